#pragma once

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/actuator_model.hpp>
#include <tilt_ropter/model/allocation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cstddef>

/// The loop on board, composed from the library's pieces as the paper's control diagram has them:
/// servo model and rotor speeds -> applied wrench -> observer -> NMPC -> allocation.
namespace examples {

class FlightController {
 public:
  explicit FlightController(const tilt_ropter::Vehicle<4>& vehicle,
                            const tilt_ropter::NmpcSettings& settings = {})
      : allocation_(vehicle),
        actuators_(vehicle),
        observer_(vehicle.body),
        nmpc_(vehicle, settings) {}

  /// Speeds reported by the motor controllers [rad/s].
  void on_rotor_speeds(const Eigen::Vector4d& speeds) { rotor_speeds_ = speeds; }

  /// A sample of the IMU, at any rate: angular velocity [rad/s] and specific force [m/s^2].
  void on_imu(double time, const Eigen::Vector3d& angular_velocity,
              const Eigen::Vector3d& specific_force) {
    applied_ = {rotor_speeds_, actuators_.update(time, command_).tilt_angle};
    observer_.update(time, specific_force, angular_velocity, allocation_.wrench(applied_));
  }

  /// Before the state of `time` is measured.
  template <typename Reference>
  void prepare(double time, const Reference& reference) {
    if (nmpc_.prepare(time, reference, observer_.external()))
      observer_.set_external(nmpc_.contact().air_wrench());
  }

  /// The state of `time`: returns rotor speeds and tilt angles to command.
  const tilt_ropter::ActuatorState<4>& on_state(double time,
                                                const tilt_ropter::BodyState<>& state) {
    result_ = nmpc_.feedback(time, state);
    command_ = allocation_.allocate(result_.wrench, result_.rate, command_).command;
    return command_;
  }

  [[nodiscard]] const tilt_ropter::ActuatorState<4>& command() const { return command_; }
  /// Measured speeds and modelled tilt angles.
  [[nodiscard]] const tilt_ropter::ActuatorState<4>& applied() const { return applied_; }
  [[nodiscard]] const tilt_ropter::NmpcResult& result() const { return result_; }
  [[nodiscard]] const tilt_ropter::Wrench<>& external() const { return observer_.external(); }
  [[nodiscard]] const tilt_ropter::Nmpc<4>& nmpc() const { return nmpc_; }

 private:
  tilt_ropter::Allocation<4> allocation_;
  tilt_ropter::ActuatorModel<4> actuators_;
  tilt_ropter::WrenchObserver<> observer_;
  tilt_ropter::Nmpc<4> nmpc_;
  tilt_ropter::NmpcResult result_;
  tilt_ropter::ActuatorState<4> command_, applied_;
  Eigen::Vector4d rotor_speeds_ = Eigen::Vector4d::Zero();
};

}  // namespace examples
