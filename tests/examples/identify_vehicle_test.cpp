// Runs hybrid_mission --excite and identify_vehicle as a user does.
// CTest: flight one_process

#include "support/full_run.hpp"
#include "support/program.hpp"
#include "support/ulog_writer.hpp"

#include "../../examples/support/csv.hpp"

#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

namespace identify_vehicle_test {

using test_support::Directory;
using test_support::Outcome;
using test_support::read_file;
using test_support::run;

class IdentifyVehicle : public testing::Test {
 protected:
  /// The log of a flight whose mass and inertia are 3 % and 10 % above those of the Tilt-Ropter.
  static void SetUpTestSuite() {
    directory = new Directory("identify_vehicle");
    const Outcome flown = run(HYBRID_MISSION_PROGRAM, "--excite --no-pictures --log-imu '" + log() +
                                                          "' --output '" + path("mission") + "'");
    ASSERT_EQ(flown.exit_code, 0) << flown.output;
    EXPECT_EQ(flown["solver_failures"], 0);
    EXPECT_FALSE(flown.says("the reference asks for")) << flown.output;
  }
  static void TearDownTestSuite() { delete directory; }

  static std::string path(const std::string& name) { return directory->file(name); }
  static std::string log() { return path("log.csv"); }
  static Outcome identify(const std::string& file, const std::string& options = "") {
    return run(IDENTIFY_VEHICLE_PROGRAM,
               "'" + file + "' --no-pictures --output '" + path("out") + "' " + options);
  }
  /// The first `rows` rows of the log, after `change(columns, fields)`.
  template <typename Change>
  static std::string changed(std::size_t rows, const Change& change) {
    std::ifstream in(log());
    std::ofstream out(path("changed.csv"));
    std::vector<std::string> header;
    std::string text;
    for (std::size_t row = 0; row <= rows && std::getline(in, text); ++row) {
      std::vector<std::string> fields;
      std::istringstream line(text);
      for (std::string field; std::getline(line, field, ',');) fields.push_back(field);
      if (row == 0) header = fields;
      change(row, header, fields);
      for (std::size_t i = 0; i < fields.size(); ++i) out << (i ? "," : "") << fields[i];
      out << '\n';
    }
    return path("changed.csv");
  }

  static Directory* directory;
};
Directory* IdentifyVehicle::directory = nullptr;

void expect_near(const Outcome& found, const std::string& name, const std::string& unit,
                 double truth, double allowed) {
  EXPECT_NEAR(found[name + unit], truth, allowed) << found.output;
  EXPECT_GT(found[name + "_95" + unit], 0.0) << name;
  EXPECT_LT(found[name + "_95" + unit], 2.0 * allowed) << name;
}

// With the mass trusted, all forces count 1.03 times less.
TEST_F(IdentifyVehicle, FindsTheVehicleThatFlew) {
  const Outcome found = identify(log());
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found.figures.at("status"), "identified");
  EXPECT_EQ(found.figures.at("not_excited"), "none");
  expect_near(found, "thrust_coefficient", "_n_s2_per_rad2", 1.4e-6 / 1.03, 0.01e-6);
  expect_near(found, "mass_over_thrust_coefficient", "_rad2_per_m", 1.545 / 1.4e-6, 1e4);
  for (const char* axis : {"com_x", "com_y", "com_z"}) expect_near(found, axis, "_m", 0.0, 0.001);
  expect_near(found, "inertia_x", "_kg_m2", 0.0154 / 1.03, 0.0005);
  expect_near(found, "inertia_y", "_kg_m2", 0.0154 / 1.03, 0.0005);
  expect_near(found, "inertia_z", "_kg_m2", 0.0275 / 1.03, 0.0008);
  expect_near(found, "torque_ratio", "_m", 0.016, 0.0005);
  expect_near(found, "servo_time_constant", "_s", 0.08, 0.004);
  expect_near(found, "servo_dead_time", "_s", 0.0, 0.003);
  expect_near(found, "rotor_time_constant", "_s", 0.03, 0.0015);
  expect_near(found, "rotor_dead_time", "_s", 0.0, 0.002);
  for (const char* axis : {"drag_x", "drag_y", "drag_z"})
    expect_near(found, axis, "_n_s_per_m", 0.0, 0.05);
  EXPECT_EQ(found["servo_rate_limited_fraction"], 0.0);
  EXPECT_LT(found["force_residual_mps2"], 0.02);
}

