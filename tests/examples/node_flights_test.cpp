// Both nodes with 2 to 8 rotors, at both levels, and with set points of a planner, in simulated
// time.
// CTest: dds flight optimised

#include "../../examples/integrations/px4_node.hpp"
#include "../../examples/integrations/ros2_node.hpp"
#include "support/px4_flight.hpp"
#include "support/px4_vehicle.hpp"
#include "support/ros2_vehicle.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>
#include <vector>

namespace loops {
namespace node_flights_test {

using Eigen::Vector3d;

constexpr std::int64_t start = 5000000000LL;
const tilt_ropter::Vehicle<4> vehicle_of_paper = tilt_ropter::tilt_ropter_vehicle();

Parameters hover(const std::string& level) {
  return {{"use_sim_time", "true"}, {"origin_height", "0.07"}, {"thrust_model_factor", "0.3"},
          {"hover_x", "0.3"},       {"hover_y", "0.6"},        {"hover_z", "1.5"},
          {"hover_yaw", "-0.5"},    {"level", level}};
}

/// A vehicle and ros2_node.
template <int Rotors>
struct Ros2Flight {
  Ros2Flight(const tilt_ropter::Vehicle<Rotors>& flown, const examples::VehicleFile& file,
             Parameters parameters)
      : vehicle(start, flown), node(flown, file, parameters) {}

  void step(long ms) {
    vehicle.sense(node);
    ASSERT_TRUE(vehicle.step());
    if (ms % 10 != 0) return;
    if (const auto* command = node.tick(vehicle.now())) vehicle.on_command(*command);
  }
  [[nodiscard]] Level level() const { return node.snapshot(0).level; }

  test_support::AnyRos2Vehicle<Rotors> vehicle;
  Ros2Node<Rotors> node;
};

/// A vehicle and px4_node; PX4 arms after 2 s.
template <int Rotors>
struct Px4Flight {
  Px4Flight(const tilt_ropter::Vehicle<Rotors>& flown, const examples::VehicleFile& file,
            Parameters parameters)
      : vehicle(start, flown), node(flown, file, parameters) {}

  void step(long ms) {
    vehicle.sense(node);
    ASSERT_TRUE(vehicle.step());
    if (ms % 500 == 0) node.on_status(vehicle.status(ms >= 2000, ms >= 2000));
    if (ms % 10 != 0) return;
    const auto out = node.tick(vehicle.now());
    if (!out.actuators) return;
    using namespace px4_msgs::msg;
    vehicle.on_motors(px4_controls<ActuatorMotors>(out.actuators->motor, out.now, out.sample));
    vehicle.on_servos(px4_controls<ActuatorServos>(out.actuators->servo, out.now, out.sample));
  }
  [[nodiscard]] Level level() const { return node.snapshot(0).level; }

