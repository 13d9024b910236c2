// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/identification/clock_calibration.hpp>
#include <tilt_ropter/identification/detail/log_smoother.hpp>
#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

/// Clock offset, marker frame and biases from a whole log.
namespace tilt_ropter {

/// Settings of calibrate_log().
struct LogCalibrationSettings {
  /// Noise of IMU and poses. Only their ratios matter, because the residuals show their size. A
  /// walk of zero is a constant bias.
  InertialNoise imu_noise;
  MarkerPoseNoise pose_noise;
  /// The first guess of clock offset and marker orientation.
  ClockCalibrationSettings clock;
  /// Standard deviation of the direction of gravity from -z of motion capture's world, per axis
  /// [rad]. Zero: the world is level, as the filter assumes.
  double gravity_stddev = 0.0;
  static constexpr double gyro_bias_stddev = 0.2;           ///< before the flight, of zero [rad/s]
  static constexpr double accelerometer_bias_stddev = 1.0;  ///< before the flight, of zero [m/s^2]

  /// A calibration with a larger standard deviation is refused.
  double max_marker_position_stddev = 0.01;     ///< [m]
  double max_marker_orientation_stddev = 0.01;  ///< [rad]
  double max_gyro_bias_stddev = 0.01;           ///< [rad/s]
  double max_accelerometer_bias_stddev = 0.1;   ///< [m/s^2]

  static constexpr double max_imu_gap = 0.05;  ///< longest pause between IMU samples [s]
  int max_iterations = 40;                     ///< of Gauss-Newton
};

inline void validate(const LogCalibrationSettings& s) {
  validate(s.imu_noise);
  require_positive("LogCalibrationSettings.imu_noise.gyro_density", s.imu_noise.gyro_density);
  require_positive("LogCalibrationSettings.imu_noise.accelerometer_density",
                   s.imu_noise.accelerometer_density);
  validate(s.pose_noise);
  validate(s.clock);
  require_in("LogCalibrationSettings.gravity_stddev [rad]", s.gravity_stddev, 0.0, 1.0);
  require_positive("LogCalibrationSettings.max_marker_position_stddev [m]",
                   s.max_marker_position_stddev);
  require_positive("LogCalibrationSettings.max_marker_orientation_stddev [rad]",
                   s.max_marker_orientation_stddev);
  require_positive("LogCalibrationSettings.max_gyro_bias_stddev [rad/s]", s.max_gyro_bias_stddev);
  require_positive("LogCalibrationSettings.max_accelerometer_bias_stddev [m/s^2]",
                   s.max_accelerometer_bias_stddev);
  require(s.max_iterations >= 1, "LogCalibrationSettings.max_iterations", s.max_iterations,
          "at least 1");
}

/// Whether the calibration succeeded and, if not, the reason.
enum class LogCalibrationStatus {
  calibrated,
  bad_data,       ///< as in ClockCalibrationStatus
  imu_gap,        ///< the IMU pauses during the poses for longer than max_imu_gap
  no_clock,       ///< calibrate_clock() refuses the log: see LogCalibration.clock
  not_converged,  ///< the iterations did not converge
  uncertain       ///< the motion does not show an unknown: see LogCalibration.uncertain
};

[[nodiscard]] constexpr const char* to_string(LogCalibrationStatus status) noexcept {
  return detail::name_in(
      {"calibrated", "bad_data", "imu_gap", "no_clock", "not_converged", "uncertain"}, status);
}

/// Result of calibrate_log(). Fields that end in _95 are half widths of 95 % intervals. The values
/// are valid only if the status is calibrated.
struct LogCalibration {
  LogCalibrationStatus status = LogCalibrationStatus::bad_data;
  ClockCalibrationStatus clock = ClockCalibrationStatus::bad_data;
  std::string uncertain;  ///< names of the fields whose standard deviation is too large

  double clock_offset = 0.0;  ///< as EkfSettings.clock_offset [s]
  double clock_offset_95 = 0.0;
  Eigen::Vector3d marker_position = Eigen::Vector3d::Zero();  ///< origin of M, body frame [m]
  Eigen::Vector3d marker_position_95 = Eigen::Vector3d::Zero();
  Eigen::Quaterniond marker_orientation = Eigen::Quaterniond::Identity();  ///< M -> body
  Eigen::Vector3d marker_orientation_95 = Eigen::Vector3d::Zero();         ///< in M [rad]
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();  ///< at the last pose [rad/s]
  Eigen::Vector3d gyro_bias_95 = Eigen::Vector3d::Zero();
  Eigen::Vector3d accelerometer_bias = Eigen::Vector3d::Zero();  ///< at the last pose [m/s^2]
  Eigen::Vector3d accelerometer_bias_95 = Eigen::Vector3d::Zero();
  /// Horizontal part of the direction of gravity, x and y of motion capture's world [rad].
  Eigen::Vector2d gravity_tilt = Eigen::Vector2d::Zero();
  Eigen::Vector2d gravity_tilt_95 = Eigen::Vector2d::Zero();

