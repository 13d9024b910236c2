// Stamps of the IMU in the clock of the ticks.

#include "../../examples/support/imu_clock.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace examples {
namespace imu_clock_test {

// Samples at 1 kHz and a tick after every tenth.
class Clocks {
 public:
  double next(double imu_ahead, double all_ahead = 0.0) {
    time_ += 1e-3;
    const double found = clock_.on_sample(time_ + all_ahead + imu_ahead);
    if (++samples_ % 10 == 0) clock_.on_tick(time_ + all_ahead);
    return found - time_;
  }
  void pause(double duration) { time_ += duration; }
  ImuClock& clock() { return clock_; }

 private:
  ImuClock clock_;
  double time_ = 100.0;
  int samples_ = 0;
};

TEST(ImuClock, StampsAreKeptWhileTheyFollowTheTicks) {
  Clocks clocks;
  for (int i = 0; i < 100; ++i) EXPECT_EQ(clocks.next(0.0), 0.0);
  for (int i = 0; i < 100; ++i) EXPECT_NEAR(clocks.next(-0.015), -0.015, 1e-9);  // a latency
}

TEST(ImuClock, StepOfTheImuAloneIsRemoved) {
  for (const double step : {-1e6, -1.0, -0.05, 0.05, 1.0, 1e6}) {
    SCOPED_TRACE(step);
    Clocks clocks;
    for (int i = 0; i < 95; ++i) clocks.next(0.0);
    for (int i = 0; i < 95; ++i) EXPECT_NEAR(clocks.next(step), 0.0, 1e-6);
    for (int i = 0; i < 95; ++i) EXPECT_NEAR(clocks.next(0.0), 0.0, 1e-6);  // and back
  }
}

TEST(ImuClock, StepOfAllClocksIsKept) {
  for (const double step : {-1e4, -1.0, 1.0, 1e4}) {
    SCOPED_TRACE(step);
    Clocks clocks;
    for (int i = 0; i < 95; ++i) clocks.next(0.0);
    for (int i = 0; i < 10; ++i) clocks.next(0.0, step);  // until a tick has shown it
    for (int i = 0; i < 95; ++i) EXPECT_NEAR(clocks.next(0.0, step), step, 1e-9);
  }
}

TEST(ImuClock, PauseOfTheImuIsNoStep) {
  Clocks clocks;
  for (int i = 0; i < 95; ++i) clocks.next(0.0);
  clocks.pause(0.5);
  clocks.clock().on_tick(100.595);
  for (int i = 0; i < 95; ++i) EXPECT_EQ(clocks.next(0.0), 0.0);
}

TEST(ImuClock, WrongStampHasNoConsequence) {
  constexpr double infinite = std::numeric_limits<double>::infinity();
  for (const double wrong : {std::nan(""), infinite, -infinite, 1e300, 1e17, -1e9}) {
    SCOPED_TRACE(wrong);
    Clocks clocks;
    for (int i = 0; i < 95; ++i) clocks.next(0.0);
    (void)clocks.clock().on_sample(wrong);
    for (int i = 0; i < 3; ++i) clocks.next(0.0);
    for (int i = 0; i < 95; ++i) EXPECT_NEAR(clocks.next(0.0), 0.0, 0.005);
  }
}

}  // namespace imu_clock_test
}  // namespace examples
