// Predicted covariance, innovation and update against automatic differentiation.

#include <tilt_ropter/estimation/detail/error_state_filter.hpp>

#include "support/autodiff.hpp"
#include "support/check_table.hpp"
#include "support/error_states.hpp"
#include "support/flights.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace error_state_filter_jacobians_test {

using test_support::cast;
using test_support::Dual;
using test_support::filter;
using test_support::Random;
using test_support::random_covariance;
using Tangent = InertialTangentd;
using Covariance = ErrorStateFilterd::Covariance;
using Innovation = MeasurementInnovation<double, 6>;

constexpr auto* random_state = test_support::random_inertial_state;

// Residual of a pose that state `y` would give, computed at state `x`.
template <typename Scalar>
Eigen::Matrix<Scalar, 6, 1> shown(const InertialState<Scalar>& y, const InertialState<Scalar>& x) {
  const Eigen::Quaternion<Scalar> at = x.orientation * x.marker_orientation;
  const Eigen::Quaternion<Scalar> to = y.orientation * y.marker_orientation;
  const Vector3<Scalar> from_position = x.position + x.orientation * x.marker_position;
  const Vector3<Scalar> to_position = y.position + y.orientation * y.marker_position;
  Eigen::Matrix<Scalar, 6, 1> r;
  r << to_position - from_position, quaternion_log(Eigen::Quaternion<Scalar>(at.conjugate() * to));
  return r;
}

Eigen::Matrix<double, 6, 21> pose_jacobian(const InertialStated& x) {
  using Scalar = Dual<21>;
  const auto start = cast<Scalar>(x);
  return test_support::jacobian_at_zero<6, 21>(
      [&](const InertialTangent<Scalar>& dx) { return shown<Scalar>(retract(start, dx), start); });
}

Eigen::Matrix<double, 6, 6> pose_covariance() {
  Eigen::Matrix<double, 6, 1> r;
  r << Eigen::Vector3d::Constant(2e-3 * 2e-3), Eigen::Vector3d::Constant(5e-3 * 5e-3);
  return r.asDiagonal();
}

double relative(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) {
  return (a - b).cwiseAbs().maxCoeff() / b.cwiseAbs().maxCoeff();
}

TEST(ErrorStateFilter, PredictedCovarianceMatchesAutomaticDifferentiation) {
  using Scalar = Dual<21>;
  Random random(105);
  ErrorStateFilterd f = filter();
  double worst = 0.0;
  for (int i = 0; i < test_support::quick_or_full(2000, 10000); ++i) {
    const InertialStated x = random_state(random);
    const Covariance p = random_covariance(random);
    InertialSampled sample{random.vector(6.0), random.vector(20.0)};
    double dt = std::pow(10.0, random.uniform(-3.5, -1.0));
    if (i % 5 == 1) sample.angular_velocity = x.gyro_bias;  // no rotation
    if (i % 5 == 2) sample.angular_velocity = x.gyro_bias + random.vector(1e-6);
    if (i % 5 == 3) {  // half a turn in the step
      dt = 0.1;
      const Eigen::Vector3d axis = random.orientation() * Eigen::Vector3d::UnitX();
      sample.angular_velocity = x.gyro_bias + axis * (pi / dt);
    }
    const auto start = cast<Scalar>(x);
    const auto end = cast<Scalar>(propagate(x, sample, dt));
    const Covariance transition =
        test_support::jacobian_at_zero<21, 21>([&](const InertialTangent<Scalar>& dx) {
          return difference(propagate(retract(start, dx), cast<Scalar>(sample), Scalar(dt)), end);
        });
    Tangent q = Tangent::Zero();
    q.segment<3>(InertialIndex::velocity).setConstant(dt * 2e-2 * 2e-2);
    q.segment<3>(InertialIndex::orientation).setConstant(dt * 2e-3 * 2e-3);
    q.segment<3>(InertialIndex::gyro_bias).setConstant(dt * 2e-5 * 2e-5);
    q.segment<3>(InertialIndex::accelerometer_bias).setConstant(dt * 3e-4 * 3e-4);
    Covariance expected = transition * p * transition.transpose();
    expected.diagonal() += q;
    f.reset(x, p);
    f.predict(sample, dt);
    // Compared entry by entry, in units of the standard deviations.
    const Tangent scale = expected.diagonal().cwiseSqrt().cwiseInverse();
    worst = std::max(worst, (scale.asDiagonal() * (f.covariance() - expected) * scale.asDiagonal())
                                .cwiseAbs()
                                .maxCoeff());
    EXPECT_EQ(difference(f.state(), propagate(x, sample, dt)), Tangent::Zero());
  }
  test_support::check_at_most(7, "filter: predicted covariance's relative error", worst, 1e-12);
}

