// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

/// Check of a problem's functions and derivatives against finite differences, for tests.
namespace tilt_ropter::optimal_control {

/// A wrong entry in the result of a problem's function; see check_derivatives().
struct DerivativeError {
  std::string callback;  ///< the function and its result, for example "step: A"
  int node = 0;
  int row = 0, column = 0;  ///< of the entry; column -1 for a vector, both -1 for a number
  double given = 0.0;       ///< value that the function returned
  double expected = 0.0;    ///< correct value; NaN: any finite number
};

/// Returns one line, for example "step: A(3, 7) at node 0 is 0.5, expected 0.25".
[[nodiscard]] inline std::string to_string(const DerivativeError& error) {
  std::ostringstream text;
  text.precision(9);
  text << error.callback;
  if (error.row >= 0) text << '(' << error.row;
  if (error.column >= 0) text << ", " << error.column;
  text << (error.row >= 0 ? ")" : "") << " at node " << error.node << " is " << error.given;
  if (std::isfinite(error.expected))
    text << ", expected " << error.expected;
  else if (std::isfinite(error.given))
    text << ", but finite differences there are not finite";
  else
    text << ", expected a finite number";
  return text.str();
}

}  // namespace tilt_ropter::optimal_control

namespace tilt_ropter::detail {

/// Implementation of check_derivatives().
template <typename Problem>
class DerivativeCheck {
 public:
  using D = optimal_control::ProblemDimensions<Problem>;
  using State = typename Problem::State;
  using Tangent = typename D::Tangent;
  using Input = typename D::Input;

  DerivativeCheck(const Problem& problem, double tolerance)
      : problem_(problem), tolerance_(tolerance) {}

  void check_node(int k, const State& x, const Input& u) {
    check_retraction(k, x);
    if (k < problem_.horizon()) check_step(k, x, u);
    check_cost(k, x, u);
    if constexpr (optimal_control::HasCurvature<Problem>::value) check_curvature(k, x, u);
    if constexpr (AllConstraints::count > 0) check_constraints(k, x, u);
    if constexpr (D::ne > 0) check_equalities(k, x);
  }

  /// Compares step_lanes() with step() for up to Lanes::count intervals from the first on.
  void check_lanes(int first, const std::vector<State>& xs, const std::vector<Input>& us) {
    const int count = std::min(Lanes::count, problem_.horizon() - first);
    Eigen::Matrix<Lanes, D::nx, D::nx> lanes_A;
    Eigen::Matrix<Lanes, D::nx, D::nu> lanes_B;
    lanes_A.setIdentity();
    lanes_B.setZero();
    std::vector<State> ends(size(Lanes::count));
    const auto start = size(first);
    problem_.step_lanes(first, count, &xs[start], &us[start], ends.data(), lanes_A, lanes_B);
    for (int lane = 0; lane < count; ++lane) {
      const int k = first + lane;
      const auto node = size(k);
      typename D::A A = D::A::Constant(nan);
      typename D::B B = D::B::Constant(nan);
      const State end = problem_.step(k, xs[node], us[node], A, B);
      // Errors of step() itself are already reported, so they are skipped here.
      const Tangent end_minus = problem_.difference(ends[size(lane)], end);
      if (all_finite(problem_.difference(end, xs[node])))
        expect_zero("step_lanes: end minus that of step", k, end_minus);
      const auto expect_same = [&](const char* callback, const auto& given, const auto& expected) {
        for (int i = 0; i < static_cast<int>(expected.rows()); ++i)
          for (int j = 0; j < static_cast<int>(expected.cols()); ++j)
            if (std::isfinite(expected(i, j)))
              expect(callback, k, i, j, given(i, j)[lane], expected(i, j), expected(i, j));
      };
      expect_same("step_lanes: A", lanes_A, A);
      expect_same("step_lanes: B", lanes_B, B);
    }
  }

  /// Returns the errors found, largest first.
  [[nodiscard]] std::vector<optimal_control::DerivativeError> errors() {
    std::stable_sort(found_.begin(), found_.end(),
                     [](const auto& a, const auto& b) { return a.first > b.first; });
    std::vector<optimal_control::DerivativeError> sorted;
    for (const auto& found : found_) sorted.push_back(found.second);
    return sorted;
  }

 private:
  using AllConstraints = optimal_control::ProblemConstraints<Problem>;
  using Pattern = typename optimal_control::TransitionPatternOf<Problem>::type;
  static constexpr double nan = std::numeric_limits<double>::quiet_NaN();

  // Derivatives of the same function by differences with long and with short steps.
  template <int Constraints, int Columns>
  struct Differences {
    Eigen::Matrix<double, Constraints, Columns> by_long, by_short;
  };

