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

template <typename Problem, typename = void>
struct TransitionBlocksOf {
  using type = FullTransition<Problem::states, Problem::inputs>;
};
template <typename Problem>
struct TransitionBlocksOf<Problem, std::void_t<typename Problem::TransitionBlocks>> {
  using type = typename Problem::TransitionBlocks;
};

}  // namespace tilt_ropter
