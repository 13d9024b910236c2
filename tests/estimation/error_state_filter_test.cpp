#include <tilt_ropter/estimation/error_state_filter.hpp>

#include "support/autodiff.hpp"
#include "support/check_table.hpp"
#include "support/flights.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

namespace tilt_ropter {
namespace {

using test_support::Dual;
using test_support::Flight;
using test_support::Random;
using Tangent = InertialTangent<>;
using Covariance = ErrorStateFilter<>::Covariance;
using Innovation = ErrorStateFilter<>::Innovation;

InertialNoise noise() {
  return {2e-3, 2e-2, 2e-5, 3e-4};
}

ErrorStateFilter<> filter() {
  return {noise(), MarkerPoseNoise{2e-3, 5e-3}};
}

InertialState<> random_state(Random& random) {
  InertialState<> x;
  x.position = random.vector(5.0);
  x.velocity = random.vector(5.0);
  x.orientation = random.orientation();
  x.gyro_bias = random.vector(0.1);
  x.accelerometer_bias = random.vector(0.5);
  x.marker_orientation = random.orientation();
  x.marker_position = random.vector(0.2);
  return x;
}

// Every part correlated with every other, in sizes as a filter has them.
Covariance random_covariance(Random& random) {
  Covariance a = Covariance::NullaryExpr([&random] { return random.normal(1.0); });
  const Tangent size =
      Tangent::NullaryExpr([&random] { return std::pow(10.0, random.uniform(-3.0, 0.0)); });
  a = (size.asDiagonal() * a).eval();
  Covariance p = a * a.transpose() / 21.0;
  p.triangularView<Eigen::StrictlyUpper>() = p.transpose();
  return p;
}

template <typename Scalar, typename From>
InertialState<Scalar> cast(const InertialState<From>& x) {
  InertialState<Scalar> y;
  y.position = x.position.template cast<Scalar>();
  y.velocity = x.velocity.template cast<Scalar>();
  y.orientation = x.orientation.template cast<Scalar>();
  y.gyro_bias = x.gyro_bias.template cast<Scalar>();
  y.accelerometer_bias = x.accelerometer_bias.template cast<Scalar>();
  y.marker_orientation = x.marker_orientation.template cast<Scalar>();
  y.marker_position = x.marker_position.template cast<Scalar>();
  return y;
}

template <typename Scalar>
InertialSample<Scalar> cast(const InertialSample<>& s) {
  return {s.angular_velocity.cast<Scalar>(), s.specific_force.cast<Scalar>()};
}

template <typename Scalar>
MarkerPose<Scalar> cast(const MarkerPose<>& pose) {
  return {pose.position.cast<Scalar>(), pose.orientation.cast<Scalar>()};
}

// What a pose shows of a state beyond `x`, in the coordinates of the residual.
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

Eigen::Matrix<double, 6, 21> pose_jacobian(const InertialState<>& x) {
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

// Of the correlation matrix.
double least_eigenvalue(const Covariance& p) {
  const Tangent scale = p.diagonal().cwiseSqrt().cwiseInverse();
  const Covariance correlation = scale.asDiagonal() * p * scale.asDiagonal();
  return Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(correlation, Eigen::EigenvaluesOnly)
      .eigenvalues()(0);
}

TEST(ErrorStateFilter, DifferenceUndoesRetraction) {
  Random random(101);
  for (int i = 0; i < 10000; ++i) {
    const double size = i % 3 == 0 ? 1.0 : i % 3 == 1 ? 1e-3 : 1e-9;
    const InertialState<> x = random_state(random);
    Tangent dx = Tangent::NullaryExpr([&] { return random.uniform(-1.7, 1.7) * size; });
    const InertialState<> y = retract(x, dx);
    EXPECT_LT((difference(y, x) - dx).norm(), 1e-13);  // positions of 5 m lose as much
    EXPECT_LT(difference(retract(x, difference(y, x)), y).norm(), 1e-13);
    InertialState<> other_sign = y;
    other_sign.orientation.coeffs() *= -1.0;
    other_sign.marker_orientation.coeffs() *= -1.0;
    EXPECT_LT((difference(other_sign, x) - dx).norm(), 1e-13);
  }
  EXPECT_EQ(difference(InertialState<>(), InertialState<>()), Tangent::Zero());
}

TEST(ErrorStateFilter, EachPartOfTheTangentMovesThePartItIsNamedAfter) {
  using I = InertialIndex;
  Random random(102);
  const InertialState<> x = random_state(random);
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

// Largest error of position, velocity and orientation after 2 s under means of samples `dt` apart.
double propagation_error(const Flight& flight, double dt) {
  InertialState<> x = flight.state(0.0);
  x.gyro_bias << 0.03, -0.02, 0.01;
  x.accelerometer_bias << -0.2, 0.1, 0.3;
  InertialState<> truth = x;
  const int steps = static_cast<int>(std::lround(2.0 / dt));
  for (int i = 0; i < steps; ++i) {
    const InertialSample<> from = flight.imu(dt * i), to = flight.imu(dt * (i + 1));
    x = propagate(x,
                  {(from.angular_velocity + to.angular_velocity) / 2.0 + x.gyro_bias,
                   (from.specific_force + to.specific_force) / 2.0 + x.accelerometer_bias},
                  dt);
  }
  const InertialState<> end = flight.state(dt * steps);
  truth.position = end.position;
  truth.velocity = end.velocity;
  truth.orientation = end.orientation;
  return difference(truth, x).norm();
}

TEST(ErrorStateFilter, PropagationIsOfSecondOrderAgainstAFlightInClosedForm) {
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

// A rate and a force that stay as they are in the body: the rotation is exact for any step, speed
// and way are of second order.
TEST(ErrorStateFilter, ConstantRateIsExactAndAForceThatDoesNotTurnToo) {
  Random random(103);
  for (int i = 0; i < 1000; ++i) {
    InertialState<> x = random_state(random);
    InertialSample<> sample{random.vector(5.0), random.vector(20.0)};
    const double dt = random.uniform(0.01, 1.0);
    const Eigen::Quaterniond turned =
        x.orientation * quaternion_exp((sample.angular_velocity - x.gyro_bias) * dt);
    const InertialState<> y = propagate(x, sample, dt);
    EXPECT_LT(y.orientation.angularDistance(turned), 1e-14);
    EXPECT_EQ(y.gyro_bias, x.gyro_bias);
    EXPECT_EQ(y.accelerometer_bias, x.accelerometer_bias);
    EXPECT_EQ(y.marker_position, x.marker_position);
    EXPECT_EQ(y.marker_orientation.coeffs(), x.marker_orientation.coeffs());

    sample.angular_velocity = x.gyro_bias;
    const Eigen::Vector3d a =
        x.orientation * (sample.specific_force - x.accelerometer_bias).eval() -
        Eigen::Vector3d(0.0, 0.0, gravity);
    const InertialState<> straight = propagate(x, sample, dt);
    EXPECT_LT((straight.velocity - x.velocity - dt * a).norm(), 1e-13);
    EXPECT_LT((straight.position - x.position - dt * x.velocity - 0.5 * dt * dt * a).norm(), 1e-13);
  }
}

TEST(ErrorStateFilter, AtRestTheStateStandsStill) {
  InertialState<> x;
  x.orientation = Random(104).orientation();
  const InertialSample<> rest{Eigen::Vector3d::Zero(),
                              x.orientation.conjugate() * Eigen::Vector3d(0.0, 0.0, gravity)};
  const InertialState<> y = propagate(x, rest, 0.5);
  EXPECT_LT(difference(y, x).norm(), 1e-14);
}

TEST(ErrorStateFilter, PredictedCovarianceIsThatOfTheLinearisedStep) {
  using Scalar = Dual<21>;
  Random random(105);
  ErrorStateFilter<> f = filter();
  double worst = 0.0;
  for (int i = 0; i < test_support::quick_or_full(2000, 10000); ++i) {
    const InertialState<> x = random_state(random);
    const Covariance p = random_covariance(random);
    InertialSample<> sample{random.vector(6.0), random.vector(20.0)};
    double dt = std::pow(10.0, random.uniform(-3.5, -1.0));
    if (i % 5 == 1) sample.angular_velocity = x.gyro_bias;  // no turn at all
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
    // Entry by entry, in the units of the deviations.
    const Tangent scale = expected.diagonal().cwiseSqrt().cwiseInverse();
    worst = std::max(worst, (scale.asDiagonal() * (f.covariance() - expected) * scale.asDiagonal())
                                .cwiseAbs()
                                .maxCoeff());
    EXPECT_EQ(difference(f.state(), propagate(x, sample, dt)), Tangent::Zero());
  }
  test_support::check_at_most(7, "filter: predicted covariance's relative error", worst, 1e-12);
}

// Each density alone, in a step short enough for it to be the only one seen.
TEST(ErrorStateFilter, EachDensityOfNoiseGrowsItsOwnVariance) {
  const double dt = 0.01;
  const auto grown = [dt](const InertialNoise& n) {
    ErrorStateFilter<> f(n, {});
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

TEST(ErrorStateFilter, InnovationIsThatOfTheLinearisedPose) {
  Random random(106);
  ErrorStateFilter<> f = filter();
  double worst_h = 0.0, worst_c = 0.0, worst_s = 0.0, worst_r = 0.0, worst_nis = 0.0;
  for (int i = 0; i < test_support::quick_or_full(2000, 10000); ++i) {
    InertialState<> x = random_state(random);
    if (i % 4 == 1) x.marker_position.setZero();
    if (i % 4 == 2) x.marker_orientation.setIdentity();
    const Eigen::Matrix<double, 6, 21> h = pose_jacobian(x);
    const MarkerPose<> pose{random.vector(5.0), random.orientation()};

    f.reset(x, Covariance::Identity());
    worst_h = std::max(worst_h, relative(f.innovation(pose).correlation, h.transpose()));

    const Covariance p = random_covariance(random);
    f.reset(x, p);
    const Innovation in = f.innovation(pose);
    const Eigen::MatrixXd s = h * p * h.transpose() + pose_covariance();
    worst_c = std::max(worst_c, relative(in.correlation, p * h.transpose()));
    worst_s = std::max(worst_s, relative(in.covariance, s));
    InertialState<> seen = x;  // a state that would show this pose
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
  EXPECT_LT(worst_nis, 1e-7);  // by the condition of S
}

TEST(ErrorStateFilter, APoseAndItsQuaternionsOtherSignAreTheSame) {
  Random random(107);
  ErrorStateFilter<> f = filter();
  for (int i = 0; i < 1000; ++i) {
    f.reset(random_state(random), random_covariance(random));
    const MarkerPose<> pose{random.vector(5.0), random.orientation()};
    const Innovation in = f.innovation(pose);
    EXPECT_EQ(in.residual, f.innovation(test_support::flipped(pose)).residual);
  }
}

TEST(ErrorStateFilter, UpdateIsTheTextbooksInJosephsForm) {
  Random random(108);
  ErrorStateFilter<> f = filter();
  double worst_state = 0.0, worst_covariance = 0.0;
  for (int i = 0; i < 2000; ++i) {
    const InertialState<> x = random_state(random);
    const Covariance p = random_covariance(random);
    f.reset(x, p);
    const MarkerPose<> pose = test_support::noisy(
        {x.position + x.orientation * x.marker_position, x.orientation * x.marker_orientation},
        {0.1, 0.1}, random);
    const Innovation in = f.innovation(pose);
    f.update(in);
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

// What is said to be known stays as it is, and the rest is as if it were not there.
TEST(ErrorStateFilter, RowsOfZeroCovarianceStayUntouchedBitForBit) {
  Random random(109);
  const Flight flight(9, random.orientation(), {0.05, -0.03, 0.1}, random.orientation());
  Covariance p = random_covariance(random);
  p.bottomRows<6>().setZero();
  p.rightCols<6>().setZero();
  p.diagonal().head<15>().array() += 1e-4;
  ErrorStateFilter<> f = filter();
  f.reset(flight.state(0.0), p);
  for (int i = 0; i < 1000; ++i) {
    f.predict(flight.imu(0.005 * i + 0.0025), 0.005);
    if (i % 2 == 0)
      f.update(f.innovation(test_support::noisy(flight.pose(0.005 * (i + 1)), {}, random)));
  }
  EXPECT_EQ(f.state().marker_position, flight.state(0.0).marker_position);
  EXPECT_LT(f.state().marker_orientation.angularDistance(flight.state(0.0).marker_orientation),
            1e-15);
  EXPECT_TRUE((f.covariance().bottomRows<6>().array() == 0.0).all());
  EXPECT_TRUE((f.covariance().rightCols<6>().array() == 0.0).all());
  EXPECT_LT((f.state().position - flight.state(5.0).position).norm(), 0.01);
}

// With little noise and much, poses and long stretches without, the covariance stays what it is.
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
      f.update(f.innovation(cast<Scalar>(test_support::noisy(flight.pose(t), {}, random))));
  }
}

TEST(ErrorStateFilter, CovarianceStaysSymmetricAndPositive) {
  const int steps = test_support::quick_or_full(100000, 1000000);
  ErrorStateFilter<> usual = filter(), still_biases({2e-3, 2e-2, 0.0, 0.0}, {2e-3, 5e-3});
  fly_long(usual, 3, steps);
  EXPECT_EQ(usual.covariance(), usual.covariance().transpose());
  EXPECT_GT(least_eigenvalue(usual.covariance()), 0.1);
  fly_long(still_biases, 4, steps);  // they become known ever better
  EXPECT_EQ(still_biases.covariance(), still_biases.covariance().transpose());
  EXPECT_GT(least_eigenvalue(still_biases.covariance()), 0.01);
}

// Nothing keeps the covariance from zero any more, and what is left of it is rounding.
TEST(ErrorStateFilter, AnImuWithoutNoiseDoesNoHarm) {
  ErrorStateFilter<> silent({0.0, 0.0, 0.0, 0.0}, {2e-3, 5e-3});
  fly_long(silent, 4, 100000);
  EXPECT_EQ(silent.covariance(), silent.covariance().transpose());
  EXPECT_GT(silent.covariance().diagonal().minCoeff(), 0.0);
  EXPECT_GT(least_eigenvalue(silent.covariance()), 0.0);
}

TEST(ErrorStateFilter, SinglePrecisionAgrees) {
  ErrorStateFilter<float> single({2e-3, 2e-2, 2e-5, 3e-4}, MarkerPoseNoise{2e-3, 5e-3});
  ErrorStateFilter<> exact = filter();
  fly_long(single, 5, 20000);
  fly_long(exact, 5, 20000);
  const Covariance p = single.covariance().cast<double>();
  EXPECT_EQ(p, p.transpose());
  EXPECT_GT(least_eigenvalue(p), 0.0);
  const Tangent deviation = exact.covariance().diagonal().cwiseSqrt();
  EXPECT_LT((p.diagonal().cwiseSqrt() - deviation).cwiseQuotient(deviation).cwiseAbs().maxCoeff(),
            0.05);
  const Tangent apart = difference(cast<double>(single.state()), exact.state());
  EXPECT_LT(apart.cwiseQuotient(deviation).cwiseAbs().maxCoeff(), 1.0);
}

template <typename Parameters>
std::string complaint(const Parameters& p) {
  try {
    validate(p);
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return "";
}

TEST(ErrorStateFilter, APoseWhoseCovarianceRoundingHasMadeNegativeChangesNothing) {
  ErrorStateFilter<> f = filter();
  Covariance p = Covariance::Identity();
  p(0, 0) = -3.0;  // far more than rounding does
  InertialState<> x;
  x.position << 1.0, 2.0, 3.0;
  f.reset(x, p);
  const Innovation in = f.innovation({});
  EXPECT_EQ(in.distance, std::numeric_limits<double>::max());
  EXPECT_FALSE(f.update(in));
  EXPECT_EQ(f.covariance(), p);
  EXPECT_EQ(difference(f.state(), x), Tangent::Zero());
}

TEST(ErrorStateFilter, NoiseOutOfRangeIsRefusedByName) {
  EXPECT_EQ(complaint(InertialNoise{}), "");
  EXPECT_EQ(complaint(InertialNoise{0.0, 0.0, 0.0, 0.0}), "");
  EXPECT_EQ(complaint(InertialNoise{-1.0, 0.0, 0.0, 0.0}),
            "InertialNoise.gyro_density [rad/s/sqrt(Hz)] = -1: must be in [0, 1000]");
  EXPECT_EQ(complaint(InertialNoise{0.0, -2.0, 0.0, 0.0}),
            "InertialNoise.accelerometer_density [m/s^2/sqrt(Hz)] = -2: must be in [0, 1000]");
  EXPECT_EQ(complaint(InertialNoise{0.0, 0.0, -3.0, 0.0}),
            "InertialNoise.gyro_bias_walk [rad/s^2/sqrt(Hz)] = -3: must be in [0, 1000]");
  EXPECT_EQ(complaint(InertialNoise{0.0, 0.0, 0.0, std::nan("")}),
            "InertialNoise.accelerometer_bias_walk [m/s^3/sqrt(Hz)] = nan: must be in [0, 1000]");
  EXPECT_EQ(complaint(MarkerPoseNoise{}), "");
  EXPECT_EQ(complaint(MarkerPoseNoise{0.0, 1.0}),
            "MarkerPoseNoise.position [m] = 0: must be in [1e-06, 1000]");
  EXPECT_EQ(complaint(MarkerPoseNoise{1.0, std::numeric_limits<double>::infinity()}),
            "MarkerPoseNoise.orientation [rad] = inf: must be in [1e-06, 10]");
  EXPECT_THROW(ErrorStateFilter<>({-1.0, 0.0, 0.0, 0.0}, {}), std::invalid_argument);
  EXPECT_THROW(ErrorStateFilter<>({}, {0.0, 1.0}), std::invalid_argument);
}

}  // namespace
}  // namespace tilt_ropter
