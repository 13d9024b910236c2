// Runs the program monte_carlo as a user does. A full run flies a thousand vehicles.
// CTest: flight

#include "../../examples/support/flight_table.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"

#include <tilt_ropter/actuation/rotor.hpp>

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <string>
#include <vector>

namespace monte_carlo_test {

namespace fs = std::filesystem;

const std::string program = MONTE_CARLO_PROGRAM;  // set by CMake

struct Outcome {
  int exit_code = -1;
  std::string output, errors, csv;
};

std::string contents(const fs::path& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

fs::path scratch() {
  fs::path path = fs::path(testing::TempDir()) / ("monte_carlo_" + std::to_string(getpid()));
  fs::create_directories(path);
  return path;
}

Outcome run(const std::string& directory, const std::string& arguments) {
  Outcome result;
  const fs::path output = scratch() / directory, errors = scratch() / "errors";
  const std::string command = "'" + program + "' --output '" + output.string() +
                              "' --no-pictures " + arguments + " 2> '" + errors.string() + "'";
  FILE* pipe = popen(command.c_str(), "r");
  if (pipe == nullptr) return result;
  char buffer[4096];
  while (std::fgets(buffer, sizeof buffer, pipe) != nullptr) result.output += buffer;
  result.exit_code = pclose(pipe);
  result.errors = contents(errors);
  result.csv = contents(output / "monte_carlo.csv");
  return result;
}

std::string table(const std::string& directory) {
  return "'" + (scratch() / directory / "monte_carlo.csv").string() + "'";
}

const Eigen::Matrix3d the_inertia = tilt_ropter::tilt_ropter_vehicle().body.inertia;

// Vehicle 23 has slow actuators. It tipped over on the ground when a rotor without thrust was still
// allowed to turn across the end of its servo range.
TEST(MonteCarlo, FliesVehiclesWithUnknownParameters) {
  const Outcome whole = run("whole", "--first 21 --count 4 --threads 2");
  ASSERT_EQ(whole.exit_code, 0) << whole.errors;
  std::istringstream csv(whole.csv);
  const examples::CsvTable flights = examples::read_csv(csv, "whole");
  ASSERT_EQ(flights.rows(), 4u);
  for (std::size_t i = 0; i < flights.rows(); ++i) {
    EXPECT_EQ(flights["verdict"][i], 0.0) << flights["index"][i];
    EXPECT_GT(flights["air_rmse_m"][i], 0.0) << flights["index"][i];
    EXPECT_LT(flights["air_rmse_m"][i], 0.06) << flights["index"][i];
    EXPECT_GT(flights["ground_rmse_m"][i], 0.0) << flights["index"][i];
    EXPECT_LT(flights["ground_rmse_m"][i], 0.10) << flights["index"][i];
    EXPECT_EQ(flights["solver_failures"][i], 0.0) << flights["index"][i];
    EXPECT_EQ(flights["false_alarms"][i], 0.0) << flights["index"][i];
    EXPECT_GT(flights["time_s"][i], 75.0) << flights["index"][i];
  }
  EXPECT_NE(whole.output.find("divergences: 0\n"), std::string::npos) << whole.output;
}

TEST(MonteCarlo, ReplayRepeatsTheFlightExactly) {
  const Outcome flown = run("flown", "--first 23 --count 1"),
                replayed = run("replayed", "--replay 23");
  ASSERT_EQ(replayed.exit_code, 0) << replayed.errors;
  std::istringstream csv(flown.csv);
  std::string header, row;
  std::getline(csv, header);
  std::getline(csv, row);
  std::istringstream names(header), values(row);
  for (std::string name, value; std::getline(names, name, ',');) {
    ASSERT_TRUE(std::getline(values, value, ','));
    EXPECT_NE(replayed.output.find('\n' + name + ": " + value + '\n'), std::string::npos) << name;
  }
  EXPECT_GT(fs::file_size(scratch() / "replayed" / "hybrid_mission.csv"), 1000000u);
}

// Each tipped over once: rotors of 1.8 times the time constant, whose lag was learnt as a speed
// ratio, and poses of twice the noise, which convicted the IMU.
TEST(MonteCarlo, VehiclesThatWereLostFly) {
  for (const char* index : {"671", "620"}) {
    const Outcome flight = run("once_lost", std::string("--level wrench --replay ") + index);
    EXPECT_NE(flight.output.find("verdict: ok\n"), std::string::npos) << index << flight.output;
  }
}

// In noise and wind the lag of healthy servos explains a fifth of the changes of the residual.
TEST(MonteCarlo, HealthyServosInNoiseAndWindAreNotCalledSlow) {
  for (const char* index : {"86", "243"}) {
    const Outcome flight =
        run("once_alarmed", std::string("--level wrench --seed 3 --replay ") + index);
    EXPECT_NE(flight.output.find("\nfalse_alarms: 0\n"), std::string::npos)
        << index << flight.output;
  }
}

TEST(MonteCarlo, SeedAndIndexDetermineTheVehicle) {
  examples::RandomStream a(1, 5), b(1, 5), seed(2, 5), index(1, 6);
  const double mass = examples::draw_vehicle(a, the_inertia).mass;
  EXPECT_EQ(examples::draw_vehicle(b, the_inertia).mass, mass);
  EXPECT_NE(examples::draw_vehicle(seed, the_inertia).mass, mass);
  EXPECT_NE(examples::draw_vehicle(index, the_inertia).mass, mass);
}

TEST(MonteCarlo, DrawsCoverEveryRangeAndStayInside) {
  struct Range {
    double from, to, least = 1e9, most = -1e9;
    void add(double x) { least = std::min(least, x), most = std::max(most, x); }
  };
  Range mass{0.8, 1.2}, inertia{0.7, 1.3}, com{-0.01, 0.01}, thrust{0.85, 1.15}, lag{0.5, 2.0},
      delay{0.0, 0.02}, friction{0.3, 1.0}, wind{0.0, 1.0};
  for (std::uint64_t k = 0; k < 2000; ++k) {
    examples::RandomStream random(1, k);
    const examples::VehicleDraw d = examples::draw_vehicle(random, the_inertia);
    EXPECT_NO_THROW(validate(examples::true_vehicle(d, tilt_ropter::tilt_ropter_vehicle())));
    mass.add(d.mass), thrust.add(d.thrust), friction.add(d.friction), wind.add(d.wind);
    for (int axis = 0; axis < 3; ++axis) inertia.add(d.inertia(axis)), com.add(d.com_offset(axis));
    lag.add(d.servo_time_constant), lag.add(d.rotor_time_constant);
    delay.add(d.command_delay), delay.add(d.capture_delay);
  }
  for (const Range& r : {mass, inertia, com, thrust, lag, delay, friction, wind}) {
    EXPECT_GE(r.least, r.from);
    EXPECT_LE(r.most, r.to);
    EXPECT_LT(r.least, r.from + 0.02 * (r.to - r.from));
    EXPECT_GT(r.most, r.to - 0.02 * (r.to - r.from));
  }
}

TEST(MonteCarlo, InertiaWithProductsStaysPhysical) {
  auto believed = tilt_ropter::tilt_ropter_vehicle();
  believed.body.inertia << 0.014, 0.003, -0.002, 0.003, 0.014, 0.001, -0.002, 0.001, 0.025;
  for (std::uint64_t k = 0; k < 500; ++k) {
    examples::RandomStream random(1, k);
    const examples::VehicleDraw draw = examples::draw_vehicle(random, believed.body.inertia);
    EXPECT_NO_THROW(validate(examples::true_vehicle(draw, believed))) << k;
  }
  EXPECT_TRUE(examples::is_physical(Eigen::Vector3d(1.0, 1.0, 2.0).asDiagonal()));
  EXPECT_FALSE(examples::is_physical(Eigen::Vector3d(1.0, 1.0, 2.01).asDiagonal()));
}

TEST(MonteCarlo, TrueRotorPositionsAreRelativeToTheShiftedCom) {
  examples::VehicleDraw draw;
  draw.com_offset << 0.01, -0.005, 0.002;
  const auto believed = tilt_ropter::tilt_ropter_vehicle();
  const auto truth = examples::true_vehicle(draw, believed);
  for (std::size_t i = 0; i < 4; ++i)
    EXPECT_TRUE(truth.rotors[i].position.isApprox(believed.rotors[i].position - draw.com_offset));
}

TEST(MonteCarlo, ThrustFactorKeepsTheSpeedsOfEachRotor) {
  examples::VehicleDraw draw;
  draw.thrust = 0.9;
  draw.rotor_time_constant = 1.5;
  auto believed = tilt_ropter::tilt_ropter_vehicle();
  believed.rotors[2].parameters = {2e-6, 0.02, 1.0, 14.0, 0.04, 1e-3};
  const auto truth = examples::true_vehicle(draw, believed);
  for (const std::size_t i : {1U, 2U}) {
    const auto &was = rotor_parameters(believed, i), &is = rotor_parameters(truth, i);
    EXPECT_NEAR(is.min_thrust, 0.9 * was.min_thrust, 1e-12);
    EXPECT_NEAR(is.max_thrust, 0.9 * was.max_thrust, 1e-12);
    EXPECT_NEAR(is.time_constant, 1.5 * was.time_constant, 1e-15);
    EXPECT_NEAR(tilt_ropter::speed_from_thrust(is.max_thrust, is),
                tilt_ropter::speed_from_thrust(was.max_thrust, was), 1e-9);
  }
}

TEST(MonteCarlo, SortsDivergedFlightsFirstThenWorstRmse) {
  examples::CsvTable flights{"", examples::flight_columns(), {}, {}};
  flights.columns.resize(flights.names.size());
  const auto add = [&flights](std::uint64_t index, examples::Verdict verdict, double air,
                              double ground) {
    examples::FlightRecord record;
    record.verdict = verdict, record.air_rmse = air, record.ground_rmse = ground;
    std::size_t c = 0;
    for (const auto& [name, value] : examples::flight_row(1, index, {}, record))
      flights.columns[c++].push_back(value);
    flights.lines.push_back(index + 2);
  };
  add(0, examples::Verdict::ok, 0.01, 0.05);
  add(1, examples::Verdict::ok, 0.05, 0.01);
  add(2, examples::Verdict::tipped, 0.001, 0.0);
  add(3, examples::Verdict::ok, 0.01, 0.09);
  EXPECT_EQ(examples::worst_first(flights), (std::vector<std::size_t>{2, 3, 1, 0}));
  EXPECT_EQ(examples::percentile({4.0, 1.0, 3.0, 2.0}, 0.5), 2.0);
  EXPECT_EQ(examples::percentile({4.0, 1.0, 3.0, 2.0}, 1.0), 4.0);
  EXPECT_EQ(examples::percentile({4.0}, 0.05), 4.0);
  const double none = std::nan("");
  EXPECT_EQ(examples::percentile({none, 1.0, none, 2.0}, 0.5), 2.0);
  EXPECT_TRUE(std::isnan(examples::percentile({none, 1.0, none, 2.0}, 1.0)));
}

TEST(MonteCarlo, ErrorsNameFileLineAndReason) {
  const auto refused = [](const std::string& files, const std::string& why) {
    const Outcome merged = run("refused", "--merge " + files);
    EXPECT_NE(merged.exit_code, 0) << why;
    EXPECT_NE(merged.errors.find(why), std::string::npos) << merged.errors;
  };
  // Without wheels, so that the mission is short.
  const Outcome whole = run("whole", "--count 1 --vehicle '" VEHICLES_DIR "/hexacopter.json'");
  ASSERT_EQ(whole.exit_code, 0) << whole.errors;
  const fs::path bad = scratch() / "bad.csv";
  const auto write = [&bad](const std::string& text) { std::ofstream(bad) << text; };
  fs::copy_file(scratch() / "whole" / "monte_carlo.run", scratch() / "bad.run");
  const std::string quoted = "'" + bad.string() + "'";
  refused("/nowhere/at/all.csv", "/nowhere/at/all.csv");
  refused("/nowhere/at/all", "cannot read /nowhere/at/all.run");
  refused(table("whole") + " " + table("whole"), "monte_carlo.csv:2: the vehicle is there twice");
  write("seed,index\n1,0\n");
  refused(quoted, "bad.csv:1: no column mass_factor");
  const std::size_t header_end = whole.csv.find('\n') + 1;
  const std::string header = whole.csv.substr(0, header_end);
  write(header);
  refused(quoted, "no vehicles in");
  std::string other = whole.csv.substr(header_end, whole.csv.find('\n', header_end) - header_end);
  write(header + "7" + other.substr(1) + "\n");
  refused(table("whole") + " " + quoted, "bad.csv:2: the seed is another one");
  const std::size_t after_index = other.find(',', other.find(',') + 1);
  write(header + "1,-1" + other.substr(after_index) + "\n");
  refused(quoted, "bad.csv:2: no such index");
  write(header + "nan,0" + other.substr(after_index) + "\n");
  refused(quoted, "bad.csv:2: no such seed");
  write(header + other.substr(0, 20) + "\n");
  refused(quoted, "bad.csv:2: ");
}

TEST(MonteCarlo, HelpAndBadArguments) {
  const Outcome help = run("help", "--help");
  EXPECT_EQ(help.exit_code, 0);
  for (const char* option : {"--seed", "--first", "--count", "--threads", "--merge", "--replay"})
    EXPECT_NE(help.output.find(option), std::string::npos) << option;
  EXPECT_NE(run("bad", "--count 0").exit_code, 0);
  EXPECT_NE(run("bad", "--threads 0").exit_code, 0);
  EXPECT_NE(run("bad", "--replay 3 --count 2").exit_code, 0);
  EXPECT_NE(run("bad", "--merge x.csv --first 2").exit_code, 0);
  EXPECT_NE(run("bad", "--output /proc/nowhere --count 1").exit_code, 0);
}

TEST(MonteCarlo, ThousandVehiclesFlyWithoutDivergence) {
  if (!test_support::full_run()) GTEST_SKIP() << "takes minutes: --full";
  const Outcome thousand = run("thousand", "--count 1000 --seed 3");
  ASSERT_EQ(thousand.exit_code, 0) << thousand.errors;
  std::istringstream csv(thousand.csv);
  const examples::CsvTable flights = examples::read_csv(csv, "thousand");
  const std::vector<double>& verdicts = flights["verdict"];
  ASSERT_EQ(verdicts.size(), 1000u);
  test_support::check_at_most(
      13, "1000 vehicles: divergences",
      static_cast<double>(std::count_if(verdicts.begin(), verdicts.end(),
                                        [](double verdict) { return verdict != 0.0; })),
      0);
  const std::vector<double>& alarms = flights["false_alarms"];
  test_support::check_at_most(30, "1000 healthy flights: false alarms",
                              static_cast<double>(std::count(alarms.begin(), alarms.end(), 1.0)),
                              0);
  test_support::check_at_most(13, "1000 vehicles: 95 % of air runs [m]",
                              examples::percentile(flights["air_rmse_m"], 0.95), 0.025);
  test_support::check_at_most(13, "1000 vehicles: 95 % of ground runs [m]",
                              examples::percentile(flights["ground_rmse_m"], 0.95), 0.030);
  test_support::check_at_most(13, "1000 vehicles: 95 % of missions [m]",
                              examples::percentile(flights["mission_rmse_m"], 0.95), 0.040);
}

}  // namespace monte_carlo_test
