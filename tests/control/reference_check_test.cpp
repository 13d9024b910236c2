#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <string>

namespace tilt_ropter {
namespace reference_check_test {

const Vehicle<4> vehicle = tilt_ropter_vehicle();

// Level reference in the air, with the acceleration sin(t) along x.
ReferencePoint swing(double t) {
  ReferencePoint point;
  point.position << -std::sin(t), 0.0, 1.5;
  point.velocity << -std::cos(t), 0.0, 0.0;
  point.acceleration << std::sin(t), 0.0, 0.0;
  return point;
}

TEST(CheckReference, HybridMissionFitsTheDefaultBounds) {
  const Mission mission = hybrid_mission(tilt_ropter_vehicle());
  EXPECT_TRUE(check_reference(mission, mission.start_time(), mission.end_time(), vehicle).empty());
  Vehicle<4> heavy = vehicle;  // has larger default bounds
  heavy.body.mass *= 3.0;
  EXPECT_TRUE(check_reference(mission, mission.start_time(), mission.end_time(), heavy).empty());
  EXPECT_FALSE(
      check_reference(mission, mission.start_time(), mission.end_time(), heavy, {}).empty());
}

TEST(CheckReference, HybridMissionViolatesThePapersBounds) {
  const Mission mission = hybrid_mission(tilt_ropter_vehicle());
  const auto violations = check_reference(mission, mission.start_time(), mission.end_time(),
                                          vehicle, paper_nmpc_settings());
  bool side_force = false, spin_up = false;
  for (const BoundViolation& v : violations) {
    if (std::string(v.bound) == "force" && v.axis == 0) {
      side_force = true;
      EXPECT_NEAR(std::abs(v.allowed), 0.2, 1e-12);
      EXPECT_GT(std::abs(v.required), 1.0);
      EXPECT_EQ(mission.phase(v.time), MissionPhase::air);
    }
    // A rise by 14 N within the horizon of 2 s needs about 7 N/s. The paper's table allows 2 N/s.
    if (std::string(v.bound) == "force_rate" && v.axis == 2) {
      spin_up = true;
      EXPECT_NEAR(std::abs(v.required), 7.1, 0.2);
    }
  }
  EXPECT_TRUE(side_force);
  EXPECT_TRUE(spin_up);
}

TEST(CheckReference, ReportsBoundTimeRequiredAndAllowedValue) {
  NmpcSettings settings;
  settings.problem.bounds.force_max.x() = 1.0;  // needed: 1.5 N sin(t)
  const auto violations = check_reference(swing, 0.0, 3.0, vehicle, settings, 1e-3);
  ASSERT_EQ(violations.size(), 1u);
  EXPECT_STREQ(violations[0].bound, "force");
  EXPECT_EQ(violations[0].axis, 0);
  EXPECT_NEAR(violations[0].time, pi / 2, 1e-3);
  EXPECT_NEAR(violations[0].required, 1.5, 1e-6);
  EXPECT_NEAR(violations[0].allowed, 1.0, 1e-12);
}

TEST(CheckReference, ReportsStepsInPositionAndOrientation) {
  const auto jump = [](double t) {
    ReferencePoint point;
    point.position << (t < 1.0 ? 0.0 : 8.0), 0.0, 1.5;
    return point;
  };
  const auto spin = [](double t) {
    ReferencePoint point;
    point.position.z() = 1.5;
    point.orientation = quaternion_from_yaw(t < 1.0 ? 0.0 : pi);
    return point;
  };
  const auto jumps = check_reference(jump, 0.0, 2.0, vehicle),
             spins = check_reference(spin, 0.0, 2.0, vehicle);
  ASSERT_EQ(jumps.size(), 1u);
  EXPECT_STREQ(jumps[0].bound, "position");
  EXPECT_EQ(jumps[0].axis, 0);
  EXPECT_NEAR(jumps[0].time, 1.0, 0.011);
  EXPECT_NEAR(jumps[0].required, 8.0, 1e-12);
  ASSERT_EQ(spins.size(), 1u);
  EXPECT_STREQ(spins[0].bound, "orientation");
  EXPECT_EQ(spins[0].axis, 2);
  EXPECT_NEAR(std::abs(spins[0].required), pi, 1e-9);
}

TEST(CheckReference, ReportsForceRate) {
  NmpcSettings settings;
  settings.problem.bounds.force_rate.x() = 1.2;  // needed: 1.5 N/s cos(t)
  const auto violations = check_reference(swing, 0.0, 3.0, vehicle, settings, 1e-3);
  ASSERT_EQ(violations.size(), 1u);
  EXPECT_STREQ(violations[0].bound, "force_rate");
  EXPECT_NEAR(std::abs(violations[0].required), 1.5, 1e-3);
}

TEST(CheckReference, ReportsTorqueRate) {
  const auto turn = [](double t) {
    ReferencePoint point;
    point.position.z() = 1.5;
    point.orientation = quaternion_from_yaw(0.5 * std::sin(2.0 * t));
    point.angular_velocity.z() = std::cos(2.0 * t);
    point.angular_acceleration.z() = -2.0 * std::sin(2.0 * t);
    return point;
  };
  const double needed = 4.0 * vehicle.body.inertia(2, 2);  // [Nm/s], times cos(2 t)
  NmpcSettings settings = nmpc_settings(vehicle);
  EXPECT_TRUE(check_reference(turn, 0.0, 3.0, vehicle, settings, 1e-3).empty());
  settings.problem.bounds.torque_rate.z() = 0.5 * needed;
  const auto violations = check_reference(turn, 0.0, 3.0, vehicle, settings, 1e-3);
  ASSERT_EQ(violations.size(), 1u);
  EXPECT_STREQ(violations[0].bound, "torque_rate");
  EXPECT_EQ(violations[0].axis, 2);
  EXPECT_NEAR(std::abs(violations[0].required), needed, 1e-3 * needed);
}

TEST(CheckReference, ReportsForceAgainstGravityOnASlope) {
  const auto drive = [](double t) {
    ReferencePoint point;
    point.position << t, 0.0, vehicle.wheels->radius;
    point.velocity.x() = 1.0;
    return point;
  };
  GroundPlane plane;
  plane.slope.x() = std::tan(0.1);  // 0.1 rad up along x
  NmpcSettings settings = nmpc_settings(vehicle);
  settings.problem.bounds.force_max.x() = 1.0;
  EXPECT_TRUE(check_reference(drive, 0.0, 2.0, vehicle, settings).empty());
  const auto violations = check_reference(drive, 0.0, 2.0, vehicle, settings, 0.01, plane);
  ASSERT_EQ(violations.size(), 1u);
  EXPECT_STREQ(violations[0].bound, "force");
  EXPECT_EQ(violations[0].axis, 0);
  EXPECT_NEAR(violations[0].required, vehicle.body.mass * gravity * std::sin(0.1), 1e-9);
}

}  // namespace reference_check_test
}  // namespace tilt_ropter
