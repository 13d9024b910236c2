// The MCAP files of the programs that fly, read by an independent reader.
// CTest: flight one_process

#include "support/mcap_reader.hpp"
#include "support/program.hpp"

#include "../../examples/support/csv.hpp"
#include "../../examples/support/flight_mcap.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <vector>

namespace mcap_test {

using test_support::McapFile;
using test_support::McapMessage;
using test_support::McapReader;
using test_support::Outcome;
using test_support::read_file;

class Mcap : public testing::Test {
 protected:
  /// A file of `ticks` ticks at 100 Hz.
  std::string write(int ticks) {
    examples::FlightMcap log(directory.file("made.mcap"), 3);
    examples::FlightSample s;
    s.estimate.emplace();
    s.external.emplace();
    s.estimate->position << 1.0, 2.0, 3.0;
    s.estimate->velocity << 0.5, 0.0, 0.0;
    s.estimate->orientation = Eigen::AngleAxisd(0.5 * tilt_ropter::pi, Eigen::Vector3d::UnitZ());
    s.estimate->angular_velocity << 0.1, 0.2, 0.3;
    s.truth.position << -1.0, -2.0, -3.0;
    s.reference.position << 7.0, 8.0, 9.0;
    s.command = {{1.0, 2.0, 3.0}, {4.0, 5.0, 6.0}};
    s.external->force << 0.0, 0.0, -0.25;
    s.true_external.torque << 0.0, 0.125, 0.0;
    s.tilt = Eigen::Vector3d(0.1, 0.2, 0.3);
    s.tilt_command = 2.0 * s.tilt;
    s.speed = Eigen::Vector3d(100.0, 200.0, 300.0);
    s.speed_command = 2.0 * s.speed;
    s.power = 250.0;
    for (int i = 0; i < ticks; ++i) {
      s.time = 0.01 * i;
      s.phase = i < 2 ? "take-off" : "air";
      s.mode = "mission";
      log.on_imu(s.time, {{0.1, 0.2, 0.3}, {0.4, 0.5, 9.81}});
      if (i % 2 == 0)
        log.on_pose(s.time, {{1.1, 2.2, 3.3}, Eigen::Quaterniond(0.5, 0.5, -0.5, 0.5)});
      log.on_tick(s);
    }
    log.close();
    return read_file(directory.file("made.mcap"));
  }

