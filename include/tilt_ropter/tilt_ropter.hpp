#pragma once

/// The whole library. A component compiles faster; each header stands alone.
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/reference.hpp>
#include <tilt_ropter/version.hpp>
