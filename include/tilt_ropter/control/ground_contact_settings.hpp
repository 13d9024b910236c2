// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <limits>

/// What the controller is told about the ground. Where it is, is a ContactEstimate.
namespace tilt_ropter {

/// Which references are on the ground, how it is reached, and what thrust is kept there.
struct GroundContactSettings {
  /// A reference that neither takes off nor lands is on the ground if it is lower than this above
  /// the height at which the CoM stands; one that does, if it is lower than a millimetre [m].
  double reference_tolerance = 0.03;
  /// Height of the ground that references were planned for: what is on the ground there counts as
  /// such where the ground turns out to be lower, too. -infinity: the ground's estimate alone [m].
  double planned_height = -std::numeric_limits<double>::infinity();
  /// With which the vehicle comes down where the reference is on the ground and no ground is met
  /// [m/s].
  double settling_speed = 0.10;
  /// Vertical thrust asked for on the ground; keeps tilt angles defined [N].
  double down_force = 0.75;
  /// Vertical thrust that a rotor keeps on the ground where torques take from it, see GroundThrust
  /// [N].
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
