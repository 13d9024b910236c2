#!/usr/bin/env bash
# readme_commands.sh SOURCE BUILD LATE_CLOCK [full]
# Runs the commands of all README files (lines indented by four spaces) in their order, in a copy of
# the sources, README.md of the top folder first. A fenced block without a language after a command
# is its expected output: these lines must appear in the output in this order. With `full` they must
# also appear when the library LATE_CLOCK makes every tick late, because a busy machine must not
# change them (where the command takes less than 10 s). Searches no weights. Uses the programs in
# BUILD; examples/run.sh builds its own. Without `full`, skips commands that build, fly for minutes or
# are in tests of their own, and draws no picture of hybrid_mission. Generates the files of the user
# that the commands name. What each command took [s] is in BUILD/readme_commands.txt.
set -euo pipefail
source=$1
build=$2
late_clock=$3
full=${4-}
[[ -f $late_clock ]]  # the loader ignores a missing one
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cp -r "$source"/{include,tests,examples,cmake,CMakeLists.txt,LICENSE,README.md} "$away"
cd "$away"
export DESTDIR=$away/root  # of installed files
mkdir build-tests
ln -s "$build/tests" build-tests/tests
if [[ ! $full ]]; then
  mkdir build
  ln -s "$build/examples" build/examples
fi

cp examples/getting_started/own_loop.cpp my_robot.cpp
# 20 s of a body that rotates about two axes and oscillates, without noise.
awk 'BEGIN {
    print "t,wx,wy,wz,ax,ay,az" > "IMU.csv"; print "t,x,y,z,qw,qx,qy,qz" > "POSE.csv"
      for (i = 0; i <= 4000; ++i) {
        t = i / 200; yaw = 0.8 * sin(1.5 * t); roll = 0.4 * sin(2.3 * t)
        c = cos(yaw); s = sin(yaw); u = cos(roll); v = sin(roll)
        ax = -2 * sin(2 * t); ay = -0.676 * sin(1.3 * t); side = c * ay - s * ax
        printf "%.4f,%.9f,%.9f,%.9f,%.9f,%.9f,%.9f\n", t, 0.92 * cos(2.3 * t), \
          1.2 * cos(1.5 * t) * v, 1.2 * cos(1.5 * t) * u, c * ax + s * ay, u * side + v * 9.81, \
          u * 9.81 - v * side > "IMU.csv"
        c = cos(yaw / 2); s = sin(yaw / 2); u = cos(roll / 2); v = sin(roll / 2)
        if (i % 2 == 0) printf "%.4f,%.9f,%.9f,1,%.9f,%.9f,%.9f,%.9f\n", t, 0.5 * sin(2 * t), \
          0.4 * sin(1.3 * t), c * u, c * v, s * v, s * u > "POSE.csv"
      } }'

# Prints the lines of the file that are missing in output.txt, in this order. The sign of a zero is
# not compared, because rounding decides it.
missing() {  # file
  local positive='s/-(0\.0+)([^0-9]|$)/ \1\2/g'
  awk 'NR == FNR { wanted[++n] = $0; next } at < n && $0 == wanted[at + 1] { ++at }
    END { while (at < n) print wanted[++at] }' \
    <(sed -E "$positive" "$1") <(sed -E "$positive" output.txt)
}

shorter() {  # sets `command` to one that takes less time and needs the same of program and README
  case $command in
    # tune_weights_test searches.
    build/examples/tune_weights*)
      command+=" --evaluations 1 --no-mujoco --no-pictures"
      [[ $full || $command == *--vehicles* ]] || command+=" --vehicles 1"
      ;;
    # One program shows that they build, by clang in half the time; the others are in BUILD.
    "cmake -S . -B build") command="CXX=clang++ $command" ;;
    "cmake --build build "*)
      command+=" --target own_loop && find '$build/examples' -maxdepth 1 -type f -executable"
      command+=" -exec cp --symbolic-link --no-clobber --target-directory build/examples {} +"
      ;;
    *--no-pictures* | *--write-*) ;;
    build/examples/hybrid_mission*)
      [[ $full ]] || command=${command/hybrid_mission/hybrid_mission --no-pictures} ;;
  esac
}

run() {  # library to load first, or nothing
  LD_PRELOAD=$1 bash -c "$command" > output.txt 2>&1 < /dev/null
}

ran=0
failed=0
compared=0
mapfile -t readmes < <(find cmake examples tests -name README.md | LC_ALL=C sort)
mkdir steps
rm -f "$build/readme_commands.txt"
# Writes each command to a file, and the expected output after it to another file.
awk 'FNR == 1 { command = "" }
  /^```/ { inside = !inside; if (inside) { output = $0 == "```" && command != "" } else command = ""; next }
  inside && output { print > (command ".output") }
  !inside && /^    [^ ]/ { command = sprintf("steps/%03d", ++n); print substr($0, 5) > command }' \
  README.md "${readmes[@]}"
for step in steps/[0-9][0-9][0-9]; do
  command=$(< "$step")
  [[ $full ]] || command=${command/#.\/examples\/run.sh -- /build/examples/hybrid_mission }
  case $command in
    ./tests/mutation.sh*) echo "== not here, it takes an hour: $command" && continue ;;
    ./tests/run.sh*) echo "== not here, it runs this test: $command" && continue ;;
    ./examples/microcontroller/run.sh*) echo "== in run.sh --cortex-m7: $command" && continue ;;
    *compile_cost*) echo "== in the long form, the test compile_cost: $command" && continue ;;
    *monte_carlo*) echo "== in the long form of monte_carlo_test: $command" && continue ;;
    *--only\ ablations*) echo "== in ./examples/run.sh --paper: $command" && continue ;;
    *missions/cluster/*) echo "== in the long form of monte_carlo_parts_test: $command" && continue ;;
    */compare_vehicles | */stress_flights*)
      [[ $full ]] || { echo "== in the test of this program: $command" && continue; } ;;
    cmake* | g++* | ./examples/run.sh* | *hitl_* | *reproduce_paper*)
      [[ $full ]] || { echo "== in the long form: $command" && continue; } ;;
  esac
  shorter
  echo "== $command"
  ran=$((ran + 1))
  began=$SECONDS
  run "" && result=0 || result=$?
  took=$((SECONDS - began))
  echo "   $took s"
  echo "$took  $command" >> "$build/readme_commands.txt"
  if [[ $result -ne 0 ]]; then
    failed=$((failed + 1))
    tail -n 20 output.txt
  elif [[ -e $step.output ]]; then
    compared=$((compared + 1))
    lacking=$(missing "$step.output")
    if [[ $full && ! $lacking && $took -lt 10 ]]; then
      run "$late_clock" || true  # only its output is compared
      lacking=$(missing "$step.output")
    fi
    [[ ! $lacking ]] && continue
    failed=$((failed + 1))
    printf 'it does not print\n%s\nbut\n' "$lacking"
    cat output.txt
  fi
done
echo "$ran commands ran, the output of $compared compared, $failed failed"
[[ $failed -eq 0 && $ran -ge 5 && $compared -ge 5 ]]
