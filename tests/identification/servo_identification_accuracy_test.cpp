// Accuracy of the fit and of its confidence intervals, with and without noise.
// CTest: optimised

#include <tilt_ropter/identification/servo_identification.hpp>

#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/servo_logs.hpp"

#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <numeric>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace servo_identification_accuracy_test {

using Status = ServoIdentificationStatus;
using Values = std::vector<double>;
using test_support::add_noise;
using test_support::full_run;
using test_support::numbers;
using test_support::square_log;
using test_support::usual;

enum class Shape { step, square, chirp, staircase, telegraph };
constexpr std::array<Shape, 5> shapes = {Shape::step, Shape::square, Shape::chirp, Shape::staircase,
                                         Shape::telegraph};

/// Stamps of `duration` [s] at `rate` [Hz], each interval up to 30 % shorter or longer.
Values jittering_stamps(test_support::Random& random, double rate, double duration) {
  const double start = random.uniform(-5.0, 5.0);
  Values times{start};
  while (times.back() < start + duration)
    times.push_back(times.back() + random.uniform(0.7, 1.3) / rate);
  return times;
}

Values commands_of(Shape shape, const Values& times, test_support::Random& random) {
  const double base = random.uniform(-0.5, 0.5), size = random.uniform(0.1, 0.4);
  const double hold = random.uniform(0.3, 0.8), end = times.back() - times.front();
  const double slow = 0.2, fast = random.uniform(1.5, 4.0);
  double flip = hold;
  bool high = false;
  Values commands;
  for (const double stamp : times) {
    const double time = stamp - times.front();
    const int holds = static_cast<int>(time / hold);
    double value = 0.0;
    switch (shape) {
      case Shape::step:
        value = time >= hold ? 1.0 : 0.0;
        break;
      case Shape::square:
        value = holds % 2;
        break;
      case Shape::chirp:
        value = std::sin(2.0 * pi * (slow + (fast - slow) * time / (2.0 * end)) * time);
        break;
      case Shape::staircase:  // up four steps and down again
        value = 0.25 * (4 - std::abs(holds % 8 - 4));
        break;
      case Shape::telegraph:
        if (time >= flip) {
          high = !high;
          flip = time + random.uniform(0.05, 0.6);
        }
        value = high ? 1.0 : 0.0;
        break;
    }
    commands.push_back(base + size * value);
  }
  return commands;
}

ServoModel random_servo(test_support::Random& random) {
  ServoModel servo;
  servo.time_constant = random.uniform(0.02, 0.3);
  servo.dead_time = random.uniform(0.0, 0.06);
  servo.gain = random.uniform(0.7, 1.3);
  servo.offset = random.uniform(-0.3, 0.3);
  servo.initial_angle = random.uniform(-0.3, 0.3);
  return servo;
}

/// Angles of the library's servo. Fewer than 64 commands may wait for their dead time.
Values library_plant(const ServoModel& servo, const Values& times, const Values& commands) {
  ServoParameters parameters;
  parameters.time_constant = servo.time_constant;
  parameters.dead_time = servo.dead_time;
  parameters.max_rate = 1000.0;
  parameters.min_angle = -10.0;
  parameters.max_angle = 10.0;
  Servod plant(parameters);
  const auto input = [&](std::size_t i) { return servo.gain * commands[i] + servo.offset; };
  // The first command was issued early enough to act from the first stamp on.
  plant.reset(servo.initial_angle, times.front() - servo.dead_time);
  plant.update(times.front() - servo.dead_time, input(0));
  Values angles;
  for (std::size_t i = 0; i < times.size(); ++i) angles.push_back(plant.update(times[i], input(i)));
  return angles;
}

