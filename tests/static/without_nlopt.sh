#!/usr/bin/env bash
# without_nlopt.sh INCLUDE_DIR COMPILER EIGEN_DIR
# Checks that only the headers of the solver include NLopt, and that the controller of
# without_nlopt.cpp works with TILT_ROPTER_WITHOUT_NLOPT and the flags of a microcontroller.
set -euo pipefail

here=$(realpath "$(dirname "${BASH_SOURCE[0]}")")
leads_to=$here/leads_to.sh
needing=$(bash "$leads_to" "$1" nlopt.h | grep -v '^tilt_ropter/[^/]*$')
diff - <(echo "$needing") << 'HEADERS'
tilt_ropter/control/detail/actuator_level.hpp
tilt_ropter/control/detail/wrench_level.hpp
tilt_ropter/control/nmpc.hpp
tilt_ropter/optimal_control/detail/dual_method.hpp
tilt_ropter/optimal_control/detail/multipliers.hpp
tilt_ropter/optimal_control/detail/quadratic_program.hpp
tilt_ropter/optimal_control/multiple_shooting.hpp
tilt_ropter/optimal_control/single_shooting.hpp
HEADERS

away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
"$2" -std=c++17 -fno-exceptions -fno-rtti -DTILT_ROPTER_WITHOUT_NLOPT -DTILT_ROPTER_NOT_OPTIMISED \
  -Wall -Wextra -Wconversion -Werror -I "$1" -isystem "$3" "$here/without_nlopt.cpp" \
  -o "$away/controller"
{ "$away/controller" || true; } 2> "$away/refusal"  # ends by abort()
grep 'QuadraticProgramSettings.method = nlopt' "$away/refusal"
