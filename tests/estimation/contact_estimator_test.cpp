#include <tilt_ropter/estimation/contact_estimator.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <optional>

namespace tilt_ropter {
namespace contact_estimator_test {

const RigidBodyParameters body{2.0, Eigen::Matrix3d::Identity()};
const Undercarriage wheels{0.11, true, true, true};
constexpr double weight = 2.0 * gravity, infinity = std::numeric_limits<double>::infinity();
const Wrenchd breeze{Eigen::Vector3d(0.4, 0.2, 0.0), Eigen::Vector3d(0.01, 0.02, 0.03)};

// Passes wrenches at 100 Hz, filtered to first order with bandwidth K, as an observer estimates
// them.
class Feed {
 public:
  explicit Feed(const GroundPlane& assumed_ground = {},
                const std::optional<Undercarriage>& on = wheels)
      : contact(body, on, assumed_ground) {}

  const ContactEstimate& operator()(double height, const Wrenchd& truth, double duration = 0.01) {
    state.position.z() = height;
    return stay(truth, duration);
  }
  const ContactEstimate& stay(const Wrenchd& truth, double duration = 0.01) {
    for (double t = 0.0; t < duration - 1e-9; t += 0.01) {
      time += 0.01;
      state.position += 0.01 * state.velocity;
      const double passed = -std::expm1(-0.01 * bandwidth);
      shown.force += passed * (truth.force - shown.force);
      shown.torque += passed * (truth.torque - shown.torque);
      see(truth);
      contact.update(time, state, observed);
    }
    return contact.estimate();
  }

  void see(const Wrenchd& truth) {
    observed.time = time;
    observed.external = shown;
    observed.raw = truth;
    observed.force_bandwidth.setConstant(bandwidth);
    observed.torque_bandwidth.setConstant(bandwidth);
    observed.add_to_sums(0.01);
  }

