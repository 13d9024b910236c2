// Invalid vehicle files are rejected with an error that names the field.

#include "../../examples/support/vehicle_choice.hpp"

#include "support/program.hpp"
#include "support/vehicle_files.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <fstream>
#include <set>
#include <sstream>
#include <string>
#include <vector>

namespace vehicle_file_errors_test {

using test_support::shipped;
using test_support::with;

/// One change of the shipped Tilt-Ropter file, and the texts that the error message must contain.
struct Wrong {
  std::string find, replace;
  std::vector<std::string> says;
};

std::vector<Wrong> wrong_files() {
  std::vector<Wrong> wrong = {
      // Missing fields.
      {"\"name\": \"Tilt-Ropter\",", "", {"name is missing", "a text"}},
      {"\"mass_kg\": 1.5,", "", {"body.mass_kg is missing", "[0.01, 1000] kg"}},
      {"\"torque_ratio_m\": 0.016,", "", {"rotor.torque_ratio_m is missing", "[0, 1] m"}},
      {"\"max_thrust_n\": 12.0,", "", {"rotor.max_thrust_n is missing", "10000] N"}},
      {"\"max_rate_radps\": 8.0,", "", {"servo.max_rate_radps is missing", "[0.1, 100] rad/s"}},
      {"\"min_angle_deg\": -180.0,", "", {"servo.min_angle_deg is missing", "[-720, 0] deg"}},
      {"\"length_m\": 0.17,", "", {"rotors[0].length_m is missing", "[0.01, 10] m"}},
      {"\"azimuth_deg\": 90.0,", "", {"rotors[1].azimuth_deg is missing", "360] deg"}},
      {"\"radius_m\": 0.11,", "", {"wheels.radius_m is missing", "[0.005, 1] m"}},
      {"\"electronics_w\": 18.0,", "", {"power.electronics_w is missing", "W"}},
      {"\"battery_capacity_ah\": 5.3,", "", {"battery_capacity_ah is missing", "100000] A h"}},
      {"\"battery_full_v\": 16.8,", "", {"battery_full_v is missing", "[0.1, 10000] V"}},
      {"\"battery_empty_v\": 13.2,", "", {"battery_empty_v is missing", "[0.1, 10000] V"}},
      {"\"battery_resistance_ohm\": 0.012,",
       "",
       {"battery_resistance_ohm is missing", "[0, 100] ohm"}},
      {"\"wheels\"", "\"weels\"", {"weels"}},
      // Wrong types.
      {"\"mass_kg\": 1.5", "\"mass_kg\": \"1.5\"", {"body.mass_kg = \"1.5\"", "a number in [0.01"}},
      {"[0.014, 0.014, 0.025]", "0.014", {"body.inertia_kg_m2 = 0.014", "three"}},
      {"[0.014, 0.014, 0.025]", "[0.014, 0.025]", {"body.inertia_kg_m2 = [0.014,0.025]", "three"}},
      {"\"tilts\": true", "\"tilts\": 1", {"rotors[0].tilts = 1", "true or false"}},
      {"\"spin\": \"clockwise\"", "\"spin\": \"cw\"", {"rotors[2].spin = \"cw\"", "counter_clock"}},
      {"\"name\": \"Tilt-Ropter\"", "\"name\": 7", {"name = 7", "a text"}},
      {"\"name\": \"Tilt-Ropter\"", "\"name\": \"\"", {"name = \"\"", "a text"}},
      // Out of range, mostly by a wrong unit.
      {"\"mass_kg\": 1.5", "\"mass_kg\": 1500", {"body.mass_kg = 1500", "[0.01, 1000] kg"}},
      {"\"mass_kg\": 1.5", "\"mass_kg\": -1.5", {"body.mass_kg = -1.5", "[0.01, 1000] kg"}},
      {"\"time_constant_s\": 0.08",
       "\"time_constant_s\": 80",
       {"servo.time_constant_s = 80", "1] s"}},
      {"\"max_angle_deg\": 180", "\"max_angle_deg\": -3", {"servo.max_angle_deg = -3", "[0, 720]"}},
      {"\"length_m\": 0.17", "\"length_m\": 170", {"rotors[0].length_m = 170", "10] m"}},
      {"\"dead_time_s\": 0.0", "\"dead_time_s\": -0.1", {"servo.dead_time_s = -0.1", "0.5] s"}},
      {"[0.06455,", "[0,", {"allowed_errors.position_m[0] = 0", "m"}},
      {"18.26", "0", {"allowed_errors.tilt_rate_radps = 0", "in [1e-06, 1e+06] rad/s"}},
      // Values that contradict each other.
      {"\"min_thrust_n\": 0.0",
       "\"min_thrust_n\": 13",
       {"rotor.min_thrust_n = 13", "less than max_thrust_n, 12 N"}},
      {"\"max_thrust_n\": 12.0",
       "\"max_thrust_n\": 3",
       {"rotor.max_thrust_n = 3", "more than 3.67875 N per rotor: the weight is 14.715 N"}},
      {"[0.014, 0.014, 0.025]",
       "[0.014, 0.014, 0.05]",
       {"body.inertia_kg_m2 = (0.014", "triangle inequality"}},
      {"\"hover_w\": 653.64", "\"hover_w\": 10", {"power.hover_w = 10", "more than electronics_w"}},
      {"\"min_angle_deg\": -180.0,\n    \"max_angle_deg\": 180.0",
       "\"min_angle_deg\": 0, \"max_angle_deg\": 0",
       {"servo.max_angle_deg = 0", "min_angle_deg"}},
      {"\"power\"",
       "\"limits\": {\"force_max_n\": [6, 6, 10]}, \"power\"",
       {"limits.force_max_n[2] = 10", "more than the weight, 14.715 N"}},
      {"\"power\"",
       "\"limits\": {\"torque_min_nm\": [0, 2, 0]}, \"power\"",
       {"limits.torque_min_nm[1] = 2", "at most torque_max_nm[1], 1.5 N m"}},
      {"\"power\"",
       "\"ground\": {\"down_force_n\": -1}, \"power\"",
       {"ground.down_force_n = -1", "[0, 1e+06] N"}},
      {"\"power\"",
       "\"ground\": {\"sinking_mps\": 1}, \"power\"",
       {"ground.sinking_mps", "known fields are down_force_n"}},
      {"\"rotors\": [", "\"rotors\": [[], [], [], [], [],", {"rotors = a list of 9", "2 to 8"}},
      {"\"azimuth_deg\": 90.0,\n      \"length_m\": 0.17",
       "\"position_m\": [0, 0.2, 0], \"thrust_axis\": [0, 1, 1], \"arm_axis\": [0, 1, 0]",
       {"rotors[1].arm_axis = 45 deg", "right angle"}},
      {"\"azimuth_deg\": 90.0,\n      \"length_m\": 0.17",
       "\"position_m\": [0, 0.2, 0], \"thrust_axis\": [0, 0, 0], \"arm_axis\": [0, 1, 0]",
       {"rotors[1].thrust_axis = of length 0", "longer than 0.001"}},
      {"\"max_thrust_n\": 12.0",
       "\"max_thrust_n\": 12.0, \"linear_thrust_coefficient_n_s_per_rad\": -0.003",
       {"rotor.linear_thrust_coefficient_n_s_per_rad = -0.003", "in [-0.00289828, 1] N s/rad"}},
      {"\"azimuth_deg\": 90.0,",
       "\"azimuth_deg\": 90.0, \"max_thrust_n\": -3,",
       {"rotors[1].max_thrust_n = -3", "a number in [0.001, 10000] N"}},
      {"\"azimuth_deg\": 90.0,",
       "\"azimuth_deg\": 90.0, \"linear_thrust_coefficient_n_s_per_rad\": -0.003,",
       {"rotors[1].linear_thrust_coefficient_n_s_per_rad = -0.003", "in [-0.00289828, 1]"}},
      {"\"azimuth_deg\": 90.0,",
       "\"azimuth_deg\": 90.0, \"min_thrust_n\": 12.5,",
       {"rotors[1].min_thrust_n = 12.5", "less than max_thrust_n, 12 N"}},
      {"\"max_thrust_n\": 12.0,\n    \"time_constant_s\": 0.03",
       "\"max_thrust_n\": 3.6, \"time_constant_s\": 0.03",
       {"rotor.max_thrust_n = 3.6", "3.67875 N per rotor: the weight is 14.715 N"}},
      {"\"battery_nominal_v\": 13.2",
       "\"battery_nominal_v\": -22",
       {"battery_nominal_v = -22", "a number in [0.1, 10000] V"}},
      {"\"hover_w\": 653.64", "\"hover_w\": 19", {"power.hover_w = 19", "at rest, 20 W"}},
      {"\"servo_hold_w\": 0.5", "\"servo_hold_w\": -1", {"power.servo_hold_w = -1", "1000] W"}},
      {"\"servo_move_j_per_rad\": 0.3",
       "\"servo_move_j_per_rad\": \"0.3\"",
       {"power.servo_move_j_per_rad = \"0.3\"", "J/rad"}},
      {"\"battery_capacity_ah\": 5.3",
       "\"battery_capacity_ah\": -5.3",
       {"battery_capacity_ah = -5.3", "[0.001, 100000] A h"}},
      {"\"battery_empty_v\": 13.2",
       "\"battery_empty_v\": 17",
       {"battery_empty_v = 17", "at most battery_full_v, 16.8 V"}},
      // Unknown and repeated names, and invalid JSON.
      {"\"mass_kg\": 1.5",
       "\"mass_kg\": 1.5, \"mas\": 2",
       {"body.mas = 2", "no such field", "mass_kg"}},
      {"\"mass_kg\": 1.5", "\"mass_kg\": 1.5, \"mass_kg\": 2", {"mass_kg is there twice"}},
      {"\"mass_kg\": 1.5,", "\"mass_kg\": 1.5 1,", {"line 4"}},
      {"\"mass_kg\": 1.5", "\"mass_kg\": nan", {"line 4"}},
      {"\"mass_kg\": 1.5", "\"mass_kg\": 1e999", {"number overflow"}},
  };
  return wrong;
}

TEST(VehicleFile, RejectsRotorsThatTogetherDoNotLiftTheWeight) {
  std::string text = test_support::read_file(shipped("tilt_ropter"));
  text = with(text, "\"max_thrust_n\": 12.0", "\"max_thrust_n\": 3.0");
  const auto refusal = [](const std::string& json) {
    std::istringstream in(json);
    try {
      (void)examples::read_vehicle(in, "file");
    } catch (const examples::VehicleFileError& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  const auto first = [&](const char* most) {
    return refusal(with(text, "\"azimuth_deg\": 90.0,",
                        std::string("\"azimuth_deg\": 90.0, \"max_thrust_n\": ") + most + ","));
  };
  EXPECT_EQ(first("5"),
            "file: sum of max_thrust_n of all rotors = 14: must be more than the weight, 14.715 N");
  EXPECT_EQ(first("6"), "");
}

TEST(VehicleFile, ErrorsNameFieldValueAndRange) {
  const std::string good = test_support::read_file(shipped("tilt_ropter"));
  const test_support::Directory directory("vehicle_file");
  const std::string path = directory.file("wrong.json");
  const std::vector<Wrong> wrong = wrong_files();
  ASSERT_GE(wrong.size(), 30u);
  for (const Wrong& w : wrong) {
    std::string text = good;
    ASSERT_NE(text.find(w.find), std::string::npos) << w.find;
    for (std::size_t at = text.find(w.find); at != std::string::npos;
         at = text.find(w.find, at + w.replace.size())) {
      text.replace(at, w.find.size(), w.replace);
      // Fixed arms are set in all rotors; every other change applies to the first match.
      if (w.find != "\"tilts\": true" || w.replace == "\"tilts\": 1") break;
    }
    std::ofstream(path) << text;
    const auto told =
        test_support::run(HYBRID_MISSION_PROGRAM, "--no-pictures --vehicle '" + path + "'");
    EXPECT_EQ(told.exit_code, 2) << w.replace << told.output;
    EXPECT_NE(told.output.find(path + ": "), std::string::npos) << told.output;
    for (const std::string& words : w.says)
      EXPECT_NE(told.output.find(words), std::string::npos) << words << " in " << told.output;
  }
}

// Each field is renamed in turn: most missing fields are misspelt names.
TEST(VehicleFile, ReportsEveryMissingRequiredField) {
  for (const char* name : {"tilt_ropter", "octocopter"}) {
    const std::string good = test_support::read_file(shipped(name));
    int fields = 0;
    for (std::size_t at = good.find("\": "); at != std::string::npos;
         at = good.find("\": ", at + 1)) {
      const std::size_t start = good.rfind('"', at - 1) + 1;
      const std::string key = good.substr(start, at - start);
      if (key == "allowed_errors") break;
      std::istringstream in(good.substr(0, start) + "un" + good.substr(start));
      try {
        (void)examples::read_vehicle(in, "file");
        ADD_FAILURE() << "read without " << key;
      } catch (const examples::VehicleFileError& error) {
        const std::set<std::string> optional_fields = {"wheels",
                                                       "on_arms",
                                                       "half_width_m",
                                                       "hover_w",
                                                       "propeller_radius_m",
                                                       "servo_hold_w",
                                                       "propeller_height_m",
                                                       "servo_move_j_per_rad",
                                                       "battery_nominal_v"};
        const bool of_wheels = good.rfind("\"wheels\"", at) != std::string::npos;
        const bool optional = optional_fields.count(key) != 0 ||
                              (key == "inertia_kg_m2" && of_wheels);  // the body's is required
        const std::string says = optional ? "un" + key + " = " : key + " is missing: must be ";
        EXPECT_NE(std::string(error.what()).find(says), std::string::npos) << error.what();
      }
      ++fields;
    }
    EXPECT_GT(fields, 30);
  }
}

TEST(VehicleFile, RejectsEmptyTruncatedAndAbsentFiles) {
  const std::string good = test_support::read_file(shipped("hexacopter"));
  for (std::size_t length = 0; length + 2 < good.size(); length += 37) {
    std::istringstream in(good.substr(0, length));
    EXPECT_THROW((void)examples::read_vehicle(in, "cut"), examples::VehicleFileError) << length;
  }
  for (const char* text : {"[]", "7", "null", "\"x\"", "{}", "{\"name\": \"x\", \"body\": 3}"}) {
    std::istringstream in(text);
    EXPECT_THROW((void)examples::read_vehicle(in, text), examples::VehicleFileError);
  }
  const auto absent = test_support::run(HYBRID_MISSION_PROGRAM, "--vehicle nowhere.json");
  EXPECT_EQ(absent.exit_code, 2);
  EXPECT_NE(absent.output.find("cannot read nowhere.json"), std::string::npos) << absent.output;
}

#ifdef COMPARE_PLANTS_PROGRAM  // with MuJoCo
TEST(VehicleFile, ProgramsForFourRotorsRejectOtherVehicles) {
  const auto told = test_support::run(COMPARE_PLANTS_PROGRAM, "--vehicle " + shipped("hexacopter"));
  EXPECT_EQ(told.exit_code, 2);
  EXPECT_NE(told.output.find("a vehicle of 4 rotors"), std::string::npos) << told.output;
}
#endif

}  // namespace vehicle_file_errors_test
