#include <tilt_ropter/actuation/servo.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "support/autodiff.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

namespace servo_test {

using namespace tilt_ropter;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double infinity = std::numeric_limits<double>::infinity();

ServoParameters parameters(double dead_time) {
  ServoParameters p;
  p.time_constant = 0.08;
  p.max_rate = 8.0;
  p.min_angle = -2.0;
  p.max_angle = 2.5;
  p.dead_time = dead_time;
  return p;
}

/// Returns the angle of the same servo at `end` [s], integrated with tiny Euler steps. `commands`
/// are pairs of time and command.
double simulate(const ServoParameters& p, const std::vector<std::pair<double, double>>& commands,
                double end) {
  double angle = 0.0;
  const double step = 2e-6;
  for (double time = commands.front().first; time < end - 0.5 * step; time += step) {
    double command = 0.0;
    for (const auto& [issued, value] : commands)
      if (issued + p.dead_time <= time + 0.5 * step) command = value;
    command = std::clamp(command, p.min_angle, p.max_angle);
    angle += step * std::clamp((command - angle) / p.time_constant, -p.max_rate, p.max_rate);
  }
  return angle;
}

TEST(Servo, SmallStepResponseIsExponential) {
  Servod servo(parameters(0.0));
  servo.update(1.0, 0.5);
  for (const double time : {1.001, 1.05, 1.4})
    EXPECT_NEAR(servo.update(time, 0.5), 0.5 * -std::expm1(-(time - 1.0) / 0.08), 1e-14);
}

TEST(Servo, LargeStepResponseIsRampThenExponential) {
  Servod servo(parameters(0.0));
  servo.update(0.0, 2.0);
  EXPECT_NEAR(servo.update(0.1, 2.0), 0.8, 1e-14);
  // The ramp ends where (2 - angle) / 0.08 = 8, at 1.36 rad and 0.17 s.
  EXPECT_NEAR(servo.update(0.17, 2.0), 1.36, 1e-14);
  EXPECT_NEAR(servo.update(0.30, 2.0), 2.0 - 0.64 * std::exp(-0.13 / 0.08), 1e-14);
}

TEST(Servo, ResultIsIndependentOfUpdateInterval) {
  test_support::Random random(1);
  for (const double dead_time : {0.0, 0.03}) {
    for (int run = 0; run < 200; ++run) {
      Servod coarse(parameters(dead_time)), fine(parameters(dead_time));
      double time = random.uniform(0.0, 100.0);
      for (int step = 0; step < 15; ++step) {
        const double command = random.uniform(-3.0, 3.0), end = time + random.uniform(0.01, 0.3);
        coarse.update(time, command);
        for (int i = 0; i < 9; ++i) fine.update(time + (end - time) * i / 9.0, command);
        time = end;
      }
      EXPECT_NEAR(coarse.update(time, 0.0), fine.update(time, 0.0), 1e-11);
    }
  }
}

TEST(Servo, MatchesTinyEulerSteps) {
  test_support::Random random(2);
  for (const double dead_time : {0.0, 0.0371}) {
    for (int run = 0; run < 4; ++run) {
      std::vector<std::pair<double, double>> commands;
      Servod servo(parameters(dead_time));
      for (int i = 0; i < 6; ++i) {
        commands.emplace_back(0.05 * i, random.uniform(-3.0, 3.0));
        servo.update(commands.back().first, commands.back().second);
      }
      const double last = commands.back().second;
      EXPECT_NEAR(servo.update(0.35, last), simulate(parameters(dead_time), commands, 0.35), 2e-4);
    }
  }
}

TEST(Servo, MovesOnlyAfterTheDeadTime) {
  Servod servo(parameters(0.02));
  servo.update(0.0, 0.5);
  EXPECT_EQ(servo.update(0.0199, 0.5), 0.0);
  EXPECT_NEAR(servo.update(0.05, 0.5), 0.5 * -std::expm1(-0.03 / 0.08), 1e-14);
}

TEST(Servo, DeadTimeIsExactDownToDocumentedUpdateInterval) {
  // 63 commands wait for their dead time. Each command is exact.
  const double dead_time = 0.063, period = 0.001001;
  ServoParameters ideal = parameters(0.0);
  Servod delayed(parameters(dead_time)), prompt(ideal);
  const auto command = [](int i) { return 2.0 * std::sin(0.05 * i); };
  for (int i = 0; i < 1000; ++i) {
    delayed.update(i * period, command(i));
    prompt.update(i * period + dead_time, command(i));
    if (i * period > dead_time) {
      Servod copy = delayed;
      EXPECT_NEAR(copy.update(i * period + dead_time, 0.0), prompt.angle(), 1e-12);
    }
  }
}

TEST(Servo, FasterCommandsShortenDeadTimeByLessThanOneEntry) {
  // At 2 kHz with a dead time of 0.2 s, 400 commands share 64 entries.
  const double dead_time = 0.2, period = 0.0005;
  Servod delayed(parameters(dead_time)), late(parameters(0.0)), early(parameters(0.0));
  const double spacing = dead_time / 63.0 + period;
  const auto command = [](double time) {
    return time < 0.0 ? 0.0 : 1.5 * std::min(1.0, 2.0 * time);
  };
  for (int i = 0; i < 2000; ++i) {
    const double time = i * period;
    delayed.update(time, command(time));
    late.update(time, command(time - dead_time));
    early.update(time, command(time - dead_time + spacing));
    EXPECT_GE(delayed.angle(), late.angle() - 1e-9);
    EXPECT_LE(delayed.angle(), early.angle() + 1e-9);
  }
  EXPECT_NEAR(delayed.angle(), 1.5, 0.02);
}

TEST(Servo, KeepsRangeAndRateLimit) {
  test_support::Random random(3);
  Servod servo(parameters(0.01));
  servo.reset(9.0, 0.0);
  EXPECT_EQ(servo.angle(), 2.5);
  double time = 0.0;
  for (int i = 0; i < 10000; ++i) {
    const double step = random.uniform(0.0, 0.05), before = servo.angle();
    time += step;
    servo.update(time, random.uniform(-100.0, 100.0));
    EXPECT_GE(servo.angle(), -2.0);
    EXPECT_LE(servo.angle(), 2.5);
    EXPECT_LE(std::abs(servo.angle() - before), 8.0 * step + 1e-12);
  }
}

TEST(Servo, StartsAtNearestEndOfRangeWithoutZero) {
  ServoParameters p;
  p.min_angle = 0.5;
  EXPECT_EQ(Servod(p).angle(), 0.5);
}

TEST(Servo, IgnoresNonFiniteAndLateInput) {
  Servod servo(parameters(0.01)), undisturbed(parameters(0.01));
  for (Servod* s : {&servo, &undisturbed}) {
    s->update(0.0, 1.0);
    s->update(0.05, 0.3);
  }
  const double angle = servo.angle();
  for (const double bad : {nan, infinity, -infinity}) {
    EXPECT_EQ(servo.update(0.06, bad), angle);
    EXPECT_EQ(servo.update(bad, 0.4), angle);
  }
  EXPECT_EQ(servo.update(0.04, 0.4), angle);
  EXPECT_EQ(servo.update(0.2, 0.1), undisturbed.update(0.2, 0.1));
}

// The call that sets the clock back has no duration.
TEST(Servo, GoesOnAfterTheClockWasSetBack) {
  for (const double dead_time : {0.0, 0.025}) {
    Servod servo(parameters(dead_time)), undisturbed(parameters(dead_time));
    for (int i = 0; i < 100; ++i) {
      const double command = std::sin(0.3 * i);
      servo.update(0.01 * i + (i < 50 ? 100.0 : -1e3), command);
      undisturbed.update(0.01 * (i < 50 ? i : i - 1), command);
      EXPECT_NEAR(servo.angle(), undisturbed.angle(), 1e-9) << i;
    }
  }
}

TEST(Servo, KeepsRangeForRandomInput) {
  test_support::Random random(4);
  const std::vector<double> pool{nan,    infinity, -infinity, 0.0,  5e-324, 1e300,
                                 -1e300, 10.0,     -1.0,      1e-9, 0.5};
  const auto pick = [&] { return pool[static_cast<std::size_t>(random.uniform(0.0, 10.999))]; };
  Servod servo(parameters(0.1));
  const int calls = test_support::quick_or_full(200000, 1000000);
  for (int i = 0; i < calls; ++i) {
    if (i % 1000 == 0) servo.reset(pick(), pick());
    servo.update(pick(), pick());
    ASSERT_TRUE(servo.angle() >= -2.0 && servo.angle() <= 2.5) << i;
  }
}

TEST(Servo, ResetDiscardsWaitingCommands) {
  Servod servo(parameters(0.1));
  servo.update(0.0, 1.0);
  servo.reset(0.2, 0.05);
  EXPECT_EQ(servo.update(1.0, 0.2), 0.2);
}

TEST(Servo, FloatAndDualMatchDouble) {
  using Dual = test_support::Dual<1>;
  Servod servo(parameters(0.0));
  Servo<float> single(parameters(0.0));
  Servo<Dual> dual(parameters(0.0));
  servo.update(0.0, 1.0);
  single.update(0.0, 1.0F);
  dual.update(0.0, Dual(1.0, 1, 0));
  EXPECT_NEAR(single.update(0.2, 1.0F), servo.update(0.2, 1.0), 1e-6);
  const Dual angle = dual.update(0.2, Dual(1.0));
  EXPECT_NEAR(angle.value(), servo.angle(), 1e-15);
  Servod more(parameters(0.0));
  more.update(0.0, 1.0 + 1e-6);
  EXPECT_NEAR(angle.derivatives()(0), (more.update(0.2, 0.0) - servo.angle()) / 1e-6, 1e-5);
}

}  // namespace servo_test
