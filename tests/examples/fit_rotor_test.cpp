// Runs the program fit_rotor as a user does.

#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <string>

namespace fit_rotor_test {

using test_support::Outcome;
using test_support::read_file;
using test_support::run;

const std::string head = "speed_radps,thrust_n,torque_nm,power_w\n";

class FitRotor : public test_support::FittingProgram {
 protected:
  FitRotor() : FittingProgram("fit_rotor", FIT_ROTOR_PROGRAM) {}  // set by CMake
};

TEST_F(FitRotor, FitsTheSimulatedRotor) {
  const Outcome found = fit(generate("stand.csv"));
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found.figures.at("status"), "fitted");
  EXPECT_EQ(found["points"], 40);
  EXPECT_NEAR(found["thrust_coefficient_n_s2_per_rad2"], 1.4e-6, 0.01e-6);
  EXPECT_NEAR(found["thrust_residual_n"], 0.05, 0.02);
  EXPECT_GT(found["thrust_r_squared"], 0.999);
  EXPECT_NEAR(found["exponent"], 2.0, 0.03);
  EXPECT_NEAR(found["torque_ratio_m"], 0.016, 0.0002);
  EXPECT_NEAR(found["torque_residual_nm"], 0.001, 0.0004);
  EXPECT_GT(found["torque_r_squared"], 0.999);
  EXPECT_NEAR(found["idle_power_w"], 5.0, 3.0);
  EXPECT_NEAR(found["power_coefficient_w_s3_per_rad3"], 3.7e-8, 0.02e-8);
  EXPECT_NEAR(found["power_residual_w"], 2.0, 0.8);
  EXPECT_GT(found["power_r_squared"], 0.999);
  EXPECT_FALSE(found.says("fit_rotor:")) << found.output;  // no warning
  double coefficient = 0.0, ratio = 0.0;
  ASSERT_EQ(std::sscanf(found.figures.at("\"rotor\"").c_str(),
                        "{ \"thrust_coefficient_n_s2_per_rad2\": %lf, \"torque_ratio_m\": %lf }",
                        &coefficient, &ratio),
            2)
      << found.output;
  EXPECT_EQ(coefficient, found["thrust_coefficient_n_s2_per_rad2"]);
  EXPECT_EQ(ratio, found["torque_ratio_m"]);
}

TEST_F(FitRotor, FitsTheLinearThrustTerm) {
  for (const double linear : {2e-3, 4e-4, -4e-4, -8e-4}) {
    const Outcome found =
        fit(generate("stand.csv", "--linear-thrust-coefficient " + std::to_string(linear)));
    ASSERT_EQ(found.exit_code, 0) << found.output;
    EXPECT_EQ(found.figures.at("linear_significant"), "yes") << found.output;
    EXPECT_NEAR(found["linear_thrust_coefficient_n_s_per_rad"], linear, 1e-4);
    EXPECT_NEAR(found["curve_thrust_coefficient_n_s2_per_rad2"], 1.4e-6, 0.05e-6);
    EXPECT_NEAR(found["curve_residual_n"], 0.05, 0.02);
    EXPECT_GT(found["curve_r_squared"], found["thrust_r_squared"]);
    EXPECT_NEAR(found["linear_share"], linear / (1.4e-6 * 2900.0 + linear), 0.03);
    double coefficient = 0.0, in_vehicle = 0.0, ratio = 0.0;
    ASSERT_EQ(std::sscanf(found.figures.at("\"rotor\"").c_str(),
                          "{ \"thrust_coefficient_n_s2_per_rad2\": %lf, "
                          "\"linear_thrust_coefficient_n_s_per_rad\": %lf, "
                          "\"torque_ratio_m\": %lf }",
                          &coefficient, &in_vehicle, &ratio),
              3)
        << found.output;
    EXPECT_EQ(coefficient, found["curve_thrust_coefficient_n_s2_per_rad2"]);
    EXPECT_EQ(in_vehicle, found["linear_thrust_coefficient_n_s_per_rad"]);
    EXPECT_TRUE(read_file(path("out") + "/fit_rotor.csv").find("thrust_curve_n") !=
                std::string::npos);
  }
  const Outcome square = fit(generate("stand.csv"));
  EXPECT_EQ(square.figures.at("linear_significant"), "no");
  EXPECT_FALSE(square.says("\"linear_thrust_coefficient")) << square.output;
  // One speed besides zero cannot separate the two terms.
  const Outcome two = fit_text("speed_radps,thrust_n\n1000,1\n0,0\n1000,1.01\n0,0.01\n");
  EXPECT_EQ(two.exit_code, 0);
  EXPECT_EQ(two.figures.count("linear_significant"), 0u) << two.output;
  // The thrust is zero at 500 rad/s, above half of the fastest speed (800 rad/s).
  std::string beyond = "speed_radps,thrust_n\n";
  for (double speed = 500.0; speed < 850.0; speed += 50.0)
    beyond += std::to_string(speed) + ',' + std::to_string(1e-5 * speed * (speed - 500.0)) + '\n';
  const Outcome late = fit_text(beyond);
  EXPECT_TRUE(late.says("the curve is none that a vehicle takes")) << late.output;
  EXPECT_FALSE(late.says("\"linear_thrust_coefficient")) << late.output;
}

