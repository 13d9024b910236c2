#include <tilt_ropter/math/detail/linear_algebra.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <cstddef>
#include <limits>
#include <vector>

namespace tilt_ropter {
namespace linear_algebra_cholesky_test {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using test_support::Random;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

/// Value of numbers that must not be read or written. Code that reads it has an error of this size.
constexpr double guard = 1e9;

constexpr int largest_size = 40;       // ten packets of four
constexpr int gaps[] = {0, 1, 3, 24};  // stride minus size

MatrixXd random_matrix(Random& random, int rows, int columns) {
  MatrixXd m(rows, columns);
  for (Eigen::Index i = 0; i < m.size(); ++i) m(i) = random.normal(1.0);
  return m;
}
VectorXd random_vector(Random& random, int size) {
  return random_matrix(random, size, 1);
}

/// Positive definite, with a condition number below 1000.
MatrixXd random_definite(Random& random, int n) {
  const MatrixXd m = random_matrix(random, n, n);
  return m * m.transpose() + 0.2 * (n + 1) * MatrixXd::Identity(n, n);
}

/// Columns that are `stride` numbers apart, with guards in the gaps and after the end.
struct Strided {
  int n;
  std::ptrdiff_t stride;
  std::vector<double> numbers;

  Strided(const MatrixXd& m, int gap)
      : n(static_cast<int>(m.rows())),
        stride(n + gap),
        numbers(static_cast<std::size_t>(stride * m.cols() + 1), guard) {
    for (int j = 0; j < m.cols(); ++j)
      for (int i = 0; i < n; ++i) at(i, j) = m(i, j);
  }

  double& at(int i, int j) { return numbers[static_cast<std::size_t>(stride * j + i)]; }

  /// Writes guards above the diagonal, too.
  void guard_upper_triangle() {
    for (int j = 0; j < n; ++j)
      for (int i = 0; i < j; ++i) at(i, j) = guard;
  }

  /// Returns the lower triangle. Fails if a guard was overwritten.
  MatrixXd lower_triangle() {
    MatrixXd lower = MatrixXd::Zero(n, n);
    for (int j = 0; j < n; ++j)
      for (int i = 0; i < stride; ++i) {
        if (i >= j && i < n)
          lower(i, j) = at(i, j);
        else
          EXPECT_EQ(at(i, j), guard) << "at " << i << ", " << j;
      }
    EXPECT_EQ(numbers.back(), guard);
    return lower;
  }
};

/// Returns the vector with a guard after its end. without_guard() fails if it was overwritten.
std::vector<double> guarded(const VectorXd& v) {
  std::vector<double> numbers(v.begin(), v.end());
  numbers.push_back(guard);
  return numbers;
}
VectorXd without_guard(const std::vector<double>& numbers) {
  EXPECT_EQ(numbers.back(), guard);
  return Eigen::Map<const VectorXd>(numbers.data(), static_cast<Eigen::Index>(numbers.size()) - 1);
}

double error(const VectorXd& a, const VectorXd& b) {
  return a.size() == 0 ? 0.0 : (a - b).cwiseAbs().maxCoeff();
}

/// Factorises a copy of A with guards in its upper triangle and solves A y = x.
struct Solution {
  int dropped;
  MatrixXd L;
  VectorXd y;

