// Correct problems give no error, also where finite differences are difficult.

#include <tilt_ropter/optimal_control/derivative_check.hpp>

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>

#include "support/circle_problem.hpp"
#include "support/full_run.hpp"
#include "support/pendulum.hpp"
#include "support/random.hpp"
#include "support/states.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <vector>

namespace tilt_ropter::optimal_control {
namespace derivative_check_correct_problems_test {

using test_support::Circle;
using test_support::errors_on_the_way;
using test_support::Pendulum;
using test_support::Random;
using test_support::random_state;
using test_support::sentences;

TEST(DerivativeCheck, FindsNoErrorInACorrectProblem) {
  EXPECT_EQ(sentences(errors_on_the_way(Circle<>())), "");
}

TEST(DerivativeCheck, ChoosesStepSizesThatSuitTheFunction) {
  struct Wavy : Circle<> {  // varies over a length of 1e-3
    double cost(int k, const State& x, const Input& u) const {
      return Circle<>::cost(k, x, u) + 1e-3 * std::sin(1e3 * x.height);
    }
    void cost_model(int k, const State& x, const Input& u, QuadraticModel<2, 2>& model) const {
      Circle<>::cost_model(k, x, u, model);
      model.lx()(1) += std::cos(1e3 * x.height);
    }
  };
  EXPECT_EQ(sentences(errors_on_the_way(Wavy())), "");
  struct Rounded : Circle<> {  // rounded to ten decimal places
    double cost(int k, const State& x, const Input& u) const {
      return std::round(1e10 * Circle<>::cost(k, x, u)) * 1e-10;
    }
  };
  EXPECT_EQ(sentences(errors_on_the_way(Rounded())), "");
  struct Bounded : Circle<> {  // not finite beyond a limit close by
    double cost(int k, const State& x, const Input& u) const {
      return x.height < limit ? Circle<>::cost(k, x, u) : nan;
    }
    double limit = infinity;
  };
  Bounded bounded;
  bounded.limit = 0.5 + 1e-4;
  const Circle<>::State x{{0.6, 0.8}, 0.5};
  const Eigen::Vector2d u(0.1, 0.2);
  EXPECT_EQ(sentences(check_derivatives(bounded, x, u)), "");
  bounded.limit = 0.5 + 1e-6;
  const std::vector<DerivativeError> errors = check_derivatives(bounded, x, u);
  ASSERT_EQ(errors.size(), 7U);
  EXPECT_EQ(to_string(errors[0]),
            "cost_model: lx(1) at node 0 is 0.74, but finite differences there are not finite");
}

// The constraint is a bound on the input. It does not count at the last node.
struct WrongAtTheEnd : Pendulum {
  using Pendulum::Pendulum;
  bool by_input = true;
  void constraint_derivatives(int k, const State& x, const Input& u, D::ConstraintsX& C,
                              D::ConstraintsU& E) const {
    Pendulum::constraint_derivatives(k, x, u, C, E);
    if (k < horizon()) return;
    C(0, 1) = 7.0;
    if (!by_input) E.setZero();
  }
};

TEST(DerivativeCheck, IgnoresInputConstraintsAtTheLastNode) {
  WrongAtTheEnd problem({5});
  const Eigen::Vector2d x(0.3, 0.4);
  const auto check = [&] { return check_derivatives(problem, x, Pendulum::Input(0.5)); };
  EXPECT_EQ(sentences(check()), "");
  problem.by_input = false;
  const std::vector<DerivativeError> errors = check();
  ASSERT_EQ(errors.size(), 2U);
  EXPECT_EQ(to_string(errors[0]), "constraint_derivatives: C(0, 1) at node 5 is 7, expected 0");
  EXPECT_EQ(to_string(errors[1]), "constraint_derivatives: E(0, 0) at node 5 is 0, expected 1");
}

TEST(DerivativeCheck, FindsNoErrorInTheTiltRopterProblem) {
  using Problem = WheeledFlightProblem<4>;
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Random random(92);
  for (int i = 0; i < test_support::quick_or_full(4, 100); ++i) {
    WheeledFlightSettings settings;
    settings.intervals = 6;
    settings.terminal_cost = i % 2 == 0 ? TerminalCost::weights : TerminalCost::riccati;
    Problem problem(vehicle.body, settings, ActuatorConstraints<4>(vehicle));
    std::vector<Problem::State> xs;
    std::vector<Problem::Input> us;
    for (int k = 0; k <= problem.horizon(); ++k) {
      WheeledFlightNode& node = problem.node(k);
      node.reference = random_state(random).body;
      node.external = {random.vector(3.0), random.vector(0.3)};
      node.on_ground = k % 2 == 0;
      if (node.on_ground) node.freedom.linear(2, 2) = node.freedom.angular(0, 0) = 0.0;
      xs.push_back(random_state(random));
      Problem::Input u;
      u << random.vector(20.0), random.vector(4.0);
      us.push_back(u);
    }
    EXPECT_EQ(sentences(check_derivatives(problem, xs, us)), "");
  }
}

}  // namespace derivative_check_correct_problems_test
}  // namespace tilt_ropter::optimal_control
