#!/usr/bin/env bash
# names.sh INCLUDE_DIR
# Checks that every `name` between backticks in a comment of a header below INCLUDE_DIR/tilt_ropter,
# such as a parameter, exists in the code of that header. Doxygen does not check these names. Prints
# errors; then fails.
set -euo pipefail
shopt -s inherit_errexit

cd "$1/tilt_ropter"
wrong=$(
  find . -name '*.hpp' -printf '%P\n' | sort | xargs awk '
    function report(i) {
      for (i = 1; i <= told; ++i) if (!(name[i] in code)) print header " has no " name[i]
      split("", code)
      split("", seen)
      told = 0
    }
    FNR == 1 { report(); header = FILENAME }
    {
      comment = (at = index($0, "//")) ? substr($0, at) : ""
      n = split(at ? substr($0, 1, at - 1) : $0, words, /[^A-Za-z_0-9]+/)
      for (i = 1; i <= n; ++i) code[words[i]]
      n = split(comment, between, "`")
      for (i = 2; i < n; ++i) {
        sub(/\(\)$/, "", between[i])
        if (between[i] ~ /^[A-Za-z_][A-Za-z_0-9]*$/ && !(between[i] in seen)) {
          seen[between[i]]
          name[++told] = between[i]
        }
      }
    }
    END { report() }'
)
if [[ $wrong ]]; then
  echo "$wrong"
  exit 1
fi
echo "names in comments are those of the code"
