#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <vector>

#include "support/autodiff.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

namespace rotation_test {

using namespace tilt_ropter;
using Eigen::Quaterniond;
using Eigen::Vector3d;

/// Rotation vectors from zero to pi, including tiny ones, in random directions.
std::vector<Vector3d> rotation_vectors() {
  test_support::Random random(1);
  std::vector<Vector3d> vectors{Vector3d::Zero()};
  for (const double size : {1e-300, 1e-8, 1e-4, 0.999e-3, 1.001e-3, 0.1, 1.0, 3.0, pi - 1e-6, pi})
    for (int i = 0; i < 20; ++i) vectors.push_back(size * random.vector(1.0).normalized());
  for (int i = 0; i < test_support::quick_or_full(1000, 10000); ++i)
    vectors.push_back(random.uniform(0.0, pi) * random.vector(1.0).normalized());
  return vectors;
}

TEST(Rotation, ExpMatchesEigenAngleAxis) {
  for (const Vector3d& theta : rotation_vectors()) {
    const double angle = theta.norm();
    const Vector3d axis = angle > 0.0 ? Vector3d(theta / angle) : Vector3d::UnitX();
    const Quaterniond expected(Eigen::AngleAxisd(angle, axis));
    EXPECT_LT((quaternion_exp(theta).coeffs() - expected.coeffs()).norm(), 1e-15) << theta;
  }
}

TEST(Rotation, ExpIsUnitQuaternionBeyondPi) {
  test_support::Random random(2);
  for (int i = 0; i < 1000; ++i)
    EXPECT_NEAR(quaternion_exp(random.vector(30.0)).norm(), 1.0, 1e-15);
}

TEST(Rotation, LogInvertsExp) {
  for (const Vector3d& theta : rotation_vectors()) {
    Vector3d back = quaternion_log(quaternion_exp(theta));
    // At pi both signs describe the same rotation.
    if (theta.norm() > pi - 1e-9 && back.dot(theta) < 0.0) back = -back;
    EXPECT_LT((back - theta).norm(), 1e-14 * (1.0 + theta.norm())) << theta.transpose();
  }
}

TEST(Rotation, LogReturnsShorterRotation) {
  test_support::Random random(3);
  for (int i = 0; i < 1000; ++i) {
    const Quaterniond q = random.orientation();
    const Quaterniond negative(-q.coeffs());
    EXPECT_LE(quaternion_log(q).norm(), pi + 1e-15);
    EXPECT_LT((quaternion_log(q) - quaternion_log(negative)).norm(), 1e-14);
    EXPECT_LT((quaternion_exp(quaternion_log(q)).toRotationMatrix() - q.toRotationMatrix()).norm(),
              1e-14);
  }
}

TEST(Rotation, FloatReachesFloatPrecision) {
  for (const Vector3d& theta : rotation_vectors()) {
    const Eigen::Vector3f single = theta.cast<float>();
    const Eigen::Quaternionf q = quaternion_exp(single);
    EXPECT_LT((q.coeffs().cast<double>() - quaternion_exp(theta).coeffs()).norm(), 1e-6);
    if (theta.norm() < 3.1) {
      EXPECT_LT((quaternion_log(q) - single).norm(), 2e-5F);
    }
  }
}

TEST(Rotation, DerivativeOfLogOfExpIsIdentity) {
  for (const Vector3d& theta : rotation_vectors()) {
    if (theta.norm() > pi - 1e-3) continue;
    const Eigen::Matrix3d jacobian = test_support::jacobian_at_zero<3, 3>([&](const auto& dual) {
      using Dual = test_support::Dual<3>;
      const Vector3<Dual> shifted = theta.cast<Dual>() + dual;
      return quaternion_log(quaternion_exp(shifted));
    });
    EXPECT_LT((jacobian - Eigen::Matrix3d::Identity()).norm(), 1e-11) << theta.transpose();
  }
}

TEST(Rotation, DerivativeOfExpAtZeroIsOneHalf) {
  const auto jacobian = test_support::jacobian_at_zero<4, 3>([](const auto& dual) {
    const auto q = quaternion_exp(dual);
    Eigen::Matrix<test_support::Dual<3>, 4, 1> packed;
    packed << q.w(), q.x(), q.y(), q.z();
    return packed;
  });
  Eigen::Matrix<double, 4, 3> expected = Eigen::Matrix<double, 4, 3>::Zero();
  expected.bottomRows<3>().diagonal().setConstant(0.5);
  EXPECT_LT((jacobian - expected).norm(), 1e-15);
}

TEST(Rotation, RightJacobianMatchesAutomaticDifferentiation) {
  double worst = 0.0;
  for (const Vector3d& theta : rotation_vectors()) {
    const Eigen::Matrix3d truth = test_support::jacobian_at_zero<3, 3>([&](const auto& dual) {
      using Dual = test_support::Dual<3>;
      const Vector3<Dual> shifted = theta.cast<Dual>() + dual;
      const Eigen::Quaternion<Dual> from = quaternion_exp(theta).conjugate().cast<Dual>();
      return quaternion_log(Eigen::Quaternion<Dual>(from * quaternion_exp(shifted)));
    });
    worst = std::max(worst, (right_jacobian(theta) - truth).norm());
  }
  test_support::check_at_most(7, "rotation: right Jacobian's error", worst, 1e-13);
}

TEST(Rotation, SkewIsTheCrossProduct) {
  test_support::Random random(4);
  for (int i = 0; i < 100; ++i) {
    const Vector3d a = random.vector(5.0), b = random.vector(5.0);
    EXPECT_LT((skew(a) * b - a.cross(b)).norm(), 1e-14);
    EXPECT_LT((skew(a) + skew(a).transpose()).norm(), 1e-15);
  }
}

TEST(Rotation, YawRoundTripAndHeadingOfBodyX) {
  test_support::Random random(5);
  for (int i = 0; i < 1000; ++i) {
    const double yaw = random.uniform(-pi, pi);
    EXPECT_NEAR(yaw_of(quaternion_from_yaw(yaw)), yaw, 1e-14);
    const Quaterniond q = random.orientation();
    const Vector3d heading = q * Vector3d::UnitX();
    EXPECT_NEAR(yaw_of(q), std::atan2(heading.y(), heading.x()), 1e-9);
  }
  EXPECT_NEAR(std::abs(yaw_of(quaternion_from_yaw(pi))), pi, 1e-15);
}

}  // namespace rotation_test
