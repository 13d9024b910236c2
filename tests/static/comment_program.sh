#!/usr/bin/env bash
# comment_program.sh HEADER NLOPT COMPILER FLAG...
# Checks that the first C++ program in the doc comments of HEADER compiles, links with the library
# NLOPT and returns 0.
set -euo pipefail

header=$1
nlopt=$2
shift 2
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
sed -n '/^\/\/\/ ```cpp$/,/^\/\/\/ ```$/p' "$header" |
  sed -E '/^\/\/\/ ```cpp$/d; /^\/\/\/ ```$/Q; s|^/// ?||' > "$away/program.cpp"
"$@" "$away/program.cpp" "$nlopt" -o "$away/program"
"$away/program"
