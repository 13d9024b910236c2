// Surfaces that a mission keeps off: read, written, refused by name, and flown in both plants.
// CTest: flight mujoco

#include "../../examples/support/mission_file.hpp"
#include "support/program.hpp"

#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <gtest/gtest.h>

#include <optional>
#include <sstream>
#include <string>

namespace corridor_mission_test {

using namespace tilt_ropter;

Mission read(const std::string& surfaces) {
  std::istringstream in(R"({"name": "x", "start": {"position_m": [0, 0, 1]}, "segments": [)"
                        R"({"type": "hover", "duration_s": 1, "keep_off": )" +
                        surfaces + R"(}, {"type": "go_to", "position_m": [1, 0, 1]}]})");
  return examples::read_mission(in, "file", std::nullopt);
}

std::string error_of(const std::string& surfaces) {
  try {
    (void)read(surfaces);
  } catch (const examples::MissionFileError& error) {
    return error.what();
  }
  return "no error";
}

TEST(CorridorMission, KeepsOffInItsSegmentOnly) {
  const Mission mission =
      read(R"([{"surface_point_m": [3, 5, 7], "normal": [0, -2, 0], "distance_m": 0.4}])");
  const ReferencePoint in = mission(0.5), after = mission(1.5);
  EXPECT_EQ(in.inside[0].normal, -Eigen::Vector3d::UnitY());
  EXPECT_NEAR(in.inside[0].beyond({100.0, 4.7, 100.0}), 0.1, 1e-12);
  EXPECT_EQ(in.inside[1].normal, Eigen::Vector3d::Zero());
  EXPECT_EQ(after.inside[0].normal, Eigen::Vector3d::Zero());
}

TEST(CorridorMission, IsWrittenAsItWasRead) {
  const test_support::Directory directory("corridor_mission");
  const std::string path = directory.file("written.json");
  const std::optional<Undercarriage> wheels = undercarriage(tilt_ropter_vehicle());
  const Mission mission = examples::read_mission(MISSIONS_DIR "/corridor.json", wheels);
  examples::write_mission(mission, wheels, path);
  const Mission again = examples::read_mission(path, wheels);
  int half_spaces = 0;
  for (double time = 0.0; time < mission.end_time(); time += 0.1)
    for (std::size_t i = 0; i < 4; ++i) {
      const HalfSpace a = mission(time).inside[i], b = again(time).inside[i];
      half_spaces += !a.normal.isZero(0.0);
      ASSERT_LT((a.normal - b.normal).norm(), 1e-8);
      ASSERT_NEAR(a.least, b.least, 1e-8);
    }
  EXPECT_GT(half_spaces, 30);
}

TEST(CorridorMission, WrongSurfacesAreRefusedByName) {
  const std::string surface =
      R"({"surface_point_m": [0, 0, 0], "normal": [1, 0, 0], "distance_m": 0.3})";
  EXPECT_EQ(error_of("[" + surface + "]"), "no error");
  const auto expect = [&](const std::string& surfaces, const std::string& message) {
    EXPECT_NE(error_of(surfaces).find(message), std::string::npos) << error_of(surfaces);
  };
  expect("[" + surface + "," + surface + "," + surface + "," + surface + "," + surface + "]",
         "segments[0].keep_off");
  expect("3", "a list of up to 4 surfaces");
  expect(R"([{"surface_point_m": [0, 0, 0], "normal": [0, 0, 0], "distance_m": 0.3}])",
         "segments[0].keep_off[0].normal");
  expect(R"([{"surface_point_m": [0, 0, 0], "normal": [1, 0, 0], "distance_m": -1}])",
         "segments[0].keep_off[0].distance_m");
  expect(R"([{"surface_point_m": [0, 0, 0], "normal": [1, 0, 0]}])", "distance_m");
}

// The way through the points leaves the corridor by several centimetres.
TEST(CorridorMission, StaysInTheCorridorInBothPlants) {
  const test_support::Directory directory("corridor_mission");
  for (const char* program : {HYBRID_MISSION_PROGRAM, MISSION_MUJOCO_PROGRAM})
    for (const char* level : {"wrench", "actuator"}) {
      const auto flight = test_support::run(
          program, "--no-pictures --mission-file '" MISSIONS_DIR "/corridor.json' --level " +
                       std::string(level) + " -o '" + directory.file("") + "'");
      ASSERT_EQ(flight.exit_code, 0) << flight.output;
      EXPECT_LT(flight["outside_max_m"], 0.01) << program << ' ' << level;
      EXPECT_GT(flight["air_rmse_m"], 0.02);
      EXPECT_EQ(flight["solver_failures"], 0);
    }
}

}  // namespace corridor_mission_test
