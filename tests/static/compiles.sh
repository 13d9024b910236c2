#!/usr/bin/env bash
# compiles.sh FILE "COMPILER:STANDARD..." SECONDS FLAG...
# Checks that FILE, a header or a source, compiles alone with each pair, such as clang++:c++20, in
# at most SECONDS of processor time (0: no limit) on a machine that takes 0.6 s for <Eigen/Dense>.
# If FILE takes longer, the machine may be busy or slow: FILE is then compared with <Eigen/Dense>,
# up to six times. Each counts with its shortest time, and the limit scales with the time of
# <Eigen/Dense>.
set -euo pipefail

file=$1
pairs=$2
limit=$3
flags=("${@:4}")
TIMEFORMAT=%U

compile() {  # header: prints seconds
  exec 3>&2
  { time "$compiler" "-std=$standard" -O2 -c -o /dev/null "${flags[@]}" -x c++ - \
    <<< "#include $1" 2>&3; } 2>&1
}

holds() {  # an expression of awk
  awk "BEGIN { exit !($1) }"
}

for pair in $pairs; do
  compiler=${pair%%:*}
  standard=${pair#*:}
  if ! command -v "$compiler" > /dev/null; then
    echo "$pair: not installed, left out"
    continue
  fi
  seconds=$(compile "\"$file\"")
  echo "$pair: $seconds s"
  holds "$limit == 0 || $seconds <= $limit" && continue
  dense=1e9
  for _ in 1 2 3 4 5 6; do
    now=$(compile '<Eigen/Dense>')
    holds "$now < $dense" && dense=$now
    echo "$pair: $seconds s, Eigen/Dense $dense s"
    ratio="$seconds / ($limit * ($dense > 0.6 ? $dense / 0.6 : 1))"
    holds "$ratio <= 1" && continue 2
    holds "$ratio > 2" && break  # not by noise
    now=$(compile "\"$file\"")
    holds "$now < $seconds" && seconds=$now
  done
  echo "more than $limit s"
  exit 1
done
