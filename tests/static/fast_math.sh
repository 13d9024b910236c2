#!/usr/bin/env bash
# fast_math.sh INCLUDE_DIR COMPILER EIGEN_DIR
# Every header that tests whether a number is finite includes math/detail/finite.hpp, which refuses
# -ffast-math with a message and accepts it with -fno-finite-math-only. No header and no test uses
# Eigen's test, which that flag does not save, or multiplies by zero. The check of packets is run.
set -euo pipefail

tests=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
compile=("$2" -std=c++17 -ffast-math -I "$1" -isystem "$3" -x c++)
finite=tilt_ropter/math/detail/finite.hpp
cd "$1"
headers=$(grep -rlE 'isfinite|isnan|is_finite|all_finite' --include='*.hpp' tilt_ropter)
test "$(wc -l <<< "$headers")" -gt 10
if grep -rnE 'allFinite\(\)|hasNaN\(\)' --include='*.[ch]pp' tilt_ropter "$tests" | grep -v '///'; then
  echo "use all_finite() of math/detail/finite.hpp"
  exit 1
fi
if grep -rnE '\* 0\.0\b|\b0\.0 \*' --include='*.hpp' tilt_ropter; then
  echo "-ffast-math makes zero of 0 * x even if x is NaN: use std::isfinite()"
  exit 1
fi
refusing=$(bash "$tests/static/leads_to.sh" . "$finite"; echo "$finite")
for header in $headers; do
  if ! grep -qxF "$header" <<< "$refusing"; then
    echo "$header does not include $finite: it does not refuse -ffast-math"
    exit 1
  fi
done
if output=$("${compile[@]}" -E -o /dev/null - <<< "#include <$finite>" 2>&1) ||
  [[ $output != *"add -fno-finite-math-only"* ]]; then
  echo "$finite does not refuse -ffast-math"
  exit 1
fi
"${compile[@]}" -E -o /dev/null -fno-finite-math-only - <<< "#include <$finite>"

program=$(mktemp)
trap 'rm -f "$program"' EXIT
"${compile[@]}" -O2 -fno-finite-math-only -I "$tests" "$tests/math/simd_test.cpp" -x none \
  -lgtest_main -lgtest -pthread -o "$program"
"$program" --gtest_brief=1 --gtest_filter="Packet.*"
