#!/usr/bin/env bash
# compiles_bites.sh COMPILER EIGEN_DIR
# Checks that compiles.sh finds a header that does not compile and a header that takes too long.
set -euo pipefail

check=$(dirname "$0")/compiles.sh
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
mkdir "$away/tilt_ropter"
header=$away/tilt_ropter/header.hpp

echo '#include <vector>' > "$header"
bash "$check" "$header" "$1:c++17" 30 -isystem "$2"
if output=$(bash "$check" "$header" "$1:c++17" 0.01 -isystem "$2") ||
  [[ $output != *"more than 0.01 s"* ]]; then
  echo "0.01 s passed for <vector>"
  exit 1
fi
echo 'inline int f() { return missing; }' >> "$header"
if bash "$check" "$header" "$1:c++17" 0 -isystem "$2" 2> /dev/null; then
  echo "a header that does not compile passed"
  exit 1
fi
