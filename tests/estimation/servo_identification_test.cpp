#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/estimation/servo_identification.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <limits>
#include <numeric>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

namespace {

using namespace tilt_ropter;
using Status = ServoIdentificationStatus;
using Values = std::vector<double>;
using test_support::full_run;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

// ---- Logs

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

/// Angles of the library's servo. Fewer than 64 commands have to come within the dead time.
Values library_plant(const ServoModel& servo, const Values& times, const Values& commands) {
  ServoParameters parameters;
  parameters.time_constant = servo.time_constant;
  parameters.dead_time = servo.dead_time;
  parameters.max_rate = 1000.0;
  parameters.min_angle = -10.0;
  parameters.max_angle = 10.0;
  Servo<> plant(parameters);
  const auto input = [&](std::size_t i) { return servo.gain * commands[i] + servo.offset; };
  // The first command was issued early enough to act from the first stamp on.
  plant.reset(servo.initial_angle, times.front() - servo.dead_time);
  plant.update(times.front() - servo.dead_time, input(0));
  Values angles;
  for (std::size_t i = 0; i < times.size(); ++i) angles.push_back(plant.update(times[i], input(i)));
  return angles;
}

/// The same by midpoint steps of 20 us, in which the command is looked up.
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

void add_noise(Values& angles, double size, test_support::Random& random) {
  for (double& angle : angles) angle += random.normal(size);
}

/// A square wave at 200 Hz for 4 s, seen without noise.
ServoLog square_log(const ServoModel& servo, double size = 0.3, double rate = 200.0) {
  ServoLog log;
  for (int i = 0; i < static_cast<int>(4.0 * rate); ++i) {
    log.times.push_back(i / rate);
    log.commands.push_back(static_cast<int>(i / (0.5 * rate)) % 2 == 1 ? size : 0.0);
  }
  log.angles = servo_response(servo, log.times, log.commands, log.times);
  return log;
}

const ServoModel usual{0.08, 0.021, 0.95, 0.05, 0.05};

// ---- The fit

TEST(ServoIdentification, ResponseIsTheClosedForm) {
  // A step from 0.2 to 0.5 at 1 s, from an angle of its own.
  const Values times{0.0, 1.0, 1.5}, commands{0.2, 0.5, 0.5};
  const ServoModel servo{0.1, 0.03, 0.9, -0.1, 0.4};
  const Values stamps{0.0, 0.2, 1.0, 1.03, 1.05, 1.4, 1.7};
  const Values angles = servo_response(servo, times, commands, stamps);
  ASSERT_EQ(angles.size(), stamps.size());
  const double low = 0.9 * 0.2 - 0.1, high = 0.9 * 0.5 - 0.1;
  const auto before = [&](double t) { return low + (0.4 - low) * std::exp(-t / 0.1); };
  for (std::size_t i = 0; i < 4; ++i) EXPECT_NEAR(angles[i], before(stamps[i]), 1e-15);
  for (std::size_t i = 4; i < 7; ++i)
    EXPECT_NEAR(angles[i], high + (before(1.03) - high) * std::exp(-(stamps[i] - 1.03) / 0.1),
                1e-15);
}

TEST(ServoIdentification, DerivativesAreThoseOfDifferences) {
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
    // No command takes effect within h of a stamp, but by a rare chance.
    EXPECT_TRUE(by_dead.col(0).isApprox(here.gain_dead, 1e-6)) << run;
    EXPECT_EQ(by_dead.rightCols(2).cwiseAbs().maxCoeff(), 0.0);
  }
}

