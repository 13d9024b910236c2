#!/usr/bin/env bash
# lengths.sh SOURCE_DIR
# Checks that tests have at most 400 lines. Prints every file that is too long.
set -euo pipefail
shopt -s inherit_errexit

cd "$1"
too_long=$(
  find tests -name '*_test.cpp' | sort | xargs wc -l |
    awk '$1 > 400 && $2 != "total" { print $2 ": " $1 " lines" }'
)
if [[ $too_long ]]; then
  echo "$too_long"
  exit 1
fi
echo "no test of more than 400 lines"
