#!/usr/bin/env bash
# compiles_bites.sh COMPILER EIGEN_DIR [ONCE]
# Checks that compiles.sh finds a header that does not compile and a header that takes too long,
# also with the precompiled header ONCE of eigen_once.sh.
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

[[ ${3-} ]] || exit 0
once=$away/once.hpp
ln -s "$3" "$once"
ln -s "$3.gch" "$once.gch"
cp "$3.seconds" "$once.seconds"
quickly() {  # seconds, Eigen's directory
  bash "$check" "$header" g++:c++17 "$1" -isystem "$2" -- "$once" 2>&1
}
echo "inline double f(const Eigen::Matrix3d& m) { return m.trace(); }" > "$header"
: > "$once.users"
if quickly 1.5 "$2"; then
  echo "a header that uses Eigen without including it passed"
  exit 1
fi
sed -i '1i #include <Eigen/Core>' "$header"
bash "$(dirname "$0")/eigen_users.sh" "$away" > "$once.users"
quickly 1.5 "$2"
if output=$(quickly 0.1 "$2") || [[ $output != *"more than 0.1 s"* ]]; then
  echo "0.1 s passed for <Eigen/Core>"
  exit 1
fi