  test_support::AnyPx4Vehicle<Rotors> vehicle;
  Px4Node<Rotors> node;
};

template <template <int> class Flight>
void hover_with_every_vehicle() {
  for (const std::pair<std::string, std::string>& chosen :
       {std::pair<std::string, std::string>{"bicopter", ""},
        {"tricopter", ""},
        {"tilt_ropter", "actuator"},
        {"quadrotor", ""},
        {"hexacopter", "wrench"},
        {"hexacopter_with_pusher", ""},
        {"coaxial_octocopter", ""}}) {
    SCOPED_TRACE(chosen.first + " " + chosen.second);
    const examples::VehicleFile file =
        examples::read_vehicle(VEHICLES_DIR "/" + chosen.first + ".json");
    std::visit(
        [&](auto vehicle) {
          if (!undercarriage(vehicle)) vehicle.legs.emplace();
          Flight flight(vehicle, file, hover(chosen.second));
          for (long ms = 1; ms <= 10000; ++ms) ASSERT_NO_FATAL_FAILURE(flight.step(ms));
          const auto& body = flight.vehicle.plant.body();
          EXPECT_LT((body.position - Vector3d(0.3, 0.6, 1.5)).norm(), 0.04);
          EXPECT_LT(body.velocity.norm(), 0.03);
          EXPECT_NEAR(tilt_ropter::yaw_of(body.orientation), -0.5, 0.05);
          EXPECT_EQ(flight.level(), Level::ok);
        },
        file.vehicle);
  }
}

TEST(NodeFlights, EveryVehicleHoversByRos2Node) {
  hover_with_every_vehicle<Ros2Flight>();
}

TEST(NodeFlights, EveryVehicleHoversByPx4Node) {
  hover_with_every_vehicle<Px4Flight>();
}

/// A circle of 0.8 m from the hover point on, in 12.6 s; the heading turns along.
SetPoint circle(double time) {
  constexpr double radius = 0.8, rate = 0.5;
  const double a = rate * time;
  SetPoint p;
  p.position = Vector3d(0.3, 0.6, 1.5) + radius * Vector3d(1.0 - std::cos(a), std::sin(a), 0.0);
  p.velocity = radius * rate * Vector3d(std::sin(a), std::cos(a), 0.0);
  p.acceleration = radius * rate * rate * Vector3d(std::cos(a), -std::sin(a), 0.0);
  p.yaw = -0.5 + a;
  p.yaw_rate = rate;
  return p;
}

TEST(NodeFlights, Px4NodeSaysWhatItWaitsFor) {
  Parameters parameters = hover("");
  test_support::Px4Vehicle vehicle(start);
  Px4Node<4> node(vehicle_of_paper, {}, parameters);
  long ms = 0;
  // PX4 says at 2 Hz that it is `armed` and in offboard mode, if it says anything.
  const auto waits_for = [&](long until, bool says, bool armed, bool offboard) {
    for (; ms < until; ++ms) {
      if (says && ms % 500 == 0) node.on_status(vehicle.status(armed, offboard));
      vehicle.sense(node);
      EXPECT_TRUE(vehicle.step());
      if (ms % 10 == 0) (void)node.tick(vehicle.now());
    }
    return std::string(node.snapshot(0).waits_for);
  };
  vehicle.estimating = false;
  EXPECT_EQ(waits_for(100, false, false, false), "vehicle_odometry");
  EXPECT_FALSE(node.snapshot(0).located);
  vehicle.estimating = true;
  EXPECT_EQ(waits_for(500, false, false, false), "vehicle_status or vehicle_control_mode");
  EXPECT_EQ(waits_for(3000, true, false, false), "arming");
  EXPECT_EQ(waits_for(3600, true, true, false), "offboard mode");
  EXPECT_EQ(waits_for(4201, true, true, true), "");  // its rotors stand still
  const Snapshot s = node.snapshot(0);
  EXPECT_NEAR(s.heard[0].rate(), 100.0, 2.0);
  EXPECT_NEAR(s.heard[0].age(), 0.002, 0.002);
  EXPECT_NEAR(s.heard[2].rate(), 2.0, 0.1);
  EXPECT_FALSE(s.heard[3].ever());
}

// Agent, network and estimator take their time. When late samples were compared with the actuators
// of now, 60 ms turned the vehicle over; when a late state was taken for that of now, it lagged.
TEST(NodeFlights, OdometryMayBeLate) {
  for (const char* level : {"wrench", "actuator"})
    for (const long delay : {0L, 30L, 60L, 80L}) {
      Parameters parameters{{"use_sim_time", "true"},
                            {"origin_height", "0.07"},
                            {"thrust_model_factor", "0.3"},
                            {"level", level},
                            {"mission", "air"}};
      Px4Flight flight(vehicle_of_paper, {}, parameters);
      flight.vehicle.delay = 1e-3 * static_cast<double>(delay);
      double sum = 0.0, worst = 0.0;
      int count = 0;
      for (long ms = 1; ms <= 30000; ++ms) {
        ASSERT_NO_FATAL_FAILURE(flight.step(ms));
        const auto shown = flight.node.snapshot(0);
        if (ms % 10 != 0 || ms < 6000 || !shown.located) continue;  // in the air
        const double error =
            (flight.vehicle.plant.body().position - shown.reference.position).norm();
        worst = std::max(worst, error);
        if (std::string(shown.activity) != "air") continue;
        sum += error * error;
        ++count;
      }
      ASSERT_GT(count, 1000);
      std::printf("odometry %ld ms late, %s level: eight %.1f mm RMSE, worst error %.0f mm\n",
                  delay, level, 1e3 * std::sqrt(sum / count), 1e3 * worst);
      EXPECT_LT(std::sqrt(sum / count), 0.004);
      EXPECT_LT(worst, 0.02);
    }
}

// The second rotor is wired to channel 7, its servo is reversed; another servo has a trim.
TEST(NodeFlights, WiringIsAParameter) {
  Parameters parameters{{"motor_channels", "1,7,3,4"},
                        {"servo_channels", "1,8,3,4"},
                        {"servo_trims", "0,0,0.25,0"},
                        {"reversed_servos", "2"},
                        {"thrust_model_factor", "0.3"}};
  const auto wiring = px4_wiring(vehicle_of_paper, parameters);
  const tilt_ropter::OutputScaling<4> scaling(vehicle_of_paper, wiring.outputs);
  tilt_ropter::ActuatorState<4> command;
  command.rotor_speed << 1000.0, 1500.0, 2000.0, 500.0;
  command.tilt_angle << 0.5, 0.5, 0.5, -0.5;
  const auto controls = wiring.controls(*scaling.outputs(command));
  const float part = static_cast<float>(0.5 / tilt_ropter::pi);
  EXPECT_FLOAT_EQ(controls.servo[0], part);
  EXPECT_TRUE(std::isnan(controls.servo[1]));
  EXPECT_FLOAT_EQ(controls.servo[2], 0.25F + part);
  EXPECT_FLOAT_EQ(controls.servo[3], -part);
  EXPECT_FLOAT_EQ(controls.servo[7], -part);
  EXPECT_TRUE(std::isnan(controls.motor[1]));
  EXPECT_GT(controls.motor[6], controls.motor[0]);
  EXPECT_LT(controls.motor[6], controls.motor[2]);
  for (const auto& [name, value] :
       std::vector<std::pair<std::string, std::string>>{{"motor_channels", "1,2,3"},
                                                        {"motor_channels", "1,2,3,3"},
                                                        {"servo_channels", "1,2,3,9"},
                                                        {"servo_channels", "1,2,3,x"},
                                                        {"servo_trims", "0,0,0,2"},
                                                        {"reversed_servos", "5"},
                                                        {"reversed_servos", "1.5"}}) {
    Parameters wrong{{name, value}};
    EXPECT_THROW((Px4Node<4>(vehicle_of_paper, {}, wrong)), std::invalid_argument) << name << value;
  }
}

TEST(NodeFlights, Px4NodeFollowsSetPointsOfPx4) {
  Px4Flight flight(vehicle_of_paper, {}, hover(""));
  constexpr long begin = 8000, end = 20000;
  for (long ms = 1; ms <= end + 3000; ++ms) {
    ASSERT_NO_FATAL_FAILURE(flight.step(ms));
    if (ms < begin || ms > end) continue;
    const SetPoint p = circle(1e-3 * static_cast<double>(ms - begin));
    if (ms % 50 == 0) {
      px4_msgs::msg::TrajectorySetpoint m{};
      const auto ned = [](float(&field)[3], const Vector3d& enu) {
        field[0] = static_cast<float>(enu.y());
        field[1] = static_cast<float>(enu.x());
        field[2] = static_cast<float>(-enu.z());
      };
      ned(m.position, p.position - Vector3d(0.0, 0.0, 0.07));
      ned(m.velocity, p.velocity);
      ned(m.acceleration, p.acceleration);
      m.yaw = static_cast<float>(tilt_ropter::pi / 2.0 - p.yaw);
      m.yawspeed = static_cast<float>(-p.yaw_rate);
      flight.node.on_set_point(m);
    }
    if (ms < begin + 2000) continue;
    const auto& body = flight.vehicle.plant.body();
    ASSERT_LT((body.position - p.position).norm(), 0.05) << ms;
    ASSERT_LT(body.orientation.angularDistance(tilt_ropter::quaternion_from_yaw(p.yaw)), 0.1);
  }
  // The planner has ended. The vehicle stops where it was, and hovers.
  EXPECT_LT((flight.vehicle.plant.body().position - circle(12.0).position).norm(), 0.6);
  EXPECT_LT(flight.vehicle.plant.body().velocity.norm(), 0.03);
  EXPECT_STREQ(flight.node.snapshot(0).activity, "hover point");
}

TEST(NodeFlights, Ros2NodeFollowsATrajectoryOfATopic) {
  Ros2Flight flight(vehicle_of_paper, {}, hover("actuator"));
  std::vector<std::vector<geometry_msgs::msg::Transform>> transforms;
  std::vector<std::vector<geometry_msgs::msg::Twist>> velocities;
  std::vector<trajectory_msgs::msg::MultiDOFJointTrajectoryPoint> points(26);
  for (std::size_t i = 0; i < points.size(); ++i) {
    const SetPoint p = circle(0.5 * static_cast<double>(i));
    const Eigen::Quaterniond q = tilt_ropter::quaternion_from_yaw(p.yaw);
    transforms.push_back(
        {{{p.position.x(), p.position.y(), p.position.z()}, {q.x(), q.y(), q.z(), q.w()}}});
    velocities.push_back(
        {{{p.velocity.x(), p.velocity.y(), p.velocity.z()}, {0.0, 0.0, p.yaw_rate}}});
    points[i].time_from_start = {static_cast<std::int32_t>(i / 2), i % 2 == 0 ? 0U : 500000000U};
  }
  for (std::size_t i = 0; i < points.size(); ++i) {
    refer_to(points[i].transforms, transforms[i]);
    refer_to(points[i].velocities, velocities[i]);
  }
  trajectory_msgs::msg::MultiDOFJointTrajectory m{};
  refer_to(m.points, points);
  constexpr long begin = 8000;
  for (long ms = 1; ms <= begin + 12400; ++ms) {
    ASSERT_NO_FATAL_FAILURE(flight.step(ms));
    if (ms == begin) flight.node.on_trajectory(m);
    if (ms < begin + 1000) continue;
    const SetPoint p = circle(1e-3 * static_cast<double>(ms - begin));
    const auto& body = flight.vehicle.plant.body();
    ASSERT_LT((body.position - p.position).norm(), 0.05) << ms;
    ASSERT_LT(body.orientation.angularDistance(tilt_ropter::quaternion_from_yaw(p.yaw)), 0.1);
  }
  m.points._length = 0;
  flight.node.on_trajectory(m);  // ignored
  EXPECT_STREQ(flight.node.snapshot(0).activity, "set points");
}

// PX4 disarms a vehicle that has landed.
TEST(NodeFlights, Px4NodePausesAndLandsWhenToldTo) {
  for (const char* level : {"wrench", "actuator"}) {
    SCOPED_TRACE(level);
    test_support::Px4Flight flight("air", level);
    flight.fly(1.5);
    flight.px4.wants_offboard = true;
    ASSERT_TRUE(flight.px4.arm());
    flight.fly(12.0);
    ASSERT_GT(flight.body().velocity.norm(), 0.3);
    flight.node->on_pause({true});
    flight.fly(2.0);
    const Vector3d there = flight.body().position;
    flight.fly(2.0);
    EXPECT_LT((flight.body().position - there).norm(), 0.02);
    EXPECT_NE(flight.node->snapshot(0).line().find("offboard, paused"), std::string::npos);
    flight.node->on_pause({false});
    flight.fly(4.0);
    EXPECT_GT(flight.body().velocity.norm(), 0.1);
    flight.node->on_land({true});
    for (int i = 0; i < 20 && flight.px4.armed(); ++i) flight.fly(1.0);
    EXPECT_TRUE(flight.px4.disarmed_by_land_detector());
    EXPECT_LT(flight.body().position.z(), 0.12);
    EXPECT_LT(flight.fastest_fall, 1.0);
    EXPECT_LT(flight.sag, 0.05);
  }
}

TEST(NodeFlights, Ros2NodeLandsWhenToldToAndTakesOffAgain) {
  Ros2Flight flight(vehicle_of_paper, {}, hover(""));
  for (long ms = 1; ms <= 24000; ++ms) {
    ASSERT_NO_FATAL_FAILURE(flight.step(ms));
    if (ms == 6000) flight.node.on_land({true});
    if (ms == 15000) {
      EXPECT_STREQ(flight.node.snapshot(0).activity, "landed");
      EXPECT_LT(flight.vehicle.plant.body().position.z(), 0.12);
      EXPECT_LT(flight.node.snapshot(0).rotor_speed[0], 500.0);  // of 1600 in hover
      flight.node.on_pause({false});
    }
  }
  EXPECT_STREQ(flight.node.snapshot(0).activity, "hover point");
  EXPECT_GT(flight.vehicle.plant.body().position.z(), 0.9);
}

}  // namespace node_flights_test
}  // namespace loops
