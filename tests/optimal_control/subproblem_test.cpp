// Residuals of a step and its multipliers: their definitions, for lower and upper bounds alike.

#include "support/random.hpp"

#include <tilt_ropter/optimal_control/detail/subproblem.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter::optimal_control {
namespace subproblem_test {

using test_support::Random;

constexpr double infinity = std::numeric_limits<double>::infinity();

// One interval with one state and one input. The constraint of node 0 is the input.
class OneBound : public testing::TestWithParam<double> {  // the sign: 1 upper bound, -1 lower bound
 protected:
  using Program = Subproblem<1, 1, 1>;

  OneBound() {
    const Eigen::Matrix<double, 1, 1> one = Eigen::Matrix<double, 1, 1>::Ones();
    for (int k = 0; k <= 1; ++k) {
      auto& model = program.riccati.stage(k).cost;
      model.lxx() = one;
      if (k == 0) model.luu() = 4.0 * one;
    }
    EXPECT_TRUE(program.riccati.set_transition(0, one, one));
    program.node(0).E(0, 0) = 1.0;
    program.node(0).penalty(0) = 10.0;
  }

  // Residual of the input `u` with the multiplier `m` >= 0, for the bound `bound` that u must not
  // exceed. With sign -1 all three have the opposite sign.
  ProgramResidual residual(double u, double bound, double m, double stiffness = infinity) {
    const double sign = GetParam();
    auto& node = program.node(0);
    (sign > 0.0 ? node.upper : node.lower)(0) = sign * bound;
    node.stiffness(0) = stiffness;
    node.multiplier(0) = sign * m;
    EXPECT_TRUE(program.check_node(0) && program.check_node(1));
    // u and the state that it leads to
    program.step(0)(1) = program.step(1)(0) = sign * u;
    program.predict();
    return program.residual(0.0);
  }