/// The same servo by midpoint steps of 20 us. The command is looked up in every step.
Values integrated_plant(const ServoModel& servo, const Values& times, const Values& commands) {
  const double step = 2e-5;
  double angle = servo.initial_angle, now = times.front();
  std::size_t issued = 0;
  const auto slope = [&](double time, double at) {
    while (issued + 1 < times.size() && times[issued + 1] + servo.dead_time <= time) ++issued;
    return (servo.gain * commands[issued] + servo.offset - at) / servo.time_constant;
  };
  Values angles;
  for (const double stamp : times) {
    while (now < stamp) {
      const double h = std::min(step, stamp - now);
      angle += h * slope(now + 0.5 * h, angle + 0.5 * h * slope(now, angle));
      now = stamp - now <= step ? stamp : now + h;
    }
    angles.push_back(angle);
  }
  return angles;
}

double deviation(const Values& values) {
  const double count = static_cast<double>(values.size());
  const double mean = std::accumulate(values.begin(), values.end(), 0.0) / count;
  double squares = 0.0;
  for (const double value : values) squares += (value - mean) * (value - mean);
  return std::sqrt(squares / count);
}

TEST(ServoIdentification, DerivativesMatchFiniteDifferences) {
  test_support::Random random(21);
  for (int run = 0; run < 50; ++run) {
    const Shape shape = shapes[static_cast<std::size_t>(run) % shapes.size()];
    const double tau = random.uniform(0.02, 0.3), dead = random.uniform(0.01, 0.06), h = 1e-6;
    const Values times = jittering_stamps(random, 100.0, 3.0);
    const Values commands = commands_of(shape, times, random);
    const auto at = [&](double time_constant, double dead_time) {
      return detail::ServoColumns(times, commands, times, time_constant, dead_time);
    };
    const detail::ServoColumns here = at(tau, dead);
    const Eigen::MatrixXd by_tau = (at(tau + h, dead).linear - at(tau - h, dead).linear) / (2 * h);
    const Eigen::MatrixXd by_dead = (at(tau, dead + h).linear - at(tau, dead - h).linear) / (2 * h);
    EXPECT_TRUE(by_tau.col(0).isApprox(here.gain_tau, 1e-6)) << run;
    EXPECT_TRUE(by_tau.col(1).isApprox(-here.decay_tau, 1e-6)) << run;
    EXPECT_TRUE(by_tau.col(2).isApprox(here.decay_tau, 1e-6)) << run;
    // No command takes effect within h of a stamp, except by rare chance.
    EXPECT_TRUE(by_dead.col(0).isApprox(here.gain_dead, 1e-6)) << run;
    EXPECT_EQ(by_dead.rightCols(2).cwiseAbs().maxCoeff(), 0.0);
  }
}

TEST(ServoIdentification, RecoversServoExactlyWithoutNoise) {
  test_support::Random random(1);
  for (int run = 0; run < (full_run() ? 200 : 20); ++run) {
    const Shape shape = shapes[static_cast<std::size_t>(run) % shapes.size()];
    const ServoModel servo = random_servo(random);
    ServoLog log;
    log.times = jittering_stamps(random, std::pow(10.0, random.uniform(1.7, 2.85)), 5.0);
    log.commands = commands_of(shape, log.times, random);
    log.angles = library_plant(servo, log.times, log.commands);
    const ServoIdentification found = identify_servo(log);
    ASSERT_EQ(found.status, Status::identified) << run << ' ' << to_string(found.status);
    EXPECT_NEAR(found.model.time_constant, servo.time_constant, 1e-7) << run;
    EXPECT_NEAR(found.model.dead_time, servo.dead_time, 1e-7) << run;
    EXPECT_NEAR(found.model.gain, servo.gain, 1e-7) << run;
    EXPECT_NEAR(found.model.offset, servo.offset, 1e-7) << run;
    EXPECT_NEAR(found.model.initial_angle, servo.initial_angle, 1e-7) << run;
    EXPECT_LT(found.half_width.time_constant, 1e-7);
    EXPECT_LT(found.residual_rms, 1e-8);
    EXPECT_NEAR(found.r_squared, 1.0, 1e-12);
    EXPECT_EQ(found.samples, log.times.size());
  }
}

