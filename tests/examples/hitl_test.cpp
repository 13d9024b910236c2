// Hardware in the loop: the bad line, silence, and flights of the three programs over DDS on the
// loopback interface. They fly in lock step, and in a full run in real time.
// CTest: real_time dds

#include "../../examples/hitl/link.hpp"
#include "../../examples/hitl/message.hpp"
#include "support/background.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/full_run.hpp"
#include "support/program.hpp"
#include "support/wait_until.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <chrono>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <thread>
#include <vector>

namespace hitl_test {

using Eigen::Vector3d;
using Eigen::Vector4d;
using std::chrono::milliseconds;
using test_support::Background;
using test_support::wait_until;

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
    return wait_until([&] { return sender.publisher.subscribers() > 0 && inbox.sender_lives(); });
  }
  /// Takes until `done`. Returns the times of the messages.
  template <typename Done>
  static std::vector<double> take_until(WrenchInbox& inbox, const Done& done) {
    std::vector<double> times;
    EXPECT_TRUE(wait_until([&] {
      inbox.take(hitl::Clock::now(),
                 [&](const hitl::WrenchCommand& c) { times.push_back(c.time); });
      return done();
    }));
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
  ASSERT_TRUE(wait_until([&] { return second.publisher.subscribers() == 2; }));
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

// Best-effort readers are not told of messages that never arrive.
TEST_F(HitlInbox, CountsLossesByTheStamps) {
  hitl::Topic regular = topic();
  regular.period = 0.01;
  WrenchInbox inbox(participant_, regular, {}), irregular(participant_, topic(), {});
  const auto arrive = [&](Sender& sender, int count) {
    const long before = inbox.counts().received;
    sender.send(count);
    take_until(inbox, [&] { return inbox.counts().received == before + count; });
  };
  {
    Sender sender(domain_);
    ASSERT_TRUE(connected(sender, inbox) && connected(sender, irregular));
    arrive(sender, 10);
    sender.command.time += 0.03;  // three are lost
    arrive(sender, 10);
    EXPECT_EQ(inbox.counts().lost, 3);
    sender.command.time -= 0.1;  // the simulation has begun again
    arrive(sender, 10);
    EXPECT_EQ(inbox.counts().lost, 3);
  }
  Sender second(domain_);
  second.command.time = 77.0;
  ASSERT_TRUE(connected(second, inbox));
  arrive(second, 10);
  EXPECT_EQ(inbox.counts().lost, 3);
  take(irregular, 40);
  EXPECT_EQ(irregular.counts().lost, 0);
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

// A second sender that comes and goes: the first one, which never stopped, is heard again.
TEST_F(HitlInbox, HearsTheFormerSenderWhenTheNewerOneIsGone) {
  WrenchInbox inbox(participant_, topic(), {0.0, 0.0, 0.0, 1.0});
  Sender first(domain_), second(domain_);
  ASSERT_TRUE(connected(first, inbox));
  ASSERT_TRUE(wait_until([&] { return second.publisher.subscribers() > 0; }));
  const auto take_at = [&](double time, long arrivals) {
    return wait_until([&] {
      inbox.take(hitl::time_point(time), [](const hitl::WrenchCommand&) {});
      return inbox.counts().received + inbox.counts().late >= arrivals;
    });
  };
  first.send(1);
  EXPECT_TRUE(take_at(1.0, 1));
  second.send(1);
  EXPECT_TRUE(take_at(1.01, 2));
  first.send(1);
  EXPECT_TRUE(take_at(1.02, 3));
  EXPECT_EQ(inbox.counts().late, 1);  // the newer one counts
  first.send(1);
  EXPECT_TRUE(take_at(1.07, 4));  // the deadline is 50 ms
  EXPECT_EQ(inbox.counts().late, 1);
  EXPECT_EQ(inbox.counts().sessions, 3);
}

TEST_F(HitlInbox, InLockStepSilenceIsATimeOfTheSimulation) {
  WrenchInbox inbox(participant_, topic(), {0.0, 0.0, 0.0, 1.0});
  Sender sender(domain_);
  ASSERT_TRUE(connected(sender, inbox));
  const auto silent_at = [&](double time) {
    inbox.take(hitl::time_point(time), [](const hitl::WrenchCommand&) {});
    return inbox.silent();
  };
  EXPECT_TRUE(silent_at(1.0));
  sender.send(1);
  EXPECT_TRUE(wait_until([&] { return !silent_at(1.0); }));
  std::this_thread::sleep_for(milliseconds(100));  // the deadline is 50 ms
  EXPECT_FALSE(silent_at(1.049));
  EXPECT_TRUE(silent_at(1.051));
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

TEST_F(HitlFlight, FliesInLockStep) {
  Background onboard(HITL_ONBOARD_PROGRAM, "--lock-step 1", report("onboard"));
  Background flight(HITL_FLIGHT_CONTROLLER_PROGRAM, "--lock-step 1", report("flight"));
  Background vehicle(HITL_SIMULATOR_PROGRAM, "--lock-step 1 --until 20", report("vehicle"));
  const auto flown = vehicle.wait();
  const auto computed = onboard.wait(), commanded = flight.wait();
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LT(flown["final_position_error_m"], 0.01);
  EXPECT_LT(flown["takeoff_overshoot_m"], 0.01);
  EXPECT_LT(flown["air_rmse_m"], 0.005);
  EXPECT_NEAR(computed["onboard_ticks"], 2300, 100);  // without those before the first pose
  EXPECT_EQ(computed["onboard_missions"], 1);
  EXPECT_EQ(computed["onboard_solver_failures"], 0);
  EXPECT_EQ(commanded["wrench_sessions"], 1);
  EXPECT_EQ(commanded["wrench_silences"], 0);
}

TEST_F(HitlFlight, FliesOverLoopback) {
  if (!full_) GTEST_SKIP() << "in real time: only in the full run";
  Background onboard(HITL_ONBOARD_PROGRAM, "", report("onboard"));
  Background flight(HITL_FLIGHT_CONTROLLER_PROGRAM, "", report("flight"));
  Background vehicle(HITL_SIMULATOR_PROGRAM, "", report("vehicle"));
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
  const std::string line = "--loss 0.05 --spike-share 0.01 --spike 0.02 " +
                           std::string(full_ ? "" : "--lock-step 0.025 ");
  const auto start = [&](const char* program, const std::string& name) {
    return std::make_unique<Background>(program, line, report(name));
  };
  const dds::Participant participant(domain_);
  dds::Subscriber<rosgraph_msgs::msg::Clock> clock(participant, "/clock", {false, 1});
  double now = 0.0;  // time of the simulation; the mission begins at 3 s
  const auto reaches = [&](double time) {
    return wait_until([&] {
      clock.take([&](const rosgraph_msgs::msg::Clock& m) { now = loops::seconds(m.clock); });
      return now >= time;
    });
  };
  auto computer = start(HITL_ONBOARD_PROGRAM, "onboard_1"),
       controller = start(HITL_FLIGHT_CONTROLLER_PROGRAM, "flight_1"),
       vehicle = start(HITL_SIMULATOR_PROGRAM, "vehicle_1");
  EXPECT_TRUE(reaches(4.2));  // taking off
  vehicle->crash();
  vehicle = start(HITL_SIMULATOR_PROGRAM, "vehicle_2");
  EXPECT_TRUE(reaches(6.8));  // in the air
  computer->crash();
  EXPECT_TRUE(reaches(now + 0.2));
  computer = start(HITL_ONBOARD_PROGRAM, "onboard_2");
  EXPECT_TRUE(reaches(now + 0.9));
  controller->crash();
  EXPECT_TRUE(reaches(now + 0.1));
  controller = start(HITL_FLIGHT_CONTROLLER_PROGRAM, "flight_2");
  EXPECT_TRUE(reaches(now + 2.0));
  const auto flown = full_ ? vehicle->wait() : vehicle->stop();
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LT(flown["final_position_error_m"], 0.1) << flown.output;
  // While a program starts, which takes longer on a busy machine, the vehicle flies without it.
  EXPECT_LT(flown["mission_rmse_m"], full_ ? 0.05 : 0.5) << flown.output;
  EXPECT_EQ(flown["actuators_sessions"], 2) << flown.output;
  EXPECT_GT(flown["actuators_lost"], 0);
  EXPECT_GT(flown["actuators_late"], 0);
  const auto computed = computer->wait(), commanded = controller->wait();
  EXPECT_EQ(computed["onboard_missions"], 1) << computed.output;
  EXPECT_EQ(computed["onboard_solver_failures"], 0) << computed.output;
  EXPECT_EQ(commanded["wrench_sessions"], 1) << commanded.output;
  const std::string before = test_support::read_file(report("flight_1"));
  EXPECT_NE(before.find("hitl_onboard is "), std::string::npos) << before;  // silent or gone
}

TEST_F(HitlFlight, ReportsMissingProgramsAndASecondOne) {
  Background first(HITL_ONBOARD_PROGRAM, "", report("first"));
  ASSERT_TRUE(wait_until([&] {
    return test_support::read_file(report("first")).find("waiting") != std::string::npos;
  }));
  // The simulator waits for 3 s. After this time the first program looks for no other.
  const auto alone = test_support::run(HITL_SIMULATOR_PROGRAM, "");
  EXPECT_EQ(alone.exit_code, 1);
  EXPECT_TRUE(alone.says("hitl_onboard and hitl_flight_controller running?")) << alone.output;
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
    EXPECT_TRUE(help.says("--spike-share") && help.says("--lock-step"));
    EXPECT_GT(test_support::run(program, "--loss 2").exit_code, 100);
    setenv("ROS_DOMAIN_ID", "nowhere", 1);
    const auto bad = test_support::run(program, "");
    EXPECT_EQ(bad.exit_code, 1);
    EXPECT_TRUE(bad.says("ROS_DOMAIN_ID = nowhere: must be 0 to 230")) << bad.output;
    test_support::dds_on_loopback();
  }
}

}  // namespace hitl_test
