// Vehicles as JSON files: those that are shipped fly without tuning, those that cannot be are
// refused with what is wrong.

#include "support/program.hpp"

#include "../../examples/support/vehicle_file.hpp"

#include <gtest/gtest.h>

#include <fstream>
#include <functional>
#include <sstream>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

namespace {

using examples::VehicleFile;

std::string shipped(const std::string& name) {
  return VEHICLES_DIR "/" + name + ".json";  // set by CMake
}

struct Vehicle {
  const char* name;
  bool drives;
};

class ShippedVehicle : public testing::TestWithParam<Vehicle> {};

// No parameter is touched but the file's; the weights are the default.
TEST_P(ShippedVehicle, FliesItsMissionWithoutTuning) {
  const test_support::Directory directory("vehicle_file");
  auto flight = test_support::run(HYBRID_MISSION_PROGRAM, "--vehicle " + shipped(GetParam().name) +
                                                              " --no-pictures --output '" +
                                                              directory.file("") + "'");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_LT(flight["air_rmse_m"], 0.05);
  EXPECT_LT(flight["mission_rmse_m"], 0.05);
  EXPECT_EQ(flight["solver_failures"], 0);
  EXPECT_EQ(flight["contact_mode_changes"], GetParam().drives ? 4 : 0);
  EXPECT_EQ(flight["tilt_rate_exceeded_share"], 0.0);
  if (GetParam().drives) {
    EXPECT_LT(flight["ground_rmse_m"], 0.05);
  }
}

INSTANTIATE_TEST_SUITE_P(, ShippedVehicle,
                         testing::Values(Vehicle{"hexacopter", false}, Vehicle{"octocopter", false},
                                         Vehicle{"five_kilograms", true}),
                         [](const auto& vehicle) { return std::string(vehicle.param.name); });

TEST(VehicleFile, TheTiltRopterIsWrittenAsShippedAndReadAsItIs) {
  const test_support::Directory directory("vehicle_file");
  const std::string path = directory.file("written.json");
  ASSERT_EQ(test_support::run(HYBRID_MISSION_PROGRAM, "--write-vehicle '" + path + "'").exit_code,
            0);
  EXPECT_EQ(test_support::read_file(path), test_support::read_file(shipped("tilt_ropter")));

  const VehicleFile read = examples::read_vehicle(path);
  const auto& vehicle = std::get<tilt_ropter::Vehicle<4>>(read.vehicle);
  const tilt_ropter::Vehicle<4> reference = tilt_ropter::tilt_ropter_vehicle();
  EXPECT_EQ(vehicle.wheels->radius, reference.wheels->radius);
  EXPECT_EQ(vehicle.body.mass, reference.body.mass);
  EXPECT_EQ(vehicle.body.inertia, reference.body.inertia);
  EXPECT_EQ(vehicle.servo.max_angle, reference.servo.max_angle);
  for (std::size_t i = 0; i < 4; ++i) {
    EXPECT_TRUE(vehicle.rotors[i].position.isApprox(reference.rotors[i].position, 1e-12));
    EXPECT_TRUE(vehicle.rotors[i].orientation.isApprox(reference.rotors[i].orientation, 1e-12));
    EXPECT_EQ(vehicle.rotors[i].spin, reference.rotors[i].spin);
  }
  EXPECT_TRUE(read.limits.force_max.isApprox(tilt_ropter::NmpcBounds{}.force_max, 1e-12));
}

TEST(VehicleFile, WhatIsReadIsWrittenAgain) {
  const test_support::Directory directory("vehicle_file");
  for (const char* name : {"tilt_ropter", "hexacopter", "octocopter", "five_kilograms"}) {
    const std::string once = directory.file("once.json"), twice = directory.file("twice.json");
    VehicleFile file = examples::read_vehicle(shipped(name));
    file.limits.angular_velocity << 1.0, 2.0, 3.5;  // which is not the default
    file.battery_wh = 12.5;
    std::visit(
        [](auto& vehicle) {
          vehicle.battery.nominal_voltage = 14.8;
          vehicle.rotor.linear_thrust_coefficient = 1e-4;
          vehicle.rotors[1].parameters = vehicle.rotor;
          vehicle.rotors[1].parameters->torque_ratio = 0.0123;
          vehicle.rotors[2].parameters = vehicle.rotor;
          vehicle.rotors[2].parameters->linear_thrust_coefficient = 0.0;
          vehicle.rotors[2].parameters->max_thrust *= 1.25;
        },
        file.vehicle);
    examples::write_vehicle(file, once);
    const VehicleFile again = examples::read_vehicle(once);
    EXPECT_EQ(again.limits.angular_velocity, file.limits.angular_velocity);
    EXPECT_EQ(again.battery_wh, file.battery_wh);
    std::visit(
        [&](const auto& vehicle) {
          const auto& written = std::get<std::decay_t<decltype(vehicle)>>(file.vehicle);
          EXPECT_EQ(vehicle.battery.nominal_voltage, 14.8);
          for (std::size_t i = 0; i < vehicle.rotors.size(); ++i) {
            EXPECT_EQ(vehicle.rotors[i].parameters.has_value(), i == 1 || i == 2);
            const auto &read = rotor_parameters(vehicle, i), &was = rotor_parameters(written, i);
            EXPECT_EQ(read.thrust_coefficient, was.thrust_coefficient);
            EXPECT_EQ(read.linear_thrust_coefficient, was.linear_thrust_coefficient);
            EXPECT_EQ(read.torque_ratio, was.torque_ratio);
            EXPECT_EQ(read.max_thrust, was.max_thrust);
          }
        },
        again.vehicle);
    examples::write_vehicle(again, twice);
    EXPECT_EQ(test_support::read_file(once), test_support::read_file(twice)) << name;
  }
}

/// A rotor by its axes is the same as one on an arm.
TEST(VehicleFile, RotorsByTheirAxes) {
  std::string text = test_support::read_file(shipped("tilt_ropter"));
  const std::string arm = "\"azimuth_deg\": 90.0,\n      \"length_m\": 0.17";
  ASSERT_NE(text.find(arm), std::string::npos);
  text.replace(text.find(arm), arm.size(),
               "\"position_m\": [0, 0.17, 0], \"thrust_axis\": [0, 0, 2], \"arm_axis\": [0, 3, 0]");
  std::istringstream in(text);
  const auto vehicle = std::get<tilt_ropter::Vehicle<4>>(examples::read_vehicle(in, "").vehicle);
  const tilt_ropter::RotorGeometry expected = tilt_ropter::tilt_ropter_vehicle().rotors[1];
  EXPECT_TRUE(vehicle.rotors[1].orientation.isApprox(expected.orientation, 1e-12));
}

std::string with(std::string text, const std::string& find, const std::string& replace) {
  EXPECT_NE(text.find(find), std::string::npos) << find;
  return text.replace(text.find(find), find.size(), replace);
}

/// Those of a rotor hold for it alone, each field by itself.
TEST(VehicleFile, ARotorMayHaveParametersOfItsOwn) {
  const std::string good = test_support::read_file(shipped("tilt_ropter"));
  const tilt_ropter::RotorParameters common = tilt_ropter::tilt_ropter_vehicle().rotor;
  const std::vector<std::pair<std::string, double tilt_ropter::RotorParameters::*>> fields = {
      {"thrust_coefficient_n_s2_per_rad2", &tilt_ropter::RotorParameters::thrust_coefficient},
      {"linear_thrust_coefficient_n_s_per_rad",
       &tilt_ropter::RotorParameters::linear_thrust_coefficient},
      {"torque_ratio_m", &tilt_ropter::RotorParameters::torque_ratio},
      {"min_thrust_n", &tilt_ropter::RotorParameters::min_thrust},
      {"max_thrust_n", &tilt_ropter::RotorParameters::max_thrust},
      {"time_constant_s", &tilt_ropter::RotorParameters::time_constant}};
  for (const auto& field : fields) {
    std::istringstream in(with(good, "\"azimuth_deg\": 90.0,",
                               "\"azimuth_deg\": 90.0, \"" + field.first + "\": 0.5,"));
    const auto vehicle = std::get<tilt_ropter::Vehicle<4>>(examples::read_vehicle(in, "").vehicle);
    for (std::size_t i = 0; i < 4; ++i)
      for (const auto& other : fields)
        EXPECT_EQ(rotor_parameters(vehicle, i).*other.second,
                  i == 1 && other.first == field.first ? 0.5 : common.*other.second)
            << field.first << i << other.first;
  }
}

/// Five kilograms on four rotors of three sorts, one of them weaker, with curves.
TEST(VehicleFile, UnlikeRotorsFlyTheirMissionWithoutTuning) {
  const test_support::Directory directory("vehicle_file");
  VehicleFile file = examples::read_vehicle(shipped("five_kilograms"));
  auto& vehicle = std::get<tilt_ropter::Vehicle<4>>(file.vehicle);
  for (const std::size_t i : {0U, 2U, 3U}) vehicle.rotors[i].parameters = vehicle.rotor;
  vehicle.rotors[0].parameters->linear_thrust_coefficient = 3e-3;
  vehicle.rotors[0].parameters->torque_ratio *= 1.3;
  vehicle.rotors[2].parameters->thrust_coefficient *= 1.5;
  vehicle.rotors[2].parameters->linear_thrust_coefficient = -3e-3;
  vehicle.rotors[3].parameters->max_thrust *= 0.8;
  vehicle.rotors[3].parameters->time_constant *= 1.5;
  examples::write_vehicle(file, directory.file("unlike.json"));
  const auto flight = test_support::run(
      HYBRID_MISSION_PROGRAM, "--vehicle '" + directory.file("unlike.json") +
                                  "' --no-pictures --output '" + directory.file("") + "'");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_LT(flight["air_rmse_m"], 0.01);
  EXPECT_LT(flight["ground_rmse_m"], 0.02);
  EXPECT_EQ(flight["solver_failures"], 0);
}

TEST(VehicleFile, WeightsComeFromTheAllowedErrors) {
  std::string text = test_support::read_file(shipped("five_kilograms"));
  text.replace(text.find("\"wheels\""), 0,
               "\"allowed_errors\": {\"position_m\": [0.1, 0.2, 0.5]}, ");
  std::istringstream in(text);
  const auto weights = examples::read_vehicle(in, "").settings().problem.weights;
  EXPECT_TRUE(weights.position.isApprox(Eigen::Vector3d(100.0, 25.0, 4.0), 1e-12));
  // A force of 5 kg is as bad as a third of it on 1.5 kg.
  EXPECT_NEAR(weights.force.x(), 0.02 * 0.3 * 0.3, 1e-6);
}

/// The shipped Tilt-Ropter with one thing changed, and what the message has to say of it.
struct Wrong {
  std::string find, replace;
  std::vector<std::string> says;
};

std::vector<Wrong> wrong_files() {
  std::vector<Wrong> wrong = {
      // Missing.
      {"\"name\": \"Tilt-Ropter\",", "", {"name is missing", "a text"}},
      {"\"mass_kg\": 1.5,", "", {"body.mass_kg is missing", "[0.01, 1000] kg"}},
      {"\"torque_ratio_m\": 0.016,", "", {"rotor.torque_ratio_m is missing", "[0, 1] m"}},
      {"\"max_thrust_n\": 12.0,", "", {"rotor.max_thrust_n is missing", "10000] N"}},
      {"\"max_rate_radps\": 8.0,", "", {"servo.max_rate_radps is missing", "[0.1, 100] rad/s"}},
      {"\"min_angle_deg\": -180.0,", "", {"servo.min_angle_deg is missing", "[-720, 0] deg"}},
      {"\"length_m\": 0.17,", "", {"rotors[0].length_m is missing", "[0.01, 10] m"}},
      {"\"azimuth_deg\": 90.0,", "", {"rotors[1].azimuth_deg is missing", "360] deg"}},
      {"\"radius_m\": 0.11,", "", {"wheels.radius_m is missing", "[0.005, 1] m"}},
      {"\"electronics_w\": 20.0,", "", {"power.electronics_w is missing", "W"}},
      {"\"wheels\"", "\"weels\"", {"weels"}},
      // Of the wrong type.
      {"\"mass_kg\": 1.5", "\"mass_kg\": \"1.5\"", {"body.mass_kg = \"1.5\"", "a number in [0.01"}},
      {"[0.014, 0.014, 0.025]", "0.014", {"body.inertia_kg_m2 = 0.014", "three"}},
      {"[0.014, 0.014, 0.025]", "[0.014, 0.025]", {"body.inertia_kg_m2 = [0.014,0.025]", "three"}},
      {"\"tilts\": true", "\"tilts\": 1", {"rotors[0].tilts = 1", "true or false"}},
      {"\"spin\": \"clockwise\"", "\"spin\": \"cw\"", {"rotors[2].spin = \"cw\"", "counter_clock"}},
      {"\"name\": \"Tilt-Ropter\"", "\"name\": 7", {"name = 7", "a text"}},
      {"\"name\": \"Tilt-Ropter\"", "\"name\": \"\"", {"name = \"\"", "a text"}},
      // Out of range, of which most are of the wrong unit.
      {"\"mass_kg\": 1.5", "\"mass_kg\": 1500", {"body.mass_kg = 1500", "[0.01, 1000] kg"}},
      {"\"mass_kg\": 1.5", "\"mass_kg\": -1.5", {"body.mass_kg = -1.5", "[0.01, 1000] kg"}},
      {"\"time_constant_s\": 0.08",
       "\"time_constant_s\": 80",
       {"servo.time_constant_s = 80", "1] s"}},
      {"\"max_angle_deg\": 180", "\"max_angle_deg\": -3", {"servo.max_angle_deg = -3", "[0, 720]"}},
      {"\"length_m\": 0.17", "\"length_m\": 170", {"rotors[0].length_m = 170", "10] m"}},
      {"\"dead_time_s\": 0.0", "\"dead_time_s\": -0.1", {"servo.dead_time_s = -0.1", "0.5] s"}},
      {"[0.06455,", "[0,", {"allowed_errors.position_m[0] = 0", "m"}},
      // Which do not fit together.
      {"\"min_thrust_n\": 0.0",
       "\"min_thrust_n\": 13",
       {"rotor.min_thrust_n = 13", "less than max_thrust_n, 12 N"}},
      {"\"max_thrust_n\": 12.0",
       "\"max_thrust_n\": 3",
       {"rotor.max_thrust_n = 3", "more than 3.67875 N, a share of the weight"}},
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
      {"\"rotors\": [", "\"rotors\": [[],", {"rotors = a list of 5", "4, 6 or 8"}},
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
      {"\"max_thrust_n\": 12.0,\n    \"time_constant_s\": 0.03\n  },",
       "\"max_thrust_n\": 3.6, \"time_constant_s\": 0.03 },",
       {"rotor.max_thrust_n = 3.6", "a share of the weight"}},
      {"\"power\"",
       "\"battery_nominal_v\": -22, \"power\"",
       {"battery_nominal_v = -22", "a number in [0.1, 10000] V"}},
      // Of another spelling, and no JSON.
      {"\"mass_kg\": 1.5",
       "\"mass_kg\": 1.5, \"mas\": 2",
       {"body.mas = 2", "no such field", "mass_kg"}},
      {"\"mass_kg\": 1.5", "\"mass_kg\": 1.5, \"mass_kg\": 2", {"mass_kg is there twice"}},
      {"\"mass_kg\": 1.5,", "\"mass_kg\": 1.5 1,", {"line 4"}},
      {"\"mass_kg\": 1.5", "\"mass_kg\": nan", {"line 4"}},
      {"\"mass_kg\": 1.5", "\"mass_kg\": 1e999", {"number overflow"}},
  };
  // Four fixed rotors that all push upward do not give every wrench.
  wrong.push_back({"\"tilts\": true", "\"tilts\": false", {"rank", "4"}});
  return wrong;
}

TEST(VehicleFile, RotorsThatDoNotCarryTheWeightTogetherAreRefused) {
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

TEST(VehicleFile, WrongOnesAreRefusedWithFieldValueAndRange) {
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
      if (w.find != "\"tilts\": true" || w.replace == "\"tilts\": 1") break;  // that: all of them
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

// Each by another name, which is how most of them go missing.
TEST(VehicleFile, EveryFieldThatIsNotOptionalIsMissed) {
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
        const std::string says =
            key == "wheels" ? "unwheels = " : key + " is missing: must be ";  // wheels are optional
        EXPECT_NE(std::string(error.what()).find(says), std::string::npos) << error.what();
      }
      ++fields;
    }
    EXPECT_GT(fields, 30);
  }
}

