// Invalid and missing samples, trust in the estimate, and settings out of range.

#include <tilt_ropter/estimation/wrench_observer.hpp>

#include "support/random.hpp"
#include "support/wrench_feed.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

namespace tilt_ropter {
namespace wrench_observer_faults_test {

using Eigen::Vector3d;
using test_support::body;
using test_support::distance;
using test_support::Feed;
using test_support::pushed;
using test_support::Random;

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double nan = std::numeric_limits<double>::quiet_NaN();

TEST(WrenchObserver, RejectsInvalidSamplesWithoutChange) {
  WrenchObserverd observer(body());
  const Eigen::Vector3d a(1.0, 0.0, 9.0), w(0.1, 0.0, 0.0);
  (void)observer.update(0.0, {w, a}, {});
  (void)observer.update(0.1, {w, a}, {});
  const Wrenchd before = observer.external();
  const Eigen::Vector3d bad(0.0, nan, 0.0), huge = Eigen::Vector3d::Constant(1e300);
  EXPECT_EQ(observer.update(nan, {w, a}, {}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(infinity, {w, a}, {}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.1, {w, a}, {}).status,
            ObserverStatus::rejected);  // time did not advance
  EXPECT_EQ(observer.update(0.05, {w, a}, {}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, {w, bad}, {}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, {bad, a}, {}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, {huge, a}, {}).status, ObserverStatus::rejected);  // overflows
  EXPECT_EQ(observer.update(0.2, {w, a}, {bad, w}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.external().force, before.force);
  EXPECT_EQ(observer.external().torque, before.torque);
  EXPECT_EQ(observer.update(0.2, {w, a}, {}).status, ObserverStatus::updated);
}

TEST(WrenchObserver, KeepsEstimateOverAGap) {
  WrenchObserverd observer(body());
  Feed feed(observer);
  feed(pushed, 300);
  const Wrenchd before = observer.filtered();
  EXPECT_LT(distance(before, pushed), 1e-5);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  // During the gap another wrench acted. Neither its force nor its momentum may affect the
  // estimate.
  EXPECT_EQ(feed({Vector3d(50, 0, 0), Vector3d(3, 0, 0)}, 0.11), ObserverStatus::gap);
  EXPECT_EQ(distance(observer.filtered(), before), 0.0);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  EXPECT_EQ(feed(pushed), ObserverStatus::updated);
  EXPECT_LT(distance(observer.filtered(), pushed), 1e-5);

  WrenchObserverSettings patient;
  patient.max_gap = 0.12;
  WrenchObserverd other(body(), patient);
  Feed feed_other(other);
  feed_other(pushed, 2);
  EXPECT_EQ(feed_other(pushed, 0.11), ObserverStatus::updated);
}

// The default max_gap is the period of a loop of 10 Hz, whose stamps have rounding errors.
TEST(WrenchObserver, IsTrustedAtTenHertz) {
  WrenchObserverd observer(body());
  for (int i = 0; i < 100; ++i) {
    const ObserverStatus status =
        observer.update(1e4 + 0.1 * i, {Vector3d::Zero(), Vector3d(0.0, 0.0, 9.81)}, {}).status;
    EXPECT_EQ(status, i == 0 ? ObserverStatus::started : ObserverStatus::updated);
  }
  EXPECT_EQ(observer.trust(1e4 + 10.0), WrenchTrust::trusted);
}

TEST(WrenchObserver, RecoversFromClockThatJumpsBack) {
  WrenchObserverd observer(body());
  const Vector3d a(1.0, 0.0, 0.0), w = Vector3d::Zero();
  (void)observer.update(100.0, {w, a}, {});
  (void)observer.update(100.01, {w, a}, {});
  const Wrenchd before = observer.external();
  EXPECT_EQ(observer.update(99.95, {w, a}, {}).status, ObserverStatus::rejected);  // late
  EXPECT_EQ(observer.update(5.0, {w, a}, {}).status, ObserverStatus::gap);
  EXPECT_EQ(distance(observer.external(), before), 0.0);
  EXPECT_EQ(observer.update(5.01, {w, a}, {}).status, ObserverStatus::updated);
}

TEST(WrenchObserver, ReportsTrust) {
  WrenchObserverSettings settings;
  settings.force_bandwidth << 10.0, 6.0, 10.0;
  settings.torque_bandwidth << 7.0, 8.0, 9.0;
  settings.force_limit.y() = 2.0;
  settings.torque_limit.x() = 0.3;
  WrenchObserverd observer(body(), settings);
  EXPECT_EQ(observer.trust(0.0), WrenchTrust::not_started);
  Feed feed(observer);
  // 3 / K of the slowest axis is 0.5 s.
  feed(pushed, 50);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  EXPECT_GT(std::abs(observer.filtered().force.y() + 1.0), 0.04);
  feed(pushed, 2);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  EXPECT_LT(std::abs(observer.filtered().force.y() + 1.0), 0.05);

  EXPECT_EQ(observer.trust(feed.time() + 0.09), WrenchTrust::trusted);
  EXPECT_EQ(observer.trust(feed.time() + 0.11), WrenchTrust::stale);
  EXPECT_EQ(observer.trust(feed.time() - 0.11), WrenchTrust::stale);
  EXPECT_EQ(observer.trust(nan), WrenchTrust::stale);
  EXPECT_EQ(observer.update(feed.time() + 0.2, {Vector3d::Zero(), Vector3d(nan, 0, 0)}, {}).status,
            ObserverStatus::rejected);
  EXPECT_EQ(observer.trust(feed.time() + 0.2), WrenchTrust::stale);

  Wrenchd more = pushed;
  more.force.y() = -2.5;
  feed(more, 100);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::limited);
  feed(pushed, 100);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  more = pushed;
  more.torque.x() = 0.35;
  feed(more, 100);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::limited);
  feed(pushed, 100);

  observer.reset();
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::not_started);
  feed(pushed);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  feed(pushed, 60);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  observer.set_offset(pushed);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  feed(pushed, 60);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
  observer.reset();
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::not_started);
  EXPECT_EQ(distance(observer.external(), {}), 0.0);
  EXPECT_EQ(distance(observer.filtered(), {}), 0.0);
}

