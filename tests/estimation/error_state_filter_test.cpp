// Retraction, propagation, long flights and settings out of range.

#include <tilt_ropter/estimation/detail/error_state_filter.hpp>

#include "support/error_states.hpp"
#include "support/flights.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include <limits>

namespace tilt_ropter {
namespace error_state_filter_test {

using test_support::cast;
using test_support::filter;
using test_support::Flight;
using test_support::Random;
using test_support::random_covariance;
using Tangent = InertialTangentd;
using Covariance = ErrorStateFilterd::Covariance;
using Innovation = MeasurementInnovation<double, 6>;

constexpr auto* random_state = test_support::random_inertial_state;

// Returns true if all eigenvalues of the correlation matrix of `p` exceed `limit`.
bool eigenvalues_exceed(double limit, const Covariance& p) {
  const Tangent scale = p.diagonal().cwiseSqrt().cwiseInverse();
  const Covariance correlation = scale.asDiagonal() * p * scale.asDiagonal();
  return (correlation - limit * Covariance::Identity()).llt().info() == Eigen::Success;
}

TEST(ErrorStateFilter, DifferenceUndoesRetraction) {
  Random random(101);
  for (int i = 0; i < 10000; ++i) {
    const double size = i % 3 == 0 ? 1.0 : i % 3 == 1 ? 1e-3 : 1e-9;
    const InertialStated x = random_state(random);
    Tangent dx = Tangent::NullaryExpr([&] { return random.uniform(-1.7, 1.7) * size; });
    const InertialStated y = retract(x, dx);
    EXPECT_LT((difference(y, x) - dx).norm(), 1e-13);  // rounding error of positions of 5 m
    EXPECT_LT(difference(retract(x, difference(y, x)), y).norm(), 1e-13);
    InertialStated other_sign = y;
    other_sign.orientation.coeffs() *= -1.0;
    other_sign.marker_orientation.coeffs() *= -1.0;
    EXPECT_LT((difference(other_sign, x) - dx).norm(), 1e-13);
  }
  EXPECT_EQ(difference(InertialStated(), InertialStated()), Tangent::Zero());
}

TEST(ErrorStateFilter, EachTangentIndexMovesItsStatePart) {
  using I = InertialIndex;
  Random random(102);
  const InertialStated x = random_state(random);
  const auto moved = [&x](int start) {
    Tangent dx = Tangent::Zero();
    dx.segment<3>(start) << 0.1, 0.2, 0.3;
    return retract(x, dx);
  };
  const Eigen::Vector3d by(0.1, 0.2, 0.3);
  EXPECT_LT((moved(I::position).position - x.position - by).norm(), 1e-14);
  EXPECT_LT((moved(I::velocity).velocity - x.velocity - by).norm(), 1e-14);
  EXPECT_LT((moved(I::gyro_bias).gyro_bias - x.gyro_bias - by).norm(), 1e-14);
  EXPECT_LT((moved(I::accelerometer_bias).accelerometer_bias - x.accelerometer_bias - by).norm(),
            1e-14);
  EXPECT_LT((moved(I::marker_position).marker_position - x.marker_position - by).norm(), 1e-14);
  EXPECT_LT(moved(I::orientation).orientation.angularDistance(x.orientation * quaternion_exp(by)),
            1e-14);
  EXPECT_LT(moved(I::marker_orientation)
                .marker_orientation.angularDistance(x.marker_orientation * quaternion_exp(by)),
            1e-14);
}

// Norm of the errors of position, velocity and orientation after 2 s, propagated with the mean of
// the IMU samples at the two ends of each interval `dt` [s].
double propagation_error(const Flight& flight, double dt) {
  InertialStated x = flight.state(0.0);
  x.gyro_bias << 0.03, -0.02, 0.01;
  x.accelerometer_bias << -0.2, 0.1, 0.3;
  InertialStated truth = x;
  const int steps = static_cast<int>(std::lround(2.0 / dt));
  for (int i = 0; i < steps; ++i) {
    const InertialSampled from = flight.imu(dt * i), to = flight.imu(dt * (i + 1));
    x = propagate(x,
                  {(from.angular_velocity + to.angular_velocity) / 2.0 + x.gyro_bias,
                   (from.specific_force + to.specific_force) / 2.0 + x.accelerometer_bias},
                  dt);
  }
  const InertialStated end = flight.state(dt * steps);
  truth.position = end.position;
  truth.velocity = end.velocity;
  truth.orientation = end.orientation;
  return difference(truth, x).norm();
}

TEST(ErrorStateFilter, PropagationHasSecondOrderAccuracy) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    Random random(seed);
    const Flight flight(seed, random.orientation());
    const double coarse = propagation_error(flight, 0.01);
    const double fine = propagation_error(flight, 0.005), finer = propagation_error(flight, 0.0025);
    EXPECT_LT(coarse, 1e-2);
    EXPECT_NEAR(coarse / fine, 4.0, 0.2);
    EXPECT_NEAR(fine / finer, 4.0, 0.1);
  }
}

