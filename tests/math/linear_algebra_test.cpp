#include <tilt_ropter/math/detail/linear_algebra.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace linear_algebra_test {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

TEST(Entries, FilledConvertsToAnyFixedSizeMatrix) {
  const Eigen::Matrix<double, 3, 5> zeros = detail::Filled();
  EXPECT_EQ(zeros, (Eigen::Matrix<double, 3, 5>::Zero()));
  const Eigen::Matrix<float, 4, 1> halves = detail::Filled{0.5};
  EXPECT_EQ(halves, Eigen::Vector4f::Constant(0.5f));
  const Eigen::Matrix<double, 2, 3, Eigen::RowMajor> row_major = detail::Filled{-infinity};
  EXPECT_TRUE((row_major.array() == -infinity).all());
  struct Settings {
    Eigen::Vector3d weights = detail::Filled{7.0};
  };
  EXPECT_EQ(Settings().weights, Eigen::Vector3d::Constant(7.0));
}

TEST(Entries, FillSetsEveryEntryOfAnySize) {
  Eigen::Matrix3d fixed = Eigen::Matrix3d::Random();
  detail::fill(fixed, 2.0);
  EXPECT_EQ(fixed, Eigen::Matrix3d::Constant(2.0));
  Eigen::MatrixXf dynamic = Eigen::MatrixXf::Random(4, 7);
  detail::fill(dynamic, -0.25);
  EXPECT_EQ(dynamic, Eigen::MatrixXf::Constant(4, 7, -0.25f));
  Eigen::VectorXd empty;
  detail::fill(empty, 1.0);
  EXPECT_EQ(empty.size(), 0);
}

TEST(Entries, CopyFirstLeavesTheRest) {
  const Eigen::Vector4d from(1.0, 2.0, 3.0, 4.0);
  for (int count = 0; count <= 4; ++count) {
    Eigen::VectorXd to = Eigen::VectorXd::Constant(6, -1.0);
    detail::copy_first(count, from, to);
    EXPECT_EQ(to.head(count), from.head(count)) << count;
    EXPECT_EQ(to.tail(6 - count), Eigen::VectorXd::Constant(6 - count, -1.0)) << count;
  }
}

TEST(Products, AreThoseOfEigen) {
  const Eigen::Matrix<double, 5, 3> a = Eigen::Matrix<double, 5, 3>::Random();
  const Eigen::Matrix<double, 3, 4> b = Eigen::Matrix<double, 3, 4>::Random();
  const Eigen::Matrix<double, 4, 3> c = Eigen::Matrix<double, 4, 3>::Random();
  const Eigen::Matrix<double, 5, 4> before = Eigen::Matrix<double, 5, 4>::Random();
  Eigen::Matrix<double, 5, 4> result = before;
  detail::add_product<5, 3, 4>(a.data(), detail::entries(b), result.data());
  EXPECT_LT((result - before - a * b).norm(), 1e-14);
  result = before;
  detail::add_product<5, 3, 4>(a.data(), detail::transposed_entries(c), result.data(), -2.0);
  EXPECT_LT((result - before + 2.0 * a * c.transpose()).norm(), 1e-14);
}

TEST(Products, SymmetriseTakesTheMeanOfBothTriangles) {
  const Eigen::Matrix4d before = Eigen::Matrix4d::Random();
  Eigen::Matrix4d m = before;
  detail::symmetrise(m);
  EXPECT_LT((m - 0.5 * (before + before.transpose())).norm(), 1e-15);
  EXPECT_EQ(m, m.transpose());
}

TEST(Entries, LargestIsMaximumNorm) {
  Eigen::Matrix<double, 2, 3> m;
  m << 1.0, -2.0, 3.0, -4.0, 0.0, 0.5;
  EXPECT_EQ(detail::largest(m), 4.0);
  for (Eigen::Index i = 0; i < m.size(); ++i) {
    Eigen::MatrixXd other = m;
    other(i) = i % 2 == 0 ? 5.0 : -5.0;
    EXPECT_EQ(detail::largest(other), 5.0) << i;
  }
  EXPECT_EQ(detail::largest(Eigen::VectorXd()), 0.0);
  EXPECT_EQ(detail::largest(Eigen::Vector3d::Zero().eval()), 0.0);
}

TEST(Entries, LargestIgnoresNanButNotInfinity) {
  for (Eigen::Index i = 0; i < 4; ++i) {
    Eigen::Vector4d v(1.0, -2.0, 2.0, -1.0);
    v(i) = nan;
    EXPECT_EQ(detail::largest(v), 2.0) << i;
    v(i) = -infinity;
    EXPECT_EQ(detail::largest(v), infinity) << i;
    v((i + 1) % 4) = nan;
    EXPECT_EQ(detail::largest(v), infinity) << i;
  }
  EXPECT_EQ(detail::largest(Eigen::Vector3d::Constant(nan).eval()), 0.0);
}

