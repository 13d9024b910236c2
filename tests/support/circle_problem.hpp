#pragma once

#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/derivative_check.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

/// A problem that can contain one mistake, for tests of check_derivatives.
namespace test_support {

/// An error in one number that a problem returns.
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

/// Entries of [A B] of Circle that can be non-zero.
struct CirclePattern {
  static constexpr bool nonzero(int row, int column) { return row + column != 3; }
};

/// A point that moves on a circle and vertically. The problem is correct except for the mistake. It
/// has all functions that a problem can have.
template <typename Pattern = CirclePattern>
struct Circle {
  static constexpr int states = 2, inputs = 2, constraints = 2, equalities = 2,
                       terminal_constraints = 1;
  struct State {
    Eigen::Vector2d direction{1.0, 0.0};
    double height = 0.0;
  };
  using Tangent = Eigen::Vector2d;
  using Input = Eigen::Vector2d;
  using Constraints = Eigen::Vector2d;
  using TerminalConstraints = Eigen::Matrix<double, 1, 1>;
  using TransitionPattern = Pattern;

  static constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  static constexpr double infinity = std::numeric_limits<double>::infinity();

  Mistake mistake;
  double stretch = 1.0;  // of the retraction, correct: 1
  int intervals = 6;

  int horizon() const { return intervals; }
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
                  Eigen::Matrix<tilt_ropter::Lanes, 2, 2>& A,
                  Eigen::Matrix<tilt_ropter::Lanes, 2, 2>& B) const {
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
    gather_into(A, 4, [&](int lane) -> const Eigen::Matrix2d& { return by_state[lane]; });
    gather_into(B, 4, [&](int lane) -> const Eigen::Matrix2d& { return by_input[lane]; });
  }

  double cost(int k, const State& x, const Input& u) const {
    const double r = x.direction.y() * x.height;
    return r * r + x.height * u(0) + u(1) * u(1) + mistake.at("cost", k);
  }
  void cost_model(int k, const State& x, const Input& u,
                  tilt_ropter::optimal_control::QuadraticModel<2, 2>& model) const {
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

  Constraints constraint_values(int k, const State& x, const Input& u) const {
    Constraints values(x.direction.y() + x.height * u(0), x.height * x.height);
    mistake.add("constraint_values", k, values);
    return values;
  }
  // Sets only the entries that can be non-zero.
  void constraint_derivatives(int k, const State& x, const Input& u, Eigen::Matrix2d& C,
                              Eigen::Matrix2d& E) const {
    C(0, 0) = x.direction.x();
    C(0, 1) = u(0);
    C(1, 1) = 2.0 * x.height;
    E(0, 0) = x.height;
    mistake.add("constraint_derivatives: C", k, C);
    mistake.add("constraint_derivatives: E", k, E);
  }
  Constraints lower(int k) const { return bound("lower", k, -infinity); }
  Constraints upper(int k) const { return bound("upper", k, infinity); }
  Constraints penalty(int k) const { return bound("penalty", k, 1e4); }
  Constraints stiffness(int k) const { return bound("stiffness", k, infinity); }
  Constraints bound(const char* name, int k, double value) const {
    Constraints bounds = Constraints::Constant(value);
    mistake.add(name, k, bounds);
    return bounds;
  }

  TerminalConstraints terminal_constraint_values(const State& x) const {
    return TerminalConstraints(x.direction.x() * x.height +
                               mistake.at("terminal_constraint_values", horizon()));
  }
  void terminal_constraint_derivatives(const State& x, Eigen::Matrix<double, 1, 2>& C) const {
    C << -x.direction.y() * x.height, x.direction.x();
    mistake.add("terminal_constraint_derivatives: C", horizon(), C);
  }
  TerminalConstraints terminal_lower() const { return terminal_bound("terminal_lower"); }
  TerminalConstraints terminal_upper() const { return terminal_bound("terminal_upper"); }
  TerminalConstraints terminal_penalty() const { return terminal_bound("terminal_penalty"); }
  TerminalConstraints terminal_stiffness() const { return terminal_bound("terminal_stiffness"); }
  TerminalConstraints terminal_bound(const char* name) const {
    return TerminalConstraints(1.0 + mistake.at(name, horizon()));
  }

  // The second equality has zero weight and must be ignored.
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

/// Checks the problem with another state and input at every node.
template <typename Problem>
std::vector<tilt_ropter::optimal_control::DerivativeError> errors_on_the_way(
    const Problem& problem) {
  std::vector<typename Problem::State> xs;
  std::vector<Eigen::Vector2d> us;
  for (int k = 0; k <= problem.horizon(); ++k) {
    const double t = 0.3 * k;
    xs.push_back({{std::cos(1.0 + t), std::sin(1.0 + t)}, 0.8 - 0.5 * t});
    us.emplace_back(0.7 + t, -0.4 + 0.2 * t);
  }
  return tilt_ropter::optimal_control::check_derivatives(problem, xs, us);
}

/// Returns one line per error.
inline std::string sentences(
    const std::vector<tilt_ropter::optimal_control::DerivativeError>& errors) {
  std::string text;
  for (const tilt_ropter::optimal_control::DerivativeError& error : errors)
    text += to_string(error) + "\n";
  return text;
}

}  // namespace test_support
