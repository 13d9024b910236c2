#include <tilt_ropter/optimal_control/derivative_check.hpp>

#include <tilt_ropter/control/wheeled_flight_problem.hpp>

#include "support/contradiction.hpp"
#include "support/double_integrator.hpp"
#include "support/full_run.hpp"
#include "support/pendulum.hpp"
#include "support/quadrotor.hpp"
#include "support/random.hpp"
#include "support/states.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace tilt_ropter {
namespace {

using test_support::Contradiction;
using test_support::DoubleIntegrator;
using test_support::Pendulum;
using test_support::Quadrotor;
using test_support::Random;
using test_support::random_state;
using test_support::Unicycle;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

std::string sentences(const std::vector<DerivativeError>& errors) {
  std::string text;
  for (const DerivativeError& error : errors) text += to_string(error) + "\n";
  return text;
}

// One number that a problem gets wrong.
struct Mistake {
  std::string callback;
  int node = 0, row = 0, column = -1;
  double amount = 0.1;

  [[nodiscard]] double at(const char* function, int k) const {
    return callback == function && node == k ? amount : 0.0;
  }
  template <typename Matrix>
  void add(const char* function, int k, Matrix&& matrix) const {
    if (at(function, k) != 0.0) matrix(row, std::max(column, 0)) += amount;
  }
};

struct CirclePattern {
  static constexpr bool nonzero(int row, int column) { return row + column != 3; }
};

// A point that moves on a circle and up and down. Right but for the mistake, and with everything
// that a problem can have.
template <typename Pattern = CirclePattern>
struct Circle {
  static constexpr int states = 2, inputs = 2, rows = 2, equalities = 2, terminal_rows = 1;
  struct State {
    Eigen::Vector2d direction{1.0, 0.0};
    double height = 0.0;
  };
  using Tangent = Eigen::Vector2d;
  using Input = Eigen::Vector2d;
  using Rows = Eigen::Vector2d;
  using TerminalRows = Eigen::Matrix<double, 1, 1>;
  using TransitionPattern = Pattern;

  Mistake mistake;
  double stretch = 1.0;  // of the retraction, should be 1

  int horizon() const { return 6; }
  static State turned(const State& x, double angle, double climb) {
    const double c = std::cos(angle), s = std::sin(angle);
    const Eigen::Vector2d& d = x.direction;
    return {{c * d.x() - s * d.y(), s * d.x() + c * d.y()}, x.height + climb};
  }
  State retract(const State& x, const Tangent& dx) const {
    return turned(x, dx(0), stretch * dx(1));
  }
  Tangent difference(const State& y, const State& x) const {
    const Eigen::Vector2d &a = y.direction, &b = x.direction;
    return {std::atan2(a.y() * b.x() - a.x() * b.y(), a.dot(b)), y.height - x.height};
  }

  State step(int k, const State& x, const Input& u) const {
    State end = turned(x, 0.1 * u(0) + 0.2 * x.height * x.direction.x(),
                       0.1 * u(1) * x.direction.y() + 0.05 * x.direction.x());
    end.height += mistake.at("step: end minus x", k);
    return end;
  }
  State step(int k, const State& x, const Input& u, Eigen::Matrix2d& A, Eigen::Matrix2d& B) const {
    const double c = x.direction.x(), s = x.direction.y();
    A << 1.0 - 0.2 * x.height * s, 0.2 * c, 0.1 * u(1) * c - 0.05 * s, 1.0;
    B << 0.1, 0.0, 0.0, 0.1 * s;
    mistake.add("step: A", k, A);
    mistake.add("step: B", k, B);
    State end = step(k, x, u);
    end.height += mistake.at("step: end with A, B minus end without", k);
    return end;
  }
  void step_lanes(int k, int count, const State* x, const Input* u, State* ends,
                  Eigen::Matrix<Lanes, 2, 2>& A, Eigen::Matrix<Lanes, 2, 2>& B) const {
    Eigen::Matrix2d by_state[4];
    Eigen::Matrix2d by_input[4];
    for (int i = 0; i < 4; ++i) {
      const int j = std::min(i, count - 1);
      const State end = step(k + j, x[j], u[j], by_state[i], by_input[i]);
      mistake.add("step_lanes: A", k + j, by_state[i]);
      mistake.add("step_lanes: B", k + j, by_input[i]);
      if (i < count) {
        ends[i] = end;
        ends[i].height += mistake.at("step_lanes: end minus that of step", k + j);
      }
    }
    gather_into(A, [&](int lane) -> const Eigen::Matrix2d& { return by_state[lane]; });
    gather_into(B, [&](int lane) -> const Eigen::Matrix2d& { return by_input[lane]; });
  }