/// Results for many random logs. The standard deviation of the angle is `decibels` above the
/// standard deviation of the added white noise.
struct Campaign {
  int cases = 0, identified = 0, least = 0;
  Values errors;                 // relative, of the time constant, sorted
  std::array<int, 5> covered{};  // cases whose interval contains the true value
  double farthest = 0.0;         // largest error, in standard deviations

  Campaign(double decibels, unsigned seed) {
    test_support::Random random(seed);
    for (; cases < (full_run() ? 1000 : 50); ++cases) {
      const Shape shape = shapes[static_cast<std::size_t>(cases) % shapes.size()];
      const ServoModel servo = random_servo(random);
      // Log-uniform rate from 50 to 1000 Hz. The library's servo holds at most 63 commands.
      const double rate = std::pow(10.0, random.uniform(std::log10(50.0), 3.0));
      const bool library = rate < 700.0 && cases % 2 == 0;
      ServoLog log;
      log.times = jittering_stamps(random, rate, 10.0);
      log.commands = commands_of(shape, log.times, random);
      log.angles = (library ? library_plant : integrated_plant)(servo, log.times, log.commands);
      add_noise(log.angles, deviation(log.angles) * std::pow(10.0, -decibels / 20.0), random);
      const ServoIdentification found = identify_servo(log);
      if (found.status == Status::identified) ++identified;

      // The residual sum of squares does not exceed the sum for the true parameters.
      const Values truth = servo_response(servo, log.times, log.commands, log.times);
      double squares = 0.0;
      for (std::size_t i = 0; i < truth.size(); ++i)
        squares += std::pow(log.angles[i] - truth[i], 2);
      const double left = std::sqrt(squares / static_cast<double>(truth.size()));
      if (found.residual_rms <= left * (1.0 + 1e-9)) ++least;

      const auto is = numbers(found.model), was = numbers(servo), wide = numbers(found.half_width);
      for (std::size_t i = 0; i < 5; ++i) {
        if (std::abs(is[i] - was[i]) <= wide[i]) ++covered[i];
        farthest = std::max(farthest, 1.96 * std::abs(is[i] - was[i]) / wide[i]);
      }
      errors.push_back(std::abs(is[0] / was[0] - 1.0));
    }
    std::sort(errors.begin(), errors.end());
  }

  void judge(const std::string& what, double bound) const {
    const auto percent = [this](double fraction) {
      return 100.0 * errors[static_cast<std::size_t>(fraction * (cases - 1))];
    };
    std::printf(
        "time constant off by %.2f %% (median), %.2f %% (95 of 100), %.2f %% (99 of 100), "
        "%.2f %% (all); intervals cover",
        percent(0.5), percent(0.95), percent(0.99), percent(1.0));
    for (const int count : covered) std::printf(" %.1f %%", 100.0 * count / cases);
    std::printf("; farthest %.2f deviations\n", farthest);
    EXPECT_EQ(identified, cases);
    EXPECT_EQ(least, cases);
    test_support::check_at_most(11, "servo: time constant's relative error, " + what, errors.back(),
                                bound);
    for (const int count : covered) {  // 95 % +- 4 standard deviations of the count
      const double spread = 4.0 * std::sqrt(0.95 * 0.05 / cases);
      EXPECT_GE(count, (0.95 - spread) * cases);
      EXPECT_LE(count, (0.95 + spread) * cases);
    }
    EXPECT_LT(farthest, 6.0);
  }
};

TEST(ServoIdentification, TimeConstantIsWithin2PercentAndIntervalsHoldAt40dB) {
  Campaign(40.0, 11).judge("40 dB", 0.02);
}

TEST(ServoIdentification, TimeConstantIsWithin10PercentAndIntervalsHoldAt20dB) {
  Campaign(20.0, 12).judge("20 dB", 0.10);
}

