// Missing poses, outliers, restarts and arbitrary input.
// CTest: optimised

#include <tilt_ropter/estimation/detail/ekf_start.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include "support/check_table.hpp"
#include "support/ekf_flights.hpp"
#include "support/flights.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numeric>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace ekf_faults_test {

using test_support::Errors;
using test_support::errors;
using test_support::expect_good;
using test_support::Flight;
using test_support::fly;
using test_support::full_run;
using test_support::gone_wrong;
using test_support::imu_period;
using test_support::Log;
using test_support::noisy;
using test_support::Random;
using test_support::record;
using test_support::Unobserved;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinite = std::numeric_limits<double>::infinity();

TEST(Ekf, BridgesTwoSecondsWithoutPoses) {
  Random random(203);
  double at_end = 0.0, recovery = 0.0;
  for (unsigned run = 0; run < 10; ++run) {
    const Flight flight(run, random.orientation());
    Log log = record(flight, 20.0, run, {}, random.vector(0.05), random.vector(0.3));
    log.poses.erase(std::remove_if(log.poses.begin(), log.poses.end(),
                                   [](const auto& p) { return p.time > 14.0 && p.time < 16.0; }),
                    log.poses.end());
    Ekfd ekf;
    fly(ekf, log, 0.0, Unobserved(), [&] {
      const Errors e = errors(ekf, flight);
      EXPECT_TRUE(std::isfinite(e.position));
      if (ekf.time() > 15.99 && ekf.time() < 15.999) at_end = std::max(at_end, e.position);
      if (ekf.time() > 16.0 && e.position > 0.01) recovery = std::max(recovery, ekf.time() - 16.0);
    });
    EXPECT_EQ(ekf.counts().restarts, 0);
    EXPECT_LE(ekf.counts().gated, 1);  // the gate rejects one valid pose in 10^4
    expect_good(ekf, flight);
  }
  test_support::check_at_most(10, "EKF: error after 2 s without poses [m]", at_end, 0.15);
  EXPECT_LT(recovery, 0.05);
  RecordProperty("error_at_end", std::to_string(at_end));
  RecordProperty("recovery", std::to_string(recovery));
}

// Motion capture is off for minutes, and the IMU keeps running.
template <typename Scalar>
void expect_return_after(double minutes, unsigned seed) {
  const Flight flight(seed, Random(204).orientation());
  const double away = 60.0 * minutes;
  Log log = record(flight, away + 15.0, seed, {}, {0.01, 0.02, -0.03}, {0.1, -0.2, 0.3});
  log.poses.erase(
      std::remove_if(log.poses.begin(), log.poses.end(),
                     [away](const auto& p) { return p.time > 5.0 && p.time < away + 5.0; }),
      log.poses.end());
  Ekf<Scalar> ekf;
  bool finite = true;
  fly(ekf, log, 0.0, Unobserved(),
      [&] { finite = finite && is_finite(ekf.state()) && all_finite(ekf.filter().covariance()); });
  EXPECT_TRUE(finite);
  const Errors e = errors(ekf, flight);
  EXPECT_LT(e.position, 0.005);
  EXPECT_LT(e.velocity, 0.05);
  EXPECT_LT(e.orientation, 0.01);
  const Eigen::Matrix<Scalar, 15, 15> p =
      ekf.filter().covariance().template topLeftCorner<15, 15>();
  EXPECT_EQ(p.llt().info(), Eigen::Success);
}

TEST(Ekf, RecoversAfterMinutesWithoutPoses) {
  for (const double minutes : {0.2, 1.0, 4.0, full_run() ? 60.0 : 10.0}) {
    SCOPED_TRACE(minutes);
    expect_return_after<double>(minutes, 7);
    expect_return_after<float>(minutes, 8);
  }
}

