// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/contact.hpp>

#include <cmath>
#include <limits>

namespace tilt_ropter {

/// Criteria for contact with the ground. The load is the upward external force (lift) minus the
/// lift that the air gives.
struct ContactEstimatorSettings {
  /// Load that counts as contact when the vehicle is within leave_height of the expected ground, as
  /// a fraction of the weight.
  double near_load = 0.10;
  /// Load that counts as contact at any other height, as a fraction of the weight. It must exceed
  /// the load of gusts.
  double far_load = 0.30;
  /// Load that only the ground can give, as a fraction of the weight. Above this load the vehicle
  /// counts as carried. The value must exceed the error of the believed weight.
  double carried_load = 0.40;
  /// A vehicle that is not carried counts as in the air above this distance from the ground [m].
  double leave_height = 0.030;
  /// Lead of the take-off detection [s]. It acts after the vehicle has not been carried for
  /// unloaded_time, as in a take-off but not in a hop over a plank. The vehicle then counts as in
  /// the air if its speed will take it to leave_height within leave_lead.
  double leave_lead = 0.1;
  double unloaded_time = 0.3;  ///< time without load before leave_lead acts [s]
  /// Depth below the last ground at which the ground is forgotten [m]. A vehicle in the air reaches
  /// this depth behind the edge of a table, for example. Up to this depth the ground is kept,
  /// because its height may only be overestimated.
  double search_depth = 0.25;
  double load_time = 0.01;  ///< time constant of the load's average [s]
  /// Time constant of the average of the wrench in the air, which is kept on the ground [s].
  double air_time = 0.5;
  double ground_time = 0.1;  ///< time constant of the average of the ground's height [s]
  double slope_time = 0.4;   ///< time constant of the average of the ground's slope [s]
  double max_slope = 0.5;    ///< largest slope of the ground; a steeper estimate is ignored
  /// Expected ground until the vehicle has stood on the ground or flown below this plane. Height
  /// -infinity: no ground is expected.
  GroundPlane assumed_ground;
};

inline void validate(const ContactEstimatorSettings& s) {
  require_positive("ContactEstimatorSettings.near_load", s.near_load);
  require(std::isfinite(s.far_load) && s.far_load >= s.near_load,
          "ContactEstimatorSettings.far_load", s.far_load, "finite and >= near_load");
  require_positive("ContactEstimatorSettings.carried_load", s.carried_load);
  require_positive("ContactEstimatorSettings.leave_height [m]", s.leave_height);
  require_non_negative("ContactEstimatorSettings.leave_lead [s]", s.leave_lead);
  require_non_negative("ContactEstimatorSettings.unloaded_time [s]", s.unloaded_time);
  require_positive("ContactEstimatorSettings.search_depth [m]", s.search_depth);
  require_positive("ContactEstimatorSettings.load_time [s]", s.load_time);
  require_positive("ContactEstimatorSettings.air_time [s]", s.air_time);
  require_positive("ContactEstimatorSettings.ground_time [s]", s.ground_time);
  require_positive("ContactEstimatorSettings.slope_time [s]", s.slope_time);
  require_positive("ContactEstimatorSettings.max_slope", s.max_slope);
  require(s.assumed_ground.height < std::numeric_limits<double>::infinity(),
          "ContactEstimatorSettings.assumed_ground.height [m]", s.assumed_ground.height,
          "finite, or -infinity");
}

}  // namespace tilt_ropter
