#include <tilt_ropter/math/detail/finite.hpp>

#include <gtest/gtest.h>

#include <limits>

namespace finite_test {

using tilt_ropter::all_finite;

template <typename Scalar>
void every_entry_counts() {
  using Limits = std::numeric_limits<Scalar>;
  Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic> values(3, 5);
  values.setConstant(Limits::max());
  EXPECT_TRUE(all_finite(values));
  for (const Scalar bad : {Limits::quiet_NaN(), Limits::infinity(), -Limits::infinity()})
    for (Eigen::Index i = 0; i < values.size(); ++i) {
      const Scalar good = values(i);
      values(i) = bad;
      EXPECT_FALSE(all_finite(values)) << i;
      EXPECT_EQ(all_finite(values.topRows(1)), i % 3 != 0) << i;
      values(i) = good;
    }
  values.resize(0, 5);
  EXPECT_TRUE(all_finite(values));
}

TEST(AllFinite, ChecksEveryEntry) {
  every_entry_counts<double>();
  every_entry_counts<float>();
}

// With -ffast-math the compiler may replace x - x by zero. The test for NaN must not depend on it.
TEST(AllFinite, DetectsNanFromASum) {
  volatile double bad = std::numeric_limits<double>::quiet_NaN(), one = 1.0;
  const double w = bad, z = one;
  const Eigen::Vector2d sums(0.7 * (w + z), 0.7 * (w - z));
  EXPECT_FALSE(all_finite(sums));
}

}  // namespace finite_test
