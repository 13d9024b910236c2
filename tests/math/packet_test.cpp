#include <tilt_ropter/math/detail/packet.hpp>

#include <gtest/gtest.h>

#include <limits>
#include <vector>

namespace tilt_ropter {
namespace {

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

template <int Rows, int Columns>
void expect_transposed() {
  constexpr int stride = detail::padded(Columns);
  std::vector<double> from(Rows * Columns), to(Rows * stride, -1.0);
  for (std::size_t i = 0; i < from.size(); ++i) from[i] = static_cast<double>(i);
  detail::vectorised([&](auto packet) __attribute__((always_inline)) {
    detail::FiniteCheck<packet()> check;
    detail::copy_transposed<packet(), Rows, Columns>(from.data(), to.data(), stride, check);
    return check.passed();
  });
  for (int i = 0; i < Rows; ++i)
    for (int j = 0; j < stride; ++j)
      EXPECT_EQ(to[static_cast<std::size_t>(stride * i + j)], j < Columns ? Rows * j + i : -1.0)
          << Rows << " x " << Columns << " at " << i << ", " << j;
}

TEST(Packet, TransposesAnyMatrixAndLeavesPaddingUntouched) {
  expect_transposed<1, 1>();
  expect_transposed<2, 3>();
  expect_transposed<3, 2>();
  expect_transposed<4, 4>();
  expect_transposed<5, 7>();
  expect_transposed<6, 18>();
  expect_transposed<18, 18>();
  expect_transposed<18, 6>();
}

TEST(Packet, PaddedRoundsUpToWholePackets) {
  EXPECT_EQ(detail::padded(0), 0);
  EXPECT_EQ(detail::padded(1), 4);
  EXPECT_EQ(detail::padded(24), 24);
  EXPECT_EQ(detail::padded(25), 28);
}

}  // namespace
}  // namespace tilt_ropter