  double cost(int k, const State& x, const Input& u) const {
    const double r = x.direction.y() * x.height;
    return r * r + x.height * u(0) + u(1) * u(1) + mistake.at("cost", k);
  }
  void cost_model(int k, const State& x, const Input& u, QuadraticModel<2, 2>& model) const {
    const double c = x.direction.x(), s = x.direction.y(), z = x.height;
    model.lx() << 2.0 * s * z * c * z, 2.0 * s * z * s + u(0);
    model.lu() << z, 2.0 * u(1);
    model.lxx() << 2.0, 0.3, 0.3, 1.0;
    model.luu() << 1.0, 0.2, 0.2, 4.0;
    mistake.add("cost_model: lx", k, model.lx());
    mistake.add("cost_model: lu", k, model.lu());
    mistake.add("cost_model: lxx", k, model.lxx());
    mistake.add("cost_model: lux", k, model.lux());
    mistake.add("cost_model: luu", k, model.luu());
  }

  Rows row_values(int k, const State& x, const Input& u) const {
    Rows values(x.direction.y() + x.height * u(0), x.height * x.height);
    mistake.add("row_values", k, values);
    return values;
  }
  // Sets what can be non-zero.
  void row_derivatives(int k, const State& x, const Input& u, Eigen::Matrix2d& C,
                       Eigen::Matrix2d& E) const {
    C(0, 0) = x.direction.x();
    C(0, 1) = u(0);
    C(1, 1) = 2.0 * x.height;
    E(0, 0) = x.height;
    mistake.add("row_derivatives: C", k, C);
    mistake.add("row_derivatives: E", k, E);
  }
  Rows lower(int k) const { return bound("lower", k, -infinity); }
  Rows upper(int k) const { return bound("upper", k, infinity); }
  Rows penalty(int k) const { return bound("penalty", k, 1e4); }
  Rows quadratic_penalty(int k) const { return bound("quadratic_penalty", k, infinity); }
  Rows bound(const char* name, int k, double value) const {
    Rows bounds = Rows::Constant(value);
    mistake.add(name, k, bounds);
    return bounds;
  }

  TerminalRows terminal_row_values(const State& x) const {
    return TerminalRows(x.direction.x() * x.height + mistake.at("terminal_row_values", horizon()));
  }
  void terminal_row_derivatives(const State& x, Eigen::Matrix<double, 1, 2>& C) const {
    C << -x.direction.y() * x.height, x.direction.x();
    mistake.add("terminal_row_derivatives: C", horizon(), C);
  }
  TerminalRows terminal_lower() const { return terminal_bound("terminal_lower"); }
  TerminalRows terminal_upper() const { return terminal_bound("terminal_upper"); }
  TerminalRows terminal_penalty() const { return terminal_bound("terminal_penalty"); }
  TerminalRows terminal_quadratic_penalty() const {
    return terminal_bound("terminal_quadratic_penalty");
  }
  TerminalRows terminal_bound(const char* name) const {
    return TerminalRows(1.0 + mistake.at(name, horizon()));
  }