TEST_F(IdentifyVehicle, TrustedThrustGivesTheMass) {
  if (!test_support::full_run())
    GTEST_SKIP() << "the library's vehicle_identification_test: --full";
  const Outcome found = identify(log(), "--trust thrust");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  expect_near(found, "mass", "_kg", 1.545, 0.015);
  expect_near(found, "inertia_z", "_kg_m2", 0.0275, 0.0008);
}

TEST_F(IdentifyVehicle, WithoutRotorSpeedsTheirLagFollowsFromTheMotion) {
  if (!test_support::full_run())
    GTEST_SKIP() << "the library's vehicle_identification_test: --full";
  const std::string file =
      changed(1000000, [](std::size_t row, const auto&, std::vector<std::string>& fields) {
        if (row > 0) return;
        for (std::string& name : fields)
          if (name.find("rotor_speed") == 0) name = "no_" + name;
      });
  const Outcome found = identify(file);
  ASSERT_EQ(found.exit_code, 0) << found.output;
  expect_near(found, "rotor_time_constant", "_s", 0.03, 0.005);
  expect_near(found, "inertia_z", "_kg_m2", 0.0275 / 1.03, 0.0015);
}

TEST_F(IdentifyVehicle, OtherToolsAcceptItsVehicleFile) {
  if (!test_support::full_run()) GTEST_SKIP() << "readme_commands flies with one: --full";
  ASSERT_EQ(identify(log()).exit_code, 0);
  const std::string vehicle = "'" + path("out") + "/identified_vehicle.json'";
  const Outcome checked = run(CHECK_VEHICLE_PROGRAM, vehicle + " --no-pictures");
  EXPECT_EQ(checked.exit_code, 0) << checked.output;
  const Outcome flown =
      run(HYBRID_MISSION_PROGRAM,
          "--mission air --mass-error 0 --inertia-error 0 --no-pictures --vehicle " + vehicle +
              " --output '" + path("mission") + "'");
  EXPECT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_EQ(flown["solver_failures"], 0);
  EXPECT_LT(flown["air_rmse_m"], 0.01);
}

TEST_F(IdentifyVehicle, ReportsWhatAHoverDoesNotExcite) {
  if (!test_support::full_run())
    GTEST_SKIP() << "the library's vehicle_identification_test: --full";
  const std::string still = path("still.csv");
  std::ofstream(still) << "time_s,x_m,y_m,z_m\n0,0,0,1.5\n10,0,0,1.5\n";
  ASSERT_EQ(
      run(HYBRID_MISSION_PROGRAM, "--trajectory '" + still + "' --no-pictures --log-imu '" +
                                      path("hover.csv") + "' --output '" + path("mission") + "'")
          .exit_code,
      0);
  const Outcome found = identify(path("hover.csv"));
  ASSERT_EQ(found.exit_code, 0) << found.output;
  const std::string missing = found.figures.at("not_excited");
  for (const char* name : {"inertia_z", "servo_time_constant", "servo_dead_time"})
    EXPECT_NE(missing.find(name), std::string::npos) << name << " in " << missing;
  EXPECT_EQ(missing.find("thrust_per_mass"), std::string::npos) << missing;
  EXPECT_TRUE(found.says("servo_time_constant_s: 0.08 (not excited)")) << found.output;
  EXPECT_GT(found["servo_time_constant_95_s"], 0.2 * 0.08);
  EXPECT_NEAR(found["thrust_coefficient_n_s2_per_rad2"], 1.4e-6 / 1.03, 0.02e-6);
}

