#include <tilt_ropter/math/validation.hpp>

#include "support/random.hpp"
#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>

namespace validation_test {

using namespace tilt_ropter;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

/// Returns the message of a check, or an empty string if the check accepts.
template <typename Check>
std::string complaint(const Check& check) {
  try {
    check();
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return {};
}

TEST(Validation, MessageNamesFieldValueAndAllowedValues) {
  EXPECT_EQ(complaint([] { require(false, "Wheel.radius [m]", -0.25, "> 0"); }),
            "Wheel.radius [m] = -0.25: must be > 0");
  EXPECT_EQ(complaint([] { require(true, "anything", -0.25, "> 0"); }), "");
}

TEST(Validation, PrintsNineDigits) {
  EXPECT_EQ(complaint([] { require(false, "a", 0.1234567894, "b"); }),
            "a = 0.123456789: must be b");
  EXPECT_EQ(complaint([] { require(false, "a", Eigen::Vector2d(1.00000001, 2.0), "b"); }),
            "a = (1.00000001, 2): must be b");
}

TEST(Validation, VectorsAndMatricesArePrintedInOneLine) {
  const Eigen::Vector3d v(1.0, -2.5, 3.0);
  EXPECT_EQ(complaint([&] { require(false, "gain", v, "small"); }),
            "gain = (1, -2.5, 3): must be small");
  EXPECT_EQ(complaint([&] { require(false, "gain", v.transpose().eval(), "small"); }),
            "gain = (1, -2.5, 3): must be small");
  const std::string text = complaint([] {
    Eigen::Matrix2d m;
    m << 1.0, 2.0, 3.0, 4.0;
    require(false, "gain", m, "small");
  });
  EXPECT_EQ(text, "gain = (1, 2; 3, 4): must be small");
}

TEST(Validation, RejectsScalarsOutsideTheirRangeOnly) {
  EXPECT_EQ(complaint([] { require_finite("a", -1.0); }), "");
  EXPECT_EQ(complaint([] { require_positive("a", 1e-300); }), "");
  EXPECT_EQ(complaint([] { require_non_negative("a", 0.0); }), "");
  for (const double bad : {nan, infinity, -infinity}) {
    EXPECT_NE(complaint([&] { require_finite("a", bad); }), "");
    EXPECT_NE(complaint([&] { require_positive("a", bad); }), "");
    EXPECT_NE(complaint([&] { require_non_negative("a", bad); }), "");
  }
  EXPECT_EQ(complaint([] { require_in("a", 1.0, 1.0, 1.0); }), "");
  EXPECT_EQ(complaint([] { require_in("a", -0.5, -0.5, 2.0); }), "");
  EXPECT_EQ(complaint([] { require_in("a", 2.0, -0.5, 2.0); }), "");
  EXPECT_EQ(complaint([] { require_in("a", 2.5, -0.5, 2.0); }), "a = 2.5: must be in [-0.5, 2]");
  EXPECT_EQ(complaint([] { require_in("a", -0.6, -0.5, 2.0); }), "a = -0.6: must be in [-0.5, 2]");
  EXPECT_EQ(complaint([] { require_in("a", nan, -0.5, 2.0); }), "a = nan: must be in [-0.5, 2]");
  EXPECT_EQ(complaint([] { require_time("t", 1.7e9); }), "");  // seconds since 1970
  test_support::expect_range("t", test_support::in_range(-1e10, 1e10), true,
                             [](double time) { require_time("t", time); });
  EXPECT_EQ(complaint([] { require_time("t", -1e11); }), "t = -1e+11: must be in [-1e+10, 1e+10]");
  EXPECT_EQ(complaint([] { require_positive("a", 0.0); }), "a = 0: must be finite and > 0");
  EXPECT_EQ(complaint([] { require_non_negative("a", -1.0); }), "a = -1: must be finite and >= 0");
}

// Each entry of a matrix in turn.
void expect_entries(const test_support::Range& range, void (*check)(const Eigen::Matrix2d&)) {
  for (int i = 0; i < 4; ++i)
    test_support::expect_range("a", range, false, [&](double value) {
      Eigen::Matrix2d m = Eigen::Matrix2d::Constant(0.5);
      m(i) = value;
      check(m);
    });
}

TEST(Validation, RejectsMatricesWithOneInvalidEntry) {
  using Eigen::Matrix2d;
  expect_entries(test_support::any_finite(), [](const Matrix2d& m) { require_finite("a", m); });
  expect_entries(test_support::positive(), [](const Matrix2d& m) { require_positive("a", m); });
  expect_entries(test_support::not_negative(),
                 [](const Matrix2d& m) { require_non_negative("a", m); });
  expect_entries(test_support::positive_or_infinite(),
                 [](const Matrix2d& m) { require_positive_or_infinite("a", m); });
}

TEST(Validation, BoundsMayBeInfiniteAndEqualButNotReversedOrNan) {
  using Eigen::Vector2d;
  const Vector2d upper(1.0, infinity);
  EXPECT_EQ(complaint([&] { require_ordered("u", Vector2d(1.0, -infinity), upper); }), "");
  EXPECT_EQ(complaint([&] { require_ordered("u", Vector2d(1.5, 0.0), upper); }),
            "u lower bound = (1.5, 0): must be <= the upper bound in every entry");
  for (int i = 0; i < 4; ++i)
    test_support::expect_range("u lower bound",
                               {{1.0, -infinity}, {test_support::above(1.0), nan, infinity}}, false,
                               [&](double value) {
                                 Eigen::Matrix2d lower = Eigen::Matrix2d::Zero();
                                 lower(i) = value;
                                 require_ordered("u", lower, Eigen::Matrix2d::Ones());
                               });
}

TEST(Validation, LimitsSizeAndAsymmetryOfInertia) {
  using test_support::expect_range;
  const auto check = [](const Eigen::Matrix3d& inertia) { require_inertia("J", inertia); };
  expect_range("J", {{1e-12, 1.0, 1e9}, {0.99e-12, 1.01e9}}, false,
               [&](double size) { check(size * Eigen::Matrix3d::Identity()); });
  for (int i = 0; i < 3; ++i)
    expect_range("J", {{1e9}, {1.01e9}}, false, [&](double largest) {
      Eigen::Vector3d moments = Eigen::Vector3d::Constant(0.9e9);
      moments(i) = largest;
      check(moments.asDiagonal());
    });
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      if (i != j)
        expect_range("J", {{1.9e-9, -1.9e-9}, {2.1e-9, -2.1e-9, 0.1}}, false, [&](double excess) {
          Eigen::Matrix3d inertia = 2.0 * Eigen::Matrix3d::Identity();
          inertia(i, j) = excess;
          check(inertia);
        });
  expect_range("J", {{0.0, 1.8e-9}, {2.2e-9, 0.1}}, false, [&](double excess) {  // a flat plate
    check(Eigen::Vector3d(1.0, 1.0, 2.0 + excess).asDiagonal());
  });
}

TEST(Validation, RejectsPhysicallyImpossibleInertia) {
  const auto says = [](const Eigen::Matrix3d& inertia) {
    return complaint([&] { require_inertia("J", inertia); });
  };
  const auto diagonal = [](double x, double y, double z) {
    return Eigen::Matrix3d(Eigen::Vector3d(x, y, z).asDiagonal());
  };
  EXPECT_EQ(says(diagonal(0.014, 0.014, 0.025)), "");
  EXPECT_EQ(says(diagonal(1.0, 1.0, 2.0)), "");  // a flat plate
  EXPECT_NE(says(diagonal(1.0, 1.0, 2.01)).find("triangle inequality"), std::string::npos);
  EXPECT_NE(says(diagonal(1.0, 0.0, 1.0)).find("positive definite"), std::string::npos);
  EXPECT_NE(says(diagonal(1.0, nan, 1.0)).find("finite in every entry"), std::string::npos);
  Eigen::Matrix3d lopsided = diagonal(1.0, 1.0, 1.0);
  lopsided(0, 1) = 0.1;
  EXPECT_NE(says(lopsided).find("symmetric"), std::string::npos);
}

TEST(Validation, ChecksInertiaByPrincipalMomentsInAnyAxes) {
  test_support::Random random(7);
  int accepted = 0;
  for (int i = 0; i < 100000; ++i) {
    const Eigen::Matrix3d turn = random.orientation().toRotationMatrix();
    Eigen::Vector3d moments(random.uniform(-1.0, 2.0), random.uniform(-1.0, 2.0), 0.0);
    const double sum = moments.x() + moments.y();
    const double edges[] = {sum * (1.0 - 1e-6), sum * (1.0 + 1e-6), random.uniform(-1.0, 3.0)};
    moments.z() = edges[i % 3];
    if ((moments.cwiseAbs().array() < 1e-6).any()) continue;
    const double unit = std::pow(10.0, random.uniform(-6.0, 3.0));
    Eigen::Matrix3d inertia = turn * moments.asDiagonal() * turn.transpose() * unit;
    inertia = (0.5 * (inertia + inertia.transpose())).eval();
    const bool body = moments.minCoeff() > 0.0 && 2.0 * moments.maxCoeff() <= moments.sum();
    accepted += body;
    const std::string said = complaint([&] { require_inertia("J", inertia); });
    ASSERT_EQ(said.empty(), body) << moments.transpose() << ": " << said;
  }
  EXPECT_GT(accepted, 10000);
}

TEST(Validation, AcceptsFlatPlatesInAnyAxes) {
  test_support::Random random(8);
  for (int i = 0; i < 10000; ++i) {
    const Eigen::Matrix3d turn = random.orientation().toRotationMatrix();
    const double x = random.uniform(0.01, 1.0), y = random.uniform(0.01, 1.0);
    const Eigen::Matrix3d plate =
        turn * Eigen::Vector3d(x, y, x + y).asDiagonal() * turn.transpose();
    EXPECT_EQ(complaint([&] { require_inertia("J", plate); }), "");
  }
}

}  // namespace validation_test
