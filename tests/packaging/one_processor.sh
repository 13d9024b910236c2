#!/usr/bin/env bash
# one_processor.sh SOURCE_DIR
# With TILT_ROPTER_NATIVE, as ./examples/run.sh has it, every file that a program is linked from is
# compiled for the same processor: otherwise the program ends as it starts.
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
