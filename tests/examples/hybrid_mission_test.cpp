// Runs the program hybrid_mission as a user does and checks the figures that it prints.
// CTest: flight one_process

#include "support/full_run.hpp"
#include "support/program.hpp"
#include "support/vehicle_files.hpp"

#include "../../examples/support/csv.hpp"
#include "../../examples/support/hybrid_experiment.hpp"
#include "../../examples/support/loss_watch.hpp"

#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <sstream>
#include <string>

namespace hybrid_mission_test {

struct Flight : test_support::Outcome {
  std::string csv;
  int pictures = 0;
};

Flight run(const std::string& arguments) {
  const test_support::Directory directory("hybrid_mission");
  Flight result{test_support::run(HYBRID_MISSION_PROGRAM,  // set by CMake
                                  "--output '" + directory.file("") + "' " + arguments),
                {}};
  result.csv = test_support::read_file(directory.file("hybrid_mission.csv"));
  for (const auto& entry : std::filesystem::directory_iterator(directory.file("")))
    if (entry.path().extension() == ".png" && entry.file_size() > 10000) ++result.pictures;
  return result;
}

const Flight& flown() {
  static const Flight result = run("--no-pictures --seed 1");
  return result;
}

TEST(HybridMission, TrackingErrorIsBelowTheLimitsAndThePaper) {
  ASSERT_EQ(flown().exit_code, 0) << flown().output;
  EXPECT_LE(flown()["air_rmse_m"], 0.0025);
  EXPECT_LE(flown()["ground_rmse_m"], 0.005);
  EXPECT_LE(flown()["mission_rmse_m"], 0.006);
  EXPECT_DOUBLE_EQ(flown()["paper_air_rmse_m"], 0.052);
  EXPECT_DOUBLE_EQ(flown()["paper_ground_rmse_m"], 0.145);
  EXPECT_DOUBLE_EQ(flown()["paper_mission_rmse_m"], 0.125);
}

TEST(HybridMission, SavesAtLeastThePowerSavedInThePaper) {
  EXPECT_GE(flown()["power_saved_percent"], 92.8);
  EXPECT_NEAR(flown()["flight_power_w"], 653.64, 20.0);
  EXPECT_GT(flown()["ground_power_w"], 20.0);  // at least the electronics
}

// The energy is the integral of the logged power. Voltage and current are those of the battery.
TEST(HybridMission, ReportsAndLogsTheBattery) {
  std::istringstream text(flown().csv);
  const examples::CsvTable log =
      examples::read_csv(text, "log", {"power_w", "voltage_v", "current_a"});
  double energy = 0.0, charge = 0.0, least = 100.0, most = 0.0;
  for (std::size_t i = 0; i < log.rows(); ++i) {
    const double power = log["power_w"][i], voltage = log["voltage_v"][i],
                 current = log["current_a"][i];
    ASSERT_NEAR(voltage * current, power, 1e-4 * power);
    energy += 0.01 * power / 3600.0;
    charge += 0.01 * current / 3600.0;
    least = std::min(least, voltage);
    most = std::max(most, current);
  }
  EXPECT_NEAR(flown()["energy_Wh"], energy, 0.01 * energy);
  EXPECT_LE(flown()["min_voltage_V"], least + 0.005);
  EXPECT_GE(flown()["max_current_A"], most - 0.05);
  EXPECT_GT(most, 653.64 / 16.8);
  EXPECT_NEAR(flown()["battery_used_percent"], 100.0 * charge / 5.3, 0.1);
  EXPECT_GT(flown()["endurance_ground_min"], 10.0 * flown()["endurance_air_min"]);
  EXPECT_NEAR(flown()["endurance_air_min"], 0.8 * 60.0 * 79.5 / 653.64, 0.5);
}

// The same vehicle flies with a battery that is almost empty, with less voltage and more current.
TEST(HybridMission, FliesWithAnAlmostEmptyBattery) {
  const Flight flight = run("--mission air --no-pictures --battery-charge 0.2"),
               full = run("--mission air --no-pictures");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_LT(flight["min_voltage_V"], full["min_voltage_V"] - 1.0);
  EXPECT_GT(flight["max_current_A"], full["max_current_A"] + 1.0);
  EXPECT_LE(flight["air_rmse_m"], 0.003);
}

// The battery gives 16 V. If the rotors reach their top speeds at 26 V, 38 % of the thrust is left,
// 1.2 times the weight; at 30 V less than the weight.
TEST(HybridMission, ThrustFallsWithTheVoltage) {
  const test_support::Directory directory("sagging");
  const std::string path = directory.file("vehicle.json");
  ASSERT_EQ(test_support::run(HYBRID_MISSION_PROGRAM, "--write-vehicle '" + path + "'").exit_code,
            0);
  const std::string good = test_support::read_file(path), find = "\"battery_nominal_v\": 13.2";
  ASSERT_NE(good.find(find), std::string::npos);
  const auto fly = [&](const std::string& nominal) {
    std::string text = good;
    text.replace(good.find(find), find.size(), "\"battery_nominal_v\": " + nominal);
    std::ofstream(path) << text;
    return run("--mission air --no-pictures --vehicle '" + path + "'");
  };
  EXPECT_LE(fly("26")["air_rmse_m"], 0.02);
  EXPECT_GT(fly("30")["mission_rmse_m"], 0.5);
}

TEST(HybridMission, LandsAndTakesOffTwiceAndGently) {
  EXPECT_LE(flown()["touchdown_speed_mps"], 0.3);
  EXPECT_GT(flown()["touchdown_speed_mps"], 0.0);
  EXPECT_LE(flown()["takeoff_overshoot_m"], 0.05);
  EXPECT_EQ(flown()["contact_mode_changes"], 4);  // two take-offs, two landings
}

TEST(HybridMission, SolverNeverFails) {
  EXPECT_EQ(flown()["solver_failures"], 0);
  EXPECT_GT(flown()["nmpc_median_us"], 0.0);
}

// Two rates are checked: the tilt rate of the commanded wrench (planned), and the speed at which
// the servos must start towards their commands. A full run compares them with those of a flight
// without the actuator constraints.
TEST(HybridMission, ServoRatesStayWithinLimitWithoutWorseTracking) {
  EXPECT_LE(flown()["planned_tilt_rate_max_radps"], 0.85 * 8.0 + 0.005);
  EXPECT_LE(flown()["tilt_rate_max_radps"], flown()["servo_speed_radps"]);
  EXPECT_EQ(flown()["tilt_rate_exceeded_share"], 0.0);

  if (!test_support::full_run()) return;
  const Flight boxes = run("--no-pictures --no-actuator-rows");
  ASSERT_EQ(boxes.exit_code, 0) << boxes.output;
  EXPECT_GT(boxes["planned_tilt_rate_max_radps"], 12.0);
  // With estimated states these servos can follow even without the actuator constraints; slower
  // servos cannot.
  EXPECT_GE(boxes["tilt_rate_max_radps"], flown()["tilt_rate_max_radps"]);
  for (const char* rmse : {"air_rmse_m", "ground_rmse_m", "mission_rmse_m"})
    EXPECT_LE(flown()[rmse], 1.05 * boxes[rmse]) << rmse;
}

// The servos have a quarter of the speed of the reference vehicle's servos (8 rad/s). Thrust on the
// ground reduces the tilt rates; the settings choose the ground thrust that such servos need.
TEST(HybridMission, ServoRatesStayWithinLimitOfSlowServos) {
  const Flight rows = run("--no-pictures --servo-speed 2");
  EXPECT_LE(rows["planned_tilt_rate_max_radps"], 0.85 * 2.0 + 0.005);
  EXPECT_LE(rows["tilt_rate_max_radps"], 2.0);
  EXPECT_EQ(rows["tilt_rate_exceeded_share"], 0.0);
  EXPECT_LE(rows["ground_rmse_m"], 0.015);  // 0.009 without the actuator constraints
  EXPECT_EQ(rows["contact_mode_changes"], 4);
  EXPECT_EQ(rows["solver_failures"], 0);

  if (!test_support::full_run()) return;
  const Flight boxes = run("--no-pictures --servo-speed 2 --ground-thrust 1.5 --no-actuator-rows");
  EXPECT_GT(boxes["tilt_rate_max_radps"], 2.0 * 2.0);
  EXPECT_GT(boxes["tilt_rate_exceeded_share"], 0.02);
}

// The same mission at the level of thrusts and tilt angles; in a full run also with servos at a
// quarter of their speed.
TEST(HybridMission, ActuatorLevelIsAtLeastAsGoodAsTheWrenchLevel) {
  for (const std::string servo : {"", " --servo-speed 2"}) {
    if (!servo.empty() && !test_support::full_run()) break;
    const Flight wrench = run("--no-pictures --level wrench" + servo),
                 actuator = run("--no-pictures --level actuator" + servo);
    ASSERT_EQ(actuator.exit_code, 0) << actuator.output;
    for (const char* rmse : {"air_rmse_m", "ground_rmse_m", "mission_rmse_m"})
      EXPECT_LE(actuator[rmse], wrench[rmse]) << rmse << servo;
    EXPECT_GE(actuator["power_saved_percent"], wrench["power_saved_percent"]) << servo;
    EXPECT_EQ(actuator["tilt_rate_exceeded_share"], 0.0) << servo;
    EXPECT_EQ(actuator["contact_mode_changes"], 4) << servo;
    EXPECT_EQ(actuator["solver_failures"], 0) << servo;
  }
}

TEST(HybridMission, LogIsBitIdenticalForTheSameSeedOnly) {
  EXPECT_GT(flown().csv.size(), 1000000u);
  EXPECT_TRUE(run("--no-pictures --seed 1").csv == flown().csv);
  EXPECT_FALSE(run("--mission air --no-pictures --seed 2").csv ==
               run("--mission air --no-pictures --seed 1").csv);
}

TEST(HybridMission, DrawsEightPicturesWithoutWarnings) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  const Flight drawn = run("");
  EXPECT_EQ(drawn.pictures, 8);
  EXPECT_EQ(drawn.output.find("arning"), std::string::npos) << drawn.output;
}