TEST_F(FitRotor, FitsOneOfSeveralRotorsInAFile) {
  std::string all = "speed_radps,rotor,thrust_n\n", second = "speed_radps,thrust_n\n";
  for (int i = 0; i < 36; ++i) {
    const double speed = 300.0 + 70.0 * i;
    const int rotor = i % 3;
    const std::string thrust =
        std::to_string((1.0 + 0.5 * rotor) * 1e-6 * speed * speed + 0.01 * (i % 2));
    all += std::to_string(speed) + ',' + std::to_string(rotor) + ',' + thrust + '\n';
    if (rotor == 1) second += std::to_string(speed) + ',' + thrust + '\n';
  }
  const std::string file = write("all.csv", all);
  const Outcome one = fit(file, "--rotor 1");
  ASSERT_EQ(one.exit_code, 0) << one.output;
  EXPECT_EQ(one.output, fit_text(second).output);
  EXPECT_EQ(one["points"], 12);
  EXPECT_EQ(fit(file)["points"], 36);  // without the option, the column is ignored
  const Outcome none = fit(file, "--rotor 7");
  EXPECT_EQ(none.exit_code, 2);
  EXPECT_TRUE(none.says("no rotor 7 in column rotor, which has 0, 1, 2")) << none.output;
  const Outcome renamed = fit(file, "--rotor 1 --rotor-column motor");
  EXPECT_EQ(renamed.exit_code, 2);
  EXPECT_TRUE(renamed.says("no column motor")) << renamed.output;
  EXPECT_GT(fit(file, "--rotor-column rotor").exit_code, 100);
}

TEST_F(FitRotor, ReportsVoltageAtTheFastestPoint) {
  const std::string text =
      "speed_radps,volts,thrust_n\n1000,16.5,1\n3000,15.8,9.001\n2000,16.2,4\n500,16.7,0.25\n";
  const Outcome found = fit(write("stand.csv", text), "--voltage volts");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found["fastest_speed_radps"], 3000);
  EXPECT_NEAR(found["fastest_thrust_n"], 9.0, 0.01);
  EXPECT_EQ(found["fastest_voltage_v"], 15.8);
  EXPECT_EQ(found["\"battery_nominal_v\""], 15.8);
  EXPECT_TRUE(found.says("\"max_thrust_n\": " + found.figures.at("fastest_thrust_n")))
      << found.output;
  EXPECT_FALSE(fit(write("stand.csv", text)).says("fastest"));
  EXPECT_EQ(fit(write("stand.csv", text), "--voltage V").exit_code, 2);
  std::string named = text;
  named.replace(named.find("volts"), 5, "voltage_v");
  EXPECT_EQ(fit(write("stand.csv", named))["fastest_voltage_v"], 15.8);
}