TEST_F(IdentifyVehicle, BadLogsAreNamedErrors) {
  const auto refusal = [](const std::string& file, const std::string& options = "") {
    const Outcome refused = identify(file, options);
    EXPECT_EQ(refused.exit_code, 2) << refused.output;
    EXPECT_FALSE(refused.says("fly with it"));
    return refused.output;
  };
  const auto says = [](const std::string& text, const std::string& part) {
    return text.find(part) != std::string::npos;
  };
  const auto set = [](std::size_t at, const std::string& column, const std::string& value) {
    return [=](std::size_t row, const auto& header, std::vector<std::string>& fields) {
      for (std::size_t i = 0; i < header.size(); ++i)
        if (row == at && header[i] == column) fields[i] = value;
    };
  };
  EXPECT_TRUE(says(refusal(path("nowhere.csv")), "cannot read"));
  EXPECT_TRUE(says(refusal(changed(5, set(0, "tilt_command_rad_3", "x"))),
                   "changed.csv:1: no column tilt_command_rad_3"));
  EXPECT_TRUE(says(refusal(changed(5, set(0, "rotor_speed_radps_2", "x"))),
                   "no column rotor_speed_radps_2"));
  EXPECT_TRUE(says(refusal(changed(5, set(3, "specific_force_mps2_y", "nan"))),
                   "changed.csv:4: column specific_force_mps2_y (6): 'nan' is not finite"));
  EXPECT_TRUE(says(refusal(changed(5, set(4, "time_s", "0"))),
                   "changed.csv:5: column time_s does not increase"));
  EXPECT_TRUE(says(refusal(changed(500, set(400, "pose_time_s", "-1"))),
                   "changed.csv:401: column pose_time_s decreases"));
  EXPECT_TRUE(says(refusal(changed(50, set(0, "none", ""))), "too few IMU samples"));
  EXPECT_TRUE(says(refusal(changed(3000, set(0, "none", ""))), "too short"));
  EXPECT_TRUE(says(refusal(log(), "--from 5 --until 8"), "too short"));
  EXPECT_TRUE(says(refusal(log(), "--min-height 3"), "too short"));
  // Times in ms, and the telemetry of two rotors exchanged.
  EXPECT_TRUE(says(refusal(changed(2000,
                                   [](std::size_t row, const auto& header, auto& fields) {
                                     for (std::size_t i = 0; i < header.size() && row > 0; ++i)
                                       if (header[i] == "rotor_speed_time_s") fields[i] += "e3";
                                   })),
                   "another clock or unit"));
  EXPECT_TRUE(says(refusal(changed(1000000,
                                   [](std::size_t row, const auto& header, auto& fields) {
                                     for (std::size_t i = 0; i < header.size() && row > 0; ++i)
                                       if (header[i] == "rotor_speed_radps_1")
                                         std::swap(fields[i], fields[i + 1]);
                                   })),
                   "the measured speed of rotor 1 follows the command of rotor 2"));
  EXPECT_EQ(identify(log(), "--vehicle /proc/nowhere").exit_code, 2);
  EXPECT_EQ(
      run(IDENTIFY_VEHICLE_PROGRAM, "'" + log() + "' --no-pictures -o /proc/nowhere").exit_code, 2);
}

/// The log as PX4 would write it: normalised outputs, speeds in rpm, floats.
std::string as_ulog(const std::string& csv) {
  using namespace tilt_ropter;
  using test_support::microseconds;
  using test_support::Packed;
  const examples::CsvTable t = examples::read_csv(csv);
  const OutputScaling<4> scaling(tilt_ropter_vehicle(), {0.3, {}});
  test_support::UlogWriter log;
  for (const char* format : test_support::px4_formats) log.format(format);
  const std::uint16_t imu = log.subscribe("sensor_combined"),
                      odometry = log.subscribe("vehicle_odometry"),
                      motors = log.subscribe("actuator_motors"),
                      servos = log.subscribe("actuator_servos"), escs = log.subscribe("esc_status");
  const auto vector = [&t](const std::string& name, std::size_t row) {
    return Eigen::Vector3d(t[name + "_x"][row], t[name + "_y"][row], t[name + "_z"][row]);
  };
  const auto rotors = [&t](const std::string& name, std::size_t row) {
    return Eigen::Vector4d(t[name + "_1"][row], t[name + "_2"][row], t[name + "_3"][row],
                           t[name + "_4"][row]);
  };
  for (std::size_t i = 0; i < t.rows(); ++i) {
    const double time = t["time_s"][i];
    log.data(imu, test_support::sensor_combined(time, vector("angular_velocity_radps", i),
                                                vector("specific_force_mps2", i)));
    if (i == 0 || t["pose_time_s"][i] > t["pose_time_s"][i - 1]) {
      const Eigen::Vector3d v = vector("orientation", i);
      log.data(odometry, test_support::vehicle_odometry(
                             t["pose_time_s"][i], vector("position_m", i),
                             Eigen::Quaterniond(t["orientation_w"][i], v.x(), v.y(), v.z()),
                             Eigen::Vector3d(0.0, 0.0, 0.0)));
    }
    const Eigen::Vector4d speeds = rotors("rotor_command_radps", i);
    if (i == 0 || speeds != rotors("rotor_command_radps", i - 1)) {
      const auto outputs = *scaling.outputs<double>({speeds, rotors("tilt_command_rad", i)});
      const std::uint64_t now = microseconds(time);
      log.data(
          motors,
          Packed().add(now).add(now).add_floats(outputs.motor).add(std::string(8 * 4 + 2, '\0')));
      log.data(servos,
               Packed().add(now).add(now).add_floats(outputs.servo).add(std::string(4 * 4, '\0')));
    }
    if (i > 0 && t["rotor_speed_time_s"][i] == t["rotor_speed_time_s"][i - 1]) continue;
    const std::uint64_t now = microseconds(t["rotor_speed_time_s"][i]);
    Packed m;
    m.add(now).add(std::string(8, '\0'));
    const Eigen::Vector4d measured = rotors("rotor_speed_radps", i);
    for (int k = 0; k < 8; ++k) {  // ESC 3 is motor 1 and the other way round
      const int motor = k == 0 ? 2 : k == 2 ? 0 : k;
      const double rpm = motor < 4 ? measured(motor) * 30.0 / pi : 0.0;
      m.add(now).add(std::uint32_t{0}).add(static_cast<std::int32_t>(std::lround(rpm)));
      m.add(std::string(12 + 2 + 3, '\0'));
      m.add(static_cast<std::uint8_t>(motor < 4 ? 101 + motor : 0));
      m.add(std::string(k < 7 ? 6 : 1, '\0'));
    }
    log.data(escs, m);
  }
  return log.bytes();
}

