#pragma once

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <optional>

namespace test_support {

inline void place(tilt_ropter::Plant<4>& plant, const tilt_ropter::BodyState<>& body,
                  const tilt_ropter::ActuatorState<4>& actuators) {
  tilt_ropter::PlantState<4> x = plant.state();
  x.body = body;
  x.actuators = actuators;
  plant.reset(x);
}

/// The reference vehicle on a plant of any kind (with a place() of its own) under observer, NMPC
/// and allocation at 100 Hz, on noisy states.
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

  /// Hovers with `clearance` [m] under the wheels, at `velocity` [m/s].
  void start(double clearance, const Eigen::Vector3d& velocity, double yaw) {
    tilt_ropter::BodyState<> body;
    body.position.z() = vehicle_.wheels->radius + clearance;
    body.velocity = velocity;
    body.orientation = tilt_ropter::quaternion_from_yaw(yaw);
    tilt_ropter::Wrench<> hover;
    hover.force.z() = weight();
    sent_ = allocation_.allocate(hover, sent_.command);
    place(plant_, body, sent_.command);
    actuators_.reset(sent_.command, 0.0);
  }

  /// From now on the plant is `truth`, in the state in which it is; a rotor that tilts no more is
  /// at once where `truth` holds it. Nobody is told.
  void fail(const tilt_ropter::Vehicle<4>& truth) {
    const tilt_ropter::PlantState<4> state = plant_.state();
    plant_ = PlantType(truth);
    plant_.reset(state);
  }

  /// From now on all that is on board takes the vehicle for `believed`, whose mass is the same.
  /// What the observer took for a disturbance since the failure was the failure.
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

  /// Flies for `duration` [s]; every solve must succeed.
  template <typename Reference>
  void run(double duration, const Reference& reference) {
    const double end = plant_.time() + duration;
    while (plant_.time() < end - 1e-6) {
      ASSERT_TRUE(has_plan(tick(reference).status));
      ASSERT_TRUE(plant_is_sound_);
    }
  }

  /// One period of 10 ms in which what reaches the controller may be tampered with: `tamper` gets
  /// the external wrench and the measured state. A state of nullopt is one that there is not.
  template <typename Reference, typename Tamper>
  const tilt_ropter::NmpcResult& tick(const Reference& reference, const Tamper& tamper) {
    using namespace tilt_ropter;
    const double time = plant_.time();
    const ActuatorState<4> applied{plant_.actuators().rotor_speed,
                                   actuators_.update(time, sent_.command).tilt_angle};
    observer_.update(time, plant_.inertial_sample(), allocation_.wrench(applied));
    std::optional<BodyState<>> measured = state_sensor_.sample(time, plant_.body())->body;
    ContactEstimate contact = contact_.update(time, *measured, observer_);
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
  [[nodiscard]] double peak_force() const { return peak_force_; }  ///< of the ground [N]
  [[nodiscard]] bool touched() const { return touched_; }
  [[nodiscard]] double highest() const { return highest_; }  ///< after the first touch [m]

  tilt_ropter::Wrench<> disturbance;  ///< on the plant, in the body frame

 private:
  tilt_ropter::Vehicle<4> vehicle_;
  PlantType plant_;
  tilt_ropter::StateSensor state_sensor_;
  tilt_ropter::Allocation<4> allocation_;
  tilt_ropter::ActuatorModel<4> actuators_;
  tilt_ropter::WrenchObserver<> observer_;
  tilt_ropter::ContactEstimator contact_;
  tilt_ropter::Nmpc<4> nmpc_;
  tilt_ropter::AllocationResult<4> sent_;
  double peak_force_ = 0.0, highest_ = -1.0;
  bool touched_ = false, plant_is_sound_ = true;
};

}  // namespace test_support
