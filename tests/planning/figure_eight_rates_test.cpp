// Rates of the reference against automatic differentiation of an independent model.

#include <tilt_ropter/planning/figure_eight.hpp>

#include "support/figure_eights.hpp"

#include <gtest/gtest.h>
#include <unsupported/Eigen/AutoDiff>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <random>

namespace figure_eight_rates_test {

using namespace tilt_ropter;
using test_support::cases;
using test_support::ground_parameters;

constexpr double two_pi = 6.28318530717958647692;

/// Independent model of the figure eight for any Scalar. It uses the integral of the ramp's rate,
/// rotation matrices, and the angle of the tangent from its components.
template <typename Scalar>
struct Model {
  const FigureEightSettings& p;
  double duration;

  Scalar phase(const Scalar& t) const {
    const double rate = two_pi * (p.laps + 2.0 * p.ramp_laps) / duration;
    const double ramp = 2.0 * two_pi * p.ramp_laps / rate;
    const auto ramp_phase = [&](const Scalar& x) {
      return Scalar((rate * ramp) *
                    (x * x * x * x * x * x - 3.0 * x * x * x * x * x + 2.5 * x * x * x * x));
    };
    if (t < ramp) return ramp_phase(Scalar(t / ramp));
    if (t > duration - ramp)
      return Scalar(two_pi * p.laps - ramp_phase(Scalar((duration - t) / ramp)));
    return Scalar((t - 0.5 * ramp) * rate);
  }

  Eigen::Matrix<Scalar, 3, 1> position(const Scalar& time) const {
    using std::sin;
    const Scalar s = phase(time);
    const Scalar x = p.amplitude.x() * sin(s), y = p.amplitude.y() * sin(Scalar(2.0 * s));
    return {Scalar(p.center.x() + std::cos(p.direction) * x - std::sin(p.direction) * y),
            Scalar(p.center.y() + std::sin(p.direction) * x + std::cos(p.direction) * y),
            Scalar(p.center.z() + p.amplitude.z() * sin(s))};
  }

  Scalar yaw(const Scalar& time) const {
    using std::atan2;
    using std::cos;
    const Scalar s = phase(time);
    return p.direction + atan2(Scalar(2.0 * p.amplitude.y() * cos(Scalar(2.0 * s))),
                               Scalar(p.amplitude.x() * cos(s)));
  }
};

using First = Eigen::AutoDiffScalar<Eigen::Matrix<double, 1, 1>>;
using Second = Eigen::AutoDiffScalar<Eigen::Matrix<First, 1, 1>>;

Second seed(double time) {
  Second t;
  t.value() = First(time, 1, 0);
  t.derivatives()(0) = First(1.0);
  return t;
}

double value(const Second& s) {
  return s.value().value();
}
double first(const Second& s) {
  return s.derivatives()(0).value();
}
double second(const Second& s) {
  const auto& d = s.derivatives()(0).derivatives();
  return d(0);
}

TEST(FigureEight, RatesMatchAutomaticDifferentiation) {
  std::mt19937 generator(2);
  for (const FigureEightSettings& p : cases()) {
    const FigureEight eight(p);
    const Model<Second> model{p, eight.duration()};
    std::uniform_real_distribution<double> any_time(eight.start_time(), eight.end_time());
    for (int i = 0; i < 200; ++i) {
      const double time = any_time(generator);
      const ReferencePoint r = eight(time);
      const auto position = model.position(seed(time));
      for (int k = 0; k < 3; ++k) {
        ASSERT_NEAR(r.position(k), value(position(k)), 1e-11);
        ASSERT_NEAR(r.velocity(k), first(position(k)), 1e-11);
        ASSERT_NEAR(r.acceleration(k), second(position(k)), 1e-10);
      }
      if (p.heading == HeadingMode::fixed) {
        ASSERT_LT(r.orientation.angularDistance(quaternion_from_yaw(p.yaw)), 1e-12);
        ASSERT_EQ(r.angular_velocity.norm() + r.angular_acceleration.norm(), 0.0);
      } else {
        const Second yaw = model.yaw(seed(time));
        ASSERT_LT(r.orientation.angularDistance(quaternion_from_yaw(value(yaw))), 1e-10);
        ASSERT_NEAR(r.angular_velocity.z(), first(yaw), 1e-9);
        ASSERT_NEAR(r.angular_acceleration.z(), second(yaw), 1e-8);
        ASSERT_EQ(r.angular_velocity.head<2>().norm(), 0.0);
        ASSERT_EQ(r.angular_acceleration.head<2>().norm(), 0.0);
      }
    }
  }
}

TEST(FigureEight, RatesMatchFiniteDifferences) {
  const double h = 1e-5;
  for (const FigureEightSettings& p : {FigureEightSettings{}, ground_parameters()}) {
    const FigureEight eight(p);
    for (double time = -0.5; time < eight.duration() + 0.5; time += 0.0317) {
      const ReferencePoint r = eight(time), before = eight(time - h), after = eight(time + h);
      ASSERT_LT((r.velocity - (after.position - before.position) / (2 * h)).norm(), 1e-8);
      ASSERT_LT((r.acceleration - (after.velocity - before.velocity) / (2 * h)).norm(), 1e-8);
      const Eigen::Quaterniond turn = before.orientation.conjugate() * after.orientation;
      ASSERT_LT((r.angular_velocity - quaternion_log(turn) / (2 * h)).norm(), 1e-8);
      ASSERT_LT(
          (r.angular_acceleration - (after.angular_velocity - before.angular_velocity) / (2 * h))
              .norm(),
          1e-8);
    }
  }
}

TEST(FigureEight, JerkIsContinuousAlsoAtRampEnds) {
  for (const FigureEightSettings& p : {FigureEightSettings{}, ground_parameters()}) {
    const FigureEight eight(p);
    const double h = 1e-3;
    Eigen::Vector3d last_jerk = Eigen::Vector3d::Zero();
    Eigen::Quaterniond last_orientation = eight(0.0).orientation;
    for (double time = -0.1; time < eight.duration() + 0.1; time += h) {
      const Eigen::Vector3d jerk = (eight(time + h).acceleration - eight(time).acceleration) / h;
      ASSERT_LT(jerk.norm(), 8.0);                             // bounded [m/s^3]
      ASSERT_LT((jerk - last_jerk).norm(), 40.0 * h) << time;  // a jump would not shrink with h
      last_jerk = jerk;
      const Eigen::Quaterniond orientation = eight(time).orientation;
      ASSERT_GT(orientation.dot(last_orientation), 0.99) << "the quaternion changed its sign";
      last_orientation = orientation;
    }
  }
}

}  // namespace figure_eight_rates_test
