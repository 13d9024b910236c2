// Second derivatives of a cost, of the dynamics and of constraints, against closed forms. What is
// not convex is left out.

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>

namespace tilt_ropter::optimal_control {
namespace auto_diff_problem_second_derivatives_test {

template <typename S, int Size>
using Vector = Eigen::Matrix<S, Size, 1>;

// Two directions of (x, u) at a right angle, and weights of the squares along them.
const Eigen::Vector3d first = Eigen::Vector3d(1.0, 2.0, 2.0) / 3.0,
                      second = Eigen::Vector3d(2.0, 1.0, -2.0) / 3.0;

struct Bent {
  static constexpr int states = 2, inputs = 1, constraints = 1;
  static constexpr bool curvature = true;
  double along_first = 0.0, along_second = 0.0;

  int horizon() const { return 3; }
  template <typename S>
  static Vector<S, 2> step(int, const Vector<S, 2>& x, const Vector<S, 1>& u) {
    return {x(0) + x(1) * u(0), x(1)};
  }
  template <typename S>
  S cost(int, const Vector<S, 2>& x, const Vector<S, 1>& u) const {
    const auto along = [&](const Eigen::Vector3d& d) {
      return S(S(d(0)) * x(0) + S(d(1)) * x(1) + S(d(2)) * u(0));
    };
    const S a = along(first), b = along(second);
    return S(S(along_first) * a * a + S(along_second) * b * b + S(7.0) * x(0));
  }
  template <typename S>
  static Vector<S, 1> constraint_values(int, const Vector<S, 2>& x, const Vector<S, 1>&) {
    return Vector<S, 1>(x(0) * x(0));
  }
  static Vector<double, 1> lower(int) { return Vector<double, 1>(-1.0); }
  static Vector<double, 1> upper(int) { return Vector<double, 1>(1.0); }
};
using Problem = AutoDiffProblem<Bent>;

const Eigen::Vector2d x(0.3, -0.4);
const Vector<double, 1> u(0.5);

// The Hessian in the order (x, u): the model has the lower left part alone.
Eigen::Matrix3d hessian_of(const Problem::Model& model) {
  Eigen::Matrix3d hessian;
  hessian << model.lxx(), model.lux().transpose(), model.lux(), model.luu();
  return hessian;
}

TEST(SecondDerivatives, OfACostEnterWithoutTheirConcavePart) {
  struct Weights {
    double first, second;
  };
  // The third has eigenvalues of one size and both signs.
  for (const auto& [along_first, along_second] :
       {Weights{3.0, 2.0}, {3.0, -5.0}, {4.0, -4.0}, {-1.0, -2.0}, {0.0, 0.0}}) {
    SCOPED_TRACE(along_second);
    const Problem problem(Bent{along_first, along_second});
    Problem::Model model;
    problem.cost_model(1, x, u, model);
    const Eigen::Vector3d at(x(0), x(1), u(0)),
        slope = 2.0 * along_first * first.dot(at) * first +
                2.0 * along_second * second.dot(at) * second + Eigen::Vector3d(7.0, 0.0, 0.0);
    const Eigen::Matrix3d convex = 2.0 * std::max(along_first, 0.0) * first * first.transpose() +
                                   2.0 * std::max(along_second, 0.0) * second * second.transpose();
    EXPECT_LT((model.gradient.head<3>() - slope).norm(), 1e-14);
    EXPECT_LT((hessian_of(model) - convex).norm(), 1e-13);
  }
}

TEST(SecondDerivatives, OfTheLastNodeAreThoseByTheState) {
  const Problem problem(Bent{0.0, -4.0});
  Problem::Model model;
  problem.cost_model(3, x, u, model);
  EXPECT_TRUE(model.lxx().isZero(0.0));  // the block of the state is concave
  model.lxx() = Eigen::Vector2d(1.0, 2.0).asDiagonal();
  problem.add_curvature(3, x, u, Vector<double, 1>(5.0), Eigen::Vector2d(1.0, 1.0), model);
  EXPECT_LT((model.lxx() - Eigen::Matrix2d(Eigen::Vector2d(11.0, 2.0).asDiagonal())).norm(), 1e-13);
}

TEST(SecondDerivatives, OfDynamicsAndConstraintsAreAddedBeforeTheConcavePartGoes) {
  const Problem problem(Bent{});
  const auto curved = [&](double costate, double multiplier, const Eigen::Matrix3d& before) {
    Problem::Model model;
    problem.cost_model(1, x, u, model);
    model.lxx() = before.topLeftCorner<2, 2>();
    model.lux() = before.bottomLeftCorner<1, 2>();
    model.luu() = before.bottomRightCorner<1, 1>();
    problem.add_curvature(1, x, u, Vector<double, 1>(multiplier), Eigen::Vector2d(costate, 9.0),
                          model);
    return hessian_of(model);
  };
  // x(1) u(0) has the curvatures 1 and -1.
  const Eigen::Vector3d together(0.0, 1.0, 1.0), state = Eigen::Vector3d::UnitX();
  const Eigen::Matrix3d none = Eigen::Matrix3d::Zero(),
                        convex = together * together.transpose() + 4.0 * state * state.transpose();
  EXPECT_LT((curved(2.0, 2.0, none) - convex).norm(), 1e-13);
  EXPECT_LT((curved(0.0, -2.0, none)).norm(), 1e-13);
  // A cost that is convex enough keeps everything.
  Eigen::Matrix3d all = 10.0 * Eigen::Matrix3d::Identity();
  all(0, 0) -= 4.0;
  all(1, 2) = all(2, 1) = 2.0;
  EXPECT_LT((curved(2.0, -2.0, 10.0 * Eigen::Matrix3d::Identity()) - all).norm(), 1e-13);
}

}  // namespace auto_diff_problem_second_derivatives_test
}  // namespace tilt_ropter::optimal_control
