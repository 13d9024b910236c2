#include <tilt_ropter/math/detail/linear_algebra.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/QR>
#include <Eigen/SVD>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace linear_algebra_singular_values_test {

using detail::SingularValues;
using test_support::Random;

template <int Rows, int Columns>
Eigen::Matrix<double, Rows, Columns> random_matrix(Random& random) {
  Eigen::Matrix<double, Rows, Columns> A;
  for (Eigen::Index i = 0; i < A.size(); ++i) A(i) = random.normal(1.0);
  return A;
}

/// Returns the largest orthonormality error of the rows of `left` and `right`. Rows of `right` with
/// a singular value of zero must be zero.
template <int Rows, int Columns>
double skewness(const SingularValues<Rows, Columns>& svd) {
  Eigen::Matrix<double, Rows, Rows> identity = Eigen::Matrix<double, Rows, Rows>::Identity();
  const double left = (svd.left * svd.left.transpose() - identity).cwiseAbs().maxCoeff();
  for (int i = 0; i < Rows; ++i)
    if (svd.values(i) == 0.0) identity(i, i) = 0.0;
  return std::max(left, (svd.right * svd.right.transpose() - identity).cwiseAbs().maxCoeff());
}

/// Checks all properties that the header promises for a finite matrix, and compares the singular
/// values with Eigen.
template <int Rows, int Columns>
void expect_decomposition(const Eigen::Matrix<double, Rows, Columns>& A) {
  const SingularValues<Rows, Columns> svd(A);
  EXPECT_LE((svd.left * svd.values.asDiagonal() * svd.right - A).norm(), 1e-14 * A.norm());
  EXPECT_LT(skewness(svd), 1e-14);
  for (int i = 0; i < Rows; ++i) {
    EXPECT_GE(svd.values(i), 0.0);
    EXPECT_LE(svd.values(i), svd.values(std::max(0, i - 1)));
  }
#ifndef __ASSOCIATIVE_MATH__  // with -ffast-math of GCC, those of Eigen are NaN
  const Eigen::MatrixXd same = A;
  const Eigen::VectorXd values = Eigen::JacobiSVD<Eigen::MatrixXd>(same).singularValues();
  EXPECT_LE((svd.values - values).norm(), 1e-14 * A.norm());
#endif
}

template <int Rows, int Columns>
void expect_decompositions(Random& random) {
  SCOPED_TRACE(testing::Message() << Rows << " x " << Columns);
  for (int i = 0; i < 50; ++i)
    expect_decomposition<Rows, Columns>(random_matrix<Rows, Columns>(random));
}

TEST(SingularValues, MatchEigenForRandomMatrices) {
  Random random(1);
  expect_decompositions<1, 7>(random);
  expect_decompositions<6, 8>(random);
#ifdef TILT_ROPTER_FULL_TESTS  // each size takes a second to compile
  expect_decompositions<1, 1>(random);
  expect_decompositions<2, 2>(random);
  expect_decompositions<3, 4>(random);
  expect_decompositions<6, 6>(random);
  expect_decompositions<6, 12>(random);
  expect_decompositions<6, 16>(random);
  expect_decompositions<12, 12>(random);
#endif
}

TEST(SingularValues, MatchEigenForMatricesOfAnyRank) {
  Random random(2);
  for (int rank = 0; rank <= 6; ++rank)
    for (int i = 0; i < 50; ++i) {
      SCOPED_TRACE(rank);
      const Eigen::Matrix<double, 6, 6> onto = random_matrix<6, 6>(random);
      const Eigen::Matrix<double, 6, 8> from = random_matrix<6, 8>(random),
                                        A = onto.leftCols(rank) * from.topRows(rank);
      expect_decomposition<6, 8>(A);
      EXPECT_EQ((SingularValues<6, 8>(A).rank(1e-12)), rank);
    }
}

// Each row is 1e8 times larger than the next. To 1e-16, each singular value is then the length of
// its row after projection orthogonal to all larger rows. This length is the diagonal entry of a QR
// factorisation.
TEST(SingularValues, SmallValuesAreAccurateForRowsOfVeryDifferentSize) {
  Random random(3);
  double worst = 0.0;
  for (int i = 0; i < 200; ++i) {
    const Eigen::Matrix<double, 4, 6> directions = random_matrix<4, 6>(random);
    const Eigen::HouseholderQR<Eigen::MatrixXd> qr(directions.transpose());
    const Eigen::Vector4d sizes(1e-24, 1e-8, 1.0, 1e-16);
    Eigen::Matrix4d order = Eigen::Matrix4d::Zero();  // row, direction
    order(0, 3) = order(1, 1) = order(2, 0) = order(3, 2) = 1.0;
    const Eigen::Matrix<double, 4, 6> A = sizes.asDiagonal() * order * directions;
    const SingularValues<4, 6> svd(A);
    EXPECT_LT(skewness(svd), 1e-14);
    for (int k = 0; k < 4; ++k) {
      const double exact = std::abs(qr.matrixQR()(k, k)) * std::pow(1e-8, k);
      worst = std::max(worst, std::abs(svd.values(k) / exact - 1.0));
    }
  }
  EXPECT_LT(worst, 1e-14);
}