// With few samples per edge the squared error is a flat function of the dead time with many kinks.
TEST(ServoIdentification, FindsLeastSquaresInSparseNoisyLogs) {
  test_support::Random random(13);
  for (int run = 0; run < (full_run() ? 2000 : 200); ++run) {
    const Shape shape = shapes[static_cast<std::size_t>(run) % shapes.size()];
    ServoModel servo = random_servo(random);
    servo.time_constant = random.uniform(0.02, 0.1);
    ServoLog log;
    log.times = jittering_stamps(random, random.uniform(40.0, 100.0), 4.0);
    log.commands = commands_of(shape, log.times, random);
    const Values truth = servo_response(servo, log.times, log.commands, log.times);
    log.angles = truth;
    add_noise(log.angles, 0.1 * deviation(truth), random);
    const ServoIdentification found = identify_servo(log);
    EXPECT_NE(found.status, Status::no_convergence) << run;
    double squares = 0.0;
    for (std::size_t i = 0; i < truth.size(); ++i) squares += std::pow(log.angles[i] - truth[i], 2);
    EXPECT_LE(found.residual_rms, std::sqrt(squares / static_cast<double>(truth.size()))) << run;
  }
}

TEST(ServoIdentification, CorrelatedNoiseWidensTheIntervals) {
  test_support::Random random(3);
  const int runs = full_run() ? 400 : 100;
  int covered = 0, covered_by_white = 0;
  for (int run = 0; run < runs; ++run) {
    ServoLog log = square_log(usual);
    double noise = 0.0;
    for (double& angle : log.angles) angle += noise = 0.8 * noise + random.normal(0.002);
    const ServoIdentification found = identify_servo(log);
    EXPECT_NEAR(found.residual_correlation, 0.8, 0.1);
    const double error = std::abs(found.model.gain - usual.gain);
    if (error <= found.half_width.gain) ++covered;
    if (error <= found.half_width.gain / 3.0) ++covered_by_white;  // sqrt(1.8 / 0.2)
  }
  EXPECT_GE(covered, 0.85 * runs);
  EXPECT_LE(covered_by_white, 0.65 * runs);
}

TEST(ServoIdentification, WhiteNoiseLeavesAWhiteResidual) {
  test_support::Random random(4);
  ServoLog log = square_log(usual);
  add_noise(log.angles, 0.01, random);
  const ServoIdentification found = identify_servo(log);
  EXPECT_NEAR(found.residual_correlation, 0.0, 0.12);
  EXPECT_NEAR(found.residual_rms, 0.01, 0.001);
  EXPECT_NEAR(found.r_squared, 1.0 - std::pow(found.residual_rms / deviation(log.angles), 2),
              1e-12);
}

TEST(ServoIdentification, RateLimitShowsInResidualCorrelation) {
  test_support::Random random(5);
  const auto identified_with = [&](double size) {
    ServoParameters parameters;  // 0.08 s and 8 rad/s: rate limit above 0.64 rad
    Servod servo(parameters);
    ServoLog log = square_log(usual, size);
    for (std::size_t i = 0; i < log.times.size(); ++i)
      log.angles[i] = servo.update(log.times[i], log.commands[i]) + random.normal(0.002);
    return identify_servo(log);
  };
  const ServoIdentification small = identified_with(0.6), large = identified_with(2.0);
  EXPECT_NEAR(small.model.time_constant, 0.08, 0.002);
  EXPECT_LT(small.residual_correlation, 0.2);
  EXPECT_GT(large.model.time_constant, 0.1);
  EXPECT_GT(large.residual_correlation, 0.9);
}

TEST(ServoIdentification, ToleratesQuantisedAngles) {
  ServoLog log = square_log(usual);
  const double tick = 2.0 * pi / 4096.0;
  for (double& angle : log.angles) angle = tick * std::round(angle / tick);
  const ServoIdentification found = identify_servo(log);
  EXPECT_EQ(found.status, Status::identified);
  EXPECT_NEAR(found.model.time_constant, usual.time_constant, 0.02 * usual.time_constant);
  EXPECT_NEAR(found.model.dead_time, usual.dead_time, 0.001);
}

}  // namespace servo_identification_accuracy_test
}  // namespace tilt_ropter
