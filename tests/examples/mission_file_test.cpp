// Missions in JSON files: what is written is flown again, what is wrong is named.
// CTest: flight

#include "../../examples/support/mission_file.hpp"
#include "../../examples/support/hybrid_experiment.hpp"
#include "../../examples/support/mission_choice.hpp"
#include "support/program.hpp"

#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

namespace mission_file_test {

using namespace tilt_ropter;
using examples::MissionFileError;

const std::optional<Undercarriage> wheels = undercarriage(tilt_ropter_vehicle());

Mission read(const std::string& segments, const std::string& start = "[0, 0]",
             const std::optional<Undercarriage>& undercarriage = wheels) {
  std::istringstream in("{\"name\": \"x\", \"start\": {\"position_m\": " + start +
                        "}, \"segments\": [" + segments + "]}");
  return examples::read_mission(in, "file", undercarriage);
}

std::string error_of(const std::string& segments, const std::string& start = "[0, 0]",
                     const std::optional<Undercarriage>& undercarriage = wheels) {
  try {
    (void)read(segments, start, undercarriage);
  } catch (const MissionFileError& error) {
    return error.what();
  }
  return "no error";
}

int kind_of(const MissionSegment& s) {
  return s.motion<Hold>()                   ? 1
         : s.motion<Transition>()           ? 2
         : s.motion<FigureEight>()          ? 3
         : s.motion<MinimumSnap>()          ? 4
         : s.motion<SampledPath>()          ? 5
         : s.motion<examples::PushMotion>() ? 6
                                            : 0;
}

void expect_same(const Mission& a, const Mission& b) {
  ASSERT_NEAR(a.duration(), b.duration(), 1e-9);
  ASSERT_EQ(a.segments().size(), b.segments().size());
  for (std::size_t i = 0; i < a.segments().size(); ++i) {
    EXPECT_EQ(a.segments()[i].phase, b.segments()[i].phase) << i;
    EXPECT_EQ(kind_of(a.segments()[i]), kind_of(b.segments()[i])) << i;
  }
  for (double time = 0.0; time < a.end_time(); time += 0.0371) {
    const ReferencePoint p = a(time), q = b(time);
    ASSERT_LT((p.position - q.position).norm(), 1e-8) << time;
    ASSERT_LT((p.velocity - q.velocity).norm(), 1e-8) << time;
    ASSERT_LT((p.acceleration - q.acceleration).norm(), 1e-7) << time;
    ASSERT_LT(p.orientation.angularDistance(q.orientation), 1e-7) << time;
    ASSERT_LT((p.angular_velocity - q.angular_velocity).norm(), 1e-7) << time;
    ASSERT_EQ(p.push ? p.push->force : 0.0, q.push ? q.push->force : 0.0) << time;
  }
}

TEST(MissionFile, WrittenMissionIsTheSameMission) {
  const test_support::Directory directory("mission_file");
  const std::string path = directory.file("written.json");
  HybridMissionSettings turned;
  turned.origin << 1.0, -2.0;
  turned.yaw = 0.3;
  turned.direction = -0.7;
  const Undercarriage legs{0.12, false, false, false}, two_axles{0.11, true, false, false};
  const std::vector<std::pair<Mission, std::optional<Undercarriage>>> missions = {
      {hybrid_mission(wheels), wheels},
      {hybrid_mission(wheels, turned), wheels},
      {hybrid_mission(legs, turned), legs},
      {hybrid_mission(two_axles, turned), two_axles},
      {hybrid_mission(std::nullopt), std::nullopt},
      {examples::inspection(tilt_ropter_vehicle(), 3.0, turned), std::nullopt},
      {examples::ground_experiment(*wheels, turned), wheels},
      {examples::hybrid_experiment(*wheels, turned), wheels}};
  for (const auto& [mission, undercarriage] : missions) {
    examples::write_mission(mission, undercarriage, path);
    expect_same(mission, examples::read_mission(path, undercarriage));
  }
}

// The ground is wherever the wheels of the vehicle are.
TEST(MissionFile, OneFileFitsVehiclesOfDifferentHeights) {
  const test_support::Directory directory("mission_file");
  const std::string path = directory.file("written.json");
  const Undercarriage large{0.3, true, true, true};
  examples::write_mission(examples::hybrid_experiment(*wheels), wheels, path);
  const Mission mission = examples::read_mission(path, large);
  for (const MissionSegment& segment : mission.segments()) {
    if (segment.phase != MissionPhase::ground) continue;
    EXPECT_NEAR(segment(segment.start_time()).position.z(), 0.3, 1e-12);
  }
}

TEST(MissionFile, WrittenHybridMissionFliesTheSame) {
  const test_support::Directory directory("mission_file");
  const std::string path = directory.file("hybrid.json"),
                    out = "--no-pictures -o '" + directory.file("") + "' ";
  const auto run = [&](const std::string& options) {
    return test_support::run(HYBRID_MISSION_PROGRAM, out + options);
  };
  ASSERT_EQ(run("--write-mission '" + path + "'").exit_code, 0);
  const auto built_in = run(""), from_file = run("--mission-file '" + path + "'");
  ASSERT_EQ(from_file.exit_code, 0) << from_file.output;
  for (const char* key :
       {"air_rmse_m", "ground_rmse_m", "mission_rmse_m", "ground_power_w", "takeoff_overshoot_m",
        "contact_mode_changes", "energy_Wh", "mission_duration_s"})
    EXPECT_EQ(from_file[key], built_in[key]) << key;
}

TEST(MissionFile, ShippedTourFliesThroughItsWayPoints) {
  const test_support::Directory directory("mission_file");
  const std::string tour = MISSIONS_DIR "/tour.json";
  const auto flight =
      test_support::run(HYBRID_MISSION_PROGRAM, "--no-pictures -o '" + directory.file("") +
                                                    "' --mission-file '" + tour + "'");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_EQ(flight["contact_mode_changes"], 4);
  EXPECT_EQ(flight["solver_failures"], 0);
  EXPECT_LE(flight["air_rmse_m"], 0.005);
  EXPECT_LE(flight["ground_rmse_m"], 0.010);

  const Mission mission = examples::read_mission(tour, wheels);
  for (const Eigen::Vector3d& point :
       {Eigen::Vector3d(3.0, 1.5, 1.8), Eigen::Vector3d(1.5, 3.0, 1.2),
        Eigen::Vector3d(0.3, 3.2, 0.11), Eigen::Vector3d(-1.0, 2.6, 0.11)}) {
    double nearest = 10.0;
    for (double time = 0.0; time < mission.end_time(); time += 1e-3)
      nearest = std::min(nearest, (mission(time).position - point).norm());
    EXPECT_LT(nearest, 2e-3);
  }
}

TEST(MissionFile, PhasesFollowFromWhereTheSegmentsStartAndEnd) {
  const Mission mission = read(
      R"({"type": "rest", "duration_s": 1},
         {"type": "go_to", "position_m": [2, 0]},
         {"type": "turn", "yaw_deg": 90},
         {"type": "take_off", "height_m": 1},
         {"type": "turn", "yaw_deg": 0},
         {"type": "go_to", "position_m": [2, 1, 1.5], "phase": "hover"},
         {"type": "way_points", "points_m": [[3, 1, 1.5]]},
         {"type": "land"})");
  const std::vector<MissionPhase> expected = {
      MissionPhase::rest,  MissionPhase::ground, MissionPhase::ground, MissionPhase::take_off,
      MissionPhase::hover, MissionPhase::hover,  MissionPhase::air,    MissionPhase::landing};
  ASSERT_EQ(mission.segments().size(), expected.size());
  for (std::size_t i = 0; i < expected.size(); ++i)
    EXPECT_EQ(mission.segments()[i].phase, expected[i]) << i;
  const ReferencePoint end = mission(mission.end_time());
  EXPECT_LT((end.position - Eigen::Vector3d(3.0, 1.0, 0.11)).norm(), 1e-9);
  EXPECT_NEAR(yaw_of(end.orientation), 0.0, 1e-9);
}

TEST(MissionFile, TurnWithoutAngleTurnsIntoTheNextPath) {
  const Mission mission =
      read(R"({"type": "turn"}, {"type": "way_points", "points_m": [[1, 2], [3, 1]]})");
  const ReferencePoint start = mission(mission.segments()[1].start_time());
  const ReferencePoint later = mission(mission.segments()[1].start_time() + 0.2);
  const Eigen::Vector3d way = later.position - start.position;
  EXPECT_NEAR(yaw_of(start.orientation), std::atan2(way.y(), way.x()), 0.02);
  EXPECT_GT(yaw_of(start.orientation), 0.5);
}

TEST(MissionFile, WayPointsEndWithTheSpeedOfTheNextEight) {
  const Mission mission = read(
      R"({"type": "turn"},
         {"type": "way_points", "points_m": [[3, 0]], "end_velocity_mps": "next"},
         {"type": "figure_eight", "amplitude_m": [2, 0.6], "direction_deg": -10, "laps": 1,
          "ends_moving": true},
         {"type": "stop"})");
  EXPECT_GT(mission(mission.segments()[2].start_time()).velocity.norm(), 1.0);
  EXPECT_LT(mission(mission.end_time()).velocity.norm(), 1e-9);
}

TEST(MissionFile, EightOnTheGroundStartsInThePresentHeading) {
  std::istringstream in(R"({"name": "x", "start": {"position_m": [1, 1], "yaw_deg": 50},
                            "segments": [{"type": "figure_eight"}]})");
  const Mission mission = examples::read_mission(in, "file", wheels);
  EXPECT_NEAR(yaw_of(mission(0.0).orientation), 50.0 * pi / 180.0, 1e-9);
  EXPECT_EQ(mission.phase(0.0), MissionPhase::ground);
}

