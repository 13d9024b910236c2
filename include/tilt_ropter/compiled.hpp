// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/ekf.hpp>

/// If the program links to tilt_ropter::compiled, include this header instead of the headers that
/// it includes. It declares the template instances of that library, so the including file does not
/// compile them. The library is built with the flags of the project that links to it; see
/// cmake/compiled.cmake. For ActuatorNmpc, include compiled_actuator_level.hpp.
///
/// The library also contains Ekf in double precision, for any number of rotors.

/// Instances for one number of rotors, and for one level of control. `prefix` is `extern` for a
/// declaration.
// NOLINTBEGIN(bugprone-macro-parentheses): types and `extern` cannot be in parentheses.
#define TILT_ROPTER_INSTANCES(prefix, rotors)                                 \
  TILT_ROPTER_NMPC_INSTANCE(prefix, tilt_ropter::detail::WrenchLevel<rotors>) \
  prefix template class tilt_ropter::Allocation<rotors>;
#define TILT_ROPTER_NMPC_INSTANCE(prefix, ...) \
  prefix template class __VA_ARGS__;           \
  prefix template class tilt_ropter::RecedingHorizonController<__VA_ARGS__>;
// NOLINTEND(bugprone-macro-parentheses)

TILT_ROPTER_INSTANCES(extern, 4)
TILT_ROPTER_INSTANCES(extern, 6)
TILT_ROPTER_INSTANCES(extern, 8)
extern template class tilt_ropter::Ekf<double>;
