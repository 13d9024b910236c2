#include <tilt_ropter/math/detail/entries.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <limits>

namespace tilt_ropter {
namespace {

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

}  // namespace
}  // namespace tilt_ropter