// At the largest speed; in a full run also slower.
TEST(HybridMission, RollsFromTheAirToTheGroundAndBackWithoutAStop) {
  for (const char* speed : {"2", "1.5", "1"}) {
    if (speed != std::string("2") && !test_support::full_run()) break;
    const Flight flight =
        run(std::string("--mission rolling --start-off 0.5 --no-pictures --speed ") + speed);
    ASSERT_EQ(flight.exit_code, 0) << flight.output;
    EXPECT_EQ(flight["contact_mode_changes"], 2) << speed;
    EXPECT_LE(flight["landing_error_m"], 0.03) << speed;
    EXPECT_LE(flight["takeoff_error_m"], 0.03) << speed;
    EXPECT_LE(flight["air_rmse_m"], 0.003) << speed;
    EXPECT_LE(flight["ground_rmse_m"], 0.006) << speed;
    EXPECT_LE(flight["touchdown_speed_mps"], 0.3) << speed;
    EXPECT_EQ(flight["solver_failures"], 0) << speed;
  }
}

// The error at the start counts in the error of the mission, not in that after it.
TEST(HybridMission, CountsTheErrorOfAStartOffTheReference) {
  const Flight off = run("--mission rolling --start-off 0.5 --no-pictures"),
               on = run("--mission rolling --no-pictures");
  EXPECT_NEAR(off["start_error_m"], 0.5, 0.01);
  EXPECT_GT(off["caught_up_s"], 0.2);
  EXPECT_LT(off["caught_up_s"], 3.0);
  EXPECT_LT(off["caught_up_rmse_m"], 0.01);
  EXPECT_GT(off["mission_rmse_m"], 5.0 * off["caught_up_rmse_m"]);
  EXPECT_LT(on["start_error_m"], 0.005);
  EXPECT_EQ(on["caught_up_s"], 0.0);
  EXPECT_EQ(on["mission_rmse_m"], on["caught_up_rmse_m"]);
}

