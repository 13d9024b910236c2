#include <tilt_ropter/control/detail/actuator_level_problem.hpp>

#include "support/autodiff.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/refusals.hpp"
#include "support/states.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace actuator_level_problem_test {

using test_support::Dual;
using test_support::Random;
using Problem = ActuatorLevelProblem<4>;
using D = Problem::D;
constexpr int nx = Problem::states, nu = Problem::inputs;

Problem random_problem(Random& random) {
  ActuatorLevelSettings settings;
  settings.weights.orientation << 30.0, 20.0, 10.0;
  Problem problem(tilt_ropter_vehicle(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    Problem::Node& node = problem.node(k);
    node.reference = test_support::random_state(random).body;
    node.external = {random.vector(1.0), random.vector(0.1)};
    node.on_ground = true;
    node.stays_on_ground = random.uniform(0.0, 1.0) < 0.5;
    node.com_plane = {0.1, {0.05, -0.02}};
    node.roll_axis << 0.8, 0.0, 0.6;
    node.freedom.angular = held_about(node.roll_axis, tilt_ropter_vehicle().body.inertia.inverse());
    node.steering = {random.vector(1.5), k % 2 == 0 ? 0.0 : 1.0};
    for (int i = 0; i < 4; ++i) {
      node.lateral_reference(i) = random.uniform(-4.0, 4.0);
      node.vertical_reference(i) = random.uniform(-4.0, 4.0);
    }
  }
  return problem;
}

Problem::State random_actuated(Random& random) {
  Problem::State x;
  x.body = test_support::random_state(random).body;
  for (int i = 0; i < 4; ++i) {
    x.thrust(i) = random.uniform(0.0, 12.0);
    x.tilt_angle(i) = random.uniform(-3.0, 3.0);
  }
  return x;
}

Problem::Input random_input(Random& random) {
  Problem::Input u;
  for (int i = 0; i < nu; ++i) u(i) = random.uniform(-8.0, 8.0);
  return u;
}

template <typename S>
ActuatedState<4, S> moved(const Problem::State& x, const ActuatedTangent<4, S>& dx) {
  Stated body;
  body.body = x.body;
  ActuatedState<4, S> lifted;
  lifted.thrust = x.thrust.cast<S>();
  lifted.tilt_angle = x.tilt_angle.cast<S>();
  lifted.body = test_support::cast<S>(body).body;
  return retract(lifted, dx);
}

// Errors times the square roots of their weights, as the settings define them.
template <typename S>
Eigen::Matrix<S, 20, 1> residual(const ActuatedState<4, S>& x, const Problem::Node& node,
                                 const ActuatorLevelWeights& w) {
  using std::cos;
  using std::sin;
  Eigen::Quaternion<S> turn =
      x.body.orientation * Eigen::Quaternion<S>(node.reference.orientation.conjugate().cast<S>());
  Vector3<S> eq = S(2) * turn.vec();
  if (turn.w() < S(0)) eq = -eq;
  Eigen::Matrix<S, 20, 1> e;
  e << x.body.position - node.reference.position.cast<S>(),
      x.body.velocity - node.reference.velocity.cast<S>(), eq,
      x.body.angular_velocity - node.reference.angular_velocity.cast<S>(),
      Eigen::Matrix<S, 8, 1>::Zero();
  const Eigen::Vector3d weights[] = {w.position, w.velocity, w.orientation, w.angular_velocity};
  for (int i = 0; i < 12; ++i) e(i) = e(i) * S(std::sqrt(weights[i / 3](i % 3)));
  for (int i = 0; i < 4; ++i) {
    const S root(std::sqrt(node.stays_on_ground ? w.thrust_on_ground : w.thrust));
    e(12 + i) = root * (x.thrust(i) * sin(x.tilt_angle(i)) - S(node.lateral_reference(i)));
    e(16 + i) = root * (x.thrust(i) * cos(x.tilt_angle(i)) - S(node.vertical_reference(i)));
  }
  return e;
}

template <typename Value, typename Truth>
double relative(const Value& value, const Truth& truth) {
  return (value - truth).cwiseAbs().maxCoeff() / truth.cwiseAbs().maxCoeff();
}

TEST(ActuatorLevelProblem, CostModelIsTheGaussNewtonModelOfTheCost) {
  Random random(41);
  using S = Dual<nx>;
  double worst = 0.0;
  for (int i = 0; i < test_support::quick_or_full(50, 10000); ++i) {
    const Problem problem = random_problem(random);
    const int k = i % 2 == 0 ? 3 : problem.horizon();
    const ActuatorLevelWeights& w = problem.settings().weights;
    const Problem::State x = random_actuated(random);
    const Problem::Input u = random_input(random);
    const Eigen::Matrix<double, 20, nx> jacobian = test_support::jacobian_at_zero<20, nx>(
        [&](const Eigen::Matrix<S, nx, 1>& d) -> Eigen::Matrix<S, 20, 1> {
          return residual<S>(moved<S>(x, d), problem.node(k), w);
        });
    const Eigen::Matrix<double, 20, 1> e = residual<double>(x, problem.node(k), w);
    const double factor = k == problem.horizon() ? w.terminal : 1.0;
    Problem::Model model;
    problem.cost_model(k, x, u, model);
    const Eigen::Matrix<double, nx, nx> hessian = 2.0 * factor * jacobian.transpose() * jacobian;
    const Eigen::Matrix<double, nx, 1> gradient = 2.0 * factor * jacobian.transpose() * e;
    worst = std::max({worst, relative(model.lxx(), hessian), relative(model.lx(), gradient)});
    double cost = factor * e.squaredNorm();
    if (k < problem.horizon()) {
      Problem::Input r;
      r << Eigen::Vector4d::Constant(w.thrust_rate), Eigen::Vector4d::Constant(w.tilt_rate);
      cost += u.dot(r.cwiseProduct(u));
      EXPECT_LT((model.lu() - 2.0 * r.cwiseProduct(u)).norm(), 1e-12);
    }
    EXPECT_NEAR(problem.cost(k, x, u), cost, 1e-12 * cost);
  }
  EXPECT_LT(worst, 1e-12);
}

TEST(ActuatorLevelProblem, DerivativesOfConstraintsAndGroundConditionsAreExact) {
  Random random(42);
  using S = Dual<nx>;
  for (int i = 0; i < 50; ++i) {
    const Problem problem = random_problem(random);
    const Problem::State x = random_actuated(random);
    const Problem::Input u = random_input(random);
    D::ConstraintsX C = D::ConstraintsX::Zero();
    D::ConstraintsU E = D::ConstraintsU::Zero();
    problem.constraint_derivatives(2, x, u, C, E);
    D::Tangent dx = D::Tangent::Random() * 0.1;
    Problem::Input du = random_input(random);
    const D::Constraints change = problem.constraint_values(2, problem.retract(x, dx), u + du) -
                                  problem.constraint_values(2, x, u);
    EXPECT_LT((change - C * dx - E * du).norm(), 1e-12);  // the constraints are linear

    const auto& plane = problem.node(2).com_plane;
    const Eigen::Matrix<double, 3, nx> truth = test_support::jacobian_at_zero<3, nx>(
        [&](const Eigen::Matrix<S, nx, 1>& d) -> Eigen::Matrix<S, 3, 1> {
          const auto y = moved<S>(x, d).body;
          const Vector3<S> velocity = y.orientation.conjugate() * y.velocity;
          const Vector3<S>& p = y.position;
          const Eigen::Vector3d& roll = problem.node(2).roll_axis;
          return {
              velocity.y(),
              S(roll.x()) * y.angular_velocity.x() + S(roll.z()) * y.angular_velocity.z(),
              p.z() - S(plane.height) - S(plane.slope.x()) * p.x() - S(plane.slope.y()) * p.y()};
        });
    D::EqualitiesX H;
    problem.equality_derivatives(2, x, H);
    EXPECT_LT(relative(H, truth), 1e-12);
  }
}

TEST(ActuatorLevelProblem, DeclaredTransitionPatternMatchesTheDerivatives) {
  Random random(43);
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.body.inertia << 0.014, 0.001, 0.002, 0.001, 0.018, -0.001, 0.002, -0.001, 0.025;
  Problem problem(vehicle);
  Eigen::Matrix<double, nx, nx + nu> seen = Eigen::Matrix<double, nx, nx + nu>::Zero();
  for (int i = 0; i < 50; ++i) {
    Problem::Node& node = problem.node(0);
    node.freedom = {};
    if (i % 2 == 0)
      node.freedom.linear << random.vector(1.0), random.vector(1.0), random.vector(1.0);
    node.freedom.angular(0, 0) = i % 3 == 0 ? 0.0 : 1.0;
    D::A A;
    D::B B;
    (void)problem.step(0, random_actuated(random), random_input(random), A, B);
    Eigen::Matrix<double, nx, nx + nu> both;
    both << A, B;
    seen += both.cwiseAbs();
  }
  for (int row = 0; row < nx; ++row)
    for (int column = 0; column < nx + nu; ++column)
      EXPECT_EQ(seen(row, column) != 0.0, Problem::TransitionPattern::nonzero(row, column))
          << row << ' ' << column;
}

TEST(ActuatorLevelProblem, BoundsAreThoseOfTheActuators) {
  Vehicle<4> vehicle = with_weak_rotor(tilt_ropter_vehicle(), 1, 0.5);
  vehicle.rotors[2].tilts = false;
  vehicle.rotor.min_thrust = 0.2;
  vehicle.servo.min_angle = -1.0;
  vehicle.servo.max_angle = 0.5;
  ActuatorLevelSettings settings;
  settings.bounds.tilt_rate_fraction = 0.5;
  Problem problem(vehicle, settings);
  using Part = Problem::Part;
  constexpr double infinity = std::numeric_limits<double>::infinity();
  EXPECT_EQ(problem.lower(3)(Part::thrust), 0.2);
  EXPECT_EQ(problem.upper(3)(Part::thrust), 12.0);
  EXPECT_EQ(problem.lower(3)(Part::thrust + 1), 0.1);
  EXPECT_EQ(problem.upper(3)(Part::thrust + 1), 6.0);
  EXPECT_EQ(problem.lower(3)(Part::tilt_angle), -1.0);
  EXPECT_EQ(problem.upper(3)(Part::tilt_angle), 0.5);
  EXPECT_EQ(problem.upper(3)(Part::tilt_angle + 2), infinity);
  EXPECT_EQ(problem.upper(0)(Part::rate + 4), 4.0);
  EXPECT_EQ(problem.lower(0)(Part::rate + 4), -4.0);
  EXPECT_EQ(problem.upper(0)(Part::thrust), infinity);
  EXPECT_EQ(problem.upper(problem.horizon())(Part::rate), infinity);
  EXPECT_EQ(problem.penalty(0)(Part::rate), infinity);
  problem.set_max_thrust(Eigen::Vector4d(5.0, 5.0, 20.0, 0.0));
  EXPECT_EQ(problem.upper(3).segment<4>(Part::thrust), Eigen::Vector4d(5.0, 5.0, 12.0, 0.2));
}

TEST(ActuatorLevelProblem, ChecksItsSettings) {
  const ActuatorLevelSettings valid;
  Problem problem(tilt_ropter_vehicle(), valid);
  const auto expect_refused = [&](const char* name, bool by_constructor,
                                  void (*spoil)(ActuatorLevelSettings&)) {
    ActuatorLevelSettings settings = valid;
    spoil(settings);
    if (by_constructor)
      test_support::expect_refused(name, [&] { Problem(tilt_ropter_vehicle(), settings); });
    test_support::expect_refused(name, [&] { problem.set_settings(settings); });
  };
  expect_refused("FlightWeights.terminal", true, [](auto& s) { s.weights.terminal = 0.0; });
  expect_refused("HorizonSettings.intervals", false, [](auto& s) { s.intervals = 19; });
  expect_refused("HorizonSettings.intervals", false, [](auto& s) { s.intervals = 21; });
  expect_refused("HorizonSettings.interval [s]", false, [](auto& s) { s.interval = 0.05; });
  expect_refused("HorizonSettings.interval [s]", false, [](auto& s) { s.interval = 0.2; });
}

}  // namespace actuator_level_problem_test
}  // namespace tilt_ropter
