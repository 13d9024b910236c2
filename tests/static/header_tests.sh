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
for header in $(find include/tilt_ropter -mindepth 2 -name '*.hpp' | LC_ALL=C sort); do
  name=$(basename "$header" .hpp)
  own=$(find tests -name "${name}_test.cpp" -o -name "${name}_*_test.cpp")
  folder=$(cut -d / -f 3 <<< "$header")
  line=$(grep -cF "\`$folder/$name\`" <<< "$table" || true)
  [[ $own || $line != 0 ]] || say "$header: no test of its name, and no line in CONTRIBUTING.md"
done
for name in $(cut -d '|' -f 2 <<< "$table" | grep -oE '[a-z_]+/[a-z_]+'); do
  [[ -e include/tilt_ropter/$name.hpp || -e include/tilt_ropter/${name/\//\/detail/}.hpp ]] ||
    say "CONTRIBUTING.md: no header $name.hpp"
done
for test in $(cut -d '|' -f 3 <<< "$table" | grep -oE '[a-z_/.]+'); do
  [[ $test == *.sh && -e $test || -n $(find tests -name "$test.cpp") ]] ||
    say "CONTRIBUTING.md: no test $test"
done
for header in $(find include/tilt_ropter -name '*.hpp' ! -path '*/detail/*' | LC_ALL=C sort); do
  nouns=$(sed -nE 's/^(class|struct|enum class) ([A-Za-z]+).*/\2/p
    s/^\[\[nodiscard\]\].* ([a-z_]+)\(.*/\1/p' "$header" | paste -sd '|')
  path=${header#include/}
  grep -rqE "<$path>|\b(${nouns:-none})d?\b" README.md examples ||
    say "$header: no program and no README of ours uses what it declares"
done
exit $result