TEST(HybridMission, FliesAndDrivesTheEightsOnTheirOwn) {
  const Flight air = run("--mission air --no-pictures"),
               ground = run("--mission ground --speed 3 --no-pictures");
  EXPECT_LE(air["air_rmse_m"], 0.003);
  EXPECT_EQ(air["contact_mode_changes"], 0);
  EXPECT_LE(ground["ground_rmse_m"], 0.006);  // at 3 m/s
  EXPECT_LE(ground["ground_power_w"], 47.38);
  EXPECT_EQ(ground["contact_mode_changes"], 0);
  for (const Flight* flight : {&air, &ground}) {
    EXPECT_EQ(flight->exit_code, 0) << flight->output;
    EXPECT_EQ((*flight)["solver_failures"], 0);
    EXPECT_EQ(flight->output.find("arning"), std::string::npos) << flight->output;
  }
}

TEST(HybridMission, InspectsAWall) {
  for (const char* level : {"wrench", "actuator"}) {
    const Flight flight = run(std::string("--mission inspect --force 4 --level ") + level +
                              (level == std::string("wrench") ? "" : " --no-pictures"));
    ASSERT_EQ(flight.exit_code, 0) << flight.output;
    EXPECT_EQ(flight.pictures, level == std::string("wrench") ? 9 : 0);
    EXPECT_EQ(flight.output.find("arning"), std::string::npos) << flight.output;
    EXPECT_NEAR(flight["force_mean_n"], 4.0, 0.1) << level;
    EXPECT_LT(flight["force_stddev_n"], 0.15) << level;
    EXPECT_LT(flight["force_max_n"], 5.2) << level;
    EXPECT_GT(flight["force_impact_n"], flight["force_max_n"]) << level;
    EXPECT_LT(flight["slide_error_m"], 0.02) << level;
    EXPECT_LT(flight["slide_force_error_n"], 1.0) << level;
    EXPECT_EQ(flight["solver_failures"], 0) << level;
  }
  EXPECT_TRUE(run("--mission inspect --no-pictures --vehicle '" VEHICLES_DIR "/quadrotor.json'")
                  .says("needs a vehicle that gives every force"));
  EXPECT_TRUE(run("--force 4 --no-pictures").says("only with --mission inspect"));
  EXPECT_TRUE(run("--mission inspect --wall 2 --no-pictures").says("no other wall"));
  const Flight soft = run("--mission inspect --wall-stiffness 1000 --no-pictures"),
               smooth = run("--mission inspect --wall-friction 0.1 --no-pictures");
  EXPECT_LT(soft["force_impact_n"], 9.0);
  EXPECT_NE(smooth["slide_error_m"], soft["slide_error_m"]);
}

