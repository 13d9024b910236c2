#pragma once

#include "wrench_level.hpp"

#include <tilt_ropter/compiled_actuator_level.hpp>

/// ActuatorNmpc for every number of rotors that the programs fly. The instances for 2, 3, 5
/// and 7 rotors are not part of tilt_ropter::compiled; actuator_instances.cpp has them.
TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(extern, 2)
TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(extern, 3)
TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(extern, 5)
TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(extern, 7)
