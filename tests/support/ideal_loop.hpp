#pragma once

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include "support/hovering.hpp"
#include "support/simulated_time.hpp"

#include <Eigen/Core>

#include <limits>

namespace test_support {

/// Closed loop of the controller with a rigid body. The body receives exactly the planned wrench
/// and an unknown force.
class IdealLoop {
 public:
  explicit IdealLoop(const tilt_ropter::NmpcSettings& settings = {})
      : nmpc(tilt_ropter::tilt_ropter_vehicle(), in_simulated_time(settings)) {
    state.body = hovering();
  }

  /// One tick of 10 ms. `estimate` is the external wrench that the controller is given. If `blind`,
  /// the measured velocity is not finite.
  template <typename Reference>
  const tilt_ropter::NmpcResult& tick(const Reference& reference,
                                      const tilt_ropter::Wrenchd& estimate = {},
                                      bool blind = false) {
    (void)nmpc.prepare(time, reference, tilt_ropter::in_the_air(estimate));
    tilt_ropter::BodyStated measured = state.body;
    if (blind) measured.velocity.x() = std::numeric_limits<double>::quiet_NaN();
    const tilt_ropter::NmpcResult& result = nmpc.feedback(time, measured);
    state.wrench = result.wrench;
    Eigen::Matrix<double, 6, 1> rate;
    rate << result.rate.force, result.rate.torque;
    state = plant.step(state, rate, unknown, 0.01);
    time += 0.01;
    return result;
  }

  tilt_ropter::RigidBodyd plant{tilt_ropter::tilt_ropter_vehicle().body};
  tilt_ropter::Nmpc<4> nmpc;
  tilt_ropter::Stated state;
  tilt_ropter::Wrenchd unknown;
  double time = 0.0;
};

}  // namespace test_support