  // d function(e) / de at e = 0, by central differences of fourth order.
  template <int Constraints, int Columns, typename Function>
  static Eigen::Matrix<double, Constraints, Columns> difference_quotients(const Function& function,
                                                                          double length) {
    Eigen::Matrix<double, Constraints, Columns> derivative;
    for (int j = 0; j < Columns; ++j) {
      using Step = Eigen::Matrix<double, Columns, 1>;
      const Step e = length * Step::Unit(j);
      const Eigen::Matrix<double, Constraints, 1> far = function(Step(2.0 * e)) -
                                                        function(Step(-2.0 * e)),
                                                  near = function(e) - function(Step(-e));
      derivative.col(j) = (8.0 * near - far) / (12.0 * length);
    }
    return derivative;
  }
  template <int Constraints, int Columns, typename Function>
  static Differences<Constraints, Columns> differences(const Function& function) {
    return {difference_quotients<Constraints, Columns>(function, 1e-3),
            difference_quotients<Constraints, Columns>(function, 1e-5)};
  }

  void note(double size, const std::string& callback, int k, int row, int column, double given,
            double expected) {
    found_.push_back({size, {callback, k, row, column, given, expected}});
  }

  // The entry must be close to `first` or to `second`. `first` may be non-finite.
  void expect(const std::string& callback, int k, int row, int column, double given, double first,
              double second) {
    const double expected = std::abs(given - first) <= std::abs(given - second) ? first : second;
    const double size = std::abs(given - expected) / (tolerance_ * (1.0 + std::abs(expected)));
    if (!(size <= 1.0))
      note(std::isfinite(size) ? size : infinity, callback, k, row, column, given, expected);
  }
  template <typename Given, int Constraints, int Columns>
  void expect_constraint(const std::string& callback, int k, int row, const Given& given,
                         const Differences<Constraints, Columns>& by) {
    for (int j = 0; j < Columns; ++j)
      expect(callback, k, row, j, given(row, j), by.by_long(row, j), by.by_short(row, j));
  }
  template <typename Given, int Columns>
  void expect_gradient(const std::string& callback, int k, const Given& given,
                       const Differences<1, Columns>& by) {
    for (int j = 0; j < Columns; ++j)
      expect(callback, k, j, -1, given(j), by.by_long(0, j), by.by_short(0, j));
  }
  template <typename Given>
  void expect_zero(const std::string& callback, int k, const Given& vector) {
    for (int i = 0; i < static_cast<int>(vector.size()); ++i)
      expect(callback, k, i, -1, vector(i), 0.0, 0.0);
  }
  template <typename Given>
  bool expect_finite(const std::string& callback, int k, const Given& vector) {
    for (int i = 0; i < static_cast<int>(vector.size()); ++i)
      if (!std::isfinite(vector(i))) note(infinity, callback, k, i, -1, vector(i), nan);
    return all_finite(vector);
  }
  template <typename Given>
  void expect_finite_matrix(const std::string& callback, int k, const Given& matrix) {
    for (int i = 0; i < static_cast<int>(matrix.rows()); ++i)
      for (int j = 0; j < static_cast<int>(matrix.cols()); ++j)
        if (!std::isfinite(matrix(i, j))) note(infinity, callback, k, i, j, matrix(i, j), nan);
  }
  template <typename Given>
  void expect_symmetric(const std::string& callback, int k, const Given& matrix) {
    expect_finite_matrix(callback, k, matrix);
    for (int i = 0; i < static_cast<int>(matrix.rows()); ++i)
      for (int j = i + 1; j < static_cast<int>(matrix.cols()); ++j)
        if (std::isfinite(matrix(i, j)) && std::isfinite(matrix(j, i)))
          expect(callback, k, i, j, matrix(i, j), matrix(j, i), matrix(j, i));
  }

  void check_retraction(int k, const State& x) {
    expect_zero("difference(x, x)", k, problem_.difference(x, x));
    const auto by_step = differences<D::nx, D::nx>([&](const Tangent& e) -> Tangent {
      return problem_.difference(problem_.retract(x, e), x);
    });
    const typename D::A identity = D::A::Identity();
    for (int i = 0; i < D::nx; ++i)
      expect_constraint("identity, the derivative of difference(retract(x, dx), x)", k, i, identity,
                        by_step);
  }