// The hybrid trajectory of the paper again, from a file with 20 samples per second.
TEST(HybridMission, FollowsATrajectoryFromAFile) {
  using namespace tilt_ropter;
  const test_support::Directory directory("trajectory");
  const Mission mission = examples::hybrid_experiment(*undercarriage(tilt_ropter_vehicle()));
  std::ofstream file(directory.file("path.csv"));
  file << "time_s,x_m,y_m,z_m,yaw_rad\n" << std::setprecision(12);
  for (double time = 0.0; time <= mission.end_time(); time += 0.05) {
    const ReferencePoint point = mission(time);
    const Eigen::Vector3d& p = point.position;
    file << 5.0 + time << ',' << p.x() << ',' << p.y() << ',' << p.z() << ','
         << yaw_of(point.orientation) << '\n';
  }
  file.close();
  const std::string option = "--no-pictures --trajectory '" + directory.file("path.csv") + "'";
  const Flight flight = run(option);
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_EQ(flight["contact_mode_changes"], 2);
  EXPECT_LE(flight["air_rmse_m"], 0.010);
  EXPECT_LE(flight["ground_rmse_m"], 0.006);
  EXPECT_EQ(flight["solver_failures"], 0);

  EXPECT_NE(run(option + " --mission air").exit_code, 0);
  std::ofstream(directory.file("path.csv")) << "time_s,x_m,y_m,z_m\n0,0,0,1\n0,0,1,1\n";
  const Flight bad = run(option);
  EXPECT_NE(bad.exit_code, 0);
  EXPECT_NE(bad.output.find("path.csv: SampledPath.samples[1].time [s] = 0"), std::string::npos)
      << bad.output;
}

