// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/entries.hpp>
#include <tilt_ropter/math/packet.hpp>

#include <Eigen/Core>

#include <type_traits>

// clang-format off
/// What a multiple-shooting problem is made of. A problem is any type `Problem` with
///
///     static constexpr int states, inputs;    // dimensions of the tangent space and of the input
///     static constexpr int rows, equalities;  // counts per node
///     using State = ...;                      // a point of the state manifold
///     using D = ProblemDimensions<Problem>;   // the vector and matrix types below
///
///     int horizon() const;                                          // number of intervals N
///     State retract(const State& x, const D::Tangent& dx) const;    // x (+) dx
///     D::Tangent difference(const State& y, const State& x) const;  // y (-) x
///
///     // end of interval k (0 <= k < N); the second one adds its derivative
///     State step(int k, const State& x, const D::Input& u) const;
///     State step(int k, const State& x, const D::Input& u, D::A& A, D::B& B) const;
///
///     // cost of node k (k = N: terminal, u is zero and means nothing) and its Gauss-Newton model
///     double cost(int k, const State& x, const D::Input& u) const;
///     void cost_model(int k, const State& x, const D::Input& u, QuadraticModel<nx, nu>& m) const;
///
///     // only if rows > 0, constraints: lower <= c(x, u) <= upper; an infinite bound is no bound.
///     // The penalty is the price of violating a constraint by one unit, the largest multiplier it
///     // can have; infinite: a hard constraint. At node N, constraints that depend on the input
///     // (that have an entry in E) do not count.
///     D::Rows row_values(int k, const State& x, const D::Input& u) const;
///     void row_derivatives(int k, const State& x, const D::Input& u,
///                          D::RowsX& C, D::RowsU& E) const;
///     const D::Rows& lower(int k) const;
///     const D::Rows& upper(int k) const;
///     const D::Rows& penalty(int k) const;
///
///     // only if equalities > 0: h(x) = 0 by weight; a weight of zero switches the row off
///     D::Equalities equality_values(int k, const State& x) const;
///     void equality_derivatives(int k, const State& x, D::EqualitiesX& H) const;
///     D::Equalities equality_weights(int k) const;
///
/// A problem may also have
///
///     using TransitionPattern = ...;  // which entries of A and B can be non-zero: FullTransition
///
///     // a quadratic penalty weight v^2 / 2 on a violation v, up to where its slope reaches the
///     // price: the multiplier is min(weight v, penalty); infinite: none
///     const D::Rows& quadratic_penalty(int k) const;
///
///     // constraints of node N that are not those of the other nodes, which then end at N - 1
///     static constexpr int terminal_rows;
///     TerminalRows terminal_row_values(const State& x) const;
///     void terminal_row_derivatives(const State& x, TerminalRowsX& C) const;
///     const TerminalRows& terminal_lower() const;    // likewise terminal_upper(),
///     const TerminalRows& terminal_penalty() const;  // terminal_quadratic_penalty()
///
///     // the intervals k .. k + count - 1, count <= 4, side by side; A and B are the identity and
///     // zero where nothing is written, x and u are those of node k and the following
///     void step_lanes(int k, int count, const State* x, const D::Input* u, State* ends,
///                     Eigen::Matrix<Lanes, nx, nx>& A, Eigen::Matrix<Lanes, nx, nu>& B) const;
///
/// All derivatives with respect to the state are in tangent coordinates, d/d(dx) of f(x (+) dx) at
/// dx = 0. A, B and H are set as a whole; entries of the model, C and E that are not set are what
/// they were set to for that node before, zero at first. None of these functions may throw or
/// allocate; they may return non-finite numbers, which the solver reports as a failure.
///
/// AutoDiffProblem makes such a type of four short functions, without derivatives by hand, and
/// check_derivatives() finds errors in those that are. A whole program: a pendulum (1 kg, 1 m, a
/// semi-implicit Euler step) swings up by a torque that is half of what would lift it. The tests
/// compile and run these very lines.
///
/// ```cpp
/// #include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
/// #include <tilt_ropter/optimal_control/multiple_shooting.hpp>
///
/// struct Pendulum {
///   static constexpr int states = 2, inputs = 1, residuals = 3, rows = 1;
///   template <typename S> using Vector2 = Eigen::Matrix<S, 2, 1>;  // angle from upright, its rate
///   template <typename S> using Vector1 = Eigen::Matrix<S, 1, 1>;  // torque [N m]
///
///   int horizon() const { return 80; }
///   template <typename S>
///   Vector2<S> step(int, const Vector2<S>& x, const Vector1<S>& u) const {
///     using std::sin;
///     const S rate = x(1) + S(0.05) * (S(9.81) * sin(x(0)) + u(0));
///     return {x(0) + S(0.05) * rate, rate};
///   }
///   template <typename S>  // the cost is the square of its norm
///   Eigen::Matrix<S, 3, 1> residual(int, const Vector2<S>& x, const Vector1<S>& u) const {
///     return {x(0), S(0.3) * x(1), S(0.3) * u(0)};
///   }
///   template <typename S>
///   Vector1<S> constraints(int, const Vector2<S>&, const Vector1<S>& u) const { return u; }
///   Vector1<double> lower(int) const { return Vector1<double>(-5.0); }
///   Vector1<double> upper(int) const { return Vector1<double>(5.0); }
/// };
///
/// int main() {
///   tilt_ropter::MultipleShooting solver{tilt_ropter::AutoDiffProblem<Pendulum>()};
///   const Eigen::Vector2d hanging(3.14, 0.0);
///   solver.reset(hanging);  // the guess: it stays there
///   const bool solved = solver.solve(hanging).status == tilt_ropter::SolveStatus::converged;
///
///   // In a loop, every 0.05 s: the plan moves on, what needs no measurement is done before it
///   // comes, the little rest after it; solver.input(0) is the torque to apply.
///   solver.shift(1.0);
///   const auto prepared = solver.prepare();
///   solver.feedback({3.13, -0.2});
///   return solved && prepared == tilt_ropter::PrepareStatus::prepared ? 0 : 1;
/// }
/// ```
// clang-format on
namespace tilt_ropter {

/// Vector and matrix types of a problem.
template <typename Problem>
struct ProblemDimensions {
  static constexpr int nx = Problem::states, nu = Problem::inputs, nc = Problem::rows,
                       ne = Problem::equalities;
  using Tangent = Eigen::Matrix<double, nx, 1>;
  using Input = Eigen::Matrix<double, nu, 1>;
  using A = Eigen::Matrix<double, nx, nx>;
  using B = Eigen::Matrix<double, nx, nu>;
  using Rows = Eigen::Matrix<double, nc, 1>;
  using RowsX = Eigen::Matrix<double, nc, nx>;
  using RowsU = Eigen::Matrix<double, nc, nu>;
  using Equalities = Eigen::Matrix<double, ne, 1>;
  using EqualitiesX = Eigen::Matrix<double, ne, nx>;
};

/// Quadratic model of a node's cost,
/// l + lx' dx + lu' du + 1/2 dx' lxx dx + du' lux dx + 1/2 du' luu du, with symmetric lxx and luu.
template <int States, int Inputs>
class QuadraticModel {
 public:
  static constexpr int width = States + Inputs, rows = detail::padded(width);

