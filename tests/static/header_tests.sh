#!/usr/bin/env bash
# header_tests.sh SOURCE_DIR
# Checks that every header of the library has a test file of its name, or a line in the table of
# CONTRIBUTING.md that names the tests that hold it, and that these exist. Checks that every header
# outside of detail/ is used or named, with one of its types, by a program or a README of ours.
set -euo pipefail
shopt -s inherit_errexit

cd "$1"
table=$(grep -E '^\| `[a-z_]+/[a-z_]+`' .github/CONTRIBUTING.md)
result=0
say() {
  echo "$1"
  result=1
}
tests=$(find tests -name '*_test.cpp' -printf '/%f/\n')
for header in $(find include/tilt_ropter -mindepth 2 -name '*.hpp' -printf '%P\n' | LC_ALL=C sort); do
  name=${header##*/}
  name=${name%.hpp}
  [[ $tests == *"/${name}_test.cpp/"* || $tests == *"/${name}_"* ||
    $table == *"\`${header%%/*}/$name\`"* ]] ||
    say "include/tilt_ropter/$header: no test of its name, and no line in CONTRIBUTING.md"
done
for name in $(cut -d '|' -f 2 <<< "$table" | grep -oE '[a-z_]+/[a-z_]+'); do
  [[ -e include/tilt_ropter/$name.hpp || -e include/tilt_ropter/${name/\//\/detail/}.hpp ]] ||
    say "CONTRIBUTING.md: no header $name.hpp"
done
for test in $(cut -d '|' -f 3 <<< "$table" | grep -oE '[a-z_/.]+'); do
  [[ $test == *.sh && -e $test || $tests == *"/$test.cpp/"* ]] ||
    say "CONTRIBUTING.md: no test $test"
done
unused=$(
  {
    find README.md examples -type f -exec cat {} +
    echo "== headers"
    find include/tilt_ropter -name '*.hpp' ! -path '*/detail/*' | LC_ALL=C sort |
      while read -r header; do
        echo "== ${header#include/}"
        cat "$header"
      done
  } | awk '
    function report() { if (header && !used) print header }
    $0 == "== headers" { declared = 1; next }
    !declared {
      if (match($0, /<tilt_ropter\/[a-z_\/.]+>/)) word[substr($0, RSTART + 1, RLENGTH - 2)]
      n = split($0, words, /[^A-Za-z_0-9]+/)
      for (i = 1; i <= n; ++i) word[words[i]]
      next
    }
    /^== / { report(); header = $2; used = header in word; next }
    {
      noun = ""
      if (/^(class|struct|enum class) [A-Za-z]/) noun = $1 == "enum" ? $3 : $2
      else if (/^\[\[nodiscard\]\].* [a-z_]+\(/) { noun = $0; sub(/\(.*/, "", noun); sub(/.* /, "", noun) }
      sub(/[^A-Za-z_].*/, "", noun)
      if (noun && ((noun in word) || ((noun "d") in word))) used = 1
    }
    END { report() }'
)
[[ ! $unused ]] || say "no program and no README of ours uses what it declares: $unused"
exit $result