// With few points the intervals must follow Student's t distribution, which is wider than the
// normal distribution.
TEST_F(FitRotor, ConfidenceIntervalsContainTheTruthIn95Percent) {
  const std::map<std::string, double> truth = {{"thrust_coefficient", 1.4e-6},
                                               {"curve_thrust_coefficient", 1.4e-6},
                                               {"linear_thrust_coefficient", 0.0},
                                               {"exponent", 2.0},
                                               {"torque_ratio", 0.016},
                                               {"idle_power", 5.0},
                                               {"power_coefficient", 3.7e-8}};
  const std::map<std::string, std::string> unit = {{"thrust_coefficient", "_n_s2_per_rad2"},
                                                   {"curve_thrust_coefficient", "_n_s2_per_rad2"},
                                                   {"linear_thrust_coefficient", "_n_s_per_rad"},
                                                   {"exponent", ""},
                                                   {"torque_ratio", "_m"},
                                                   {"idle_power", "_w"},
                                                   {"power_coefficient", "_w_s3_per_rad3"}};
  for (const char* points : {"4", "40"}) {
    std::map<std::string, int> held;
    const int seeds = test_support::full_run() ? 200 : 100;
    for (int seed = 1; seed <= seeds; ++seed) {
      const Outcome found =
          fit(generate("stand.csv", "--seed " + std::to_string(seed) + " --points " + points));
      ASSERT_EQ(found.exit_code, 0) << found.output;
      for (const auto& [name, value] : truth)
        held[name] +=
            std::abs(found[name + unit.at(name)] - value) <= found[name + "_95" + unit.at(name)];
    }
    for (const auto& [name, count] : held) {
      EXPECT_GE(count, 0.90 * seeds) << name << " of " << points << " points";
      EXPECT_LE(count, 0.99 * seeds) << name << " of " << points << " points";
    }
  }
}

TEST_F(FitRotor, EverySimulationOptionTakesEffect) {
  const Outcome found =
      fit(generate("stand.csv",
                   "--seed 2 --thrust-coefficient 2e-5 --torque-ratio 0.02 --idle-power 30 "
                   "--power-coefficient 1e-6 --points 80 --slowest 100 --fastest 900 "
                   "--thrust-noise 0.2 --torque-noise 0.004 --power-noise 1"));
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found["points"], 80);
  EXPECT_NEAR(found["thrust_coefficient_n_s2_per_rad2"], 2e-5, 0.05e-5);
  EXPECT_NEAR(found["thrust_residual_n"], 0.2, 0.05);
  EXPECT_NEAR(found["torque_ratio_m"], 0.02, 0.0005);
  EXPECT_NEAR(found["torque_residual_nm"], 0.004, 0.001);
  EXPECT_NEAR(found["idle_power_w"], 30.0, 1.0);
  EXPECT_NEAR(found["power_coefficient_w_s3_per_rad3"], 1e-6, 0.01e-6);
  EXPECT_NEAR(found["power_residual_w"], 1.0, 0.3);
  std::ifstream csv(path("out") + "/fit_rotor.csv");
  std::string first;
  std::getline(csv, first);
  std::getline(csv, first);
  EXPECT_EQ(first.substr(0, 4), "100,");
  EXPECT_NE(read_file(path("out") + "/fit_rotor.csv").find("\n900,"), std::string::npos);
  EXPECT_EQ(read_file(generate("a.csv", "--seed 3")), read_file(generate("b.csv", "--seed 3")));
  EXPECT_NE(read_file(generate("a.csv", "--seed 3")), read_file(generate("b.csv", "--seed 4")));
  EXPECT_EQ(run(program, "--generate '" + path("a.csv") + "' --slowest 3000").exit_code, 2);
}

TEST_F(FitRotor, WarnsIfThrustIsNotProportionalToSpeedSquared) {
  const Outcome other = fit(generate("stand.csv", "--exponent 1.8"));
  ASSERT_EQ(other.exit_code, 0) << other.output;
  EXPECT_NEAR(other["exponent"], 1.8, 0.03);
  EXPECT_TRUE(other.says("thrust goes with speed to the 1.")) << other.output;
  EXPECT_FALSE(fit(generate("stand.csv")).says("thrust goes with speed"));
  // A scale with an offset of 0.3 N.
  std::string text = head;
  for (int i = 0; i <= 20; ++i) {
    const double speed = 300.0 + 130.0 * i;
    text += std::to_string(speed) + ',' + std::to_string(0.3 + 1.4e-6 * speed * speed) + ",,\n";
  }
  text.replace(0, head.size(), "speed_radps,thrust_n,note,\n");
  const Outcome offset = fit_text(text);
  EXPECT_TRUE(offset.says("a scale that is not at zero")) << offset.output;
}

