#!/usr/bin/env bash
# readme_program.sh README SOURCE
# The README's first C++ program is SOURCE, which is compiled and run by the tests, line by line.
set -euo pipefail
diff <(sed -n '/^```cpp$/,/^```$/p' "$1" | sed '/^```cpp$/d; /^```$/Q') "$2"
