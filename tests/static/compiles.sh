#!/usr/bin/env bash
# compiles.sh FILE "COMPILER:STANDARD..." SECONDS FLAG...
# FILE, a header or a source, compiles by itself under each pair, such as clang++:c++20, and takes
# no more than SECONDS (0: any time). The processor's time counts, and the best of three. A busy
# machine shares caches and cores: what takes longer is compared with <Eigen/Dense> beside it, which
# takes 0.6 s on the machine that the limits are meant for.
set -euo pipefail

file=$1
pairs=$2
limit=$3
shift 3
TIMEFORMAT=%U

compile() {  # header, flags: prints seconds
  exec 3>&2
  { time "$compiler" "-std=$standard" -O2 -c -o /dev/null "${@:2}" -x c++ - \
    <<< "#include $1" 2>&3; } 2>&1
}

within_limit() {
  [[ $limit == 0 ]] || awk "BEGIN { exit !($seconds <= $limit * $1) }"
}

for pair in $pairs; do
  compiler=${pair%%:*}
  standard=${pair#*:}
  if ! command -v "$compiler" > /dev/null; then
    echo "$pair: not installed, left out"
    continue
  fi
  for attempt in 1 2 3; do
    seconds=$(compile "\"$file\"" "$@")
    echo "$pair: $seconds s"
    within_limit 1 && continue 2
    slowness=$(awk -v t="$(compile '<Eigen/Dense>' "$@")" 'BEGIN { print (t > 0.6 ? t / 0.6 : 1) }')
    echo "the machine is slower by $slowness"
    within_limit "$slowness" && continue 2
  done
  echo "more than $limit s"
  exit 1
done
