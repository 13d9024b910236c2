// The Jacobian of every measurement model against automatic differentiation, and its residual.

#include <tilt_ropter/estimation/measurement_models.hpp>

#include "support/autodiff.hpp"
#include "support/error_states.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace measurement_models_test {

using Eigen::Vector3d;
using test_support::cast;
using test_support::Dual;
using test_support::Random;

using Derivative = Dual<21>;

// Motion with this error: the gyro sample is measured, so a larger bias is a smaller rate.
InertialMotion<Derivative> moved(const InertialMotiond& at, const InertialTangent<Derivative>& dx) {
  InertialMotion<Derivative> y;
  const InertialState<Derivative> x = cast<Derivative>(at.state);
  y.state = retract(x, dx);
  y.angular_velocity = at.angular_velocity.cast<Derivative>() - (y.state.gyro_bias - x.gyro_bias);
  y.imu_position = at.imu_position.cast<Derivative>();
  return y;
}

// Returns the largest error of H, relative to its largest entry.
template <typename M, typename MDual>
double jacobian_error(const M& m, const MDual& dual, const InertialMotiond& at) {
  constexpr int rows = decltype(linearise(m, at))::rows;
  const auto h = linearise(m, at);
  EXPECT_TRUE(h.valid);
  EXPECT_TRUE(h.is_usable());
  const Eigen::Matrix<double, rows, 21> expected =
      test_support::jacobian_at_zero<rows, 21>([&](const InertialTangent<Derivative>& dx) {
        return (-linearise(dual, moved(at, dx)).residual).eval();
      });
  return (h.jacobian - expected).cwiseAbs().maxCoeff() / expected.cwiseAbs().maxCoeff();
}

InertialMotiond random_motion(Random& random) {
  InertialMotiond at;
  at.state = test_support::random_inertial_state(random);
  at.state.position.z() = random.uniform(2.0, 5.0);
  at.angular_velocity = random.vector(3.0);
  at.imu_position = random.vector(0.2);
  return at;
}

// A state whose body z leans by less than a radian.
InertialMotiond nearly_level(Random& random) {
  InertialMotiond at = random_motion(random);
  at.state.orientation =
      quaternion_from_yaw(random.uniform(-3.0, 3.0)) * quaternion_exp(random.vector(0.3));
  return at;
}

MeasuredPlane<double> random_plane(Random& random) {
  return {Vector3d(random.uniform(-0.1, 0.1), random.uniform(-0.1, 0.1), 1.0).normalized(),
          random.uniform(-0.3, 0.1)};
}

MeasuredPlane<Derivative> dual(const MeasuredPlane<double>& p) {
  return {p.normal.cast<Derivative>(), Derivative(p.offset)};
}

template <typename Check>
void expect_exact(Check check) {
  Random random(501);
  double worst = 0.0;
  for (int i = 0; i < 200; ++i) worst = std::max(worst, check(random));
  EXPECT_LT(worst, 1e-12);
}

TEST(MeasurementModels, PositionJacobianIsExact) {
  expect_exact([](Random& random) {
    const PositionMeasurement<double> m{random.vector(2.0), Eigen::Matrix3d::Identity(),
                                        random.vector(0.5)};
    PositionMeasurement<Derivative> d;
    d.position = m.position.cast<Derivative>();
    d.antenna = m.antenna.cast<Derivative>();
    return jacobian_error(m, d, random_motion(random));
  });
}

TEST(MeasurementModels, VelocityJacobiansAreExact) {
  expect_exact([](Random& random) {
    WorldVelocityMeasurement<double> m;
    m.velocity = random.vector(2.0);
    m.antenna = random.vector(0.5);
    WorldVelocityMeasurement<Derivative> d;
    d.velocity = m.velocity.cast<Derivative>();
    d.antenna = m.antenna.cast<Derivative>();
    return jacobian_error(m, d, random_motion(random));
  });
  expect_exact([](Random& random) {
    BodyVelocityMeasurement<double> m;
    m.velocity = random.vector(2.0);
    m.sensor = random.vector(0.5);
    BodyVelocityMeasurement<Derivative> d;
    d.velocity = m.velocity.cast<Derivative>();
    d.sensor = m.sensor.cast<Derivative>();
    return jacobian_error(m, d, random_motion(random));
  });
}

