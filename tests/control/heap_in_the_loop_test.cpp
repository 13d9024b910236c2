// After construction and a few ticks no function of the control loop uses the heap, except NLopt.
// NLopt's heap use stays within the bounds in DualSolver's documentation.
// CTest: alone

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include "support/allocation_counter.hpp"
#include "support/check_table.hpp"
#include "support/loop_watch.hpp"
#include "support/random.hpp"
#include "support/simulated_time.hpp"
#include "support/state_sensor.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>
#include <nlopt.h>

#include <Eigen/Core>

#include <cmath>
#include <cstddef>
#include <limits>
#include <set>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace heap_in_the_loop_test {

using test_support::expect_nlopt_within_documented_bounds;
using test_support::heap_use;
using test_support::HeapInTheLoop;
using test_support::HeapUse;
using test_support::HeapUser;
using test_support::LoopWatch;
using test_support::NloptInTicks;
using test_support::Random;
using test_support::StateSensor;
using test_support::StateSensorParameters;
using test_support::ticks;
using test_support::warm_up;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

// Compilers may remove an allocation if its address is not used. Storing the address here prevents
// this.
const void* volatile seen = nullptr;

TEST_F(HeapInTheLoop, CountsHeapUseOfTheLoop) {
  for (int i = 0; i <= warm_up; ++i) watch.next_tick();
  LoopWatch deliberate = watch;
  const std::vector<double> vector =
      deliberate("vector", [] { return std::vector<double>(static_cast<std::size_t>(ticks())); });
  seen = vector.data();
  Eigen::VectorXd eigen(3);
  seen = eigen.data();
  deliberate("Eigen", [&] { eigen = Eigen::VectorXd::Random(5); });
  seen = eigen.data();
  std::vector<double> small(3);
  seen = small.data();
  deliberate("release", [&] { std::vector<double>().swap(small); });
  const std::string bytes = std::to_string(8 * ticks());
  EXPECT_NE(deliberate.notes().find("vector: 1 allocations (" + bytes + " bytes), 0 releases"),
            std::string::npos)
      << deliberate.notes();
  // If malloc's alignment is too small for vector instructions, Eigen adds bytes for alignment.
  const int aligning = EIGEN_MALLOC_ALREADY_ALIGNED ? 0 : EIGEN_DEFAULT_ALIGN_BYTES;
  EXPECT_NE(deliberate.notes().find("Eigen: 1 allocations (" + std::to_string(40 + aligning) +
                                    " bytes), 1 releases"),
            std::string::npos)
      << deliberate.notes();
  EXPECT_NE(deliberate.notes().find("release: 0 allocations (0 bytes), 1 releases"),
            std::string::npos)
      << deliberate.notes();
}

double allocating_objective(unsigned, const double* x, double*, void*) {
  const std::vector<double> memory(7, x[0]);
  seen = memory.data();
  return memory.back();
}

TEST_F(HeapInTheLoop, CountsNloptApartFromItsCallbacks) {
  double x = 1.0, value = 0.0;
  const HeapUse nlopt = heap_use(HeapUser::nlopt), other = heap_use(HeapUser::other);
  nlopt_opt optimizer = nlopt_create(NLOPT_LN_NELDERMEAD, 1U);
  nlopt_set_min_objective(optimizer, allocating_objective, nullptr);
  nlopt_set_maxeval(optimizer, 3);
  nlopt_optimize(optimizer, &x, &value);
  nlopt_destroy(optimizer);
  const HeapUse by_nlopt = heap_use(HeapUser::nlopt) - nlopt;
  const HeapUse by_objective = heap_use(HeapUser::other) - other;
  EXPECT_GT(by_nlopt.allocations, 0);
  EXPECT_EQ(by_nlopt.allocations, by_nlopt.releases);
  EXPECT_EQ(by_objective.allocations, 3);
  EXPECT_EQ(by_objective.bytes, 3 * 7 * 8);
}

