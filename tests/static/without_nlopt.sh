#!/usr/bin/env bash
# without_nlopt.sh INCLUDE_DIR COMPILER EIGEN_DIR
# Which headers lead to NLopt: those that solve, no other; and the umbrella header
# compiles where the preprocessor finds no nlopt.h.
set -euo pipefail

compile=("$2" -std=c++17 -I "$1" -isystem "$3" -x c++)
cd "$1"
needing=$(for header in $(find tilt_ropter -mindepth 2 -name '*.hpp' | LC_ALL=C sort); do
  includes=$("${compile[@]}" -M - <<< "#include <$header>")
  [[ $includes != *nlopt.h* ]] || echo "$header"
done)
diff - <(echo "$needing") << 'HEADERS'
tilt_ropter/control/nmpc.hpp
tilt_ropter/optimal_control/dual_method.hpp
tilt_ropter/optimal_control/full_space.hpp
tilt_ropter/optimal_control/multiple_shooting.hpp
tilt_ropter/optimal_control/multipliers.hpp
tilt_ropter/optimal_control/quadratic_program.hpp
HEADERS
"${compile[@]}" -w -fsyntax-only - << 'PROGRAM'
#undef __has_include
#define __has_include(header) 0
#include <tilt_ropter/tilt_ropter.hpp>
#ifdef NLOPT_H
#error "nlopt.h was included"
#endif
int main() { return tilt_ropter::tilt_ropter_vehicle().body.mass > 0.0 ? 0 : 1; }
PROGRAM