// The controller of the paper as printed, from a start in its range: it flies to the end.
TEST(HybridMission, FliesAsInThePaper) {
  const Flight flight = run("--mission air --as-in-paper all --no-pictures");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_LE(flight["air_rmse_m"], flight["paper_air_rmse_m"]);
  EXPECT_GT(flight["air_rmse_m"], 2.0 * flown()["air_rmse_m"]);
}

TEST(HybridMission, SaysThatTheVehicleWasLost) {
  const Flight heavy = run("--mission air --thrust-error -0.5 --mass-error 1 --no-pictures");
  EXPECT_EQ(heavy.exit_code, 1);
  EXPECT_NE(heavy.output.find("hybrid_mission: the vehicle "), std::string::npos) << heavy.output;
  EXPECT_GT(heavy["air_rmse_m"], 0.5);  // the figures are there
  EXPECT_TRUE(heavy.says("likely_reason: ")) << heavy.output;
  EXPECT_TRUE(heavy.says(" N that the model does not explain")) << heavy.output;
}

// A flight ends early only if the vehicle does not come back.
TEST(HybridMission, EndsAfterALossThatLasts) {
  const auto lost_for = [](double duration, double distance) {
    examples::LossWatch watch;
    for (double t = 0.0; t < 10.0 && !watch.is_over(); t += 0.01)
      watch.on_step(t, t > 3.0 && t < 3.0 + duration ? distance : 0.1, false, distance);
    EXPECT_NEAR(watch.time(), 3.0, 0.02);
    return watch.is_over();
  };
  EXPECT_FALSE(lost_for(1.9, 3.0));
  EXPECT_TRUE(lost_for(2.1, 3.0));
  EXPECT_TRUE(lost_for(0.1, 11.0));
}

// What check_vehicle says without flying is said before the flight, and again as the reason.
TEST(HybridMission, SaysWhatIsWrongWithTheVehicleFirst) {
  const test_support::Directory directory("hybrid_mission_vehicle");
  const std::string both =
      test_support::with(test_support::read_file(test_support::shipped("tilt_ropter")),
                         "\"azimuth_deg\": 0.0", "\"azimuth_deg\": 180.0");
  const Flight lost = run("--no-pictures --vehicle '" + directory.write("two.json", both) + "'");
  EXPECT_EQ(lost.exit_code, 1);
  EXPECT_EQ(lost.output.find("error: the rotors 3 and 4 are in one place\n"), 0u) << lost.output;
  EXPECT_TRUE(lost.says("likely reason: the rotors 3 and 4 are in one place")) << lost.output;
  EXPECT_LT(lost["lost_at_s"], 15.0);
}

TEST(HybridMission, HelpAndBadArguments) {
  const Flight help = run("--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_NE(help.output.find("--mass-error"), std::string::npos);
  const Flight bad = run("--mass-error -3");
  EXPECT_NE(bad.exit_code, 0);
  EXPECT_NE(bad.output.find("--mass-error"), std::string::npos);
  const Flight unwritable = run("--output /proc/nowhere --no-pictures");
  EXPECT_NE(unwritable.exit_code, 0);
}

}  // namespace hybrid_mission_test