  ContactEstimator contact;
  BodyStated state;
  Wrenchd shown;
  ObservedWrenchd observed;
  double time = 0.0, bandwidth = 5.0;
};

Wrenchd with_lift(double lift, Wrenchd wrench = {}) {
  wrench.force.z() += lift;
  return wrench;
}

// Flies at a height [m] while only `air` acts on the vehicle.
Feed flying(double height, const Wrenchd& air = {}) {
  Feed feed;
  feed(height, air, 5.0);
  EXPECT_FALSE(feed.contact.estimate().on_ground);
  return feed;
}

TEST(ContactEstimator, LoadMeansGroundAtAnyHeight) {
  for (const double ground : {-0.5, 0.0, 0.3, 7.0}) {
    Feed feed = flying(ground + 0.2);
    feed(ground + 0.11, with_lift(0.9 * weight), 0.1);
    const ContactEstimate& e = feed.contact.estimate();
    EXPECT_TRUE(e.on_ground) << ground;
    EXPECT_TRUE(e.ground_known);
    EXPECT_NEAR(e.ground.height, ground, 1e-9);
    EXPECT_EQ(feed.contact.mode_changes(), 1);
  }
}

// The first update has no duration.
TEST(ContactEstimator, TakesAnUnfilteredWrenchFromTheFirstUpdateOn) {
  ContactEstimator contact(body, wheels);
  BodyStated state;
  state.position.z() = 0.11;
  ObservedWrenchd observed;
  EXPECT_TRUE(is_finite(contact.update(0.0, state, observed)));  // no sample yet
  for (int i = 1; i < 50; ++i) {
    observed = unfiltered_wrench(observed, 0.01 * i, with_lift(weight));
    ASSERT_TRUE(is_finite(contact.update(0.01 * i, state, observed)));
  }
  EXPECT_TRUE(contact.estimate().on_ground);
}

// A take-off with the CoM aside: one wheel leaves first. What leans but is loaded, or does not
// rise, stands.
TEST(ContactEstimator, OneWheelThatHardlyCarriesIsNoGround) {
  struct Case {
    double lean, load, rising;  // [rad], of the weight, [m/s]
    bool stands;
  };
  for (const Case& c :
       {Case{0.01, 0.1, 0.02, false}, Case{-0.01, 0.1, 0.02, false}, Case{0.002, 0.1, 0.02, true},
        Case{0.01, 0.3, 0.02, true}, Case{0.01, 0.1, 0.0, true}}) {
    SCOPED_TRACE(c.lean);
    SCOPED_TRACE(c.load);
    SCOPED_TRACE(c.rising);
    Feed feed = flying(0.3);
    feed(0.11, with_lift(0.9 * weight), 2.0);
    feed(0.11, with_lift(c.load * weight), 1.5);  // the filter follows
    EXPECT_TRUE(feed.contact.estimate().on_ground);
    feed.state.orientation =
        Eigen::Quaterniond(Eigen::AngleAxisd(c.lean, Eigen::Vector3d::UnitX()));
    feed.state.velocity.z() = c.rising;
    EXPECT_EQ(feed.stay(with_lift(c.load * weight), 0.05).on_ground, c.stands);
    if (c.stands) continue;
    EXPECT_FALSE(feed.stay(with_lift(0.8 * weight), 0.03).on_ground);  // the other wheel touches
    EXPECT_TRUE(feed.stay(with_lift(0.9 * weight), 0.4).on_ground);    // lands
  }
}

// A sample above ten times the weight is ignored, and is not part of the next mean.
TEST(ContactEstimator, AnOutlierIsIgnoredForOneUpdateOnly) {
  Feed feed = flying(3.0);
  feed.observed.raw.force.z() = feed.observed.external.force.z() = 1e4 * weight;
  feed.observed.add_to_sums(1e-3);
  feed.time += 0.01;
  feed.contact.update(feed.time, feed.state, feed.observed);
  EXPECT_FALSE(feed.contact.estimate().on_ground);
  const double mean = feed(3.0, breeze).external.force.x();
  EXPECT_NEAR(mean, feed.shown.force.x(), 1e-9);
  EXPECT_FALSE(feed.contact.estimate().on_ground);
}

TEST(ContactEstimator, WithoutUndercarriageTheWholeWrenchIsDisturbance) {
  Feed feed({}, std::nullopt);
  for (const double height : {3.0, 0.11, 0.0, -0.5}) {
    const Wrenchd load = with_lift(0.5 * weight, breeze);
    feed(height, load, 2.0);
    const ContactEstimate& e = feed.contact.estimate();
    EXPECT_FALSE(e.on_ground || e.ground_known);
    EXPECT_LT((e.disturbance.force - feed.shown.force).norm(), 1e-12);
    EXPECT_LT((e.disturbance.torque - feed.shown.torque).norm(), 1e-12);
    EXPECT_EQ(e.ground.height, -infinity);
  }
  EXPECT_EQ(feed.contact.mode_changes(), 0);
}

// An undercarriage that does not pitch hides the pitch torque of the air. An undercarriage that
// does not roll holds the vehicle in every direction.
TEST(ContactEstimator, GroundReactionFollowsUndercarriage) {
  const Wrenchd standing{Eigen::Vector3d(0.3, 0.1, 0.9 * weight), Eigen::Vector3d(0.2, 0.4, 0.1)};
  const auto on = [&standing](const Undercarriage& undercarriage) {
    Feed feed({}, undercarriage);
    feed(0.5, {}, 5.0);
    feed(0.11, standing, 3.0);
    return feed.contact.estimate();
  };
  const ContactEstimate axle = on(wheels), car = on({0.11, true, false, false}),
                        legs = on({0.11, false, false, false});
  EXPECT_TRUE(axle.on_ground && car.on_ground && legs.on_ground);
  EXPECT_NEAR(axle.disturbance.torque.y(), 0.4, 1e-3);
  EXPECT_NEAR(axle.rolling.torque.y(), 0.4, 1e-3);
  EXPECT_NEAR(car.disturbance.torque.y(), 0.0, 1e-3);
  EXPECT_EQ(car.rolling.torque.y(), 0.0);
  EXPECT_NEAR(car.rolling.force.x(), 0.3, 1e-3);
  EXPECT_NEAR(car.ground_reaction.torque.y(), 0.4, 1e-3);
  EXPECT_EQ(legs.rolling.force, Eigen::Vector3d::Zero());
  EXPECT_NEAR(legs.ground_reaction.force.x(), 0.3, 1e-3);
  EXPECT_NEAR(legs.ground_reaction.torque.z(), 0.1, 1e-3);
}

TEST(ContactEstimator, StartsInTheAirIfItHoversJustAboveTheGround) {
  Feed feed;
  EXPECT_FALSE(feed(0.13, {}).on_ground);
  EXPECT_FALSE(feed(0.13, with_lift(0.05 * weight), 0.5).on_ground);
  EXPECT_EQ(feed.contact.mode_changes(), 0);
}

TEST(ContactEstimator, LearnsSlopeFromAttitudeOfStandingBody) {
  const Eigen::Vector2d slope(0.1, -0.05);
  Feed feed({}, Undercarriage{0.11, false, false, false});
  feed(0.5, {}, 2.0);
  feed.state.orientation = Eigen::AngleAxisd(
      std::atan(slope.norm()), Eigen::Vector3d(slope.y(), -slope.x(), 0.0).normalized());
  feed(0.11, with_lift(0.9 * weight), 5.0);
  EXPECT_LT((feed.contact.estimate().ground.slope - slope).norm(), 1e-3);
}

TEST(ContactEstimator, HeightAloneIsNotContact) {
  Feed feed = flying(0.3);
  feed(0.11, {}, 1.0);  // at the expected ground, without load
  EXPECT_FALSE(feed.contact.estimate().on_ground);
  feed(0.05, {}, 1.0);  // the ground is not there
  EXPECT_EQ(feed.contact.estimate().ground.height, -infinity);
  feed(-0.4, with_lift(0.5 * weight), 0.2);
  EXPECT_TRUE(feed.contact.estimate().on_ground);
  EXPECT_NEAR(feed.contact.estimate().ground.height, -0.51, 1e-9);
}

TEST(ContactEstimator, StartsOnAssumedGround) {
  Feed feed;
  EXPECT_TRUE(feed(0.11, with_lift(0.2 * weight)).on_ground);
  EXPECT_EQ(feed.contact.mode_changes(), 0);
  Feed uncertain;  // a filter that has just started has a noisy velocity
  uncertain.state.velocity.z() = 0.2;
  EXPECT_TRUE(uncertain(0.11, with_lift(weight)).on_ground);
  GroundPlane nothing;
  nothing.height = -infinity;
  Feed nowhere(nothing);
  EXPECT_FALSE(nowhere(0.11, with_lift(0.2 * weight)).on_ground);
}

TEST(ContactEstimator, GustsAreNotContact) {
  Feed feed = flying(1.0);
  feed(1.0, with_lift(0.25 * weight), 0.5);
  EXPECT_FALSE(feed.contact.estimate().on_ground);
  feed.state.velocity.z() = 0.5;  // a strong gust lifts the vehicle
  feed.stay(with_lift(0.6 * weight), 0.5);
  EXPECT_FALSE(feed.contact.estimate().on_ground);
  EXPECT_EQ(feed.contact.mode_changes(), 0);
}

TEST(ContactEstimator, SmallerLoadIsContactNearTheGround) {
  Feed feed = flying(1.0);
  feed(0.13, {}, 1.0);
  feed(0.13, with_lift(0.15 * weight), 0.3);
  EXPECT_TRUE(feed.contact.estimate().on_ground);
  EXPECT_NEAR(feed.contact.estimate().ground.height, 0.02, 1e-9);
}

TEST(ContactEstimator, SplitsWrenchIntoGroundReactionAndRest) {
  Feed feed = flying(0.3, breeze);
  const Wrenchd on_it{Eigen::Vector3d(-0.3, 0.1, weight), Eigen::Vector3d(0.2, 0.05, -0.1)};
  feed(0.11, on_it, 5.0);
  const ContactEstimate& e = feed.contact.estimate();
  EXPECT_LT((e.rolling.force - Eigen::Vector3d(-0.3, 0.1, 0.0)).norm(), 1e-6);
  EXPECT_LT((e.rolling.torque - Eigen::Vector3d(0.0, 0.05, -0.1)).norm(), 1e-6);
  EXPECT_NEAR(e.ground_reaction.force.z(), weight, 1e-6);
  EXPECT_NEAR(e.ground_reaction.torque.x(), 0.2 - 0.01, 1e-3);
  // The disturbance in the air is kept, except for the pitch torque. The ground gives no pitch
  // torque, so this part is measured on the ground.
  EXPECT_NEAR(e.disturbance.force.x(), 0.4, 1e-3);
  EXPECT_NEAR(e.disturbance.torque.x(), 0.01, 1e-3);
  EXPECT_NEAR(e.disturbance.torque.y(), 0.05, 1e-6);
  EXPECT_NEAR(e.disturbance.force.z(), 0.0, 1e-9);
}

TEST(ContactEstimator, SplitsWrenchAlongWorldVerticalIfBodyIsPitched) {
  Feed feed = flying(0.3);
  feed.state.orientation = Eigen::AngleAxisd(0.4, Eigen::Vector3d::UnitY());
  const Eigen::Matrix3d to_body = feed.state.orientation.conjugate().toRotationMatrix();
  feed(0.11, {to_body * Eigen::Vector3d(0.3, 0.0, weight), Eigen::Vector3d::Zero()}, 5.0);
  const ContactEstimate& e = feed.contact.estimate();
  EXPECT_LT((e.rolling.force - to_body * Eigen::Vector3d(0.3, 0.0, 0.0)).norm(), 1e-6);
}

TEST(ContactEstimator, MissingLiftOnTheGroundIsDisturbance) {
  Feed feed;
  feed(0.11, with_lift(weight), 1.0);
  // The thrust rises to 115 % of the believed weight, and the vehicle still stands.
  for (double thrust = 0.0; thrust < 1.15; thrust += 0.02)
    feed(0.11, with_lift((1.0 - thrust) * weight));
  feed(0.11, with_lift(-0.15 * weight), 0.2);
  EXPECT_TRUE(feed.contact.estimate().on_ground);
  EXPECT_NEAR(feed.contact.estimate().disturbance.force.z(), -0.15 * weight, 0.01 * weight);
}

TEST(ContactEstimator, RemovesGroundReactionAtOnceAfterTakeOff) {
  Feed feed;
  feed(0.11, with_lift(weight, breeze), 1.0);
  const double air_lift = -0.1 * weight;
  for (int i = 0; i < 20; ++i)  // in 0.2 s, faster than the observer
    feed(0.11, with_lift(weight + (air_lift - weight) * i / 20.0, breeze));
  feed.state.velocity.z() = 0.3;
  feed.stay(with_lift(air_lift, breeze), 0.12);
  const ContactEstimate& e = feed.contact.estimate();
  ASSERT_FALSE(e.on_ground);
  EXPECT_GT(feed.shown.force.z(), 0.1 * weight);  // estimate of the observer
  EXPECT_NEAR(e.disturbance.force.z(), air_lift, 0.02 * weight);
  feed.stay(with_lift(air_lift, breeze), 2.0);
  EXPECT_NEAR(e.disturbance.force.z(), air_lift, 1e-3 * weight);
  EXPECT_NEAR(e.disturbance.force.x(), breeze.force.x(), 1e-3);
  EXPECT_EQ(feed.contact.mode_changes(), 1);
}

TEST(ContactEstimator, DetectsTakeOffOfVehicleLighterThanBelieved) {
  Feed feed;
  feed(0.11, with_lift(weight), 1.0);
  feed(0.11, with_lift(0.25 * weight), 0.5);
  feed.state.velocity.z() = 0.3;  // the apparent lift is a quarter of the weight
  feed.stay(with_lift(0.25 * weight), 0.2);
  EXPECT_FALSE(feed.contact.estimate().on_ground);
  EXPECT_NEAR(feed.contact.estimate().disturbance.force.z(), 0.25 * weight, 0.02 * weight);
}

// After a long time without load (take-off) the estimator predicts the height from the speed. After
// a short time without load (hop over a plank) it does not.
TEST(ContactEstimator, DetectsTakeOffBeforeLeaveHeight) {
  const auto rise = [](double unloaded) {
    Feed feed;
    feed.bandwidth = 1e3;  // no lag
    feed(0.11, with_lift(weight), 1.0);
    feed.stay({}, unloaded);
    EXPECT_TRUE(feed.contact.estimate().on_ground);
    feed.state.velocity.z() = 0.2;  // 2 cm in 0.1 s
    feed(0.11, {}, 0.03);
    EXPECT_TRUE(feed.contact.estimate().on_ground);
    feed(0.11 + 0.012, {});
    return feed.contact.estimate().on_ground;
  };
  EXPECT_FALSE(rise(0.4));
  EXPECT_TRUE(rise(0.1));
}

TEST(ContactEstimator, FollowsJumpsAndDriftOfHeightEstimate) {
  Feed feed;
  feed(0.11, with_lift(weight), 1.0);
  feed(0.21, with_lift(weight), 1.0);
  EXPECT_TRUE(feed.contact.estimate().on_ground);
  EXPECT_NEAR(feed.contact.estimate().ground.height, 0.10, 1e-4);
  for (int i = 0; i < 1000; ++i) feed(0.21 - 1e-4 * i, with_lift(weight));
  EXPECT_NEAR(feed.contact.estimate().ground.height, 0.0, 2e-3);
  EXPECT_EQ(feed.contact.mode_changes(), 0);
}

TEST(ContactEstimator, ForgetsGroundFarBelowIt) {
  Feed feed;
  feed(0.11, with_lift(weight), 1.0);  // a roof
  feed(0.11, {}, 1.0);
  feed(2.0, {}, 2.0);
  EXPECT_TRUE(feed.contact.estimate().ground_known);
  feed(-0.05, {}, 1.0);  // the ground is lower than estimated, without contact
  EXPECT_TRUE(feed.contact.estimate().ground_known);
  EXPECT_NEAR(feed.contact.estimate().ground.height, 0.0, 1e-6);
  feed(-0.3, {}, 0.1);
  EXPECT_FALSE(feed.contact.estimate().ground_known);
  EXPECT_EQ(feed.contact.estimate().ground.height, -infinity);
  feed(-5.0, with_lift(weight), 0.2);
  EXPECT_NEAR(feed.contact.estimate().ground.height, -5.11, 1e-9);
  EXPECT_EQ(feed.contact.mode_changes(), 2);
}

TEST(ContactEstimator, LearnsSlopeFromAxleAndDirectionOfMotion) {
  Feed feed;
  feed(0.11, with_lift(weight), 1.0);
  feed.state.orientation = Eigen::AngleAxisd(0.1, Eigen::Vector3d::UnitX());
  feed.state.velocity << 1.0, 0.0, -0.15;
  feed.stay(with_lift(weight), 3.0);
  const GroundPlane& ground = feed.contact.estimate().ground;
  EXPECT_NEAR(ground.slope.x(), -0.15, 1e-3);
  EXPECT_NEAR(ground.slope.y(), std::tan(0.1), 1e-3);
  EXPECT_NEAR(ground.height_at(feed.state.position) + 0.11, feed.state.position.z(), 1e-3);
  EXPECT_EQ(feed.contact.mode_changes(), 0);
}

// The slope's downhill force belongs to the ground. The remaining force is the rolling resistance.
TEST(ContactEstimator, DownhillForceIsGroundReaction) {
  Feed feed;
  feed(0.11, with_lift(weight), 1.0);
  feed.state.velocity << 1.0, 0.0, 0.1;
  const Wrenchd pushed{Eigen::Vector3d(-0.1 * weight - 0.3, 0.0, weight - 0.03),
                       Eigen::Vector3d::Zero()};
  feed.stay(pushed, 5.0);
  const ContactEstimate& e = feed.contact.estimate();
  EXPECT_LT((e.ground_reaction.force - Eigen::Vector3d(-0.1 * weight, 0.0, weight)).norm(), 1e-3);
  EXPECT_LT((e.rolling.force - Eigen::Vector3d(-0.3, 0.0, -0.03)).norm(), 1e-3);
}

TEST(ContactEstimator, IgnoresNonFiniteAndOutOfOrderInput) {
  Feed feed;
  feed(0.11, with_lift(weight), 0.5);
  const ContactEstimate before = feed.contact.estimate();
  const double nan = std::nan("");
  const Eigen::Vector3d k = Eigen::Vector3d::Constant(5.0);
  BodyStated lost = feed.state;
  lost.position.z() = nan;
  feed.contact.update(feed.time + 0.01, lost, feed.observed);
  ObservedWrenchd bad = feed.observed;
  bad.external = {k * nan, k};
  feed.contact.update(feed.time + 0.01, feed.state, bad);
  bad.raw_sum = bad.external;
  bad.add_to_sums(0.01);
  feed.contact.update(feed.time + 0.01, feed.state, bad);
  feed.contact.update(nan, feed.state, feed.observed);
  lost.position.z() = 3.0;
  feed.contact.update(feed.time, lost, feed.observed);
  feed.contact.update(feed.time - 1.0, lost, feed.observed);
  const ContactEstimate& after = feed.contact.estimate();
  EXPECT_EQ(after.on_ground, before.on_ground);
  EXPECT_EQ(after.ground.height, before.ground.height);
  EXPECT_EQ(after.disturbance.force, before.disturbance.force);
  EXPECT_TRUE(is_finite(after));
}

}  // namespace contact_estimator_test
}  // namespace tilt_ropter
