#!/usr/bin/env bash
# parses_bites.sh DIRECTORY COMPILER FLAG...
# Checks that parses.sh finds headers that are wrong or lack an include.
set -euo pipefail

directory=$1
compiler=$2
flags=("${@:3}")
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cp "$directory"/*.users "$away"
for once in "$directory"/*.hpp "$directory"/*.pch; do ln -s "$once" "$away"; done
header=$away/header.hpp

parses() {
  bash "$(dirname "$0")/parses.sh" "$away" "$compiler" "$header" "${flags[@]}" 2>&1
}
refuses() {  # reason
  if parses; then
    echo "$1 passed"
    exit 1
  fi
}
body='inline double f(const tilt_ropter::Vehicle<4>& v) { return v.body.mass; }'
echo "$body" > "$header"
refuses "a header that includes nothing"
printf '#include <tilt_ropter/model/vehicle.hpp>\n%s\n' "$body" > "$header"
[[ $(parses) != *precompiled* ]] || { echo "a precompiled header that it does not include" && exit 1; }
vehicle=$(grep -lF vehicle.hpp "$away"/[0-9].hpp)
echo "$header" >> "${vehicle%.hpp}.users"
[[ $(parses) == *precompiled*vehicle.hpp* ]] || { echo "not precompiled" && exit 1; }
echo 'inline tilt_ropter::MissingType g() { return {}; }' >> "$header"
refuses "a wrong header"