TEST_F(FitRotor, WarnsOfFewPointsAndNarrowSpeedRange) {
  const Outcome few = fit(generate("stand.csv", "--points 6"));
  EXPECT_EQ(few.exit_code, 0);
  EXPECT_TRUE(few.says("so few points (6)")) << few.output;
  EXPECT_FALSE(few.says("less than twice"));
  const Outcome narrow = fit(generate("stand.csv", "--slowest 1500 --fastest 2900"));
  EXPECT_EQ(narrow.exit_code, 0);
  EXPECT_TRUE(narrow.says("the fastest speed is less than twice the slowest")) << narrow.output;
  EXPECT_FALSE(narrow.says("so few"));
  // A point at rest does not widen the speed range.
  std::string text = read_file(path("stand.csv"));
  text += "0,0,0,5\n";
  EXPECT_TRUE(fit_text(text).says("less than twice the slowest"));
}

TEST_F(FitRotor, FitsWithoutTorqueAndPower) {
  const Outcome thrust =
      fit_text("note,thrust_n,speed_radps\nslow,1,1000\n,4,2000\nfast,9.1,3000\n");
  ASSERT_EQ(thrust.exit_code, 0) << thrust.output;
  EXPECT_NEAR(thrust["thrust_coefficient_n_s2_per_rad2"], 1e-6, 0.02e-6);
  EXPECT_EQ(thrust.figures.count("torque_ratio_m"), 0u);
  EXPECT_EQ(thrust.figures.count("power_coefficient_w_s3_per_rad3"), 0u);
  EXPECT_FALSE(thrust.says("torque_ratio_m"));
  const Outcome power =
      fit_text("speed_radps,thrust_n,power_w\n1000,1,10\n2000,4,81\n3000,9.1,268\n0,0,0\n");
  ASSERT_EQ(power.exit_code, 0) << power.output;
  EXPECT_NEAR(power["power_coefficient_w_s3_per_rad3"], 1e-8, 0.05e-8);
  EXPECT_EQ(power.figures.count("torque_ratio_m"), 0u);
}

TEST_F(FitRotor, ReadsOtherColumnNames) {
  const std::string names = "--speed w --thrust T --torque Q --power P";
  const std::string file = generate("stand.csv", names);
  const Outcome wrong = fit(file);
  EXPECT_EQ(wrong.exit_code, 2);
  EXPECT_TRUE(
      wrong.says("stand.csv:2: no column speed_radps, the header line has 'w', 'T', 'Q', "
                 "'P'"))
      << wrong.output;
  const Outcome right = fit(file, names);
  EXPECT_EQ(right.exit_code, 0);
  EXPECT_NEAR(right["torque_ratio_m"], 0.016, 0.0002);
  // A column that an option names must exist.
  EXPECT_EQ(fit(file, "--speed w --thrust T --torque M").exit_code, 2);
  EXPECT_EQ(fit(file, "--speed w --thrust T --power M").exit_code, 2);
}

