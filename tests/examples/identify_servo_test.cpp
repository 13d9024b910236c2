// Runs the program identify_servo as a user does, and flies the mission with the identified time
// constant.

#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <string>

namespace identify_servo_test {

using test_support::Outcome;
using test_support::read_file;
using test_support::run;

class IdentifyServo : public test_support::FittingProgram {
 protected:
  IdentifyServo() : FittingProgram("identify_servo", IDENTIFY_SERVO_PROGRAM) {}  // set by CMake
};

TEST_F(IdentifyServo, IdentifiesTheSimulatedServo) {
  const Outcome found = fit(generate("log.csv"));
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found.figures.at("status"), "identified");
  EXPECT_NEAR(found["samples"], 2400, 100);
  EXPECT_NEAR(found["time_constant_s"], 0.08, 0.0005);
  EXPECT_NEAR(found["dead_time_s"], 0.015, 0.0005);
  EXPECT_NEAR(found["gain"], 0.97, 0.002);
  EXPECT_NEAR(found["offset_rad"], 0.02, 0.0005);
  EXPECT_NEAR(found["residual_rad"], 0.002, 0.0003);
  EXPECT_NEAR(found["residual_correlation"], 0.0, 0.1);
  EXPECT_GT(found["r_squared"], 0.999);
  for (const char* width : {"time_constant_95_s", "dead_time_95_s", "offset_95_rad"}) {
    EXPECT_GT(found[width], 1e-5) << width;
    EXPECT_LT(found[width], 1e-3) << width;
  }
  EXPECT_LT(found["gain_95"], 0.002);
}

TEST_F(IdentifyServo, EverySimulationOptionTakesEffect) {
  const Outcome found = fit(generate("log.csv",
                                     "--seed 2 --time-constant 0.05 --dead-time 0.03 --gain 1.1 "
                                     "--offset -0.1 --noise 0.01 --resolution 0 --rate 500 "
                                     "--duration 6 --step 0.2"));
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_NEAR(found["samples"], 3000, 100);
  EXPECT_NEAR(found["time_constant_s"], 0.05, 0.003);
  EXPECT_NEAR(found["dead_time_s"], 0.03, 0.002);
  EXPECT_NEAR(found["gain"], 1.1, 0.02);
  EXPECT_NEAR(found["offset_rad"], -0.1, 0.002);
  EXPECT_NEAR(found["residual_rad"], 0.01, 0.001);
  EXPECT_EQ(read_file(generate("a.csv", "--seed 3")), read_file(generate("b.csv", "--seed 3")));
  EXPECT_NE(read_file(generate("a.csv", "--seed 3")), read_file(generate("b.csv", "--seed 4")));
  EXPECT_NE(read_file(generate("a.csv", "--resolution 0")),
            read_file(generate("b.csv", "--resolution 0.1")));
  const Outcome too_many = run(program, "--generate '" + path("log.csv") + "' --dead-time 0.5");
  EXPECT_EQ(too_many.exit_code, 2);
  EXPECT_TRUE(too_many.says("--dead-time")) << too_many.output;
}

TEST_F(IdentifyServo, WritesCsvWithLogAndFit) {
  ASSERT_EQ(fit(generate("log.csv", "--noise 0 --resolution 0")).exit_code, 0);
  std::ifstream csv(path("out") + "/identify_servo.csv");
  std::string line;
  std::getline(csv, line);
  EXPECT_EQ(line, "time_s,command_rad,angle_rad,fit_rad");
  int rows = 0;
  for (; std::getline(csv, line); ++rows) {
    double time = 0.0, command = 0.0, angle = 0.0, fit = 0.0;
    ASSERT_EQ(std::sscanf(line.c_str(), "%lf,%lf,%lf,%lf", &time, &command, &angle, &fit), 4);
    EXPECT_NEAR(angle, fit, 5e-6);  // time stamps are rounded to 1 us; up to 7 rad/s
  }
  EXPECT_GT(rows, 2000);
}

TEST_F(IdentifyServo, ReadsOtherColumnNames) {
  const std::string names = "--time t --command u --angle y";
  const std::string log = generate("log.csv", names);
  const Outcome wrong = fit(log);
  EXPECT_EQ(wrong.exit_code, 2);
  EXPECT_TRUE(wrong.says("log.csv:2: no column time_s, the header line has 't', 'u', 'y'"))
      << wrong.output;
  EXPECT_EQ(fit(log, names).exit_code, 0);
}

TEST_F(IdentifyServo, RejectsDeadTimeAboveMaxDeadTime) {
  const std::string log = generate("log.csv", "--dead-time 0.04");
  EXPECT_EQ(fit(log).exit_code, 0);
  const Outcome refused = fit(log, "--max-dead-time 0.02");
  EXPECT_EQ(refused.exit_code, 1);
  EXPECT_EQ(refused.figures.at("status"), "the dead time is longer than looked for");
  EXPECT_FALSE(refused.says("fly with it"));
}

TEST_F(IdentifyServo, RejectsLogsWithoutExcitationOrSamples) {
  std::string still = "time_s,command_rad,angle_rad\n";
  for (int i = 0; i < 100; ++i) still += std::to_string(0.01 * i) + ",0.2,0.1\n";
  const Outcome constant = fit(write("still.csv", still));
  EXPECT_EQ(constant.exit_code, 1);
  EXPECT_EQ(constant.figures.at("status"), "the command does not move enough");
  EXPECT_FALSE(constant.says("time_constant_s"));
  const Outcome empty = fit(write("empty.csv", "time_s,command_rad,angle_rad\n"));
  EXPECT_EQ(empty.exit_code, 1);
  EXPECT_EQ(empty.figures.at("status"), "too few samples");
}

