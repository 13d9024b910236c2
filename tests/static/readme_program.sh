#!/usr/bin/env bash
# readme_program.sh README                  print the C++ of the README as one source: its first
#                                           program, and the pieces that are no whole program as a
#                                           function, each with what the ones before it have made
# readme_program.sh README SOURCE PROGRAM   check that what begins like SOURCE, which is compiled and
#                                           run by the tests, is SOURCE, line by line, and that
#                                           PROGRAM prints what the README says under the first one
set -euo pipefail
readme=$1

block() {  # first line
  awk -v first="$1" '/^```/ { inside = !inside; fresh = inside; shown = 0; next }
    fresh { fresh = 0; shown = $0 == first }
    shown' "$readme"
}

if [[ $# -eq 1 ]]; then
  block '#include <tilt_ropter/tilt_ropter.hpp>'
  echo 'void pieces();'
  echo 'void pieces() {'
  awk '/^```cpp$/ { code = 1; text = ""; next }
    /^```/ && code { code = 0; if (text !~ /int main/) { printf "%s", text; ++count }; next }
    code { text = text $0 "\n" }
    END { exit count < 3 }' "$readme"
  echo '}'
  exit 0
fi
source=$2
program=$3
block "$(head -n 1 "$source")" | diff - "$source"
printed=$("$program")
block "$(head -n 1 <<< "$printed")" | diff <(echo "$printed") -
