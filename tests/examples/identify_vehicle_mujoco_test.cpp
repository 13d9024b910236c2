// Identifies the vehicle in MuJoCo, a model that the identification does not share, and flies with
// the result, as a user does.
// CTest: flight mujoco long

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <string>

namespace identify_vehicle_mujoco_test {

using test_support::Outcome;
using test_support::read_file;
using test_support::run;

TEST(IdentifyVehicleMujoco, FindsTheVehicleAndFliesAsWellAsWithTheTruth) {
  const test_support::Directory directory("identify_vehicle_mujoco");
  const auto quoted = [&](const char* name) { return " '" + directory.file(name) + "'"; };
  const std::string output = " --no-pictures --output" + quoted("out");
  // The plant has 3 % more mass and 10 % more inertia than the given file.
  const Outcome excited =
      run(MISSION_MUJOCO_PROGRAM, "--excite --log-imu" + quoted("log.csv") + output);
  ASSERT_EQ(excited.exit_code, 0) << excited.output;
  const Outcome found = run(IDENTIFY_VEHICLE_PROGRAM, quoted("log.csv") + output);
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found.figures.at("status"), "identified");
  EXPECT_EQ(found.figures.at("not_excited"), "none");
  const auto expect = [&found](const char* name, double truth, double allowed) {
    EXPECT_NEAR(found[name], truth, allowed) << name;
  };
  // With the mass trusted, all forces count 1.03 times less.
  expect("mass_over_thrust_coefficient_rad2_per_m", 1.545 / 1.4e-6, 0.01 * 1.545 / 1.4e-6);
  for (const char* name : {"com_x_m", "com_y_m", "com_z_m"}) expect(name, 0.0, 0.001);
  expect("inertia_x_kg_m2", 0.0154 / 1.03, 0.05 * 0.0154);
  expect("inertia_y_kg_m2", 0.0154 / 1.03, 0.05 * 0.0154);
  expect("inertia_z_kg_m2", 0.0275 / 1.03, 0.05 * 0.0275);
  expect("torque_ratio_m", 0.016, 0.05 * 0.016);
  expect("rotor_time_constant_s", 0.03, 0.05 * 0.03);
  // The servo drives an arm with inertia by a torque. The lag that is found has the same delay; its
  // time constant alone is 5 % shorter.
  EXPECT_NEAR(found["servo_time_constant_s"] + found["servo_dead_time_s"], 0.08, 0.05 * 0.08);

  // The file that knows the plant.
  ASSERT_EQ(run(HYBRID_MISSION_PROGRAM, "--write-vehicle" + quoted("given.json")).exit_code, 0);
  std::string truth = read_file(directory.file("given.json"));
  const auto replace = [&truth](const std::string& from, const std::string& to) {
    const std::size_t at = truth.find(from);
    ASSERT_NE(at, std::string::npos) << from;
    truth.replace(at, from.size(), to);
  };
  replace("\"mass_kg\": 1.5", "\"mass_kg\": 1.545");
  replace("[0.014, 0.014, 0.025]", "[0.0154, 0.0154, 0.0275]");
  directory.write("truth.json", truth);
  const std::string mission = test_support::full_run() ? "" : "--mission air ";
  const auto errors = [&](const std::string& model, int seed) {
    Outcome flown = run(MISSION_MUJOCO_PROGRAM, mission + "--model '" + directory.file(model) +
                                                    "' --seed " + std::to_string(seed) + output);
    EXPECT_EQ(flown.exit_code, 0) << flown.output;
    EXPECT_EQ(flown["solver_failures"], 0);
    return flown;
  };
  for (int seed = 1; seed <= test_support::quick_or_full(1, 5); ++seed) {
    const Outcome with_truth = errors("truth.json", seed),
                  with_found = errors("out/identified_vehicle.json", seed);
    for (const char* figure : {"air_rmse_m", "mission_rmse_m"})
      EXPECT_LE(with_found[figure], 1.1 * with_truth[figure] + 1e-4)  // printed to 0.1 mm
          << figure;
  }
}

TEST(IdentifyVehicleMujoco, ModelNeedsTheRotorsOfTheVehicle) {
  const test_support::Directory directory("identify_vehicle_mujoco");
  const Outcome refused = run(MISSION_MUJOCO_PROGRAM, "--model /proc/nowhere --no-pictures -o '" +
                                                          directory.file("out") + "'");
  EXPECT_EQ(refused.exit_code, 2) << refused.output;
  EXPECT_TRUE(refused.says("/proc/nowhere")) << refused.output;
  const Outcome six =
      run(MISSION_MUJOCO_PROGRAM, "--model '" VEHICLES_DIR "/hexacopter.json' --no-pictures -o '" +
                                      directory.file("out") + "'");
  EXPECT_NE(six.exit_code, 0);
  EXPECT_TRUE(six.says("as many rotors")) << six.output;
}

}  // namespace identify_vehicle_mujoco_test
