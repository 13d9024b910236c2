#include <tilt_ropter/planning/transition.hpp>

#include <gtest/gtest.h>
#include <unsupported/Eigen/AutoDiff>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

namespace transition_test {

using namespace tilt_ropter;

constexpr double pi_ = 3.14159265358979323846;

std::vector<TransitionSettings> cases() {
  std::mt19937 generator(3);
  const auto uniform = [&generator](double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(generator);
  };
  std::vector<TransitionSettings> all;
  for (int i = 0; i < 50; ++i) {
    TransitionSettings p;
    for (Waypoint* w : {&p.from, &p.to}) {
      w->position << uniform(-5, 5), uniform(-5, 5), uniform(0, 5);
      w->yaw = uniform(-10, 10);
    }
    p.max_speed = uniform(0.1, 3);
    p.max_acceleration = uniform(0.1, 3);
    p.max_yaw_rate = uniform(0.1, 3);
    p.max_yaw_acceleration = uniform(0.1, 3);
    all.push_back(p);
  }
  TransitionSettings turn;  // only the heading, across the branch cut of atan2
  turn.from.yaw = 3.0;
  turn.to.yaw = -3.0;
  all.push_back(turn);
  TransitionSettings shift;  // only the position
  shift.to.position << 0.0, 1e-3, 0.0;
  all.push_back(shift);
  all.push_back(TransitionSettings{});  // no change
  return all;
}

std::string message_of(const TransitionSettings& p) {
  try {
    Transition transition(p);
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return "accepted";
}

TEST(Transition, MovesFromRestToRestAndHolds) {
  const double infinity = std::numeric_limits<double>::infinity();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (const TransitionSettings& p : cases()) {
    const Transition transition(p);
    const double start = transition.start_time(), end = transition.end_time();
    const auto expect_rest = [](const ReferencePoint& r, const Waypoint& at) {
      EXPECT_LT((r.position - at.position).norm(), 1e-12);
      EXPECT_LT(r.orientation.angularDistance(quaternion_from_yaw(at.yaw)), 1e-7);
      EXPECT_EQ(r.velocity.norm() + r.acceleration.norm(), 0.0);
      EXPECT_EQ(r.angular_velocity.norm() + r.angular_acceleration.norm(), 0.0);
    };
    for (const double time : {start, start - 1.0, -infinity, nan})
      expect_rest(transition(time), p.from);
    for (const double time : {end + 1e-9, end + 1.0, infinity}) expect_rest(transition(time), p.to);
  }
}

TEST(Transition, KeepsAllLimitsAndReachesTheTightest) {
  for (const TransitionSettings& p : cases()) {
    const Transition transition(p);
    double speed = 0.0, acceleration = 0.0, yaw_rate = 0.0, yaw_acceleration = 0.0;
    for (int i = 0; i <= 10000; ++i) {
      const ReferencePoint r =
          transition(transition.start_time() + transition.duration() * i / 10000);
      speed = std::max(speed, r.velocity.norm() / p.max_speed);
      acceleration = std::max(acceleration, r.acceleration.norm() / p.max_acceleration);
      yaw_rate = std::max(yaw_rate, std::abs(r.angular_velocity.z()) / p.max_yaw_rate);
      yaw_acceleration =
          std::max(yaw_acceleration, std::abs(r.angular_acceleration.z()) / p.max_yaw_acceleration);
    }
    const double tightest = std::max({speed, acceleration, yaw_rate, yaw_acceleration});
    EXPECT_LE(tightest, 1.0 + 1e-9);
    if (transition.duration() > 1e-3) {
      EXPECT_GT(tightest, 0.999);
    }
  }
}

TEST(Transition, RatesMatchFiniteDifferences) {
  for (const TransitionSettings& p : cases()) {
    const Transition transition(p);
    const double h = 1e-4 * transition.duration();
    const double size = 1.0 + (p.to.position - p.from.position).norm();
    const double rate = size / transition.duration();
    for (int i = -10; i <= 510; ++i) {
      const double time = transition.start_time() + transition.duration() * (i + 0.3) / 500;
      const ReferencePoint r = transition(time), before = transition(time - h),
                           after = transition(time + h);
      ASSERT_LT((r.velocity - (after.position - before.position) / (2 * h)).norm(), 1e-6 * rate);
      ASSERT_LT((r.acceleration - (after.velocity - before.velocity) / (2 * h)).norm(),
                1e-5 * rate / transition.duration());
      const Eigen::Quaterniond turn = before.orientation.conjugate() * after.orientation;
      ASSERT_LT((r.angular_velocity - quaternion_log(turn) / (2 * h)).norm(), 1e-5 * rate);
      ASSERT_LT(
          (r.angular_acceleration - (after.angular_velocity - before.angular_velocity) / (2 * h))
              .norm(),
          1e-4 * rate / transition.duration());
    }
  }
}

TEST(Transition, RatesMatchAutomaticDifferentiation) {
  using First = Eigen::AutoDiffScalar<Eigen::Matrix<double, 1, 1>>;
  TransitionSettings p;
  p.from.position << 1.0, 2.0, 3.0;
  p.to.position << -1.0, 2.5, 1.0;
  p.to.yaw = 1.0;
  const Transition transition(p);
  const double duration = transition.duration();
  for (int i = 0; i <= 100; ++i) {
    // s in Bernstein form: the last four of the eight polynomials of degree 7.
    const First x(i / 100.0, Eigen::Matrix<double, 1, 1>(1.0 / duration));
    const First y = 1.0 - x;
    const First s =
        x * x * x * x * (35.0 * y * y * y + 21.0 * x * y * y + 7.0 * x * x * y + x * x * x);
    const ReferencePoint r = transition(duration * i / 100.0);
    const Eigen::Vector3d way = p.to.position - p.from.position;
    EXPECT_LT((r.position - p.from.position - s.value() * way).norm(), 1e-12);
    EXPECT_LT((r.velocity - s.derivatives()(0) * way).norm(), 1e-12);
    EXPECT_NEAR(r.angular_velocity.z(), s.derivatives()(0) * p.to.yaw, 1e-12);
    EXPECT_NEAR(yaw_of(r.orientation), s.value() * p.to.yaw, 1e-12);
  }
}

TEST(Transition, JerkIsZeroAndContinuousAtTheEnds) {
  TransitionSettings p;
  p.to.position << 1.0, 0.0, 0.0;
  const Transition transition(p);
  const double h = 1e-3;
  Eigen::Vector3d last = Eigen::Vector3d::Zero();
  for (double time = -0.1; time < transition.duration() + 0.1; time += h) {
    const Eigen::Vector3d jerk =
        (transition(time + h).acceleration - transition(time).acceleration) / h;
    ASSERT_LT((jerk - last).norm(), 20.0 * h) << time;
    last = jerk;
  }
  EXPECT_LT(last.norm(), 1e-12);
}

TEST(Transition, YawTakesShorterWayContinuously) {
  for (const double from : {-7.0, -pi_, -0.1, 0.0, 3.0, pi_, 100.0})
    for (const double by : {-3.1, -1.0, -1e-8, 0.0, 1e-8, 1.0, 3.1}) {
      TransitionSettings p;
      p.from.yaw = from;
      p.to.yaw = from + by + 2.0 * pi_ * 3.0;
      const Transition transition(p);
      double turned = 0.0;
      Eigen::Quaterniond last = transition(0.0).orientation;
      for (int i = 1; i <= 1000; ++i) {
        const Eigen::Quaterniond q = transition(transition.duration() * i / 1000).orientation;
        ASSERT_GT(q.dot(last), 0.99);
        turned += quaternion_log(Eigen::Quaterniond(last.conjugate() * q)).z();
        last = q;
      }
      EXPECT_NEAR(turned, by, 1e-9) << from;
    }
}

TEST(Transition, UsesGivenDurationOrReportsMinimum) {
  TransitionSettings p;
  p.to.position.x() = 1.0;  // at most 1 m/s, 1 m/s^2: sqrt(84 / (5 sqrt 5)) s = 2.741 s
  EXPECT_NEAR(Transition(p).duration(), 2.7410, 1e-4);
  p.duration = 5.0;
  EXPECT_DOUBLE_EQ(Transition(p).duration(), 5.0);
  EXPECT_LT((Transition(p)(2.5).position - Eigen::Vector3d(0.5, 0.0, 0.0)).norm(), 1e-12);
  p.duration = 2.0;
  EXPECT_EQ(message_of(p),
            "TransitionSettings.duration [s] = 2: must be 0 or >= 2.741020, which the limits "
            "need");
}

TEST(Transition, TakeOffRisesStraightUp) {
  const Waypoint from{{1.0, 2.0, 0.11}, 0.7};
  const Transition up = take_off(from, 1.5);
  double last = 0.11, fastest = 0.0;
  for (double time = 0.0; time < up.duration(); time += 0.01) {
    const ReferencePoint r = up(time);
    ASSERT_EQ(r.position.x(), 1.0);
    ASSERT_EQ(r.position.y(), 2.0);
    ASSERT_GE(r.position.z(), last);
    ASSERT_NEAR(yaw_of(r.orientation), 0.7, 1e-12);
    last = r.position.z();
    fastest = std::max(fastest, r.velocity.z());
  }
  EXPECT_NEAR(fastest, 0.8, 1e-3);
  EXPECT_NEAR(up(up.end_time()).position.z(), 1.5, 1e-12);
  EXPECT_GT(take_off(from, 1.5, 0.4).duration(), 1.9 * up.duration());
  EXPECT_GT(take_off(from, 1.5, 0.8, 0.1).duration(), 1.9 * up.duration());
}

TEST(Transition, LandingIsGentleNearTheGround) {
  const Waypoint from{{1.0, 2.0, 1.5}, 0.7};
  const Transition down = landing(from, 0.11);
  double fastest = 0.0;
  for (double time = 0.0; time < down.end_time() + 1.0; time += 0.001) {
    const ReferencePoint r = down(time);
    ASSERT_LE(r.velocity.z(), 0.0);
    fastest = std::max(fastest, -r.velocity.z());
    if (r.position.z() < 0.11 + 0.05) {
      ASSERT_LT(-r.velocity.z(), 0.14);
    }
    if (r.position.z() < 0.11 + 0.01) {
      ASSERT_LT(-r.velocity.z(), 0.05);
    }
    ASSERT_GE(r.position.z(), 0.11 - 1e-12);
  }
  EXPECT_NEAR(fastest, 0.5, 1e-3);
  EXPECT_NEAR(down(down.end_time()).position.z(), 0.11, 1e-12);
  EXPECT_GT(landing(from, 0.11, 0.25).duration(), 1.9 * down.duration());
  EXPECT_GT(landing(from, 0.11, 0.5, 0.05).duration(), 1.9 * down.duration());
}

TEST(Transition, SetStartTimeShiftsTheWholeReference) {
  TransitionSettings p;
  p.to.position.x() = 1.0;
  Transition transition(p);
  const ReferencePoint before = transition(1.0);
  transition.set_start_time(-4.0);
  EXPECT_LT((transition(-3.0).position - before.position).norm(), 1e-12);
  EXPECT_DOUBLE_EQ(transition.end_time(), -4.0 + transition.duration());
  EXPECT_DOUBLE_EQ(transition.start_time(), -4.0);
  EXPECT_THROW(transition.set_start_time(std::numeric_limits<double>::infinity()),
               std::invalid_argument);
}

}  // namespace transition_test
