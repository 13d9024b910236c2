// Which logs and settings are accepted and which are rejected, and why.
// CTest: optimised

#include <tilt_ropter/identification/servo_identification.hpp>

#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/servo_logs.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <limits>
#include <set>
#include <string>
#include <utility>
#include <vector>

namespace tilt_ropter {
namespace servo_identification_test {

using Status = ServoIdentificationStatus;
using Values = std::vector<double>;
using test_support::add_noise;
using test_support::full_run;
using test_support::numbers;
using test_support::square_log;
using test_support::usual;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

TEST(ServoIdentification, ResponseMatchesClosedForm) {
  // A step from 0.2 to 0.5 at 1 s, with an independent initial angle.
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

// A part of a log, without a copy.
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

TEST(ServoIdentification, AcceptsAnyLogTypeWithSameMembers) {
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

TEST(ServoIdentification, ReversedServosAndOtherUnitsAreRefusedByName) {
  ServoModel reversed = usual;
  reversed.gain = -0.95;
  const ServoIdentification found = identify_servo(square_log(reversed));
  EXPECT_EQ(found.status, Status::reversed);
  EXPECT_NEAR(found.model.gain, -0.95, 1e-7);
  EXPECT_NEAR(found.model.dead_time, usual.dead_time, 1e-7);
  for (const double degrees : {180.0 / pi, pi / 180.0}) {
    ServoLog log = square_log(usual);
    for (double& angle : log.angles) angle *= degrees;
    EXPECT_EQ(identify_servo(log).status, Status::implausible_gain);
  }
  // The commands are late by more than the dead time.
  for (const double late : {0.04, 0.1}) {
    ServoLog log = square_log(usual);
    Values stamps = log.times;
    for (double& time : stamps) time += late;
    log.angles = servo_response(usual, log.times, log.commands, stamps);
    EXPECT_EQ(identify_servo(log).status, Status::angle_early) << late;
  }
}

TEST(ServoIdentification, AcceptsStampsFromAnyEpoch) {
  ServoLog log = square_log(usual);
  for (double& time : log.times) time += 1.7e9;
  const ServoIdentification found = identify_servo(log);
  EXPECT_EQ(found.status, Status::identified);
  EXPECT_NEAR(found.model.time_constant, usual.time_constant, 1e-5);
  EXPECT_NEAR(found.model.dead_time, usual.dead_time, 1e-5);
}

Status status_of(const ServoLog& log) {
  return identify_servo(log).status;
}

TEST(ServoIdentification, RejectsInvalidLogs) {
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

TEST(ServoIdentification, RejectsConstantCommandsAndUnrelatedAngles) {
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

TEST(ServoIdentification, RejectsTimeConstantsThatAreNotObservable) {
  test_support::Random random(7);
  ServoModel servo = usual;
  servo.time_constant = 0.003;  // settles between two samples at 50 Hz
  ServoLog log = square_log(servo, 0.3, 50.0);
  add_noise(log.angles, 0.003, random);
  EXPECT_EQ(status_of(log), Status::time_constant_too_short);
  servo.time_constant = 0.0005;
  EXPECT_EQ(status_of(square_log(servo)), Status::time_constant_too_short);
  servo.time_constant = 5.0;  // longer than max_time_constant
  log = square_log(servo);
  add_noise(log.angles, 0.01, random);
  EXPECT_EQ(status_of(log), Status::time_constant_too_long);
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
  const auto with = [&log](auto Settings::*setting, auto value) {
    Settings settings;
    settings.*setting = value;
    return identify_servo(log, settings).status;
  };
  EXPECT_EQ(with(&Settings::max_dead_time, 0.03), Status::identified);
  EXPECT_EQ(with(&Settings::max_dead_time, 0.01), Status::dead_time_too_long);
  EXPECT_EQ(with(&Settings::max_iterations, 1), Status::no_convergence);
  for (std::vector<double>* list : {&log.times, &log.commands, &log.angles}) list->resize(20);
  EXPECT_NE(status_of(log), Status::too_few_samples);
  for (std::vector<double>* list : {&log.times, &log.commands, &log.angles}) list->resize(19);
  EXPECT_EQ(status_of(log), Status::too_few_samples);
}

TEST(ServoIdentification, ZeroMaxDeadTimeDisablesItsEstimation) {
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
    ++at_zero;  // at zero the other estimates equal those without dead time
    EXPECT_NEAR(free.model.time_constant, without.model.time_constant, 1e-6);
  }
  EXPECT_GT(at_zero, 3);
  EXPECT_LT(at_zero, 17);
}

TEST(ServoIdentification, EveryStatusHasItsOwnText) {
  std::set<std::string> texts;
  const int last = static_cast<int>(Status::angle_early);
  for (int i = 0; i <= last; ++i) texts.insert(to_string(static_cast<Status>(i)));
  EXPECT_EQ(texts.size(), static_cast<std::size_t>(last) + 1);
  EXPECT_EQ(texts.count("unknown"), 0u);
}

TEST(ServoIdentification, ResultIsFiniteOrRejectedForAnyLog) {
  test_support::Random random(10);
  const Values pool{0.0, -0.0, 1.0, -1.0, 0.3, 1e-9, 5e-324, 1e300, -1e300, 1e150, 1e9, nan};
  int fits = 0;
  for (int run = 0; run < (full_run() ? 20000 : 1000); ++run) {
    // One extreme value in a valid log, or only such values.
    ServoLog log = square_log(usual, 0.3, 10.0);
    const std::size_t wild = run % 2 == 0 ? 1 : log.times.size();
    for (std::size_t i = 0; i < wild; ++i) {
      const auto any = [&](std::size_t count) {
        return static_cast<std::size_t>(random.uniform(0.0, static_cast<double>(count) - 1e-6));
      };
      const std::size_t row = any(log.times.size());
      Values* const values[] = {&log.times, &log.commands, &log.angles};
      // Times that do not increase are rejected at once, so few logs have an extreme time.
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

}  // namespace servo_identification_test
}  // namespace tilt_ropter
