#!/usr/bin/env bash
# compiles.sh FILE "COMPILER:STANDARD..." SECONDS FLAG...
# FILE, a header or a source, compiles by itself under each pair, such as clang++:c++20, and takes
# no more than SECONDS (0: any time). The processor's time counts, which hardly depends on what else
# the machine does, and the best of three.
set -euo pipefail

file=$1
pairs=$2
limit=$3
shift 3
TIMEFORMAT=%U
for pair in $pairs; do
  compiler=${pair%%:*}
  standard=${pair#*:}
  if ! command -v "$compiler" > /dev/null; then
    echo "$pair: not installed, left out"
    continue
  fi
  for attempt in 1 2 3; do
    exec 3>&2
    seconds=$({ time "$compiler" "-std=$standard" -O2 -c -o /dev/null "$@" -x c++ - \
      <<< "#include \"$file\"" 2>&3; } 2>&1)
    echo "$pair: $seconds s"
    awk "BEGIN { exit !($limit == 0 || $seconds <= $limit) }" && continue 2
  done
  echo "more than $limit s"
  exit 1
done
