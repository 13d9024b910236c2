#include <tilt_ropter/identification/clock_calibration.hpp>

#include <gtest/gtest.h>

#include <cstddef>
#include <cstdlib>
#include <fstream>
#include <sstream>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace clock_calibration_recorded_test {

using Status = ClockCalibrationStatus;

// Returns the rows of a CSV file after its header.
std::vector<std::vector<double>> read_rows(const std::string& path) {
  std::ifstream file(path);
  std::vector<std::vector<double>> rows;
  std::string line;
  std::getline(file, line);
  while (std::getline(file, line)) {
    std::istringstream cells(line);
    std::vector<double> row;
    for (std::string cell; std::getline(cells, cell, ',');) row.push_back(std::stod(cell));
    rows.push_back(row);
  }
  return rows;
}

// TILT_ROPTER_DATA names a directory with euroc_v203/{imu,pose,truth}.csv: a flight from the EuRoC
// data set (Burri et al., IJRR 2016).
TEST(ClockCalibration, RecordedFlightAgreesWithGroundTruth) {
  const char* directory = std::getenv("TILT_ROPTER_DATA");
  if (directory == nullptr) GTEST_SKIP() << "TILT_ROPTER_DATA is not set: no recorded flight";
  const std::string path = std::string(directory) + "/euroc_v203/";
  const auto imu_rows = read_rows(path + "imu.csv"), pose_rows = read_rows(path + "pose.csv"),
             truth_rows = read_rows(path + "truth.csv");
  if (imu_rows.empty() || pose_rows.empty() || truth_rows.empty())
    GTEST_SKIP() << "no recorded flight in TILT_ROPTER_DATA";
  std::vector<Timed<InertialSampled>> imu, truth;
  imu.reserve(imu_rows.size());
  for (const auto& row : imu_rows) {
    InertialSampled sample;
    sample.angular_velocity << row.at(1), row.at(2), row.at(3);
    imu.push_back({row[0], sample});
  }
  std::vector<Timed<MarkerPosed>> poses;
  poses.reserve(pose_rows.size());
  for (const auto& row : pose_rows)
    poses.push_back({row.at(0),
                     {{row.at(1), row.at(2), row.at(3)},
                      Eigen::Quaterniond(row.at(4), row.at(5), row.at(6), row.at(7))}});
  // The gyro measurement that the true attitudes imply, in the middle of each interval.
  for (std::size_t i = 0; i + 1 < truth_rows.size(); ++i) {
    const auto attitude = [](const std::vector<double>& row) {
      return Eigen::Quaterniond(row.at(4), row.at(5), row.at(6), row.at(7)).normalized();
    };
    const auto &from = truth_rows[i], &to = truth_rows[i + 1];
    InertialSampled sample;
    sample.angular_velocity =
        quaternion_log(Eigen::Quaterniond(attitude(from).conjugate() * attitude(to))) /
        (to[0] - from[0]);
    truth.push_back({(from[0] + to[0]) / 2.0, sample});
  }
  const ClockCalibration by_gyro = calibrate_clock(imu, poses);
  const ClockCalibration by_truth = calibrate_clock(truth, poses);
  EXPECT_EQ(by_gyro.status, Status::calibrated);
  EXPECT_EQ(by_truth.status, Status::calibrated);
  EXPECT_NEAR(by_gyro.offset, by_truth.offset, 5e-3);
  const double apart = by_gyro.marker_orientation.angularDistance(by_truth.marker_orientation);
  EXPECT_LT(apart, 2.0 * pi / 180.0);
  RecordProperty("offset_by_gyro", std::to_string(by_gyro.offset));
  RecordProperty("offset_by_truth", std::to_string(by_truth.offset));
  RecordProperty("deviation", std::to_string(by_gyro.stddev));
  RecordProperty("marker_degrees", std::to_string(apart * 180.0 / pi));
}

}  // namespace clock_calibration_recorded_test
}  // namespace tilt_ropter
