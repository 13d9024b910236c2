// Identification of a servo and of the clocks, from any logs with any settings.

#include <tilt_ropter/identification/clock_calibration.hpp>
#include <tilt_ropter/identification/servo_identification.hpp>

#include "fuzz/input.hpp"

#include <algorithm>
#include <cmath>

using namespace tilt_ropter;

namespace {

bool is_finite(const ServoModel& m) {
  return std::isfinite(m.time_constant) && std::isfinite(m.dead_time) && std::isfinite(m.gain) &&
         std::isfinite(m.offset) && std::isfinite(m.initial_angle);
}

void identify_any_servo(fuzz::Input& input) {
  ServoIdentificationSettings s;
  if (input.coin()) input.vary_all(s.max_time_constant, s.max_dead_time);
  s.max_iterations = input.integer(0, 100);

  // A servo that follows its command. The input bytes replace some samples.
  ServoLog log;
  const int rows = input.integer(0, 60);
  const double period = input.number(0.05);
  double angle = 0.0, command = 0.0;
  for (int i = 0; i < rows; ++i) {
    if (input.integer(0, 7) == 0) command = input.number(1.0);
    angle += 0.2 * (command - angle);
    log.times.push_back(input.integer(0, 31) == 0 ? input.number(3.0) : std::abs(period) * i);
    log.commands.push_back(command);
    log.angles.push_back(input.integer(0, 31) == 0 ? input.number(1.0) : angle);
  }
  if (input.integer(0, 31) == 0) log.angles.push_back(0.0);

  ServoIdentification found;
  if (!fuzz::accepted([&] { found = identify_servo(log, s); })) return;
  if (found.status != ServoIdentificationStatus::identified) return;
  fuzz::expect(is_finite(found.model) && is_finite(found.half_width),
               "what was identified is finite");
  fuzz::expect(std::isfinite(found.residual_rms) && found.r_squared <= 1.0 + 1e-9,
               "residual and explained share are numbers");
  fuzz::expect(found.model.time_constant >= s.min_time_constant &&
                   found.model.time_constant <= s.max_time_constant &&
                   found.model.dead_time >= 0.0 && found.model.dead_time <= s.max_dead_time,
               "the model is among those looked for");
}

void calibrate_any_clock(fuzz::Input& input) {
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
  if (!fuzz::accepted([&] { found = calibrate_clock(imu, poses, s); })) return;
  if (found.status != ClockCalibrationStatus::calibrated) return;
  fuzz::expect(std::abs(found.offset) <= s.max_offset, "the offset is one that was looked for");
  fuzz::expect(found.stddev >= 0.0 && found.stddev <= s.max_stddev,
               "the offset is as certain as asked");
  fuzz::expect(
      std::isfinite(found.residual) && std::abs(found.marker_orientation.norm() - 1.0) < 1e-6,
      "residual and marker frame are numbers");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  input.coin() ? identify_any_servo(input) : calibrate_any_clock(input);
  return 0;
}
