#include <tilt_ropter/math/detail/lanes.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>

namespace tilt_ropter {
namespace {

TEST(Lanes, EveryOperatorMatchesScalarInEachLane) {
  test_support::Random random(1);
  for (int trial = 0; trial < 1000; ++trial) {
    double a[4], b[4];
    for (int i = 0; i < 4; ++i) {
      a[i] = random.normal(10.0);
      b[i] = random.normal(10.0);
    }
    const Lanes x(a[0], a[1], a[2], a[3]), y = gather([&](int i) { return b[i]; });
    Lanes sum = x, difference = x, product = x, quotient = x;
    sum += y;
    difference -= y;
    product *= y;
    quotient /= y;
    const Lanes root = sqrt(x * x), negative = -x;
    for (int i = 0; i < 4; ++i) {
      EXPECT_EQ((x + y)[i], a[i] + b[i]);
      EXPECT_EQ((x - y)[i], a[i] - b[i]);
      EXPECT_EQ((x * y)[i], a[i] * b[i]);
      EXPECT_EQ((x / y)[i], a[i] / b[i]);
      EXPECT_EQ(sum[i], a[i] + b[i]);
      EXPECT_EQ(difference[i], a[i] - b[i]);
      EXPECT_EQ(product[i], a[i] * b[i]);
      EXPECT_EQ(quotient[i], a[i] / b[i]);
      EXPECT_EQ(negative[i], -a[i]);
      EXPECT_DOUBLE_EQ(root[i], std::abs(a[i]));
    }
  }
}

TEST(Lanes, EigenMultipliesFourMatricesAtOnce) {
  test_support::Random random(2);
  Eigen::Matrix3d a[4], b[4];
  Eigen::Matrix<Lanes, 3, 3> x, y;
  for (int lane = 0; lane < 4; ++lane)
    for (int i = 0; i < 9; ++i) {
      a[lane](i) = random.normal(1.0);
      b[lane](i) = random.normal(1.0);
    }
  for (int i = 0; i < 9; ++i) {
    x(i) = gather([&](int lane) { return a[lane](i); });
    y(i) = gather([&](int lane) { return b[lane](i); });
  }
  const Eigen::Matrix<Lanes, 3, 3> product = x * y;
  for (int lane = 0; lane < 4; ++lane)
    for (int i = 0; i < 9; ++i) EXPECT_NEAR(product(i)[lane], (a[lane] * b[lane])(i), 1e-14);
}

}  // namespace
}  // namespace tilt_ropter
