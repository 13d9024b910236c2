// The PX4 node in flight in simulated time: its messages go directly to a simulated vehicle.
// CTest: dds

#include "../../examples/integrations/px4_node.hpp"
#include "../../examples/integrations/px4_topics.hpp"
#include "support/px4_vehicle.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <stdexcept>
#include <string>

namespace loops {
namespace px4_node_test {

using Eigen::Vector3d;
using tilt_ropter::pi;

constexpr float nan_f = std::numeric_limits<float>::quiet_NaN();

/// A vehicle and the node.
struct Flight {
  explicit Flight(const std::string& hover_z = "1.5", const std::string& mission = "")
      : parameters{
            {"use_sim_time", "true"}, {"origin_height", "0.07"}, {"thrust_model_factor", "0.3"},
            {"hover_x", "0.3"},       {"hover_y", "0.6"},        {"hover_z", hover_z},
            {"hover_yaw", "-0.5"},    {"mission", mission}} {}

  /// PX4 says so now, and repeats it at 2 Hz.
  void say(bool armed, bool offboard) {
    repeat = [this, armed, offboard] { node.on_status(vehicle.status(armed, offboard)); };
    repeat();
  }

  void fly(double seconds) {
    for (int i = 0; i < std::lround(1000.0 * seconds); ++i) {
      vehicle.sense(node);
      ASSERT_TRUE(vehicle.step());
      if (repeat && std::lround(1000.0 * vehicle.plant.time()) % 500 == 0) repeat();
      if (std::lround(1000.0 * vehicle.plant.time()) % 10 != 0) continue;
      const auto out = node.tick(vehicle.now());
      if (out.mode) vehicle.on_mode(*out.mode);
      if (!out.actuators) continue;
      using namespace px4_msgs::msg;
      vehicle.on_motors(px4_controls<ActuatorMotors>(out.actuators->motor, out.now, out.sample));
      servos = px4_controls<ActuatorServos>(out.actuators->servo, out.now, out.sample);
      vehicle.on_servos(servos);
    }
    EXPECT_EQ(vehicle.wrong_modes + vehicle.wrong_outputs, 0);
  }