TEST(MissionFile, TrajectoryIsRelativeToTheFile) {
  const test_support::Directory directory("mission_file");
  (void)directory.write("path.csv", "time_s,x_m,y_m,z_m\n0,0,0,1\n2,1,0,1.5\n4,2,0,1\n");
  const std::string path = directory.write(
      "mission.json", R"({"name": "x", "segments": [{"type": "trajectory", "file": "path.csv"},
                          {"type": "hover", "duration_s": 1}, {"type": "land"}]})");
  const Mission mission = examples::read_mission(path, wheels);
  EXPECT_LT((mission(2.0).position - Eigen::Vector3d(1.0, 0.0, 1.5)).norm(), 1e-9);
  EXPECT_NEAR(mission(mission.end_time()).position.z(), 0.11, 1e-12);
  const std::string again = directory.file("again.json");
  const auto written =
      test_support::run(HYBRID_MISSION_PROGRAM, "--trajectory '" + directory.file("path.csv") +
                                                    "' --write-mission '" + again + "'");
  ASSERT_EQ(written.exit_code, 0) << written.output;
  EXPECT_NEAR(examples::read_mission(again, wheels).duration(), 4.0, 1e-9);
}

/// Each optional field, with a mission that another value of the field changes.
const std::string push_on_a_wall =
    R"("type": "push", "surface_point_m": [1, 0, 0], "normal": [-1, 0, 0], )"
    R"("tool_m": [0.3, 0, 0], "force_n": 5)";