  // The second one is off.
  Eigen::Vector2d equality_values(int k, const State& x) const {
    return {x.direction.y() - x.height + mistake.at("equality_values", k), nan};
  }
  void equality_derivatives(int k, const State& x, Eigen::Matrix2d& H) const {
    H << x.direction.x(), -1.0, nan, nan;
    mistake.add("equality_derivatives: H", k, H);
  }
  Eigen::Vector2d equality_weights(int k) const {
    return {1.0 + mistake.at("equality_weights", k), 0.0};
  }
};

template <typename Problem>
std::vector<DerivativeError> errors_on_the_way(const Problem& problem) {
  std::vector<typename Problem::State> xs;
  std::vector<Eigen::Vector2d> us;
  for (int k = 0; k <= problem.horizon(); ++k) {
    const double t = 0.3 * k;
    xs.push_back({{std::cos(1.0 + t), std::sin(1.0 + t)}, 0.8 - 0.5 * t});
    us.emplace_back(0.7 + t, -0.4 + 0.2 * t);
  }
  return check_derivatives(problem, xs, us);
}

TEST(DerivativeCheck, FindsNothingInARightProblem) {
  EXPECT_EQ(sentences(errors_on_the_way(Circle<>())), "");
}

TEST(DerivativeCheck, NamesTheCallbackNodeRowAndColumnOfEveryMistake) {
  const int last = Circle<>().horizon();
  std::vector<Mistake> mistakes;
  for (int k = 0; k < last; ++k)
    for (int row = 0; row < 2; ++row) {
      for (int column = 0; column < 2; ++column)
        for (const char* callback : {"step: A", "step: B", "step_lanes: A", "step_lanes: B",
                                     "row_derivatives: C", "row_derivatives: E"}) {
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
  mistakes.push_back({"terminal_row_derivatives: C", last, 0, 0});
  mistakes.push_back({"terminal_row_derivatives: C", last, 0, 1});
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

TEST(DerivativeCheck, NamesEveryNumberThatIsNotFinite) {
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
      for (const char* callback : {"row_values", "lower", "upper", "penalty", "quadratic_penalty"})
        if (k < last) mistakes.push_back({callback, k, i});
    }
    if (k < last) mistakes.push_back({"step: end minus x", k, 1});
    mistakes.push_back({"equality_values", k, 0});
    mistakes.push_back({"equality_weights", k, 0});
  }
  for (const char* callback : {"terminal_row_values", "terminal_lower", "terminal_upper",
                               "terminal_penalty", "terminal_quadratic_penalty"})
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

TEST(DerivativeCheck, ComesWithTheWorstFirst) {
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

TEST(DerivativeCheck, SaysItInASentence) {
  EXPECT_EQ(to_string({"step: A", 0, 3, 7, 0.5, 0.25}),
            "step: A(3, 7) at node 0 is 0.5, expected 0.25");
  EXPECT_EQ(to_string({"cost_model: lx", 12, 4, -1, 0.5, -2.0}),
            "cost_model: lx(4) at node 12 is 0.5, expected -2");
  EXPECT_EQ(to_string({"cost", 2, -1, -1, infinity, nan}),
            "cost at node 2 is inf, expected a finite number");
  EXPECT_EQ(to_string({"step: A", 0, 3, 7, 0.5, nan}),
            "step: A(3, 7) at node 0 is 0.5, but finite differences there are not finite");
}

TEST(DerivativeCheck, SeesARetractionThatDifferenceDoesNotUndo) {
  Circle<> problem;
  problem.stretch = 1.2;
  const std::vector<DerivativeError> errors = errors_on_the_way(problem);
  EXPECT_TRUE(std::any_of(errors.begin(), errors.end(), [](const DerivativeError& error) {
    return error.callback == "identity, the derivative of difference(retract(x, dx), x)" &&
           error.row == 1 && error.column == 1 && std::abs(error.expected - 1.2) < 1e-8;
  })) << sentences(errors);
}

TEST(DerivativeCheck, SeesEntriesThatTheTransitionPatternLeavesOut) {
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

// The constraint is a bound on the input, which does not count at the last node.
struct WrongAtTheEnd : Pendulum {
  using Pendulum::Pendulum;
  bool by_input = true;
  void row_derivatives(int k, const State& x, const Input& u, D::RowsX& C, D::RowsU& E) const {
    Pendulum::row_derivatives(k, x, u, C, E);
    if (k < horizon()) return;
    C(0, 1) = 7.0;
    if (!by_input) E.setZero();
  }
};

TEST(DerivativeCheck, LeavesOutConstraintsThatDoNotCountAtTheLastNode) {
  WrongAtTheEnd problem({5});
  const Eigen::Vector2d x(0.3, 0.4);
  const auto check = [&] { return check_derivatives(problem, x, Pendulum::Input(0.5)); };
  EXPECT_EQ(sentences(check()), "");
  problem.by_input = false;
  const std::vector<DerivativeError> errors = check();
  ASSERT_EQ(errors.size(), 2U);
  EXPECT_EQ(to_string(errors[0]), "row_derivatives: C(0, 1) at node 5 is 7, expected 0");
  EXPECT_EQ(to_string(errors[1]), "row_derivatives: E(0, 0) at node 5 is 0, expected 1");
}

TEST(DerivativeCheck, SeesEntriesOfAAndBThatAreNotSet) {
  struct Forgetful : Circle<> {
    State step(int k, const State& x, const Input& u) const { return Circle<>::step(k, x, u); }
    State step(int k, const State& x, const Input& u, Eigen::Matrix2d& A,
               Eigen::Matrix2d& B) const {
      const double before = B(0, 1);
      const State end = Circle<>::step(k, x, u, A, B);
      B(0, 1) = before;
      return end;
    }
  };
  const std::vector<DerivativeError> errors = errors_on_the_way(Forgetful());
  ASSERT_EQ(errors.size(), 6U) << sentences(errors);
  EXPECT_EQ(to_string(errors[0]), "step: B(0, 1) at node 0 is nan, expected 0");
}

TEST(DerivativeCheck, TakesDifferencesThatFitTheFunction) {
  struct Wavy : Circle<> {  // changes within a thousandth
    double cost(int k, const State& x, const Input& u) const {
      return Circle<>::cost(k, x, u) + 1e-3 * std::sin(1e3 * x.height);
    }
    void cost_model(int k, const State& x, const Input& u, QuadraticModel<2, 2>& model) const {
      Circle<>::cost_model(k, x, u, model);
      model.lx()(1) += std::cos(1e3 * x.height);
    }
  };
  EXPECT_EQ(sentences(errors_on_the_way(Wavy())), "");
  struct Rounded : Circle<> {  // is known to ten digits
    double cost(int k, const State& x, const Input& u) const {
      return std::round(1e10 * Circle<>::cost(k, x, u)) * 1e-10;
    }
  };
  EXPECT_EQ(sentences(errors_on_the_way(Rounded())), "");
  struct Bounded : Circle<> {  // ends close by
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

TEST(DerivativeCheck, TheToleranceActs) {
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
    // The input is that of the last node, too, where it is zero.
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

TEST(DerivativeCheck, RefusesTrajectoriesOfTheWrongLength) {
  const Circle<> problem;
  const std::vector<Circle<>::State> xs(7);
  const std::vector<Eigen::Vector2d> us(7, Eigen::Vector2d::Zero());
  EXPECT_NO_THROW((void)check_derivatives(problem, xs, us));
  EXPECT_NO_THROW((void)check_derivatives(problem, xs, {us.begin(), us.end() - 1}));
  EXPECT_THROW((void)check_derivatives(problem, {xs.begin(), xs.end() - 1}, us),
               std::invalid_argument);
  EXPECT_THROW((void)check_derivatives(problem, xs, {us.begin(), us.end() - 2}),
               std::invalid_argument);
  EXPECT_THROW((void)check_derivatives(problem, xs, us, 0.0), std::invalid_argument);
  EXPECT_THROW((void)check_derivatives(problem, xs, us, nan), std::invalid_argument);
}

TEST(DerivativeCheck, FindsNothingInTheTestProblems) {
  Random random(91);
  for (int i = 0; i < test_support::quick_or_full(20, 1000); ++i) {
    const Eigen::Vector3d x = random.vector(3.0), u = random.vector(3.0);
    const auto expect_none = [](const auto& errors) { EXPECT_EQ(sentences(errors), ""); };
    expect_none(check_derivatives(Pendulum({5}), x.head<2>(), u.head<1>()));
    expect_none(check_derivatives(Unicycle({5}), x, u.head<2>()));
    expect_none(check_derivatives(DoubleIntegrator({5}), x.head<2>(), u.head<1>()));
    expect_none(check_derivatives(Contradiction({5}), x.head<1>(), u.head<1>()));
    Quadrotor::State body = random_state(random).body;
    expect_none(check_derivatives(Quadrotor({5}), body,
                                  Eigen::Vector4d(u(0), u(1), u(2), random.uniform(0.1, 4.0))));
  }
}

TEST(DerivativeCheck, FindsNothingInTheTiltRoptersProblem) {
  using Problem = WheeledFlightProblem<4>;
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Random random(92);
  for (int i = 0; i < test_support::quick_or_full(4, 100); ++i) {
    WheeledFlightSettings settings;
    settings.intervals = 6;
    settings.terminal_cost = i % 2 == 0 ? TerminalCost::weights : TerminalCost::riccati;
    Problem problem(vehicle.body, settings, ActuatorRows<4>(vehicle));
    std::vector<Problem::State> xs;
    std::vector<Problem::Input> us;
    for (int k = 0; k <= problem.horizon(); ++k) {
      WheeledFlightNode& node = problem.node(k);
      node.reference = random_state(random).body;
      node.external = {random.vector(3.0), random.vector(0.3)};
      node.on_ground = k % 2 == 0;
      if (node.on_ground) node.freedom.linear(2, 2) = node.freedom.angular.x() = 0.0;
      xs.push_back(random_state(random));
      Problem::Input u;
      u << random.vector(20.0), random.vector(4.0);
      us.push_back(u);
    }
    EXPECT_EQ(sentences(check_derivatives(problem, xs, us)), "");
  }
}

}  // namespace
}  // namespace tilt_ropter
