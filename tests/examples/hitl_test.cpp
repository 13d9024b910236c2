// Hardware in the loop: the bad line, silence, and flights of the three programs over DDS on the
// loopback interface.
// CTest: real_time dds

#include "../../examples/hitl/link.hpp"
#include "../../examples/hitl/message.hpp"
#include "support/background.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <chrono>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <thread>
#include <vector>

namespace {

using Eigen::Vector3d;
using Eigen::Vector4d;
using std::chrono::milliseconds;
using test_support::Background;

// The DDS domain depends on the process id, so that test processes can run at the same time.

using Wrench = tilt_ropter_msgs::msg::WrenchCommand;
using WrenchInbox = hitl::Inbox<Wrench>;

class HitlInbox : public testing::Test {
 protected:
  /// A sender as a program of its own would be.
  struct Sender {
    explicit Sender(std::uint32_t domain)
        : participant(domain),
          publisher(participant, hitl::wrench_command_topic.name,
                    hitl::wrench_command_topic.offered()) {}
    void send(int count, double force = 1.0) {
      for (int i = 0; i < count; ++i) {
        command.time += 0.01;
        command.wrench.force.x() = force;
        publisher.publish(encoder.encode(command));
      }
    }
    dds::Participant participant;
    dds::Publisher<Wrench> publisher;
    hitl::Encoder encoder;
    hitl::WrenchCommand command;
  };

  [[nodiscard]] hitl::Topic topic() const {
    hitl::Topic deep = hitl::wrench_command_topic;
    deep.depth = 1000;
    return deep;
  }
  /// Waits until `sender` and `inbox` know each other.
  static bool connected(const Sender& sender, const WrenchInbox& inbox) {
    for (int i = 0; i < 1000; ++i) {
      if (sender.publisher.subscribers() > 0 && inbox.sender_lives()) return true;
      std::this_thread::sleep_for(milliseconds(10));
    }
    return false;
  }
  /// Takes until `done`, at most for 5 s. Returns the times of the messages.
  template <typename Done>
  static std::vector<double> take_until(WrenchInbox& inbox, const Done& done) {
    std::vector<double> times;
    for (int i = 0; i < 1000; ++i) {
      inbox.take(hitl::Clock::now(),
                 [&](const hitl::WrenchCommand& c) { times.push_back(c.time); });
      if (done()) break;
      std::this_thread::sleep_for(milliseconds(5));
    }
    return times;
  }
  /// Takes until this number of messages has come in any way.
  static std::vector<double> take(WrenchInbox& inbox, long arrivals) {
    return take_until(inbox, [&] {
      const hitl::ArrivalCounts c = inbox.counts();
      return c.received + c.lost + c.late + c.rejected >= arrivals;
    });
  }
  static bool becomes_silent(WrenchInbox& inbox) {
    take_until(inbox, [&] { return inbox.silent(); });
    return inbox.silent();
  }
  static bool is_heard_again(WrenchInbox& inbox) {
    take_until(inbox, [&] { return !inbox.silent(); });
    return !inbox.silent();
  }

