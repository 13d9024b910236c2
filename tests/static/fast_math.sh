#!/usr/bin/env bash
# fast_math.sh INCLUDE_DIR COMPILER EIGEN_DIR
# Every header that asks whether a number is finite refuses -ffast-math by a sentence, and takes it
# with -fno-finite-math-only. None asks Eigen, whose answer that flag does not save, and no test.
set -euo pipefail

tests=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
compile=("$2" -std=c++17 -ffast-math -I "$1" -isystem "$3" -x c++)
cd "$1"
headers=$(grep -rlE 'isfinite|is_finite|all_finite' --include='*.hpp' tilt_ropter)
test "$(wc -l <<< "$headers")" -gt 10
if grep -rnE 'allFinite\(\)|hasNaN\(\)' --include='*.[ch]pp' tilt_ropter "$tests" | grep -v '///'; then
  echo "all_finite() of math/finite.hpp is the way to ask"
  exit 1
fi
for header in $headers; do
  if output=$("${compile[@]}" -E -o /dev/null - <<< "#include <$header>" 2>&1) ||
    [[ $output != *"add -fno-finite-math-only"* ]]; then
    echo "$header does not refuse -ffast-math"
    exit 1
  fi
done
"${compile[@]}" -fsyntax-only -fno-finite-math-only - <<< '#include <tilt_ropter/tilt_ropter.hpp>'
