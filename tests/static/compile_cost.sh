#!/usr/bin/env bash
# What a program that uses Nmpc costs its compiler, as a multiple of one that includes Eigen/Dense in
# the same minute, and its memory (CHECKS 27). By -O2, which a Release build of a user may have.
#
# usage: compile_cost.sh COMPILER INCLUDE_DIR EIGEN_DIR
set -euo pipefail
compiler=$1 include=$2 eigen=$3
most_times=15 most_megabytes=700
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
  nmpc.prepare(0.0, [](double) { return tilt_ropter::ReferencePoint(); }, {});
  return nmpc.feedback(0.0, {}).wrench.force.z() > 0.0 ? 0 : 1;
}
CPP

cost() {  # source, flags: processor time [s] and memory [MB], the less of two runs
  for _ in 1 2; do
    /usr/bin/time -f '%U %S %M' -o "$away/cost" "$compiler" -std=c++17 -O2 "${@:2}" \
      -I "$include" -isystem "$eigen" -c "$away/$1.cpp" -o "$away/$1.o"
    awk '{ printf "%.2f %.0f\n", $1 + $2, $3 / 1024 }' "$away/cost"
  done | sort -g | head -1
}

read -r unit unit_megabytes <<< "$(cost eigen)"
read -r seconds megabytes <<< "$(cost nmpc)"
read -r debug_seconds debug_megabytes <<< "$(cost nmpc -g)"
times=$(awk -v a="$seconds" -v b="$unit" 'BEGIN { printf "%.1f", a / b }')
echo "Eigen/Dense: $unit s, $unit_megabytes MB"
echo "Nmpc: $seconds s, $megabytes MB, $times times as long; at most $most_times and $most_megabytes MB"
echo "with -g: $debug_seconds s, $debug_megabytes MB, at most 1200 MB"
awk -v t="$times" -v m="$megabytes" -v d="$debug_megabytes" -v most="$most_times" \
  -v memory="$most_megabytes" 'BEGIN { exit !(t <= most && m <= memory && d <= 1200) }'