// All onboard functions and the plant with its sensors, in repeated flights from the ground into
// the air and back. State measurements, references, voltages and IMU samples fail now and then.
TEST_F(HeapInTheLoop, WholeLoopInAirAndOnGround) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.servo.dead_time = 0.015;
  vehicle.battery.nominal_voltage = 20.0;
  Allocation allocation(vehicle);
  OutputScaling scaling(vehicle);
  const PowerModel power(vehicle);
  Battery battery(vehicle.battery);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserverd observer(vehicle.body);
  ContactEstimator contact(vehicle);
  FailureDetector<4> detector(vehicle);
  NmpcSettings settings = test_support::in_simulated_time();
  settings.problem.bounds.force_rate << 3.0, 3.0, 10.0;  // makes constraints active
  Nmpc nmpc(vehicle, settings);
  Plant<4> plant(vehicle);
  StateSensorParameters delayed;
  delayed.delay = 0.01;
  StateSensor state_sensor(delayed, 1);
  PoseSensor pose_sensor({}, 2);
  ImuSensor imu({}, 3);
  RotorSpeedSensor<4> rotor_sensor({}, 4);

  const double radius = vehicle.wheels->radius;
  FigureEightSettings eight;
  eight.center.z() = radius;
  eight.amplitude << 0.4, 0.15, 0.0;
  eight.laps = 1;
  eight.heading = HeadingMode::along_velocity;
  const FigureEight on_wheels(eight);
  const ReferencePoint start = on_wheels(0.0);
  Waypoint below, above;
  below.position = above.position = start.position;
  above.position.z() = 0.4;
  below.yaw = above.yaw = yaw_of(start.orientation);
  const Mission mission({{MissionPhase::rest, Hold(below, 0.3)},
                         {MissionPhase::take_off, take_off(below, 0.4)},
                         {MissionPhase::hover, Hold(above, 0.3)},
                         {MissionPhase::landing, landing(above, radius)},
                         {MissionPhase::rest, Hold(below, 0.3)},
                         {MissionPhase::ground, on_wheels}});
  int fault = 0;  // 1: bad measurement, 2: bad reference and voltage, 3: bad IMU sample
  const auto reference = [&](double time) {
    ReferencePoint point = mission(std::fmod(time, mission.end_time()));
    if (fault == 2) point.position.x() = nan;
    return point;
  };

  AllocationResult<4> sent;
  BodyStated measured = plant.body();
  Eigen::Vector4d speeds = Eigen::Vector4d::Zero();
  NloptInTicks nlopt;
  std::set<NmpcStatus> reached;
  double energy = 0.0;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    const double time = plant.time();
    fault = i % 60 == 30 ? 1 : i % 60 == 45 ? 2 : i % 60 == 50 ? 3 : i % 400 > 370 ? 1 : 0;
    if (const auto m =
            watch("StateSensor", [&] { return state_sensor.sample(time, plant.body()); }))
      measured = m->body;
    (void)watch("PoseSensor", [&] { return pose_sensor.sample(time, plant.body()); });
    if (const auto m = watch("RotorSpeedSensor", [&] {
          return rotor_sensor.sample(time, plant.actuators().rotor_speed);
        }))
      speeds = m->rotor_speed;
    const ActuatorState<4> applied{speeds, watch("ActuatorModel", [&] {
                                     return actuators.update(time, sent.command).tilt_angle;
                                   })};
    if (auto m = watch("ImuSensor", [&] {
          return imu.sample(time, plant.body().angular_velocity, plant.specific_force());
        })) {
      if (fault == 3) m->specific_force.y() = nan;
      const Wrenchd wrench =
          watch("Allocation::wrench", [&] { return allocation.wrench(applied); });
      (void)watch("WrenchObserver", [&] { return observer.update(time, *m, wrench).status; });
      (void)watch("FailureDetector", [&] {
        return detector.update(time, *m, applied, actuators.state().rotor_speed, i % 300 != 0).kind;
      });
    }
    if (i % 25 == 0) {
      settings.ground.down_force = i % 2 == 0 ? 0.75 : 1.0;
      settings.problem.weights.position.x() = i % 2 == 0 ? 60.0 : 80.0;
      watch("Nmpc::set_settings", [&] { nmpc.set_settings(settings); });
    }
    const double voltage = fault == 2 ? nan : 20.0 - 0.001 * time;
    for (const bool taken :
         {watch("Allocation::set_voltage", [&] { return allocation.set_voltage(voltage); }),
          watch("ActuatorModel::set_voltage", [&] { return actuators.set_voltage(voltage); }),
          watch("OutputScaling::set_voltage", [&] { return scaling.set_voltage(voltage); }),
          watch("Nmpc::set_voltage", [&] { return nmpc.set_voltage(voltage); }),
          watch("Plant::set_voltage", [&] { return plant.set_voltage(voltage); })})
      EXPECT_EQ(taken, fault != 2);
    nlopt([&] {
      watch("ContactEstimator", [&] { contact.update(time, measured, observer.observed()); });
      watch("Nmpc::prepare", [&] { return nmpc.prepare(time, reference, contact.estimate()); });
      BodyStated delivered = measured;
      if (fault == 1) delivered.velocity.x() = nan;
      const NmpcResult& result = watch(
          "Nmpc::feedback", [&]() -> const NmpcResult& { return nmpc.feedback(time, delivered); });
      reached.insert(result.status);
      sent = watch("Allocation::allocate",
                   [&] { return allocation.allocate(time, result.wrench, result.rate, sent); });
    });
    watch("Plant::step", [&] { return plant.step(sent.command, {}, 0.01); });
    energy += watch("PowerModel", [&] { return power.power(plant.actuators().rotor_speed); });
    (void)watch("Battery", [&] { return battery.update(time, fault == 2 ? nan : energy); });
    (void)watch("Battery::load", [&] { return battery.load(energy); });
    (void)watch("Battery::endurance", [&] { return battery.endurance(energy); });
  }
  EXPECT_GE(reached.size(), 4U);  // includes approximate, at touch-down
  EXPECT_GE(contact.mode_changes(), 2);
  EXPECT_GT(energy, 0.0);
  // Measured: 29 calls and 256 kB, both in a cold start.
  EXPECT_GT(nlopt.calls, 0);
  test_support::check_at_most(1, "NLopt: calls in a tick, at worst",
                              static_cast<double>(nlopt.calls), 60);
  test_support::check_at_most(1, "NLopt: bytes in a tick, at worst",
                              static_cast<double>(nlopt.bytes), 500000);
  expect_nlopt_within_documented_bounds();
}