TEST(MissionFile, EveryFieldHasAnEffect) {
  struct Case {
    std::string before, segment, field;
  };
  const std::string hover = R"({"type": "take_off", "height_m": 2},)";
  const std::vector<Case> cases = {
      {"", R"("type": "take_off", "height_m": 2)", R"("max_speed_mps": 0.3)"},
      {"", R"("type": "take_off", "height_m": 2)", R"("max_acceleration_mps2": 0.1)"},
      {hover, R"("type": "land")", R"("max_speed_mps": 0.1)"},
      {hover, R"("type": "land")", R"("max_acceleration_mps2": 0.05)"},
      {hover, R"("type": "turn", "yaw_deg": 90)", R"("max_yaw_rate_radps": 0.2)"},
      {hover, R"("type": "turn", "yaw_deg": 90)", R"("max_yaw_acceleration_radps2": 0.2)"},
      {hover, R"("type": "turn", "yaw_deg": 90)", R"("duration_s": 20)"},
      {hover, R"("type": "turn", "yaw_deg": 90)", R"("phase": "air")"},
      {hover, R"("type": "go_to", "position_m": [1, 0, 1])", R"("yaw_deg": 20)"},
      {hover, R"("type": "go_to", "position_m": [1, 0, 1])", R"("max_speed_mps": 0.2)"},
      {hover, R"("type": "go_to", "position_m": [1, 0, 1])", R"("max_acceleration_mps2": 0.1)"},
      {hover, R"("type": "go_to", "position_m": [1, 0, 1])", R"("duration_s": 20)"},
      {hover, R"("type": "go_to", "position_m": [1, 0, 1])", R"("phase": "hover")"},
      {hover, R"("type": "way_points", "points_m": [[3, 0, 1]])", R"("max_speed_mps": 0.5)"},
      {hover, R"("type": "way_points", "points_m": [[3, 0, 1]])",
       R"("max_acceleration_mps2": 0.5)"},
      {hover, R"("type": "way_points", "points_m": [[3, 0, 1]])",
       R"("end_velocity_mps": [1, 0, 0])"},
      {hover, R"("type": "way_points", "points_m": [[3, 0, 1]])",
       R"("end_acceleration_mps2": [0.5, 0, 0])"},
      {hover, R"("type": "way_points", "points_m": [[3, 0, 1]])", R"("duration_s": 20)"},
      {hover, R"("type": "way_points", "points_m": [[3, 0, 1]])", R"("phase": "landing")"},
      {hover, R"("type": "way_points", "points_m": [[3, 0, 1], [4, 2, 1]], "heading": "fixed")",
       R"("heading": "along_velocity")"},
      {hover, R"("type": "figure_eight")", R"("amplitude_m": [1, 0.5, 0])"},
      {hover, R"("type": "figure_eight")", R"("direction_deg": 10)"},
      {hover, R"("type": "figure_eight")", R"("laps": 1)"},
      {hover, R"("type": "figure_eight")", R"("ramp_laps": 0.5)"},
      {hover, R"("type": "figure_eight")", R"("max_speed_mps": 0.5)"},
      {hover, R"("type": "figure_eight")", R"("max_acceleration_mps2": 0.5)"},
      {hover, R"("type": "figure_eight")", R"("ends_moving": true)"},
      {"", R"("type": "figure_eight")", R"("max_yaw_rate_radps": 0.5)"},
      {R"({"type": "way_points", "points_m": [[3, 0]], "end_velocity_mps": [1, 0, 0]},)",
       R"("type": "stop")", R"("max_acceleration_mps2": 0.5)"},
      {hover, push_on_a_wall, R"("surface_point_m": [1.1, 0, 0])"},
      {hover, push_on_a_wall, R"("normal": [-1, 0.1, 0])"},
      {hover, push_on_a_wall, R"("tool_m": [0.4, 0, 0])"},
      {hover, push_on_a_wall, R"("force_n": 3)"},
      {hover, push_on_a_wall, R"("friction": 0.2)"},
      {hover, push_on_a_wall, R"("hold_s": 3)"},
      {hover, push_on_a_wall, R"("slide_m": [0, 1, 0])"},
      {hover, push_on_a_wall + R"(, "slide_m": [0, 1, 0])", R"("speed_mps": 0.1)"},
  };
  const auto differ = [](const Mission& a, const Mission& b) {
    if (std::abs(a.duration() - b.duration()) > 1e-6) return true;
    for (double time = 0.0; time < a.end_time(); time += 0.01) {
      const ReferencePoint p = a(time), q = b(time);
      if ((p.position - q.position).norm() > 1e-6 || a.phase(time) != b.phase(time)) return true;
      if (p.orientation.angularDistance(q.orientation) > 1e-6) return true;
      if (p.push && q.push &&
          (p.push->force != q.push->force || p.push->surface.friction != q.push->surface.friction))
        return true;
    }
    return false;
  };
  for (const Case& c : cases) {
    std::string changed = c.segment;
    const std::string key = c.field.substr(0, c.field.find(':'));
    const auto was = changed.find(", " + key);
    if (was != std::string::npos) changed.erase(was, changed.find(", \"", was + 1) - was);
    // A turn brings the vehicle into the start of a path along its velocity.
    const std::string turn =
        c.field.find("along_velocity") == std::string::npos ? "" : R"({"type": "turn"},)";
    const Mission a = read(c.before + turn + '{' + c.segment + '}', "[0, 0]"),
                  b = read(c.before + turn + '{' + changed + ", " + c.field + '}', "[0, 0]");
    EXPECT_TRUE(differ(a, b)) << c.segment << " with " << c.field;
  }
}

