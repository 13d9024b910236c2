#!/usr/bin/env bash
# one_processor.sh COMPILER INCLUDE_DIR EIGEN_DIR
# Checks that a program whose files are compiled for different processors (different alignment in
# Eigen) ends at its start with a message, and that a program with equal files runs.
set -euo pipefail
compile=("$1" -std=c++17 -I "$2" -isystem "$3" -c)
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT

echo '#include <tilt_ropter/model/state.hpp>' > "$away/other.cpp"
printf '%s\nint main() {}\n' '#include <tilt_ropter/model/vehicle.hpp>' > "$away/main.cpp"
"${compile[@]}" "$away/main.cpp" -o "$away/main.o"
"${compile[@]}" "$away/other.cpp" -o "$away/alike.o"
# The setting that -march changes.
"${compile[@]}" -DEIGEN_MAX_STATIC_ALIGN_BYTES=64 "$away/other.cpp" -o "$away/different.o"
"$1" "$away/main.o" "$away/alike.o" -o "$away/alike"
"$away/alike"
"$1" "$away/main.o" "$away/different.o" -o "$away/mixed"
if "$away/mixed" 2> "$away/message"; then
  echo "a program of two kinds of files has run"
  exit 1
fi
cat "$away/message"
grep -q "Compile all of them for the same processor" "$away/message"
