// Runs the program replay_flight as a user does: with logs of a simulated flight, whose clock
// offset and marker frame are known, and with logs of a real flight if these are available.

#include "support/flights.hpp"
#include "support/full_run.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <sstream>
#include <string>
#include <vector>

namespace replay_flight_test {

using test_support::Flight;
using test_support::Outcome;
using test_support::run;

constexpr double clock_offset = -0.137;  // added to the time stamps of poses [s]
const Eigen::Vector3d marker_position(0.05, -0.08, 0.12);
const Eigen::Quaterniond marker_orientation(Eigen::AngleAxisd(2.5, Eigen::Vector3d(1, 2, 2) / 3.0));

class ReplayFlight : public testing::Test {
 protected:
  /// Simulates 30 s that start upside down. On average, `outliers` of 1000 poses are outliers.
  void fly(int outliers = 0) {
    const Flight flight(3, Eigen::Quaterniond(0.0, 1.0, 0.0, 0.0), marker_position,
                        marker_orientation);
    test_support::Random random(5);
    const double period = 0.005;
    test_support::NoisyImu imu(flight, {2e-4, 2e-3, 2e-5, 3e-4}, period, 4,
                               Eigen::Vector3d(0.03, -0.05, 0.02), Eigen::Vector3d(0.2, -0.1, 0.3));
    std::ostringstream imu_log, pose_log, truth_log;
    for (std::ostringstream* log : {&imu_log, &pose_log, &truth_log}) *log << std::setprecision(12);
    imu_log << "t,wx,wy,wz,fx,fy,fz\n";
    pose_log << "t,px,py,pz,qw,qx,qy,qz\n";
    truth_log << "t,px,py,pz,qw,qx,qy,qz,vx,vy,vz\n";
    const auto add = [](std::ostringstream& log, const Eigen::Vector3d& v) {
      log << ',' << v.x() << ',' << v.y() << ',' << v.z();
    };
    const auto add_rotation = [](std::ostringstream& log, const Eigen::Quaterniond& q) {
      log << ',' << q.w() << ',' << q.x() << ',' << q.y() << ',' << q.z();
    };
    for (int i = 0; i < 6000; ++i) {
      const double t = period * i;
      const auto sample = imu(t);
      imu_log << t;
      add(imu_log, sample.angular_velocity);
      add(imu_log, sample.specific_force);
      imu_log << '\n';
      const auto x = flight.state(t);
      truth_log << t;
      add(truth_log, x.position);
      add_rotation(truth_log, x.orientation);
      add(truth_log, x.velocity);
      truth_log << '\n';
      if (i % 2 != 0) continue;
      auto pose = test_support::noisy(flight.pose(t), {1e-3, 3e-3}, random);
      if (random.uniform(0.0, 1000.0) < outliers) pose = test_support::gone_wrong(pose, random);
      pose_log << t - clock_offset;
      add(pose_log, pose.position);
      add_rotation(pose_log, pose.orientation);
      pose_log << '\n';
    }
    directory_.write("imu.csv", imu_log.str());
    directory_.write("pose.csv", pose_log.str());
    directory_.write("truth.csv", truth_log.str());
  }

  [[nodiscard]] Outcome replay(const std::string& arguments) const {
    return run(REPLAY_FLIGHT_PROGRAM,  // set by CMake
               "--no-pictures --output '" + directory_.file("out") + "' " + arguments);
  }
  [[nodiscard]] std::string logs(bool with_truth = true) const {
    const auto quoted = [this](const char* name) { return " '" + directory_.file(name) + "'"; };
    return quoted("imu.csv") + quoted("pose.csv") + (with_truth ? quoted("truth.csv") : "");
  }

