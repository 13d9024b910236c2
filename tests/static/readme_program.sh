#!/usr/bin/env bash
# readme_program.sh README                  print the C++ of the README as one source: its first
#                                           program, and all pieces that are not programs in one
#                                           function, where each piece can use the earlier ones
# readme_program.sh README SOURCE PROGRAM   check that the excerpt in the README, a ```c++ block up
#                                           to its line `// ...`, is in SOURCE, which the tests
#                                           compile and run, and that PROGRAM, the first program,
#                                           prints the output in the README
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
    END { exit count < 2 }' "$readme"
  echo '}'
  exit 0
fi
source=$2
program=$3
excerpt=$(awk '/^```c\+\+$/ { inside = 1; next } /^ *\/\/ \.\.\.$/ { inside = 0 } inside' "$readme")
(($(wc -l <<< "$excerpt") > 30))
[[ $(sed 's/^  //' "$source") == *"$excerpt"* ]] || { echo "not in $source: the excerpt" && exit 1; }
printed=$("$program")
block "$(head -n 1 <<< "$printed")" | diff <(echo "$printed") -
