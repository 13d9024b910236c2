// Runs the program check_vehicle as a user does.
// CTest: flight

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <cstdlib>
#include <string>

namespace check_vehicle_test {

test_support::Outcome check(const std::string& vehicle,
                            const std::string& more = "--no-pictures --no-flight") {
  const test_support::Directory directory("check_vehicle");
  return test_support::run(CHECK_VEHICLE_PROGRAM,
                           vehicle + " -o '" + directory.file("") + "' " + more);
}

std::string shipped(const std::string& name) {
  return VEHICLES_DIR "/" + name + ".json";
}

/// Checks a shipped vehicle whose file has the text `from` replaced by `to`.
test_support::Outcome check_changed(const std::string& name, const std::string& from,
                                    const std::string& to) {
  const test_support::Directory directory("check_vehicle_changed");
  std::string text = test_support::read_file(shipped(name));
  EXPECT_NE(text.find(from), std::string::npos) << from;
  text.replace(text.find(from), from.size(), to);
  return check(directory.write("changed.json", text));
}

// Flown in a full run. The file of the octocopter has no battery.
TEST(CheckVehicle, ShippedVehiclesFly) {
  const bool flies = test_support::full_run();
  for (const std::string name : {"tilt_ropter", "hexacopter", "octocopter", "five_kilograms"}) {
    if (name == "five_kilograms" && !flies) break;
    const auto told = check(shipped(name), flies ? "--no-pictures" : "--no-pictures --no-flight");
    EXPECT_EQ(told.exit_code, 0) << told.output;
    EXPECT_EQ(told["rank"], 6);
    EXPECT_TRUE(told.says("level: wrench")) << told.output;
    EXPECT_EQ(told["warnings"], 0) << told.output;
    EXPECT_EQ(told["limitations"], 0) << told.output;
    EXPECT_TRUE(told.says(flies ? "verdict: flies" : "verdict: no error found, but not flown"))
        << told.output;
    EXPECT_EQ(told.says("hover_min: not known"), name == "octocopter") << told.output;
  }
}

// The Tilt-Ropter has four rotors of 12 N and a mass of 1.5 kg.
TEST(CheckVehicle, ReportsTheFiguresOfTheTiltRopter) {
  const auto told = check("");
  EXPECT_NEAR(told["weight_n"], 1.5 * 9.81, 0.05);
  EXPECT_NEAR(told["lift_per_weight"], 48.0 / 14.715, 0.01);
  EXPECT_NEAR(told["least_thrust_in_hover_n"], 14.715 / 4.0, 0.01);
  EXPECT_TRUE(told.says("    1     6")) << told.output;  // rank 6 with rotor 1 lost
}

TEST(CheckVehicle, ComputesFlightTimeFromBatteryEnergy) {
  const auto told = check(shipped("five_kilograms"), "--no-pictures --no-flight --usable 0.5");
  EXPECT_EQ(told.exit_code, 0) << told.output;
  EXPECT_NEAR(told["hover_min"], 60.0 * 0.5 * 355.0 / 1900.0, 0.01);
  EXPECT_GT(told["driving_min"], 10.0 * told["hover_min"]);
}

// References: U = R I + V and P = V I at both ends; the mean of these loads for the times.
TEST(CheckVehicle, ReportsCurrentSagAndEnduranceOfTheBattery) {
  const auto told = check("");
  for (const std::string mode : {"hover", "driving"}) {
    const double power = told[mode + "_power_w"], current = told[mode + "_current_a"];
    EXPECT_NEAR(told[mode + "_voltage_v"] * current, power, 0.01 * power) << mode;
    EXPECT_NEAR(told[mode + "_voltage_v"] + told[mode + "_sag_v"], 16.8, 0.06) << mode;
    EXPECT_NEAR(told[mode + "_sag_v"], 0.012 * current, 0.01 * current) << mode;
    const double mean = 0.5 * (current + told[mode + "_end_current_a"]);
    EXPECT_NEAR(told[mode + "_min"], 60.0 * 0.8 * 5.3 / mean, 0.02 * told[mode + "_min"]) << mode;
  }
  EXPECT_NEAR(told["hover_power_w"], 653.64, 1.0);
  EXPECT_LE(told["driving_power_w"], 47.38);
  EXPECT_NEAR(told["battery_energy_wh"], 5.3 * 15.0, 0.1);
}

TEST(CheckVehicle, FindsBatteriesThatAreTooWeak) {
  auto told = check_changed("tilt_ropter", "\"battery_resistance_ohm\": 0.012",
                            "\"battery_resistance_ohm\": 0.02");
  EXPECT_EQ(told.exit_code, 0);
  EXPECT_EQ(told["warnings"], 1) << told.output;
  EXPECT_TRUE(told.says("% charge, full thrust takes")) << told.output;
  told = check_changed("tilt_ropter", "\"battery_resistance_ohm\": 0.012",
                       "\"battery_resistance_ohm\": 0.08");
  EXPECT_EQ(told.exit_code, 1);
  EXPECT_TRUE(told.says("does not give the power of hover")) << told.output;
}

TEST(CheckVehicle, WarnsOfLimitsBeyondActuatorsAndOfLittleLift) {
  // Limits beyond the actuators, which give 24 N and 4.1 N m.
  auto told = check_changed("tilt_ropter", "\"power\"",
                            "\"limits\": {\"force_max_n\": [30, 6, 30], "
                            "\"torque_min_nm\": [-1, -5, -1]}, \"power\"");
  EXPECT_EQ(told.exit_code, 0);
  EXPECT_EQ(told["warnings"], 2) << told.output;
  EXPECT_TRUE(told.says("limits.force_max_n[0] = 30 is more")) << told.output;
  EXPECT_TRUE(told.says("limits.torque_min_nm[1] = -5 is more")) << told.output;
  // Limits that are too small for the mission.
  told = check_changed("tilt_ropter", "\"power\"",
                       "\"limits\": {\"force_max_n\": [0.2, 6, 30]}, \"power\"");
  EXPECT_TRUE(told.says("the mission asks for force[0]")) << told.output;
  // Maximum lift below 1.5 times the weight.
  told = check_changed("tilt_ropter", "\"max_thrust_n\": 12.0", "\"max_thrust_n\": 5.0");
  EXPECT_EQ(told.exit_code, 0);
  EXPECT_TRUE(told.says("lift of less than 1.5 times")) << told.output;
}

TEST(CheckVehicle, RejectsVehiclesThatCannotHover) {
  auto told = check_changed("tilt_ropter", "\"max_thrust_n\": 12.0", "\"max_thrust_n\": 3.7");
  EXPECT_EQ(told.exit_code, 1);
  EXPECT_TRUE(told.says("verdict: does not fly")) << told.output;
  // The sum of all thrusts exceeds the weight, but the rotors push against each other.
  told = check_changed("octocopter", "\"max_thrust_n\": 12", "\"max_thrust_n\": 1.5");
  EXPECT_EQ(told.exit_code, 1);
  EXPECT_TRUE(told.says("do not carry the weight")) << told.output;
}

TEST(CheckVehicle, NamesWhatContradictsItselfInTheFile) {
  auto told = check_changed("tilt_ropter", "\"azimuth_deg\": 180.0", "\"azimuth_deg\": 0.0");
  EXPECT_EQ(told.exit_code, 1);
  EXPECT_TRUE(told.says("error: the rotors 3 and 4 are in one place")) << told.output;
  const test_support::Directory directory("check_vehicle_changed");
  std::string text = test_support::read_file(shipped("tilt_ropter"));
  const auto change = [&text](const std::string& from, const std::string& to) {
    for (std::size_t at = 0; (at = text.find(from, at)) != std::string::npos; at += to.size())
      text.replace(at, from.size(), to);
  };
  change("\"counter_clockwise", "\"clockwise");
  change("angle_deg\": -180.0", "angle_deg\": -3.14159");
  change("angle_deg\": 180.0", "angle_deg\": 3.14159");
  told = check(directory.write("changed.json", text));
  EXPECT_TRUE(told.says("warning: all rotors turn the same way")) << told.output;
  EXPECT_TRUE(told.says("max_angle_deg = 3.14 look like radians: -180 to 180")) << told.output;
  // Without a rotor no torque about x or y is left: it does not stay upright.
  EXPECT_TRUE(told.says("    1     6       2.65      no     no")) << told.output;
  EXPECT_FALSE(check("").says("radians"));
}

TEST(CheckVehicle, NamesUnitsThatNoVehicleHas) {
  const auto is_named = [](const std::string& from, const std::string& to, const char* text) {
    const auto told = check_changed("tilt_ropter", from, to);
    EXPECT_TRUE(told.says(text) && told.says(": is the unit right?")) << to << told.output;
  };
  // In kg cm^2; per rpm^2; the torque coefficient; in grams.
  is_named("[0.014, 0.014, 0.025]", "[140, 140, 250]", "warning: body.inertia_kg_m2");
  is_named("per_rad2\": 1.4e-06", "per_rad2\": 1.54e-08", "times the power of an ideal one");
  is_named("\"torque_ratio_m\": 0.016", "\"torque_ratio_m\": 2.2e-8", "of an ideal one");
  is_named("\"max_thrust_n\": 12.0", "\"max_thrust_n\": 1223", "warning: rotor.max_thrust_n");
}

TEST(CheckVehicle, DrawsThePicture) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  const test_support::Directory directory("check_vehicle");
  const auto told =
      test_support::run(CHECK_VEHICLE_PROGRAM, "--no-flight -o '" + directory.file("") + "'");
  EXPECT_EQ(told.output.find("arning: "), std::string::npos) << told.output;
  EXPECT_GT(test_support::read_file(directory.file("check_vehicle.png")).size(), 10000u);
}

TEST(CheckVehicle, HelpAndBadArguments) {
  EXPECT_EQ(check("", "--help").exit_code, 0);
  EXPECT_GT(check("", "--usable 2").exit_code, 100);
  const auto absent = check("nowhere.json");
  EXPECT_EQ(absent.exit_code, 2);
  EXPECT_TRUE(absent.says("cannot read nowhere.json")) << absent.output;
}

}  // namespace check_vehicle_test
