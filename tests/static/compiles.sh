#!/usr/bin/env bash
# compiles.sh FILE "COMPILER:STANDARD..." FLAG...
# FILE, a header or a source, compiles by itself under each pair, such as clang++:c++20.
set -euo pipefail

file=$1
pairs=$2
shift 2
for pair in $pairs; do
  compiler=${pair%%:*}
  standard=${pair#*:}
  if ! command -v "$compiler" > /dev/null; then
    echo "$pair: not installed, left out"
    continue
  fi
  echo "$pair"
  "$compiler" "-std=$standard" -fsyntax-only "$@" -x c++ - <<< "#include \"$file\""
done