TEST(MeasurementModels, HeightAndRangeJacobiansAreExact) {
  expect_exact([](Random& random) {
    const HeightMeasurement<double> m{random.uniform(0.0, 3.0), 0.1, random.vector(0.3)};
    const HeightMeasurement<Derivative> d{Derivative(m.height), Derivative(0.1),
                                          m.sensor.cast<Derivative>()};
    return jacobian_error(m, d, random_motion(random));
  });
  expect_exact([](Random& random) {
    RangeMeasurement<double> m;
    m.range = random.uniform(0.5, 3.0);
    m.sensor = random.vector(0.2);
    m.direction = (random.vector(0.15) - Vector3d::UnitZ()).normalized();
    m.ground = random_plane(random);
    RangeMeasurement<Derivative> d;
    d.range = Derivative(m.range);
    d.sensor = m.sensor.cast<Derivative>();
    d.direction = m.direction.cast<Derivative>();
    d.ground = dual(m.ground);
    return jacobian_error(m, d, nearly_level(random));
  });
}

// The tilt error has an effect of second order: its mean leaves the residual, and its variance is
// part of the noise.
TEST(MeasurementModels, RangeCountsTheTiltErrorToSecondOrder) {
  Random random(12);
  for (int run = 0; run < test_support::quick_or_full(2, 20); ++run) {
    InertialMotiond at = nearly_level(random);
    RangeMeasurement<double> m;
    m.sensor = random.vector(0.2);
    m.direction = (random.vector(0.3) - Vector3d::UnitZ()).normalized();
    m.stddev = 1e-3;
    const double range = -linearise(m, at).residual(0);
    const Vector3d stddev(0.05, 0.03, 0.04);
    at.orientation_covariance = stddev.cwiseAbs2().asDiagonal();
    m.range = range;
    const auto counted = linearise(m, at);
    double sum = 0.0, squares = 0.0;
    constexpr int samples = 20000;
    for (int i = 0; i < samples; ++i) {
      const Vector3d turn = stddev.cwiseProduct(test_support::normal_vector(random, 1.0));
      InertialMotiond true_motion = at;
      true_motion.state.orientation = at.state.orientation * quaternion_exp(turn);
      true_motion.orientation_covariance.setZero();
      RangeMeasurement<double> zero = m;
      zero.range = 0.0;
      const double beyond = -linearise(zero, true_motion).residual(0) - range -
                            counted.jacobian.middleCols<3>(InertialIndex::orientation).dot(turn);
      sum += beyond;
      squares += beyond * beyond;
    }
    const double mean = sum / samples, variance = squares / samples - mean * mean;
    EXPECT_NEAR(-counted.residual(0), mean, 0.05 * std::abs(mean) + 1e-4);
    EXPECT_NEAR(counted.noise(0) - m.stddev * m.stddev, variance, 0.1 * variance + 1e-7);
  }
}

TEST(MeasurementModels, FlowJacobianIsExact) {
  expect_exact([](Random& random) {
    FlowMeasurement<double> m;
    m.flow << random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0);
    m.camera = random.vector(0.2);
    m.ground = random_plane(random);
    FlowMeasurement<Derivative> d;
    d.flow = m.flow.cast<Derivative>();
    d.camera = m.camera.cast<Derivative>();
    d.ground = dual(m.ground);
    return jacobian_error(m, d, nearly_level(random));
  });
}

TEST(MeasurementModels, HeadingJacobianIsExact) {
  expect_exact([](Random& random) {
    const HeadingMeasurement<double> m{random.uniform(-pi, pi), 0.1};
    const HeadingMeasurement<Derivative> d{Derivative(m.heading), Derivative(0.1)};
    return jacobian_error(m, d, nearly_level(random));
  });
}

TEST(MeasurementModels, PoseJacobianIsExactWithoutResidual) {
  expect_exact([](Random& random) {
    const InertialMotiond at = random_motion(random);
    PoseMeasurement<double> m;
    m.sensor = random.vector(0.2);
    m.sensor_orientation = random.orientation();
    m.position = at.state.position + at.state.orientation * (m.sensor - at.imu_position);
    m.orientation = at.state.orientation * m.sensor_orientation;
    EXPECT_LT(linearise(m, at).residual.norm(), 1e-14);
    PoseMeasurement<Derivative> d;
    d.position = m.position.cast<Derivative>();
    d.orientation = m.orientation.cast<Derivative>();
    d.sensor = m.sensor.cast<Derivative>();
    d.sensor_orientation = m.sensor_orientation.cast<Derivative>();
    return jacobian_error(m, d, at);
  });
}

