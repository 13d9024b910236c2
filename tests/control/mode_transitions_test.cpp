// Landings and take-offs that go wrong a little: the controller touches down while it drifts
// sideways and higher than it should be, and is called up from the ground by a reference that is
// higher and drifts, too. TILT_ROPTER_FULL=1 does 200 instead of 20.

#include "support/random.hpp"

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/actuator_model.hpp>
#include <tilt_ropter/model/allocation.hpp>
#include <tilt_ropter/planning/transition.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <string>

namespace tilt_ropter {
namespace {

/// One vehicle with the controller on it.
class Loop {
 public:
  explicit Loop(unsigned seed)
      : vehicle_(tilt_ropter_vehicle()),
        plant_(vehicle_),
        state_sensor_({}, seed),
        allocation_(vehicle_),
        actuators_(vehicle_),
        observer_(vehicle_.body),
        nmpc_(vehicle_) {}

  /// Hovers with `clearance` [m] under the wheels, at `velocity` [m/s].
  void start(double clearance, const Eigen::Vector3d& velocity, double yaw) {
    PlantState<4> x = plant_.state();
    x.body.position.z() = vehicle_.wheels.radius + clearance;
    x.body.velocity = velocity;
    x.body.orientation = quaternion_from_yaw(yaw);
    Wrench<> hover;
    hover.force.z() = vehicle_.body.mass * gravity;
    x.actuators = command_ = allocation_.allocate(hover, command_).command;
    plant_.reset(x);
    actuators_.reset(command_, 0.0);
  }

  template <typename Reference>
  void run(double duration, const Reference& reference) {
    const double end = plant_.time() + duration;
    while (plant_.time() < end - 1e-6) {
      const double time = plant_.time();
      const ActuatorState<4> applied{plant_.actuators().rotor_speed,
                                     actuators_.update(time, command_).tilt_angle};
      observer_.update(time, plant_.specific_force(), plant_.body().angular_velocity,
                       allocation_.wrench(applied));
      if (nmpc_.prepare(time, reference, observer_.external()))
        observer_.set_external(nmpc_.contact().air_wrench());
      const auto measured = state_sensor_.sample(time, plant_.body());
      const NmpcResult& result = nmpc_.feedback(time, measured->body);
      EXPECT_EQ(result.status, NmpcStatus::solved);
      command_ = allocation_.allocate(result.wrench, result.rate, command_).command;
      actuators_.update(time, command_);
      for (int i = 0; i < 20; ++i) {
        ASSERT_TRUE(plant_.step(command_, {}, 5e-4));
        peak_force_ = std::max(peak_force_, plant_.normal_forces().sum());
        touched_ = touched_ || plant_.normal_forces().sum() > 0.0;
        if (touched_)
          highest_ = std::max(highest_, plant_.body().position.z() - vehicle_.wheels.radius);
      }
    }
  }

  [[nodiscard]] const Plant<4>& plant() const { return plant_; }
  [[nodiscard]] const Nmpc<4>& nmpc() const { return nmpc_; }
  [[nodiscard]] double weight() const { return vehicle_.body.mass * gravity; }
  [[nodiscard]] double peak_force() const { return peak_force_; }  ///< of the ground [N]
  [[nodiscard]] bool touched() const { return touched_; }
  [[nodiscard]] double highest() const { return highest_; }  ///< after the first touch [m]

 private:
  Vehicle<4> vehicle_;
  Plant<4> plant_;
  StateSensor state_sensor_;
  Allocation<4> allocation_;
  ActuatorModel<4> actuators_;
  WrenchObserver<> observer_;
  Nmpc<4> nmpc_;
  ActuatorState<4> command_;
  double peak_force_ = 0.0, highest_ = -1.0;
  bool touched_ = false;
};

int cases() {
  return std::getenv("TILT_ROPTER_FULL") != nullptr ? 200 : 20;
}

TEST(ModeTransitions, LandsAndTakesOffWithOneModeChangeEachAndNoBounce) {
  test_support::Random random(14);
  double worst_bounce = 0.0, worst_force = 0.0;
  for (int i = 0; i < cases(); ++i) {
    SCOPED_TRACE(i);
    const double yaw = random.uniform(-pi, pi), drift = random.uniform(-pi, pi);
    const Eigen::Vector3d way(std::cos(drift), std::sin(drift), 0.0);
    const double error = random.uniform(0.03, 0.05), speed = random.uniform(0.0, 1.0);
    Loop loop(static_cast<unsigned>(i));

    // Down: the reference rests on the ground, the vehicle is too high and drifts.
    loop.start(error, speed * way, yaw);
    const double radius = tilt_ropter_vehicle().wheels.radius;
    const auto rest = [&](double) {
      ReferencePoint point;
      point.position << 0.0, 0.0, radius;
      point.orientation = quaternion_from_yaw(yaw);
      return point;
    };
    loop.run(3.0, rest);
    if (HasFatalFailure()) return;
    EXPECT_TRUE(loop.touched());
    EXPECT_TRUE(loop.nmpc().contact().on_ground());
    EXPECT_EQ(loop.nmpc().contact().mode_changes(), 1);
    EXPECT_LT(loop.highest(), 0.05);
    EXPECT_LT(loop.peak_force(), 4.0 * loop.weight());
    worst_bounce = std::max(worst_bounce, loop.highest());
    worst_force = std::max(worst_force, loop.peak_force() / loop.weight());

    // Up: the reference begins too high and drifts from the start.
    const double begin = loop.plant().time();
    const Eigen::Vector3d from = loop.plant().body().position;
    const Transition climb = take_off({Eigen::Vector3d(0.0, 0.0, radius), yaw}, 1.0);
    const auto up = [&](double time) {
      ReferencePoint point = climb(climb.start_time() + time - begin);
      point.position.head<2>() = (from + speed * std::max(0.0, time - begin) * way).head<2>();
      point.velocity += speed * way;
      point.position.z() += error;
      return point;
    };
    loop.run(4.0, up);
    if (HasFatalFailure()) return;
    EXPECT_FALSE(loop.nmpc().contact().on_ground());
    EXPECT_EQ(loop.nmpc().contact().mode_changes(), 2);
    EXPECT_LT(loop.peak_force(), 4.0 * loop.weight());
    EXPECT_LT((loop.plant().body().position - up(begin + 4.0).position).norm(), 0.05);
  }
  RecordProperty("worst_bounce_m", std::to_string(worst_bounce));
  RecordProperty("worst_force_mg", std::to_string(worst_force));
}

}  // namespace
}  // namespace tilt_ropter