TEST(VehicleFile, StandsOnWheelsOrLegsOrNothing) {
  const std::string good = test_support::read_file(shipped("octocopter"));
  const auto standing = [&good](const std::string& on) {
    std::istringstream in("{" + on + good.substr(1));
    return examples::read_vehicle(in, "file").undercarriage();
  };
  EXPECT_FALSE(standing(""));
  EXPECT_FALSE(standing("\"wheels\": null, \"legs\": null,"));
  const auto car =
      standing("\"wheels\": {\"radius_m\": 0.1, \"half_track_m\": 0.2, \"wheel_base_m\": 0.3},");
  ASSERT_TRUE(car);
  EXPECT_TRUE(car->rolls && !car->pitches);
  const std::string legs =
      "\"legs\": {\"height_m\": 0.2, \"half_length_m\": 0.15, \"half_width_m\": 0.1},";
  const auto bird = standing(legs);
  ASSERT_TRUE(bird);
  EXPECT_TRUE(!bird->rolls && !bird->pitches);
  EXPECT_EQ(bird->height, 0.2);
  EXPECT_THROW((void)standing(legs + "\"wheels\": {\"radius_m\": 0.1, \"half_track_m\": 0.2},"),
               examples::VehicleFileError);

  // What is written is what was read.
  const test_support::Directory directory("vehicle_file");
  const std::string path = directory.file("legs.json");
  std::istringstream in("{" + legs + good.substr(1));
  const VehicleFile file = examples::read_vehicle(in, "file");
  examples::write_vehicle(file, path);
  EXPECT_EQ(
      std::get<tilt_ropter::Vehicle<8>>(examples::read_vehicle(path).vehicle).legs->half_width,
      0.1);
}

