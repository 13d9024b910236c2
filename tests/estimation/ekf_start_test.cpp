// State and covariance with which the filter starts and restarts at a pose.

#include <tilt_ropter/estimation/detail/ekf_start.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

namespace tilt_ropter {
namespace ekf_start_test {

using Eigen::Vector3d;
using Filter = ErrorStateFilter<double>;
using Covariance = Filter::Covariance;
using I = InertialIndex;
using test_support::Random;

// A filter that has run: every part of the state is different from that of the settings, and all
// parts are correlated.
class EkfStartAtPose : public testing::Test {
 protected:
  EkfStartAtPose() {
    settings.velocity_stddev = 6.0;
    settings.gyro_bias << 0.01, -0.02, 0.03;
    settings.accelerometer_bias << 0.3, 0.1, -0.2;
    settings.gyro_bias_stddev = 0.05;
    settings.accelerometer_bias_stddev = 0.4;
    settings.imu_position << 0.02, 0.0, -0.01;
    settings.marker_position << 0.1, 0.0, 0.05;
    settings.marker_orientation = quaternion_exp(Vector3d(0.0, 0.3, 1.0));
    settings.marker_position_stddev = 0.01;
    settings.marker_orientation_stddev = 0.02;
    Random random(1);
    before.position = random.vector(2.0);
    before.velocity = random.vector(2.0);
    before.orientation = random.orientation();
    before.gyro_bias = random.vector(0.1);
    before.accelerometer_bias = random.vector(0.5);
    before.marker_position =
        settings.marker_position - settings.imu_position + Vector3d(0.02, -0.03, 0.01);
    before.marker_orientation =
        settings.marker_orientation * quaternion_exp(Vector3d(0.05, 0.03, -0.06));
    Covariance root;
    for (Eigen::Index i = 0; i < root.size(); ++i) root.data()[i] = random.normal(0.005);
    covariance = root * root.transpose();
  }

  Filter start(const detail::KnownAtStart& known) const {
    Filter filter(settings.imu_noise, settings.pose_noise);
    filter.reset(before, covariance);
    detail::start_at_pose(filter, pose, known, settings);
    return filter;
  }

  // Largest covariance between two parts of the state.
  static double covariance_of(const Filter& filter, int row, int column) {
    return filter.covariance().block<3, 3>(row, column).cwiseAbs().maxCoeff();
  }
  static Vector3d stddev(const Filter& filter, int part) {
    return filter.covariance().diagonal().segment<3>(part).cwiseSqrt();
  }

