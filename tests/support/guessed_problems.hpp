#pragma once

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <random>
#include <vector>

/// Problems that are not convex, as users of other tools solve them first, and random guesses of
/// their solutions: the straight line from start to end, with noise.
namespace test_support {

template <typename S, int Size>
using VectorOf = Eigen::Matrix<S, Size, 1>;

/// A pole that hangs from a cart and must stand on it, with a force of at most 10 N. `Arrives`:
/// with a hard condition on the end, otherwise only by the cost.
template <bool Arrives>
struct SwingUp {
  static constexpr int states = 4, inputs = 1, residuals = 5, constraints = 1,
                       terminal_constraints = Arrives ? 4 : 0, terminal_residuals = 4;
  static constexpr double upright = 3.14159265358979323846;

  int intervals = 60;

  [[nodiscard]] int horizon() const { return intervals; }
  /// State: position [m], angle from hanging [rad], and their rates.
  template <typename S>
  static VectorOf<S, 4> rate(const VectorOf<S, 4>& x, const S& force) {
    using std::cos;
    using std::sin;
    const double cart = 1.0, pole = 0.1, length = 0.5, g = 9.81;
    const S s = sin(x(1)), c = cos(x(1)), mass = S(cart) + pole * s * s;
    VectorOf<S, 4> result;
    result << x(2), x(3), (force + pole * s * (length * x(3) * x(3) + g * c)) / mass,
        (-force * c - pole * length * x(3) * x(3) * c * s - (cart + pole) * g * s) /
            (length * mass);
    return result;
  }
  template <typename S>
  VectorOf<S, 4> step(int, const VectorOf<S, 4>& x, const VectorOf<S, 1>& u) const {
    const double h = 0.05;
    const VectorOf<S, 4> k1 = rate<S>(x, u(0)), k2 = rate<S>(x + S(h / 2.0) * k1, u(0)),
                         k3 = rate<S>(x + S(h / 2.0) * k2, u(0)), k4 = rate<S>(x + S(h) * k3, u(0));
    return x + S(h / 6.0) * (k1 + S(2.0) * k2 + S(2.0) * k3 + k4);
  }
  template <typename S>
  VectorOf<S, 5> residual(int, const VectorOf<S, 4>& x, const VectorOf<S, 1>& u) const {
    VectorOf<S, 5> r;
    r << x(0), x(1) - S(upright), S(0.1) * x(2), S(0.1) * x(3), S(0.1) * u(0);
    return r;
  }
  template <typename S>
  VectorOf<S, 4> terminal_residual(const VectorOf<S, 4>& x) const {
    VectorOf<S, 4> r;
    r << x(0), x(1) - S(upright), S(0.1) * x(2), S(0.1) * x(3);
    return r;
  }
  template <typename S>
  VectorOf<S, 1> constraint_values(int, const VectorOf<S, 4>&, const VectorOf<S, 1>& u) const {
    return u;
  }
  [[nodiscard]] VectorOf<double, 1> lower(int) const { return VectorOf<double, 1>(-10.0); }
  [[nodiscard]] VectorOf<double, 1> upper(int) const { return VectorOf<double, 1>(10.0); }
  template <typename S>
  VectorOf<S, terminal_constraints> terminal_constraint_values(const VectorOf<S, 4>& x) const {
    if constexpr (Arrives) {
      VectorOf<S, 4> r;
      r << x(0), x(1) - S(upright), x(2), x(3);
      return r;
    } else {
      return {};
    }
  }
  [[nodiscard]] VectorOf<double, terminal_constraints> terminal_lower() const {
    return VectorOf<double, terminal_constraints>::Zero();
  }
  [[nodiscard]] VectorOf<double, terminal_constraints> terminal_upper() const {
    return terminal_lower();
  }
  static Eigen::Vector4d start() { return Eigen::Vector4d::Zero(); }
  static Eigen::Vector4d end() { return {0.0, upright, 0.0, 0.0}; }
  static Eigen::Matrix<double, 1, 1> usual_input() { return Eigen::Matrix<double, 1, 1>::Zero(); }
};

/// A point mass in the plane that must pass two circles, which are on its straight way.
struct TwoCircles {
  static constexpr int states = 4, inputs = 2, residuals = 6, constraints = 4,
                       terminal_constraints = 4, terminal_residuals = 0;

