#!/usr/bin/env bash
# The compile cost of a program that uses Nmpc, as a multiple of a program that includes only
# Eigen/Dense, and the memory of the compiler (check 27): header-only, with -g, and with the
# instances of tilt_ropter::compiled. Uses -O2, as a Release build of a user may do.
#
# usage: compile_cost.sh COMPILER INCLUDE_DIR EIGEN_DIR [full | count [FLAG...]]
# Measures processor time; `full` also measures -g and the loop of the README. `count` measures no
# time: it counts the bytes that GCC allocates while it compiles, which are the same on a busy machine
# and grow with what it parses, instantiates and optimises. It compiles with the flags, which may
# make warnings errors.
set -euo pipefail
compiler=$1 include=$2 eigen=$3 form=${4-} flags=("${@:5}")
most_times=15 most_megabytes=700 most_debug_megabytes=1200 most_compiled_times=4
most_loop_times=30 most_loop_megabytes=1080
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT

cat > "$away/eigen.cpp" << 'CPP'
#include <Eigen/Dense>
int main(int argc, char**) { return (Eigen::Matrix3d::Identity() * argc).trace() > 6.0; }
CPP
cat > "$away/nmpc.cpp" << 'CPP'
#include <tilt_ropter/control/nmpc.hpp>
int main() {
  tilt_ropter::Nmpc<4> nmpc(tilt_ropter::tilt_ropter_vehicle());
  (void)nmpc.prepare(0.0, [](double) { return tilt_ropter::ReferencePoint(); }, {});
  return nmpc.feedback(0.0, {}).wrench.force.z() > 0.0 ? 0 : 1;
}
CPP

sed 's|control/nmpc.hpp|compiled.hpp|' "$away/nmpc.cpp" > "$away/compiled.cpp"

if [[ $form == count ]]; then
  count() {  # source: sets `bytes` [MB]. Without garbage collection all of them remain at the end
    "$compiler" -std=c++17 -O2 -fmem-report --param ggc-min-expand=1000000 \
      --param ggc-min-heapsize=100000000 "${flags[@]}" -I "$include" -isystem "$eigen" \
      -c "$away/$1.cpp" -o /dev/null 2> "$away/report" || { cat "$away/report" >&2; exit 1; }
    bytes=$(awk '/^Size  *Allocated/ { heap = 1 } heap && /^Total/ { n = $2 + 0
      u = substr($2, length($2)); print u == "k" ? n / 1024 : u == "G" ? 1024 * n : n; exit }' \
      "$away/report")
  }
  count eigen
  unit=$bytes result=0
  for limit in compiled:2.6 nmpc:4.6; do
    count "${limit%:*}"
    awk -v name="${limit%:*}" -v most="${limit#*:}" -v bytes="$bytes" -v unit="$unit" 'BEGIN {
        printf "%s: %d MB, %.2f times Eigen/Dense, at most %s\n", name, bytes, bytes / unit, most
        exit !(bytes > 0 && unit > 0 && bytes <= most * unit) }' || result=1
  done
  exit $result
fi

cost() {  # source, flags: processor time [s] and memory [MB]
  /usr/bin/time -f '%U %S %M' -o "$away/cost" "$compiler" -std=c++17 -O2 "${@:2}" \
    -I "$include" -isystem "$eigen" -c "$away/$1.cpp" -o "$away/$1.o"
  awk '{ printf "%.2f %.0f\n", $1 + $2, $3 / 1024 }' "$away/cost"
}

at_most() {  # limit, measured
  awk -v limit="$1" -v measured="$2" 'BEGIN { exit !(measured <= limit) }'
}
ratio() { awk -v a="$1" -v b="$unit" 'BEGIN { printf "%.1f", a / b }'; }

# A machine that serves others takes 20 % longer at times. Each program counts with its shortest
# time, and one that is over its limit is compiled again, in turn with Eigen/Dense.
unit=1e9 seconds=1e9 compiled_seconds=1e9
for attempt in 1 2 3; do
  for _ in 1 2; do
    read -r now _ <<< "$(cost eigen)"
    at_most "$now" "$unit" || unit=$now
  done
  if [[ $attempt == 1 ]] || ! at_most $most_times "$(ratio "$seconds")"; then
    read -r now megabytes <<< "$(cost nmpc)"
    at_most "$now" "$seconds" || seconds=$now
  fi
  if [[ $attempt == 1 ]] || ! at_most $most_compiled_times "$(ratio "$compiled_seconds")"; then
    read -r now compiled_megabytes <<< "$(cost compiled)"
    at_most "$now" "$compiled_seconds" || compiled_seconds=$now
  fi
  at_most $most_times "$(ratio "$seconds")" &&
    at_most $most_compiled_times "$(ratio "$compiled_seconds")" && break
done
size=$(stat -c %s "$away/nmpc.o")
compiled_size=$(stat -c %s "$away/compiled.o")
times=$(ratio "$seconds") compiled_times=$(ratio "$compiled_seconds")
echo "Eigen/Dense: $unit s"
echo "Nmpc: $seconds s, $megabytes MB, $((size / 1024)) KB of object, $times times as long;" \
  "at most $most_megabytes MB and $most_times times"
echo "with compiled instances: $compiled_seconds s, $compiled_megabytes MB," \
  "$((compiled_size / 1024)) KB of object, $compiled_times times as long;" \
  "at most $most_compiled_times times"

at_most $most_times "$times"
at_most $most_compiled_times "$compiled_times"
at_most $most_megabytes "$megabytes"
if [[ $form == full ]]; then
  read -r debug_seconds debug_megabytes <<< "$(cost nmpc -g)"
  echo "with -g: $debug_seconds s, $debug_megabytes MB; at most $most_debug_megabytes MB"
  at_most $most_debug_megabytes "$debug_megabytes"
  cp "$include/../examples/getting_started/own_loop.cpp" "$away"
  read -r loop_seconds loop_megabytes <<< "$(cost own_loop)"
  loop_times=$(ratio "$loop_seconds")
  echo "own_loop: $loop_seconds s, $loop_megabytes MB, $loop_times times as long; at most" \
    "$most_loop_megabytes MB and $most_loop_times times"
  at_most $most_loop_megabytes "$loop_megabytes"
  at_most $most_loop_times "$loop_times"
fi