  Program program{1};
};

// The derivative of 2 u^2 + 0.5 u^2 + m u is 5 u + m, the input's own terms are 4 u + m.
TEST_P(OneBound, StationarityIsRelativeToTheTermsOfTheInput) {
  EXPECT_NEAR(residual(-0.6, -0.6, 3.0).stationarity, 0.0, 1e-15);
  EXPECT_NEAR(residual(-0.6, -0.6, 2.0).stationarity, 1.0 / (1.0 + 0.4), 1e-15);
  EXPECT_NEAR(residual(-0.6, -0.6, 4.5).stationarity, 1.5 / (1.0 + 2.1), 1e-15);
}

TEST_P(OneBound, ComplementarityIsTheSmallerOfDistanceAndMultiplier) {
  EXPECT_NEAR(residual(0.5, 2.0, 0.25).complementarity, 0.25 / 1.25, 1e-15);  // by the multiplier
  EXPECT_NEAR(residual(1.7, 2.0, 4.0).complementarity, 0.3 / 3.0, 1e-15);     // by the distance
  EXPECT_NEAR(residual(2.0, 2.0, 4.0).complementarity, 0.0, 1e-15);
  EXPECT_EQ(residual(0.5, 2.0, 0.0).complementarity, 0.0);
}

TEST_P(OneBound, GapIsTheErrorOfTheCostByComplementarity) {
  program.cost_here = 7.0;
  const double cost = 7.0 + 2.5 * 0.5 * 0.5;
  EXPECT_NEAR(residual(0.5, 2.0, 0.25).gap, 0.25 * 1.5 / (1.0 + cost), 1e-15);
  EXPECT_NEAR(residual(0.5, 0.2, 0.25).gap, 0.25 * 0.3 / (1.0 + cost), 1e-15);  // violated
  EXPECT_EQ(residual(0.5, 0.2, 10.0).gap, 0.0);  // relaxed at its penalty
  program.cost_here = -7.0;
  EXPECT_NEAR(residual(0.5, 2.0, 0.25).gap, 0.25 * 1.5 / (1.0 + 7.0 - 0.625), 1e-15);
}

// While the multiplier is below the penalty, it accounts for a violation of multiplier / stiffness.
TEST_P(OneBound, ViolationIsWhatNeitherMultiplierNorPriceAccountsFor) {
  EXPECT_EQ(residual(0.5, 2.0, 0.0).violation, 0.0);
  EXPECT_NEAR(residual(3.0, 2.0, 1.0).violation, 1.0 / 3.0, 1e-15);
  EXPECT_NEAR(residual(2.01, 2.0, 9.9).violation, std::min(0.01 / 3.0, 0.1 / 10.9), 1e-15);
  EXPECT_NEAR(residual(3.0, 2.0, 9.9).violation, 0.1 / 10.9, 1e-15);  // nearly at its penalty
  EXPECT_EQ(residual(3.0, 2.0, 10.0).violation, 0.0);                 // relaxed
  EXPECT_NEAR(residual(3.0, 2.0, 5.0, 5.0).violation, 0.0, 1e-15);
  EXPECT_NEAR(residual(3.0, 2.0, 2.0, 5.0).violation, 0.6 / 3.0, 1e-15);
  EXPECT_NEAR(residual(2.8, 2.0, 5.0, 5.0).complementarity, 0.2 / 3.0, 1e-15);
}

// The same at the point of linearisation, where the constraint has the value `u`, for no step.
TEST_P(OneBound, ResidualHereIsThatOfNoStep) {
  const auto here = [this](double u, double bound, double m, double stiffness) {
    program.node(0).value(0) = GetParam() * u;
    (void)residual(0.0, bound, m, stiffness);
    return program.residual_here(program.violation_here(0));
  };
  EXPECT_EQ(here(1.0, 2.0, 0.0, infinity).violation, 0.0);
  EXPECT_NEAR(here(3.0, 2.0, 0.0, infinity).violation, 1.0, 1e-15);    // not relative to the bound
  EXPECT_NEAR(here(13.0, 2.0, 0.0, infinity).violation, 10.0, 1e-15);  // the penalty
  EXPECT_NEAR(program.violation_here(0), 11.0, 1e-14);
  EXPECT_EQ(here(3.0, 2.0, 10.0, infinity).violation, 0.0);
  const ProgramResidual other = here(3.0, 2.0, 9.9, infinity);
  EXPECT_EQ(other.violation, 0.0);  // 0.1 / 10.9 would not be the largest
  EXPECT_GT(other.largest(), 0.1 / 10.9);
  EXPECT_NEAR(here(1.7, 2.0, 4.0, infinity).complementarity, 0.3 / 3.0, 1e-15);
  EXPECT_NEAR(here(1.7, 2.0, 4.0, infinity).gap, 4.0 * 0.3 / (1.0 + program.cost_here), 1e-15);
}

TEST_P(OneBound, StepThatIsNotANumberHasInfiniteResiduals) {
  const ProgramResidual r = residual(std::numeric_limits<double>::quiet_NaN(), 2.0, 0.5);
  EXPECT_EQ(r.violation, infinity);
  EXPECT_EQ(r.stationarity, infinity);
  EXPECT_EQ(r.largest(), infinity);
}

// Two relaxed hard bounds on the same input whose terms cancel.
class TwoBounds : public testing::TestWithParam<double> {};
TEST_P(TwoBounds, TermsThatCancelScaleTheStationarity) {
  const double sign = GetParam(), penalty = Subproblem<1, 1, 2>::hard_penalty;
  Subproblem<1, 1, 2> program(1);
  auto& node = program.node(0);
  program.riccati.stage(0).cost.luu()(0, 0) = 1.0;
  node.E << 1.0, -1.0;
  for (int i = 0; i < 2; ++i) {
    (sign > 0.0 ? node.upper : node.lower)(i) = -sign;
    node.penalty(i) = infinity;
    node.multiplier(i) = sign * penalty;
  }
  ASSERT_TRUE(program.check_node(0) && program.check_node(1));
  program.step(0)(1) = 0.5;
  program.predict();
  EXPECT_NEAR(program.residual(0.0).stationarity, 0.5 / (1.0 + penalty), 1e-20);
  for (int i = 0; i < 2; ++i) node.multiplier(i) = sign * 0.5 * penalty;  // not relaxed
  EXPECT_NEAR(program.residual(0.0).stationarity, 0.5 / 1.5, 1e-15);
}

INSTANTIATE_TEST_SUITE_P(UpperAndLower, OneBound, testing::Values(1.0, -1.0));
INSTANTIATE_TEST_SUITE_P(UpperAndLower, TwoBounds, testing::Values(1.0, -1.0));

// A random program, or with sign -1 its mirror image, in which steps, multipliers and constraints
// have the opposite sign. Prices are hard, soft and quadratic.
using Mixed = Subproblem<3, 2, 5>;
void fill(Mixed& program, unsigned seed, double sign) {
  Random random(seed);
  const auto numbers = [&random](auto&& matrix) {
    for (Eigen::Index j = 0; j < matrix.cols(); ++j)
      for (Eigen::Index i = 0; i < matrix.rows(); ++i) matrix(i, j) = random.normal(1.0);
  };
  for (int k = 0; k <= program.horizon(); ++k) {
    Eigen::Matrix3d A;
    Eigen::Matrix<double, 3, 2> B;
    Eigen::Matrix<double, 5, 5> root;
    Eigen::Matrix<double, 5, 1> gradient, step;
    numbers(A);
    numbers(B);
    numbers(root);
    numbers(gradient);
    numbers(step);
    const Eigen::Matrix<double, 5, 5> hessian = root * root.transpose();
    auto& model = program.riccati.stage(k).cost;
    model.hessian.topLeftCorner<5, 5>() = hessian;
    model.gradient.head<5>() = sign * gradient;
    program.step(k).head<5>() = sign * step;
    EXPECT_TRUE(program.riccati.set_transition(k, A, B));
    auto& n = program.node(k);
    numbers(n.C);
    numbers(n.E);
    for (int i = 0; i < 5; ++i) {
      const double value = random.normal(1.0), low = random.normal(2.0) - 2.0,
                   high = low + random.uniform(0.0, 4.0), penalty = random.uniform(0.1, 10.0),
                   m = random.normal(3.0), kind = random.uniform(0.0, 1.0);
      n.value(i) = sign * value;
      n.lower(i) = sign > 0.0 ? low : -high;
      n.upper(i) = sign > 0.0 ? high : -low;
      n.penalty(i) = kind < 0.2 ? infinity : penalty;
      n.stiffness(i) = kind > 0.7 ? penalty : infinity;
      n.multiplier(i) = kind < 0.5 ? 0.0 : sign * std::clamp(m, -penalty, penalty);
    }
    EXPECT_TRUE(program.check_node(k));
  }
  program.predict();
}

void expect_close(double a, double b) {
  EXPECT_NEAR(a, b, 1e-11 * (1.0 + std::abs(a)));
}

TEST(Subproblem, MirrorImageHasTheSameResidualsAndCost) {
  Mixed program(3), mirror(3);
  double largest = 0.0;
  for (unsigned seed = 0; seed < 300; ++seed) {
    SCOPED_TRACE(seed);
    fill(program, seed, 1.0);
    fill(mirror, seed, -1.0);
    const ProgramResidual a = program.residual(0.1), b = mirror.residual(0.1);
    expect_close(a.stationarity, b.stationarity);
    expect_close(a.violation, b.violation);
    expect_close(a.complementarity, b.complementarity);
    expect_close(a.gap, b.gap);
    expect_close(program.excess(), mirror.excess());
    expect_close(program.residual_here(1.0).largest(), mirror.residual_here(1.0).largest());
    expect_close(program.cost_of_step(0.1), mirror.cost_of_step(0.1));
    for (int k = 0; k <= 3; ++k) {
      expect_close(program.violation_here(k), mirror.violation_here(k));
      EXPECT_LT((program.costate(k) + mirror.costate(k)).norm(), 1e-9);
    }
    largest = std::max(largest, a.complementarity);
  }
  EXPECT_GT(largest, 0.1);
}

TEST(Subproblem, KeepsItsMeaningInOtherUnits) {
  constexpr double cost = 8.0, row = 0.25;
  Mixed program(3), other(3);
  for (unsigned seed = 0; seed < 100; ++seed) {
    SCOPED_TRACE(seed);
    for (Mixed* one : {&program, &other}) fill(*one, seed, 1.0);
    other.node(1).finite_penalty.setConstant(3.0);
    for (int k = 0; k <= 3; ++k) other.change_units(k, cost, Mixed::Values::Constant(row));
    EXPECT_TRUE((other.node(1).finite_penalty.array() == 3.0 * row / cost).all());
    expect_close(program.cost_of_step(0.1), cost * other.cost_of_step(0.1 / cost));
    expect_close(program.excess(), other.excess());
    for (int k = 0; k <= 3; ++k) {
      expect_close(program.violation_here(k), row * other.violation_here(k));
      EXPECT_LT((program.costate(k) - cost * other.costate(k)).norm(), 1e-9);
      EXPECT_LT((program.node(k).multiplier * row - cost * other.node(k).multiplier).norm(), 1e-9);
    }
    const auto predicted = other.node(1).predicted;
    other.predict();
    EXPECT_LT((other.node(1).predicted - predicted).norm(), 1e-11);
  }
}

}  // namespace subproblem_test
}  // namespace tilt_ropter::optimal_control