TEST(Ekf, GatesOutliersAndKeepsAccuracy) {
  Random random(205);
  double worst = 0.0;
  for (unsigned run = 0; run < 10; ++run) {
    const Flight flight(run, random.orientation());
    Log log = record(flight, 20.0, run, {}, random.vector(0.05), random.vector(0.3));
    std::vector<bool> wrong(log.poses.size(), false);
    for (std::size_t i = 10; i < log.poses.size(); ++i)
      if (random.uniform(0.0, 1.0) < 0.05) {
        wrong[i] = true;
        log.poses[i].value = gone_wrong(log.poses[i].value, random);
      }
    Ekfd ekf;
    long good_gated = 0;
    fly(
        ekf, log, 0.0,
        [&](std::size_t i, EkfStatus status) {
          if (wrong[i]) {
            EXPECT_EQ(status, EkfStatus::gated) << i;
          }
          if (!wrong[i] && status != EkfStatus::updated && i > 0) ++good_gated;
        },
        [&] {
          if (ekf.time() > 5.0) worst = std::max(worst, errors(ekf, flight).position);
        });
    EXPECT_LE(good_gated, 3);
    EXPECT_EQ(ekf.counts().restarts, 0);
    EXPECT_EQ(ekf.counts().gated, good_gated + std::count(wrong.begin(), wrong.end(), true));
    expect_good(ekf, flight);
  }
  test_support::check_at_most(10, "EKF: error with 5 % outliers [m]", worst, 0.01);
}

TEST(Ekf, RestartsIfVehicleWasMoved) {
  Random random(215);
  const Flight flight(11, random.orientation());
  Log log = record(flight, 20.0, 11);
  const Eigen::Vector3d away(3.0, -2.0, 1.0);
  const std::size_t moved = 900;
  for (std::size_t i = moved; i < log.poses.size(); ++i) log.poses[i].value.position += away;
  Ekfd ekf;
  std::vector<EkfStatus> statuses;
  fly(ekf, log, 0.0, [&](std::size_t, EkfStatus status) { statuses.push_back(status); });
  const std::size_t ignored = 100;  // restart_time
  for (std::size_t i = 0; i < ignored; ++i) EXPECT_EQ(statuses[moved + i], EkfStatus::gated) << i;
  EXPECT_EQ(statuses[moved + ignored], EkfStatus::restarted);
  EXPECT_EQ(statuses[moved + ignored + 1], EkfStatus::updated);
  EXPECT_EQ(ekf.counts().restarts, 1);
  EXPECT_EQ(ekf.counts().gated, 100);
  EXPECT_LT((ekf.state().position - away - flight.state(20.0).position).norm(), 0.005);
}

// An invalid or extreme number, or with probability 1/4 a number in [-1, 1].
double wild(Random& random) {
  switch (static_cast<int>(random.uniform(0.0, 12.0))) {
    case 0:
      return nan;
    case 1:
      return infinite;
    case 2:
      return -infinite;
    case 3:
      return 0.0;
    case 4:
      return 5e-324;
    case 5:
      return 1e300;
    case 6:
      return -1e300;
    case 7:
      return random.uniform(-1e6, 1e6);
    case 8:
      return random.uniform(-1e3, 1e3);
    default:
      return random.uniform(-1.0, 1.0);
  }
}

Eigen::Vector3d wild_vector(Random& random, const Eigen::Vector3d& usual) {
  if (random.uniform(0.0, 1.0) < 0.5) return usual;
  if (random.uniform(0.0, 1.0) < 0.3)
    return random.vector(random.uniform(0.0, 1.0) < 0.5 ? 1e3 : 1e5);
  const double x = wild(random), y = wild(random);
  return {x, y, wild(random)};
}

template <typename Scalar>
bool is_finite(const Ekf<Scalar>& ekf) {
  const InertialState<Scalar>& x = ekf.filter().state();
  return is_finite(ekf.state()) && std::isfinite(ekf.time()) && std::isfinite(ekf.filter_time()) &&
         std::isfinite(ekf.nis()) && all_finite(ekf.filter().covariance()) &&
         all_finite(x.position) && all_finite(x.velocity) && all_finite(x.orientation.coeffs()) &&
         all_finite(x.gyro_bias) && all_finite(x.accelerometer_bias) &&
         all_finite(x.marker_position) && all_finite(x.marker_orientation.coeffs()) &&
         std::abs(static_cast<double>(ekf.state().orientation.norm()) - 1.0) < 1e-3;
}

