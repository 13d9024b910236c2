#!/usr/bin/env bash
# readme_commands.sh SOURCE BUILD [full]
# Runs the READMEs' commands, the lines that are indented by four spaces, as they are printed and in
# their order, the first README's first, in a copy of the sources. Without `full` those that build or fly for minutes are left
# out, and the programs are BUILD's. The user's own files that they name are made here.
set -euo pipefail
source=$1
build=$2
full=${3-}
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cp -r "$source"/{include,tests,examples,cmake,CMakeLists.txt,LICENSE,README.md} "$away"
cd "$away"
export DESTDIR=$away/root  # of what is installed
mkdir build-tests
ln -s "$build/tests" build-tests/tests
if [[ ! $full ]]; then
  mkdir build
  ln -s "$build/examples" build/examples
fi

cp examples/own_loop.cpp my_robot.cpp
# Twenty seconds of a body that turns about two axes and swings, without noise.
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

ran=0
failed=0
mapfile -t readmes < <(find cmake examples tests -name README.md | LC_ALL=C sort)
mapfile -t commands < <(awk '/^```/ { code = !code } !code && /^    [^ ]/ { print substr($0, 5) }' \
  README.md "${readmes[@]}")
for command in "${commands[@]}"; do
  case $command in
    ./tests/run.sh*) echo "== not here, it runs this test: $command" && continue ;;
    *compile_cost*) echo "== in the test compile_cost: $command" && continue ;;
    *monte_carlo*) echo "== in the long form of monte_carlo_test: $command" && continue ;;
    cmake* | g++* | ./examples/run.sh* | *hitl_*)
      [[ $full ]] || { echo "== in the long form: $command" && continue; } ;;
  esac
  echo "== $command"
  ran=$((ran + 1))
  bash -c "$command" > output.txt 2>&1 < /dev/null && continue
  failed=$((failed + 1))
  tail -n 20 output.txt
done
echo "$ran of ${#commands[@]} commands ran, $failed failed"
[[ $failed -eq 0 && $ran -ge 5 ]]