// Successful and failed calibrations, gaps in time, bad samples and limits.
TEST_F(HeapInTheLoop, ObserverWithCalibrationAndLimits) {
  WrenchObserverSettings settings;
  settings.force_limit.setConstant(1.0);
  WrenchObserverd observer(tilt_ropter_vehicle().body, settings);
  Random random(85);
  std::set<ObserverStatus> reached;
  std::set<CalibrationStatus> calibrated;
  std::set<WrenchTrust> trusted;
  double time = 0.0;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    time += i % 300 == 0 ? 0.2 : 0.01;
    const bool push = i % 600 > 400;
    Eigen::Vector3d a = random.vector(0.1) + 2.0 * push * Eigen::Vector3d::UnitX();
    if (i % 70 == 0) a.y() = nan;
    trusted.insert(watch("trust", [&] { return observer.trust(time); }));
    reached.insert(watch("update", [&] {
      return observer.update(time, {Eigen::Vector3d::Zero(), a}, {}).status;
    }));
    if (i % 150 == 20) watch("begin_calibration", [&] { observer.begin_calibration(); });
    if (i % 150 == (i < 600 ? 149 : 50))
      calibrated.insert(watch("end_calibration", [&] { return observer.end_calibration(); }));
    if (i % 600 == 599) watch("set_offset", [&] { observer.set_offset({}); });
  }
  EXPECT_GE(reached.size(), 4U);
  EXPECT_GE(calibrated.size(), 3U);
  EXPECT_EQ(trusted.size(), 5U);
}

// Requests within and beyond the limits, for vehicles with and without a null space.
TEST_F(HeapInTheLoop, AllocationWithinAndBeyondLimits) {
  Vehicle<4> narrow = tilt_ropter_vehicle();
  narrow.rotor.min_thrust = 0.3;
  narrow.servo.min_angle = -1.0;
  narrow.servo.max_angle = 1.2;
  const Allocation<4> tilting(tilt_ropter_vehicle()), limited(narrow);
  const Allocation<8> fixed(test_support::omnidirectional_octocopter());
  AllocationResult<4> last, last_limited, inverted;
  AllocationResult<8> last_fixed;
  Random random(85);
  std::set<AllocationStatus> reached;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    const double time = 0.01 * i;
    const double size = std::pow(10.0, random.uniform(-3.0, 2.0));
    Wrenchd wanted{random.vector(size), random.vector(0.1 * size)};
    const Wrenchd rate{random.vector(size), random.vector(size)};
    if (i % 10 == 9) wanted.force.y() = nan;
    watch("allocate", [&] {
      last = tilting.allocate(time, wanted, rate, last);
      last_limited = limited.allocate(time, wanted, rate, last_limited);
      last_fixed = fixed.allocate(time, wanted, rate, last_fixed);
    });
    reached.insert(last.status);
    reached.insert(last_limited.status);
    // A lateral force of alternating sign, across the end of the tilt range.
    const Wrenchd upside_down{{0.0, i % 20 < 10 ? 0.05 : -0.05, -8.0}, Eigen::Vector3d::Zero()};
    watch("allocate", [&] { inverted = tilting.allocate(time, upside_down, {}, inverted); });
    reached.insert(inverted.status);
  }
  EXPECT_EQ(reached.size(), 7U);
}

}  // namespace heap_in_the_loop_test
}  // namespace tilt_ropter