  test_support::Directory directory_{"replay_flight"};
};

TEST_F(ReplayFlight, EstimatesClockMarkerFrameAndStateFromLogs) {
  fly();
  const Outcome found = replay(logs() + " --calibrate-clock --estimate-marker-pose");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_NEAR(found["clock_offset_s"], clock_offset, 0.001);
  EXPECT_NEAR(found["marker_rotation_deg"], 2.5 * 180.0 / 3.14159265, 0.3);
  EXPECT_NEAR(found["marker_lever_m"], marker_position.norm(), 0.002);
  EXPECT_EQ(found["samples"], 6000);
  EXPECT_EQ(found["poses"], 3000);
  EXPECT_EQ(found["restarts"], 0);
  EXPECT_LT(found["position_rmse_m"], 0.002);
  EXPECT_LT(found["attitude_rmse_deg"], 0.3);
  EXPECT_LT(found["velocity_rmse_mps"], 0.01);
  EXPECT_NEAR(found["truth_shift_s"], 0.0, 0.002);
}

TEST_F(ReplayFlight, CalibratesFromTheWholeLogAndRepeatsTheReplay) {
  fly(20);
  const Outcome found = replay(logs() + " --calibrate");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_NEAR(found["clock_offset_s"], clock_offset, 3.0 * found["clock_offset_95_s"]);
  EXPECT_LT(found["clock_offset_95_s"], 0.001);
  EXPECT_NEAR(found["marker_rotation_deg"], 2.5 * 180.0 / 3.14159265, 0.2);
  EXPECT_NEAR(found["marker_lever_m"], marker_position.norm(), 0.001);
  EXPECT_LT(found["marker_position_95_m"], 0.001);
  EXPECT_NEAR(found["gyro_bias_radps"], 0.03, 0.002);
  EXPECT_NEAR(found["accelerometer_bias_mps2"], 0.2, 0.02);
  EXPECT_NEAR(found["calibration_outliers"], 60, 25);
  EXPECT_NEAR(found["calibration_position_residual_m"], 0.001, 2e-4);
  EXPECT_LT(found["position_rmse_m"], 0.002);
  EXPECT_LT(found["attitude_rmse_deg"], 0.3);
  const std::string key = "replay with it: ";
  const std::size_t start = found.output.find(key) + key.size();
  const std::string options = found.output.substr(start, found.output.find('\n', start) - start);
  const Outcome again = replay(logs() + ' ' + options);
  ASSERT_EQ(again.exit_code, 0) << again.output;
  for (const char* figure : {"position_rmse_m", "attitude_rmse_deg", "clock_offset_s"})
    EXPECT_NEAR(again[figure], found[figure], 2e-5 + 0.01 * std::abs(found[figure])) << figure;
  const std::string with_gyro = options.substr(0, options.find(" --accelerometer-bias"));
  const std::string without = options.substr(0, options.find(" --gyro-bias"));
  const auto first_row = [this](const std::string& given) {
    EXPECT_EQ(replay(logs() + ' ' + given).exit_code, 0);
    std::ifstream csv(directory_.file("out") + "/replay_flight.csv");
    std::string row;
    std::getline(csv, row);
    std::getline(csv, row);
    return row;
  };
  EXPECT_NE(first_row(with_gyro), first_row(options));
  EXPECT_NE(first_row(with_gyro), first_row(without));
  const Outcome with_gravity = replay(logs() + " --calibrate --gravity-deviation 0.02");
  EXPECT_NEAR(with_gravity["gravity_tilt_rad"], 0.0, 0.002) << with_gravity.output;
}

TEST_F(ReplayFlight, UsesGivenClockOffsetAndMarkerFrame) {
  fly();
  std::ostringstream given;
  const Eigen::Quaterniond& q = marker_orientation;
  given << std::setprecision(12) << " --marker-rotation " << q.w() << ' ' << q.x() << ' ' << q.y()
        << ' ' << q.z() << " --marker-lever " << marker_position.x() << ' ' << marker_position.y()
        << ' ' << marker_position.z();
  const Outcome plain = replay(logs() + " --clock-offset=-0.137" + given.str());
  ASSERT_EQ(plain.exit_code, 0) << plain.output;
  EXPECT_EQ(plain["marker_rotation_deg"], 0.0);
  EXPECT_EQ(plain["marker_lever_m"], 0.0);
  EXPECT_LT(plain["position_rmse_m"], 0.002);
  const Outcome ten_ms_off = replay(logs() + " --clock-offset=-0.127" + given.str());
  EXPECT_GT(ten_ms_off["position_rmse_m"], 2.0 * plain["position_rmse_m"]) << ten_ms_off.output;
  // The filter finds the latency of the poses. Without this it would refuse half of them and go
  // astray by metres.
  EXPECT_LT(ten_ms_off["position_rmse_m"], 0.01) << ten_ms_off.output;
  EXPECT_NEAR(ten_ms_off["truth_shift_s"], 0.0, 0.005);
  const Outcome lost = replay(logs() + " --clock-offset=-0.137");  // marker frame 143 degrees off
  EXPECT_TRUE(lost.exit_code == 1 && lost.says("turned by 143 degrees")) << lost.output;
}

TEST_F(ReplayFlight, RejectsOutliers) {
  fly(50);
  const Outcome found = replay(logs() + " --calibrate-clock --estimate-marker-pose");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_NEAR(found["rejected"], 150, 40);
  EXPECT_LT(found["position_rmse_m"], 0.003);
}

TEST_F(ReplayFlight, FilterOptionsTakeEffect) {  // one; all in a full run
  fly(50);
  const std::string common = logs() + " --estimate-marker-pose --clock-offset -0.137";
  const Outcome plain = replay(common);
  std::vector<const char*> options = {"--gyro-noise 0.02"};
  if (test_support::full_run()) {
    EXPECT_EQ(replay(common).figures, plain.figures);
    options.insert(options.end(),
                   {"--judge-from 20", "--accelerometer-noise 0.2", "--accelerometer-walk 0.1",
                    "--gyro-walk 0.01", "--orientation-noise 0.02", "--position-noise 0.01"});
  }
  for (const char* option : options)
    EXPECT_NE(replay(common + ' ' + option).figures, plain.figures) << option;
  const Outcome strict = replay(common + " --gate 2 --max-rejections 2");
  EXPECT_GT(strict["rejected"], plain["rejected"]);
  EXPECT_GT(strict["restarts"], 10) << strict.output;
}

TEST_F(ReplayFlight, WritesEstimateWithStddevAndErrors) {
  fly();
  ASSERT_EQ(replay(logs() + " --calibrate-clock --estimate-marker-pose").exit_code, 0);
  std::ifstream csv(directory_.file("out") + "/replay_flight.csv");
  std::string header, line;
  std::getline(csv, header);
  for (const char* column : {"time_s,", "orientation_w,", "deviation_velocity_mps_z,",
                             "deviation_marker_position_m_x,", "error_orientation_rad_z"})
    EXPECT_NE(header.find(column), std::string::npos) << column;
  int rows = 0;
  while (std::getline(csv, line)) ++rows;
  EXPECT_NEAR(rows, 6000, 10);  // from the first pose on
  ASSERT_EQ(replay(logs(false) + " --calibrate-clock --estimate-marker-pose").exit_code, 0);
  std::ifstream unjudged(directory_.file("out") + "/replay_flight.csv");
  std::getline(unjudged, header);
  EXPECT_EQ(header.find("error"), std::string::npos);
}

TEST_F(ReplayFlight, DrawsPictureWithoutWarnings) {
  if (std::system("gnuplot --version > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "gnuplot is not installed";
  fly();
  for (const bool with_truth : {true, false}) {
    const Outcome drawn =
        run(REPLAY_FLIGHT_PROGRAM, "--output '" + directory_.file("out") + "' " + logs(with_truth) +
                                       " --calibrate-clock --estimate-marker-pose");
    EXPECT_EQ(drawn.exit_code, 0);
    EXPECT_FALSE(drawn.says("arning")) << drawn.output;
    EXPECT_GT(std::filesystem::file_size(directory_.file("out") + "/replay_flight.png"), 10000u);
    std::filesystem::remove(directory_.file("out") + "/replay_flight.png");
  }
}

TEST_F(ReplayFlight, ErrorsNameFileLineAndColumn) {
  fly();
  const std::string imu = " '" + directory_.file("imu.csv") + "'";
  const auto refusal = [&](const std::string& head, const std::string& text) {
    const Outcome refused = replay(imu + " '" + directory_.write("bad.csv", head + text) + "'");
    EXPECT_EQ(refused.exit_code, 2) << refused.output;
    return refused.output.substr(refused.output.find("bad.csv"));
  };
  const std::string head = "t,px,py,pz,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n";
  EXPECT_EQ(refusal(head, "0.1,0,0,x,1,0,0,0\n"),
            "bad.csv:3: column pz (4): 'x' is not a number, expected is a number\n");
  EXPECT_EQ(refusal(head, "0.1,0,0,0,1,0,0\n"), "bad.csv:3: 7 fields, the header line has 8\n");
  EXPECT_EQ(refusal(head, "0.1,0,0,0,2,0,0,0\n"),
            "bad.csv:3: columns qw (5) to qz: a quaternion of length 2.000000, must be 1\n");
  EXPECT_EQ(refusal("t,px\n", "0,1\n"),
            "bad.csv:1: 2 columns, expected are t, px, py, pz, qw, qx, qy, qz\n");
  EXPECT_EQ(refusal(head, ""), "bad.csv: fewer than two samples\n");
  EXPECT_TRUE(replay(imu + " nowhere.csv").says("cannot read nowhere.csv"));
  const Outcome backwards =
      replay(imu + " '" + directory_.write("bad.csv", head + "-1,0,0,0,1,0,0,0\n") + "'");
  EXPECT_TRUE(backwards.says("bad.csv:3: column t (1) does not increase")) << backwards.output;
}

TEST_F(ReplayFlight, RejectsMismatchedLogsWithAHint) {
  fly();
  const Outcome apart = replay(logs() + " --clock-offset 500");
  EXPECT_EQ(apart.exit_code, 1);
  EXPECT_TRUE(apart.says("--calibrate-clock")) << apart.output;
  const std::string still = "0,0,0,0,0,0,9.81\n";
  std::string log = "t,wx,wy,wz,fx,fy,fz\n";
  for (int i = 0; i < 3000; ++i) log += std::to_string(0.01 * i) + still.substr(1);
  const Outcome calm = replay(" '" + directory_.write("still.csv", log) + "' '" +
                              directory_.file("pose.csv") + "' --calibrate-clock");
  EXPECT_EQ(calm.exit_code, 1);
  EXPECT_TRUE(calm.says("cannot be calibrated")) << calm.output;
  const Outcome still_calm = replay(" '" + directory_.file("still.csv") + "' '" +
                                    directory_.file("pose.csv") + "' --calibrate");
  EXPECT_EQ(still_calm.exit_code, 1);
  EXPECT_TRUE(still_calm.says("cannot be calibrated: the clock offset is not found"))
      << still_calm.output;
}

// Lies that replay_flight finds by trying, each from the same good logs.
TEST_F(ReplayFlight, EndsWithTheLikelyReasonWherePosesAreRefused) {
  fly();
  const Outcome turned = replay(logs() + " --clock-offset=-0.137");
  EXPECT_EQ(turned.exit_code, 1);
  EXPECT_TRUE(turned.says("marker frame is turned by 143 degrees")) << turned.output;
  std::string imu = "t,c1,c2,c3,c4,c5,c6\n", line;
  std::ifstream good(directory_.file("imu.csv"));
  std::getline(good, line);
  while (std::getline(good, line)) {  // gyroscope and accelerometer exchanged, in ms
    std::istringstream fields(line);
    std::vector<std::string> f;
    for (std::string field; std::getline(fields, field, ',');) f.push_back(field);
    imu += std::to_string(1e3 * std::stod(f[0]));
    for (const std::size_t i : {4u, 5u, 6u, 1u, 2u, 3u}) imu += ',' + f[i];
    imu += '\n';
  }
  const Outcome swapped = replay(" '" + directory_.write("swapped.csv", imu) + "' '" +
                                 directory_.file("pose.csv") + "' --calibrate");
  EXPECT_EQ(swapped.exit_code, 1);
  EXPECT_TRUE(swapped.says("gyroscope and accelerometer are exchanged")) << swapped.output;
  EXPECT_TRUE(swapped.says("unknown names")) << swapped.output;
  EXPECT_TRUE(swapped.says("read as ms")) << swapped.output;
}

// EuRoC and TUM files as they are downloaded: the same replay as that of the plain files.
TEST_F(ReplayFlight, ReadsEurocAndTumAsDownloaded) {
  fly();
  const Outcome plain = replay(logs(false) + " --calibrate");
  const auto converted = [this](const char* from, const std::string& header, bool tum) {
    std::ifstream in(directory_.file(from));
    std::string line, text = header;
    std::getline(in, line);
    while (std::getline(in, line)) {
      std::istringstream fields(line);
      std::vector<std::string> f;
      for (std::string field; std::getline(fields, field, ',');) f.push_back(field);
      std::ostringstream time;
      time << std::fixed << std::setprecision(tum ? 6 : 0)
           << (tum ? 1.0 : 1e9) * (1403715000.0 + std::stod(f[0]));
      f[0] = time.str();
      if (tum) std::rotate(f.begin() + 4, f.begin() + 5, f.end());  // x y z w
      for (std::size_t i = 0; i < f.size(); ++i) text += (i == 0 ? "" : tum ? " " : ",") + f[i];
      text += "\r\n";
    }
    return " '" + directory_.write(std::string("as_downloaded_") + from, text) + "'";
  };
  const std::string imu =
      converted("imu.csv",
                "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
                "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\r\n",
                false);
  const std::string tum =
      converted("pose.csv",
                "# ground truth trajectory\n# file: 'x'\n# timestamp tx ty tz qx qy qz qw\n", true);
  const Outcome found = replay(imu + tum + " --calibrate");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found["time_origin_s"], 1403715000);
  EXPECT_NEAR(found["used"], plain["used"], 5);
  EXPECT_NEAR(found["clock_offset_s"], plain["clock_offset_s"], 1e-5);
  EXPECT_NEAR(found["marker_lever_m"], plain["marker_lever_m"], 1e-4);
}

TEST_F(ReplayFlight, HelpAndBadArguments) {
  const Outcome help = replay("--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_TRUE(help.says("--estimate-marker-pose"));
  EXPECT_GT(replay("").exit_code, 100);
  EXPECT_GT(replay("a b --gate -1").exit_code, 100);
  EXPECT_GT(replay("a b --calibrate-clock --clock-offset 1").exit_code, 100);
  for (const char* option : {"--calibrate-clock", "--clock-offset 1", "--estimate-marker-pose",
                             "--marker-lever 0 0 1", "--gyro-bias 0 0 1"})
    EXPECT_GT(replay(std::string("a b --calibrate ") + option).exit_code, 100) << option;
  EXPECT_GT(replay("a b --gravity-deviation 0.1").exit_code, 100);
  EXPECT_GT(replay("a b --marker-rotation 1 0 0 0 0").exit_code, 100);
  fly();
  EXPECT_EQ(replay(logs() + " --output /proc/nowhere").exit_code, 1);
}

// A real flight: TILT_ROPTER_DATA names the directory that contains euroc_v203.
TEST_F(ReplayFlight, EstimatesARecordedFlight) {
  const char* data = std::getenv("TILT_ROPTER_DATA");
  if (data == nullptr || !std::filesystem::exists(std::string(data) + "/euroc_v203/imu.csv"))
    GTEST_SKIP() << "TILT_ROPTER_DATA does not name a directory with euroc_v203";
  const auto quoted = [data](const char* name) {
    return " '" + std::string(data) + "/euroc_v203/" + name + "'";
  };
  const Outcome found = replay(quoted("imu.csv") + quoted("pose.csv") + quoted("truth.csv") +
                               " --calibrate-clock --estimate-marker-pose");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_EQ(found["restarts"], 0);
  EXPECT_LT(found["attitude_rmse_deg"], 0.5);
  EXPECT_LT(found["velocity_rmse_mps"], 0.028);
  // In the truth, positions and attitudes differ by 8 ms, at speeds of up to 2 m/s. IMU and motion
  // capture agree with the attitudes of the truth.
  EXPECT_LT(found["position_rmse_m"], 0.008);
  EXPECT_LT(found["shifted_position_rmse_m"], 0.003);
  EXPECT_NEAR(found["truth_shift_s"], -0.008, 0.002);
}

TEST_F(ReplayFlight, CalibratesARecordedFlight) {
  const char* data = std::getenv("TILT_ROPTER_DATA");
  if (data == nullptr || !std::filesystem::exists(std::string(data) + "/euroc_v203/imu.csv"))
    GTEST_SKIP() << "TILT_ROPTER_DATA does not name a directory with euroc_v203";
  const std::string source = std::string(data) + "/euroc_v203/";
  const auto whole = [&source](const char* name) { return " '" + source + name + "'"; };
  const Outcome found =
      replay(whole("imu.csv") + whole("pose.csv") + whole("truth.csv") + " --calibrate");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_LT(found["shifted_position_rmse_m"], 0.003);
  EXPECT_LT(found["shifted_attitude_rmse_deg"], 0.45);
  EXPECT_NEAR(found["clock_offset_s"], 0.2, 0.001);
  EXPECT_GT(found["calibration_error_scale"], 1.5);  // motion capture errs for seconds
  // The second half alone, with these values.
  const auto second_half = [&](const char* name) {
    std::ifstream in(source + name);
    std::string text, line;
    std::getline(in, text);
    text += '\n';
    while (std::getline(in, line))
      if (std::stod(line) >= 27.0) text += line + '\n';
    return " '" + directory_.write(name, text) + "'";
  };
  const std::string key = "replay with it: ";
  const std::size_t start = found.output.find(key) + key.size();
  const std::string options = found.output.substr(start, found.output.find('\n', start) - start);
  const Outcome half = replay(second_half("imu.csv") + second_half("pose.csv") +
                              second_half("truth.csv") + ' ' + options);
  ASSERT_EQ(half.exit_code, 0) << half.output;
  EXPECT_LT(half["shifted_position_rmse_m"], 0.003);
  EXPECT_LT(half["shifted_attitude_rmse_deg"], 0.45);
}

}  // namespace replay_flight_test
