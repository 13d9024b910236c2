#include <tilt_ropter/optimal_control/detail/trajectory.hpp>

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>

#include "support/benchmark_problem.hpp"
#include "support/double_integrator.hpp"
#include "support/random.hpp"
#include "support/states.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

namespace tilt_ropter::optimal_control {
namespace augmented_lagrangian_test {

using test_support::DoubleIntegrator;
using test_support::Random;

using Flight = WheeledFlightProblem<0>;

constexpr int touch_down = 3;

Flight landing(const Eigen::Vector3d& ground_weights) {
  WheeledFlightSettings settings = test_support::benchmark_settings();
  settings.intervals = 6;
  settings.weights.ground = ground_weights;
  Flight problem(test_support::benchmark_body(), settings);
  for (int k = touch_down; k <= 6; ++k) {
    problem.node(k).on_ground = true;
    problem.node(k).com_plane.height = 0.1;
  }
  return problem;
}

// Returns an augmented Lagrangian with non-zero multipliers.
AugmentedLagrangian<Flight> used_lagrangian(Random& random, const Flight& problem) {
  AugmentedLagrangian<Flight> lagrangian(problem.horizon(), 1e3);
  Trajectory<Flight> t(problem.horizon());
  for (int k = 0; k <= problem.horizon(); ++k) {
    t.x(k).body.velocity = random.vector(0.1);
    t.x(k).body.angular_velocity = random.vector(0.1);
    t.x(k).body.position = random.vector(0.1);
  }
  lagrangian.update(problem, t, 0.1, true);
  return lagrangian;
}

TEST(AugmentedLagrangian, AddsTheGaussNewtonModelOfItsValue) {
  Random random(121);
  for (int trial = 0; trial < 30; ++trial) {
    const Flight problem = landing({1e3, trial % 2 == 0 ? 0.0 : 500.0, 2e3});
    auto lagrangian = used_lagrangian(random, problem);
    const Stated x = test_support::random_state(random);
    for (const int k : {touch_down, 6}) {
      Flight::Model model, before;
      before.lx().setConstant(3.0);
      before.lxx().setConstant(2.0);
      before.luu().setConstant(1.0);
      model = before;
      const double largest = lagrangian.add_to_model(problem, k, x, model);

      const Eigen::Vector3d h = problem.equality_values(k, x), w = problem.equality_weights(k);
      EXPECT_EQ(largest, (w.array() > 0.0).select(h.cwiseAbs(), 0.0).maxCoeff());
      StateTangentd gradient;
      Flight::EqualitiesX jacobian;
      for (int i = 0; i < 18; ++i) {
        constexpr double step = 1e-5;
        const Stated up = retract<double>(x, step * StateTangentd::Unit(i)),
                     down = retract<double>(x, -step * StateTangentd::Unit(i));
        gradient(i) =
            (lagrangian.value(problem, k, up) - lagrangian.value(problem, k, down)) / (2.0 * step);
        jacobian.col(i) =
            (problem.equality_values(k, up) - problem.equality_values(k, down)) / (2.0 * step);
      }
      const Eigen::Matrix<double, 18, 18> hessian =
          jacobian.transpose() * w.asDiagonal() * jacobian;
      EXPECT_LT((model.lx() - before.lx() - gradient).norm(), 1e-7 * gradient.norm());
      EXPECT_LT((model.lxx() - before.lxx() - hessian).norm(), 1e-7 * hessian.norm());
      EXPECT_EQ(model.lu(), before.lu());
      EXPECT_EQ(model.lux(), before.lux());
      EXPECT_EQ(model.luu(), before.luu());
      // The entries that the problem does not set again have their old values.
      lagrangian.take_from_model(k, model);
      EXPECT_EQ(model.gradient, before.gradient);
      EXPECT_EQ(model.hessian, before.hessian);
    }
  }
}

// Between adding to the model and taking from it, costs may get another unit.
TEST(AugmentedLagrangian, RestoresTheModelInTheUnitOfItsCost) {
  Random random(123);
  const Flight problem = landing({1e3, 500.0, 2e3});
  auto lagrangian = used_lagrangian(random, problem);
  const Stated x = test_support::random_state(random);
  Flight::Model model;
  model.lx().setConstant(3.0);
  model.lxx().setConstant(2.0);
  lagrangian.add_to_model(problem, touch_down, x, model);
  model.gradient /= 4.0;
  model.hessian /= 4.0;
  const double value = lagrangian.value(problem, touch_down, x);
  const Eigen::Vector3d h = problem.equality_values(touch_down, x),
                        w = problem.equality_weights(touch_down);
  const double by_weights = 0.5 * h.dot(w.asDiagonal() * h);
  lagrangian.change_unit(4.0);
  lagrangian.take_from_model(touch_down, model);
  EXPECT_TRUE((model.lx().array() == 0.75).all());
  EXPECT_TRUE((model.lxx().array() == 0.5).all());
  // The weights are the problem's, the multipliers its own.
  EXPECT_NEAR(lagrangian.value(problem, touch_down, x) - by_weights, (value - by_weights) / 4.0,
              1e-12 * std::abs(value));
}

TEST(AugmentedLagrangian, IgnoresNodeZeroAndEqualitiesWithZeroWeight) {
  Random random(122);
  Flight problem = landing(Eigen::Vector3d(1e3, 0.0, 1e3));
  problem.node(0).on_ground = true;
  auto lagrangian = used_lagrangian(random, problem);
  const Stated x = test_support::random_state(random);
  for (int k = 0; k <= 6; ++k) {
    const bool on = k >= touch_down;
    Flight::Model model;
    EXPECT_EQ(lagrangian.has(problem, k), on);
    EXPECT_EQ(lagrangian.value(problem, k, x) != 0.0, on);
    EXPECT_EQ(lagrangian.add_to_model(problem, k, x, model) != 0.0, on);
    EXPECT_EQ(model.lx().isZero(0.0) && model.lxx().isZero(0.0), !on);
    Stated rolling = x;  // changes only the equality with zero weight
    rolling.body.angular_velocity.x() += 1.0;
    EXPECT_EQ(lagrangian.value(problem, k, rolling), lagrangian.value(problem, k, x));
  }
  EXPECT_TRUE(lagrangian.any(problem));
  EXPECT_FALSE(lagrangian.any(landing(Eigen::Vector3d::Zero())));
  for (int k = 1; k <= 6; ++k) problem.node(k).on_ground = false;
  EXPECT_FALSE(lagrangian.any(problem));  // only node 0 is left
}

TEST(AugmentedLagrangian, IsZeroWithoutEqualities) {
  const test_support::Unicycle problem({4});
  AugmentedLagrangian<test_support::Unicycle> lagrangian(4, 1e6);
  EXPECT_FALSE(lagrangian.any(problem));
  EXPECT_EQ(lagrangian.value(problem, 2, Eigen::Vector3d::Ones()), 0.0);
}

// A mass with the terminal equality v = 0 for its velocity v, with a weight of 100.
struct Stop {
  DoubleIntegrator problem{{4, 0.0, test_support::infinity, true}};
  AugmentedLagrangian<DoubleIntegrator> lagrangian;