  Solution(const MatrixXd& A, const VectorXd& x, double least = 0.0, int gap = 3) {
    Strided matrix(A, gap);
    matrix.guard_upper_triangle();
    dropped = detail::factorise(matrix.numbers.data(), matrix.stride, matrix.n, least);
    L = matrix.lower_triangle();
    std::vector<double> numbers = guarded(x);
    detail::solve_factorised(matrix.numbers.data(), matrix.stride, matrix.n, numbers.data());
    y = without_guard(numbers);
  }
};

TEST(Cholesky, ProductsMatchEigenAtAnySizeAndStride) {
  Random random(1);
  for (int rows = 0; rows <= largest_size; ++rows)
    for (const int columns : {0, 1, 2, 7, largest_size})
      for (const int gap : gaps) {
        SCOPED_TRACE(testing::Message() << rows << " x " << columns << ", gap " << gap);
        const MatrixXd M = random_matrix(random, rows, columns);
        const VectorXd x = random_vector(random, columns), before = random_vector(random, rows);
        Strided m(M, gap), row(x.transpose(), gap);
        std::vector<double> result = guarded(before);
        detail::add_product(-0.7, {m.numbers.data(), rows, columns, m.stride},
                            {row.numbers.data(), row.stride}, result.data());
        EXPECT_LT(error(without_guard(result), before - 0.7 * M * x), 1e-13);
      }
}

TEST(Cholesky, DotMatchesEigenAtAnySize) {
  Random random(2);
  for (int n = 0; n <= largest_size; ++n)
    for (int i = 0; i < 10; ++i) {
      const VectorXd a = random_vector(random, n), b = random_vector(random, n);
      EXPECT_NEAR(detail::dot(guarded(a).data(), guarded(b).data(), n), a.dot(b), 1e-13) << n;
    }
}

TEST(Cholesky, FactorAndSolutionMatchEigenAtAnySizeAndStride) {
  Random random(3);
  for (int n = 0; n <= largest_size; ++n)
    for (const int gap : gaps) {
      SCOPED_TRACE(testing::Message() << "size " << n << ", gap " << gap);
      const MatrixXd A = random_definite(random, n);
      const VectorXd x = random_vector(random, n);
      const Solution solution(A, x, 0.0, gap);
      EXPECT_EQ(solution.dropped, 0);
      if (n == 0) continue;  // Eigen has no norm of an empty matrix
      const Eigen::LLT<MatrixXd> llt(A);
      EXPECT_LT((solution.L - MatrixXd(llt.matrixL())).norm(), 1e-13 * A.norm());
      EXPECT_LT(error(solution.y, llt.solve(x)), 1e-13 * x.norm());
    }
}

TEST(Cholesky, DropsDependentColumnsAndSolvesTheRest) {
  Random random(4);
  for (int n = 2; n <= largest_size; n += 3)
    for (int rank = 1; rank < n; rank += 4) {
      SCOPED_TRACE(testing::Message() << "size " << n << ", rank " << rank);
      // `rank` independent columns at random positions. Each of the other columns is a linear
      // combination of the columns before it.
      MatrixXd columns = random_matrix(random, n, n);
      std::vector<bool> independent(static_cast<std::size_t>(n), false);
      for (int j = 0, k = 0; j < n; ++j) {
        const bool last_chance = n - j == rank - k;
        if (k == 0 || last_chance || (k < rank && random.uniform(0.0, 1.0) < 0.5)) {
          independent[static_cast<std::size_t>(j)] = true;
          ++k;
        } else {
          columns.col(j) = columns.leftCols(j) * random_vector(random, j);
          columns.col(j).normalize();
        }
      }
      const MatrixXd A = columns.transpose() * columns;
      const VectorXd x = random_vector(random, n);
      const Solution solution(A, x, 1e-9);
      EXPECT_EQ(solution.dropped, n - rank);
      EXPECT_LT((solution.L * solution.L.transpose() - A).norm(), 1e-9 * A.norm());

      std::vector<int> kept;
      for (int j = 0; j < n; ++j) {
        if (independent[static_cast<std::size_t>(j)]) {
          kept.push_back(j);
        } else {
          EXPECT_EQ(solution.L.col(j), VectorXd::Zero(n)) << "column " << j;
          EXPECT_EQ(solution.y(j), 0.0);
        }
      }
      const VectorXd rest = MatrixXd(A(kept, kept)).llt().solve(VectorXd(x(kept)));
      EXPECT_LT(error(solution.y(kept), rest), 1e-6 * rest.norm());
    }
}

TEST(Cholesky, DropsPivotsUpToTheFractionLeastOfTheDiagonal) {
  Eigen::Matrix2d A;
  A << 4.0, 2.0, 2.0, 2.0;                             // second pivot: 1, half of the diagonal 2
  for (const double scale : {0x1p-60, 1.0, 0x1p60}) {  // of the second row and column
    const Eigen::Vector2d scales(1.0, scale), x(4.0, 3.0 * scale);
    const MatrixXd scaled = scales.asDiagonal() * A * scales.asDiagonal();
    for (const double least : {0.0, 0.49}) {
      const Solution solution(scaled, x, least);
      EXPECT_EQ(solution.dropped, 0);
      EXPECT_EQ(solution.y, Eigen::Vector2d(0.5, 1.0 / scale));
    }
    for (const double least : {0.5, 0.6}) {
      const Solution solution(scaled, x, least);
      EXPECT_EQ(solution.dropped, 1);
      EXPECT_EQ(solution.y, Eigen::Vector2d(1.0, 0.0));
    }
  }
}

// `y` solves A y = x without row and column `dropped`.
void expect_solution_without(int dropped, const MatrixXd& A, const VectorXd& x, const VectorXd& y) {
  std::vector<int> kept;
  for (int j = 0; j < A.rows(); ++j)
    if (j != dropped) kept.push_back(j);
  const VectorXd rest = MatrixXd(A(kept, kept)).llt().solve(VectorXd(x(kept)));
  EXPECT_LT(error(y(kept), rest), 1e-12);
}

TEST(Cholesky, DropsColumnsWithoutAFinitePositivePivot) {
  Random random(5);
  constexpr int n = 9;
  for (int bad = 0; bad < n; ++bad)
    for (const double diagonal : {0.0, -1.0, nan, infinity, -infinity})
      for (const double least : {0.0, 1e-9}) {
        SCOPED_TRACE(testing::Message() << diagonal << " at " << bad);
        MatrixXd A = random_definite(random, n);
        A(bad, bad) = diagonal;
        const VectorXd x = random_vector(random, n);
        const Solution solution(A, x, least);
        EXPECT_EQ(solution.dropped, 1);
        EXPECT_EQ(solution.L.col(bad), VectorXd::Zero(n));
        EXPECT_EQ(solution.y(bad), 0.0);
        expect_solution_without(bad, A, x, solution.y);
      }
}

/// Factorises a copy of a matrix of fixed size with guards in its upper triangle and solves A y =
/// x.
template <int Size>
struct FixedSolution {
  Eigen::Matrix<double, Size, Size> L;
  Eigen::Matrix<double, Size, 1> y;

