#pragma once

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/actuator_model.hpp>
#include <tilt_ropter/model/allocation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cstddef>

/// The loop on board, composed from the library's pieces as the paper's control diagram has them:
/// IMU and motion capture -> EKF -> state; servo model and rotor speeds -> applied wrench ->
/// observer -> external wrench; both -> NMPC -> allocation.
namespace examples {

class FlightController {
 public:
  FlightController(const tilt_ropter::Vehicle<4>& vehicle,
                   const tilt_ropter::NmpcSettings& settings,
                   const tilt_ropter::EkfSettings& estimation)
      : allocation_(vehicle),
        actuators_(vehicle),
        ekf_(estimation),
        observer_(vehicle.body),
        nmpc_(vehicle, settings) {}

  /// Speeds reported by the motor controllers [rad/s].
  void on_rotor_speeds(const Eigen::Vector4d& speeds) { rotor_speeds_ = speeds; }

  /// A sample of the IMU, at any rate.
  void on_imu(double time, const tilt_ropter::InertialSample<>& sample) {
    applied_ = {rotor_speeds_, actuators_.update(time, command_).tilt_angle};
    ekf_.on_imu(time, sample);
    const tilt_ropter::InertialState<>& x = ekf_.filter().state();
    observer_.update(time, sample.specific_force - x.accelerometer_bias,
                     sample.angular_velocity - x.gyro_bias, allocation_.wrench(applied_));
  }

  /// A pose from motion capture, taken at `time`, however late it comes.
  void on_pose(double time, const tilt_ropter::MarkerPose<>& pose) { ekf_.on_pose(time, pose); }

  /// Before the last measurements of a tick come.
  template <typename Reference>
  void prepare(double time, const Reference& reference) {
    if (nmpc_.prepare(time, reference, observer_.external()))
      observer_.set_external(nmpc_.contact().air_wrench());
  }

  /// After them: returns rotor speeds and tilt angles to command. Before the first state they stay
  /// as they are; without one later, the last plan goes on as Nmpc::hold says.
  const tilt_ropter::ActuatorState<4>& control(double time) {
    started_ = started();
    if (!started_) return command_;
    result_ = ekf_.running() ? nmpc_.feedback(time, ekf_.state()) : nmpc_.hold(time);
    command_ = allocation_.allocate(result_.wrench, result_.rate, command_).command;
    actuators_.update(time, command_);  // acts from now on
    return command_;
  }

  /// True from the first state on.
  [[nodiscard]] bool started() const { return started_ || ekf_.running(); }
  [[nodiscard]] const tilt_ropter::ActuatorState<4>& command() const { return command_; }
  /// Measured speeds and modelled tilt angles.
  [[nodiscard]] const tilt_ropter::ActuatorState<4>& applied() const { return applied_; }
  [[nodiscard]] const tilt_ropter::NmpcResult& result() const { return result_; }
  [[nodiscard]] const tilt_ropter::Wrench<>& external() const { return observer_.external(); }
  [[nodiscard]] const tilt_ropter::Ekf<>& ekf() const { return ekf_; }
  [[nodiscard]] const tilt_ropter::Nmpc<4>& nmpc() const { return nmpc_; }

 private:
  tilt_ropter::Allocation<4> allocation_;
  tilt_ropter::ActuatorModel<4> actuators_;
  tilt_ropter::Ekf<> ekf_;
  tilt_ropter::WrenchObserver<> observer_;
  tilt_ropter::Nmpc<4> nmpc_;
  tilt_ropter::NmpcResult result_;
  tilt_ropter::ActuatorState<4> command_, applied_;
  Eigen::Vector4d rotor_speeds_ = Eigen::Vector4d::Zero();
  bool started_ = false;
};

}  // namespace examples