/// Eigen's form of a vector and of a matrix.
Eigen::Vector3d eigen(const detail::Triple<double>& a) {
  return {a.x, a.y, a.z};
}
Eigen::Matrix3d eigen(const detail::Square<double>& m) {
  Eigen::Matrix3d all;
  all << eigen(m.x), eigen(m.y), eigen(m.z);
  return all;
}
Eigen::Matrix3d cross_product_matrix(const Eigen::Vector3d& a) {
  return (Eigen::Matrix3d() << a.cross(Eigen::Vector3d::UnitX()), a.cross(Eigen::Vector3d::UnitY()),
          a.cross(Eigen::Vector3d::UnitZ()))
      .finished();
}
Eigen::MatrixXd random_matrix(test_support::Random& random, int rows, int columns) {
  return Eigen::MatrixXd::NullaryExpr(rows, columns, [&] { return random.normal(1.0); });
}

TEST(Triple, OperatorsMatchEigen) {
  test_support::Random random(1);
  for (int i = 0; i < 100; ++i) {
    const Eigen::Vector3d x = random_matrix(random, 3, 1), y = random_matrix(random, 3, 1),
                          z = random_matrix(random, 3, 1);
    const Eigen::Matrix3d A = random_matrix(random, 3, 3), B = random_matrix(random, 3, 3);
    const detail::Triple<double> a = detail::triple(x), b = detail::triple(y),
                                 c = detail::triple(z);
    const detail::Square<double> m = detail::square(A), n = detail::square(B);
    detail::Triple<double> sum = a;
    detail::Square<double> square_sum = m;
    sum += b;
    square_sum += n;
    EXPECT_EQ(eigen(sum), x + y);
    EXPECT_EQ(eigen(a + b), x + y);
    EXPECT_EQ(eigen(a - b), x - y);
    EXPECT_EQ(eigen(2.5 * a), 2.5 * x);
    EXPECT_EQ(eigen(scaled(a, b)), x.cwiseProduct(y));
    EXPECT_NEAR(dot(a, b), x.dot(y), 1e-14);
    EXPECT_LT((eigen(cross(a, b)) - x.cross(y)).norm(), 1e-14);
    EXPECT_EQ(eigen(square_sum), A + B);
    EXPECT_EQ(eigen(m + n), A + B);
    EXPECT_EQ(eigen(-0.5 * m), -0.5 * A);
    EXPECT_LT((eigen(m * a) - A * x).norm(), 1e-14);
    EXPECT_LT((eigen(m * n) - A * B).norm(), 1e-14);
    EXPECT_EQ(eigen(scaled(m, a)), x.asDiagonal() * A);
    EXPECT_EQ(eigen(transposed(m)), A.transpose());
    EXPECT_LT((eigen(times_cross(m, a)) - A * cross_product_matrix(x)).norm(), 1e-14);
    EXPECT_LT((eigen(outer(1.5, a, b, c)) - 1.5 * Eigen::Matrix3d::Identity() - x * y.transpose() -
               cross_product_matrix(z))
                  .norm(),
              1e-14);
  }
}

TEST(Triple, ReadsAndWritesBlocksOnly) {
  test_support::Random random(2);
  const Eigen::MatrixXd from = random_matrix(random, 7, 6);
  Eigen::MatrixXd to = from, expected = from;
  detail::put(detail::triple(from, 4, 5), to, 1, 0);
  detail::put(detail::square(from, 0, 1), to, 4, 3);
  expected.block<3, 1>(1, 0) = from.block<3, 1>(4, 5);
  expected.block<3, 3>(4, 3) = from.block<3, 3>(0, 1);
  EXPECT_EQ(to, expected);
}

TEST(Inverse, TimesMatrixIsIdentity) {
  test_support::Random random(3);
  for (int i = 0; i < 100; ++i) {
    const Eigen::Matrix3d m = random_matrix(random, 3, 3), inverse = detail::inverse(m);
    EXPECT_LT((m * inverse - Eigen::Matrix3d::Identity()).norm(),
              1e-14 * m.norm() * inverse.norm());
  }
  Eigen::Matrix3d singular = random_matrix(random, 3, 3);
  singular.row(2) << 0.0, 0.0, 0.0;
  EXPECT_FALSE(std::isfinite(detail::inverse(singular).sum()));
}

}  // namespace linear_algebra_test
}  // namespace tilt_ropter