  void check_step(int k, const State& x, const Input& u) {
    typename D::A A = D::A::Constant(nan);
    typename D::B B = D::B::Constant(nan);
    const State end = problem_.step(k, x, u), same_end = problem_.step(k, x, u, A, B);
    if (!expect_finite("step: end minus x", k, problem_.difference(end, x))) return;
    expect_zero("step: end with A, B minus end without", k, problem_.difference(same_end, end));
    const auto by_state = differences<D::nx, D::nx>([&](const Tangent& e) -> Tangent {
      return problem_.difference(problem_.step(k, problem_.retract(x, e), u), end);
    });
    const auto by_input = differences<D::nx, D::nu>([&](const Input& e) -> Tangent {
      return problem_.difference(problem_.step(k, x, u + e), end);
    });
    for (int i = 0; i < D::nx; ++i) {
      expect_constraint("step: A", k, i, A, by_state);
      expect_constraint("step: B", k, i, B, by_input);
      for (int j = 0; j < D::nx + D::nu; ++j) {
        if (Pattern::nonzero(i, j)) continue;
        const auto of = [&](const auto& state, const auto& input) {
          return j < D::nx ? state(i, j) : input(i, j - D::nx);
        };
        expect("TransitionPattern of [A B]", k, i, j, 0.0, of(by_state.by_long, by_input.by_long),
               of(by_state.by_short, by_input.by_short));
      }
    }
  }

  void check_cost(int k, const State& x, const Input& u) {
    using Number = Eigen::Matrix<double, 1, 1>;
    optimal_control::QuadraticModel<D::nx, D::nu> model;
    problem_.cost_model(k, x, u, model);
    const double cost = problem_.cost(k, x, u);
    if (std::isfinite(cost)) {
      expect_gradient("cost_model: lx", k, model.lx(),
                      differences<1, D::nx>([&](const Tangent& e) -> Number {
                        return Number(problem_.cost(k, problem_.retract(x, e), u));
                      }));
      if (k < problem_.horizon())
        expect_gradient("cost_model: lu", k, model.lu(),
                        differences<1, D::nu>([&](const Input& e) -> Number {
                          return Number(problem_.cost(k, x, u + e));
                        }));
    } else {
      note(infinity, "cost", k, -1, -1, cost, nan);
    }
    if (k == problem_.horizon()) expect_finite("cost_model: lu", k, model.lu());
    expect_symmetric("cost_model: lxx", k, model.lxx());
    expect_symmetric("cost_model: luu", k, model.luu());
    expect_finite_matrix("cost_model: lux", k, model.lux());
  }

  // cost_model() must set all entries again that add_curvature() changed.
  void check_curvature(int k, const State& x, const Input& u) {
    optimal_control::QuadraticModel<D::nx, D::nu> expected, model;
    problem_.cost_model(k, x, u, expected);
    problem_.cost_model(k, x, u, model);
    const typename AllConstraints::Values multipliers = AllConstraints::Values::Ones();
    const Tangent costate = Tangent::Constant(k < problem_.horizon() ? 1.0 : 0.0);
    problem_.add_curvature(k, x, u, multipliers, costate, model);
    expect_symmetric("add_curvature: lxx", k, model.lxx());
    expect_symmetric("add_curvature: luu", k, model.luu());
    expect_finite_matrix("add_curvature: lux", k, model.lux());
    expect_zero("add_curvature: change of the gradient", k, model.gradient - expected.gradient);
    problem_.cost_model(k, x, u, model);
    const auto left = model.hessian - expected.hessian;
    for (int i = 0; i < D::nx + D::nu; ++i)
      for (int j = 0; j < D::nx + D::nu; ++j)
        if (std::isfinite(expected.hessian(i, j)))
          expect("cost_model: Hessian after add_curvature, minus before", k, i, j, left(i, j), 0.0,
                 0.0);
  }

  void check_constraints(int k, const State& x, const Input& u) {
    using Values = typename AllConstraints::Values;
    const bool own_end = AllConstraints::of_end >= 0 && k == problem_.horizon();
    const std::string prefix = own_end ? "terminal_" : "";
    const Values values = AllConstraints::values(problem_, k, x, u);
    typename AllConstraints::ByState C = AllConstraints::ByState::Zero();
    typename AllConstraints::ByInput E = AllConstraints::ByInput::Zero();
    AllConstraints::derivatives(problem_, k, x, u, C, E);
    const auto by_state =
        differences<AllConstraints::count, D::nx>([&](const Tangent& e) -> Values {
          return AllConstraints::values(problem_, k, problem_.retract(x, e), u);
        });
    const auto by_input = differences<AllConstraints::count, D::nu>(
        [&](const Input& e) -> Values { return AllConstraints::values(problem_, k, x, u + e); });
    Values lower, upper, penalty, stiffness = Values::Constant(infinity);
    AllConstraints::bounds(problem_, k, lower, upper, penalty, stiffness);
    expect_finite(prefix + "constraint_values", k, values);
    for (int i = 0; i < AllConstraints::count; ++i) {
      if (!AllConstraints::applies(problem_, k, E, i)) continue;
      const auto expect_number = [&](const char* callback, double bound) {
        if (std::isnan(bound)) note(infinity, prefix + callback, k, i, -1, bound, nan);
      };
      expect_number("lower", lower(i));
      expect_number("upper", upper(i));
      expect_number("penalty", penalty(i));
      expect_number("stiffness", stiffness(i));
      if (!std::isfinite(values(i))) continue;
      expect_constraint(prefix + "constraint_derivatives: C", k, i, C, by_state);
      if (!own_end) expect_constraint(prefix + "constraint_derivatives: E", k, i, E, by_input);
    }
  }

