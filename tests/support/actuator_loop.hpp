#pragma once

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/state_sensor.hpp"

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <optional>

namespace test_support {

/// Settings for a loop in which time stands still while the controller computes.
inline tilt_ropter::ActuatorNmpcSettings in_simulated_time(
    tilt_ropter::ActuatorNmpcSettings settings) {
  if (settings.time_limit == 0.0) settings.time_limit = std::numeric_limits<double>::infinity();
  return settings;
}

/// Closed loop at 100 Hz with noisy states: any vehicle, plant, observer and ActuatorNmpc.
template <int Rotors>
class ActuatorLoop {
 public:
  ActuatorLoop(const tilt_ropter::Vehicle<Rotors>& truth,
               const tilt_ropter::Vehicle<Rotors>& believed, unsigned seed = 1)
      : ActuatorLoop(truth, believed, tilt_ropter::actuator_nmpc_settings(believed), seed) {}
  ActuatorLoop(const tilt_ropter::Vehicle<Rotors>& truth,
               const tilt_ropter::Vehicle<Rotors>& believed,
               const tilt_ropter::ActuatorNmpcSettings& settings, unsigned seed = 1)
      : plant_(truth),
        state_sensor_({}, seed),
        body_(believed),
        actuators_(believed),
        observer_(believed.body),
        contact_(believed),
        detector_(believed),
        standing_(undercarriage(believed) ? undercarriage(believed)->height : 0.0),
        nmpc_(believed, in_simulated_time(settings)) {}

  /// Starts at rest in hover at `position` [m], with the controller's safe command applied.
  void start(const Eigen::Vector3d& position) {
    command_ = nmpc_.result().command;
    tilt_ropter::PlantState<Rotors> x = plant_.state();
    x.body.position = position;
    x.actuators = command_;
    plant_.reset(x);
    actuators_.reset(command_, 0.0);
  }

  void set_wall(const std::optional<tilt_ropter::Wall>& wall) { plant_.set_wall(wall); }

  /// Replaces the plant by `truth` in the current state.
  void fail(const tilt_ropter::Vehicle<Rotors>& truth) {
    const tilt_ropter::PlantState<Rotors> state = plant_.state();
    plant_ = tilt_ropter::Plant<Rotors>(truth);
    plant_.reset(state);
  }

  /// The loop now uses the vehicle `believed`.
  void tell(const tilt_ropter::Vehicle<Rotors>& believed) {
    const double time = plant_.time();
    const tilt_ropter::ActuatorState<Rotors> now = actuators_.state();
    body_ = tilt_ropter::ActuatedBody<Rotors>(believed);
    actuators_ = tilt_ropter::ActuatorModel<Rotors>(believed);
    actuators_.reset(now, time);
    nmpc_ = tilt_ropter::ActuatorNmpc<Rotors>(believed, nmpc_.settings());
    observer_.reset();
    contact_ = tilt_ropter::ContactEstimator(believed);
    detector_ = tilt_ropter::FailureDetector<Rotors>(believed);
  }

  /// One period of 10 ms. Records the largest and the mean squared distance from the reference.
  template <typename Reference>
  const tilt_ropter::ActuatorNmpcResult<Rotors>& tick(const Reference& reference) {
    using namespace tilt_ropter;
    const double time = plant_.time();
    const ActuatorState<Rotors> modelled = actuators_.update(time, command_);
    const ActuatorState<Rotors> applied{plant_.actuators().rotor_speed, modelled.tilt_angle};
    const InertialSampled sample = plant_.inertial_sample();
    const ObservedWrenchd& observed = observer_.update(time, sample, wrench(applied));
    const BodyStated measured = state_sensor_.sample(time, plant_.body())->body;
    const ContactEstimate& contact = contact_.update(time, measured, observed, reference(time));
    const double clearance =
        measured.position.z() - standing_ - contact.ground.height_at(measured.position);
    detector_.update(time, sample, applied, modelled.rotor_speed,
                     !contact.on_ground && clearance > 0.05);
    const auto start = std::chrono::steady_clock::now();
    (void)nmpc_.prepare(time, reference, contact);
    const auto& result = nmpc_.feedback(time, measured, modelled);
    const std::chrono::duration<double, std::micro> passed =
        std::chrono::steady_clock::now() - start;
    controller_us_ = passed.count();
    command_ = result.command;
    actuators_.update(time, command_);
    for (int i = 0; i < 20; ++i) sound_ = plant_.step(command_, disturbance, 5e-4) && sound_;
    const double error = (plant_.body().position - reference(plant_.time()).position).norm();
    squares_ += error * error;
    largest_ = std::max(largest_, error);
    ++ticks_;
    planned_ += has_plan(result.status);
    solved_ += result.status == NmpcStatus::solved;
    return result;
  }

  /// Flies for `duration` [s].
  template <typename Reference>
  void run(double duration, const Reference& reference) {
    const double end = plant_.time() + duration;
    while (plant_.time() < end - 1e-6) (void)tick(reference);
  }

  /// Forgets the errors so far.
  void restart_statistics() {
    squares_ = largest_ = 0.0;
    ticks_ = planned_ = solved_ = 0;
  }
  [[nodiscard]] double rmse() const { return std::sqrt(squares_ / std::max(ticks_, 1)); }  ///< [m]
  [[nodiscard]] double largest_error() const { return largest_; }                          ///< [m]
  [[nodiscard]] bool all_planned() const { return planned_ == ticks_; }
  [[nodiscard]] int solved() const { return solved_; }
  [[nodiscard]] int ticks() const { return ticks_; }
  [[nodiscard]] bool sound() const { return sound_; }
  /// Time of prepare() and feedback() in the last tick [us].
  [[nodiscard]] double controller_us() const { return controller_us_; }
  [[nodiscard]] const tilt_ropter::Plant<Rotors>& plant() const { return plant_; }
  [[nodiscard]] const tilt_ropter::ActuatorNmpc<Rotors>& nmpc() const { return nmpc_; }
  [[nodiscard]] const tilt_ropter::ContactEstimator& contact() const { return contact_; }
  [[nodiscard]] const tilt_ropter::ActuatorFailure& failure() const { return detector_.failure(); }

  tilt_ropter::Wrenchd disturbance;  ///< acts on the plant, body frame [N; N m]

 private:
  // Wrench that the actuators really apply.
  [[nodiscard]] tilt_ropter::Wrenchd wrench(
      const tilt_ropter::ActuatorState<Rotors>& actuators) const {
    return body_.wrench(actuators);
  }

  tilt_ropter::Plant<Rotors> plant_;
  StateSensor state_sensor_;
  tilt_ropter::ActuatedBody<Rotors> body_;
  tilt_ropter::ActuatorModel<Rotors> actuators_;
  tilt_ropter::WrenchObserverd observer_;
  tilt_ropter::ContactEstimator contact_;
  tilt_ropter::FailureDetector<Rotors> detector_;
  double standing_;  // height of the CoM on the ground [m]
  tilt_ropter::ActuatorNmpc<Rotors> nmpc_;
  tilt_ropter::ActuatorState<Rotors> command_;
  double squares_ = 0.0, largest_ = 0.0, controller_us_ = 0.0;
  int ticks_ = 0, planned_ = 0, solved_ = 0;
  bool sound_ = true;
};

}  // namespace test_support
