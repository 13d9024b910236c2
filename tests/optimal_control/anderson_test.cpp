#include <tilt_ropter/optimal_control/detail/step_search.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>
#include <Eigen/LU>
#include <Eigen/QR>

#include <cmath>

namespace tilt_ropter::optimal_control {
namespace anderson_test {

using test_support::Random;

Eigen::VectorXd random_vector(Random& random, Eigen::Index size) {
  Eigen::VectorXd v(size);
  for (double& entry : v) entry = random.normal(1.0);
  return v;
}

/// Iteration x <- x + f(x) with f(x) = b - A x. It multiplies the error's components by `factors`.
struct LinearIteration {
  Eigen::MatrixXd A;
  Eigen::VectorXd b;

  LinearIteration(Random& random, const Eigen::VectorXd& factors) {
    const Eigen::Index n = factors.size();
    Eigen::MatrixXd skewed(n, n);
    for (Eigen::Index i = 0; i < n; ++i) skewed.col(i) = random_vector(random, n);
    const Eigen::MatrixXd q = Eigen::HouseholderQR<Eigen::MatrixXd>(skewed).householderQ();
    skewed = q + 0.2 / std::sqrt(static_cast<double>(n)) * skewed;  // eigenvectors not orthogonal
    A = skewed * (1.0 - factors.array()).matrix().asDiagonal() * skewed.inverse();
    b = random_vector(random, n);
  }

  [[nodiscard]] Eigen::VectorXd f(const Eigen::VectorXd& x) const { return b - A * x; }

  /// Returns |f| after `moves` accelerated moves from zero, relative to |f| at zero.
  [[nodiscard]] double accelerated(int moves, int memory) const {
    Anderson anderson(b.size(), memory);
    Eigen::VectorXd x = Eigen::VectorXd::Zero(b.size()), here = f(x);
    for (int i = 0; i < moves; ++i) {
      const Eigen::VectorXd move = anderson.step(here);
      x += move;
      const Eigen::VectorXd there = f(x);
      anderson.add(move, here, there);
      here = there;
    }
    return here.norm() / b.norm();
  }
  [[nodiscard]] double plain(int moves) const {
    Eigen::VectorXd x = Eigen::VectorXd::Zero(b.size());
    for (int i = 0; i < moves; ++i) x += f(x);
    return f(x).norm() / b.norm();
  }
};

// The least-squares problem is regularised with 1e-10. If the moves are far from parallel, the
// error after n + 1 moves comes from the regularisation only. Otherwise one more move is needed.
TEST(Anderson, SolvesLinearIterationWithinDimensionPlusTwoMoves) {
  Random random(81);
  for (int n = 1; n <= 6; ++n)
    for (int i = 0; i < 20; ++i) {
      Eigen::VectorXd factors(n);
      for (double& factor : factors) factor = random.uniform(-0.9, 0.9);
      const LinearIteration iteration(random, factors);
      EXPECT_LT(iteration.accelerated(n + 1, n), 1e-3) << "dimension " << n;
      EXPECT_LT(iteration.accelerated(n + 2, n), 1e-9) << "dimension " << n;
    }
}

TEST(Anderson, ConvergesWhereThePlainIterationDivergesOrIsSlow) {
  Random random(82);
  for (int i = 0; i < 20; ++i) {
    Eigen::VectorXd factors(4);
    factors << -15.0, -2.0, 0.5, 0.999;
    const LinearIteration both(random, factors);
    EXPECT_GT(both.plain(6), 1e3);
    EXPECT_LT(both.accelerated(6, 4), 1e-9);

    factors << 0.999, 0.99, 0.9, 0.0;
    const LinearIteration creeping(random, factors);
    EXPECT_GT(creeping.plain(100), 1e-3);
    EXPECT_LT(creeping.accelerated(6, 4), 1e-9);
  }
}

TEST(Anderson, ShortMemoryStillBeatsThePlainIteration) {
  Random random(83);
  const Eigen::VectorXd factors = Eigen::VectorXd::LinSpaced(30, -0.5, 0.995);
  for (int i = 0; i < 20; ++i) {
    const LinearIteration iteration(random, factors);
    const double plain = iteration.plain(60);
    EXPECT_LT(iteration.accelerated(60, 2), 0.5 * plain);
    EXPECT_LT(iteration.accelerated(60, 5), 0.1 * plain);
    EXPECT_LT(iteration.accelerated(60, 30), 1e-3 * plain);
  }
}

TEST(Anderson, RepeatedAndZeroMovesDoNoHarm) {
  Random random(84);
  for (int i = 0; i < 20; ++i) {
    const Eigen::VectorXd move = random_vector(random, 3), before = random_vector(random, 3),
                          after = random_vector(random, 3);
    const Eigen::VectorXd f = random_vector(random, 3), zero = Eigen::VectorXd::Zero(3);
    Anderson once(3, 8), often(3, 8), nothing(3, 8);
    once.add(move, before, after);
    for (int k = 0; k < 10; ++k) {  // more than the memory holds
      often.add(move, before, after);
      nothing.add(zero, before, before);
    }
    EXPECT_LT((often.step(f) - once.step(f)).norm(), 1e-6 * once.step(f).norm());
    EXPECT_EQ(nothing.step(f), f);
    nothing.add(move, before, after);
    EXPECT_LT((nothing.step(f) - once.step(f)).norm(), 1e-12 * once.step(f).norm());
    EXPECT_LT(often.step(zero).norm(), 1e-12);
  }
}

TEST(Anderson, MoreMovesThanDimensionsStillGiveASecantStep) {
  Random random(85);
  const LinearIteration iteration(random, Eigen::Vector2d(-3.0, 0.9));
  Anderson anderson(2, 8);
  for (int i = 0; i < 20; ++i) {
    const Eigen::VectorXd move = random_vector(random, 2);
    const Eigen::VectorXd from = random_vector(random, 2);
    anderson.add(move, iteration.f(from), iteration.f(from + move));
  }
  const Eigen::VectorXd x = random_vector(random, 2);
  const Eigen::VectorXd end = x + anderson.step(iteration.f(x));
  EXPECT_LT(iteration.f(end).norm(), 1e-6 * iteration.f(x).norm());
}

TEST(Anderson, ClearForgetsEverything) {
  Random random(86);
  Anderson used(4, 3), fresh(4, 3);
  EXPECT_TRUE(used.empty());
  for (int i = 0; i < 5; ++i)
    used.add(random_vector(random, 4), random_vector(random, 4), random_vector(random, 4));
  EXPECT_FALSE(used.empty());
  used.clear();
  EXPECT_TRUE(used.empty());
  const Eigen::VectorXd f = random_vector(random, 4);
  EXPECT_EQ(used.step(f), f);
  for (int i = 0; i < 5; ++i) {
    const Eigen::VectorXd move = random_vector(random, 4), before = random_vector(random, 4),
                          after = random_vector(random, 4);
    used.add(move, before, after);
    fresh.add(move, before, after);
    EXPECT_EQ(used.step(f), fresh.step(f));
  }
}

}  // namespace anderson_test
}  // namespace tilt_ropter::optimal_control
