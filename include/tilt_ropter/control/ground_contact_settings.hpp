// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>

#include <limits>

/// Settings of the controller for ground contact. ContactEstimate tells where the ground is.
namespace tilt_ropter {

/// How the model of the controller represents the ground.
enum class GroundModel {
  /// The model cannot move in the directions that the ground holds. Of the external wrench, only
  /// ContactEstimate::rolling acts on it.
  held,
  /// The model moves freely, and the whole estimated external wrench acts on it (paper, Sec.
  /// External Wrench Estimation).
  external_wrench,
};

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
  /// Selects the condition for the ground constraints. False: the reference is on the ground as
  /// above, and ContactEstimate::on_ground. True: the heights of the reference and of the vehicle
  /// are both within height_tolerance of the standing height (paper, indicator function delta).
  bool contact_by_height = false;
  double height_tolerance = 0.005;  ///< used with contact_by_height [m]
  GroundModel model = GroundModel::held;
  /// Descent speed where the reference is on the ground and the vehicle has not touched it yet
  /// [m/s]. Zero: the vehicle follows the reference as it is, as in the paper.
  double settling_speed = 0.10;
  /// Vertical thrust that is commanded on the ground [N]. It keeps the tilt angles defined.
  double down_force = 0.75;
  /// Vertical thrust that a rotor keeps on the ground where torques reduce its thrust [N]. See
  /// GroundThrust.
  double rotor_thrust = 0.06;
};

inline void validate(const GroundContactSettings& s) {
  require_positive("GroundContactSettings.reference_tolerance [m]", s.reference_tolerance);
  require(s.planned_height < std::numeric_limits<double>::infinity(),
          "GroundContactSettings.planned_height [m]", s.planned_height, "finite, or -infinity");
  require_positive("GroundContactSettings.height_tolerance [m]", s.height_tolerance);
  require(s.settling_speed == 0.0 || (s.settling_speed >= 0.01 && s.settling_speed <= 10.0),
          "GroundContactSettings.settling_speed [m/s]", s.settling_speed, "0, or in [0.01, 10]");
  require_finite("GroundContactSettings.down_force [N]", s.down_force);
  require_non_negative("GroundContactSettings.rotor_thrust [N]", s.rotor_thrust);
}

}  // namespace tilt_ropter