TEST_F(IdentifyServo, ErrorsNameFileLineAndColumn) {
  const std::string head = "time_s,command_rad,angle_rad\n0,0,0\n0.1,0,0\n";
  const auto refusal = [&](const std::string& text) {
    const Outcome refused = fit(write("bad.csv", text));
    EXPECT_EQ(refused.exit_code, 2) << refused.output;
    return refused.output.substr(refused.output.find("bad.csv"));
  };
  EXPECT_EQ(refusal(head + "0.2,0,x\n"), "bad.csv:4: column angle_rad (3): 'x' is not a number\n");
  EXPECT_EQ(refusal(head + "0.2,nan,0\n"),
            "bad.csv:4: column command_rad (2): 'nan' is not finite\n");
  EXPECT_EQ(refusal(head + "# late\n0.1,0,0\n"), "bad.csv:5: column time_s does not increase\n");
  EXPECT_EQ(refusal(""), "bad.csv:1: no header line\n");
  EXPECT_EQ(fit(path("nowhere.csv")).exit_code, 2);
}

TEST_F(IdentifyServo, WarnsOfOtherUnits) {
  EXPECT_TRUE(fit(generate("scaled.csv", "--gain 0.3")).says("far from 1: are command and angle"));
  std::string degrees = "time_s,command_rad,angle_rad\n";
  double angle = 0.0;
  for (int i = 0; i < 400; ++i) {
    const double command = i / 40 % 2 == 1 ? 20.0 : 0.0;
    degrees += std::to_string(0.01 * i) + ',' + std::to_string(command) + ',' +
               std::to_string(angle) + '\n';
    angle += 0.1 * (command - angle);
  }
  const Outcome found = fit(write("degrees.csv", degrees));
  EXPECT_EQ(found.exit_code, 0);
  EXPECT_TRUE(found.says("rad: are they degrees?")) << found.output;
  EXPECT_FALSE(fit(generate("log.csv")).says("are "));
}

TEST_F(IdentifyServo, WarnsOfRateLimitInTheLog) {
  EXPECT_FALSE(fit(generate("small.csv", "--step 0.5")).says("smaller"));
  const Outcome large = fit(generate("large.csv", "--step 1.5 --time-constant 0.05"));
  EXPECT_TRUE(large.says("make them smaller")) << large.output;
  EXPECT_GT(large["residual_correlation"], 0.5);
  EXPECT_GT(large["time_constant_s"], 0.06);
}

TEST_F(IdentifyServo, DrawsPictureWithoutWarnings) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  const Outcome drawn = run(program, "'" + generate("log.csv") + "' -o '" + path("out") + "'");
  EXPECT_EQ(drawn.exit_code, 0);
  EXPECT_EQ(drawn.output.find("arning"), std::string::npos) << drawn.output;
  EXPECT_GT(std::filesystem::file_size(path("out") + "/identify_servo.png"), 10000u);
}

TEST_F(IdentifyServo, HelpAndBadArguments) {
  const Outcome help = run(program, "--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_TRUE(help.says("--generate"));
  EXPECT_GT(run(program, "").exit_code, 100);
  EXPECT_GT(run(program, "log.csv --generate other.csv").exit_code, 100);
  EXPECT_GT(run(program, "log.csv --seed 2").exit_code, 100);
  EXPECT_EQ(run(program, "--generate /proc/nowhere").exit_code, 2);
  EXPECT_EQ(run(program, "'" + generate("log.csv") + "' -o /proc/nowhere").exit_code, 2);
}

// The servos of the mission have a time constant of 0.08 s, no dead time, gain 1 and offset 0.
TEST_F(IdentifyServo, MissionTracksBestWithTheIdentifiedTimeConstant) {
  const Outcome found = fit(generate("log.csv", "--dead-time 0 --gain 1 --offset 0"));
  ASSERT_EQ(found.exit_code, 0) << found.output;
  const std::string options = found.figures.at("fly with it").substr(15);  // after the program
  EXPECT_EQ(options.find("--servo-time-constant 0.0"), 0u) << options;
  const auto fly = [&](const std::string& believed) {
    return run(HYBRID_MISSION_PROGRAM, believed + " --no-pictures --output '" + path("out") + "'");
  };
  const Outcome right = fly(options), unsaid = fly(""), twice = fly("--servo-time-constant 0.16"),
                half = fly("--servo-time-constant 0.04");
  EXPECT_EQ(right["solver_failures"], 0);
  EXPECT_NEAR(right["air_rmse_m"], unsaid["air_rmse_m"], 0.0003);
  EXPECT_NEAR(right["mission_rmse_m"], unsaid["mission_rmse_m"], 0.0003);
  EXPECT_GT(twice["air_rmse_m"], 2.0 * right["air_rmse_m"]);
  EXPECT_GT(twice["ground_rmse_m"], 1.1 * right["ground_rmse_m"]);
  EXPECT_GT(half["air_rmse_m"], 1.05 * right["air_rmse_m"]);  // the observer compensates most
}

}  // namespace identify_servo_test