TEST_F(FitRotor, RejectsPointsThatDoNotDetermineTheFit) {
  const auto status = [&](const std::string& text) {
    const Outcome refused = fit_text(text);
    EXPECT_EQ(refused.exit_code, 1) << refused.output;
    EXPECT_FALSE(refused.says("thrust_coefficient")) << refused.output;
    std::string found = refused.figures.at("status");
    EXPECT_TRUE(refused.says("text.csv: " + found)) << refused.output;
    return found;
  };
  EXPECT_EQ(status(head), "fewer than 3 points");
  EXPECT_EQ(status(head + "1000,1,0.02,10\n2000,4,0.08,80\n"), "fewer than 3 points");
  EXPECT_EQ(status(head + "0,0,0,5\n0,0,0,5\n0,0.1,0,5\n"), "the rotor does not turn");
  EXPECT_EQ(status(head + "1000,1,0,5\n1001,1,0,5\n1000,1.1,0,5\n"),
            "the speed is the same throughout");
  EXPECT_EQ(status(head + "1000,-1,0.02,10\n2000,-4,0.08,80\n3000,-9,0.18,270\n"),
            "the thrust is negative: turn its sign");
  EXPECT_EQ(status(head + "1000,1,-0.02,10\n2000,4,-0.08,80\n3000,9,-0.18,270\n"),
            "the torque is negative: turn its sign");
  EXPECT_EQ(status(head + "1000,5,0.02,10\n2000,5,0.08,80\n3000,5,0.18,270\n"),
            "the thrust does not follow the speed");
  EXPECT_EQ(status(head + "1000,9,0.02,10\n2000,4,0.08,80\n3000,1,0.18,270\n"),
            "the thrust does not follow the speed");
  EXPECT_EQ(status(head + "1000,1,0.1,10\n2000,4,0.1,80\n3000,9,0.1,270\n"),
            "the torque does not follow the speed");
  EXPECT_EQ(status(head + "1000,1,0.02,10\n2000,4,0.08,10\n3000,9,0.18,10\n"),
            "the power does not follow the speed");
  EXPECT_EQ(status(head + "1000,1,0.02,270\n2000,4,0.08,80\n3000,9,0.18,10\n"),
            "the power does not follow the speed");
}

TEST_F(FitRotor, ErrorsNameFileLineAndColumn) {
  const auto refusal = [&](const std::string& text) {
    const Outcome refused = fit_text(text);
    EXPECT_EQ(refused.exit_code, 2) << refused.output;
    return refused.output.substr(refused.output.find("text.csv"));
  };
  EXPECT_EQ(refusal(head + "0,0,0,0\n1000,x,0,0\n"),
            "text.csv:3: column thrust_n (2): 'x' is not a number\n");
  EXPECT_EQ(refusal(head + "0,0,0,0\n1000,1,nan,0\n"),
            "text.csv:3: column torque_nm (3): 'nan' is not finite\n");
  EXPECT_EQ(refusal(head + "0,0,0,0\n# reversed\n-1000,1,0,0\n"),
            "text.csv:4: column speed_radps is negative\n");
  EXPECT_EQ(refusal(head + "0,0,0\n"), "text.csv:2: 3 fields, the header line has 4\n");
  EXPECT_EQ(refusal(""), "text.csv:1: no header line\n");
  EXPECT_EQ(fit(path("nowhere.csv")).exit_code, 2);
}

TEST_F(FitRotor, DrawsPictureWithoutWarnings) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  const std::string thrust_alone =
      write("thrust.csv", "speed_radps,thrust_n\n1000,1\n2000,4\n3000,9.1\n");
  for (const std::string& file : {generate("stand.csv"), thrust_alone}) {
    std::filesystem::remove_all(path("out"));
    const Outcome drawn = run(program, "'" + file + "' -o '" + path("out") + "'");
    EXPECT_EQ(drawn.exit_code, 0);
    EXPECT_EQ(drawn.output.find("arning"), std::string::npos) << drawn.output;
    EXPECT_FALSE(drawn.says("no pictures")) << drawn.output;
    EXPECT_GT(std::filesystem::file_size(path("out") + "/fit_rotor.png"), 10000u);
  }
}

TEST_F(FitRotor, HelpAndBadArguments) {
  const Outcome help = run(program, "--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_TRUE(help.says("--generate"));
  EXPECT_GT(run(program, "").exit_code, 100);
  EXPECT_GT(run(program, "stand.csv --generate other.csv").exit_code, 100);
  EXPECT_GT(run(program, "stand.csv --seed 2").exit_code, 100);
  EXPECT_EQ(run(program, "--generate /proc/nowhere").exit_code, 2);
  EXPECT_EQ(run(program, "'" + generate("stand.csv") + "' -o /proc/nowhere").exit_code, 2);
}

}  // namespace fit_rotor_test
