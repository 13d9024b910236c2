#!/usr/bin/env bash
# lengths.sh SOURCE_DIR
# Checks that headers of the library have at most 350 lines, or say in their first comment why they
# are long, and that tests have at most 400 lines. Prints every file that is too long.
set -euo pipefail
shopt -s inherit_errexit

cd "$1"
too_long=$(
  find include -name '*.hpp' | sort | while read -r header; do
    ((lines = $(wc -l < "$header"))) && ((lines <= 350)) && continue
    # The words of the first comment, which wrap anywhere.
    awk '/^\/\/\// { sub("^/// ?", ""); print; found = 1; next } found { exit }' "$header" |
      tr -s ' \n' ' ' |
      grep -qE 'is long because' || echo "$header: $lines lines, and no reason"
  done
  find tests -name '*_test.cpp' | sort | while read -r test; do
    ((lines = $(wc -l < "$test"))) && ((lines <= 400)) || echo "$test: $lines lines"
  done
)
if [[ $too_long ]]; then
  echo "$too_long"
  exit 1
fi
echo "no header of more than 350 lines without a reason, no test of more than 400"