  FixedSolution(const MatrixXd& A, const VectorXd& x) : L(A), y(x) {
    for (int j = 0; j < Size; ++j)
      for (int i = 0; i < j; ++i) L(i, j) = guard;
    detail::factorise(L);
    detail::solve_factorised(L, y.data());
    for (int j = 0; j < Size; ++j)
      for (int i = 0; i < j; ++i) {
        EXPECT_EQ(L(i, j), guard);
        L(i, j) = 0.0;
      }
  }
};

TEST(Cholesky, OfFixedSizeEqualsThatOfAnySize) {
  Random random(7);
  for (int i = 0; i < 100; ++i) {
    const MatrixXd A = random_definite(random, 7);
    const VectorXd x = random_vector(random, 7);
    const FixedSolution<7> solution(A, x);
    const Solution other(A, x);
    EXPECT_LT((solution.L - other.L).norm(), 1e-14 * A.norm());
    EXPECT_LT(error(solution.y, other.y), 1e-13);
  }
}

TEST(Cholesky, OfFixedSizeLeavesOutColumnsWithoutAPositivePivot) {
  Random random(8);
  constexpr int n = 6;
  for (int bad = 0; bad < n; ++bad)
    for (const double diagonal : {0.0, -1.0, nan}) {
      SCOPED_TRACE(testing::Message() << diagonal << " at " << bad);
      MatrixXd A = random_definite(random, n);
      A(bad, bad) = diagonal;
      const VectorXd x = random_vector(random, n);
      const FixedSolution<n> solution(A, x);
      EXPECT_EQ(solution.L(bad, bad), infinity);
      EXPECT_EQ(solution.L.col(bad).tail(n - 1 - bad), VectorXd::Zero(n - 1 - bad));
      EXPECT_EQ(solution.y(bad), 0.0);
      expect_solution_without(bad, A, x, solution.y);
    }
  // The second pivot is `above`, the second diagonal entry 1 + `above`.
  for (const double above : {0x1p-52, 0x1p-48}) {
    const Eigen::Matrix2d A = (Eigen::Matrix2d() << 4.0, 2.0, 2.0, 1.0 + above).finished();
    const FixedSolution<2> solution(A, Eigen::Vector2d(4.0, 2.0 + above));
    EXPECT_EQ(solution.y, above > 1e-15 ? Eigen::Vector2d(0.5, 1.0) : Eigen::Vector2d(1.0, 0.0));
  }
}

// The caller can then see that the result is not a solution.
TEST(Cholesky, CountsNonFiniteEntriesAsDroppedColumns) {
  Random random(6);
  constexpr int n = 9;
  for (const double bad : {nan, infinity, -infinity})
    for (int j = 0; j < n; ++j)
      for (int i = j; i < n; ++i) {
        MatrixXd A = random_definite(random, n);
        A(i, j) = bad;
        EXPECT_GT(Solution(A, random_vector(random, n)).dropped, 0)
            << bad << " at " << i << ", " << j;
      }
}

TEST(Cholesky, OfTheEstimatorsSolvesLikeEigenOrSaysThatNothingIsDefinite) {
  Random random(9);
  constexpr int n = 6;
  using Square = Eigen::Matrix<double, n, n>;
  for (int i = 0; i < 50; ++i) {
    Square A = random_definite(random, n);
    const Eigen::LLT<MatrixXd> llt(A);
    const Eigen::Matrix<double, n, 1> x = random_vector(random, n);
    Eigen::Matrix<double, 4, n> rows;
    for (int r = 0; r < 4; ++r) rows.row(r) = random_vector(random, n).transpose();
    A.triangularView<Eigen::StrictlyUpper>().setConstant(nan);  // is not read
    const detail::Cholesky factor(A);
    EXPECT_TRUE(factor.is_definite);
    EXPECT_LT(error(factor.solve(x), llt.solve(x)), 1e-13);
    const MatrixXd truth = llt.solve(MatrixXd(rows.transpose())).transpose();
    EXPECT_LT((factor.solve_rows(rows) - truth).norm(), 1e-13 * truth.norm());
    const Eigen::Matrix<float, n, n> single = A.cast<float>();
    const Eigen::Matrix<float, n, 1> least = detail::Cholesky(single).solve(x.cast<float>());
    EXPECT_LT(error(least.cast<double>(), llt.solve(x)), 1e-4);
    for (const double bad : {0.0, -1.0, nan}) {
      Square spoilt = A;
      spoilt(i % n, i % n) = bad;
      EXPECT_FALSE(detail::Cholesky(spoilt).is_definite) << bad << " at " << i % n;
    }
  }
}

}  // namespace linear_algebra_cholesky_test
}  // namespace tilt_ropter
