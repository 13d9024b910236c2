#pragma once

#include <tilt_ropter/model/vehicle.hpp>

namespace test_support {

/// Returns a vehicle with 3 % more mass than `believed`.
template <int Rotors>
tilt_ropter::Vehicle<Rotors> heavier(tilt_ropter::Vehicle<Rotors> believed) {
  believed.body.mass *= 1.03;
  return believed;
}

/// Returns the Tilt-Ropter with 3 % more mass than the controller assumes.
inline tilt_ropter::Vehicle<4> heavy_vehicle() {
  return heavier(tilt_ropter::tilt_ropter_vehicle());
}

}  // namespace test_support
