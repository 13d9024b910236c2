#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>

namespace tilt_ropter {
namespace {

const Vehicle<4> vehicle = tilt_ropter_vehicle();
const RigidBodyParameters body = vehicle.body;

ReferencePoint hover(double) {
  ReferencePoint point;
  point.position << 0.0, 0.0, 1.5;
  return point;
}

BodyState<> hovering() {
  BodyState<> state;
  state.position << 0.0, 0.0, 1.5;
  return state;
}

void expect_within_bounds(const NmpcResult& result, const NmpcBounds& bounds) {
  EXPECT_TRUE(is_finite(result.wrench));
  EXPECT_TRUE(is_finite(result.rate));
  EXPECT_TRUE((result.wrench.force.array() <= bounds.force_max.array()).all());
  EXPECT_TRUE((result.wrench.force.array() >= bounds.force_min.array()).all());
  EXPECT_TRUE((result.wrench.torque.array() <= bounds.torque_max.array()).all());
  EXPECT_TRUE((result.wrench.torque.array() >= bounds.torque_min.array()).all());
}

// A rigid body that gets exactly the wrench that is planned, with an unknown force.
class IdealLoop {
 public:
  explicit IdealLoop(const NmpcSettings& settings = {}) : nmpc(vehicle, settings) {
    state.body = hovering();
  }

  template <typename Reference>
  const NmpcResult& tick(const Reference& reference, const Wrench<>& estimate = {},
                         bool blind = false) {
    nmpc.prepare(time, reference, estimate);
    BodyState<> measured = state.body;
    if (blind) measured.velocity.x() = std::numeric_limits<double>::quiet_NaN();
    const NmpcResult& result = nmpc.feedback(time, measured);
    state.wrench = result.wrench;
    Eigen::Matrix<double, 6, 1> rate;
    rate << result.rate.force, result.rate.torque;
    state = plant.step(state, rate, unknown, 0.01);
    time += 0.01;
    return result;
  }

