#!/usr/bin/env bash
# parses.sh DIRECTORY COMPILER HEADER FLAG... -- COMMAND...
# Checks that HEADER is correct alone if DIRECTORY/included of headers_once.sh lists it: it is only
# parsed, with the last precompiled header in DIRECTORY that it includes. The check of the header
# that includes it measures its time and generates its code. Runs COMMAND for all other headers.
set -euo pipefail

directory=$1
compiler=$2
header=$3
shift 3
flags=(-std=c++17)
while [[ $1 != -- ]]; do
  flags+=("$1")
  shift
done
shift
grep -qxF "$header" "$directory/included" || exec "$@"

parse() {
  "$compiler" "${flags[@]}" "$@" -fsyntax-only -x c++ - <<< "#include \"$header\""
}
number=$(grep -lxF "$header" "$directory"/*.users | sed -E 's|.*/([0-9]+)\.users|\1|' |
  sort -n | tail -n 1) || true
if [[ $number ]]; then
  echo "parsed with precompiled $(< "$directory/$number.hpp")"
  parse -include "$directory/$number.hpp" && exit 0
  echo "and now without it, in case that a header has changed since"
fi
parse
