#pragma once

#include "../../examples/integrations/messages.hpp"
#include "../../examples/integrations/node.hpp"
#include "../../examples/integrations/real_time.hpp"
#include "background.hpp"
#include "dds_on_loopback.hpp"
#include "full_run.hpp"
#include "ros2_vehicle.hpp"
#include "wait_until.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <functional>
#include <string>

/// Flights of the nodes over DDS.
namespace test_support {

/// Root mean square of a distance.
struct Rmse {
  double sum = 0.0;
  int count = 0;
  void add(const Eigen::Vector3d& error) {
    sum += error.squaredNorm();
    ++count;
  }
  [[nodiscard]] double value() const { return std::sqrt(sum / std::max(1, count)); }
};

/// The topics of ros2_node, seen from the vehicle.
class Ros2Line {
 public:
  explicit Ros2Line(const dds::Participant& participant, const std::string& space = "")
      : imu_(participant, space + "imu"),
        pose_(participant, space + "motion_capture/pose"),
        speeds_(participant, space + "rotor_speeds"),
        actuators_(participant, space + "actuators") {}

  [[nodiscard]] bool connected() const {
    return imu_.subscribers() == 1 && pose_.subscribers() == 1 && speeds_.subscribers() == 1 &&
           actuators_.publishers() == 1;
  }
  void on_imu(const sensor_msgs::msg::Imu& m) { imu_.publish(m); }
  void on_pose(const geometry_msgs::msg::PoseStamped& m) { pose_.publish(m); }
  void on_rotor_speeds(const sensor_msgs::msg::JointState& m) { speeds_.publish(m); }

  /// Publishes the measurements of this millisecond.
  void sense() { vehicle.sense(*this); }
  void take() {
    actuators_.take([&](const actuator_msgs::msg::Actuators& m) { vehicle.on_command(m); });
  }
  [[nodiscard]] bool heard() const { return vehicle.commands > 0; }
  /// Whether the command of this tick has arrived.
  [[nodiscard]] bool answered() const {
    return heard() && vehicle.command_stamp == loops::seconds(loops::stamp(vehicle.now()));
  }

  Ros2Vehicle vehicle{1000000000LL};

 private:
  dds::Publisher<sensor_msgs::msg::Imu> imu_;
  dds::Publisher<geometry_msgs::msg::PoseStamped> pose_;
  dds::Publisher<sensor_msgs::msg::JointState> speeds_;
  dds::Subscriber<actuator_msgs::msg::Actuators> actuators_;
};

/// A clock and a domain for a node that is a process of its own.
class DdsFlight : public testing::Test {
 protected:
  /// Flies on in simulated time until `enough()`, which is asked in every tick. Time stands still
  /// until the tick is answered. Before its first measurement a node does not answer; then the
  /// vehicle waits for 20 ms, and nothing is counted. Once a second the clock skips a tick.
  template <typename Line>
  void lock_step(Line& line, const std::function<bool()>& enough) {
    const long end = std::lround(1000.0 * line.vehicle.plant.time()) + 60000;
    for (long i = end - 60000;; ++i) {
      ASSERT_LT(i, end) << "the flight does not end";
      line.sense();
      if (i % 1000 == 500) {
        ++skipped_;
      } else if (i % 10 == 0) {
        clock_.publish({loops::stamp(line.vehicle.now())});
        ++published_;
        const auto answered = [&] {
          line.take();
          return line.answered();
        };
        if (line.heard()) {
          ASSERT_TRUE(wait_until(answered)) << "no answer at " << line.vehicle.plant.time() << " s";
          ++answered_;
        } else {
          answered_ += wait_until(answered, std::chrono::milliseconds(20)) ? 1 : 0;
        }
        if (enough()) return;
      }
      ASSERT_TRUE(line.vehicle.step());
    }
  }
  /// A node ran every tick that was answered, and no other tick than those of the clock. Before its
  /// first measurement it may have missed some.
  void expect_ticks_of_the_clock(const Outcome& flown) const {
    EXPECT_EQ(flown.exit_code, 0) << flown.output;
    EXPECT_GE(flown["ticks"], answered_);
    EXPECT_LE(flown["ticks"] + flown["late_ticks"], published_ + skipped_);
  }

  /// Flies in real time: one step every millisecond. After a pause it catches up.
  template <typename Line>
  static void in_real_time(Line& line, double seconds, const std::function<void()>& each) {
    line.vehicle.start = loops::system_time_ns();
    const std::int64_t start = loops::now_ns();
    for (std::int64_t i = 0; i < std::llround(1000.0 * seconds); ++i) {
      while (!loops::sleep_until(start + i * 1000000)) continue;
      line.sense();
      line.take();
      ASSERT_TRUE(line.vehicle.step());
      each();
    }
  }
  /// Sends measurements with stamps of the system clock until `enough()`.
  template <typename Line>
  static bool on_the_system_clock(Line& line, const std::function<bool()>& enough) {
    return wait_until([&] {
      line.vehicle.start += loops::system_time_ns() - line.vehicle.now();
      line.sense();
      line.take();
      return !line.vehicle.step() || enough();
    });
  }

  const bool full_ = full_run();
  const std::uint32_t domain_ = dds_on_loopback();
  Directory directory_{"dds_flight"};
  dds::Participant participant_{domain_};
  dds::Publisher<rosgraph_msgs::msg::Clock> clock_{participant_, "/clock"};
  int published_ = 0, skipped_ = 0, answered_ = 0;  // ticks
};

}  // namespace test_support
