#!/usr/bin/env bash
# names.sh INCLUDE_DIR
# Checks that every `name` between backticks in a comment of a header below INCLUDE_DIR/tilt_ropter,
# such as a parameter, exists in the code of that header. Doxygen does not check these names. Prints
# errors; then fails.
set -euo pipefail
shopt -s inherit_errexit

cd "$1/tilt_ropter"
wrong=$(
  find . -name '*.hpp' -printf '%P\n' | sort | while read -r header; do
    code=$(sed 's|//.*||' "$header" | grep -oE '[A-Za-z_][A-Za-z_0-9]*' | sort -u)
    names=$({ grep -oE '//.*' "$header" || true; } |
      { grep -oE '`[A-Za-z_][A-Za-z_0-9]*(\(\))?`' || true; } | tr -d '`()' | sort -u)
    comm -13 <(echo "$code") <(echo "$names") | sed "/^$/d; s|^|$header has no |"
  done
)
if [[ $wrong ]]; then
  echo "$wrong"
  exit 1
fi
echo "names in comments are those of the code"
