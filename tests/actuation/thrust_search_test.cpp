// CTest: optimised

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/detail/thrust_search.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "support/random.hpp"
#include "support/vehicles.hpp"

namespace thrust_search_test {

using namespace tilt_ropter;
using Search = detail::ThrustSearch<4>;
using Limits = detail::ThrustLimits<4, double>;

/// Request with all thrusts in one group.
Search::Request request_of(const Search::Thrusts& base) {
  Search::Request request;
  request.groups.setZero();
  request.groups.col(0) = base;
  request.floor_angles.fill(0.0);
  request.near.fill(0.0);
  request.floors = false;
  return request;
}

Search::Parts whole() {
  Search::Parts parts;
  parts.fill(detail::AnglePart::whole);
  return parts;
}

TEST(ThrustSearch, FindsThrustsIfAGridDoesAndMinimisesChange) {
  test_support::Random random(3);
  const AllocationMatrix<4> allocation(tilt_ropter_vehicle());
  const Search::Directions directions = allocation.null_space;
  for (const auto& [lower, upper] :
       {std::pair{-pi, pi}, {-0.5 * pi, 0.5 * pi}, {-0.6, 1.0}, {-2.0, 2.5}}) {
    int reached = 0;
    const Limits limits(test_support::with_tilt_range(lower, upper));
    const Search search(limits, directions);
    for (int i = 0; i < 150; ++i) {
      Search::Thrusts base;
      for (int k = 0; k < 4; ++k)
        base.segment<2>(2 * k) << random.uniform(-9.0, 9.0), random.uniform(-4.0, 14.0);
      base -= directions * (directions.transpose() * base);
      Search::Answer answer;
      const bool found = search.reach(request_of(base), whole(), false, answer);
      double least = 1e9;
      for (double u = -20.0; u <= 20.0; u += 0.25) {
        for (double v = -20.0; v <= 20.0; v += 0.25) {
          const Search::Thrusts point = base + directions * Eigen::Vector2d(u, v);
          bool inside = true;
          for (int k = 0; k < 4; ++k)
            inside = inside && limits.contains(k, point.segment<2>(2 * k));
          if (inside) least = std::min(least, std::hypot(u, v));
        }
      }
      EXPECT_TRUE(found || least > 1e8);
      if (!found) continue;
      ++reached;
      for (int k = 0; k < 4; ++k) EXPECT_TRUE(limits.contains(k, answer.thrusts.segment<2>(2 * k)));
      const Eigen::Vector2d y = directions.transpose() * (answer.thrusts - base);
      EXPECT_LT((answer.thrusts - base - directions * y).norm(), 1e-11);
      if (limits.convex()) {
        EXPECT_LT(y.norm(), least + 1e-5);
      }
    }
    EXPECT_GT(reached, 5);
    EXPECT_LT(reached, 150);
  }
}

TEST(ThrustSearch, KeepsLimitsForWrenchesFarBeyondReach) {
  const AllocationMatrix<4> allocation(tilt_ropter_vehicle());
  test_support::Random random(6);
  for (const double range : {0.2, 1.0, 2.0, pi}) {
    const Limits limits(test_support::with_tilt_range(-range, range));
    const Search search(limits, allocation.null_space);
    for (int i = 0; i < 500; ++i) {
      Search::Request request = request_of(Search::Thrusts::Zero());
      const double scale = std::pow(10.0, random.uniform(-9.0, 3.0));
      for (int g = 0; g < 4; ++g)
        for (int k = 0; k < 8; ++k) request.groups(k, g) = random.uniform(-scale, scale);
      request.groups -=
          (allocation.null_space * (allocation.null_space.transpose() * request.groups)).eval();
      Search::Answer answer;
      search.prioritise(request, whole(), answer);
      for (const double fraction : answer.fractions) {
        EXPECT_GE(fraction, 0.0);
        EXPECT_LE(fraction, 1.0);
      }
      for (int k = 0; k < 4; ++k) {
        const Eigen::Vector2d t = answer.thrusts.segment<2>(2 * k);
        EXPECT_LT(t.norm(), 12.0 + 1e-6);
        EXPECT_LT(limits.out_of_range(t), 1e-6);
      }
    }
  }
}

}  // namespace thrust_search_test