  RigidBody<> plant{body};
  Nmpc<4> nmpc;
  State<> state;
  Wrench<> unknown;
  double time = 0.0;
};

TEST(Nmpc, HoldsHoverAndReturnsToIt) {
  IdealLoop loop;
  loop.state.body.position += Eigen::Vector3d(0.3, -0.2, 0.2);
  for (int i = 0; i < 500; ++i) ASSERT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  EXPECT_LT((loop.state.body.position - hovering().position).norm(), 2e-3);
}

TEST(Nmpc, KnownExternalForceLeavesNoOffset) {
  IdealLoop loop;
  loop.unknown.force << 0.8, -0.5, -1.0;
  for (int i = 0; i < 500; ++i) (void)loop.tick(hover, loop.unknown);
  EXPECT_LT((loop.state.body.position - hovering().position).norm(), 1e-4);

  IdealLoop without_estimate;
  without_estimate.unknown = loop.unknown;
  for (int i = 0; i < 500; ++i) (void)without_estimate.tick(hover);
  EXPECT_GT((without_estimate.state.body.position - hovering().position).norm(), 1e-3);
}

TEST(Nmpc, WithoutFeedforwardTheReferenceWrenchIsThePapers) {
  IdealLoop loop(paper_nmpc_settings());
  (void)loop.tick(hover, {Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d::Zero()});
  const WheeledFlightNode& node = loop.nmpc.solver().problem().node(3);
  EXPECT_EQ(node.wrench_reference.force, Eigen::Vector3d(0.0, 0.0, body.mass * gravity));
  EXPECT_EQ(node.wrench_reference.torque, Eigen::Vector3d::Zero());
  IdealLoop ours;
  for (int i = 0; i < 2; ++i)
    (void)ours.tick(hover, {Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d::Zero()});
  EXPECT_LT((ours.nmpc.solver().problem().node(3).wrench_reference.force -
             Eigen::Vector3d(-1.0, -2.0, body.mass * gravity - 3.0))
                .norm(),
            1e-12);
}

TEST(Nmpc, PaperPresetIsThePapersTable) {
  const NmpcSettings s = paper_nmpc_settings();
  EXPECT_EQ(s.problem.intervals, 20);
  EXPECT_DOUBLE_EQ(s.problem.interval, 0.1);
  EXPECT_EQ(s.problem.bounds.force_max, Eigen::Vector3d(0.2, 0.2, 20.0));
  EXPECT_EQ(s.problem.bounds.force_min, Eigen::Vector3d(-0.2, -0.2, 0.0));
  EXPECT_EQ(s.problem.bounds.torque_max, Eigen::Vector3d(20.0, 20.0, 20.0));
  EXPECT_EQ(s.problem.bounds.force_rate, Eigen::Vector3d(2.0, 2.0, 2.0));
  EXPECT_EQ(s.problem.bounds.torque_rate, Eigen::Vector3d(2.0, 2.0, 2.0));
  EXPECT_EQ(s.problem.bounds.angular_velocity, Eigen::Vector3d(2.0, 2.0, 1.5));
}

TEST(Nmpc, ABadMeasurementContinuesTheLastPlanWithinBounds) {
  IdealLoop loop;
  loop.state.body.position.x() = 0.5;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  const Wrench<> before = loop.state.wrench;
  for (int i = 0; i < 10; ++i) {
    const NmpcResult& result = loop.tick(hover, {}, true);
    EXPECT_EQ(result.status, NmpcStatus::bad_state);
    expect_within_bounds(result, loop.nmpc.settings().problem.bounds);
  }
  EXPECT_GT((loop.state.wrench.force - before.force).norm(), 1e-6);  // the plan moved on
  for (int i = 0; i < 300; ++i) EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  EXPECT_LT((loop.state.body.position - hovering().position).norm(), 5e-3);
}

TEST(Nmpc, APlanThatIsTooOldGivesWayToTheSafeWrench) {
  IdealLoop loop;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  NmpcStatus status = NmpcStatus::solved;
  for (int i = 0; i < 30; ++i) status = loop.tick(hover, {}, true).status;
  EXPECT_EQ(status, NmpcStatus::no_plan);
  EXPECT_NEAR(loop.state.wrench.force.z(), body.mass * gravity, 0.1);
  for (int i = 0; i < 300; ++i) EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
}

TEST(Nmpc, ABadReferenceOrEstimateFailsWithAFiniteCommandAndRecovers) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  IdealLoop loop;
  for (int i = 0; i < 20; ++i) (void)loop.tick(hover);
  const auto lost = [&](double t) {
    ReferencePoint point = hover(t);
    point.position.y() = nan;
    return point;
  };
  for (int i = 0; i < 5; ++i) {
    const NmpcResult& result = loop.tick(lost);
    EXPECT_EQ(result.status, NmpcStatus::solver_failed);
    expect_within_bounds(result, loop.nmpc.settings().problem.bounds);
  }
  EXPECT_EQ(loop.tick(hover).status, NmpcStatus::solved);
  // An estimate that is not finite is not used.
  EXPECT_EQ(loop.tick(hover, {Eigen::Vector3d(nan, 0, 0), Eigen::Vector3d::Zero()}).status,
            NmpcStatus::solved);
}

TEST(Nmpc, FirstMeasurementBadGivesTheSafeWrench) {
  Nmpc nmpc(vehicle);
  nmpc.prepare(0.0, hover, {});
  BodyState<> bad = hovering();
  bad.orientation.coeffs().setZero();
  const NmpcResult& result = nmpc.feedback(0.0, bad);
  EXPECT_EQ(result.status, NmpcStatus::no_plan);
  expect_within_bounds(result, nmpc.settings().problem.bounds);
}

TEST(Nmpc, OnTheGroundItTakesTheWeightOffTheRotors) {
  // Down on the ground the estimate is the normal force, whatever the thrust.
  NmpcSettings settings;
  Nmpc nmpc(vehicle, settings);
  BodyState<> standing;
  standing.position.z() = vehicle.wheels.radius;
  const auto rest = [&](double) {
    ReferencePoint point;
    point.position = standing.position;
    return point;
  };
  Wrench<> wrench;
  for (int i = 0; i < 600; ++i) {
    const double time = 0.01 * i;
    Wrench<> normal;
    normal.force.z() = std::max(0.0, body.mass * gravity - wrench.force.z());
    nmpc.prepare(time, rest, normal);
    const NmpcResult& result = nmpc.feedback(time, standing);
    ASSERT_EQ(result.status, NmpcStatus::solved);
    EXPECT_TRUE(result.on_ground);
    wrench = result.wrench;
  }
  EXPECT_NEAR(wrench.force.z(), settings.ground.down_force, 0.1);
}

TEST(Nmpc, TheCommandIsCutToTheBoundsWhateverThePlanSays) {
  // A plan may give up a bound (here the box of the force shrinks to what the start is out of); the
  // command may not.
  NmpcSettings settings;
  settings.problem.bounds.force_min.z() = 0.0;
  settings.problem.bounds.force_max.z() = 10.0;  // less than the weight: the safe wrench is cut
  Nmpc nmpc(vehicle, settings);
  BodyState<> bad = hovering();
  bad.position.x() = std::nan("");
  nmpc.prepare(0.0, hover, {});
  const NmpcResult cut = nmpc.feedback(0.0, bad);
  EXPECT_EQ(cut.status, NmpcStatus::no_plan);
  EXPECT_DOUBLE_EQ(cut.wrench.force.z(), 10.0);
}

TEST(Nmpc, SoManyFailuresInARowDropTheWarmStart) {
  const auto iterate_after_failures = [](int failures_before_reset) {
    NmpcSettings settings;
    settings.failures_before_reset = failures_before_reset;
    settings.max_plan_age = 1.0;
    IdealLoop loop(settings);
    loop.state.body.position.x() = 0.5;
    for (int i = 0; i < 30; ++i) (void)loop.tick(hover);
    for (int i = 0; i < 3; ++i) (void)loop.tick(hover, {}, true);
    (void)loop.tick(hover);
    return loop.nmpc.solver().report().kkt;  // of the iterate that the tick started from
  };
  // A cold start begins with the whole horizon at the measured state, far from optimal.
  EXPECT_GT(iterate_after_failures(3), 10.0 * iterate_after_failures(4));
}

TEST(Nmpc, SettingsOutOfRangeAreRefusedByName) {
  const auto message = [](const NmpcSettings& settings) -> std::string {
    try {
      Nmpc nmpc(vehicle, settings);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "accepted";
  };
  NmpcSettings s;
  s.max_plan_age = 0.0;
  EXPECT_NE(message(s).find("NmpcSettings.max_plan_age"), std::string::npos);
  s = {};
  s.failures_before_reset = 0;
  EXPECT_NE(message(s).find("NmpcSettings.failures_before_reset = 0"), std::string::npos);
}

}  // namespace
}  // namespace tilt_ropter