// Rate and specific force are constant in the body frame. The orientation is then exact for any
// step; velocity and position are of second order.
TEST(ErrorStateFilter, ConstantRateIsExactAndConstantForceWithoutRotationToo) {
  Random random(103);
  for (int i = 0; i < 1000; ++i) {
    InertialStated x = random_state(random);
    InertialSampled sample{random.vector(5.0), random.vector(20.0)};
    const double dt = random.uniform(0.01, 1.0);
    const Eigen::Quaterniond turned =
        x.orientation * quaternion_exp((sample.angular_velocity - x.gyro_bias) * dt);
    const InertialStated y = propagate(x, sample, dt);
    EXPECT_LT(y.orientation.angularDistance(turned), 1e-14);
    EXPECT_EQ(y.gyro_bias, x.gyro_bias);
    EXPECT_EQ(y.accelerometer_bias, x.accelerometer_bias);
    EXPECT_EQ(y.marker_position, x.marker_position);
    EXPECT_EQ(y.marker_orientation.coeffs(), x.marker_orientation.coeffs());

    sample.angular_velocity = x.gyro_bias;
    const Eigen::Vector3d a =
        x.orientation * (sample.specific_force - x.accelerometer_bias).eval() -
        Eigen::Vector3d(0.0, 0.0, gravity);
    const InertialStated straight = propagate(x, sample, dt);
    EXPECT_LT((straight.velocity - x.velocity - dt * a).norm(), 1e-13);
    EXPECT_LT((straight.position - x.position - dt * x.velocity - 0.5 * dt * dt * a).norm(), 1e-13);
  }
}

TEST(ErrorStateFilter, StateIsConstantAtRest) {
  InertialStated x;
  x.orientation = Random(104).orientation();
  const InertialSampled rest{Eigen::Vector3d::Zero(),
                             x.orientation.conjugate() * Eigen::Vector3d(0.0, 0.0, gravity)};
  const InertialStated y = propagate(x, rest, 0.5);
  EXPECT_LT(difference(y, x).norm(), 1e-14);
}

// Each noise density alone, in a step short enough that only this density has an effect.
TEST(ErrorStateFilter, EachNoiseDensityIncreasesItsOwnVariance) {
  const double dt = 0.01;
  const auto grown = [dt](const InertialNoise& n) {
    ErrorStateFilterd f(n, {});
    f.reset({}, Covariance::Zero());
    f.predict({}, dt);
    return Tangent(f.covariance().diagonal() / dt);
  };
  const auto expected = [](int start, double density) {
    Tangent v = Tangent::Zero();
    v.segment<3>(start).setConstant(density * density);
    return v;
  };
  EXPECT_LT((grown({0.2, 0.0, 0.0, 0.0}) - expected(6, 0.2)).norm(), 1e-15);
  EXPECT_LT((grown({0.0, 0.3, 0.0, 0.0}) - expected(3, 0.3)).norm(), 1e-15);
  EXPECT_LT((grown({0.0, 0.0, 0.4, 0.0}) - expected(9, 0.4)).norm(), 1e-15);
  EXPECT_LT((grown({0.0, 0.0, 0.0, 0.5}) - expected(12, 0.5)).norm(), 1e-15);
}

TEST(ErrorStateFilter, InnovationIsIndependentOfQuaternionSign) {
  Random random(107);
  ErrorStateFilterd f = filter();
  for (int i = 0; i < 1000; ++i) {
    f.reset(random_state(random), random_covariance(random));
    const MarkerPosed pose{random.vector(5.0), random.orientation()};
    const Innovation in = f.innovation_of(f.linearise(pose));
    EXPECT_EQ(in.residual, f.innovation_of(f.linearise(test_support::flipped(pose))).residual);
  }
}

// States with zero covariance do not change, and the other states behave as if these were
// constants.
TEST(ErrorStateFilter, StatesWithZeroCovarianceStayUnchangedBitForBit) {
  Random random(109);
  const Flight flight(9, random.orientation(), {0.05, -0.03, 0.1}, random.orientation());
  Covariance p = random_covariance(random);
  p.bottomRows<6>().setZero();
  p.rightCols<6>().setZero();
  p.diagonal().head<15>().array() += 1e-4;
  ErrorStateFilterd f = filter();
  f.reset(flight.state(0.0), p);
  for (int i = 0; i < 1000; ++i) {
    f.predict(flight.imu(0.005 * i + 0.0025), 0.005);
    if (i % 2 == 0) f.update(test_support::noisy(flight.pose(0.005 * (i + 1)), {}, random));
  }
  EXPECT_EQ(f.state().marker_position, flight.state(0.0).marker_position);
  EXPECT_LT(f.state().marker_orientation.angularDistance(flight.state(0.0).marker_orientation),
            1e-15);
  EXPECT_TRUE((f.covariance().bottomRows<6>().array() == 0.0).all());
  EXPECT_TRUE((f.covariance().rightCols<6>().array() == 0.0).all());
  EXPECT_LT((f.state().position - flight.state(5.0).position).norm(), 0.01);
}

