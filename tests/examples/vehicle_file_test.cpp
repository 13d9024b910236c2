// Vehicle files are read and written without loss, and their vehicles fly without tuning.
// CTest: flight

#include "../../examples/support/vehicle_choice.hpp"

#include "support/full_run.hpp"
#include "support/program.hpp"
#include "support/vehicle_files.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cstddef>
#include <functional>
#include <sstream>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

namespace vehicle_file_test {

using examples::VehicleFile;
using test_support::shipped;
using test_support::with;

struct Vehicle {
  const char* name;
  bool drives;
};

class ShippedVehicle : public testing::TestWithParam<Vehicle> {};

// All parameters are those of the file, with the default weights.
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

TEST(VehicleFile, WritesTheShippedTiltRopterFileAndReadsItBack) {
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

TEST(VehicleFile, ReadAndWriteRoundTripKeepsAllFields) {
  const test_support::Directory directory("vehicle_file");
  for (const char* name : {"tilt_ropter", "hexacopter", "octocopter", "five_kilograms"}) {
    const std::string once = directory.file("once.json"), twice = directory.file("twice.json");
    VehicleFile file = examples::read_vehicle(shipped(name));
    file.limits.angular_velocity << 1.0, 2.0, 3.5;  // differs from the default
    file.battery_wh = 12.5;
    file.ground = {0.625, 0.0625, 0.25};
    std::visit(
        [](auto& vehicle) {
          vehicle.battery = {14.8, 5.25, 16.5, 13.25, 0.0125};
          vehicle.power.servo_hold = 0.75;
          vehicle.power.servo_move = 0.125;
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
    EXPECT_EQ(again.settings().ground.down_force, 0.625);
    EXPECT_EQ(again.settings().ground.rotor_thrust, 0.0625);
    EXPECT_EQ(again.settings().ground.settling_speed, 0.25);
    std::visit(
        [&](const auto& vehicle) {
          const auto& written = std::get<std::decay_t<decltype(vehicle)>>(file.vehicle);
          EXPECT_EQ(vehicle.battery.nominal_voltage, 14.8);
          EXPECT_EQ(vehicle.battery.capacity, 5.25);
          EXPECT_EQ(vehicle.battery.full_voltage, 16.5);
          EXPECT_EQ(vehicle.battery.empty_voltage, 13.25);
          EXPECT_EQ(vehicle.battery.resistance, 0.0125);
          EXPECT_EQ(vehicle.power.servo_hold, 0.75);
          EXPECT_EQ(vehicle.power.servo_move, 0.125);
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

/// A rotor that is given by its axes equals the same rotor given by its arm.
// Nobody knows it before the first flight. The true one is 653.64 W.
TEST(VehicleFile, PowerOfHoverIsEstimatedWhereTheFileHasNone) {
  std::istringstream in(
      with(test_support::read_file(shipped("tilt_ropter")), "\"hover_w\": 653.64,", ""));
  const auto vehicle = std::get<tilt_ropter::Vehicle<4>>(examples::read_vehicle(in, "").vehicle);
  EXPECT_NEAR(vehicle.power.hover, 653.64, 0.15 * 653.64);
  EXPECT_NE(vehicle.power.hover, 653.64);
}

TEST(VehicleFile, RotorByAxesEqualsRotorOnArm) {
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

/// A parameter of one rotor applies to this rotor only. Each field can be given alone.
TEST(VehicleFile, RotorFieldsOverrideCommonParameters) {
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

/// A vehicle of 5 kg with four different rotors: two have a linear thrust term, one is weaker.
TEST(VehicleFile, VehicleWithUnlikeRotorsFliesWithoutTuning) {
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
               "\"allowed_errors\": {\"position_m\": [0.1, 0.2, 0.5], \"tilt_rate_radps\": 5}, ");
  std::istringstream in(text);
  const VehicleFile file = examples::read_vehicle(in, "");
  const auto weights = file.settings().problem.weights;
  EXPECT_TRUE(weights.position.isApprox(Eigen::Vector3d(100.0, 25.0, 4.0), 1e-12));
  // Allowed forces scale with the weight: the factor is 1.5 kg / 5 kg = 0.3, squared.
  EXPECT_NEAR(weights.force.x(), 0.02 * 0.3 * 0.3, 1e-6);
  EXPECT_EQ(file.allowed_errors.tilt_rate, 5.0);  // of the actuator level
}

TEST(VehicleFile, ReadsWheelsLegsOrNoUndercarriage) {
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

  // Writing and reading back keeps the legs.
  const test_support::Directory directory("vehicle_file");
  const std::string path = directory.file("legs.json");
  std::istringstream in("{" + legs + good.substr(1));
  const VehicleFile file = examples::read_vehicle(in, "file");
  examples::write_vehicle(file, path);
  EXPECT_EQ(
      std::get<tilt_ropter::Vehicle<8>>(examples::read_vehicle(path).vehicle).legs->half_width,
      0.1);
}

/// Writes the Tilt-Ropter with a change to a file and returns its path.
std::string changed_vehicle(const test_support::Directory& directory, const char* name,
                            const std::function<void(tilt_ropter::Vehicle<4>&)>& change) {
  VehicleFile file;
  change(std::get<tilt_ropter::Vehicle<4>>(file.vehicle));
  std::string path = directory.file(std::string(name) + ".json");
  examples::write_vehicle(file, path);
  return path;
}

// A vehicle on legs, one without undercarriage, and one whose servos have a dead time. In the short
// form, only the first flies in all programs except MuJoCo, the others only the mission.
TEST(VehicleFile, ProgramsAcceptVehiclesWithoutWheelsOrWithDeadTime) {
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
    if (test_support::full_run()) missions.emplace_back(MISSION_MUJOCO_PROGRAM);
#endif
    for (const std::string& program : missions) {
      const auto flight = test_support::run(program, with);
      ASSERT_EQ(flight.exit_code, 0) << flight.output;
      EXPECT_EQ(flight["contact_mode_changes"], c.mode_changes) << program;
      EXPECT_LT(flight["mission_rmse_m"], 0.01) << program;
      EXPECT_LT(flight["touchdown_speed_mps"], 0.2) << program;
    }
    if (c.mode_changes != 2 && !test_support::full_run()) continue;
    const auto fleet = test_support::run(MONTE_CARLO_PROGRAM, with + "--count 2");
    EXPECT_EQ(fleet.exit_code, 0) << fleet.output;
    EXPECT_EQ(fleet["divergences"], 0) << fleet.output;
    const auto loop = test_support::run(RT_LOOP_PROGRAM, "--seconds 2 --vehicle '" + c.path + "'");
    EXPECT_EQ(loop.exit_code, 0) << loop.output;
    // After a tick that is too late, the vehicle flies with an old command.
    if (test_support::full_run() || loop["missed_deadlines"] == 0.0) {
      EXPECT_LT(loop["position_error_m"], 0.05) << loop.output;
    }
  }
}

}  // namespace vehicle_file_test