  const MarkerPosed pose{Vector3d(1.0, 2.0, 3.0), quaternion_exp(Vector3d(0.4, -0.2, 2.0))};
  EkfSettings settings;
  InertialStated before;
  Covariance covariance;
};

const detail::KnownAtStart nothing{}, marker{true, false, 0.0}, all_but_pose{true, true, 0.1};

TEST_F(EkfStartAtPose, StateIsAtThePoseOfTheMarker) {
  for (const detail::KnownAtStart& known : {nothing, marker, all_but_pose}) {
    const InertialStated x = start(known).state();
    EXPECT_LT((x.position + x.orientation * x.marker_position - pose.position).norm(), 1e-12);
    EXPECT_LT((x.orientation * x.marker_orientation).angularDistance(pose.orientation), 1e-12);
  }
}

TEST_F(EkfStartAtPose, MarkerFrameIsThatOfTheSettingsUnlessKnown) {
  const InertialStated unknown = start(nothing).state(), known = start(marker).state();
  EXPECT_LT((unknown.marker_position - settings.marker_position + settings.imu_position).norm(),
            1e-12);
  EXPECT_LT(unknown.marker_orientation.angularDistance(settings.marker_orientation), 1e-12);
  EXPECT_LT((known.marker_position - before.marker_position).norm(), 1e-12);
  EXPECT_LT(known.marker_orientation.angularDistance(before.marker_orientation), 1e-12);
}

TEST_F(EkfStartAtPose, MarkerPositionIsKeptBesideAFixedMarkerOrientation) {
  settings.marker_orientation_stddev = 0.0;
  before.marker_orientation =
      settings.marker_orientation * quaternion_exp(Vector3d(1e-9, 0.0, 0.0));  // rounding
  EXPECT_EQ(start(marker).state().marker_position, before.marker_position);
}

// A frame that wrong poses have taught is further away than the settings allow.
TEST_F(EkfStartAtPose, MarkerFrameIsThatOfTheSettingsIfImplausible) {
  const InertialStated learned = before;
  for (const bool turned : {false, true}) {
    before = learned;
    if (turned)
      before.marker_orientation =
          settings.marker_orientation * quaternion_exp(Vector3d(0.0, 0.11, 0.0));
    else
      before.marker_position = settings.marker_position - settings.imu_position +  //
                               Vector3d(0.0, 0.0, 0.06);
    const Filter filter = start(all_but_pose);
    const InertialStated& x = filter.state();
    EXPECT_LT((x.marker_position - settings.marker_position + settings.imu_position).norm(), 1e-12);
    EXPECT_LT(x.marker_orientation.angularDistance(settings.marker_orientation), 1e-12);
    EXPECT_TRUE(stddev(filter, I::marker_position).isApproxToConstant(0.01, 1e-2));
    EXPECT_TRUE(stddev(filter, I::marker_orientation).isApproxToConstant(0.02, 1e-2));
    EXPECT_EQ(covariance_of(filter, I::gyro_bias, I::marker_position), 0.0);
  }
}

// After Ekf::start() no pose has been used, and a gap follows.
TEST_F(EkfStartAtPose, BiasesKeepTheirCovarianceIfTheMarkerFrameIsUnknown) {
  const Filter filter = start({false, true, 0.1});
  for (const int bias : {I::gyro_bias, I::accelerometer_bias})
    EXPECT_TRUE(
        stddev(filter, bias).isApprox(covariance.diagonal().segment<3>(bias).cwiseSqrt(), 0.05))
        << bias;
}

TEST_F(EkfStartAtPose, BiasesAndVelocityAreThoseOfTheSettingsUnlessKnown) {
  for (const detail::KnownAtStart& known : {nothing, marker}) {
    const Filter filter = start(known);
    const InertialStated& x = filter.state();
    EXPECT_EQ(x.velocity, Vector3d::Zero());
    EXPECT_EQ(x.gyro_bias, settings.gyro_bias);
    EXPECT_EQ(x.accelerometer_bias, settings.accelerometer_bias);
    EXPECT_TRUE(stddev(filter, I::velocity).isApproxToConstant(6.0, 1e-9));
    EXPECT_TRUE(stddev(filter, I::gyro_bias).isApproxToConstant(0.05, 1e-9));
    EXPECT_TRUE(stddev(filter, I::accelerometer_bias).isApproxToConstant(0.4, 1e-9));
    for (const int bias : {I::gyro_bias, I::accelerometer_bias})
      for (int part = 0; part < I::size; part += 3)
        if (part != bias) {
          EXPECT_EQ(covariance_of(filter, bias, part), 0.0) << bias << ' ' << part;
          EXPECT_EQ(covariance_of(filter, part, bias), 0.0) << bias << ' ' << part;
        }
  }
  const Filter filter = start(all_but_pose);
  const InertialStated& x = filter.state();
  EXPECT_EQ(x.velocity, before.velocity);
  EXPECT_LT((x.gyro_bias - before.gyro_bias).norm(), 1e-12);
  EXPECT_LT((x.accelerometer_bias - before.accelerometer_bias).norm(), 1e-12);
  EXPECT_TRUE(stddev(filter, I::gyro_bias)
                  .isApprox(covariance.diagonal().segment<3>(I::gyro_bias).cwiseSqrt(), 0.05));
  EXPECT_GT(covariance_of(filter, I::gyro_bias, I::accelerometer_bias), 0.0);
}

// By an acceleration of 10 m/s^2 during the gap.
TEST_F(EkfStartAtPose, VelocityIsLessCertainAfterALongerGap) {
  for (const double gap : {0.0, 0.1, 0.4, 0.55, 2.0})
    EXPECT_TRUE(stddev(start({true, true, gap}), I::velocity)
                    .isApproxToConstant(gap < 0.55 ? 0.5 + 10.0 * gap : 6.0, 1e-9))
        << gap;
}

// Between the marker frame and the biases only what is known stays.
TEST_F(EkfStartAtPose, MarkerFrameKeepsItsCovarianceIfKnown) {
  const Filter unknown = start(nothing), known = start(marker), all = start(all_but_pose);
  EXPECT_TRUE(stddev(unknown, I::marker_position).isApproxToConstant(0.01, 1e-2));
  EXPECT_TRUE(stddev(unknown, I::marker_orientation).isApproxToConstant(0.02, 1e-2));
  for (const Filter* filter : {&known, &all})
    for (const int part : {I::marker_orientation, I::marker_position})
      EXPECT_TRUE(
          stddev(*filter, part).isApprox(covariance.diagonal().segment<3>(part).cwiseSqrt(), 0.01));
  EXPECT_EQ(covariance_of(known, I::gyro_bias, I::marker_position), 0.0);
  EXPECT_GT(covariance_of(all, I::gyro_bias, I::marker_position), 0.0);
  EXPECT_GT(covariance_of(all, I::marker_orientation, I::accelerometer_bias), 0.0);
}

// The pose is as exact as its noise; with an uncertain marker frame, the body is less certain.
TEST_F(EkfStartAtPose, PoseSetsTheCovarianceOfPositionAndOrientation) {
  settings.marker_position_stddev = settings.marker_orientation_stddev = 0.0;
  const Filter exact = start(nothing);
  EXPECT_TRUE(
      stddev(exact, I::orientation).isApproxToConstant(settings.pose_noise.orientation, 1e-3));
  const double lever = (settings.marker_position - settings.imu_position).norm();
  EXPECT_LT(stddev(exact, I::position).maxCoeff(),
            std::hypot(settings.pose_noise.position, lever * settings.pose_noise.orientation));
  settings.marker_orientation_stddev = 0.02;
  const Filter uncertain = start(nothing);
  EXPECT_TRUE(stddev(uncertain, I::orientation)
                  .isApproxToConstant(std::hypot(0.02, settings.pose_noise.orientation), 1e-3));
  EXPECT_GT(covariance_of(uncertain, I::orientation, I::marker_orientation), 0.9 * 0.02 * 0.02);
}

// The covariance moves with the state, and what the vehicle did in the gap is unknown.
TEST_F(EkfStartAtPose, AfterAGapTheVelocityMovesThePosition) {
  constexpr double gap = 0.3;
  const Vector3d angular_velocity(0.5, -1.0, 2.0);
  Filter filter(settings.imu_noise, settings.pose_noise);
  filter.reset(before, covariance);
  ASSERT_TRUE(detail::resume(filter, gap, angular_velocity));
  Covariance moves = Covariance::Identity(), expected = covariance;
  moves.block<3, 3>(I::position, I::velocity) = gap * Eigen::Matrix3d::Identity();
  expected = moves * expected * moves.transpose();
  const auto add = [&expected](int part, double stddev) {
    expected.diagonal().segment<3>(part).array() += stddev * stddev;
  };
  add(I::orientation, gap);
  add(I::velocity, 10.0 * gap);
  add(I::position, 5.0 * gap * gap);
  EXPECT_TRUE(filter.covariance().isApprox(expected, 1e-9));
  const InertialStated& x = filter.state();
  EXPECT_TRUE(x.position.isApprox(before.position + gap * before.velocity));
  EXPECT_EQ(x.velocity, before.velocity);
  EXPECT_LT(
      x.orientation.angularDistance(before.orientation * quaternion_exp(gap * angular_velocity)),
      1e-9);
  EXPECT_FALSE(detail::resume(filter, 0.5, angular_velocity));
  EXPECT_TRUE(filter.covariance().isApprox(expected, 1e-9));
}

}  // namespace ekf_start_test
}  // namespace tilt_ropter
