#pragma once

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/simulated_time.hpp"
#include "support/state_sensor.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <optional>

namespace test_support {

inline void place(tilt_ropter::Plant<4>& plant, const tilt_ropter::BodyStated& body,
                  const tilt_ropter::ActuatorState<4>& actuators) {
  tilt_ropter::PlantState<4> x = plant.state();
  x.body = body;
  x.actuators = actuators;
  plant.reset(x);
}

/// Closed loop at 100 Hz with noisy states: the reference vehicle, a plant of any type, observer,
/// NMPC and allocation. The plant type needs its own place() function.
template <typename PlantType>
class ControlLoop {
 public:
  explicit ControlLoop(unsigned seed, const tilt_ropter::NmpcSettings& settings = {})
      : vehicle_(tilt_ropter::tilt_ropter_vehicle()),
        plant_(vehicle_),
        state_sensor_({}, seed),
        allocation_(vehicle_),
        actuators_(vehicle_),
        observer_(vehicle_.body),
        contact_(vehicle_),
        nmpc_(vehicle_, in_simulated_time(settings)) {}

  /// Starts at hover with `clearance` [m] under the wheels, `velocity` [m/s] and `yaw` [rad].
  void start(double clearance, const Eigen::Vector3d& velocity, double yaw) {
    tilt_ropter::BodyStated body;
    body.position.z() = vehicle_.wheels->radius + clearance;
    body.velocity = velocity;
    body.orientation = tilt_ropter::quaternion_from_yaw(yaw);
    tilt_ropter::Wrenchd hover;
    hover.force.z() = weight();
    sent_ = allocation_.allocate(hover, sent_.command);
    place(plant_, body, sent_.command);
    actuators_.reset(sent_.command, 0.0);
  }

  void set_wall(const std::optional<tilt_ropter::Wall>& wall) { plant_.set_wall(wall); }

  /// Puts the plant into this state, with its actuators as they are. The controller is not
  /// informed.
  void put(const tilt_ropter::BodyStated& body) {
    place(plant_, body, plant_.actuators());
    observer_.reset();
  }

  /// Replaces the plant by `truth` in the current state of the plant. A rotor that no longer tilts
  /// is immediately at the angle at which `truth` holds it. The controller is not informed.
  void fail(const tilt_ropter::Vehicle<4>& truth) {
    const tilt_ropter::PlantState<4> state = plant_.state();
    plant_ = PlantType(truth);
    plant_.reset(state);
  }

  /// Informs observer, controller, allocation and actuator model: they now use the vehicle
  /// `believed`, which has the same mass. The observer is reset, because the disturbance that it
  /// estimated since the failure was the failure itself.
  void tell(const tilt_ropter::Vehicle<4>& believed) {
    const double time = plant_.time();
    tilt_ropter::ActuatorState<4> now{sent_.command.rotor_speed, actuators_.state().tilt_angle};
    actuators_ = tilt_ropter::ActuatorModel<4>(believed);
    actuators_.reset(now, time);
    allocation_ = tilt_ropter::Allocation<4>(believed);
    nmpc_ = tilt_ropter::Nmpc<4>(believed, nmpc_.settings());
    observer_.reset();
    contact_ = tilt_ropter::ContactEstimator(believed);
  }

  /// Flies for `duration` [s]. Every solve must succeed.
  template <typename Reference>
  void run(double duration, const Reference& reference) {
    const double end = plant_.time() + duration;
    while (plant_.time() < end - 1e-6) {
      ASSERT_TRUE(has_plan(tick(reference).status));
      ASSERT_TRUE(plant_is_sound_);
    }
  }

  /// One period of 10 ms. `tamper` may change the inputs of the controller: the external wrench and
  /// the measured state. The state nullopt means that there is no measurement.
  template <typename Reference, typename Tamper>
  const tilt_ropter::NmpcResult& tick(const Reference& reference, const Tamper& tamper) {
    using namespace tilt_ropter;
    const double time = plant_.time();
    const ActuatorState<4> applied{plant_.actuators().rotor_speed,
                                   actuators_.update(time, sent_.command).tilt_angle};
    (void)observer_.update(time, plant_.inertial_sample(), allocation_.wrench(applied));
    std::optional<BodyStated> measured = state_sensor_.sample(time, plant_.body())->body;
    ContactEstimate contact =
        contact_.update(time, *measured, observer_.observed(), reference(time));
    tamper(contact.disturbance, measured);
    (void)nmpc_.prepare(time, reference, contact);
    const NmpcResult& result = measured ? nmpc_.feedback(time, *measured) : nmpc_.hold(time);
    sent_ = allocation_.allocate(time, result.wrench, result.rate, sent_);
    actuators_.update(time, sent_.command);
    for (int i = 0; i < 20; ++i) {
      plant_is_sound_ = plant_.step(sent_.command, disturbance, 5e-4) && plant_is_sound_;
      peak_force_ = std::max(peak_force_, plant_.normal_forces().sum());
      touched_ = touched_ || plant_.normal_forces().sum() > 0.0;
      if (touched_)
        highest_ = std::max(highest_, plant_.body().position.z() - vehicle_.wheels->radius);
    }
    return result;
  }
  template <typename Reference>
  const tilt_ropter::NmpcResult& tick(const Reference& reference) {
    return tick(reference, [](const auto&...) {});
  }

  [[nodiscard]] const PlantType& plant() const { return plant_; }
  [[nodiscard]] const tilt_ropter::Nmpc<4>& nmpc() const { return nmpc_; }
  [[nodiscard]] const tilt_ropter::ContactEstimator& contact() const { return contact_; }
  [[nodiscard]] const tilt_ropter::ActuatorState<4>& command() const { return sent_.command; }
  [[nodiscard]] double weight() const { return vehicle_.body.mass * tilt_ropter::gravity; }
  [[nodiscard]] double peak_force() const { return peak_force_; }  ///< peak force of the ground [N]
  [[nodiscard]] bool touched() const { return touched_; }
  /// Largest clearance after the first contact [m].
  [[nodiscard]] double highest() const { return highest_; }

  tilt_ropter::Wrenchd disturbance;  ///< acts on the plant, body frame [N; N m]

 private:
  tilt_ropter::Vehicle<4> vehicle_;
  PlantType plant_;
  StateSensor state_sensor_;
  tilt_ropter::Allocation<4> allocation_;
  tilt_ropter::ActuatorModel<4> actuators_;
  tilt_ropter::WrenchObserverd observer_;
  tilt_ropter::ContactEstimator contact_;
  tilt_ropter::Nmpc<4> nmpc_;
  tilt_ropter::AllocationResult<4> sent_;
  double peak_force_ = 0.0, highest_ = -1.0;
  bool touched_ = false, plant_is_sound_ = true;
};

}  // namespace test_support
