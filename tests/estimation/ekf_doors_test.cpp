// Lies of the filter's sensors: another unit, sign, axis, frame, order or covariance. Each is
// refused, or harmless, or the estimate is not good; the filter is never good and wrong.
// CTest: optimised

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include "support/flights.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <functional>
#include <limits>
#include <vector>

namespace tilt_ropter {
namespace ekf_doors_test {

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;

constexpr double nan = std::numeric_limits<double>::quiet_NaN(), degree = pi / 180.0;

/// What the sensors say at one time.
struct Words {
  InertialSampled imu;
  PoseMeasurement<double> pose;  // of an odometry, 20 Hz
  PositionMeasurement<double> position;
  WorldVelocityMeasurement<double> velocity;
  HeadingMeasurement<double> heading;  // and of GPS with a compass, 10 Hz
};

struct Lie {
  const char* name;
  std::function<void(Words&)> tell;
};

/// Seconds of 12 in which the estimate is good, and those of them in which it is wrong.
struct Outcome {
  double good = 0.0, wrong = 0.0;
};

Outcome fly(bool gps, const Lie& lie) {
  constexpr double period = 0.01, noise = 0.02;
  const test_support::Flight flight(1);
  EkfSettings s;
  test_support::NoisyImu imu(flight, s.imu_noise, period, 2);
  test_support::Random random(3);
  Ekfd ekf(s);
  Outcome o;
  for (int i = 0; i <= 1200; ++i) {
    const double t = period * i;
    const InertialStated x = flight.state(t);
    const auto blurred = [&random](const Vector3d& v) {
      return Vector3d(v + test_support::normal_vector(random, noise));
    };
    const Matrix3d covariance = noise * noise * Matrix3d::Identity();
    Words w;
    w.imu = imu(t);
    w.pose.position = blurred(x.position);
    w.pose.orientation = x.orientation * quaternion_exp(blurred(Vector3d::Zero()));
    w.pose.covariance.setIdentity();
    w.pose.covariance *= noise * noise;
    w.position = {blurred(x.position), covariance, Vector3d::Zero()};
    w.velocity = {blurred(x.velocity), covariance, Vector3d::Zero()};
    w.heading = {yaw_of(x.orientation) + random.normal(noise), noise};
    lie.tell(w);
    (void)ekf.on_imu(t, w.imu);
    if (i == 0)
      (void)ekf.start({x.position, x.velocity, x.orientation, Vector3d::Zero()}, {0.1, 0.1, 0.1});
    if (gps && i % 10 == 5) {
      (void)ekf.on_measurement(t, w.position);
      (void)ekf.on_measurement(t, w.velocity);
      (void)ekf.on_measurement(t, w.heading);
    } else if (!gps && i % 5 == 2) {
      (void)ekf.on_measurement(t, w.pose);
    }
    if (t < 2.0 || ekf.trust(t).state != EstimateState::good) continue;
    const BodyStated y = ekf.state();
    o.good += period;
    if (!((y.position - x.position).norm() < 0.3 &&
          y.orientation.angularDistance(x.orientation) < 0.2))
      o.wrong += period;
  }
  return o;
}

const auto turned = [](const Quaterniond& q) {
  return [q](Words& w) {
    w.pose.position = q * w.pose.position;
    w.pose.orientation = q * w.pose.orientation;
    w.position.position = q * w.position.position;
    w.velocity.velocity = q * w.velocity.velocity;
  };
};
const auto scaled = [](double unit) {
  return [unit](Words& w) {
    w.pose.position *= unit;
    w.position.position *= unit;
    w.velocity.velocity *= unit;
  };
};
const auto unsure = [](const std::function<void(Matrix3d&)>& change) {
  return [change](Words& w) {
    change(w.position.covariance);
    change(w.velocity.covariance);
    Matrix3d part = w.pose.covariance.topLeftCorner<3, 3>();
    change(part);
    w.pose.covariance.topLeftCorner<3, 3>() = part;
  };
};

TEST(EkfDoors, NoLieOfASensorIsGoodAndWrong) {
  const double half = std::sqrt(0.5);
  const std::vector<Lie> lies = {
      {"in g", [](Words& w) { w.imu.specific_force /= gravity; }},
      {"in ft/s^2", [](Words& w) { w.imu.specific_force /= 0.3048; }},
      {"force reversed", [](Words& w) { w.imu.specific_force *= -1.0; }},
      {"without gravity", [](Words& w) { w.imu.specific_force.z() -= gravity; }},
      {"degrees per second", [](Words& w) { w.imu.angular_velocity /= degree; }},
      {"rate reversed", [](Words& w) { w.imu.angular_velocity *= -1.0; }},
      {"sensors exchanged", [](Words& w) { w.imu.angular_velocity.swap(w.imu.specific_force); }},
      {"x and z", [](Words& w) { std::swap(w.imu.specific_force.x(), w.imu.specific_force.z()); }},
      {"NaN", [](Words& w) { w.imu.specific_force.y() = nan; }},
      {"in mm", scaled(1e3)},
      {"in cm", scaled(1e2)},
      {"in feet", scaled(1.0 / 0.3048)},
      {"in km", scaled(1e-3)},
      {"NED", turned(Quaterniond(0.0, half, half, 0.0))},
      {"z down", turned(Quaterniond(0.0, 1.0, 0.0, 0.0))},
      {"y up", turned(Quaterniond(half, -half, 0.0, 0.0))},
      {"z y x w", [](Words& w) { w.pose.orientation.coeffs().reverseInPlace(); }},
      {"conjugate", [](Words& w) { w.pose.orientation.coeffs().head<3>() *= -1.0; }},
      {"no rotation", [](Words& w) { w.pose.orientation.coeffs().setZero(); }},
      {"velocity of NED", [](Words& w) { w.velocity.velocity.z() *= -1.0; }},
      {"velocity in km/h", [](Words& w) { w.velocity.velocity *= 3.6; }},
      {"heading in degrees", [](Words& w) { w.heading.heading /= degree; }},
      {"heading from north", [](Words& w) { w.heading.heading = pi / 2 - w.heading.heading; }},
      {"heading reversed", [](Words& w) { w.heading.heading *= -1.0; }},
      {"heading off", [](Words& w) { w.heading.heading += pi; }},
      {"heading NaN", [](Words& w) { w.heading.heading = nan; }},
      {"heading certain", [](Words& w) { w.heading.stddev = 0.0; }},
      {"covariance 0", unsure([](Matrix3d& p) { p.setZero(); })},
      {"negative", unsure([](Matrix3d& p) { p *= -1.0; })},
      {"-1 for unknown", unsure([](Matrix3d& p) { p(0, 0) = -1.0; })},
      {"indefinite", unsure([](Matrix3d& p) { p(0, 1) = p(1, 0) = 2.0 * p(0, 0); })},
      {"covariance NaN", unsure([](Matrix3d& p) { p(1, 1) = nan; })},
      {"huge", unsure([](Matrix3d& p) { p *= 1e20; })},
      {"variances in mm^2", unsure([](Matrix3d& p) { p *= 1e6; })},
      {"variances in km^2", unsure([](Matrix3d& p) { p *= 1e-6; })}};
  for (const bool gps : {false, true}) {
    EXPECT_GT(fly(gps, {"right", [](Words&) {}}).good, 9.9);
    for (const Lie& lie : lies)
      EXPECT_LT(fly(gps, lie).wrong, 0.3) << lie.name << (gps ? ", GPS" : ", odometry");
  }
}

}  // namespace ekf_doors_test
}  // namespace tilt_ropter