TEST(ErrorStateFilter, InnovationMatchesAutomaticDifferentiation) {
  Random random(106);
  ErrorStateFilterd f = filter();
  double worst_h = 0.0, worst_c = 0.0, worst_s = 0.0, worst_r = 0.0, worst_nis = 0.0;
  for (int i = 0; i < test_support::quick_or_full(2000, 10000); ++i) {
    InertialStated x = random_state(random);
    if (i % 4 == 1) x.marker_position.setZero();
    if (i % 4 == 2) x.marker_orientation.setIdentity();
    const Eigen::Matrix<double, 6, 21> h = pose_jacobian(x);
    const MarkerPosed pose{random.vector(5.0), random.orientation()};

    f.reset(x, Covariance::Identity());
    worst_h =
        std::max(worst_h, relative(f.innovation_of(f.linearise(pose)).correlation, h.transpose()));

    const Covariance p = random_covariance(random);
    f.reset(x, p);
    const Innovation in = f.innovation_of(f.linearise(pose));
    const Eigen::MatrixXd s = h * p * h.transpose() + pose_covariance();
    worst_c = std::max(worst_c, relative(in.correlation, p * h.transpose()));
    worst_s = std::max(worst_s, relative(in.covariance, s));
    InertialStated seen = x;  // a state that would give this pose
    seen.orientation = pose.orientation * x.marker_orientation.conjugate();
    seen.position = pose.position - seen.orientation * x.marker_position;
    worst_r = std::max(worst_r, (in.residual - shown(seen, x)).norm());
    const double nis = in.residual.dot(s.inverse() * in.residual);
    worst_nis = std::max(worst_nis, std::abs(in.distance / nis - 1.0));
    EXPECT_EQ(in.covariance, in.covariance.transpose());
    EXPECT_EQ(f.covariance(), p);
  }
  test_support::check_at_most(7, "filter: measurement's Jacobian's relative error", worst_h, 1e-12);
  EXPECT_LT(worst_c, 1e-12);
  EXPECT_LT(worst_s, 1e-12);
  EXPECT_LT(worst_r, 1e-12);
  EXPECT_LT(worst_nis, 1e-7);  // limited by the condition of S
}

TEST(ErrorStateFilter, UpdateMatchesJosephForm) {
  Random random(108);
  ErrorStateFilterd f = filter();
  double worst_state = 0.0, worst_covariance = 0.0;
  for (int i = 0; i < 2000; ++i) {
    const InertialStated x = random_state(random);
    const Covariance p = random_covariance(random);
    f.reset(x, p);
    const MarkerPosed pose = test_support::noisy(
        {x.position + x.orientation * x.marker_position, x.orientation * x.marker_orientation},
        {0.1, 0.1}, random);
    const Innovation in = f.innovation_of(f.linearise(pose));
    f.update(in, f.linearise(pose));
    const Eigen::Matrix<double, 6, 21> h = pose_jacobian(x);
    const Eigen::Matrix<double, 6, 6> r = pose_covariance();
    const Eigen::MatrixXd s = h * p * h.transpose() + r;
    const Eigen::Matrix<double, 21, 6> gain = p * h.transpose() * s.inverse();
    const Covariance rest = Covariance::Identity() - gain * h;
    const Covariance joseph = rest * p * rest.transpose() + gain * r * gain.transpose();
    worst_state = std::max(worst_state,
                           difference(f.state(), retract(x, Tangent(gain * in.residual))).norm());
    const Tangent before = p.diagonal().cwiseSqrt().cwiseInverse();
    worst_covariance =
        std::max(worst_covariance,
                 (before.asDiagonal() * (f.covariance() - joseph) * before.asDiagonal()).norm());
  }
  EXPECT_LT(worst_state, 1e-9);
  EXPECT_LT(worst_covariance, 1e-9);
}

}  // namespace error_state_filter_jacobians_test
}  // namespace tilt_ropter
