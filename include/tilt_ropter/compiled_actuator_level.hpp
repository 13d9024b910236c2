// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/compiled.hpp>
#include <tilt_ropter/control/nmpc.hpp>

/// Same as compiled.hpp, for programs that use ActuatorNmpc. It is a separate header because its
/// declarations cost every file that includes it half a second.

/// Instance for one number of rotors. `prefix` is `extern` for a declaration.
#define TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(prefix, rotors) \
  TILT_ROPTER_NMPC_INSTANCE(prefix, tilt_ropter::detail::ActuatorLevel<rotors>)

TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(extern, 4)
TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(extern, 6)
TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(extern, 8)