// Random calls, then a normal flight. Checks the errors of the estimate at its end.
template <typename Scalar>
void expect_survival(unsigned seed, int calls, const EkfSettings& settings) {
  Random random(seed);
  const Flight flight(seed, random.orientation(), settings.marker_position,
                      settings.marker_orientation);
  Ekf<Scalar> ekf(settings);
  double t = 0.0;
  const auto imu = [&](double time, const InertialSampled& s) {
    return ekf.on_imu(time, {s.angular_velocity.cast<Scalar>(), s.specific_force.cast<Scalar>()});
  };
  const auto pose = [&](double time, const MarkerPosed& p) {
    return ekf.on_pose(time, {p.position.cast<Scalar>(), p.orientation.cast<Scalar>()});
  };
  for (int i = 0; i < calls; ++i) {
    const double choice = random.uniform(0.0, 1.0);
    if (choice < 0.9)
      t += imu_period;
    else if (choice < 0.93)
      t += random.uniform(-0.5, 0.5);
    else if (choice < 0.935)
      t += 10.0;
    const double stamp = choice < 0.96 ? t : wild(random);
    const InertialSampled sample = flight.imu(t);
    imu(stamp,
        {wild_vector(random, sample.angular_velocity), wild_vector(random, sample.specific_force)});
    ASSERT_TRUE(is_finite(ekf)) << "seed " << seed << ", call " << i;
    MarkerPosed p = flight.pose(t);
    p.position = wild_vector(random, p.position);
    const double turn = random.uniform(0.0, 1.0);
    if (turn < 0.1)
      p.orientation.coeffs() << wild_vector(random, {0, 0, 0}), wild(random);
    else if (turn < 0.15)
      p.orientation.coeffs() *= wild(random);
    else if (turn < 0.3)
      p.orientation = random.orientation();
    pose(choice > 0.97 ? wild(random) : stamp, p);
    ASSERT_TRUE(is_finite(ekf)) << "seed " << seed << ", call " << i;
  }
  t = std::max(t, 0.0) + 1.0;
  for (int i = 0; i <= 4000; ++i) {
    t += imu_period;
    imu(t, flight.imu(t));
    if (i % 2 == 0) pose(t, noisy(flight.pose(t), {}, random));
    ASSERT_TRUE(is_finite(ekf));
  }
  const Errors e = errors(ekf, flight);
  EXPECT_TRUE(ekf.running()) << seed;
  EXPECT_LT(e.position, 0.02) << seed;
  EXPECT_LT(e.velocity, 0.2) << seed;
  EXPECT_LT(e.orientation, 0.03) << seed;
}

// The IMU sends one sample with an absurd stamp and is silent for a while. The poses go on.
TEST(Ekf, StampBeyondAnyClockDoesNotSetTheClock) {
  const Flight flight(1);
  for (const double stamp : {1e300, -1e300, 1e11}) {
    SCOPED_TRACE(stamp);
    Random random(2);
    Ekfd ekf;
    for (int i = 0; i < 1000; ++i) {
      const double t = imu_period * i;
      if (i <= 200 || i > 240) ekf.on_imu(i == 200 ? stamp : t, flight.imu(t));
      ekf.on_pose(t, noisy(flight.pose(t), {}, random));
      ASSERT_TRUE(is_finite(ekf)) << i;
    }
    EXPECT_EQ(ekf.clock_step(), 0.0);
    EXPECT_TRUE(ekf.running());
    EXPECT_LT(errors(ekf, flight).position, 0.02);
  }
}

// Settings at the ends of their ranges. If rounding errors exceed the noise of a pose, the estimate
// is inaccurate, but it must stay finite.
template <typename Scalar>
void expect_finite_at_the_ends(unsigned ends) {
  SCOPED_TRACE(ends);
  const auto end = [ends](unsigned bit, double low, double high) {
    return (ends >> bit) % 2 == 0 ? low : high;
  };
  EkfSettings s;
  const double density = end(0, 0.0, 1e3);
  s.imu_noise = {density, density, density, density};
  s.pose_noise = {end(1, 1e-6, 1e3), end(2, 1e-6, 10.0)};
  s.velocity_stddev = end(3, 1e-6, 1e3);
  s.gyro_bias_stddev = s.accelerometer_bias_stddev = end(4, 0.0, 1e3);
  s.marker_position.setConstant(end(5, 0.0, 100.0));
  (ends % 3 == 0 ? s.imu_position_stddev : s.marker_position_stddev) = end(6, 0.0, 100.0);
  s.marker_orientation_stddev = end(6, 0.0, 10.0);
  s.max_imu_gap = 1.0;
  Random random(ends);
  const Flight flight(ends, random.orientation(), s.marker_position, s.marker_orientation);
  Ekf<Scalar> ekf(s);
  double t = 0.0;
  for (int i = 0; i < 400; ++i) {
    t += i % 50 == 49 ? 0.9 : imu_period;
    const InertialSampled sample = flight.imu(t);
    ekf.on_imu(t, {sample.angular_velocity.cast<Scalar>(), sample.specific_force.cast<Scalar>()});
    const MarkerPosed pose = noisy(flight.pose(t), {}, random);
    if (i % 2 == 0) ekf.on_pose(t, {pose.position.cast<Scalar>(), pose.orientation.cast<Scalar>()});
    ASSERT_TRUE(is_finite(ekf)) << i;
  }
}

