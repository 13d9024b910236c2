// Every mistake in a problem is found and named.

#include <tilt_ropter/optimal_control/derivative_check.hpp>

#include "support/circle_problem.hpp"
#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace tilt_ropter::optimal_control {
namespace derivative_check_test {

using test_support::Circle;
using test_support::errors_on_the_way;
using test_support::Mistake;
using test_support::sentences;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

TEST(DerivativeCheck, NamesTheCallbackNodeRowAndColumnOfEveryMistake) {
  const int last = Circle<>().horizon();
  std::vector<Mistake> mistakes;
  for (int k = 0; k < last; ++k)
    for (int row = 0; row < 2; ++row) {
      for (int column = 0; column < 2; ++column)
        for (const char* callback : {"step: A", "step: B", "step_lanes: A", "step_lanes: B",
                                     "constraint_derivatives: C", "constraint_derivatives: E"}) {
          mistakes.push_back({callback, k, row, column, 0.1});
          mistakes.push_back({callback, k, row, column, -1e-4});
          mistakes.push_back({callback, k, row, column, nan});
        }
      mistakes.push_back({"cost_model: lu", k, row, -1, 0.1});
    }
  for (int k = 0; k < last; ++k) {
    mistakes.push_back({"step: end with A, B minus end without", k, 1});
    mistakes.push_back({"step_lanes: end minus that of step", k, 1});
  }
  for (int k = 0; k <= last; ++k) {
    for (int i = 0; i < 2; ++i) {
      mistakes.push_back({"cost_model: lx", k, i});
      mistakes.push_back({"equality_derivatives: H", k, 0, i});
    }
    mistakes.push_back({"cost_model: lxx", k, 0, 1});
    mistakes.push_back({"cost_model: luu", k, 0, 1});
  }
  mistakes.push_back({"terminal_constraint_derivatives: C", last, 0, 0});
  mistakes.push_back({"terminal_constraint_derivatives: C", last, 0, 1});
  for (const Mistake& mistake : mistakes) {
    Circle<> problem;
    problem.mistake = mistake;
    const std::vector<DerivativeError> errors = errors_on_the_way(problem);
    ASSERT_EQ(errors.size(), 1U) << mistake.callback << " at node " << mistake.node << "\n"
                                 << sentences(errors);
    const DerivativeError& error = errors.front();
    EXPECT_EQ(error.callback, mistake.callback);
    EXPECT_EQ(error.node, mistake.node) << mistake.callback;
    EXPECT_EQ(error.row, mistake.row) << mistake.callback;
    EXPECT_EQ(error.column, mistake.column) << mistake.callback;
    if (std::isnan(mistake.amount)) {
      EXPECT_TRUE(std::isnan(error.given) && std::isfinite(error.expected));
    } else {
      EXPECT_NEAR(error.given - error.expected, mistake.amount, 1e-8) << mistake.callback;
    }
  }
}

TEST(DerivativeCheck, NamesEveryNonFiniteNumber) {
  const int last = Circle<>().horizon();
  std::vector<Mistake> mistakes;
  for (int k = 0; k <= last; ++k) {
    mistakes.push_back({"cost", k, -1});
    for (int i = 0; i < 2; ++i) {
      mistakes.push_back({"cost_model: lu", k, i});
      for (int j = 0; j < 2; ++j) {
        mistakes.push_back({"cost_model: lxx", k, i, j});
        mistakes.push_back({"cost_model: lux", k, i, j});
        mistakes.push_back({"cost_model: luu", k, i, j});
      }
      for (const char* callback : {"constraint_values", "lower", "upper", "penalty", "stiffness"})
        if (k < last) mistakes.push_back({callback, k, i});
    }
    if (k < last) mistakes.push_back({"step: end minus x", k, 1});
    mistakes.push_back({"equality_values", k, 0});
    mistakes.push_back({"equality_weights", k, 0});
  }
  for (const char* callback : {"terminal_constraint_values", "terminal_lower", "terminal_upper",
                               "terminal_penalty", "terminal_stiffness"})
    mistakes.push_back({callback, last, 0});
  for (Mistake& mistake : mistakes) {
    mistake.amount = nan;
    Circle<> problem;
    problem.mistake = mistake;
    const std::vector<DerivativeError> errors = errors_on_the_way(problem);
    ASSERT_EQ(errors.size(), 1U) << mistake.callback << " at node " << mistake.node << "\n"
                                 << sentences(errors);
    const DerivativeError& error = errors.front();
    EXPECT_EQ(error.callback, mistake.callback);
    EXPECT_EQ(error.node, mistake.node) << mistake.callback;
    EXPECT_EQ(error.row, mistake.row) << mistake.callback;
    EXPECT_EQ(error.column, mistake.column) << mistake.callback;
    EXPECT_TRUE(std::isnan(error.given)) << mistake.callback;
  }
}

TEST(DerivativeCheck, ReturnsTheWorstErrorFirst) {
  struct TwoMistakes : Circle<> {
    void cost_model(int k, const State& x, const Input& u, QuadraticModel<2, 2>& model) const {
      Circle<>::cost_model(k, x, u, model);
      if (k == 1) model.lx()(0) += 1e-3;
      if (k == 2) model.lx()(1) += 1.0;
      if (k == 3) model.lu()(0) = nan;
    }
  };
  const std::vector<DerivativeError> errors = errors_on_the_way(TwoMistakes());
  ASSERT_EQ(errors.size(), 3U);
  EXPECT_EQ(errors[0].node, 3);
  EXPECT_EQ(errors[1].node, 2);
  EXPECT_EQ(errors[2].node, 1);
}

TEST(DerivativeCheck, FindsMistakesOfTheCurvature) {
  struct Curved : Circle<> {
    void add_curvature(int k, const State&, const Input&,
                       const ProblemConstraints<Circle<>>::Values& multipliers,
                       const Eigen::Vector2d& costate, QuadraticModel<2, 2>& model) const {
      if (k != 2) return;
      model.lxx()(0, 1) += multipliers(0) + costate(0);
      if (symmetric) model.lxx()(1, 0) += multipliers(0) + costate(0);
    }
    void cost_model(int k, const State& x, const Input& u, QuadraticModel<2, 2>& model) const {
      const double before = model.lxx()(0, 1);
      Circle<>::cost_model(k, x, u, model);
      if (keeps) model.lxx()(0, 1) = model.lxx()(1, 0) = before;
    }
    bool symmetric = true, keeps = false;
  };
  Curved problem;
  EXPECT_EQ(sentences(errors_on_the_way(problem)), "");
  problem.symmetric = false;
  const std::vector<DerivativeError> asymmetric = errors_on_the_way(problem);
  ASSERT_EQ(asymmetric.size(), 1U) << sentences(asymmetric);
  EXPECT_EQ(asymmetric[0].callback, "add_curvature: lxx");
  EXPECT_EQ(asymmetric[0].node, 2);
  problem.symmetric = true;
  problem.keeps = true;
  const std::vector<DerivativeError> left = errors_on_the_way(problem);
  ASSERT_EQ(left.size(), 2U) << sentences(left);
  EXPECT_EQ(left[0].callback, "cost_model: Hessian after add_curvature, minus before");
}

TEST(DerivativeCheck, ToStringDescribesTheError) {
  EXPECT_EQ(to_string({"step: A", 2, 3, 7, 0.123456789, 1e-7}),
            "step: A(3, 7) at node 2 is 0.123456789, expected 1e-07");
  EXPECT_EQ(to_string({"step: A", 0, 3, 7, 0.5, 0.25}),
            "step: A(3, 7) at node 0 is 0.5, expected 0.25");
  EXPECT_EQ(to_string({"cost_model: lx", 12, 4, -1, 0.5, -2.0}),
            "cost_model: lx(4) at node 12 is 0.5, expected -2");
  EXPECT_EQ(to_string({"cost", 2, -1, -1, infinity, nan}),
            "cost at node 2 is inf, expected a finite number");
  EXPECT_EQ(to_string({"step: A", 0, 3, 7, 0.5, nan}),
            "step: A(3, 7) at node 0 is 0.5, but finite differences there are not finite");
}

TEST(DerivativeCheck, FindsRetractionThatDifferenceDoesNotInvert) {
  Circle<> problem;
  problem.stretch = 1.2;
  const std::vector<DerivativeError> errors = errors_on_the_way(problem);
  EXPECT_TRUE(std::any_of(errors.begin(), errors.end(), [](const DerivativeError& error) {
    return error.callback == "identity, the derivative of difference(retract(x, dx), x)" &&
           error.row == 1 && error.column == 1 && std::abs(error.expected - 1.2) < 1e-8;
  })) << sentences(errors);
}

TEST(DerivativeCheck, FindsEntriesThatTheTransitionPatternOmits) {
  struct Wrong {
    static constexpr bool nonzero(int row, int column) { return row != 1 || column == 1; }
  };
  const std::vector<DerivativeError> errors = errors_on_the_way(Circle<Wrong>());
  ASSERT_EQ(errors.size(), 12U) << sentences(errors);
  for (const DerivativeError& error : errors) {
    EXPECT_EQ(error.callback, "TransitionPattern of [A B]");
    EXPECT_EQ(error.row, 1);
    EXPECT_TRUE(error.column == 0 || error.column == 3) << error.column;
    EXPECT_EQ(error.given, 0.0);
  }
}

TEST(DerivativeCheck, FindsEntriesOfAAndBThatAreNotSet) {
  struct Forgetful : Circle<> {
    State step(int k, const State& x, const Input& u) const { return Circle<>::step(k, x, u); }
    State step(int k, const State& x, const Input& u, Eigen::Matrix2d& A,
               Eigen::Matrix2d& B) const {
      const double before = B(0, 1);
      State end = Circle<>::step(k, x, u, A, B);
      B(0, 1) = before;
      return end;
    }
  };
  const std::vector<DerivativeError> errors = errors_on_the_way(Forgetful());
  ASSERT_EQ(errors.size(), 6U) << sentences(errors);
  EXPECT_EQ(to_string(errors[0]), "step: B(0, 1) at node 0 is nan, expected 0");
}

TEST(DerivativeCheck, ToleranceTakesEffect) {
  Circle<> problem;
  problem.mistake = {"step: A", 1, 1, 1, 1e-4};
  const Circle<>::State x{{0.6, 0.8}, 0.5};
  const Eigen::Vector2d u(0.1, 0.2);
  EXPECT_EQ(check_derivatives(problem, x, u).size(), 1U);
  EXPECT_EQ(check_derivatives(problem, x, u, 0.4e-4).size(), 1U);
  EXPECT_EQ(check_derivatives(problem, x, u, 0.6e-4).size(), 0U);
}

TEST(DerivativeCheck, ChecksEveryNodeWithTheStateAndInputGiven) {
  Circle<> problem;
  const Circle<>::State x{{0.6, 0.8}, 0.5};
  const Eigen::Vector2d u(0.1, 0.2);
  const std::vector<Circle<>::State> xs(7, x);
  for (int k = 0; k <= problem.horizon(); ++k) {
    problem.mistake = {"cost_model: lx", k, 1};
    // At the last node the input counts as zero.
    const double truth = 2.0 * 0.8 * 0.5 * 0.8 + (k < problem.horizon() ? 0.1 : 0.0);
    for (const auto& errors :
         {check_derivatives(problem, x, u),
          check_derivatives(problem, xs, std::vector<Eigen::Vector2d>(7, u))}) {
      ASSERT_EQ(errors.size(), 1U);
      EXPECT_EQ(errors.front().node, k);
      EXPECT_NEAR(errors.front().expected, truth, 1e-9);
    }
  }
}

TEST(DerivativeCheck, NamesItsArguments) {
  Circle<> problem;
  std::vector<Circle<>::State> xs;
  std::vector<Eigen::Vector2d> us;
  const auto check = [&](std::size_t states, std::size_t inputs, double tolerance) {
    xs.resize(states);
    us.assign(inputs, Eigen::Vector2d::Zero());
    (void)check_derivatives(problem, xs, us, tolerance);
  };
  using test_support::expect_accepted;
  using test_support::expect_refused;
  expect_accepted([&] { check(7, 7, 1e-6); });
  expect_accepted([&] { check(7, 6, 1e-6); });
  for (const std::size_t states : {0U, 6U, 8U})
    expect_refused(
        "check_derivatives: number of states", [&] { check(states, 7, 1e-6); },
        std::to_string(states) + ": must be");
  for (const std::size_t inputs : {0U, 5U})
    expect_refused("check_derivatives: number of inputs", [&] { check(7, inputs, 1e-6); });
  for (const double tolerance : {0.0, -1.0, nan})
    expect_refused("check_derivatives: tolerance", [&] { check(7, 7, tolerance); });
  problem.intervals = 1;
  expect_accepted([&] { check(2, 1, 1e-6); });
  for (problem.intervals = 0; problem.intervals > -2; --problem.intervals)
    expect_refused("Problem.horizon()", [&] { check(1, 0, 1e-6); });
}

}  // namespace derivative_check_test
}  // namespace tilt_ropter::optimal_control