// Long flight with uneven IMU intervals and with stretches without poses.
template <typename Scalar>
void fly_long(ErrorStateFilter<Scalar>& f, unsigned seed, int steps) {
  Random random(seed);
  const Flight flight(seed, random.orientation(), {0.05, -0.03, 0.1}, random.orientation());
  using P = typename ErrorStateFilter<Scalar>::Covariance;
  P p = P::Identity();
  p.template bottomRightCorner<6, 6>() *= Scalar(0.01);
  f.reset(cast<Scalar>(flight.state(0.0)), p);
  double t = 0.0;
  for (int i = 0; i < steps; ++i) {
    const double dt = i % 7 == 0 ? 0.02 : 0.002;
    f.predict(cast<Scalar>(flight.imu(t + dt / 2.0)), Scalar(dt));
    t += dt;
    if (i % 3 == 0 && i % 5000 > 500)
      f.update(cast<Scalar>(test_support::noisy(flight.pose(t), {}, random)));
  }
}

TEST(ErrorStateFilter, CovarianceStaysSymmetricPositiveDefinite) {
  const int steps = test_support::quick_or_full(100000, 1000000);
  ErrorStateFilterd usual = filter(), still_biases({2e-3, 2e-2, 0.0, 0.0}, {2e-3, 5e-3});
  fly_long(usual, 3, steps);
  EXPECT_EQ(usual.covariance(), usual.covariance().transpose());
  EXPECT_TRUE(eigenvalues_exceed(0.1, usual.covariance()));
  fly_long(still_biases, 4, steps);  // the variance of the biases falls steadily
  EXPECT_EQ(still_biases.covariance(), still_biases.covariance().transpose());
  EXPECT_TRUE(eigenvalues_exceed(0.01, still_biases.covariance()));
}

// Without IMU noise the covariance falls towards zero, until only rounding errors remain.
TEST(ErrorStateFilter, CovarianceStaysPositiveDefiniteWithoutImuNoise) {
  ErrorStateFilterd silent({0.0, 0.0, 0.0, 0.0}, {2e-3, 5e-3});
  fly_long(silent, 4, 100000);
  EXPECT_EQ(silent.covariance(), silent.covariance().transpose());
  EXPECT_GT(silent.covariance().diagonal().minCoeff(), 0.0);
  EXPECT_TRUE(eigenvalues_exceed(0.0, silent.covariance()));
}

#ifdef TILT_ROPTER_FULL_TESTS  // seconds to compile
TEST(ErrorStateFilter, SinglePrecisionAgrees) {
  ErrorStateFilter<float> single({2e-3, 2e-2, 2e-5, 3e-4}, MarkerPoseNoise{2e-3, 5e-3});
  ErrorStateFilterd exact = filter();
  fly_long(single, 5, 20000);
  fly_long(exact, 5, 20000);
  const Covariance p = single.covariance().cast<double>();
  EXPECT_EQ(p, p.transpose());
  EXPECT_TRUE(eigenvalues_exceed(0.0, p));
  const Tangent deviation = exact.covariance().diagonal().cwiseSqrt();
  EXPECT_LT((p.diagonal().cwiseSqrt() - deviation).cwiseQuotient(deviation).cwiseAbs().maxCoeff(),
            0.05);
  const Tangent apart = difference(cast<double>(single.state()), exact.state());
  EXPECT_LT(apart.cwiseQuotient(deviation).cwiseAbs().maxCoeff(), 1.0);
}
#endif

TEST(ErrorStateFilter, RejectsUpdateWithIndefiniteInnovationCovariance) {
  ErrorStateFilterd f = filter();
  Covariance p = Covariance::Identity();
  p(0, 0) = -3.0;  // far more than rounding causes
  InertialStated x;
  x.position << 1.0, 2.0, 3.0;
  f.reset(x, p);
  const Innovation in = f.innovation_of(f.linearise({}));
  EXPECT_EQ(in.distance, std::numeric_limits<double>::max());
  EXPECT_FALSE(f.update(in, f.linearise(MarkerPosed())));
  EXPECT_EQ(f.covariance(), p);
  EXPECT_EQ(difference(f.state(), x), Tangent::Zero());
}

}  // namespace error_state_filter_test
}  // namespace tilt_ropter
