// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/SVD>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <type_traits>
#include <utility>
#include <vector>

/// Calibration of the offset between the clocks of the IMU and motion capture, from a part of a
/// flight. Both measure the rotation of the vehicle, and their rotations agree at one offset only.
namespace tilt_ropter {

/// Search range and acceptance limits of calibrate_clock().
struct ClockCalibrationSettings {
  double max_offset = 0.5;  ///< offsets from -max_offset to max_offset are searched, at most 60 [s]
  double window = 0.05;     ///< rotations are compared over this time, at least 0.001 [s]
  double max_stddev = 2e-3;  ///< an offset with a larger standard deviation is refused [s]
};

inline void validate(const ClockCalibrationSettings& s) {
  require(s.max_offset > 0.0 && s.max_offset <= 60.0, "ClockCalibrationSettings.max_offset [s]",
          s.max_offset, "in (0, 60]");
  require(std::isfinite(s.window) && s.window >= 1e-3, "ClockCalibrationSettings.window [s]",
          s.window, "finite and >= 0.001");
  require_positive("ClockCalibrationSettings.max_stddev [s]", s.max_stddev);
}

/// Whether the offset was found and, if not, the reason. If several reasons apply, the status is
/// the first of them in this order.
enum class ClockCalibrationStatus {
  calibrated,
  bad_data,      ///< a number is not finite, a quaternion is not unit, or stamps do not increase
  too_short,     ///< fewer than 100 rotations to compare
  out_of_range,  ///< the best offset lies at an end of the search range
  uncertain,     ///< too little rotation, or rotation about one axis only
  ambiguous      ///< the motion repeats itself: another offset fits as well
};

[[nodiscard]] constexpr const char* to_string(ClockCalibrationStatus status) noexcept {
  return detail::name_in(
      {"calibrated", "bad_data", "too_short", "out_of_range", "uncertain", "ambiguous"}, status);
}

/// Result of calibrate_clock(). The offset is valid only if the status is calibrated.
struct ClockCalibration {
  ClockCalibrationStatus status = ClockCalibrationStatus::bad_data;
  double offset = 0.0;  ///< to add to the stamps of the poses (EkfSettings.clock_offset) [s]
  double stddev = std::numeric_limits<double>::infinity();                 ///< of the offset [s]
  Eigen::Quaterniond marker_orientation = Eigen::Quaterniond::Identity();  ///< M -> body
  double residual = 0.0;  ///< root mean square over rotations and axes [rad]
};

namespace detail {

/// Rotations of the IMU from the start of a log to times within the log.
template <typename Scalar>
class GyroIntegral {
 public:
  explicit GyroIntegral(const std::vector<Timed<InertialSample<Scalar>>>& imu) : imu_(imu) {
    turned_.reserve(imu.size());
    turned_.push_back(Eigen::Quaterniond::Identity());
    for (std::size_t i = 0; i + 1 < imu.size(); ++i)
      turned_.push_back((turned_[i] * part(i, imu[i + 1].time)).normalized());
  }

  [[nodiscard]] bool covers(double time) const {
    return time >= imu_.front().time && time < imu_.back().time;
  }

  /// The rotations until `times` + `offset`, where the times increase. The identity outside the
  /// log.
  [[nodiscard]] std::vector<Eigen::Quaterniond> at(const std::vector<double>& times,
                                                   double offset) const {
    std::vector<Eigen::Quaterniond> result(times.size(), Eigen::Quaterniond::Identity());
    std::size_t i = 0;
    for (std::size_t k = 0; k < times.size(); ++k) {
      const double time = times[k] + offset;
      if (!covers(time)) continue;
      while (imu_[i + 1].time <= time) ++i;
      result[k] = turned_[i] * part(i, time);
    }
    return result;
  }

 private:
  /// Rotation from sample i to `time`, before the next sample. The rate is linear in between.
  [[nodiscard]] Eigen::Quaterniond part(std::size_t i, double time) const {
    const double duration = time - imu_[i].time;
    const double fraction = duration / (imu_[i + 1].time - imu_[i].time);
    const Eigen::Vector3d from = imu_[i].value.angular_velocity.template cast<double>();
    const Eigen::Vector3d to = imu_[i + 1].value.angular_velocity.template cast<double>();
    return quaternion_exp(duration * (from + fraction / 2.0 * (to - from)));
  }

