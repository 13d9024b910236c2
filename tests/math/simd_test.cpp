#include <tilt_ropter/math/detail/simd.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace tilt_ropter {
namespace simd_test {

TEST(Packet, FiniteCheckFindsOneBadNumberAtAnyIndex) {
  for (const int count : {0, 1, 2, 3, 4, 7, 8, 16, 24, 35}) {
    std::vector<double> numbers(static_cast<std::size_t>(count), 1e300);
    const auto finite = [&] {
      return detail::vectorised([&](auto packet) __attribute__((always_inline)) {
        detail::FiniteCheck<packet()> check;
        check.add(numbers.data(), count);
        return check.passed();
      });
    };
    EXPECT_TRUE(finite()) << count;
    for (auto& number : numbers)
      for (const double bad :
           {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(),
            -std::numeric_limits<double>::infinity()}) {
        const double good = number;
        number = bad;
        EXPECT_FALSE(finite()) << count;
        number = good;
      }
  }
}

#if defined(__x86_64__)
TEST(Packet, IsWideWhereTheProcessorHasAvx512) {
  const int width =
      detail::vectorised_wide([](auto packet) __attribute__((always_inline)) { return packet(); });
#if defined(__AVX512F__)
  EXPECT_EQ(width, 8);
#elif (defined(__AVX2__) && defined(__FMA__)) || defined(TILT_ROPTER_NO_DISPATCH)
  EXPECT_EQ(width, 4);  // compiled for a processor without AVX-512
#else
  EXPECT_EQ(width, __builtin_cpu_supports("avx512f") ? 8 : 4);
#endif
}
#endif

TEST(Packet, PaddedRoundsUpToWholePackets) {
  EXPECT_EQ(detail::padded(0), 0);
  EXPECT_EQ(detail::padded(1), 4);
  EXPECT_EQ(detail::padded(24), 24);
  EXPECT_EQ(detail::padded(25), 28);
}

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
  for (int count = 1; count <= 4; ++count) {
    gather_into(x, count, [&](int lane) -> const Eigen::Matrix3d& { return a[lane]; });
    gather_into(y, count, [&](int lane) -> const Eigen::Matrix3d& { return b[lane]; });
    const Eigen::Matrix<Lanes, 3, 3> product = x * y;
    for (int lane = 0; lane < 4; ++lane) {
      const int last = std::min(lane, count - 1);
      for (int i = 0; i < 9; ++i) EXPECT_NEAR(product(i)[lane], (a[last] * b[last])(i), 1e-14);
      Eigen::Matrix3d back;
      scatter(x, lane, back);
      EXPECT_EQ(back, a[last]);
    }
  }
}

}  // namespace simd_test
}  // namespace tilt_ropter
