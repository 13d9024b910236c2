#!/usr/bin/env bash
# parses.sh DIRECTORY COMPILER HEADER FLAG...
# Checks that HEADER is correct alone: parses it with the last precompiled header in DIRECTORY, of
# headers_once.sh, that it includes.
set -euo pipefail

directory=$1
compiler=$2
header=$3
flags=(-std=c++17 "${@:4}")

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
