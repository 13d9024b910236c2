#pragma once

#include <Eigen/Core>

#include <type_traits>

// clang-format off
/// What a multiple-shooting problem is made of. A problem is any type `Problem` with
///
///     static constexpr int states, inputs;    // dimensions of the tangent space and of the input
///     static constexpr int rows, equalities;  // counts per node
///     using State = ...;                      // a point of the state manifold
///     using D = ProblemDimensions<Problem>;   // the vector and matrix types below
///     using TransitionBlocks = ...;  // optional, what of A and B can be non-zero: FullTransition
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
///     // rows: lower <= c(x, u) <= upper; an infinite bound is no bound; the penalty bounds a
///     // row's multiplier: the price of violating it by one unit
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
/// All derivatives with respect to the state are in tangent coordinates, d/d(dx) of f(x (+) dx) at
/// dx = 0. A, B and H are set as a whole; entries of the model, C and E that are not set are what
/// they were set to for that node before, zero at first. None of these functions may throw or
/// allocate; they may return non-finite numbers, which the solver reports as a failure.
///
/// A whole program: a pendulum (1 kg, 1 m, a semi-implicit Euler step) swings up by a torque that
/// is half of what would lift it. The tests compile and run these very lines.
///
/// ```cpp
/// #include <tilt_ropter/optimal_control/multiple_shooting.hpp>
///
/// #include <cmath>
///
/// struct Pendulum {
///   static constexpr int states = 2, inputs = 1, rows = 1, equalities = 0;
///   using State = Eigen::Vector2d;  // angle from upright [rad] and its rate [rad/s]
///   using D = tilt_ropter::ProblemDimensions<Pendulum>;
///   using Input = D::Input;  // torque [N m]
///   using Model = tilt_ropter::QuadraticModel<states, inputs>;
///   double h = 0.05, g = 9.81;
///   State weight{1.0, 0.1};
///   D::Rows most = D::Rows(5.0), least = -most, price = D::Rows(1e4);
///
///   int horizon() const { return 80; }
///   State retract(const State& x, const State& dx) const { return x + dx; }
///   State difference(const State& y, const State& x) const { return y - x; }
///   State step(int, const State& x, const Input& u) const {
///     const double rate = x(1) + h * (g * std::sin(x(0)) + u(0));
///     return {x(0) + h * rate, rate};
///   }
///   State step(int k, const State& x, const Input& u, D::A& A, D::B& B) const {
///     const double slope = h * g * std::cos(x(0));
///     A << 1.0 + h * slope, h, slope, 1.0;
///     B << h * h, h;
///     return step(k, x, u);
///   }
///   double cost(int, const State& x, const Input& u) const {
///     return x.dot(weight.cwiseProduct(x)) + 0.1 * u.squaredNorm();
///   }
///   void cost_model(int, const State& x, const Input& u, Model& m) const {
///     m.lx = 2.0 * weight.cwiseProduct(x);
///     m.lxx = 2.0 * weight.asDiagonal();
///     m.lu = 0.2 * u;
///     m.luu << 0.2;
///   }
///   Input row_values(int, const State&, const Input& u) const { return u; }
///   void row_derivatives(int, const State&, const Input&, D::RowsX&, D::RowsU& E) const {
///     E << 1.0;
///   }
///   const D::Rows& lower(int) const { return least; }
///   const D::Rows& upper(int) const { return most; }
///   const D::Rows& penalty(int) const { return price; }
/// };
///
/// int main() {
///   tilt_ropter::MultipleShooting<Pendulum> solver(Pendulum{});
///   const Pendulum::State hanging(3.14, 0.0);
///   solver.reset(hanging);  // the guess: it stays there
///   const bool solved = solver.solve(hanging).status == tilt_ropter::SolveStatus::converged;
///
///   // In a loop, every 0.05 s: the plan moves on, what needs no measurement is done before it
///   // comes, the little rest after it; solver.input(0) is the torque to apply.
///   solver.shift(1.0);
///   const bool prepared = solver.prepare();
///   solver.feedback({3.13, -0.2});
///   return solved && prepared ? 0 : 1;
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

/// Quadratic model of a node's cost:
/// l + lx' dx + lu' du + 1/2 dx' lxx dx + du' lux dx + 1/2 du' luu du.
template <int States, int Inputs>
struct QuadraticModel {
  Eigen::Matrix<double, States, 1> lx = Eigen::Matrix<double, States, 1>::Zero();
  Eigen::Matrix<double, Inputs, 1> lu = Eigen::Matrix<double, Inputs, 1>::Zero();
  Eigen::Matrix<double, States, States> lxx = Eigen::Matrix<double, States, States>::Zero();
  Eigen::Matrix<double, Inputs, States> lux = Eigen::Matrix<double, Inputs, States>::Zero();
  Eigen::Matrix<double, Inputs, Inputs> luu = Eigen::Matrix<double, Inputs, Inputs>::Zero();
};

/// Which square blocks of [A B] can be non-zero: here all. A problem that knows better says so in a
/// type of this form named TransitionBlocks, and the solver is faster by what it need not multiply.
template <int States, int Inputs>
struct FullTransition {
  static constexpr bool divides(int n) { return States % n == 0 && Inputs % n == 0; }
  static constexpr int size = divides(4) ? 4 : divides(3) ? 3 : divides(2) ? 2 : 1;  ///< of a block
  static constexpr bool nonzero(int /*row*/, int /*column*/) { return true; }
};

/// The TransitionBlocks of a problem, or FullTransition where it names none.
template <typename Problem, typename = void>
struct TransitionBlocksOf {
  using type = FullTransition<Problem::states, Problem::inputs>;
};
/// For a problem that names its own.
template <typename Problem>
struct TransitionBlocksOf<Problem, std::void_t<typename Problem::TransitionBlocks>> {
  using type = typename Problem::TransitionBlocks;
};

}  // namespace tilt_ropter
