// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <limits>

/// Settings of the controller for ground contact. ContactEstimate tells where the ground is.
namespace tilt_ropter {

/// Settings for references on the ground, for the descent to the ground, and for the thrust there.
struct GroundContactSettings {
  /// Height above the standing height of the CoM below which a reference counts as on the ground
  /// [m]. It applies to a reference that neither takes off nor lands. For a reference that takes
  /// off or lands, the limit is one millimetre.
  double reference_tolerance = 0.03;
  /// Height of the ground for which references were planned [m]. A reference on this ground counts
  /// as on the ground, also where the estimated ground is lower. -infinity: only the estimated
  /// ground counts.
  double planned_height = -std::numeric_limits<double>::infinity();
  /// Descent speed where the reference is on the ground and the vehicle has not touched it yet
  /// [m/s].
  double settling_speed = 0.10;
  /// Vertical thrust that is commanded on the ground [N]. It keeps the tilt angles defined.
  double down_force = 0.75;
  /// Vertical thrust that a rotor keeps on the ground where torques reduce its thrust [N]. See
  /// GroundThrust.
  double rotor_thrust = 0.08;
};

inline void validate(const GroundContactSettings& s) {
  require_positive("GroundContactSettings.reference_tolerance [m]", s.reference_tolerance);
  require(s.planned_height < std::numeric_limits<double>::infinity(),
          "GroundContactSettings.planned_height [m]", s.planned_height, "finite, or -infinity");
  require_in("GroundContactSettings.settling_speed [m/s]", s.settling_speed, 0.01, 10.0);
  require_finite("GroundContactSettings.down_force [N]", s.down_force);
  require_non_negative("GroundContactSettings.rotor_thrust [N]", s.rotor_thrust);
}

}  // namespace tilt_ropter