  int intervals = 50;
  double offset = 1e-4;  ///< of the first circle's centre from the way [m]

  [[nodiscard]] int horizon() const { return intervals; }
  template <typename S>
  VectorOf<S, 4> step(int, const VectorOf<S, 4>& x, const VectorOf<S, 2>& u) const {
    const double h = 0.1;
    VectorOf<S, 4> end;
    end << x(0) + S(h) * x(2) + S(h * h / 2.0) * u(0), x(1) + S(h) * x(3) + S(h * h / 2.0) * u(1),
        x(2) + S(h) * u(0), x(3) + S(h) * u(1);
    return end;
  }
  template <typename S>
  VectorOf<S, 6> residual(int, const VectorOf<S, 4>& x, const VectorOf<S, 2>& u) const {
    VectorOf<S, 6> r;
    r << S(0.1) * (x(0) - S(3.0)), S(0.1) * x(1), S(0.1) * x(2), S(0.1) * x(3), S(0.3) * u(0),
        S(0.3) * u(1);
    return r;
  }
  template <typename S>
  VectorOf<S, 4> constraint_values(int, const VectorOf<S, 4>& x, const VectorOf<S, 2>& u) const {
    const auto square = [](const S& a) { return S(a * a); };
    VectorOf<S, 4> r;
    r << square(x(0) - S(1.0)) + square(x(1) - S(offset)),
        square(x(0) - S(2.0)) + square(x(1) + S(0.1)), u(0), u(1);
    return r;
  }
  [[nodiscard]] Eigen::Vector4d lower(int) const { return {0.09, 0.09, -2.0, -2.0}; }
  [[nodiscard]] Eigen::Vector4d upper(int) const {
    constexpr double infinity = std::numeric_limits<double>::infinity();
    return {infinity, infinity, 2.0, 2.0};
  }
  template <typename S>
  VectorOf<S, 4> terminal_constraint_values(const VectorOf<S, 4>& x) const {
    VectorOf<S, 4> r;
    r << x(0) - S(3.0), x(1), x(2), x(3);
    return r;
  }
  [[nodiscard]] Eigen::Vector4d terminal_lower() const { return Eigen::Vector4d::Zero(); }
  [[nodiscard]] Eigen::Vector4d terminal_upper() const { return Eigen::Vector4d::Zero(); }
  static Eigen::Vector4d start() { return Eigen::Vector4d::Zero(); }
  static Eigen::Vector4d end() { return {3.0, 0.0, 0.0, 0.0}; }
  static Eigen::Vector2d usual_input() { return Eigen::Vector2d::Zero(); }
};

/// One metre from rest to rest in the shortest time, with an acceleration of at most 1 m/s^2. The
/// second input is the length of the interval.
struct ShortestTime {
  static constexpr int states = 2, inputs = 2, residuals = 2, constraints = 2,
                       terminal_constraints = 2, terminal_residuals = 0;

  int intervals = 20;