  explicit Stop(double max_multiplier = 1e6) : lagrangian(4, max_multiplier) {}

  void update(double v, double residual, bool full_step = true) {
    Trajectory<DoubleIntegrator> t(4);
    for (int k = 0; k <= 4; ++k) t.x(k) = Eigen::Vector2d(7.0, k == 4 ? v : 5.0);
    lagrangian.update(problem, t, residual, full_step);
  }
  [[nodiscard]] double value(double v) const {
    return lagrangian.value(problem, 4, Eigen::Vector2d(0.0, v));
  }
  [[nodiscard]] double multiplier() const { return 0.5 * (value(1.0) - value(-1.0)); }
  [[nodiscard]] double weight() const { return value(1.0) + value(-1.0); }
};

TEST(AugmentedLagrangian, UpdateMovesMultipliersByWeightTimesValue) {
  Stop stop;
  EXPECT_EQ(stop.weight(), 100.0);
  EXPECT_EQ(stop.multiplier(), 0.0);
  stop.update(0.3, 0.4);
  EXPECT_NEAR(stop.multiplier(), 30.0, 1e-12);
  stop.update(-0.05, 0.1);
  EXPECT_NEAR(stop.multiplier(), 25.0, 1e-12);
  EXPECT_EQ(stop.lagrangian.value(stop.problem, 3, Eigen::Vector2d(0.0, 1.0)), 0.0);  // zero weight
  stop.lagrangian.forget_multipliers();
  EXPECT_EQ(stop.multiplier(), 0.0);
}

TEST(AugmentedLagrangian, DropsMultipliersOfEqualitiesWithZeroWeight) {
  Stop stop;
  stop.update(0.3, 0.4);
  stop.problem.stops = false;
  stop.update(0.3, 0.1);
  stop.problem.stops = true;
  EXPECT_EQ(stop.multiplier(), 0.0);
}

// The same equality at every node.
struct SlowEverywhere : DoubleIntegrator {
  SlowEverywhere() : DoubleIntegrator({4, 0.0, test_support::infinity, true}) {}
  D::Equalities equality_weights(int) const { return D::Equalities::Constant(100.0); }
};

TEST(AugmentedLagrangian, ShiftMovesMultipliersWithTheirNodes) {
  const SlowEverywhere problem;
  AugmentedLagrangian<SlowEverywhere> lagrangian(4, 1e6);
  Trajectory<SlowEverywhere> t(4);
  for (int k = 0; k <= 4; ++k) t.x(k) = Eigen::Vector2d(0.0, 0.1 * k);
  lagrangian.update(problem, t, 0.4, true);
  lagrangian.shift(2);
  for (int k = 1; k <= 4; ++k) {
    const double up = lagrangian.value(problem, k, Eigen::Vector2d(0.0, 1.0)),
                 down = lagrangian.value(problem, k, Eigen::Vector2d(0.0, -1.0));
    EXPECT_NEAR(0.5 * (up - down), 10.0 * std::min(k + 2, 4), 1e-12) << k;
  }
}

TEST(AugmentedLagrangian, MultipliersAreBounded) {
  Stop stop(50.0);
  for (const double v : {1.0, -1.0})
    for (int i = 0; i < 5; ++i) {
      stop.update(v, std::pow(0.1, i));
      EXPECT_LE(std::abs(stop.multiplier()), 50.0 + 1e-9);
      if (i < 2) continue;
      EXPECT_NEAR(stop.multiplier(), std::copysign(50.0, v), 1e-9);
    }
}

TEST(AugmentedLagrangian, WeightsGrowOnlyIfFullStepsDoNotHalveTheResidual) {
  Stop stop;
  stop.update(0.0, 1.0);
  EXPECT_DOUBLE_EQ(stop.weight(), 100.0);  // no earlier residual
  stop.update(0.0, 0.4);
  EXPECT_DOUBLE_EQ(stop.weight(), 100.0);  // more than halved
  stop.update(0.0, 0.3, false);
  EXPECT_DOUBLE_EQ(stop.weight(), 100.0);  // not halved, but a shortened step
  stop.update(0.1, 0.2);
  EXPECT_DOUBLE_EQ(stop.weight(), 300.0);      // not halved
  EXPECT_NEAR(stop.multiplier(), 30.0, 1e-9);  // with the new weight
  for (int i = 0; i < 30; ++i) stop.update(0.0, 1.0);
  EXPECT_DOUBLE_EQ(stop.weight(), 1e6);  // upper limit
  stop.lagrangian.forget_scale();
  EXPECT_DOUBLE_EQ(stop.weight(), 100.0);
  stop.update(0.0, 1.0);
  EXPECT_DOUBLE_EQ(stop.weight(), 100.0);  // again no earlier residual
}

}  // namespace augmented_lagrangian_test
}  // namespace tilt_ropter::optimal_control
