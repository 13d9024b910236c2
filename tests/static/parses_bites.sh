#!/usr/bin/env bash
# parses_bites.sh DIRECTORY COMPILER INCLUDE_DIR FLAG...
# Checks that parses.sh finds headers that are wrong or lack an include, and passes on the headers
# that no other header includes.
set -euo pipefail

directory=$1
compiler=$2
include=$3
flags=("${@:4}")
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cp "$directory"/*.users "$away"
for once in "$directory"/*.hpp "$directory"/*.pch; do ln -s "$once" "$away"; done
header=$away/header.hpp
echo "$header" > "$away/included"

parses() {
  bash "$(dirname "$0")/parses.sh" "$away" "$compiler" "$header" "${flags[@]}" -- \
    echo "passed on" 2>&1
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
: > "$away/included"
[[ $(parses) == "passed on" ]] || { echo "a header that is not included was parsed" && exit 1; }

# The headers with the longest times are still measured.
for measured in control/nmpc control/actuator_nmpc simulation/plant tilt_ropter compiled; do
  [[ -e $include/tilt_ropter/$measured.hpp ]]
  if grep -qxF "$include/tilt_ropter/$measured.hpp" "$directory/included"; then
    echo "$measured.hpp is not measured"
    exit 1
  fi
done