TEST(MeasurementModels, WheelJacobiansAreExact) {
  expect_exact([](Random& random) {
    NoSlipMeasurement<double> m;
    m.axle = random.vector(0.2);
    m.along = (Vector3d::UnitY() + random.vector(0.2)).normalized();
    NoSlipMeasurement<Derivative> d;
    d.axle = m.axle.cast<Derivative>();
    d.along = m.along.cast<Derivative>();
    return jacobian_error(m, d, random_motion(random));
  });
  expect_exact([](Random& random) {
    WheelHeightMeasurement<double> m;
    m.wheel = random.vector(0.3);
    m.ground = random_plane(random);
    WheelHeightMeasurement<Derivative> d;
    d.wheel = m.wheel.cast<Derivative>();
    d.ground = dual(m.ground);
    return jacobian_error(m, d, random_motion(random));
  });
  expect_exact([](Random& random) {
    WheelSpeedMeasurement<double> m;
    m.speed = random.uniform(-20.0, 20.0);
    m.wheel = random.vector(0.3);
    m.ground_normal = random_plane(random).normal;
    WheelSpeedMeasurement<Derivative> d;
    d.speed = Derivative(m.speed);
    d.wheel = m.wheel.cast<Derivative>();
    d.ground_normal = m.ground_normal.cast<Derivative>();
    return jacobian_error(m, d, nearly_level(random));
  });
}

TEST(MeasurementModels, ResidualsHaveTheDocumentedSigns) {
  InertialMotiond at;
  at.state.position << 1.0, 2.0, 3.0;
  at.state.velocity << 0.5, -0.2, 0.1;
  at.angular_velocity << 0.3, 0.4, 0.5;
  FlowMeasurement<double> flow;
  flow.flow << 0.4 - 0.5 / 3.0, -0.3 + 0.2 / 3.0;
  EXPECT_LT(linearise(flow, at).residual.norm(), 1e-15);
  RangeMeasurement<double> range;
  range.range = 3.5;
  EXPECT_NEAR(linearise(range, at).residual(0), 0.5, 1e-15);
  range.direction = Vector3d(1.0, 0.0, -1.0).normalized();
  EXPECT_NEAR(linearise(range, at).residual(0), 3.5 - 3.0 * std::sqrt(2.0), 1e-14);
  EXPECT_NEAR(linearise(HeadingMeasurement<double>{0.1, 0.1}, at).residual(0), 0.1, 1e-15);
  // A wheel of 0.5 m that rolls at 0.5 m/s while the body pitches at 0.4 rad/s turns at 0.6 rad/s
  // relative to it.
  WheelSpeedMeasurement<double> wheel;
  wheel.radius = 0.5;
  wheel.speed = 0.6;
  EXPECT_LT(std::abs(linearise(wheel, at).residual(0)), 1e-15);
  at.imu_position << 0.1, 0.0, 0.0;  // the body's origin is 10 cm behind the IMU
  EXPECT_NEAR(linearise(PositionMeasurement<double>{at.state.position, Eigen::Matrix3d::Identity(),
                                                    Vector3d::Zero()},
                        at)
                  .residual.x(),
              0.1, 1e-15);
}

TEST(MeasurementModels, AreNotValidWhereNothingIsSeen) {
  InertialMotiond at;
  at.state.position.z() = 1.0;
  at.state.orientation = quaternion_exp(Vector3d(pi, 0.0, 0.0));  // upside down
  EXPECT_FALSE(linearise(RangeMeasurement<double>{}, at).valid);
  EXPECT_FALSE(linearise(FlowMeasurement<double>{}, at).valid);
  at.state.orientation = quaternion_exp(Vector3d(0.0, pi / 2.0, 0.0));  // body x is vertical
  EXPECT_FALSE(linearise(HeadingMeasurement<double>{}, at).valid);
  at.state.orientation = quaternion_exp(Vector3d(pi / 2.0, 0.0, 0.0));  // the axle is vertical
  EXPECT_FALSE(linearise(WheelSpeedMeasurement<double>{}, at).valid);
  at.state.orientation.setIdentity();
  at.state.position.z() = -1.0;  // below the ground
  EXPECT_FALSE(linearise(RangeMeasurement<double>{}, at).valid);
  EXPECT_FALSE(linearise(FlowMeasurement<double>{}, at).valid);
}

TEST(MeasurementModels, WhiteNoiseOfEqualEffectIsLarger) {
  EXPECT_DOUBLE_EQ(white_stddev(0.5, 10.0, 50.0), 0.5 * std::sqrt(1000.0));
  EXPECT_EQ(white_stddev(0.5, 0.001, 50.0), 0.5);  // not correlated from sample to sample
}

}  // namespace measurement_models_test
}  // namespace tilt_ropter