TEST(Ekf, StaysFiniteAtTheEndsOfSettingsRanges) {
  for (unsigned ends = 0; ends < 128; ++ends) {
    expect_finite_at_the_ends<double>(ends);
    expect_finite_at_the_ends<float>(ends);
  }
}

// A wrong marker frame must not stay with the standard deviation of the settings.
TEST(Ekf, StartWithoutKnownMarkerFrameTakesThatOfTheSettings) {
  EkfSettings s;
  s.imu_position = {0.02, 0.0, -0.01};
  s.marker_position = {0.1, 0.0, 0.05};
  s.marker_orientation = quaternion_exp(Eigen::Vector3d(0.0, 0.3, 1.0));
  s.marker_position_stddev = 0.01;
  s.marker_orientation_stddev = 0.02;
  ErrorStateFilter<double> filter(s.imu_noise, s.pose_noise);
  InertialStated wrong;
  wrong.marker_position = {9.0, -5.0, 3.0};
  wrong.marker_orientation = quaternion_exp(Eigen::Vector3d(1.5, 0.0, 0.0));
  filter.reset(wrong, ErrorStateFilter<double>::Covariance::Identity());
  detail::start_at_pose(filter, MarkerPosed{{1.0, 2.0, 3.0}, s.marker_orientation}, {}, s);
  const InertialStated& x = filter.state();
  EXPECT_LT((x.marker_position - (s.marker_position - s.imu_position)).norm(), 1e-12);
  EXPECT_LT(x.marker_orientation.angularDistance(s.marker_orientation), 1e-12);
  EXPECT_LT(x.orientation.angularDistance(Eigen::Quaterniond::Identity()), 1e-12);
}

// The poses teach another marker frame than the settings allow: an axis or a unit of it is wrong.
TEST(Ekf, AMarkerFrameFarFromThatOfTheSettingsIsNotGood) {
  EkfSettings s;
  s.marker_position_stddev = 0.01;
  s.marker_orientation_stddev = 0.02;
  for (const double turn : {0.0, 0.3})
    for (const double lever : {0.0, 0.2}) {
      const Flight flight(3, Eigen::Quaterniond::Identity(), {lever, 0.0, 0.0},
                          quaternion_exp(Eigen::Vector3d(0.0, 0.0, turn)));
      Random random(4);
      Ekfd ekf(s);
      int good = 0;
      for (int i = 0; i <= 4000; ++i) {
        const double t = imu_period * i;
        ekf.on_imu(t, flight.imu(t));
        if (i % 2 == 0) ekf.on_pose(t, noisy(flight.pose(t), {}, random));
        good += i > 2000 && ekf.trust(t).state == EstimateState::good;
      }
      SCOPED_TRACE(testing::Message() << turn << " rad, " << lever << " m");
      EXPECT_EQ(good, turn + lever == 0.0 ? 2000 : 0);
    }
}

// In the last nine runs, a filter that kept a wrong velocity, marker frame or step of the clock did
// not recover.
TEST(Ekf, RecoversFromAnyInput) {
  std::vector<unsigned> runs(full_run() ? 1000 : 50);
  std::iota(runs.begin(), runs.end(), 0U);
  runs.insert(runs.end(), {663, 705, 899, 965, 999, 4774, 5673, 6971, 9057});
  for (const unsigned run : runs) {
    EkfSettings s;
    if (run % 2 == 1) {
      s.marker_position_stddev = 0.01;
      s.marker_orientation_stddev = 0.02;
    }
    expect_survival<double>(run, 1000, s);
    if (run % 5 == 0) expect_survival<float>(run, 1000, s);
    if (HasFailure()) break;
  }
}

}  // namespace ekf_faults_test
}  // namespace tilt_ropter