  test_support::Px4Vehicle vehicle{5000000000LL};
  std::function<void()> repeat;
  px4_msgs::msg::ActuatorServos servos{};
  Parameters parameters;
  Px4Node<4> node{tilt_ropter::tilt_ropter_vehicle(), {}, parameters};
};

TEST(Px4Node, HoversInNedAndFrdAxes) {
  for (const bool velocity_in_body : {false, true}) {
    Flight flight;
    flight.vehicle.velocity_in_body = velocity_in_body;
    flight.say(false, false);
    flight.fly(2.0);
    EXPECT_EQ(flight.vehicle.commands, 0);
    EXPECT_GE(flight.vehicle.heartbeats, 195);  // PX4 requires these for offboard mode
    flight.say(true, true);
    flight.fly(6.0);
    for (int i = 0; i < 20; ++i) {
      flight.fly(0.1);
      const auto& body = flight.vehicle.plant.body();
      EXPECT_LT((body.position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.02);
      EXPECT_NEAR(tilt_ropter::yaw_of(body.orientation), -0.5, 0.02);
    }
    EXPECT_NEAR(flight.vehicle.commands, 800, 2);
    // In hover, the external force is the wind and the weight that the node does not know. The
    // accelerometer bias has been calibrated.
    EXPECT_LT((flight.node.external().force - Vector3d(0.3, 0.6, -0.03 * 1.5 * 9.81)).norm(), 0.1);
    EXPECT_EQ(flight.node.snapshot(0).level, Level::ok);
    EXPECT_STREQ(flight.node.snapshot(0).mode, "offboard");
  }
}

TEST(Px4Node, FliesAMissionThatPushesOnAWall) {
  Flight flight("1.5", "inspect");
  tilt_ropter::Wall wall;
  const tilt_ropter::Mission mission = mission_of(flight.parameters, {}).value();
  for (double time = 0.0; time < 10.0; time += 0.1)
    if (const auto& push = mission(time).push) {
      wall.point = push->surface.point;
      wall.normal = push->surface.normal;
      wall.hull_centre = push->surface.tool;
    }
  flight.vehicle.plant.set_wall(wall);
  flight.say(false, false);
  flight.fly(2.0);
  flight.say(true, true);
  flight.fly(12.0);
  double force = 0.0;
  for (int i = 0; i < 200; ++i) {
    flight.fly(0.01);
    force += flight.vehicle.plant.wall_force() / 200.0;
  }
  EXPECT_NEAR(force, 5.0, 0.15);
}

TEST(Px4Node, SpareChannelsAreNanAndStampsAreThoseOfPx4) {
  Flight flight;
  flight.say(false, true);
  flight.fly(0.1);
  flight.say(true, true);
  flight.fly(0.1);
  const auto& motors = flight.vehicle.last_motors;
  EXPECT_EQ(motors.timestamp, 5200000U);
  EXPECT_EQ(motors.timestamp_sample, 5198000U);
  EXPECT_EQ(flight.servos.timestamp, 5200000U);
  for (std::size_t i = 0; i < 12; ++i) EXPECT_EQ(std::isnan(motors.control[i]), i >= 4);
  for (std::size_t i = 0; i < 15; ++i) EXPECT_EQ(std::isnan(flight.servos.control[i]), i >= 4);
}

TEST(Px4Node, SendsNoCommandsUnlessArmedAndOffboard) {
  Flight flight;
  flight.fly(0.2);  // no status yet
  flight.say(true, false);
  flight.fly(0.2);
  EXPECT_EQ(flight.vehicle.commands, 0);
  flight.say(true, true);
  flight.fly(0.2);
  EXPECT_NEAR(flight.vehicle.commands, 20, 1);
  flight.say(true, false);
  flight.fly(0.2);
  EXPECT_NEAR(flight.vehicle.commands, 20, 1);
}

// Passes the accelerometer's samples on, turned or in another unit.
struct Liar {
  Px4Node<4>& node;
  Eigen::Matrix3f lie;
  void on_odometry(const px4_msgs::msg::VehicleOdometry& m) { node.on_odometry(m); }
  void on_battery(const px4_msgs::msg::BatteryStatus& m) { node.on_battery(m); }
  void on_sensors(px4_msgs::msg::SensorCombined m) {
    Eigen::Map<Eigen::Vector3f> force(m.accelerometer_m_s2);
    force = (lie * force).eval();
    node.on_sensors(m);
  }
};

TEST(Px4Node, DoesNotFlyWithAnAccelerometerThatContradictsTheWeight) {
  const Eigen::Matrix3f unit = Eigen::Matrix3f::Identity();
  const Eigen::Matrix3f flu = Eigen::Vector3f(1.0F, -1.0F, -1.0F).asDiagonal();
  Eigen::Matrix3f exchanged;
  exchanged << 0, 0, 1, 1, 0, 0, 0, 1, 0;
  for (const Eigen::Matrix3f& lie :
       {Eigen::Matrix3f(unit / 9.81F), flu, exchanged, Eigen::Matrix3f(0.0F * unit)}) {
    Flight flight;
    Liar liar{flight.node, lie};
    const auto wait = [&] {
      for (int i = 0; i < 2000; ++i) {
        flight.vehicle.sense(liar);
        ASSERT_TRUE(flight.vehicle.step());
      }
    };
    flight.say(false, false);
    wait();
    EXPECT_TRUE(flight.node.tick(flight.vehicle.now()).mode);
    flight.say(true, true);
    const auto out = flight.node.tick(flight.vehicle.now());
    EXPECT_FALSE(out.mode || out.actuators);
    EXPECT_EQ(flight.node.snapshot(0).level, Level::error);
    // The IMU is mended on the ground: the next arming flies.
    flight.say(false, false);
    flight.fly(2.0);
    flight.say(true, true);
    EXPECT_TRUE(flight.node.tick(flight.vehicle.now()).actuators);
  }
}

// A pilot flies, then switches to offboard mode. Nobody tells the node that the rotors turn.
TEST(Px4Node, TakesOverInTheAir) {
  for (const bool started_in_flight : {false, true})
    for (const char* height : {"1.5", "5", "60"}) {
      SCOPED_TRACE(height);
      Flight flight(height);
      if (!started_in_flight) {
        flight.say(false, false);
        flight.fly(2.0);
      }
      tilt_ropter::BodyStated body;
      body.position << 0.3, 0.6, std::stod(height);
      body.orientation = tilt_ropter::quaternion_from_yaw(-0.5);
      tilt_ropter::PlantState<4> state = flight.vehicle.plant.state();
      state.body = body;
      flight.vehicle.by_another.rotor_speed.setConstant(std::sqrt(1.03 * 1.5 * 9.81 / 4 / 1.4e-6));
      state.actuators = flight.vehicle.by_another;
      flight.say(true, false);
      // It has not seen how the vehicle got there: it looks for a second.
      for (int i = 0; i < (started_in_flight ? 1 : 5); ++i) {
        state.time = flight.vehicle.plant.time();
        flight.vehicle.plant.reset(state);
        flight.fly(0.3);
      }
      flight.say(true, true);
      double lowest = body.position.z(), level = 1.0;
      for (int i = 0; i < 100; ++i) {
        flight.fly(0.03);
        const tilt_ropter::BodyStated& now = flight.vehicle.plant.body();
        lowest = std::min(lowest, now.position.z());
        level = std::min(level, (now.orientation * Vector3d::UnitZ()).z());
      }
      EXPECT_GT(lowest, body.position.z() - 0.1);
      EXPECT_GT(level, std::cos(5.0 * pi / 180.0));
      EXPECT_LT((flight.vehicle.plant.body().position - body.position).norm(), 0.05);
    }
}

TEST(Px4Node, StopsSendingSoonAfterOdometryIsLost) {
  Flight flight;
  flight.say(false, false);
  flight.fly(2.0);
  flight.say(true, true);
  flight.fly(6.0);
  flight.vehicle.estimating = false;
  flight.fly(0.5);
  const int commands = flight.vehicle.commands, heartbeats = flight.vehicle.heartbeats;
  EXPECT_NEAR(commands, 640, 3);
  EXPECT_LT((flight.vehicle.plant.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.1);
  flight.fly(0.1);
  EXPECT_EQ(flight.vehicle.commands, commands);
  EXPECT_EQ(flight.vehicle.heartbeats, heartbeats);
  EXPECT_EQ(flight.node.snapshot(0).level, Level::error);
}

TEST(Px4Node, SendsNothingIfItsClockIsNotThatOfPx4) {
  for (const std::int64_t difference : {-2000000000LL, 2000000000LL, 1700000000000000000LL}) {
    Flight flight;
    flight.say(true, true);
    flight.fly(0.1);
    EXPECT_GT(flight.vehicle.commands, 5);
    const auto out = flight.node.tick(flight.vehicle.now() + difference);
    EXPECT_FALSE(out.mode || out.actuators);
    EXPECT_EQ(flight.node.snapshot(0).level, Level::error);
  }
}

// An age by stamps that is above max_silence, from the start or in flight, as with a clock that
// creeps or a slow line: never a flight without feedback.
TEST(Px4Node, DoesNotFlyOnStampsThatAreOld) {
  for (const double age : {0.11, 0.3, 0.9, -0.3}) {
    Flight late;
    late.vehicle.stamps_late = age;
    late.say(true, true);
    late.fly(1.0);
    EXPECT_EQ(late.vehicle.commands + late.vehicle.heartbeats, 0) << age;

    Flight flight;
    flight.say(false, false);
    flight.fly(2.0);
    flight.say(true, true);
    flight.fly(5.0);
    flight.vehicle.stamps_late = age;
    flight.fly(0.5);
    const int commands = flight.vehicle.commands;
    EXPECT_LT((flight.vehicle.plant.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.1);
    flight.fly(0.2);
    EXPECT_EQ(flight.vehicle.commands, commands) << age;
    EXPECT_EQ(flight.node.snapshot(0).level, Level::error);
  }
}

// PX4's estimator resets its position or heading: the vehicle stays where it is.
TEST(Px4Node, TheHoverPointMovesWithResetsOfTheEstimator) {
  for (const Vector3d& step :
       {Vector3d(0, 0, 3), Vector3d(0, 0, -3), Vector3d(5, 0, 0), Vector3d(0.1, -0.2, 0.1)})
    for (const double turn : {0.0, 1.0}) {
      SCOPED_TRACE(step.transpose());
      Flight flight;
      flight.say(false, false);
      flight.fly(2.0);
      flight.say(true, true);
      flight.fly(6.0);
      flight.vehicle.reset_estimate(step, turn);
      double farthest = 0.0, level = 1.0;
      for (int i = 0; i < 200; ++i) {
        flight.fly(0.02);
        const auto& body = flight.vehicle.plant.body();
        farthest = std::max(farthest, (body.position - Vector3d(0.3, 0.6, 1.5)).norm());
        level = std::min(level, (body.orientation * Vector3d::UnitZ()).z());
      }
      EXPECT_LT(farthest, 0.1) << turn;
      EXPECT_GT(level, std::cos(5.0 * pi / 180.0)) << turn;
    }
}

// Neither a second sender elsewhere nor an estimate with a large variance moves the vehicle.
TEST(Px4Node, DoesNotFollowASecondSenderOfOdometry) {
  Flight flight;
  flight.say(false, false);
  flight.fly(2.0);
  flight.say(true, true);
  flight.fly(5.0);
  for (int i = 0; i < 200; ++i) {
    flight.fly(0.01);
    px4_msgs::msg::VehicleOdometry other = flight.vehicle.odometry();
    other.position[0] += 2.0F;
    flight.node.on_odometry(other);
    other.position[0] -= 1.8F;
    other.position_variance[1] = 100.0F;
    flight.node.on_odometry(other);
  }
  EXPECT_LT((flight.vehicle.plant.body().position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.02);
}

// PX4's land detector takes a vehicle without a thrust set point for one that has landed.
TEST(Px4Node, SendsTheThrustForTheLandDetector) {
  Flight flight;
  flight.say(false, false);
  flight.fly(2.0);
  flight.say(true, true);
  flight.fly(5.0);
  const auto out = flight.node.tick(flight.vehicle.now());
  ASSERT_TRUE(out.thrust);
  EXPECT_NEAR(out.thrust->xyz[2], -1.03 * 1.5 * 9.81 / 48.0, 0.02);
  EXPECT_EQ(out.thrust->timestamp, out.now);
}

TEST(Px4Node, RejectsParametersOutOfRange) {
  const auto node = [](Parameters parameters) {
    Px4Node<4> pilot(tilt_ropter::tilt_ropter_vehicle(), {}, parameters);
  };
  EXPECT_THROW(node({{"level", "thrust"}}), std::invalid_argument);
  EXPECT_THROW(node({{"thrust_model_factor", "2.0"}}), std::invalid_argument);
  EXPECT_THROW(node({{"max_silence", "100"}}), std::invalid_argument);  // [ms]
  EXPECT_THROW(node({{"origin_height", "nan"}}), std::invalid_argument);
}

TEST(Px4Versions, NamesTopicsAfterTheVersionsOfTheFirmware) {
  const Px4Versions current;
  EXPECT_EQ(current.topic("VehicleOdometry"), "fmu/out/vehicle_odometry");
  EXPECT_EQ(current.topic("VehicleStatus"), "fmu/out/vehicle_status_v4");
  EXPECT_EQ(current.topic("ActuatorServos"), "fmu/in/actuator_servos_v1");
  const Px4Versions older({"VehicleStatus=1", "ActuatorServos=0"});
  EXPECT_EQ(older.topic("VehicleStatus"), "fmu/out/vehicle_status_v1");
  EXPECT_EQ(older.topic("ActuatorServos"), "fmu/in/actuator_servos");
  EXPECT_EQ(older.of("ActuatorServos"), 0);
  for (const char* bad : {"", "VehicleStatus", "VehicleStatus=", "VehicleStatus=5",
                          "VehicleStatus=-1", "VehicleStatus=1 ", "Status=1", "VehicleOdometry=1"})
    EXPECT_THROW(Px4Versions({std::string(bad)}), std::invalid_argument) << bad;
}

TEST(Px4Messages, RejectsInvalidOdometry) {
  using Odometry = px4_msgs::msg::VehicleOdometry;
  Odometry good{};
  good.pose_frame = pose_frame_ned;
  good.velocity_frame = velocity_frame_ned;
  good.position[0] = 1.0F;
  good.position[1] = 2.0F;
  good.position[2] = -3.0F;
  good.q[0] = 1.0F;
  const auto body = body_state(good, 0.5);
  ASSERT_TRUE(body.has_value());
  EXPECT_LT((body->position - Vector3d(2.0, 1.0, 3.5)).norm(), 1e-12);
  EXPECT_NEAR(tilt_ropter::yaw_of(body->orientation), pi / 2, 1e-12);  // north
  const auto refused = [&good](auto&& spoil) {
    Odometry m = good;
    spoil(m);
    return !body_state(m, 0.5).has_value();
  };
  EXPECT_TRUE(refused([](Odometry& m) { m.pose_frame = pose_frame_frd; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.velocity_frame = velocity_frame_frd; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.position[1] = nan_f; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.q[0] = nan_f; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.q[0] = 0.0F; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.velocity[2] = nan_f; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.angular_velocity[0] = nan_f; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.position_variance[2] = 1.1F; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.velocity_variance[0] = 1.1F; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.orientation_variance[2] = 0.3F; }));
  EXPECT_TRUE(refused([](Odometry& m) { m.quality = -1; }));
  EXPECT_FALSE(refused([](Odometry& m) { m.velocity_variance[0] = nan_f; }));  // it is not told
}

}  // namespace px4_node_test
}  // namespace loops