  const std::uint32_t domain_ = test_support::dds_on_loopback();
  dds::Participant participant_{domain_};
};

TEST_F(HitlInbox, CountsSessionsReceivedAndLostMessages) {
  WrenchInbox clean(participant_, topic(), {}), lossy(participant_, topic(), {0.3, 0.0, 0.0});
  {
    Sender first(domain_);
    ASSERT_TRUE(connected(first, clean) && connected(first, lossy));
    first.send(10);
    EXPECT_EQ(take(clean, 10).size(), 10U);
    take(lossy, 10);
  }
  Sender second(domain_);
  for (int i = 0; i < 200 && second.publisher.subscribers() < 2; ++i)
    std::this_thread::sleep_for(milliseconds(10));
  ASSERT_TRUE(connected(second, clean) && connected(second, lossy));
  second.send(300);
  EXPECT_EQ(take(clean, 310).size(), 300U);
  const auto got = static_cast<double>(take(lossy, 310).size());
  EXPECT_NEAR(got, 210.0, 40.0);
  EXPECT_EQ(clean.counts().sessions, 2);  // the sender was restarted
  EXPECT_EQ(clean.counts().received, 310);
  EXPECT_EQ(clean.counts().lost + clean.counts().late + clean.counts().rejected, 0);
  EXPECT_EQ(lossy.counts().sessions, 2);
  EXPECT_EQ(lossy.counts().received + lossy.counts().lost, 310);
  EXPECT_NEAR(static_cast<double>(lossy.counts().lost), 93.0, 45.0);
  EXPECT_EQ(lossy.counts().late, 0);
}

TEST_F(HitlInbox, DropsDelayedMessagesThatNewerOnesOvertook) {
  WrenchInbox some(participant_, topic(), {0.0, 0.5, 0.05}),
      all(participant_, topic(), {0.0, 1.0, 0.05});
  Sender sender(domain_);
  ASSERT_TRUE(connected(sender, some) && connected(sender, all));
  sender.send(100);
  const auto sent = hitl::Clock::now();
  std::this_thread::sleep_for(milliseconds(10));
  all.take(sent, [](const hitl::WrenchCommand&) { FAIL() << "nothing is in time"; });
  const auto delayed = take(all, 100), times = take(some, 100);
  EXPECT_TRUE(std::is_sorted(times.begin(), times.end()));
  EXPECT_LT(times.size(), 80U);
  const hitl::ArrivalCounts counts = some.counts();
  EXPECT_GT(counts.late, 20);
  EXPECT_EQ(counts.received + counts.late, 100);
  EXPECT_EQ(counts.lost, 0);
  EXPECT_EQ(delayed.size(), 100U);  // none overtook another
}

TEST_F(HitlInbox, CountsAndDropsUnusableMessages) {
  WrenchInbox inbox(participant_, topic(), {});
  Sender sender(domain_);
  ASSERT_TRUE(connected(sender, inbox));
  sender.send(1);
  sender.send(3, std::numeric_limits<double>::quiet_NaN());
  sender.send(1);
  EXPECT_EQ(take(inbox, 5).size(), 2U);
  EXPECT_EQ(inbox.counts().rejected, 3);
}

TEST_F(HitlInbox, SaysWhenTheSenderIsSilent) {
  WrenchInbox inbox(participant_, topic(), {}), deaf(participant_, topic(), {1.0, 0.0, 0.0});
  EXPECT_FALSE(inbox.sender_lives());
  std::optional<Sender> sender(std::in_place, domain_);
  ASSERT_TRUE(connected(*sender, inbox) && connected(*sender, deaf));
  EXPECT_TRUE(inbox.silent());  // nothing came yet
  sender->send(1);
  EXPECT_TRUE(is_heard_again(inbox));
  take(deaf, 1);
  EXPECT_TRUE(deaf.silent());  // DDS hears the sender, but the line takes all away
  EXPECT_TRUE(becomes_silent(inbox));
  EXPECT_TRUE(inbox.sender_lives());
  sender->send(1);
  EXPECT_TRUE(is_heard_again(inbox));
  sender.reset();  // the sender ends: DDS no longer watches its deadline
  EXPECT_TRUE(becomes_silent(inbox));
  EXPECT_FALSE(inbox.sender_lives());
}

TEST_F(HitlInbox, RejectsADomainThatDoesNotExist) {
  setenv("ROS_DOMAIN_ID", "233", 1);
  EXPECT_THROW((void)loops::ros_domain(), std::runtime_error);
}

// ---- Flights

class HitlFlight : public testing::Test {
 protected:
  [[nodiscard]] std::string report(const std::string& name) const { return directory_.file(name); }