  test_support::Directory directory{"mcap"};
};

void expect_vector(const McapMessage& m, const std::string& path, const Eigen::Vector3d& v) {
  for (const int i : {0, 1, 2})
    EXPECT_NEAR(m.numbers.at(path + '.' + "xyz"[i]), v(i), 1e-12) << m.topic << ' ' << path;
}

TEST_F(Mcap, HoldsTheMessagesThatItsSchemasDescribe) {
  const McapFile file = McapReader::read(write(12));
  EXPECT_EQ(file.profile, "ros2");
  EXPECT_EQ(file.types.at("/odometry"), "nav_msgs/msg/Odometry");
  EXPECT_EQ(file.types.at("/tf"), "tf2_msgs/msg/TFMessage");
  EXPECT_EQ(file.types.at("/imu"), "sensor_msgs/msg/Imu");
  const McapMessage odometry = file.of("/odometry").at(11);
  EXPECT_EQ(odometry.time, 110000000u);
  EXPECT_EQ(odometry.numbers.at("header.stamp.nanosec"), 110000000.0);
  EXPECT_EQ(odometry.texts.at("header.frame_id"), "map");
  EXPECT_EQ(odometry.texts.at("child_frame_id"), "base_link");
  expect_vector(odometry, "pose.pose.position", {1.0, 2.0, 3.0});
  EXPECT_NEAR(odometry.numbers.at("pose.pose.orientation.z"), std::sqrt(0.5), 1e-12);
  EXPECT_NEAR(odometry.numbers.at("pose.pose.orientation.w"), std::sqrt(0.5), 1e-12);
  EXPECT_EQ(odometry.numbers.at("pose.covariance[35]"), 0.0);
  expect_vector(odometry, "twist.twist.linear", {0.0, -0.5, 0.0});  // body frame
  expect_vector(odometry, "twist.twist.angular", {0.1, 0.2, 0.3});
  expect_vector(file.of("/ground_truth/odometry").at(0), "pose.pose.position", {-1.0, -2.0, -3.0});
  expect_vector(file.of("/reference").at(0), "pose.position", {7.0, 8.0, 9.0});
  expect_vector(file.of("/wrench_command").at(0), "wrench.force", {1.0, 2.0, 3.0});
  expect_vector(file.of("/wrench_command").at(0), "wrench.torque", {4.0, 5.0, 6.0});
  expect_vector(file.of("/external_wrench").at(0), "wrench.force", {0.0, 0.0, -0.25});
  expect_vector(file.of("/ground_truth/external_wrench").at(0), "wrench.torque", {0.0, 0.125, 0.0});
  const McapMessage imu = file.of("/imu").at(3);
  expect_vector(imu, "angular_velocity", {0.1, 0.2, 0.3});
  expect_vector(imu, "linear_acceleration", {0.4, 0.5, 9.81});
  EXPECT_EQ(imu.numbers.at("orientation_covariance[0]"), -1.0);
  expect_vector(file.of("/tf").at(0), "transforms[0].transform.translation", {1.0, 2.0, 3.0});
  EXPECT_EQ(file.of("/tf").at(0).texts.at("transforms[0].child_frame_id"), "base_link");
  const McapMessage pose = file.of("/pose").at(1);
  EXPECT_EQ(pose.time, 20000000u);
  EXPECT_EQ(pose.numbers.at("pose.orientation.y"), -0.5);
  const McapMessage tilt = file.of("/tilt_commands").at(0), speed = file.of("/rotor_speeds").at(0);
  EXPECT_EQ(tilt.texts.at("name[2]"), "tilt_3");
  EXPECT_EQ(tilt.numbers.at("position[2]"), 0.6);
  EXPECT_EQ(tilt.numbers.count("velocity[0]"), 0u);
  EXPECT_EQ(speed.texts.at("name[0]"), "rotor_1");
  EXPECT_EQ(speed.numbers.at("velocity[1]"), 200.0);
  EXPECT_EQ(file.of("/rotor_speed_commands").at(0).numbers.at("velocity[1]"), 400.0);
  EXPECT_EQ(file.of("/tilt_angles").at(0).numbers.at("position[0]"), 0.1);
  EXPECT_EQ(file.of("/power").at(0).numbers.at("data"), 250.0);
  ASSERT_EQ(file.of("/phase").size(), 2u);  // where it changes
  EXPECT_EQ(file.of("/phase").at(1).texts.at("data"), "air");
  EXPECT_EQ(file.of("/flight_mode").at(0).texts.at("data"), "mission");
  EXPECT_EQ(file.chunks, 1u);
}

TEST_F(Mcap, AFileOfSeveralChunksHasAnIndexOfAll) {
  const McapFile file = McapReader::read(write(800));
  EXPECT_EQ(file.chunks, 3u);
  EXPECT_EQ(file.of("/odometry").size(), 800u);
  EXPECT_EQ(file.of("/pose").size(), 400u);
}

// So that the reader of these tests sees what is wrong with a file.
TEST_F(Mcap, TheReaderRefusesASpoiltFile) {
  const std::string good = write(2);
  EXPECT_NO_THROW((void)McapReader::read(good));
  for (std::size_t i = 0; i < good.size(); i += 7) {
    std::string spoilt = good;
    spoilt[i] = static_cast<char>(spoilt[i] ^ 0x10);
    EXPECT_ANY_THROW((void)McapReader::read(spoilt)) << i;
  }
  EXPECT_ANY_THROW((void)McapReader::read(good.substr(0, good.size() / 2)));
}

TEST_F(Mcap, RefusesWhatItCannotWrite) {
  EXPECT_THROW(examples::FlightMcap("/proc/nowhere", 4), std::runtime_error);
  EXPECT_THROW((void)examples::ros2_definition("nav_msgs/msg/Path"), std::invalid_argument);
  EXPECT_THROW(examples::FlightMcap("/dev/full", 4), std::runtime_error);
  examples::McapWriter full("/dev/full");
  EXPECT_THROW(full.close(), std::runtime_error);
}

/// The fields of the messages, by name of the message, from the IDL of the nodes in integrations/,
/// which are those of ROS 2: "float64 x" as in a ros2msg schema.
std::string from_idl(const std::string& package, const std::string& message) {
  std::istringstream text(
      read_file(MISSIONS_DIR "/../integrations/idl/" + package + ".idl"));  // set by CMake
  std::string fields;
  bool inside = false;
  for (std::string line; std::getline(text, line);) {
    if (line == "struct " + message + "_ {") inside = true;
    if (line == "};") inside = false;
    std::istringstream words(line);
    std::string type, name;
    if (!inside || !(words >> type >> name) || type == "struct" || type == "//") continue;
    std::string count;
    if (type.substr(0, 9) == "sequence<") {
      type = type.substr(9, type.size() - 10);
      count = "[]";
    }
    name.pop_back();
    if (const std::size_t bracket = name.find('['); bracket != std::string::npos) {
      count = name.substr(bracket);
      name.erase(bracket);
    }
    if (const std::size_t middle = type.find("::msg::dds_::"); middle != std::string::npos)
      type = type.substr(0, middle) + '/' + type.substr(middle + 13, type.size() - middle - 14);
    else if (type.back() == '_')
      type = package + '/' + type.substr(0, type.size() - 1);
    fields += (type == "double" ? "float64" : type) + count + ' ' + name + '\n';
  }
  return fields;
}

TEST_F(Mcap, SchemasAreTheMessagesOfTheNodes) {
  int compared = 0;
  for (const char* type : {"nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu",
                           "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped",
                           "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"}) {
    std::string name = type, text = examples::ros2_definition(type);
    name.erase(name.find("/msg"), 4);
    for (std::size_t end = 0; end != std::string::npos; ++compared) {
      end = text.find("====");
      const std::size_t middle = name.find('/');
      EXPECT_EQ(text.substr(0, end), from_idl(name.substr(0, middle), name.substr(middle + 1)))
          << name;
      if (end == std::string::npos) continue;
      text.erase(0, text.find("MSG: ") + 5);
      name = text.substr(0, text.find('\n'));
      text.erase(0, name.size() + 1);
    }
  }
  EXPECT_GT(compared, 30);
}

/// The rows of hybrid_mission.csv and the messages of the same ticks.
void expect_same(const std::string& log, const std::string& mcap) {
  const examples::CsvTable table = examples::read_csv(log, {}, examples::CsvNumbers::any);
  const McapFile file = McapReader::read(read_file(mcap));
  const std::vector<McapMessage> truth = file.of("/ground_truth/odometry"),
                                 speeds = file.of("/rotor_speeds");
  ASSERT_EQ(truth.size(), table.rows());
  for (std::size_t i = 0; i < truth.size(); ++i) {
    EXPECT_NEAR(1e-9 * static_cast<double>(truth[i].time), table["time_s"][i], 1e-6);
    EXPECT_NEAR(truth[i].numbers.at("pose.pose.position.z"), table["position_m_z"][i], 1e-6);
    EXPECT_NEAR(speeds[i].numbers.at("velocity[3]"), table["rotor_speed_radps_4"][i], 1e-3);
  }
  const double flown = table["time_s"].back() - table["time_s"].front();
  EXPECT_NEAR(static_cast<double>(file.of("/imu").size()), 1000.0 * flown, 150.0);
  EXPECT_NEAR(static_cast<double>(file.of("/pose").size()), 100.0 * flown, 15.0);
}

TEST_F(Mcap, HybridMissionWritesItsFlight) {
  const std::string mission =
      directory.write("mission.json", R"({"name": "hover", "start": {"position_m": [0, 0, 1]},
        "segments": [{"type": "hover", "duration_s": 2}]})");
  const std::string options = "--no-pictures --mission-file '" + mission + "' --output '" +
                              directory.file("out") + "' --mcap ";
  const Outcome flown =
      test_support::run(HYBRID_MISSION_PROGRAM, options + directory.file("flown.mcap"));
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  expect_same(directory.file("out") + "/hybrid_mission.csv", directory.file("flown.mcap"));
  const Outcome refused = test_support::run(HYBRID_MISSION_PROGRAM, options + "/proc/nowhere");
  EXPECT_EQ(refused.exit_code, 1);
  EXPECT_TRUE(refused.says("cannot write /proc/nowhere")) << refused.output;
}

TEST_F(Mcap, OtherProgramsHaveTheOption) {
  for (const char* program : {HYBRID_MISSION_PROGRAM, COMPARE_VEHICLES_PROGRAM, MONTE_CARLO_PROGRAM,
                              REPRODUCE_PAPER_PROGRAM})
    EXPECT_TRUE(test_support::run(program, "--help").says("--mcap")) << program;
  EXPECT_GT(test_support::run(MONTE_CARLO_PROGRAM, "--mcap x.mcap").exit_code, 100);
}

}  // namespace mcap_test
