// Calibration of the clocks from any logs with any settings.

#include <tilt_ropter/identification/clock_calibration.hpp>

#include "fuzz/input.hpp"

#include <cmath>

using namespace tilt_ropter;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  ClockCalibrationSettings s;
  s.max_offset = 0.05;
  s.window = 0.02;
  if (input.coin()) input.vary_all(s.max_offset, s.window, s.max_stddev);

  // A vehicle that turns back and forth. The input bytes replace some samples.
  const double rate = input.number(3.0), shift = input.uniform(-0.1, 0.1);
  const int samples = input.integer(0, 300);
  std::vector<Timed<InertialSampled>> imu;
  std::vector<Timed<MarkerPosed>> poses;
  Eigen::Quaterniond turned = Eigen::Quaterniond::Identity();
  for (int i = 0; i < samples; ++i) {
    const double time = 0.005 * i;
    const Eigen::Vector3d velocity =
        rate * Eigen::Vector3d(std::sin(5.0 * time), std::cos(7.0 * time), 0.0);
    turned = (turned * quaternion_exp(Eigen::Vector3d(0.005 * velocity))).normalized();
    const bool wild = input.integer(0, 63) == 0;
    imu.push_back({wild ? input.number(2.0) : time,
                   {wild ? input.vector(5.0) : velocity, Eigen::Vector3d::Zero()}});
    poses.push_back({wild ? input.number(2.0) : time + shift,
                     {Eigen::Vector3d::Zero(), wild ? input.orientation() : turned}});
  }
  ClockCalibration found;
  if (!fuzz::accepted([&] { found = calibrate_clock(imu, poses, s); })) return 0;
  if (found.status != ClockCalibrationStatus::calibrated) return 0;
  fuzz::expect(std::abs(found.offset) <= s.max_offset, "the offset is one that was looked for");
  fuzz::expect(found.stddev >= 0.0 && found.stddev <= s.max_stddev,
               "the offset is as certain as asked");
  fuzz::expect(
      std::isfinite(found.residual) && std::abs(found.marker_orientation.norm() - 1.0) < 1e-6,
      "residual and marker frame are numbers");
  return 0;
}