  const std::uint32_t domain_ = test_support::dds_on_loopback();  // also of the programs
  const bool full_ = test_support::full_run();
  test_support::Directory directory_{"hitl"};
};

// A full run flies the whole mission; otherwise the flight ends after 4 s (take-off).
// Test machines are busy, so that only a full run checks deadlines.
TEST_F(HitlFlight, FliesOverLoopback) {
  Background onboard(HITL_ONBOARD_PROGRAM, "", report("onboard"));
  Background flight(HITL_FLIGHT_CONTROLLER_PROGRAM, "", report("flight"));
  Background vehicle(HITL_SIMULATOR_PROGRAM, full_ ? "" : "--until 4", report("vehicle"));
  const auto flown = vehicle.wait();
  const auto computed = onboard.wait(), commanded = flight.wait();
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LT(flown["final_position_error_m"], 0.03);
  EXPECT_LT(flown["takeoff_overshoot_m"], 0.05);
  EXPECT_GT(flown["round_trip_median_us"], 10.0);
  EXPECT_LT(flown["round_trip_median_us"], 10000.0);
  EXPECT_EQ(computed["onboard_missions"], 1);
  EXPECT_GT(computed["onboard_ticks"], 600);
  EXPECT_EQ(computed["onboard_solver_failures"], 0);
  EXPECT_EQ(commanded["wrench_sessions"], 1);
  if (!full_) return;
  EXPECT_LT(computed["onboard_deadline_misses"], 1e-3 * computed["onboard_ticks"]);
  EXPECT_LE(flown["air_rmse_m"], 1.2 * 0.0030);
  EXPECT_LE(flown["ground_rmse_m"], 1.2 * 0.0083);
  EXPECT_LE(flown["mission_rmse_m"], 1.2 * 0.0098);
  EXPECT_GE(flown["power_saved_percent"], 92.8);
}

TEST_F(HitlFlight, FliesInMujoco) {
  const auto fly = [&](const std::string& options) {
    return test_support::run(HITL_SIMULATOR_PROGRAM, "--plant mujoco " + options);
  };
#ifdef MISSION_MUJOCO_PROGRAM
  if (!full_) GTEST_SKIP() << "only in the full run";
  Background onboard(HITL_ONBOARD_PROGRAM, "", report("onboard"));
  Background flight(HITL_FLIGHT_CONTROLLER_PROGRAM, "", report("flight"));
  const auto flown = fly("");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_EQ(onboard.wait()["onboard_solver_failures"], 0);
  EXPECT_EQ(flight.wait()["wrench_sessions"], 1);
  EXPECT_LT(flown["air_rmse_m"], 0.02);
  EXPECT_LT(flown["ground_rmse_m"], 0.03);
#else
  const auto refused = fly("");
  EXPECT_EQ(refused.exit_code, 1);
  EXPECT_TRUE(refused.says("built without MuJoCo")) << refused.output;
#endif
}

TEST_F(HitlFlight, SurvivesABadLineAndTheRestartOfEachProgram) {
  const std::string bad = "--loss 0.05 --spike-share 0.01 --spike 0.02 ";
  const auto onboard = [&] {
    return std::make_unique<Background>(HITL_ONBOARD_PROGRAM, bad, report("onboard"));
  };
  const auto flight = [&] {
    return std::make_unique<Background>(HITL_FLIGHT_CONTROLLER_PROGRAM, bad, report("flight"));
  };
  const auto seconds = [](double s) {
    std::this_thread::sleep_for(milliseconds(static_cast<int>(1000.0 * s)));
  };
  auto computer = onboard(), controller = flight();
  {
    Background first(HITL_SIMULATOR_PROGRAM, bad + "--until 100", report("first"));
    seconds(4.2);  // taking off
    first.crash();
  }
  Background vehicle(HITL_SIMULATOR_PROGRAM, bad + (full_ ? "" : "--until 6"), report("vehicle"));
  seconds(3.0 + 3.8);  // in the air
  computer->crash();
  seconds(0.2);
  computer = onboard();
  seconds(0.9);
  controller->crash();
  seconds(0.1);
  controller = flight();
  const auto flown = vehicle.wait();
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LT(flown["final_position_error_m"], 0.1) << flown.output;
  EXPECT_EQ(flown["actuators_sessions"], 2) << flown.output;
  EXPECT_GT(flown["actuators_lost"], 0);
  EXPECT_GT(flown["actuators_late"], 0);
  const auto computed = computer->wait(), commanded = controller->wait();
  EXPECT_EQ(computed["onboard_missions"], 1) << computed.output;
  EXPECT_EQ(computed["onboard_solver_failures"], 0) << computed.output;
  EXPECT_EQ(commanded["wrench_sessions"], 1) << commanded.output;
  if (full_) {
    EXPECT_LT(flown["mission_rmse_m"], 0.05) << flown.output;
  }
}

TEST_F(HitlFlight, ReportsMissingProgramsAndASecondOne) {
  const auto alone = test_support::run(HITL_SIMULATOR_PROGRAM, "");
  EXPECT_EQ(alone.exit_code, 1);
  EXPECT_TRUE(alone.says("hitl_onboard and hitl_flight_controller running?")) << alone.output;
  Background first(HITL_ONBOARD_PROGRAM, "", report("first"));
  std::this_thread::sleep_for(milliseconds(1300));  // later than it looks for others
  const auto second = test_support::run(HITL_ONBOARD_PROGRAM, "");
  EXPECT_EQ(second.exit_code, 1);
  EXPECT_TRUE(
      second.says("another program of this kind runs in DDS domain " + std::to_string(domain_)))
      << second.output;
  EXPECT_EQ(first.stop().exit_code, 0);  // it went on
}

TEST_F(HitlFlight, HelpAndBadArguments) {
  EXPECT_GT(test_support::run(HITL_SIMULATOR_PROGRAM, "--plant nowhere").exit_code, 100);
  for (const char* program :
       {HITL_SIMULATOR_PROGRAM, HITL_ONBOARD_PROGRAM, HITL_FLIGHT_CONTROLLER_PROGRAM}) {
    const auto help = test_support::run(program, "--help");
    EXPECT_EQ(help.exit_code, 0);
    EXPECT_TRUE(help.says("--spike-share"));
    EXPECT_GT(test_support::run(program, "--loss 2").exit_code, 100);
    setenv("ROS_DOMAIN_ID", "nowhere", 1);
    const auto bad = test_support::run(program, "");
    EXPECT_EQ(bad.exit_code, 1);
    EXPECT_TRUE(bad.says("ROS_DOMAIN_ID = nowhere: must be 0 to 232")) << bad.output;
    test_support::dds_on_loopback();
  }
}

}  // namespace