  void check_equalities(int k, const State& x) {
    using Equalities = typename D::Equalities;
    const Equalities weights = problem_.equality_weights(k);
    expect_finite("equality_weights", k, weights);
    if (!(weights.array() > 0.0).any()) return;
    typename D::EqualitiesX H = D::EqualitiesX::Constant(nan);
    problem_.equality_derivatives(k, x, H);
    const Equalities values = problem_.equality_values(k, x);
    const auto by_state = differences<D::ne, D::nx>([&](const Tangent& e) -> Equalities {
      return problem_.equality_values(k, problem_.retract(x, e));
    });
    for (int i = 0; i < D::ne; ++i) {
      if (!(weights(i) > 0.0)) continue;
      if (std::isfinite(values(i)))
        expect_constraint("equality_derivatives: H", k, i, H, by_state);
      else
        note(infinity, "equality_values", k, i, -1, values(i), nan);
    }
  }

  const Problem& problem_;
  double tolerance_;
  std::vector<std::pair<double, optimal_control::DerivativeError>> found_;
};

}  // namespace tilt_ropter::detail

namespace tilt_ropter::optimal_control {

/// Compares everything that a problem (see problem.hpp) returns to the solver with the correct
/// values, at the nodes 0 .. N of the states `xs` (N + 1 states) and inputs `us` (N inputs; more
/// are ignored). The function compares:
///
/// - step: A and B, cost_model: lx and lu, constraint_derivatives: C and E,
///   terminal_constraint_derivatives and equality_derivatives (where the weight is not zero) with
///   central differences in tangent coordinates;
/// - difference() with retract(): each is the inverse of the other, to first order;
/// - entries of A and B that are zero in TransitionPattern with zero;
/// - the two overloads of step() with each other, and step_lanes(), if it exists, with them;
/// - cost_model and add_curvature: lxx and luu with their transposes. Their values are not checked,
///   because Gauss-Newton Hessians are not the second derivatives of the cost;
/// - the Hessian of cost_model() before and after a call of add_curvature().
///
/// All numbers must be finite. Bounds and penalties must not be NaN.
///
/// At node N the input is zero, and constraints with a non-zero entry in E are skipped there. An
/// entry is an error if it differs by more than tolerance (1 + |expected|). Errors in entries
/// smaller than the tolerance are not detected. The differences are of fourth order, with steps of
/// 1e-3 and of 1e-5, and the entry must agree with one of them. If a function has a kink within
/// these steps, a reported error may be false.
///
/// Returns the errors, largest first, empty if there are none. Calls every function 8 (nx + nu)
/// times per node and allocates: for tests, not for the loop. Throws std::invalid_argument if a
/// trajectory has another length or the tolerance is not positive.
template <typename Problem>
[[nodiscard]] std::vector<DerivativeError> check_derivatives(
    const Problem& problem, const std::vector<typename Problem::State>& xs,
    const std::vector<typename ProblemDimensions<Problem>::Input>& us, double tolerance = 1e-6) {
  using Input = typename ProblemDimensions<Problem>::Input;
  require(problem.horizon() >= 1, "Problem.horizon()", problem.horizon(), ">= 1");
  const auto horizon = detail::size(problem.horizon());
  require(xs.size() == horizon + 1, "check_derivatives: number of states", xs.size(),
          "Problem.horizon() + 1");
  require(us.size() >= horizon, "check_derivatives: number of inputs", us.size(),
          ">= Problem.horizon()");
  require_positive("check_derivatives: tolerance", tolerance);
  detail::DerivativeCheck<Problem> check(problem, tolerance);
  for (std::size_t k = 0; k <= horizon; ++k)
    check.check_node(static_cast<int>(k), xs[k], k < horizon ? us[k] : Input(Input::Zero()));
  if constexpr (HasLanes<Problem>::value)
    for (int k = 0; k < problem.horizon(); k += Lanes::count) check.check_lanes(k, xs, us);
  return check.errors();
}

/// Uses the same state and the same input at every node.
template <typename Problem>
[[nodiscard]] std::vector<DerivativeError> check_derivatives(
    const Problem& problem, const typename Problem::State& x,
    const typename ProblemDimensions<Problem>::Input& u, double tolerance = 1e-6) {
  const auto horizon = detail::size(std::max(problem.horizon(), 0));
  return check_derivatives(problem, std::vector<typename Problem::State>(horizon + 1, x),
                           std::vector<typename ProblemDimensions<Problem>::Input>(horizon, u),
                           tolerance);
}

}  // namespace tilt_ropter::optimal_control
