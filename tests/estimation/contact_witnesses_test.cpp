// Contact needs two witnesses: the load that the accelerometer feels, and the load by the motion.

#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace contact_witnesses_test {

const RigidBodyParameters body{2.0, Eigen::Matrix3d::Identity()};
const Undercarriage wheels{0.11, true, true, true};
constexpr double weight = 2.0 * gravity;

// A point mass that moves vertically under `thrust`, above a floor at `floor`. The observer feels
// what acts on it plus `lie` of the accelerometer, and believes `believed` as the applied force.
struct Vertical {
  explicit Vertical(double height, double floor_height = 0.0) : floor(floor_height) {
    state.position.z() = height;
  }

  const ContactEstimate& fly(double duration) {
    for (double t = 0.0; t < duration - 1e-9; t += 0.01) {
      time += 0.01;
      double load = std::max(
          0.0, 4000.0 * (floor + wheels.height - state.position.z()) - 200.0 * state.velocity.z());
      if (state.position.z() > floor + wheels.height) load = 0.0;
      state.velocity.z() += 0.01 * ((thrust + load + gust) / body.mass - gravity);
      state.position.z() += 0.01 * state.velocity.z();
      observed.time = time;
      observed.raw.force.z() = thrust + load + gust + lie - believed();
      observed.external = observed.raw;
      observed.applied.emplace();
      observed.applied->force.z() = believed();
      observed.add_to_sums(0.01);
      contact.update(time, state, observed);
    }
    return contact.estimate();
  }
  // The thrust holds the height.
  const ContactEstimate& hover(double duration) {
    for (double t = 0.0; t < duration - 1e-9; t += 0.01) {
      thrust = weight - gust - 10.0 * state.velocity.z();
      fly(0.01);
    }
    return contact.estimate();
  }
  [[nodiscard]] double believed() const { return knows_thrust ? thrust : 0.0; }

  ContactEstimator contact{body, wheels};
  ObservedWrenchd observed;
  BodyStated state;
  double time = 0.0, floor, thrust = 0.0, gust = 0.0, lie = 0.0;
  bool knows_thrust = true;
};

// A controller that takes over in hover: its observer has begun anew, and its first sample comes
// late.
TEST(ContactWitnesses, AHoverWithoutASampleIsNotGround) {
  WrenchObserverd observer(body);
  const InertialSampled level{Eigen::Vector3d::Zero(), {0.0, 0.0, gravity}};
  (void)observer.update(0.0, level, {});  // somebody else flies: the applied wrench is not known
  observer.reset();
  EXPECT_FALSE(observer.observed().applied);
  Wrenchd hover;
  hover.force.z() = weight;
  BodyStated state;
  state.position.z() = 1.5;
  ContactEstimator contact(body, wheels);
  for (int i = 1; i <= 100; ++i) {
    if (i > 10) (void)observer.update(0.01 * i - 0.08, level, hover);
    EXPECT_FALSE(contact.update(0.01 * i, state, observer.observed()).on_ground) << i;
    EXPECT_LT(std::abs(contact.load_by_motion()), 0.01 * weight) << i;
  }
}

TEST(ContactWitnesses, AFeltLoadInMidAirIsNotGround) {
  for (const double height : {0.5, 1.5, 20.0}) {
    Vertical v(height);
    v.hover(2.0);
    for (const double lie : {0.35, 0.6, 1.5, 3.0}) {
      v.lie = lie * weight;
      const ContactEstimate& e = v.hover(1.0);
      EXPECT_FALSE(e.on_ground) << height << ' ' << lie;
      EXPECT_NEAR(e.disturbance.force.z(), 0.0, 0.15 * weight);  // it follows the motion
      EXPECT_GT(v.contact.felt_load() - v.contact.load_by_motion(), 0.9 * v.lie);
      v.lie = 0.0;
      v.hover(1.0);
    }
    EXPECT_EQ(v.contact.mode_changes(), 0);
  }
}

TEST(ContactWitnesses, AFeltLoadDoesNotCarryTheGroundUp) {
  Vertical v(0.11);
  EXPECT_TRUE(v.fly(1.0).on_ground);
  v.lie = 0.8 * weight;
  v.thrust = 1.1 * weight;  // takes off
  v.fly(1.0);
  ASSERT_GT(v.state.position.z(), 0.4);
  EXPECT_FALSE(v.contact.estimate().on_ground);
  EXPECT_NEAR(v.contact.estimate().ground.height, 0.0, 0.05);
}

