#pragma once

#include <tilt_ropter/model/vehicle.hpp>

namespace test_support {

/// Returns the Tilt-Ropter with 3 % more mass than the controller assumes.
inline tilt_ropter::Vehicle<4> heavy_vehicle() {
  tilt_ropter::Vehicle<4> v = tilt_ropter::tilt_ropter_vehicle();
  v.body.mass *= 1.03;
  return v;
}

}  // namespace test_support
