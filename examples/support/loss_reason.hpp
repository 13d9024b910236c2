#pragma once

#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <sstream>
#include <string>
#include <vector>

namespace examples {

/// Remembers what was wrong in the last second before a vehicle was lost.
class LossReason {
 public:
  /// Call this after each tick of the controller, `period` [s] after the last one, until the loss.
  /// `unexplained`: the estimated external force [N].
  template <int Rotors>
  void on_control(const tilt_ropter::Vehicle<Rotors>& vehicle,
                  const tilt_ropter::ActuatorState<Rotors>& command, bool has_plan,
                  const tilt_ropter::EstimateTrust& trust,
                  const tilt_ropter::ActuatorFailure& failure, const Eigen::Vector3d& unexplained,
                  double period) {
    using namespace tilt_ropter;
    bool at_most = false, at_stop = false;
    for (std::size_t i = 0; i < Rotors; ++i) {
      const auto k = static_cast<Eigen::Index>(i);
      const RotorParameters& rotor = rotor_parameters(vehicle, i);
      at_most =
          at_most || command.rotor_speed(k) > 0.995 * speed_from_thrust(rotor.max_thrust, rotor);
      constexpr double near = 0.01;  // [rad]
      at_stop = at_stop || (vehicle.rotors[i].tilts &&
                            (command.tilt_angle(k) > vehicle.servo.max_angle - near ||
                             command.tilt_angle(k) < vehicle.servo.min_angle + near));
    }
    const auto add = [period](double& fraction, bool now) {
      fraction += std::min(period, 1.0) * ((now ? 1.0 : 0.0) - fraction);
    };
    add(full_, at_most);
    add(stop_, at_stop);
    add(unsolved_, !has_plan);
    add(doubtful_, trust.state != EstimateState::good);
    failure_ = failure;
    force_ += std::min(period, 1.0) * (unexplained - force_);
    weight_ = vehicle.body.mass * gravity;
  }

  /// One sentence. `violations`: bounds that the reference passes.
  [[nodiscard]] std::string sentence(
      const std::vector<tilt_ropter::BoundViolation>& violations) const {
    using tilt_ropter::FailureKind;
    constexpr double often = 0.2;
    std::string reason;
    const auto add = [&reason](const std::string& text) {
      reason += (reason.empty() ? "" : "; ") + text;
    };
    if (failure_.kind != FailureKind::none) {
      std::ostringstream text;
      if (failure_.kind != FailureKind::slow_servos) text << "rotor " << failure_.rotor + 1 << ": ";
      text << to_string(failure_.kind) << ", found at " << failure_.time << " s";
      add(text.str());
    }
    if (force_.norm() > 0.25 * weight_) {
      std::ostringstream text;
      text.precision(3);
      text << force_.norm() << " N that the model does not explain: mass, thrust, wind or contact";
      add(text.str());
    }
    if (doubtful_ > often) add("the estimate was not good: sensors");
    if (stop_ > often) add("tilt angles at the end of the servos' range");
    if (full_ > often) add("rotors at their largest thrust");
    if (unsolved_ > often) add("the controller had no plan");
    if (!violations.empty()) {
      std::ostringstream text;
      text.precision(3);
      const tilt_ropter::BoundViolation& v = violations.front();
      text << "the reference asks for " << v.bound << '[' << v.axis << "] = " << v.required
           << " at " << v.time << " s, allowed is " << v.allowed;
      add(text.str());
    }
    return reason.empty() ? "not known: no failure, no limit, a good estimate" : reason;
  }

 private:
  double full_ = 0.0, stop_ = 0.0, unsolved_ = 0.0, doubtful_ = 0.0;  // fractions of a second
  Eigen::Vector3d force_ = Eigen::Vector3d::Zero();                   // [N]
  double weight_ = 0.0;                                               // [N]
  tilt_ropter::ActuatorFailure failure_;
};

}  // namespace examples
