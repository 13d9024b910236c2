// The state estimator with any samples, poses and time stamps.

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>

#include "fuzz/input.hpp"

#include <cmath>
#include <optional>

using namespace tilt_ropter;

namespace {

EkfSettings any_settings(fuzz::Input& input) {
  EkfSettings s;
  if (input.coin()) s.marker_orientation_stddev = 0.02;
  if (input.coin()) (input.coin() ? s.imu_position_stddev : s.marker_position_stddev) = 0.05;
  if (input.coin()) return s;
  input.vary_all(
      s.imu_noise.gyro_density, s.imu_noise.accelerometer_density, s.imu_noise.gyro_bias_walk,
      s.imu_noise.accelerometer_bias_walk, s.pose_noise.position, s.pose_noise.orientation,
      s.imu_position, s.imu_orientation.coeffs(), s.imu_position_stddev, s.marker_position,
      s.marker_orientation.coeffs(), s.marker_position_stddev, s.marker_orientation_stddev,
      s.clock_offset, s.gyro_bias, s.accelerometer_bias, s.velocity_stddev, s.gyro_bias_stddev,
      s.accelerometer_bias_stddev, s.gate, s.max_rejections, s.restart_time, s.restart_distance,
      s.full_restart_time, s.max_delay, s.max_imu_rate, s.fusion_delay, s.max_imu_gap,
      s.trust.position_error, s.trust.orientation_error, s.trust.lost_position_error,
      s.trust.position_age, s.trust.imu_age);
  return s;
}

void expect_sound(const Ekfd& ekf) {
  const InertialStated& x = ekf.filter().state();
  fuzz::expect(is_finite(ekf.state()) && std::isfinite(ekf.time()) &&
                   std::isfinite(ekf.filter_time()) && std::isfinite(ekf.nis()),
               "state and times are finite");
  fuzz::expect(std::abs(ekf.state().orientation.norm() - 1.0) < 1e-3,
               "the orientation is of unit length");
  fuzz::expect(all_finite(x.gyro_bias) && all_finite(x.accelerometer_bias) &&
                   all_finite(x.marker_position) && all_finite(ekf.imu_position()) &&
                   all_finite(x.marker_orientation.coeffs()),
               "biases and marker frame are finite");
  fuzz::expect(all_finite(ekf.filter().covariance()), "the covariance is finite");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  const EkfSettings settings = any_settings(input);
  std::optional<Ekfd> ekf;
  if (!fuzz::accepted([&] { ekf.emplace(settings); })) return 0;
  double time = 0.0;
  for (int tick = 0; tick < 200 && !input.empty(); ++tick) {
    time += 0.01;
    const int kind = input.integer(0, 15);
    const double stamp = kind == 0 ? input.number(10.0) : time + (kind == 1 ? -0.03 : 0.0);
    if (kind < 12) {
      const InertialSampled sample{input.vector(10.0), input.vector(30.0)};
      const EkfStatus status = ekf->on_imu(stamp, sample);
      fuzz::expect(status == EkfStatus::rejected ||
                       (std::isfinite(stamp) && all_finite(sample.specific_force)),
                   "what is not finite is rejected");
    } else if (kind == 12) {
      FlowMeasurement<double> flow;
      flow.flow = input.vector(2.0).head<2>();
      flow.camera = input.vector(1.0);
      ekf->on_measurement(stamp, flow);
      WheelSpeedMeasurement<double> wheel;
      wheel.speed = input.number(10.0);
      wheel.ground_normal = input.vector(1.0);
      ekf->on_measurement(stamp, wheel);
      const Eigen::Vector3d place = input.vector(2.0);
      ekf->on_measurement(stamp, PositionMeasurement<double>{place, Eigen::Matrix3d::Identity(),
                                                             input.vector(1.0)});
      PoseMeasurement<double> pose;
      pose.position = place + input.vector(1.0);
      pose.orientation = input.orientation();
      pose.sensor = input.vector(1.0);
      ekf->on_measurement(stamp, pose);
      fuzz::expect(!std::isnan(ekf->trust(stamp).position_stddev), "the trust is a number");
    } else {
      const Eigen::Vector3d position = input.vector(2.0);
      const EkfStatus status = ekf->on_pose(stamp, {position, input.orientation()});
      fuzz::expect(status == EkfStatus::rejected || all_finite(position),
                   "what is not finite is rejected");
    }
    expect_sound(*ekf);
  }
  return 0;
}
