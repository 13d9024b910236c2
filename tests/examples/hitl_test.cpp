// Hardware in the loop: flights of the three programs over DDS on the loopback interface, in lock
// step, and in a full run in real time.
// CTest: real_time dds

#include "../../examples/integrations/dds.hpp"
#include "../../examples/integrations/messages.hpp"
#include "support/background.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/full_run.hpp"
#include "support/program.hpp"
#include "support/wait_until.hpp"

#include <gtest/gtest.h>

#include <cstdint>
#include <cstdlib>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

namespace hitl_test {

using test_support::Background;
using test_support::wait_until;

class HitlFlight : public testing::Test {
 protected:
  [[nodiscard]] std::string report(const std::string& name) const { return directory_.file(name); }
  void survive_restarts(const std::string& options, bool to_the_end);

  struct Told {
    test_support::Outcome vehicle, onboard, flight_controller;
  };
  /// Flies with `options` of all three programs and `more` of the simulator.
  [[nodiscard]] Told fly(const std::string& options, const std::string& more = "") const {
    Background onboard(HITL_ONBOARD_PROGRAM, options, report("onboard"));
    Background flight(HITL_FLIGHT_CONTROLLER_PROGRAM, options, report("flight"));
    Background vehicle(HITL_SIMULATOR_PROGRAM, options + more, report("vehicle"));
    const auto flown = vehicle.wait();
    return {flown, onboard.wait(), flight.wait()};
  }

  const std::uint32_t domain_ = test_support::dds_on_loopback();  // also of the programs
  const bool full_ = test_support::full_run();
  test_support::Directory directory_{"hitl"};
};

TEST_F(HitlFlight, FliesInLockStep) {
  const auto [flown, computed, commanded] = fly("--lock-step 1", " --until 20");
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

TEST_F(HitlFlight, FliesEveryVehicleInLockStep) {
  std::vector<std::string> names = {"octocopter", "tricopter"};
  if (full_) {
    names.clear();
    for (const auto& entry : std::filesystem::directory_iterator(VEHICLES_DIR))
      if (entry.path().extension() == ".json") names.push_back(entry.path().stem());
  }
  for (const std::string& name : names) {
    SCOPED_TRACE(name);
    const auto [flown, computed, commanded] =
        fly("--lock-step 1 --vehicle '" VEHICLES_DIR "/" + name + ".json'", " --until 15");
    ASSERT_EQ(flown.exit_code, 0) << flown.output;
    EXPECT_LT(flown["air_rmse_m"], 0.008);
    EXPECT_EQ(computed["onboard_missions"], 1);
    EXPECT_EQ(computed["onboard_solver_failures"], 0);
    EXPECT_EQ(commanded["wrench_sessions"] + commanded["actuator_command_sessions"], 1);
    EXPECT_EQ(commanded["wrench_silences"], 0);
  }
}

TEST_F(HitlFlight, FliesOverLoopback) {
  if (!full_) GTEST_SKIP() << "in real time: only in the full run";
  const auto [flown, computed, commanded] = fly("");
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

// Each program is killed once in flight and started again.
void HitlFlight::survive_restarts(const std::string& options, bool to_the_end) {
  const std::string line = options + " --loss 0.05 --spike-share 0.01 --spike 0.02 " +
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
  const auto flown = to_the_end ? vehicle->wait() : vehicle->stop();
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LT(flown["final_position_error_m"], 0.1) << flown.output;
  // While a program starts, which takes longer on a busy machine, the vehicle flies without it.
  EXPECT_LT(flown["mission_rmse_m"], to_the_end ? 0.05 : 0.5) << flown.output;
  EXPECT_EQ(flown["actuators_sessions"], 2) << flown.output;
  EXPECT_GT(flown["actuators_lost"], 0);
  EXPECT_GT(flown["actuators_late"], 0);
  const auto computed = computer->wait(), commanded = controller->wait();
  EXPECT_EQ(computed["onboard_missions"], 1) << computed.output;
  EXPECT_EQ(computed["onboard_solver_failures"], 0) << computed.output;
  EXPECT_EQ(commanded["wrench_sessions"] + commanded["actuator_command_sessions"], 1)
      << commanded.output;
  const std::string before = test_support::read_file(report("flight_1"));
  EXPECT_NE(before.find("hitl_onboard is "), std::string::npos) << before;  // silent or gone
}

TEST_F(HitlFlight, SurvivesABadLineAndTheRestartOfEachProgram) {
  survive_restarts("", full_);
}

TEST_F(HitlFlight, SurvivesThemByLeaning) {
  if (!full_) GTEST_SKIP() << "only in the full run";
  survive_restarts("--vehicle '" VEHICLES_DIR "/quadrotor.json'", false);
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
