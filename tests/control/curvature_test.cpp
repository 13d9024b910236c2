// add_curvature() of both control levels against differences of the exact first derivatives.

#include <tilt_ropter/control/detail/actuator_level_problem.hpp>
#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/math/detail/finite.hpp>

#include "support/random.hpp"
#include "support/states.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Eigenvalues>

#include <algorithm>

namespace tilt_ropter {
namespace curvature_test {

using test_support::Random;

/// Second derivatives by the state of costate' step(x), by differences of A' costate.
template <typename Problem>
typename Problem::StateJacobian second_derivatives(const Problem& problem,
                                                   const typename Problem::State& x,
                                                   const typename Problem::Tangent& costate) {
  using Tangent = typename Problem::Tangent;
  const auto gradient = [&](const Tangent& d) -> Tangent {
    typename Problem::StateJacobian A;
    typename Problem::InputJacobian B;
    (void)problem.step(0, problem.retract(x, d), Problem::Input::Zero(), A, B);
    return A.transpose() * costate;
  };
  const double length = 1e-4;
  typename Problem::StateJacobian derivatives;
  for (int j = 0; j < Problem::states; ++j)
    derivatives.col(j) =
        (gradient(length * Tangent::Unit(j)) - gradient(-length * Tangent::Unit(j))) /
        (2.0 * length);
  // The tangent coordinates at retract(x, d) are turned by d / 2, which is antisymmetric.
  return 0.5 * (derivatives + derivatives.transpose());
}

template <typename Problem>
typename Problem::StateJacobian curvature_of(const Problem& problem,
                                             const typename Problem::State& x,
                                             const typename Problem::Constraints& multipliers,
                                             const typename Problem::Tangent& costate) {
  typename Problem::Model model;
  problem.add_curvature(0, x, Problem::Input::Zero(), multipliers, costate, model);
  EXPECT_EQ(model.gradient.norm(), 0.0);
  EXPECT_EQ(model.luu().norm() + model.lux().norm(), 0.0);
  return model.lxx();
}

void expect_convex(const Eigen::MatrixXd& curvature) {
  EXPECT_TRUE(all_finite(curvature));
  EXPECT_LT((curvature - curvature.transpose()).norm(), 1e-12 * (1.0 + curvature.norm()));
  EXPECT_GT(Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(curvature).eigenvalues().minCoeff(),
            -1e-12 * (1.0 + curvature.norm()));
}

// Positions and velocities of the costate that ask for a force along `wanted` (body frame).
template <typename Problem>
typename Problem::Tangent costate_along(const Eigen::Vector3d& wanted, const BodyStated& body,
                                        Random& random, int position, int velocity) {
  typename Problem::Tangent costate = Problem::Tangent::Zero();
  const Eigen::Vector3d in_world = -(body.orientation * wanted);
  costate.template segment<3>(position) = random.uniform(0.0, 100.0) * in_world;
  costate.template segment<3>(velocity) = random.uniform(0.0, 100.0) * in_world;
  return costate;
}

TEST(Curvature, OfTheForceIsExactButForTheConcavePart) {
  using I = TangentIndex;
  Random random(61);
  const WheeledFlightProblem<4> problem(tilt_ropter_vehicle().body);
  for (int i = 0; i < 200; ++i) {
    Stated x = test_support::random_state(random);
    x.body.angular_velocity.setZero();  // the force then has one direction during the step
    x.wrench.torque.setZero();
    const Eigen::Vector3d force = x.wrench.force, e = force.normalized();
    const auto costate =
        costate_along<WheeledFlightProblem<4>>(e, x.body, random, I::position, I::velocity);
    auto multipliers = WheeledFlightProblem<4>::Constraints::Zero().eval();
    EXPECT_EQ(curvature_of(problem, x, multipliers, costate).norm(), 0.0);
    multipliers(WheeledFlightProblem<4>::Part::force + 2) = 1.0;  // a limit acts
    const auto curvature = curvature_of(problem, x, multipliers, costate);
    auto expected = second_derivatives(problem, x, costate);
    expect_convex(curvature);
    const Eigen::Matrix3d across = Eigen::Matrix3d::Identity() - e * e.transpose();
    const double turning = curvature.block<3, 3>(I::orientation, I::orientation).trace() / 2.0;
    EXPECT_GT(turning, 0.0);
    expected.block<3, 3>(I::force, I::force) += turning / force.squaredNorm() * across;
    for (const int row : {I::force, I::orientation})
      for (const int column : {I::force, I::orientation})
        EXPECT_LT((curvature.block<3, 3>(row, column) - expected.block<3, 3>(row, column)).norm(),
                  1e-5 * (1.0 + expected.norm()));
  }
}

TEST(Curvature, OfTheThrustsIsExactForParallelRotors) {
  using Problem = ActuatorLevelProblem<4>;
  using I = ActuatedIndex<4>;
  Random random(62);
  ActuatorLevelSettings settings;
  settings.interval = 0.005;  // the thrusts hardly turn the body during the step
  const Problem problem(tilt_ropter_vehicle(), settings);
  for (int i = 0; i < 200; ++i) {
    Problem::State x;
    x.thrust.setConstant(random.uniform(0.5, 10.0));
    x.tilt_angle.setZero();
    x.body = test_support::random_state(random).body;
    x.body.angular_velocity.setZero();
    const auto costate =
        costate_along<Problem>(Eigen::Vector3d::UnitZ(), x.body, random, I::position, I::velocity);
    auto multipliers = Problem::Constraints::Zero().eval();
    EXPECT_EQ(curvature_of(problem, x, multipliers, costate).norm(), 0.0);
    multipliers(Problem::Part::thrust) = 1.0;  // a limit acts
    const auto curvature = curvature_of(problem, x, multipliers, costate);
    const auto expected = second_derivatives(problem, x, costate);
    expect_convex(curvature);
    EXPECT_GT(curvature.norm(), 0.0);
    // The angular velocity turns the force during the step: one order of the interval smaller.
    for (int row = 0; row < I::angular_velocity; ++row)
      for (int column = 0; column < I::angular_velocity; ++column)
        EXPECT_NEAR(curvature(row, column), expected(row, column), 1e-3 * curvature.norm())
            << row << ", " << column;
  }
}

// A state far from the case in which the formulas are exact.
template <typename Problem, typename RandomState>
void expect_safe(const Problem& problem, const RandomState& random_state, Random& random) {
  for (int i = 0; i < 300; ++i) {
    const auto x = random_state();
    typename Problem::Tangent costate;
    for (int j = 0; j < Problem::states; ++j) costate(j) = random.uniform(-1e4, 1e4);
    typename Problem::Constraints multipliers;
    for (int j = 0; j < Problem::constraints; ++j) multipliers(j) = random.uniform(-1e4, 1e4);
    expect_convex(curvature_of(problem, x, multipliers, costate));

    typename Problem::Model fresh, used;
    problem.cost_model(0, x, Problem::Input::Zero(), fresh);
    problem.cost_model(0, x, Problem::Input::Zero(), used);
    problem.add_curvature(0, x, Problem::Input::Zero(), multipliers, costate, used);
    problem.cost_model(0, x, Problem::Input::Zero(), used);
    EXPECT_EQ((fresh.hessian - used.hessian).norm(), 0.0) << "cost_model() leaves curvature";
  }
}

TEST(Curvature, IsConvexForAnyStateAndLeavesNoTrace) {
  Random random(63);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  for (const TerminalCost terminal : {TerminalCost::weights, TerminalCost::riccati}) {
    WheeledFlightSettings settings;
    settings.terminal_cost = terminal;
    expect_safe(
        WheeledFlightProblem<4>(vehicle.body, settings, ActuatorConstraints<4>(vehicle)),
        [&] { return test_support::random_state(random); }, random);
    expect_safe(
        WheeledFlightProblem<0>(vehicle.body, settings),
        [&] {
          Stated x = test_support::random_state(random);
          x.wrench.force *= random.uniform(0.0, 1.0) < 0.1 ? 0.0 : 1.0;
          return x;
        },
        random);
  }
  expect_safe(
      ActuatorLevelProblem<4>(vehicle),
      [&] {
        ActuatedState<4> x;
        for (int i = 0; i < 4; ++i) {
          x.thrust(i) = random.uniform(-1.0, 12.0);
          x.tilt_angle(i) = random.uniform(-3.0, 3.0);
        }
        x.body = test_support::random_state(random).body;
        return x;
      },
      random);
}

}  // namespace curvature_test
}  // namespace tilt_ropter
