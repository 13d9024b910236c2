#pragma once

#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/LU>

#include <cmath>

namespace test_support {

using tilt_ropter::ActuatedBody;
using tilt_ropter::ActuatorFailure;
using tilt_ropter::ActuatorState;
using tilt_ropter::FailureDetector;
using tilt_ropter::gravity;
using tilt_ropter::tilt_ropter_vehicle;
using tilt_ropter::Vehicle;
using tilt_ropter::Wrenchd;

/// A body whose actuators do what is asked, except the failed one. Nothing but this wrench, a
/// constant disturbance and gravity acts on it.
class FailingBody {
 public:
  FailingBody(const Vehicle<4>& vehicle, double rate)
      : vehicle_(vehicle), rate_(rate), truth_(vehicle) {}

  /// Hover with small motions of all speeds and angles, as a controller commands them.
  void run(FailureDetector<4>& detector, double duration, bool airborne = true) {
    for (const double end = time_ + duration; time_ < end; time_ += 1.0 / rate_) {
      ActuatorState<4> believed;
      for (int i = 0; i < 4; ++i) {
        believed.rotor_speed(i) =
            speed_from_thrust(thrust_factor(i) * (0.25 + 0.02 * std::sin(7.0 * time_ + i)) *
                                  vehicle_.body.mass * gravity,
                              vehicle_.rotor);
        believed.tilt_angle(i) =
            0.1 * std::sin(5.0 * time_ + 2.0 * i) + 0.05 * std::sin(13.0 * time_ + i);
      }
      ActuatorState<4> telemetry = believed;
      for (int i = 0; i < 4; ++i) telemetry.rotor_speed(i) *= speed_factor(i);
      ActuatorState<4> real = telemetry;
      if (slowness > 1.0) {
        const double lag = vehicle_.servo.time_constant;
        for (int i = 0; i < 4; ++i) {
          const double command =
              believed.tilt_angle(i) +
              lag * (0.5 * std::cos(5.0 * time_ + 2.0 * i) + 0.65 * std::cos(13.0 * time_ + i));
          angle_(i) += (command - angle_(i)) / (slowness * lag * rate_);
        }
        real.tilt_angle = angle_;
      }
      Wrenchd wrench = truth_.wrench(real);
      wrench.force *= gain;
      wrench.force += disturbance.force;
      wrench.torque += disturbance.torque;
      for (int n = 0; n < 20; ++n) {
        const Eigen::Vector3d& w = rate_of_turn_;
        rate_of_turn_ += vehicle_.body.inertia.inverse() *
                         (wrench.torque - w.cross(vehicle_.body.inertia * w)) / (20.0 * rate_);
      }
      detector.update(time_, {rate_of_turn_, wrench.force / vehicle_.body.mass}, telemetry,
                      believed.rotor_speed, airborne, touches);
    }
  }

  void fail(const ActuatorFailure& failure, const ActuatorFailure& also = {}) {
    truth_ = ActuatedBody<4>(with_failure(with_failure(vehicle_, failure), also));
    failed_at_ = time_;
  }
  [[nodiscard]] double since_failure(double time) const { return time - failed_at_; }

  Wrenchd disturbance;
  double slowness = 1.0;  ///< true / believed time constant of the servos
  bool touches = false;   ///< what the detector is told of an obstacle
  double gain = 1.0;      ///< true / believed force
  Eigen::Vector4d speed_factor = Eigen::Vector4d::Ones();   ///< measured / commanded speed
  Eigen::Vector4d thrust_factor = Eigen::Vector4d::Ones();  ///< commanded / hover thrust

 private:
  Vehicle<4> vehicle_;
  double rate_, time_ = 10.0, failed_at_ = 0.0;
  ActuatedBody<4> truth_;
  Eigen::Vector3d rate_of_turn_ = Eigen::Vector3d::Zero();
  Eigen::Vector4d angle_ = Eigen::Vector4d::Zero();  // of slow servos [rad]
};

/// The detector of the reference vehicle and such a body.
struct FailingFlight {
  FailureDetector<4> detector{tilt_ropter_vehicle()};
  FailingBody body{tilt_ropter_vehicle(), 100.0};
};

}  // namespace test_support
