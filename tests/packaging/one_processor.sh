#!/usr/bin/env bash
# one_processor.sh SOURCE_DIR
# Checks that TILT_ROPTER_NATIVE, which ./examples/run.sh sets, compiles every file of a program for
# the same processor. Otherwise the program would end at its start.
set -euo pipefail

source=$1
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cmake -S "$source" -B "$away" -DCMAKE_BUILD_TYPE=Release -DTILT_ROPTER_NATIVE=ON \
  -DTILT_ROPTER_BUILD_EXAMPLES=ON -DCMAKE_EXPORT_COMPILE_COMMANDS=ON > "$away/log" 2>&1 ||
  { cat "$away/log"; exit 1; }
commands=$(grep -c '"command"' "$away/compile_commands.json")
native=$(grep '"command"' "$away/compile_commands.json" | grep -c -- -march=native)
echo "$native of $commands files are compiled for this processor"
[[ $native -eq $commands && $commands -gt 10 ]]