/// The shipped Tilt-Ropter, changed, in a file of its own.
std::string changed_vehicle(const test_support::Directory& directory, const char* name,
                            const std::function<void(tilt_ropter::Vehicle<4>&)>& change) {
  VehicleFile file;
  change(std::get<tilt_ropter::Vehicle<4>>(file.vehicle));
  const std::string path = directory.file(std::string(name) + ".json");
  examples::write_vehicle(file, path);
  return path;
}

// On legs, on nothing, and with servos that hear late.
TEST(VehicleFile, ProgramsTakeVehiclesWithoutWheelsAndWithDeadTime) {
  using tilt_ropter::Vehicle;
  const test_support::Directory directory("vehicle_file");
  const auto on_legs = [](Vehicle<4>& v) {
    v.wheels.reset();
    v.legs = tilt_ropter::LegParameters{};
  };
  struct Case {
    std::string path;
    int mode_changes;
  };
  const std::vector<Case> cases{
      {changed_vehicle(directory, "legs", on_legs), 2},
      {changed_vehicle(directory, "nothing", [](Vehicle<4>& v) { v.wheels.reset(); }), 0},
      {changed_vehicle(directory, "late", [](Vehicle<4>& v) { v.servo.dead_time = 0.02; }), 4}};
  for (const Case& c : cases) {
    const std::string with =
        "--vehicle '" + c.path + "' --no-pictures --output '" + directory.file("out") + "' ";
    std::vector<std::string> missions{HYBRID_MISSION_PROGRAM};
#ifdef MISSION_MUJOCO_PROGRAM
    missions.emplace_back(MISSION_MUJOCO_PROGRAM);
#endif
    for (const std::string& program : missions) {
      const auto flight = test_support::run(program, with);
      ASSERT_EQ(flight.exit_code, 0) << flight.output;
      EXPECT_EQ(flight["contact_mode_changes"], c.mode_changes) << program;
      EXPECT_LT(flight["mission_rmse_m"], 0.01) << program;
      EXPECT_LT(flight["touchdown_speed_mps"], 0.2) << program;
    }
    const auto fleet = test_support::run(MONTE_CARLO_PROGRAM, with + "--count 2");
    EXPECT_EQ(fleet.exit_code, 0) << fleet.output;
    EXPECT_EQ(fleet["divergences"], 0) << fleet.output;
    const auto loop = test_support::run(RT_LOOP_PROGRAM, "--seconds 2 --vehicle '" + c.path + "'");
    EXPECT_EQ(loop.exit_code, 0) << loop.output;
    EXPECT_LT(loop["position_error_m"], 0.05) << loop.output;
  }
}

TEST(VehicleFile, EmptyTruncatedAndAbsentFiles) {
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

TEST(VehicleFile, ProgramsForFourRotorsSaySo) {
  for (const char* program : {MONTE_CARLO_PROGRAM, HITL_SIMULATOR_PROGRAM, HITL_ONBOARD_PROGRAM,
                              HITL_FLIGHT_CONTROLLER_PROGRAM, RT_LOOP_PROGRAM}) {
    const auto told = test_support::run(program, "--vehicle " + shipped("hexacopter"));
    EXPECT_EQ(told.exit_code, 2) << program;
    EXPECT_NE(told.output.find("a vehicle of 4 rotors"), std::string::npos) << told.output;
  }
}

}  // namespace
