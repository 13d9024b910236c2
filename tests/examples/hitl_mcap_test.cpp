// The MCAP file of hitl_simulator, in lock step.
// CTest: real_time dds

#include "support/background.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/mcap_reader.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <string>

namespace hitl_mcap_test {

using test_support::Background;

TEST(HitlMcap, HoldsTheVehicleItsSensorsAndItsCommands) {
  test_support::dds_on_loopback();
  const test_support::Directory directory("hitl_mcap");
  const std::string file = directory.file("flight.mcap");
  Background onboard(HITL_ONBOARD_PROGRAM, "--lock-step 1", directory.file("onboard")),
      flight(HITL_FLIGHT_CONTROLLER_PROGRAM, "--lock-step 1", directory.file("flight")),
      vehicle(HITL_SIMULATOR_PROGRAM, "--lock-step 1 --until 6 --mcap '" + file + "'",
              directory.file("vehicle"));
  const auto flown = vehicle.wait();
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  (void)onboard.wait();
  (void)flight.wait();
  const auto log = test_support::McapReader::read(test_support::read_file(file));
  EXPECT_NEAR(static_cast<double>(log.of("/imu").size()), 9000.0, 10.0);  // from 3 s before
  EXPECT_TRUE(log.of("/odometry").empty());  // the simulator does not know the estimate
  const auto truth = log.of("/ground_truth/odometry"), wanted = log.of("/reference"),
             speeds = log.of("/rotor_speeds"), commands = log.of("/rotor_speed_commands");
  ASSERT_EQ(truth.size(), wanted.size());
  EXPECT_NEAR(static_cast<double>(truth.size()), 900.0, 2.0);
  EXPECT_NEAR(truth.back().numbers.at("pose.pose.position.z"),
              wanted.back().numbers.at("pose.position.z"), 0.02);
  EXPECT_GT(wanted.back().numbers.at("pose.position.z"), 0.5);  // it has taken off
  EXPECT_NEAR(speeds.back().numbers.at("velocity[3]"), commands.back().numbers.at("velocity[3]"),
              50.0);
  EXPECT_EQ(log.of("/flight_mode").front().texts.at("data"), "silent");
  EXPECT_EQ(log.of("/flight_mode").back().texts.at("data"), "commanded");
  EXPECT_EQ(log.of("/phase").front().texts.at("data"), "waiting");
}

}  // namespace hitl_mcap_test