TEST(MissionFile, ErrorsNameSegmentFieldValueAndRange) {
  struct Wrong {
    std::string segments;
    std::vector<std::string> says;
    std::string start = "[0, 0]";
  };
  const std::string up = R"({"type": "take_off", "height_m": 1},)";
  const std::vector<Wrong> wrong = {
      {R"({"type": "rest"})", {"segments[0].duration_s is missing", "in [0.01, 10000] s"}},
      {R"({"type": "rest", "duration_s": -1})", {"segments[0].duration_s = -1", "10000] s"}},
      {R"({"type": "rest", "duration_s": "1"})", {"duration_s = \"1\"", "a number in"}},
      {R"({"type": "rest", "duration": 1})", {"segments[0].duration_s is missing"}},
      {R"({"type": "rest", "duration_s": 1, "x": 2})",
       {"segments[0].x = 2", "no such field", "duration_s, keep_off, type"}},
      {R"({"type": "fly"})", {"segments[0].type = \"fly\"", "\"way_points\""}},
      {R"({"duration_s": 1})", {"segments[0].type is missing", "one of \"rest\""}},
      {"7", {"segments[0] = 7", "an object"}},
      {R"({"type": "hover", "duration_s": 1})", {"segments[0].type = \"hover\"", "on the ground"}},
      {up + R"({"type": "rest", "duration_s": 1})", {"segments[1].type = \"rest\"", "in the air"}},
      {up + R"({"type": "take_off", "height_m": 2})", {"segments[1].type", "on the ground"}},
      {'{' + push_on_a_wall + '}', {"segments[0].type = \"push\"", "in the air"}},
      {up + '{' + push_on_a_wall + R"(, "slide_m": [1, 0, 0]})", {"slide", "along the surface"}},
      {up + '{' + push_on_a_wall + R"(, "slide_m": [0, 0.1, 0]})", {"slide", "one second"}},
      {R"({"type": "land"})", {"segments[0].type = \"land\"", "in the air"}},
      {R"({"type": "take_off", "height_m": 0.1})", {"height_m = 0.1", "in [0.12, 1000] m"}},
      {up + R"({"type": "go_to", "position_m": [1]})", {"segments[1].position_m = [1]", "two or"}},
      {up + R"({"type": "go_to", "position_m": [1, 2, 0.05]})",
       {"segments[1].position_m[2] = 0.05", "0.11 m"}},
      {R"({"type": "go_to", "position_m": [0, 1]})",
       {"segments[0]: sideways speed on the ground", "turn before"}},
      {up + R"({"type": "go_to", "position_m": [1, 0, 1], "phase": "ground"})",
       {"segments[1].phase = \"ground\"", "in the air"}},
      {up + R"({"type": "go_to", "position_m": [9, 0, 1], "duration_s": 1})",
       {"segments[1] (go_to): TransitionSettings.duration [s] = 1", "which the limits need"}},
      {R"({"type": "turn"})", {"segments[0].yaw_deg is missing", "in the last segment"}},
      {R"({"type": "way_points", "points_m": []})", {"points_m = []", "1 to 99 positions"}},
      {R"({"type": "way_points", "points_m": [[1, 0, 2, 3]]})", {"points_m[0] = [1,0,2,3]"}},
      {R"({"type": "way_points", "points_m": [[1, "a"]]})", {"points_m[0][1] = \"a\"", "1000] m"}},
      {R"({"type": "way_points", "points_m": [[1, 0]], "end_velocity_mps": [3, 0, 0]})",
       {"segments[0] (way_points): MinimumSnapSettings.end_velocity", "<= 1.5"}},
      {R"({"type": "way_points", "points_m": [[1, 0]], "end_velocity_mps": "fast"})",
       {"end_velocity_mps = \"fast\"", "\"next\""}},
      {R"({"type": "way_points", "points_m": [[1, 0]], "end_velocity_mps": "next"})",
       {"end_velocity_mps = \"next\"", "the last segment"}},
      {R"({"type": "way_points", "points_m": [[3, 0]], "end_velocity_mps": "next"},
          {"type": "way_points", "points_m": [[5, 0]]})",
       {"segments[0].end_velocity_mps = \"next\"", "no speed of its own"}},
      {R"({"type": "way_points", "points_m": [[3, 0]], "end_velocity_mps": "next"},
          {"type": "figure_eight"})",
       {"segments[1].direction_deg is missing"}},
      {R"({"type": "way_points", "points_m": [[3, 0]], "end_velocity_mps": [1, 0, 0]},
          {"type": "rest", "duration_s": 1})",
       {"segments[1].type = \"rest\"", "ends in motion"}},
      {R"({"type": "figure_eight", "laps": 1.5})", {"laps = 1.5", "a whole number"}},
      {R"({"type": "figure_eight", "laps": 0})", {"laps = 0", "[1, 1000]"}},
      {R"({"type": "figure_eight", "starts_moving": true})",
       {"segments[0].starts_moving = true", "false after"}},
      {R"({"type": "figure_eight", "direction_deg": 40})",
       {"segments[0]: turn from the end", "at most 1e-06 rad"}},
      {up + R"({"type": "trajectory", "file": "nowhere.csv"})",
       {"segments[1].file: cannot read nowhere.csv"}},
      {R"({"type": "way_points", "points_m": [[3, 0]], "end_velocity_mps": [1, 0, 0]},
          {"type": "figure_eight"})",
       {"segments[1]: change of velocity", "at most 1e-06 m/s"}},
      {R"({"type": "figure_eight", "amplitude_m": [2, 0.6, 0.5]})",
       {"segments[0]: height of the CoM", "its height on the ground"}},
      {up + R"({"type": "figure_eight", "amplitude_m": [2, 0.6, 1.5]})",
       {"segments[1]: height of the CoM", "at least"}},
      {"", {"segments = []", "1 to 200 segments"}},
      {R"({"type": "rest", "duration_s": 1})", {"start.position_m[2] = 0.01"}, "[0, 0, 0.01]"},
      {R"({"type": "rest", "duration_s": 1})", {"start.position_m[0] = 5000"}, "[5000, 0]"},
  };
  for (const Wrong& w : wrong) {
    const std::string error = error_of(w.segments, w.start);
    EXPECT_EQ(error.rfind("file: ", 0), 0U) << w.segments << '\n' << error;
    for (const std::string& words : w.says)
      EXPECT_NE(error.find(words), std::string::npos) << w.segments << '\n' << error;
  }
  EXPECT_NE(error_of(R"({"type": "rest", "duration_s": 1})", "[0, 0]", std::nullopt)
                .find("no wheels or legs"),
            std::string::npos);
  const Undercarriage legs{0.12, false, false, false};
  EXPECT_NE(
      error_of(R"({"type": "go_to", "position_m": [1, 0]})", "[0, 0]", legs).find("does not roll"),
      std::string::npos);
}

TEST(MissionFile, ProgramNamesAWrongFileAndReturns2) {
  const test_support::Directory directory("mission_file");
  const std::string path = directory.write("bad.json", R"({"name": "x", "segmets": []})");
  const auto told = test_support::run(HYBRID_MISSION_PROGRAM, "--mission-file '" + path + "'");
  EXPECT_EQ(told.exit_code, 2);
  EXPECT_TRUE(told.says("bad.json: segments is missing")) << told.output;
  EXPECT_EQ(test_support::run(HYBRID_MISSION_PROGRAM, "--mission-file nowhere.json").exit_code, 2);
  EXPECT_GT(test_support::run(HYBRID_MISSION_PROGRAM, "--mission-file x.json --speed 2").exit_code,
            100);
  for (const char* text : {"[]", "7", "null", "{", "{}", R"({"name": "x", "segments": 3})",
                           R"({"name": "x", "segments": [{"type": "hover", "duration_s": 1}]})"}) {
    std::istringstream in(text);
    EXPECT_THROW((void)examples::read_mission(in, "file", wheels), MissionFileError) << text;
  }
}

}  // namespace mission_file_test