  [[nodiscard]] int horizon() const { return intervals; }
  template <typename S>
  VectorOf<S, 2> step(int, const VectorOf<S, 2>& x, const VectorOf<S, 2>& u) const {
    const S& h = u(1);
    VectorOf<S, 2> end;
    end << x(0) + h * x(1) + S(0.5) * h * h * u(0), x(1) + h * u(0);
    return end;
  }
  template <typename S>
  VectorOf<S, 2> residual(int, const VectorOf<S, 2>&, const VectorOf<S, 2>& u) const {
    using std::sqrt;
    VectorOf<S, 2> r;
    r << sqrt(sqrt(u(1) * u(1) + S(1e-6))), S(1e-2) * u(0);
    return r;
  }
  template <typename S>
  VectorOf<S, 2> constraint_values(int, const VectorOf<S, 2>&, const VectorOf<S, 2>& u) const {
    return u;
  }
  [[nodiscard]] Eigen::Vector2d lower(int) const { return {-1.0, 0.01}; }
  [[nodiscard]] Eigen::Vector2d upper(int) const { return {1.0, 1.0}; }
  template <typename S>
  VectorOf<S, 2> terminal_constraint_values(const VectorOf<S, 2>& x) const {
    VectorOf<S, 2> r;
    r << x(0) - S(1.0), x(1);
    return r;
  }
  [[nodiscard]] Eigen::Vector2d terminal_lower() const { return Eigen::Vector2d::Zero(); }
  [[nodiscard]] Eigen::Vector2d terminal_upper() const { return Eigen::Vector2d::Zero(); }
  static Eigen::Vector2d start() { return Eigen::Vector2d::Zero(); }
  static Eigen::Vector2d end() { return {1.0, 0.0}; }
  static Eigen::Vector2d usual_input() { return {0.0, 0.1}; }
};

/// States and inputs of a plan; the input of the last node is zero.
template <typename User>
struct PlanOf {
  std::vector<VectorOf<double, User::states>> states;
  std::vector<VectorOf<double, User::inputs>> inputs;
};

/// The guess of number `seed`, with noise of this standard deviation, relative to the way of each
/// state.
template <typename User>
[[nodiscard]] PlanOf<User> random_guess(const User& user, double noise, unsigned seed) {
  std::mt19937 generator(seed);
  std::normal_distribution<double> normal;
  const auto start = User::start(), end = User::end();
  PlanOf<User> guess;
  for (int k = 0; k <= user.intervals; ++k) {
    VectorOf<double, User::states> x = start + (end - start) * k / user.intervals;
    VectorOf<double, User::inputs> u = User::usual_input();
    for (int i = 0; i < User::states; ++i)
      x(i) += noise * normal(generator) * (1.0 + std::abs(end(i)));
    for (int i = 0; i < User::inputs; ++i) u(i) += noise * normal(generator);
    guess.states.push_back(k == 0 ? start : x);
    guess.inputs.push_back(u);
  }
  return guess;
}

/// Sets the guess of a solver for the problem `user`.
template <typename Solver, typename User>
void set_guess(Solver& solver, const PlanOf<User>& guess) {
  solver.reset(User::start());
  for (std::size_t k = 0; k < guess.states.size(); ++k)
    solver.set_guess(static_cast<int>(k), guess.states[k], guess.inputs[k]);
}

template <typename User, typename Solver>
[[nodiscard]] PlanOf<User> plan_of(const Solver& solver) {
  PlanOf<User> plan;
  for (int k = 0; k <= solver.horizon(); ++k) {
    plan.states.push_back(solver.state(k));
    plan.inputs.push_back(k < solver.horizon() ? VectorOf<double, User::inputs>(solver.input(k))
                                               : VectorOf<double, User::inputs>::Zero());
  }
  return plan;
}

/// What a plan costs and violates, computed from the functions of the problem alone.
struct PlanValue {
  double cost = 0.0;
  double largest = 0.0;   ///< defect or violation
  double together = 0.0;  ///< sum of all of them

  /// The cost plus all violations, at a penalty above every multiplier of these problems.
  [[nodiscard]] double merit() const { return cost + 1e4 * together; }
};

template <typename User>
[[nodiscard]] PlanValue value_of(const User& user, const PlanOf<User>& plan) {
  const tilt_ropter::optimal_control::AutoDiffProblem<User> problem(user);
  PlanValue value;
  const auto violate = [&value](double by) {
    if (std::isnan(by)) by = std::numeric_limits<double>::infinity();
    value.largest = std::max(value.largest, by);
    value.together += std::max(by, 0.0);
  };
  for (int k = 0; k <= user.intervals; ++k) {
    const auto at = static_cast<std::size_t>(k);
    const auto& x = plan.states[at];
    const auto& u = plan.inputs[at];
    value.cost += problem.cost(k, x, u);
    if (k < user.intervals) {
      const auto defect = (problem.step(k, x, u) - plan.states[at + 1]).eval();
      for (int i = 0; i < User::states; ++i) violate(std::abs(defect(i)));
      const auto values = user.template constraint_values<double>(k, x, u);
      const auto lower = user.lower(k), upper = user.upper(k);
      for (int i = 0; i < User::constraints; ++i)
        violate(std::max(values(i) - upper(i), lower(i) - values(i)));
    } else {
      const auto values = user.template terminal_constraint_values<double>(x);
      for (int i = 0; i < User::terminal_constraints; ++i) violate(std::abs(values(i)));
    }
  }
  return value;
}

}  // namespace test_support