  const std::vector<Timed<InertialSample<Scalar>>>& imu_;
  std::vector<Eigen::Quaterniond> turned_;
};

/// Rotation of the marker frame between two poses.
struct MarkerTurn {
  std::size_t start, end;  ///< numbers of the poses
  Eigen::Vector3d turn;    ///< rotation vector in M [rad]
};

/// Best rotation M -> body and best constant difference (the gyro's bias) between rotations of the
/// marker and of the IMU. Fitted at one clock offset (Kabsch 1976).
struct TurnFit {
  double cost = std::numeric_limits<double>::infinity();  ///< mean square of the residuals [rad^2]
  double second_largest = 0.0;  ///< second largest singular value of the correlation [rad^2]
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
  std::vector<double> squares;  ///< squared residual of each rotation [rad^2]
};

/// Fits the rotation from `marker` to `body`. Both hold one rotation vector per column.
template <typename Turns>
TurnFit fit_rotation(Turns body, Turns marker) {
  body.colwise() -= body.rowwise().mean().eval();
  marker.colwise() -= marker.rowwise().mean().eval();
  const auto correlation = (body * marker.transpose() / static_cast<double>(body.cols())).eval();
  const Eigen::JacobiSVD<std::decay_t<decltype(correlation)>, Eigen::NoQRPreconditioner> svd(
      correlation, Eigen::ComputeFullU | Eigen::ComputeFullV);
  Eigen::Vector3d sign = Eigen::Vector3d::Ones();
  sign.z() = (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0.0 ? -1.0 : 1.0;
  TurnFit fit;
  fit.rotation = svd.matrixU() * sign.asDiagonal() * svd.matrixV().transpose();
  fit.second_largest = svd.singularValues()(1);
  const Eigen::RowVectorXd squares = (body - fit.rotation * marker).colwise().squaredNorm();
  fit.cost = squares.mean();
  fit.squares.assign(squares.data(), squares.data() + squares.size());
  return fit;
}

/// Rotation vector of the IMU during a turn of the marker. `turned`: GyroIntegral::at() of the
/// poses
inline Eigen::Vector3d turn_in(const std::vector<Eigen::Quaterniond>& turned, const MarkerTurn& t) {
  return quaternion_log(Eigen::Quaterniond(turned[t.start].conjugate() * turned[t.end]));
}

/// `times`: of the poses, in motion capture's clock
template <typename Scalar>
TurnFit fit_turns(const std::vector<MarkerTurn>& turns, const std::vector<double>& times,
                  const GyroIntegral<Scalar>& gyro, double offset) {
  const std::vector<Eigen::Quaterniond> turned = gyro.at(times, offset);
  const auto count = static_cast<Eigen::Index>(turns.size());
  Eigen::Matrix3Xd body(3, count), marker(3, count);
  for (Eigen::Index i = 0; i < count; ++i) {
    const MarkerTurn& t = turns[static_cast<std::size_t>(i)];
    body.col(i) = turn_in(turned, t);
    marker.col(i) = t.turn;
  }
  return fit_rotation(std::move(body), std::move(marker));
}

/// Returns true if the gyro's rotations during the `turns` (poses at this clock offset) repeat
/// themselves after a time of up to `range` [s], so well that the difference is comparable with the
/// `cost` of the calibration. Then another offset, searched or not, fits as well.
template <typename Scalar>
bool repeats(const std::vector<MarkerTurn>& turns, const std::vector<double>& times,
             const GyroIntegral<Scalar>& gyro, double offset, double range, double step,
             double cost) {
  constexpr double comparable = 4.0;  // twice the residual
  const std::vector<Eigen::Quaterniond> before = gyro.at(times, offset);
  const auto difference = [&](double shift) {
    const std::vector<Eigen::Quaterniond> after = gyro.at(times, offset + shift);
    double sum = 0.0;
    int count = 0;
    for (const MarkerTurn& t : turns) {
      if (!gyro.covers(times[t.start] + offset) || !gyro.covers(times[t.end] + offset + shift))
        continue;
      sum += (turn_in(before, t) - turn_in(after, t)).squaredNorm();
      ++count;
    }
    return count < 100 ? std::numeric_limits<double>::infinity() : sum / count;
  };
  double largest = 0.0;  // the difference grows from zero before it can fall again
  for (double shift = step; shift <= range; shift += step) {
    const double now = difference(shift);
    if (now > 2.0 * comparable * cost && std::isfinite(now)) largest = std::max(largest, now);
    if (largest > 0.0 && now < std::max(comparable * cost, 0.01 * largest)) return true;
  }
  return false;
}

}  // namespace detail

/// Finds the offset between the two clocks. Compares the rotation of the marker frame between poses
/// one `window` apart with the rotation integrated from the gyro, at every offset. The constant
/// rotation of the marker frame and the gyro's bias are fitted at each offset.
///
/// Both logs must be in the order of their stamps. Poses may have outliers and gaps. Needs a few
/// seconds of rotation about two axes or more, and `max_offset` of IMU samples before and after the
/// poses used. Refuses motion that repeats itself within twice max_offset. Logs of float are read
/// as double. Throws std::invalid_argument if a setting is out of range. Allocates, so do not call
/// it in the control loop.
template <typename Scalar = double>
[[nodiscard]] ClockCalibration calibrate_clock(
    const std::vector<Timed<InertialSample<Scalar>>>& imu,
    const std::vector<Timed<MarkerPose<Scalar>>>& poses,
    const ClockCalibrationSettings& settings = {}) {
  validate(settings);
  ClockCalibration result;
  const auto orientation = [](const auto& pose) {
    return Eigen::Quaterniond(pose.value.orientation.template cast<double>());
  };
  const auto is_unit = [](const auto& pose) {
    return std::abs(pose.orientation.template cast<double>().norm() - 1.0) < 0.1;
  };
  if (!detail::is_good_list(imu, [](const auto& s) { return all_finite(s.angular_velocity); }) ||
      !detail::is_good_list(poses, is_unit))
    return result;
  result.status = ClockCalibrationStatus::too_short;
  if (imu.size() < 2) return result;

  const double coarse = std::min(5e-3, settings.window / 4.0);
  const auto steps = static_cast<int>(std::ceil(settings.max_offset / coarse));
  const double reach = settings.max_offset + 2.0 * coarse;  // the last steps may exceed the range
  const detail::GyroIntegral<Scalar> gyro(imu);
  std::vector<detail::MarkerTurn> turns;
  std::vector<double> times(poses.size());
  std::transform(poses.begin(), poses.end(), times.begin(), [](const auto& p) { return p.time; });
  double total = 0.0;
  for (std::size_t i = 0, j = 0; i < poses.size(); ++i) {
    const double start = times[i];
    while (j < poses.size() && times[j] < start + settings.window) ++j;
    if (j == poses.size()) break;
    const double end = times[j];
    if (end > start + 2.0 * settings.window || !gyro.covers(start - reach) ||
        !gyro.covers(end + reach))
      continue;
    turns.push_back(
        {i, j,
         quaternion_log((orientation(poses[i]).conjugate() * orientation(poses[j])).normalized())});
    total += end - start;
  }
  if (turns.size() < 100) return result;
  const double overlap =
      std::max(1.0, total / (times[turns.back().end] - times[turns.front().start]));

  // Coarse search over the whole range. Wrong poses would disturb the fit. Rotations with a
  // residual above five times the median are dropped. The search is then repeated, because these
  // rotations may have misled it.
  double offset = 0.0;
  int best = 0;
  for (int round = 0; round < 3; ++round) {
    double lowest = std::numeric_limits<double>::infinity();
    for (int i = -steps; i <= steps; ++i) {
      const double tried = std::clamp(coarse * i, -settings.max_offset, settings.max_offset);
      const double cost = detail::fit_turns(turns, times, gyro, tried).cost;
      if (cost < lowest) {
        lowest = cost;
        offset = tried;
        best = i;
      }
    }
    const std::vector<double> squares = detail::fit_turns(turns, times, gyro, offset).squares;
    std::vector<double> sorted = squares;
    const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
    std::nth_element(sorted.begin(), middle, sorted.end());
    std::vector<detail::MarkerTurn> kept;
    for (std::size_t i = 0; i < turns.size(); ++i)
      if (squares[i] <= 25.0 * *middle) kept.push_back(turns[i]);
    const bool settled = kept.size() == turns.size();
    turns = std::move(kept);
    if (settled) break;
  }
  result.status = ClockCalibrationStatus::out_of_range;
  if (std::abs(best) == steps) return result;

  // Fine search with parabolas through neighbours at decreasing distance.
  double curvature = 0.0;
  for (double step = coarse; step > 1e-4; step /= 4.0) {
    const double before = detail::fit_turns(turns, times, gyro, offset - step).cost;
    const double here = detail::fit_turns(turns, times, gyro, offset).cost;
    const double after = detail::fit_turns(turns, times, gyro, offset + step).cost;
    curvature = (before - 2.0 * here + after) / (step * step);
    if (!(curvature > 0.0)) break;
    offset += std::clamp((before - after) / (2.0 * step * curvature), -step, step);
  }
  if (std::abs(offset) > settings.max_offset) return result;
  const detail::TurnFit fit = detail::fit_turns(turns, times, gyro, offset);
  result.offset = offset;
  const double count = static_cast<double>(turns.size());
  result.marker_orientation = Eigen::Quaterniond(fit.rotation);
  result.residual = std::sqrt(fit.cost / 3.0);
  if (curvature > 0.0)
    result.stddev = std::sqrt(2.0 * overlap * fit.cost / ((3.0 * count - 7.0) * curvature));
  const bool two_axes = fit.second_largest > 10.0 * fit.cost / std::sqrt(count);
  if (!two_axes || !(result.stddev <= settings.max_stddev))
    result.status = ClockCalibrationStatus::uncertain;
  else
    result.status =
        detail::repeats(turns, times, gyro, offset, 2.0 * settings.max_offset, coarse, fit.cost)
            ? ClockCalibrationStatus::ambiguous
            : ClockCalibrationStatus::calibrated;
  return result;
}

}  // namespace tilt_ropter