  [[nodiscard]] auto lx() { return gradient.template head<States>(); }
  [[nodiscard]] auto lu() { return gradient.template segment<Inputs>(States); }
  [[nodiscard]] auto lxx() { return hessian.template topLeftCorner<States, States>(); }
  [[nodiscard]] auto lux() { return hessian.template block<States, Inputs>(0, States).transpose(); }
  [[nodiscard]] auto luu() { return hessian.template block<Inputs, Inputs>(States, States); }
  [[nodiscard]] auto lx() const { return gradient.template head<States>(); }
  [[nodiscard]] auto lu() const { return gradient.template segment<Inputs>(States); }
  [[nodiscard]] auto lxx() const { return hessian.template topLeftCorner<States, States>(); }
  [[nodiscard]] auto lux() const {
    return hessian.template block<States, Inputs>(0, States).transpose();
  }
  [[nodiscard]] auto luu() const { return hessian.template block<Inputs, Inputs>(States, States); }

  /// How the solver has it: in the order (dx, du), filled up with zeros to whole packets; lux' in
  /// the columns of du alone.
  Eigen::Matrix<double, rows, width> hessian = detail::Filled();
  Eigen::Matrix<double, rows, 1> gradient = detail::Filled();
};

/// Which entries of [A B] can be non-zero: here all. A problem that knows better says so in a type
/// of this form named TransitionPattern, and the solver is faster by what it need not multiply.
struct FullTransition {
  static constexpr bool nonzero(int /*row*/, int /*column*/) { return true; }
};

/// The TransitionPattern of a problem, or FullTransition where it names none.
template <typename Problem, typename = void>
struct TransitionPatternOf {
  using type = FullTransition;
};
/// For a problem that names its own.
template <typename Problem>
struct TransitionPatternOf<Problem, std::void_t<typename Problem::TransitionPattern>> {
  using type = typename Problem::TransitionPattern;
};

}  // namespace tilt_ropter
