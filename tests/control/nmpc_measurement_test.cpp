// How the measured state enters a tick and the feedback between ticks.

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include "support/hovering.hpp"
#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace tilt_ropter {
namespace nmpc_measurement_test {

using test_support::hover;
using test_support::hovering;
using test_support::in_simulated_time;

const Vehicle<4> vehicle = tilt_ropter_vehicle();

using Command = Eigen::Matrix<double, 12, 1>;

Command command_of(const NmpcResult& result) {
  Command command;
  command << result.wrench.force, result.wrench.torque, result.rate.force, result.rate.torque;
  return command;
}

ReferencePoint parked(double /*time*/) {
  ReferencePoint point;
  point.position.z() = vehicle.wheels->radius;
  return point;
}

ContactEstimate standing_on_the_ground() {
  ContactEstimate contact;
  contact.on_ground = contact.ground_known = true;
  return contact;
}

NmpcSettings settings_without_bounds_on_rates() {
  NmpcSettings settings = in_simulated_time();
  settings.problem.bounds.force_rate.setConstant(1e4);
  settings.problem.bounds.torque_rate.setConstant(1e4);
  return settings;
}

// Command of a feedback between ticks at `last`, after a tick at `first`.
template <typename Reference>
Command between(const Reference& reference, const ContactEstimate& contact, const BodyStated& first,
                const BodyStated& last) {
  Nmpc<4> nmpc(vehicle, settings_without_bounds_on_rates());
  (void)nmpc.prepare(0.0, reference, contact);
  EXPECT_EQ(nmpc.feedback(0.0, first).status, NmpcStatus::solved);
  const NmpcResult& result = nmpc.between_ticks(0.005, last);
  EXPECT_EQ(result.status, NmpcStatus::solved);
  return command_of(result);
}

BodyStated turned(const BodyStated& state, const Eigen::Vector3d& by) {
  BodyStated moved = state;
  moved.orientation = state.orientation * quaternion_exp(by);
  return moved;
}

BodyStated scaled(BodyStated state, double factor) {
  state.orientation.coeffs() *= factor;
  return state;
}

constexpr double factors[] = {1.1, 0.9, 2.0, -1.0, 1.2e-3};  // of the quaternion

TEST(NmpcMeasurement, LengthAndSignOfTheQuaternionDoNotMatterInATick) {
  const auto command = [](bool cold, const BodyStated& last) {
    Nmpc<4> nmpc(vehicle, in_simulated_time());
    if (!cold) {
      (void)nmpc.prepare(0.0, hover, in_the_air({}));
      EXPECT_EQ(nmpc.feedback(0.0, hovering()).status, NmpcStatus::solved);
    }
    (void)nmpc.prepare(0.01, hover, in_the_air({}));
    const NmpcResult& result = nmpc.feedback(0.01, last);
    EXPECT_EQ(result.status, NmpcStatus::solved);
    return command_of(result);
  };
  const BodyStated leaning = turned(hovering(), {0.01, -0.02, 0.015});
  for (const bool cold : {true, false}) {
    const Command unit = command(cold, leaning);
    EXPECT_GT((unit - command(cold, hovering())).norm(), 0.1);
    for (const double factor : factors)
      EXPECT_LT((command(cold, scaled(leaning, factor)) - unit).norm(), 1e-6) << factor;
  }
}

TEST(NmpcMeasurement, LengthAndSignOfTheQuaternionDoNotMatterBetweenTicks) {
  const auto command = [](const BodyStated& last) {
    return between(hover, in_the_air({}), hovering(), last);
  };
  const BodyStated leaning = turned(hovering(), {0.4, -0.3, 1.5});
  const Command unit = command(leaning);
  EXPECT_GT((unit - command(hovering())).norm(), 0.1);
  for (const double factor : factors)
    EXPECT_LT((command(scaled(leaning, factor)) - unit).norm(), 1e-6 * unit.norm()) << factor;
}

// The ground holds the roll. A pitched vehicle that turns has a roll rate in body axes.
TEST(NmpcMeasurement, RollRateOnTheGroundIsNotCorrectedBetweenTicks) {
  BodyStated standing;
  standing.position.z() = vehicle.wheels->radius;
  standing = turned(standing, {0.0, -0.1, 0.0});
  standing.angular_velocity.z() = 1.0;
  BodyStated rolling = standing;
  rolling.angular_velocity.x() = 0.1;
  const auto ground = [&](const BodyStated& last) {
    return between(parked, standing_on_the_ground(), standing, last);
  };
  EXPECT_EQ(ground(rolling), ground(standing));
  BodyStated turning = hovering();
  turning.angular_velocity.x() = 0.1;
  const auto air = [&](const BodyStated& last) {
    return between(hover, in_the_air({}), hovering(), last);
  };
  EXPECT_GT((air(turning) - air(hovering())).norm(), 0.1);
}

}  // namespace nmpc_measurement_test
}  // namespace tilt_ropter