TEST(ServoIdentification, WithoutNoiseTheServoIsRecoveredExactly) {
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

std::array<double, 5> numbers(const ServoModel& m) {
  return {m.time_constant, m.dead_time, m.gain, m.offset, m.initial_angle};
}

/// What comes out of many random logs in which the angle's deviation is `decibels` above that of
/// white noise.
struct Campaign {
  int cases = 0, identified = 0, least = 0;
  Values errors;                 // of the time constant, relative, sorted
  std::array<int, 5> covered{};  // by the intervals of the model's parameters
  double farthest = 0.0;         // of all errors, in standard deviations

  Campaign(double decibels, unsigned seed) {
    test_support::Random random(seed);
    for (; cases < (full_run() ? 1000 : 50); ++cases) {
      const Shape shape = shapes[static_cast<std::size_t>(cases) % shapes.size()];
      const ServoModel servo = random_servo(random);
      // As many logs from 50 to 100 Hz as from 500 to 1000; the library's servo holds 63 commands.
      const double rate = std::pow(10.0, random.uniform(std::log10(50.0), 3.0));
      const bool library = rate < 700.0 && cases % 2 == 0;
      ServoLog log;
      log.times = jittering_stamps(random, rate, 10.0);
      log.commands = commands_of(shape, log.times, random);
      log.angles = (library ? library_plant : integrated_plant)(servo, log.times, log.commands);
      add_noise(log.angles, deviation(log.angles) * std::pow(10.0, -decibels / 20.0), random);
      const ServoIdentification found = identify_servo(log);
      if (found.status == Status::identified) ++identified;

      // The least squares are no more than those that the true parameters leave.
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
    const auto percent = [this](double share) {
      return 100.0 * errors[static_cast<std::size_t>(share * (cases - 1))];
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
    for (const int count : covered) {  // 95 % give or take 4 standard deviations of the count
      const double spread = 4.0 * std::sqrt(0.95 * 0.05 / cases);
      EXPECT_GE(count, (0.95 - spread) * cases);
      EXPECT_LE(count, (0.95 + spread) * cases);
    }
    EXPECT_LT(farthest, 6.0);
  }
};

TEST(ServoIdentification, At40DecibelsTheTimeConstantIsWithin2PercentAndTheIntervalsHold) {
  Campaign(40.0, 11).judge("40 dB", 0.02);
}

TEST(ServoIdentification, At20DecibelsTheTimeConstantIsWithin10PercentAndTheIntervalsHold) {
  Campaign(20.0, 12).judge("20 dB", 0.10);
}

// Few samples on each edge: the error is full of kinks over the dead time, and flat.
TEST(ServoIdentification, TheLeastSquaresAreFoundInSparseNoisyLogsToo) {
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

TEST(ServoIdentification, ARateLimitInTheLogShowsInTheResidual) {
  test_support::Random random(5);
  const auto identified_with = [&](double size) {
    ServoParameters parameters;  // 0.08 s and 8 rad/s: limited from 0.64 rad on
    Servo<> servo(parameters);
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

// Part of a record, without a copy.
struct View {
  const double* values;
  std::size_t length;

  const double* data() const { return values; }
  std::size_t size() const { return length; }
  const double* begin() const { return values; }
  const double* end() const { return values + length; }
  double front() const { return values[0]; }
  double back() const { return values[length - 1]; }
  double operator[](std::size_t i) const { return values[i]; }
};
struct ViewLog {
  View times, commands, angles;
};

TEST(ServoIdentification, AnyLogWithTheSameMembersWillDo) {
  ServoLog log = square_log(usual);
  const ViewLog part{{log.times.data(), 300}, {log.commands.data(), 300}, {log.angles.data(), 300}};
  const ServoIdentification of_part = identify_servo(part);
  for (Values* values : {&log.times, &log.commands, &log.angles}) values->resize(300);
  const ServoIdentification of_copy = identify_servo(log);
  EXPECT_EQ(of_part.status, Status::identified);
  EXPECT_EQ(of_part.samples, 300u);
  EXPECT_EQ(of_part.model.time_constant, of_copy.model.time_constant);
  EXPECT_EQ(of_part.half_width.dead_time, of_copy.half_width.dead_time);
  EXPECT_EQ(servo_response(of_part.model, part.times, part.commands, part.times),
            servo_response(of_part.model, log.times, log.commands, log.times));
}

TEST(ServoIdentification, QuantisedAnglesAreNoObstacle) {
  ServoLog log = square_log(usual);
  const double tick = 2.0 * pi / 4096.0;
  for (double& angle : log.angles) angle = tick * std::round(angle / tick);
  const ServoIdentification found = identify_servo(log);
  EXPECT_EQ(found.status, Status::identified);
  EXPECT_NEAR(found.model.time_constant, usual.time_constant, 0.02 * usual.time_constant);
  EXPECT_NEAR(found.model.dead_time, usual.dead_time, 0.001);
}

TEST(ServoIdentification, ReversedServosHaveANegativeGain) {
  ServoModel reversed = usual;
  reversed.gain = -0.95;
  const ServoIdentification found = identify_servo(square_log(reversed));
  EXPECT_EQ(found.status, Status::identified);
  EXPECT_NEAR(found.model.gain, -0.95, 1e-7);
  EXPECT_NEAR(found.model.dead_time, usual.dead_time, 1e-7);
}

TEST(ServoIdentification, StampsMayCountFromAnyEpoch) {
  ServoLog log = square_log(usual);
  for (double& time : log.times) time += 1.7e9;
  const ServoIdentification found = identify_servo(log);
  EXPECT_EQ(found.status, Status::identified);
  EXPECT_NEAR(found.model.time_constant, usual.time_constant, 1e-5);
  EXPECT_NEAR(found.model.dead_time, usual.dead_time, 1e-5);
}

// ---- Refusals

Status status_of(const ServoLog& log, const ServoIdentificationSettings& settings = {}) {
  return identify_servo(log, settings).status;
}

TEST(ServoIdentification, RefusesWhatIsNoLog) {
  EXPECT_EQ(status_of({}), Status::too_few_samples);
  const ServoLog good = square_log(usual);
  ASSERT_EQ(status_of(good), Status::identified);
  for (Values ServoLog::*values : {&ServoLog::times, &ServoLog::commands, &ServoLog::angles}) {
    ServoLog log = good;
    (log.*values).pop_back();
    EXPECT_EQ(status_of(log), Status::sizes_unequal);
    for (const double bad : {nan, infinity, -infinity}) {
      log = good;
      (log.*values)[300] = bad;
      EXPECT_EQ(status_of(log), Status::not_finite);
    }
  }
  ServoLog log = good;
  std::swap(log.times[300], log.times[301]);
  EXPECT_EQ(status_of(log), Status::stamps_not_increasing);
  log.times[300] = log.times[301] = good.times[300];
  EXPECT_EQ(status_of(log), Status::stamps_not_increasing);
}

TEST(ServoIdentification, RefusesCommandsThatDoNotExciteAndAnglesThatDoNotFollow) {
  test_support::Random random(6);
  ServoLog log = square_log(usual);
  for (double& command : log.commands) command = 0.3;
  EXPECT_EQ(status_of(log), Status::command_constant);
  log = square_log(usual);
  for (double& angle : log.angles) angle = 0.1;
  EXPECT_EQ(status_of(log), Status::no_response);
  for (int run = 0; run < (full_run() ? 500 : 50); ++run) {
    for (double& angle : log.angles) angle = random.normal(0.01);
    EXPECT_EQ(status_of(log), Status::no_response);
  }
}

TEST(ServoIdentification, RefusesTimeConstantsThatTheLogCannotTell) {
  test_support::Random random(7);
  ServoModel servo = usual;
  servo.time_constant = 0.003;  // over between two samples at 50 Hz
  ServoLog log = square_log(servo, 0.3, 50.0);
  add_noise(log.angles, 0.003, random);
  EXPECT_EQ(status_of(log), Status::time_constant_too_short);
  servo.time_constant = 0.0005;
  EXPECT_EQ(status_of(square_log(servo)), Status::time_constant_too_short);
  servo.time_constant = 5.0;  // longer than is looked for, and than the log
  ServoIdentificationSettings patient;
  patient.max_time_constant = 50.0;
  log = square_log(servo);
  add_noise(log.angles, 0.01, random);
  EXPECT_EQ(status_of(log), Status::time_constant_too_long);
  EXPECT_EQ(status_of(log, patient), Status::time_constant_too_long);
  log = square_log(usual);
  for (double& time : log.times) time *= 1e-4;
  EXPECT_EQ(status_of(log), Status::time_constant_too_long);
}

TEST(ServoIdentification, EverySettingActs) {
  using Settings = ServoIdentificationSettings;
  test_support::Random random(8);
  ServoLog log = square_log(usual);
  add_noise(log.angles, 0.01, random);
  const ServoIdentification found = identify_servo(log);
  ASSERT_EQ(found.status, Status::identified);
  const double significance = 1.96 * found.model.gain / found.half_width.gain;
  const auto with = [&log](auto Settings::*setting, auto value) {
    Settings settings;
    settings.*setting = value;
    return identify_servo(log, settings).status;
  };
  EXPECT_EQ(with(&Settings::min_time_constant, 0.07), Status::identified);
  EXPECT_EQ(with(&Settings::min_time_constant, 0.09), Status::time_constant_too_short);
  EXPECT_EQ(with(&Settings::max_time_constant, 0.09), Status::identified);
  EXPECT_EQ(with(&Settings::max_time_constant, 0.07), Status::time_constant_too_long);
  EXPECT_EQ(with(&Settings::max_dead_time, 0.03), Status::identified);
  EXPECT_EQ(with(&Settings::max_dead_time, 0.01), Status::dead_time_too_long);
  EXPECT_EQ(with(&Settings::min_excitation, 0.29), Status::identified);
  EXPECT_EQ(with(&Settings::min_excitation, 0.31), Status::command_constant);
  EXPECT_EQ(with(&Settings::min_significance, 0.9 * significance), Status::identified);
  EXPECT_EQ(with(&Settings::min_significance, 1.1 * significance), Status::no_response);
  EXPECT_EQ(with(&Settings::min_samples, 800), Status::identified);
  EXPECT_EQ(with(&Settings::min_samples, 801), Status::too_few_samples);
  EXPECT_EQ(with(&Settings::max_iterations, 1), Status::no_convergence);
}

TEST(ServoIdentification, WithoutDeadTimeItIsNotEstimated) {
  ServoModel servo = usual;
  servo.dead_time = 0.0;
  test_support::Random random(9);
  ServoIdentificationSettings settings;
  settings.max_dead_time = 0.0;
  int at_zero = 0;
  for (int run = 0; run < 20; ++run) {
    ServoLog log = square_log(servo);
    add_noise(log.angles, 0.01, random);
    const ServoIdentification free = identify_servo(log), without = identify_servo(log, settings);
    EXPECT_EQ(free.status, Status::identified);
    EXPECT_EQ(without.status, Status::identified);
    EXPECT_EQ(without.model.dead_time, 0.0);
    EXPECT_EQ(without.half_width.dead_time, 0.0);
    EXPECT_GT(without.half_width.time_constant, 0.0);
    EXPECT_LT(without.half_width.time_constant, 0.8 * free.half_width.time_constant);
    EXPECT_NEAR(without.model.time_constant, 0.08, 2.0 * without.half_width.time_constant);
    EXPECT_LE(free.residual_rms, without.residual_rms * (1.0 + 1e-9));
    if (free.model.dead_time > 0.0) continue;
    ++at_zero;  // the estimate at the end of its range is that without dead time
    EXPECT_NEAR(free.model.time_constant, without.model.time_constant, 1e-6);
  }
  EXPECT_GT(at_zero, 3);
  EXPECT_LT(at_zero, 17);
}

TEST(ServoIdentification, RefusesSettingsByName) {
  using Settings = ServoIdentificationSettings;
  const auto refusal = [](auto Settings::*setting, auto value) -> std::string {
    Settings settings;
    settings.*setting = value;
    try {
      (void)identify_servo({}, settings);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "not refused";
  };
  const auto names = [](const std::string& message, const std::string& field) {
    return message.find("ServoIdentificationSettings." + field) != std::string::npos;
  };
  for (const double bad : {-0.1, nan, infinity}) {
    EXPECT_TRUE(names(refusal(&Settings::min_time_constant, bad), "min_time_constant"));
    EXPECT_TRUE(names(refusal(&Settings::max_time_constant, bad), "max_time_constant"));
    EXPECT_TRUE(names(refusal(&Settings::max_dead_time, bad), "max_dead_time"));
    EXPECT_TRUE(names(refusal(&Settings::min_excitation, bad), "min_excitation"));
    EXPECT_TRUE(names(refusal(&Settings::min_significance, bad), "min_significance"));
  }
  EXPECT_TRUE(names(refusal(&Settings::max_time_constant, 0.001), "max_time_constant"));
  EXPECT_TRUE(names(refusal(&Settings::min_samples, 5), "min_samples"));
  EXPECT_TRUE(names(refusal(&Settings::max_iterations, 0), "max_iterations"));
}

TEST(ServoIdentification, EveryStatusHasATextOfItsOwn) {
  std::set<std::string> texts;
  const int last = static_cast<int>(Status::dead_time_too_long);
  for (int i = 0; i <= last; ++i) texts.insert(to_string(static_cast<Status>(i)));
  EXPECT_EQ(texts.size(), static_cast<std::size_t>(last) + 1);
  EXPECT_EQ(texts.count("unknown"), 0u);
}

TEST(ServoIdentification, WhateverIsInTheLogTheAnswerIsFiniteOrRefused) {
  test_support::Random random(10);
  const Values pool{0.0, -0.0, 1.0, -1.0, 0.3, 1e-9, 5e-324, 1e300, -1e300, 1e150, 1e9, nan};
  int fits = 0;
  for (int run = 0; run < (full_run() ? 20000 : 1000); ++run) {
    // One wild value in a good log, or nothing but.
    ServoLog log = square_log(usual, 0.3, 10.0);
    const std::size_t wild = run % 2 == 0 ? 1 : log.times.size();
    for (std::size_t i = 0; i < wild; ++i) {
      const auto any = [&](std::size_t count) {
        return static_cast<std::size_t>(random.uniform(0.0, static_cast<double>(count) - 1e-6));
      };
      const std::size_t row = any(log.times.size());
      Values* const values[] = {&log.times, &log.commands, &log.angles};
      // Times that do not increase are refused at once: few of those.
      (*values[random.uniform(0.0, 1.0) < 0.001 ? 0 : 1 + any(2)])[row] =
          pool[any(pool.size() - (run % 4 < 2 ? 1 : 0))];
    }
    const ServoIdentification found = identify_servo(log);
    if (found.status != Status::identified) continue;
    ++fits;
    for (const double number : numbers(found.model)) ASSERT_TRUE(std::isfinite(number));
    for (const double number : numbers(found.half_width)) ASSERT_TRUE(std::isfinite(number));
    ASSERT_TRUE(std::isfinite(found.residual_rms) && std::isfinite(found.r_squared));
  }
  EXPECT_GT(fits, 0);
}

}  // namespace