TEST(ContactWitnesses, ATableCarriesByBoth) {
  Vertical v(1.3, 0.8);
  v.hover(2.0);
  v.state.velocity.z() = -0.15;
  for (int i = 0; i < 600; ++i) {  // sinks, and takes the felt load as a reason to push less
    v.thrust = weight - 10.0 * (v.state.velocity.z() + 0.15) -
               std::clamp(v.contact.felt_load(), 0.0, weight);
    v.fly(0.01);
  }
  EXPECT_TRUE(v.contact.estimate().on_ground);
  EXPECT_NEAR(v.contact.estimate().ground.height, 0.8, 0.01);
  EXPECT_GT(v.contact.standing_for(), 0.3);
}

// Another controller has flown; nobody tells that the rotors turn.
TEST(ContactWitnesses, StartsInTheAirAboveTheAssumedGround) {
  for (const double height : {0.5, 1.5, 60.0}) {
    Vertical v(height);
    v.knows_thrust = false;
    v.thrust = weight;
    for (int i = 0; i < 30; ++i) {  // the model of the rotors takes 0.3 s
      EXPECT_FALSE(v.fly(0.01).on_ground);
      EXPECT_EQ(v.contact.estimate().disturbance.force.norm(), 0.0);
    }
    v.knows_thrust = true;
    for (int i = 0; i < 100; ++i) EXPECT_LT(v.hover(0.01).disturbance.force.norm(), 0.2 * weight);
    EXPECT_FALSE(v.contact.estimate().on_ground);
    EXPECT_EQ(v.contact.mode_changes(), 0);
  }
  EXPECT_TRUE(Vertical(0.11).fly(0.1).on_ground);
  EXPECT_TRUE(Vertical(0.21, 0.1).fly(0.1).on_ground);
}

TEST(ContactWitnesses, AFallIsNotStanding) {
  Vertical v(0.11);
  v.fly(1.0);
  EXPECT_NEAR(v.contact.standing_for(), 1.0, 0.1);
  EXPECT_NEAR(v.contact.load_by_motion(), weight, 0.1 * weight);
  v.floor = -5.0;  // the table breaks
  v.fly(0.3);
  EXPECT_EQ(v.contact.standing_for(), 0.0);
  EXPECT_LT(v.contact.load_by_motion(), 0.2 * weight);
}

TEST(ContactWitnesses, TheStateMayJump) {
  Vertical v(1.5);
  v.hover(2.0);
  v.state.velocity.z() -= 5.0;
  v.state.position.z() = 3.0;
  v.thrust = weight;
  EXPECT_LT(v.fly(0.05).disturbance.force.norm(), 0.05 * weight);
  EXPECT_FALSE(v.contact.estimate().on_ground);
}

TEST(ContactWitnesses, ReferencesArePlannedForTheGroundNearTheAssumedOne) {
  constexpr double unknown = -std::numeric_limits<double>::infinity();
  Vertical near(0.06, -0.05), far(-1.0, -1.11), above(1.5);
  EXPECT_EQ(near.fly(0.5).planned_height, 0.0);
  EXPECT_EQ(Vertical(0.11).fly(0.5).planned_height, unknown);  // the estimated ground is better
  EXPECT_EQ(far.fly(0.5).planned_height, unknown);
  EXPECT_EQ(above.hover(0.5).planned_height, unknown);
}

// A wall holds against any force, so what it gives must not wind up.
TEST(ContactWitnesses, TheDisturbanceHasLimitsByTheWeight) {
  ContactEstimator contact(body, wheels);
  BodyStated state;
  state.position.z() = 2.0;
  ObservedWrenchd observed;
  for (int i = 0; i < 100; ++i) {
    Wrenchd wall;
    wall.force << -0.2 * weight, 0.0, 0.05 * weight;
    if (i >= 50) wall = {Eigen::Vector3d(-weight, weight, 0.1 * weight), Eigen::Vector3d(0, 2, 0)};
    observed = unfiltered_wrench(observed, 0.01 * i, wall);
    const ContactEstimate& e = contact.update(0.01 * i, state, observed);
    EXPECT_EQ(e.limited, i >= 50);
    EXPECT_LE(e.disturbance.force.head<2>().norm(), 0.3001 * weight);
    EXPECT_LE(e.disturbance.torque.norm(), 0.0301 * weight);
    EXPECT_NEAR(e.disturbance.force.z(), wall.force.z(), 1e-6);
    EXPECT_LT((e.external.force - wall.force).norm(), 1e-9);
  }
}

}  // namespace contact_witnesses_test
}  // namespace tilt_ropter
