// The loop of the missions with sensors that lie (tests/README.md, check 25): the vehicle stays
// near its reference where the IMU is good, and lands where the position is lost.
// CTest: flight

#include "../../examples/support/fault_option.hpp"
#include "../../examples/support/flight_controller.hpp"
#include "../../examples/support/mission_sensors.hpp"
#include "../../examples/support/vehicle_choice.hpp"

#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

namespace examples {
namespace sensor_faults_test {

using namespace tilt_ropter;

// A level circle of 1.5 m radius at 1.5 m/s, 1.5 m above the ground, from a hover.
ReferencePoint circle(double t) {
  constexpr double radius = 1.5, rate = 1.0, ramp = 3.0;
  const double s = pi / ramp, now = std::clamp(t, 0.0, ramp);
  const double phase = rate * (0.5 * (now - std::sin(s * now) / s) + (t - now));
  const double speed = t < ramp ? rate * 0.5 * (1.0 - std::cos(s * now)) : rate;
  const double change = t < ramp ? rate * 0.5 * s * std::sin(s * now) : 0.0;
  ReferencePoint p;
  p.position << radius * std::sin(phase), radius * (1.0 - std::cos(phase)), 1.5;
  const Eigen::Vector3d along(std::cos(phase), std::sin(phase), 0.0);
  const Eigen::Vector3d inward(-std::sin(phase), std::cos(phase), 0.0);
  p.velocity = radius * speed * along;
  p.acceleration = radius * (change * along + speed * speed * inward);
  return p;
}

struct Outcome {
  double error = 0.0;   // largest distance from the reference while it is followed [m]
  double at_end = 0.0;  // at the end [m]
  double not_good_after = std::numeric_limits<double>::infinity();  // first time [s]
  double touchdown = 0.0, lean = 0.0;                               // of a landing [m/s], [rad]
  FlightMode mode = FlightMode::mission;
  bool rotors_off = false;
  long restarts = 0;
};

// The controller in another clock than that of the plant.
struct OtherClock {
  FlightController<4>& controller;
  double ahead = 0.0;  // of the plant's clock [s]
  void on_imu(double time, const InertialSampled& sample) {
    controller.on_imu(time + ahead, sample);
  }
  void on_pose(double time, const MarkerPosed& pose) { controller.on_pose(time + ahead, pose); }
  void on_rotor_speeds(const Eigen::Vector4d& speeds) { controller.on_rotor_speeds(speeds); }
};

// At 5 s the clock of all sensors and ticks is set forward by `clock_step` [s].
Outcome fly(double duration, const std::string& fault_text,
            const Eigen::Vector3d& lever = Eigen::Vector3d::Zero(), double clock_step = 0.0) {
  Vehicle<4> truth = tilt_ropter_vehicle();
  truth.body.mass *= 1.03;
  truth.body.inertia *= 1.1;
  Plant<4> plant(truth);
  MissionSensors<4> sensors(3);
  ImuSensorParameters imu = MissionSensors<4>::imu_parameters(1000.0);
  imu.position = lever;
  sensors.imu = ImuSensor(imu, 3);
  const SensorFault fault = fault_text.empty() ? SensorFault() : parse_fault(fault_text);
  if (!fault_text.empty()) sensors.add_fault(fault);
  EkfSettings estimation = MissionSensors<4>::estimation();
  estimation.imu_position = lever;
  FlightController<4> controller(tilt_ropter_vehicle(), in_simulated_time(NmpcSettings{}),
                                 estimation);
  ActuatorState<4> command = controller.lift(tilt_ropter_vehicle().body.mass * gravity);
  controller.start_with(command);
  BodyStated start;
  start.position = circle(0.0).position;
  plant.reset(start, command);
  Outcome o;
  bool touched = false;
  OtherClock clock{controller};
  for (int i = 0; i < static_cast<int>(duration * 1000.0); ++i) {
    const double t = plant.time();
    if (i == 5000) clock.ahead = clock_step;
    sensors.sense(plant, clock);
    if (i % 10 == 0 && controller.started()) {
      const double now = t + clock.ahead;
      controller.prepare(now, [&clock](double time) { return circle(time - clock.ahead); });
      command = controller.control(now);
      if (t > fault.start && controller.trust().state != EstimateState::good)
        o.not_good_after = std::min(o.not_good_after, t - fault.start);
    }
    EXPECT_TRUE(plant.step(command, {}, 1e-3));
    const BodyStated& body = plant.body();
    o.mode = controller.mode();
    o.at_end = (body.position - circle(plant.time()).position).norm();
    if (t > 3.0 && o.mode == FlightMode::mission) o.error = std::max(o.error, o.at_end);
    const bool touches = plant.normal_forces().sum() > 0.0;
    if (touches && !touched) o.touchdown = body.velocity.norm();
    touched = touched || touches;
    const double up = (body.orientation * Eigen::Vector3d::UnitZ()).z();
    // After the stop the body tips over its axle, as it does with the rotors off.
    if (t > 3.0 && !touched) o.lean = std::max(o.lean, std::acos(std::min(1.0, up)));
  }
  o.rotors_off = command.rotor_speed.isZero();
  o.restarts = controller.ekf().counts().restarts;
  return o;
}

void expect_near_reference(const std::string& fault, double limit = 0.15) {
  SCOPED_TRACE(fault);
  const Outcome o = fly(14.0, fault);  // the way back takes some seconds
  EXPECT_LT(o.error, limit);
  EXPECT_EQ(o.mode, FlightMode::mission);
  EXPECT_LT(o.at_end, 0.05);
  testing::Test::RecordProperty(fault.substr(0, fault.find(':')), std::to_string(o.error));
  std::printf("%-60s error %.3f m, reported after %.3f s\n", fault.c_str(), o.error,
              o.not_good_after);
}

TEST(SensorFaults, WithoutFaultTheErrorIsSmall) {
  expect_near_reference("", 0.05);
}

TEST(SensorFaults, FrozenPosesAreBridged) {
  expect_near_reference("pose_freeze:start=5,duration=0.3");
  expect_near_reference("pose_freeze:start=5,duration=1");
  expect_near_reference("pose_freeze:start=4.5,duration=2");
}

TEST(SensorFaults, JumpsAreIgnored) {
  expect_near_reference("pose_jump:start=5,duration=0.9,size=0.05");
  expect_near_reference("pose_jump:start=5,duration=0.9,size=0.5");
}

TEST(SensorFaults, GhostsAreIgnored) {
  expect_near_reference("pose_ghost:start=5,duration=1,size=0.5");
}

TEST(SensorFaults, JitterAndClockStepsAreTolerated) {
  expect_near_reference("pose_jitter:start=0,size=0.004");
  expect_near_reference("pose_clock_step:start=5,size=1");
  expect_near_reference("pose_clock_step:start=5,size=-1");
}

// The clock of the computer is corrected in flight, or a simulation begins again.
TEST(SensorFaults, SettingTheClockIsSurvived) {
  for (const double step : {-1000.0, -4.0, -0.5, -0.05, 0.05, 0.5, 1000.0}) {
    SCOPED_TRACE(step);
    const Outcome o = fly(9.0, "", Eigen::Vector3d::Zero(), step);
    std::printf("clock step %g s: error %.3f m\n", step, o.error);
    EXPECT_LT(o.error, 0.15);
    EXPECT_LT(o.at_end, 0.03);
    EXPECT_EQ(o.mode, FlightMode::mission);
  }
}

TEST(SensorFaults, VibrationIsAveraged) {
  for (const char* frequency : {"50", "97", "200"})
    expect_near_reference(std::string("imu_vibration:start=0,size=0.2,frequency=") + frequency);
}

// An IMU that the poses contradict is replaced by the poses and the actuators (BodyByPoses).
TEST(SensorFaults, AWrongImuIsReplacedByThePoses) {
  for (const char* frequency : {"1002", "1006", "1013"})
    for (const char* size : {"0.15", "0.5"})
      expect_near_reference(
          std::string("imu_vibration:start=4,size=") + size + ",frequency=" + frequency, 0.4);
  expect_near_reference("accelerometer_clip:start=4,size=9.3", 0.4);
}

// So quick that the filter follows the poses all the same, so slow that the body follows the IMU.
TEST(SensorFaults, AnImuThatSwingsIsReplacedByThePoses) {
  for (const char* frequency : {"40", "1015", "1040"})
    expect_near_reference(std::string("imu_vibration:start=4,size=0.6,frequency=") + frequency,
                          0.1);
}

// The clock of the IMU alone is set, also by less than the time that the models need to notice.
TEST(SensorFaults, ClockStepsOfTheImuAreSurvived) {
  for (const char* size : {"1", "-1", "0.2", "-0.2", "0.08", "-0.08", "0.04", "-0.04", "-0.02"})
    expect_near_reference(std::string("imu_clock_step:start=5,size=") + size);
  expect_near_reference("imu_clock_step:start=5,size=-1,duration=0.001");  // one wrong stamp
  expect_near_reference("imu_clock_step:start=5,size=1000,duration=0.001");
}

TEST(SensorFaults, SilentImuIsReportedAndSurvived) {
  const Outcome o = fly(9.0, "imu_dropout:start=5,duration=0.3");
  EXPECT_LT(o.not_good_after, 0.1);
  EXPECT_LT(o.error, 0.15);
  EXPECT_LT(o.at_end, 0.05);
  EXPECT_EQ(o.mode, FlightMode::mission);
  std::printf("imu_dropout error %.3f m\n", o.error);
}

TEST(SensorFaults, LeverArmOfTheImuIsKnown) {
  const Outcome o = fly(8.0, "", {0.1, 0.0, 0.0});
  EXPECT_LT(o.error, 0.05);
  std::printf("lever arm error %.3f m\n", o.error);
}

TEST(SensorFaults, LosingAllPositionsEndsInALevelLanding) {
  struct Case {
    const char* fault;
    double clock_step;  // while it sinks [s]
  };
  for (const auto& [fault, clock_step] :
       {Case{"pose_dropout:start=4", 0.0}, Case{"pose_dropout:start=4", -100.0},
        Case{"pose_freeze:start=4", 0.0}}) {
    SCOPED_TRACE(fault);
    const Outcome o = fly(20.0, fault, Eigen::Vector3d::Zero(), clock_step);
    EXPECT_LT(o.not_good_after, 0.15);  // 20 ms of them are the delay of the poses
    EXPECT_EQ(o.mode, FlightMode::stopped);
    EXPECT_TRUE(o.rotors_off);
    EXPECT_LT(o.touchdown, 1.0);
    EXPECT_LT(o.lean, 0.2);
    std::printf("%s, clock step %g s: touch-down %.2f m/s, lean %.1f deg\n", fault, clock_step,
                o.touchdown, o.lean * 180.0 / pi);
  }
}

TEST(SensorFaults, OptionIsParsedAndErrorsNameTheField) {
  const SensorFault f = parse_fault("pose_jump:start=20,duration=2,size=0.1");
  EXPECT_EQ(f.kind, SensorFaultKind::pose_jump);
  EXPECT_EQ(f.start, 20.0);
  EXPECT_EQ(f.duration, 2.0);
  EXPECT_EQ(f.size, 0.1);
  const auto complaint = [](const std::string& text) -> std::string {
    try {
      (void)parse_fault(text);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "";
  };
  EXPECT_NE(complaint("pose_melt:start=2").find("must be one of pose_freeze"), std::string::npos);
  EXPECT_NE(complaint("pose_jump:begin=2").find("unknown field begin"), std::string::npos);
  EXPECT_NE(complaint("pose_jump:size=2m").find("must be a number"), std::string::npos);
  EXPECT_NE(complaint("pose_jitter:size=-1").find("SensorFault.size"), std::string::npos);
}

}  // namespace sensor_faults_test
}  // namespace examples
