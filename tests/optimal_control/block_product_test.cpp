#include <tilt_ropter/optimal_control/block_product.hpp>

#include <gtest/gtest.h>
#include <Eigen/Dense>

namespace tilt_ropter {
namespace {

constexpr int inner = 6, columns = 9, rows = padded(22);
using X = Eigen::Matrix<double, rows, inner>;
using M = Eigen::Matrix<double, inner, columns>;
using Y = Eigen::Matrix<double, rows, columns>;

struct Staircase {
  static constexpr int size = 3;
  static constexpr bool nonzero(int row, int column) { return column >= row; }
};

// Ones where the blocks may be non-zero.
M mask() {
  M m = M::Ones();
  m.block<3, 3>(3, 0).setZero();
  return m;
}

TEST(BlockProduct, IsTheProductWithoutTheZeroBlocks) {
  const X x = X::Random();
  const M m = M::Random();
  const Y before = Y::Random();
  Y y = before;
  add_product<Staircase, inner, columns>(x, m, y);
  EXPECT_LT((y - before - x * m.cwiseProduct(mask())).cwiseAbs().maxCoeff(), 1e-14);
}

TEST(BlockProduct, LowerProductIsRightFromTheDiagonalDown) {
  const X x = X::Random();
  const M m = M::Random();
  const Y before = Y::Random(), truth = before + x * m;
  constexpr int offset = 4;
  Y y = before;
  add_lower_product<FullBlocks<3>, inner, columns, offset>(x, m, y);
  for (int j = 0; j < columns; ++j)
    for (int i = j + offset; i < rows; ++i) EXPECT_NEAR(y(i, j), truth(i, j), 1e-14);
}

TEST(BlockProduct, BatchDoesTheRowsAskedForAndNoneBeyondTheirTile) {
  constexpr int room = 3 * batch_rows;
  const Eigen::MatrixXd x = Eigen::MatrixXd::Random(room, inner);
  const M m = M::Random();
  for (int count = 0; count <= room; ++count) {
    Eigen::MatrixXd y = Eigen::MatrixXd::Zero(room, columns);
    add_batch<Staircase, inner, columns>(x, m, y, count);
    const Eigen::MatrixXd truth = x * m.cwiseProduct(mask());
    EXPECT_LT((y - truth).topRows(count).norm(), 1e-13);
    const int tiles = (count + batch_rows - 1) / batch_rows;
    EXPECT_TRUE(y.bottomRows(room - tiles * batch_rows).isZero(0.0));
  }
}

TEST(BlockProduct, PaddingIsWholeRegisters) {
  for (int n = 1; n < 40; ++n) {
    EXPECT_EQ(padded(n) % packet_size, 0);
    EXPECT_GE(padded(n), n);
    EXPECT_LT(padded(n), n + packet_size);
  }
}

}  // namespace
}  // namespace tilt_ropter