  double position_residual = 0.0;     ///< root mean square per axis, without outliers [m]
  double orientation_residual = 0.0;  ///< root mean square per axis, without outliers [rad]
  /// Errors that the log shows / those that the assumed noise explains. Contained in the intervals.
  double error_scale = 1.0;
  int poses = 0, outliers = 0;  ///< poses used, and those of them with reduced weight
  int iterations = 0;
  std::vector<Timed<InertialStated>> trajectory;  ///< smoothed, at IMU samples
};

namespace detail {

/// Trajectory of the filter, with the marker frame that it found at the end.
template <typename Scalar>
[[nodiscard]] bool start_smoother(LogSmoother<Scalar>& smoother,
                                  const std::vector<Timed<InertialSample<Scalar>>>& imu,
                                  const std::vector<Timed<MarkerPose<Scalar>>>& poses,
                                  const EkfSettings& settings) {
  Ekf<Scalar> ekf(settings);
  std::size_t next = 0;
  while (next < poses.size() && poses[next].time + settings.clock_offset < imu.front().time) ++next;
  for (std::size_t j = 0; j + 1 < imu.size() && next < poses.size(); ++j) {
    (void)ekf.on_imu(imu[j].time, imu[j].value);
    const std::size_t first = next;
    for (; next < poses.size() && poses[next].time + settings.clock_offset < imu[j + 1].time;
         ++next)
      (void)ekf.on_pose(poses[next].time, poses[next].value);
    if (ekf.counts().used == 0 || (next == first && !smoother.nodes.empty())) continue;
    typename LogSmoother<Scalar>::Node node;
    node.sample = j;
    node.first_pose = first;
    node.last_pose = next;
    node.state = ekf.filter().state();
    const BodyState<Scalar> body = ekf.state();
    node.state.position = body.position;
    node.state.velocity = body.velocity;
    node.state.orientation = body.orientation;
    smoother.nodes.push_back(node);
  }
  if (smoother.nodes.size() < 2) return false;
  const InertialState<Scalar> last = ekf.filter().state();
  smoother.constants.marker_orientation = last.marker_orientation;
  smoother.constants.marker_position = last.marker_position;
  smoother.constants.clock_offset = settings.clock_offset;
  for (typename LogSmoother<Scalar>::Node& node : smoother.nodes) {
    InertialState<Scalar>& x = node.state;
    const Vector3<Scalar> marker = x.position + x.orientation * x.marker_position;
    x.orientation =
        (x.orientation * x.marker_orientation * last.marker_orientation.conjugate()).normalized();
    x.position = marker - x.orientation * last.marker_position;
  }
  return true;
}

/// Weights of poses from their residuals: 1 up to a limit, then falling so fast that a pose far
/// away has no influence. Returns the number of reduced weights.
template <typename Scalar>
int set_weights(LogSmoother<Scalar>& smoother) {
  constexpr double median_3 = 2.366, limit_3 = 16.27;  // of chi-square; one in 1000 exceeds 16.27
  const auto distances = [&](int part, double stddev) {
    std::vector<double> squares;
    for (const typename LogSmoother<Scalar>::Node& node : smoother.nodes)
      for (std::size_t i = node.first_pose; i < node.last_pose; ++i)
        squares.push_back(smoother.residuals[i].template segment<3>(part).squaredNorm() /
                          (stddev * stddev));
    std::vector<double> sorted = squares;
    const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
    std::nth_element(sorted.begin(), middle, sorted.end());
    const double scale = std::max(1.0, *middle / median_3);
    for (double& square : squares) square /= scale;
    return squares;
  };
  const std::vector<double> by_position = distances(0, smoother.pose_noise.position),
                            by_orientation = distances(3, smoother.pose_noise.orientation);
  int reduced = 0;
  std::size_t n = 0;
  for (const typename LogSmoother<Scalar>::Node& node : smoother.nodes)
    for (std::size_t i = node.first_pose; i < node.last_pose; ++i, ++n) {
      const double excess = std::max(by_position[n], by_orientation[n]) / limit_3;
      smoother.weights[i] = excess > 1.0 ? 1.0 / (excess * excess) : 1.0;
      reduced += excess > 1.0 ? 1 : 0;
    }
  return reduced;
}

/// Compares the formal standard deviations of constants with those of a jackknife: the constants
/// are found again without one tenth of the log, for each tenth. This contains errors that last for
/// seconds, such as those of a badly seen marker, which the assumed white noise does not. The ratio
/// is pooled over the seven constants, because for each alone ten parts would be few.
template <typename Scalar>
[[nodiscard]] double error_scale(LogSmoother<Scalar>& smoother) {
  constexpr std::size_t parts = 10;
  using Index = SmootherIndex;
  constexpr int constants = Index::size - Index::marker_orientation;
  using Constants = Eigen::Matrix<Scalar, constants, 1>;
  const Eigen::Matrix<Scalar, constants, constants> formal =
      smoother.covariance().template bottomRightCorner<constants, constants>();
  const std::size_t first = smoother.nodes.front().first_pose,
                    count = smoother.nodes.back().last_pose - first;
  std::array<Constants, parts> found;
  Constants mean = Constants::Zero();
  for (std::size_t part = 0; part < parts; ++part) {
    found[part] =
        smoother.change_without(first + part * count / parts, first + (part + 1) * count / parts)
            .template tail<constants>();
    mean += found[part] / static_cast<double>(parts);
  }
  double square = 0.0;
  for (const Constants& f : found)
    for (int i = 0; i < constants; ++i)
      square += std::pow(f(i) - mean(i), 2) / formal(i, i) / constants;
  return std::sqrt(square * (parts - 1) / parts);
}

/// Standard deviations of the unknowns before the log; large for what the settings do not contain.
template <typename Scalar>
[[nodiscard]] typename LogSmoother<Scalar>::Vector prior_stddev(
    const LogCalibrationSettings& settings) {
  using Index = SmootherIndex;
  typename LogSmoother<Scalar>::Vector prior = LogSmoother<Scalar>::Vector::Zero();
  prior.template segment<3>(Index::position).setConstant(10.0);
  prior.template segment<3>(Index::velocity).setConstant(30.0);
  prior.template segment<3>(Index::orientation).setConstant(3.0);
  prior.template segment<3>(Index::gyro_bias).setConstant(settings.gyro_bias_stddev);
  prior.template segment<3>(Index::accelerometer_bias)
      .setConstant(settings.accelerometer_bias_stddev);
  prior.template segment<2>(Index::gravity).setConstant(gravity * settings.gravity_stddev);
  prior.template segment<3>(Index::marker_orientation).setConstant(3.0);
  prior.template segment<3>(Index::marker_position).setConstant(10.0);
  prior(Index::clock) = 1.0;
  return prior;
}

/// Sets values, intervals and status from the solution.
template <typename Scalar>
void report(LogSmoother<Scalar>& smoother, const std::vector<Timed<InertialSample<Scalar>>>& imu,
            const LogCalibrationSettings& settings, LogCalibration& result) {
  using Index = SmootherIndex;
  const LogConstants<Scalar>& c = smoother.constants;
  const InertialState<Scalar>& last = smoother.nodes.back().state;
  const typename LogSmoother<Scalar>::Vector stddev =
      smoother.covariance().diagonal().cwiseMax(0.0).cwiseSqrt();
  result.error_scale = error_scale(smoother);
  const typename LogSmoother<Scalar>::Vector half_width = 1.96 * result.error_scale * stddev;
  result.clock_offset = c.clock_offset;
  result.clock_offset_95 = half_width(Index::clock);
  result.marker_position = c.marker_position;
  result.marker_position_95 = half_width.template segment<3>(Index::marker_position);
  result.marker_orientation = c.marker_orientation;
  result.marker_orientation_95 = half_width.template segment<3>(Index::marker_orientation);
  result.gyro_bias = last.gyro_bias;
  result.gyro_bias_95 = half_width.template segment<3>(Index::gyro_bias);
  result.accelerometer_bias = last.accelerometer_bias;
  result.accelerometer_bias_95 = half_width.template segment<3>(Index::accelerometer_bias);
  result.gravity_tilt = c.gravity / gravity;
  result.gravity_tilt_95 = half_width.template segment<2>(Index::gravity) / gravity;
  double positions = 0.0, orientations = 0.0;
  int used = 0;
  for (const typename LogSmoother<Scalar>::Node& node : smoother.nodes) {
    result.trajectory.push_back({imu[node.sample].time, node.state});
    for (std::size_t i = node.first_pose; i < node.last_pose; ++i) {
      ++result.poses;
      if (smoother.weights[i] < 1.0) continue;
      positions += smoother.residuals[i].template head<3>().squaredNorm() / 3.0;
      orientations += smoother.residuals[i].template tail<3>().squaredNorm() / 3.0;
      ++used;
    }
  }
  result.position_residual = std::sqrt(positions / used);
  result.orientation_residual = std::sqrt(orientations / used);
  const auto check = [&](const char* name, double widest, double limit) {
    if (!(widest <= 1.96 * limit))
      result.uncertain += (result.uncertain.empty() ? "" : " ") + std::string(name);
  };
  check("clock_offset", result.clock_offset_95, settings.clock.max_stddev);
  check("marker_position", result.marker_position_95.maxCoeff(),
        settings.max_marker_position_stddev);
  check("marker_orientation", result.marker_orientation_95.maxCoeff(),
        settings.max_marker_orientation_stddev);
  check("gyro_bias", result.gyro_bias_95.maxCoeff(), settings.max_gyro_bias_stddev);
  check("accelerometer_bias", result.accelerometer_bias_95.maxCoeff(),
        settings.max_accelerometer_bias_stddev);
  result.status =
      result.uncertain.empty() ? LogCalibrationStatus::calibrated : LogCalibrationStatus::uncertain;
}

}  // namespace detail

/// Finds the clock offset of motion capture, its marker frame, the biases and the trajectory by one
/// least-squares problem over the whole log: IMU noise, walk of the biases and residuals of the
/// poses, weighted by their assumed noise. Poses with large residuals get weights near zero.
/// calibrate_clock() and Ekf give the first guess, so none is needed.
///
/// Both logs must be in the order of their stamps. Needs ten seconds or more of rotation about all
/// axes, and `clock.max_offset` of IMU samples before and after the poses used. Where the motion
/// does not show an unknown the result has a status that says so. Throws std::invalid_argument if a
/// setting is out of range. Allocates about 8 kB per pose. Takes some milliseconds per second of
/// log, so do not call it in the control loop. Scalar is double; it is a template parameter so that
/// only code that calls the function compiles it.
template <typename Scalar = double>
[[nodiscard]] LogCalibration calibrate_log(const std::vector<Timed<InertialSample<Scalar>>>& imu,
                                           const std::vector<Timed<MarkerPose<Scalar>>>& poses,
                                           const LogCalibrationSettings& settings = {}) {
  using Index = detail::SmootherIndex;
  validate(settings);
  LogCalibration result;
  const bool finite =
      std::all_of(imu.begin(), imu.end(),
                  [](const auto& s) { return all_finite(s.value.specific_force); }) &&
      std::all_of(poses.begin(), poses.end(),
                  [](const auto& p) { return all_finite(p.value.position); });
  const ClockCalibration clock = calibrate_clock(imu, poses, settings.clock);
  result.clock = clock.status;
  if (!finite || clock.status == ClockCalibrationStatus::bad_data) return result;
  result.status = LogCalibrationStatus::no_clock;
  if (clock.status != ClockCalibrationStatus::calibrated) return result;

  EkfSettings ekf;
  ekf.clock_offset = clock.offset;
  ekf.marker_orientation = clock.marker_orientation;
  ekf.marker_orientation_stddev = 0.1;
  ekf.marker_position_stddev = 1.0;
  ekf.max_delay = 0.5;
  detail::LogSmoother<Scalar> smoother(imu, poses, detail::prior_stddev<Scalar>(settings));
  smoother.imu_noise = settings.imu_noise;
  smoother.pose_noise = settings.pose_noise;
  result.status = LogCalibrationStatus::not_converged;
  if (!detail::start_smoother(smoother, imu, poses, ekf)) return result;
  result.status = LogCalibrationStatus::imu_gap;
  for (std::size_t j = smoother.nodes.front().sample; j <= smoother.nodes.back().sample; ++j)
    if (imu[j + 1].time - imu[j].time > settings.max_imu_gap) return result;

  result.status = LogCalibrationStatus::not_converged;
  smoother.find_residuals();
  bool converged = false;
  while (!converged && result.iterations < settings.max_iterations) {
    result.outliers = detail::set_weights(smoother);
    const typename detail::LogSmoother<Scalar>::Vector step = smoother.iterate();
    ++result.iterations;
    if (!all_finite(step)) return result;
    smoother.find_residuals();
    const auto variances = smoother.covariance().diagonal();
    converged = true;
    for (int i = Index::gyro_bias; i < Index::size; ++i)
      converged = converged && std::abs(step(i)) <= 0.02 * std::sqrt(variances(i));
  }
  if (!converged) return result;

  detail::report(smoother, imu, settings, result);
  return result;
}

}  // namespace tilt_ropter