TEST_F(IdentifyVehicle, ReadsALogOfPx4) {
  std::ofstream(path("log.ulg"), std::ios::binary) << as_ulog(log());
  const Outcome csv = identify(log()),
                found = identify(path("log.ulg"), "--thrust-model-factor 0.3");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_TRUE(found.says("poses are those of vehicle_odometry"));
  EXPECT_EQ(found.figures.at("not_excited"), "none");
  for (const char* name : {"thrust_coefficient_n_s2_per_rad2", "inertia_x_kg_m2", "inertia_z_kg_m2",
                           "torque_ratio_m", "servo_time_constant_s", "rotor_time_constant_s"})
    EXPECT_NEAR(found[name], csv[name], 2e-3 * csv[name]) << name;
  EXPECT_NEAR(found["com_x_m"], csv["com_x_m"], 1e-4);
  const Outcome other = identify(path("log.ulg"));  // another thrust model
  EXPECT_NE(other.figures, found.figures);
  const Outcome missing = identify(path("log.ulg"), "--pose-topic vehicle_mocap_odometry");
  EXPECT_EQ(missing.exit_code, 2);
  EXPECT_TRUE(missing.says("no data of vehicle_mocap_odometry")) << missing.output;
}

TEST_F(IdentifyVehicle, StandingStillExcitesNothing) {
  std::ofstream out(path("standing.csv"));
  std::ifstream in(log());
  std::string header;
  std::getline(in, header);
  out << header << '\n';
  const auto columns = static_cast<std::size_t>(std::count(header.begin(), header.end(), ',')) + 1;
  for (int row = 0; row < 8000; ++row) {
    // time, gyroscope, accelerometer, time of the pose, position, orientation w x y z, zeros
    const std::string time = std::to_string(0.001 * row);
    out << time << ",0,0,0,0,0,9.81," << time << ",0,0,1,1,0,0,0";
    for (std::size_t i = 15; i < columns; ++i) out << ',' << (i + 5 == columns ? time : "0");
    out << '\n';
  }
  out.close();
  const Outcome refused = identify(path("standing.csv"));
  EXPECT_EQ(refused.exit_code, 2) << refused.output;
  EXPECT_TRUE(refused.says("nothing excited")) << refused.output;
}

TEST_F(IdentifyVehicle, DrawsPictureWithoutWarnings) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  const Outcome drawn =
      run(IDENTIFY_VEHICLE_PROGRAM, "'" + log() + "' --output '" + path("drawn") + "'");
  EXPECT_EQ(drawn.exit_code, 0) << drawn.output;
  EXPECT_EQ(drawn.output.find("arning"), std::string::npos) << drawn.output;
  EXPECT_GT(std::filesystem::file_size(path("drawn") + "/identify_vehicle.png"), 10000u);
}

TEST_F(IdentifyVehicle, HelpAndBadArguments) {
  const Outcome help = run(IDENTIFY_VEHICLE_PROGRAM, "--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_TRUE(help.says("specific_force_mps2_x"));
  EXPECT_GT(run(IDENTIFY_VEHICLE_PROGRAM, "").exit_code, 100);
  EXPECT_GT(identify(log(), "--trust inertia").exit_code, 100);
  EXPECT_GT(run(HYBRID_MISSION_PROGRAM, "--excite --mission air").exit_code, 100);
}

}  // namespace identify_vehicle_test
