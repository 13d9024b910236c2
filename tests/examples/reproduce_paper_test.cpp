// Runs the program reproduce_paper as a user does, and checks its tables against its logs.
// CTest: flight

#include "../../examples/paper/control_diagram.hpp"
#include "../../examples/paper/frames_drawing.hpp"
#include "../../examples/paper/table.hpp"
#include "../../examples/support/csv.hpp"
#include "support/program.hpp"

#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <vector>

namespace reproduce_paper_test {

namespace fs = std::filesystem;
using namespace examples::paper;
using test_support::Outcome;

Outcome run(const std::string& output, const std::string& arguments) {
  return test_support::run(REPRODUCE_PAPER_PROGRAM,  // set by CMake
                           "--no-pictures --output '" + output + "' " + arguments);
}

/// RMSE [m] and mean power [W] of a phase, from a log of 100 Hz.
struct FromLog {
  double rmse = 0.0, power = 0.0;

  FromLog(const std::string& path, double phase) {
    const examples::CsvTable log = examples::read_csv(path);
    double count = 0.0;
    for (std::size_t i = 0; i < log.rows(); ++i) {
      if (log["phase"][i] != phase) continue;
      for (const char* axis : {"x", "y", "z"}) {
        const std::string a = axis;
        const double error = log["position_m_" + a][i] - log["reference_m_" + a][i];
        rmse += error * error;
      }
      power += log["power_w"][i];
      count += 1.0;
    }
    rmse = std::sqrt(rmse / count);
    power /= count;
  }
};

TEST(ReproducePaper, TablesHaveThePapersFiguresAndThoseOfTheLogs) {
  const test_support::Directory directory("reproduce_paper");
  const Outcome both =
      run(directory.file(""), "--only air,ground --plants plant --settings library --threads 2");
  ASSERT_EQ(both.exit_code, 0) << both.output;
  EXPECT_DOUBLE_EQ(both["air_paper_vehicle_rmse_m"], 0.052);
  EXPECT_DOUBLE_EQ(both["ground_paper_vehicle_rmse_m"], 0.145);
  EXPECT_DOUBLE_EQ(both["hybrid_paper_vehicle_rmse_m"], 0.125);
  EXPECT_DOUBLE_EQ(both["hybrid_paper_vehicle_air_power_w"], 653.64);
  EXPECT_DOUBLE_EQ(both["hybrid_paper_vehicle_ground_power_w"], 47.38);
  EXPECT_NEAR(both["hybrid_paper_vehicle_power_saved_percent"], 92.8, 0.051);

  const FromLog air(directory.file("air_library_plant/hybrid_mission.csv"), 3.0),
      ground(directory.file("ground_library_plant/hybrid_mission.csv"), 5.0);
  EXPECT_NEAR(both["air_library_plant_rmse_m"], air.rmse, 1e-4);
  EXPECT_NEAR(both["ground_library_plant_rmse_m"], ground.rmse, 1e-4);
  EXPECT_NEAR(both["air_library_plant_air_power_w"], air.power, 0.5);
  EXPECT_NEAR(both["ground_library_plant_ground_power_w"], ground.power, 0.5);
  EXPECT_NEAR(both["ground_library_plant_power_saved_percent"],
              100.0 * (1.0 - ground.power / air.power), 0.1);
  EXPECT_LE(air.rmse, 0.003);
  EXPECT_LE(ground.rmse, 0.006);
  EXPECT_LE(ground.power, 47.38);
  const double axes =
      std::hypot(both["air_library_plant_rmse_x_m"], both["air_library_plant_rmse_y_m"],
                 both["air_library_plant_rmse_z_m"]);
  EXPECT_NEAR(axes, air.rmse, 2e-4);
  EXPECT_GE(both["air_library_plant_max_error_m"], air.rmse);
  EXPECT_EQ(both["ground_library_plant_solver_failures"], 0);

  const examples::CsvTable csv = examples::read_csv(
      directory.file("paper.csv"), {"rmse_m", "ground_power_w"}, examples::CsvNumbers::any);
  ASSERT_EQ(csv.rows(), 5u);  // air: paper, ours; ground: paper, ours; hybrid: paper
  EXPECT_EQ(csv["rmse_m"][0], 0.052);
  EXPECT_NEAR(csv["rmse_m"][1], both["air_library_plant_rmse_m"], 5.1e-5);
  EXPECT_EQ(csv["rmse_m"][2], 0.145);
  EXPECT_NEAR(csv["rmse_m"][3], both["ground_library_plant_rmse_m"], 5.1e-5);
  EXPECT_EQ(csv["ground_power_w"][4], 47.38);
  const std::string table = test_support::read_file(directory.file("paper.md"));
  EXPECT_NE(both.output.find(table), std::string::npos);

  // The number of threads does not matter.
  const test_support::Directory again("reproduce_paper_again");
  const Outcome one = run(again.file(""),
                          "--only air,ground --plants plant --settings library "
                          "--threads 1");
  ASSERT_EQ(one.exit_code, 0) << one.output;
  EXPECT_EQ(test_support::read_file(again.file("paper.csv")),
            test_support::read_file(directory.file("paper.csv")));
}

TEST(ReproducePaper, ThePaperAsPrintedFliesItsEightBelowItsRmse) {
  const test_support::Directory directory("reproduce_paper_preset");
  const Outcome flight = run(directory.file(""), "--only air --plants plant --settings preset");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_LE(flight["air_preset_plant_rmse_m"], 0.052);
  EXPECT_GT(flight["air_preset_plant_lean_max_deg"], 5.0);  // 0.2 N sideways: it has to lean
  EXPECT_EQ(flight["air_preset_plant_solver_failures"], 0);
}

TEST(ReproducePaper, IdentifiesTheServoAndUpdatesThePictures) {
  const test_support::Directory directory("reproduce_paper_servo"), project("reproduce_paper_docs");
  fs::create_directories(project.file("pictures"));
  const Outcome outcome =
      run(directory.file(""), "--only servo,drawings --update '" + project.file("") + "'");
  ASSERT_EQ(outcome.exit_code, 0) << outcome.output;
  const double truth = outcome["servo_true_time_constant_s"];
  EXPECT_EQ(truth, tilt_ropter::tilt_ropter_vehicle().servo.time_constant);
  EXPECT_NEAR(outcome["servo_time_constant_s"], truth, 0.02 * truth);
  EXPECT_GT(outcome["servo_residual_rad"], 0.001);  // the noise of the encoder
  EXPECT_EQ(examples::read_csv(directory.file("servo_identification.csv")).names,
            (std::vector<std::string>{"time_s", "pwm_us", "command_rad", "angle_rad", "fit_rad"}));
  for (const char* drawing : {"frames.svg", "control_diagram.svg"})
    EXPECT_EQ(test_support::read_file(project.file(std::string("pictures/") + drawing)),
              test_support::read_file(directory.file(drawing)))
        << drawing;
  EXPECT_FALSE(fs::exists(directory.file("paper.csv")));  // nothing was flown
}

TEST(ReproducePaper, FliesInMujocoOrSaysThatItCannot) {
  const test_support::Directory directory("reproduce_paper_mujoco");
  const Outcome flight = run(directory.file(""), "--only air --plants mujoco --settings library");
  if (flight.exit_code == 1 && flight.says("without MuJoCo"))
    GTEST_SKIP() << "built without MuJoCo";
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_LE(flight["air_library_mujoco_rmse_m"], 0.0045);
}

TEST(ReproducePaper, RefusesWrongOptionsAndSaysWhatItCannotWrite) {
  const Outcome help = run("nowhere", "--help");
  EXPECT_EQ(help.exit_code, 0);
  for (const char* option : {"--only", "--settings", "--plants", "--hitl", "--ablations",
                             "--threads", "--update", "preset_wider_bounds"})
    EXPECT_TRUE(help.says(option)) << option;
  for (const char* wrong : {"--only moon", "--settings best", "--plants gazebo", "--threads 0",
                            "--update nowhere", "--hitl-until -1", "surplus"})
    EXPECT_GT(run("nowhere", wrong).exit_code, 100) << wrong;
  EXPECT_FALSE(fs::exists("nowhere"));
  const Outcome outcome = run("/proc/nowhere", "--only drawings");
  EXPECT_EQ(outcome.exit_code, 1);
  EXPECT_TRUE(outcome.says("/proc/nowhere")) << outcome.output;
}

TEST(FramesDrawing, ShowsEveryFrameAndFollowsTheVehicle) {
  tilt_ropter::Vehicle<4> vehicle = tilt_ropter::tilt_ropter_vehicle();
  const std::string drawing = draw_frames(vehicle);
  for (const char* frame : {">I<", ">B<", ">R1<", ">R2<", ">R3<", ">R4<", ">W1<", ">W2<"})
    EXPECT_NE(drawing.find(frame), std::string::npos) << frame;
  EXPECT_EQ(drawing.find("nan"), std::string::npos);
  vehicle.wheels->half_track += 0.05;
  EXPECT_NE(draw_frames(vehicle), drawing);
  vehicle.rotor.propeller_radius = 0.0;  // unknown
  EXPECT_EQ(draw_frames(vehicle).find("nan"), std::string::npos);
  vehicle.wheels.reset();
  EXPECT_EQ(draw_frames(vehicle).find(">W1<"), std::string::npos);
}

TEST(ControlDiagram, ShowsTheBlocksOfThePaper) {
  const std::string diagram = draw_control_diagram();
  for (const char* block : {"Motion planner", "NMPC", "Control allocation", "Motors, servos", "EKF",
                            "Wrench observer", "Contact estimate", "Actuator model"})
    EXPECT_NE(diagram.find(block), std::string::npos) << block;
}

TEST(Table, IsMarkdownWithAlignedColumns) {
  Table table({"name", "a"}, 1);
  table.add({"first", millimetres(0.0525)});
  table.add({"x", number(std::nan(""), 2)});
  EXPECT_EQ(table.markdown(),
            "| name  |    a |\n"
            "|-------|-----:|\n"
            "| first | 52.5 |\n"
            "| x     |      |\n");
}

TEST(ReplaceSection, ReplacesOnlyTheTextBetweenTheMarks) {
  const test_support::Directory directory("replace_section");
  const std::string path =
      directory.write("a.md", "before\n<!-- begin one -->\nold\n<!-- end one -->\nafter\n");
  replace_section(path, "one", "new\n");
  EXPECT_EQ(test_support::read_file(path),
            "before\n<!-- begin one -->\nnew\n<!-- end one -->\nafter\n");
  EXPECT_THROW(replace_section(path, "two", ""), std::runtime_error);
  EXPECT_THROW(replace_section(directory.file("none.md"), "one", ""), std::runtime_error);
}

}  // namespace reproduce_paper_test
