#!/usr/bin/env bash
# readme_program.sh README SOURCE COMPILER NLOPT [FLAG...]
# Of the README's C++: what begins like SOURCE, which is compiled and run by the tests, is SOURCE,
# line by line; the first program prints what the README says under it; and the pieces that are no
# whole program compile, each with what the ones before it have made.
set -euo pipefail
readme=$1
source=$2
compiler=$3
nlopt=$4
shift 4
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT

block() {  # first line
  awk -v first="$1" '/^```/ { inside = !inside; fresh = inside; shown = 0; next }
    fresh { fresh = 0; shown = $0 == first }
    shown' "$readme"
}
block "$(head -n 1 "$source")" | diff - "$source"

{
  block '#include <tilt_ropter/tilt_ropter.hpp>'
  echo 'void pieces() {'
  awk '/^```cpp$/ { code = 1; text = ""; next }
    /^```/ && code { code = 0; if (text !~ /int main/) { printf "%s", text; ++count }; next }
    code { text = text $0 "\n" }
    END { exit count < 5 }' "$readme"
  echo '}'
} > "$away/first.cpp"
"$compiler" "$@" "$away/first.cpp" "$nlopt" -o "$away/first"
"$away/first" > "$away/printed.txt"
block "$(head -n 1 "$away/printed.txt")" | diff "$away/printed.txt" -