TEST(SingularValues, ScaleWithTheMatrix) {
  Random random(4);
#ifdef __ASSOCIATIVE_MATH__
  constexpr double large = 1e70;
#else
  constexpr double large = 1e140;
#endif
  for (const double scale : {1.0 / large, 1e-20, 1e20, large})
    for (int i = 0; i < 20; ++i) {
      const Eigen::Matrix<double, 6, 8> A = random_matrix<6, 8>(random), scaled = scale * A;
      const SingularValues<6, 8> svd(A), same(scaled);
      EXPECT_LT((same.values / scale - svd.values).norm(), 1e-14 * A.norm()) << scale;
      EXPECT_LT(skewness(same), 1e-14) << scale;
      EXPECT_EQ(same.rank(1e-9), 6) << scale;
    }
}

TEST(SingularValues, ZeroMatrixHasZeroValuesAndZeroRightRows) {
  const SingularValues<3, 5> svd(Eigen::Matrix<double, 3, 5>::Zero());
  EXPECT_EQ(svd.values, Eigen::Vector3d::Zero());
  EXPECT_EQ(svd.left, Eigen::Matrix3d::Identity());
  EXPECT_EQ(svd.right, (Eigen::Matrix<double, 3, 5>::Zero()));
  EXPECT_EQ(svd.rank(0.0), 0);

  // Two equal rows and a zero row. The zeros are exact, since a rotation by 45 degrees merges the
  // two rows.
  Eigen::Matrix<double, 3, 5> twins = Eigen::Matrix<double, 3, 5>::Zero();
  twins(0, 1) = twins(2, 1) = 3.0;
  const SingularValues<3, 5> of_twins(twins);
  EXPECT_NEAR(of_twins.values(0), 3.0 * std::sqrt(2.0), 1e-15);
  EXPECT_EQ(of_twins.values.tail<2>(), Eigen::Vector2d::Zero());
  EXPECT_EQ(of_twins.right.bottomRows<2>(), (Eigen::Matrix<double, 2, 5>::Zero()));
  EXPECT_EQ(of_twins.rank(0.0), 1);
}

TEST(SingularValues, RankCountsValuesAboveFractionOfLargest) {
  Eigen::Matrix3d A = Eigen::Matrix3d::Zero();
  A.diagonal() << 0.25, 1.0, 0.5;
  const SingularValues<3, 3> svd(A);
  EXPECT_EQ(svd.values, Eigen::Vector3d(1.0, 0.5, 0.25));
  EXPECT_EQ(svd.rank(0.0), 3);
  EXPECT_EQ(svd.rank(0.24), 3);
  EXPECT_EQ(svd.rank(0.25), 2);
  EXPECT_EQ(svd.rank(0.5), 1);
  EXPECT_EQ(svd.rank(1.0), 0);
}

// A check of the rank therefore rejects such a matrix. Exactly one singular value is not finite.
TEST(SingularValues, NonFiniteMatrixNeverHasFullRank) {
  Random random(5);
  using Limits = std::numeric_limits<double>;
  for (const double bad : {Limits::quiet_NaN(), Limits::infinity(), -Limits::infinity(), 1e200})
    for (Eigen::Index i = 0; i < 6 * 8; ++i) {
      Eigen::Matrix<double, 6, 8> A = random_matrix<6, 8>(random);
      A(i) = bad;
      const SingularValues<6, 8> svd(A);
      EXPECT_EQ(std::count_if(svd.values.begin(), svd.values.end(),
                              [](double value) { return !std::isfinite(value); }),
                1)
          << bad << " at " << i;
      EXPECT_LT(svd.rank(1e-9), 6) << bad << " at " << i;
      EXPECT_LT(svd.rank(0.0), 6) << bad << " at " << i;
    }
}

}  // namespace linear_algebra_singular_values_test
}  // namespace tilt_ropter
