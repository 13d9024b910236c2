#pragma once

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/compiled.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <Eigen/Core>

#include <functional>

/// The loop on board, composed from the library's pieces as the paper's control diagram has them:
/// IMU and motion capture -> EKF -> state; servo model and rotor speeds -> applied wrench ->
/// observer -> external wrench; both -> contact estimate -> NMPC -> allocation.
namespace examples {

/// Where to be at a time. One that holds its mission by reference costs no allocation.
using Reference = std::function<tilt_ropter::ReferencePoint(double)>;

/// Of 4, 6 or 8 rotors; compiled once, in flight_controller.cpp.
template <int Rotors = 4>
class FlightController {
 public:
  FlightController(
      const tilt_ropter::Vehicle<Rotors>& vehicle, const tilt_ropter::NmpcSettings& settings,
      const tilt_ropter::EkfSettings& estimation,
      const tilt_ropter::WrenchObserverSettings& observer = tilt_ropter::observer_settings(20.0));

  /// For a vehicle that is in the air from the start: what to command until the first state.
  void start_with(const tilt_ropter::ActuatorState<Rotors>& command);

  /// Rotor speeds and tilt angles that push upward with `force` [N] and turn nothing.
  [[nodiscard]] tilt_ropter::ActuatorState<Rotors> lift(double force) const;

  /// Speeds reported by the motor controllers [rad/s].
  void on_rotor_speeds(const Eigen::Matrix<double, Rotors, 1>& speeds) { rotor_speeds_ = speeds; }

  /// A sample of the IMU, at any rate.
  void on_imu(double time, const tilt_ropter::InertialSample<>& sample);

  /// A pose from motion capture, taken at `time`, however late it comes.
  void on_pose(double time, const tilt_ropter::MarkerPose<>& pose);

  /// Before the last measurements of a tick come.
  void prepare(double time, const Reference& reference);

  /// After them: returns rotor speeds and tilt angles to command. Before the first state they stay
  /// as they are; without one later, the last plan goes on as Nmpc::hold says.
  const tilt_ropter::ActuatorState<Rotors>& control(double time);

  /// True from the first state on.
  [[nodiscard]] bool started() const { return started_ || ekf_.running(); }
  [[nodiscard]] const tilt_ropter::ActuatorState<Rotors>& command() const { return sent_.command; }
  /// Measured speeds and modelled tilt angles.
  [[nodiscard]] const tilt_ropter::ActuatorState<Rotors>& applied() const { return applied_; }
  [[nodiscard]] const tilt_ropter::NmpcResult& result() const { return result_; }
  /// Greatest tilt rate of the commanded wrench, of all arms [rad/s].
  [[nodiscard]] double planned_tilt_rate() const;
  [[nodiscard]] const tilt_ropter::Wrench<>& external() const { return observer_.external(); }
  [[nodiscard]] const tilt_ropter::Ekf<>& ekf() const { return ekf_; }
  [[nodiscard]] const tilt_ropter::ContactEstimator& contact() const { return contact_; }
  [[nodiscard]] const tilt_ropter::Nmpc<Rotors>& nmpc() const { return nmpc_; }

 private:
  tilt_ropter::Allocation<Rotors> allocation_;
  tilt_ropter::ActuatorModel<Rotors> actuators_;
  tilt_ropter::Ekf<> ekf_;
  tilt_ropter::WrenchObserver<> observer_;
  tilt_ropter::ContactEstimator contact_;
  tilt_ropter::Nmpc<Rotors> nmpc_;
  tilt_ropter::NmpcResult result_;
  tilt_ropter::AllocationResult<Rotors> sent_;
  tilt_ropter::ActuatorState<Rotors> applied_;
  Eigen::Matrix<double, Rotors, 1> rotor_speeds_ = Eigen::Matrix<double, Rotors, 1>::Zero();
  bool started_ = false;
};

}  // namespace examples