TEST(WrenchObserver, SettlingTimeIncludesSlowestTorqueAxis) {
  WrenchObserverSettings settings;
  settings.torque_bandwidth.z() = 2.0;
  WrenchObserverd observer(body(), settings);
  Feed feed(observer);
  feed(pushed, 150);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::settling);
  feed(pushed, 3);
  EXPECT_EQ(observer.trust(feed.time()), WrenchTrust::trusted);
}

TEST(WrenchObserver, RecoversFromAnyInput) {
  Random random(53);
  const auto pick = [&random](const std::array<double, 9>& values) {
    return values[static_cast<std::size_t>(random.uniform(0.0, 9.0))];
  };
  const double denormal = std::numeric_limits<double>::denorm_min();
  const std::array<double, 9> bad = {nan,   infinity, -infinity, 0.0, denormal,
                                     1e300, -1e300,   1.0,       1e6};
  // Most numbers are harmless, so that each argument is also invalid alone.
  const auto number = [&] { return random.uniform(0.0, 1.0) < 0.1 ? pick(bad) : 0.1; };
  const auto vector = [&] {
    const double x = number(), y = number();
    return Vector3d(x, y, number());
  };
  const auto wrench = [&] {
    const Vector3d force = vector();
    return Wrenchd{force, vector()};
  };
  WrenchObserverSettings settings;
  settings.force_limit.setConstant(20.0);
  settings.torque_limit.setConstant(2.0);
  WrenchObserverd observer(body(), settings);
  std::array<int, 4> statuses{};
  std::array<int, 12> calibrations{};
  const Vector3d none = Vector3d::Zero();
  double good_time = 1000.0;
  const auto expect_finite = [&] {
    ASSERT_TRUE(is_finite(observer.filtered()) && is_finite(observer.offset()));
    ASSERT_LE(observer.external().force.cwiseAbs().maxCoeff(), 20.0);
    ASSERT_LE(observer.external().torque.cwiseAbs().maxCoeff(), 2.0);
  };
  for (int i = 0; i < 1000000; ++i) {
    const std::array<double, 9> times = {
        nan,       infinity,        -infinity, 0.0, denormal, 1e300, good_time - 0.01,
        good_time, good_time + 10.0};
    const double time = pick(times);
    const Vector3d a = vector(), w = vector();
    const Wrenchd applied = wrench();
    const Wrenchd before = observer.filtered(), shown = observer.external();
    const ObserverStatus status = observer.update(time, {w, a}, applied).status;
    ++statuses[static_cast<std::size_t>(status)];
    if (status != ObserverStatus::updated) {
      ASSERT_EQ(distance(observer.filtered(), before), 0.0);
      ASSERT_EQ(distance(observer.external(), shown), 0.0);
    }
    if (!std::isfinite(time) || !all_finite(a) || !all_finite(w) || !is_finite(applied)) {
      ASSERT_EQ(status, ObserverStatus::rejected);
    }
    ASSERT_NO_FATAL_FAILURE(expect_finite());
    if (i % 11 == 0) observer.set_offset(wrench());
    if (i % 13 == 0) observer.begin_calibration();
    if (i % 17 == 0) ++calibrations[static_cast<std::size_t>(observer.end_calibration(wrench()))];
    ASSERT_NO_FATAL_FAILURE(expect_finite());
    if (!std::isfinite(time)) {
      ASSERT_NE(observer.trust(time), WrenchTrust::trusted);
    }
    if (i % 100 != 99) continue;
    // The next valid samples are processed correctly.
    observer.set_offset({});
    observer.reset();
    good_time += 0.01;
    ASSERT_NE(observer.update(good_time, {none, none}, {}).status, ObserverStatus::rejected);
    for (int k = 0; k < 3; ++k) {
      good_time += 0.01;
      ASSERT_EQ(observer.update(good_time, {none, Vector3d::UnitX()}, {}).status,
                ObserverStatus::updated);
    }
    ASSERT_NEAR(observer.external().force.x(), body().mass * -std::expm1(-0.45), 1e-9);
    ASSERT_EQ(observer.external().torque.norm(), 0.0);
  }
  EXPECT_GT(statuses[static_cast<std::size_t>(ObserverStatus::updated)], 0);
  EXPECT_EQ(statuses[static_cast<std::size_t>(ObserverStatus::started)], 1);
  EXPECT_GT(statuses[static_cast<std::size_t>(ObserverStatus::gap)], 0);
  EXPECT_GT(statuses[static_cast<std::size_t>(ObserverStatus::rejected)], 0);
  EXPECT_GT(calibrations[static_cast<std::size_t>(CalibrationStatus::too_short)], 0);
}

TEST(WrenchObserver, RejectsFiniteButAbsurdNumbers) {
  WrenchObserverd observer(body());
  const Vector3d none = Vector3d::Zero(), huge(0.0, 1e100, 0.0);
  EXPECT_EQ(observer.update(0.0, {huge, none}, {}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.0, {none, none}, {}).status, ObserverStatus::started);
  EXPECT_EQ(observer.update(0.01, {none, huge}, {}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.01, {none, none}, {huge, none}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.01, {none, none}, {none, huge}).status, ObserverStatus::rejected);
  // A time step of almost zero.
  EXPECT_EQ(observer.update(1e-300, {Vector3d::Ones(), none}, {}).status, ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.01, {none, none}, {}).status, ObserverStatus::updated);
  EXPECT_EQ(distance(observer.external(), {}), 0.0);
}

}  // namespace wrench_observer_faults_test
}  // namespace tilt_ropter
