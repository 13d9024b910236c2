// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/measurement_faults.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

/// Witnesses besides poses, for MeasurementGuard. Nothing here throws or allocates.
namespace tilt_ropter::detail {

/// Finds errors of a heading sensor that last, such as those of a compass that turns away from its
/// calibration. White noise has innovations with mean zero. The gyroscope, and positions in motion,
/// then count more.
class HeadingNoise {
 public:
  /// Processes an innovation by its standard deviation if the noise is white.
  void add(double innovation) noexcept {
    constexpr double memory = 30.0, largest = 6.0;
    mean_ += (std::clamp(innovation, -largest, largest) - mean_) / memory;
  }
  /// By which the variance of the noise is larger than believed.
  [[nodiscard]] double factor() const noexcept {
    constexpr double chance = 0.5;  // some four standard deviations of the mean
    const double excess = std::max(0.0, std::abs(mean_) / chance - 1.0);
    return 1.0 + 100.0 * excess * excess;
  }
  /// True if the heading contradicts the other sensors.
  [[nodiscard]] bool contradicts() const noexcept { return factor() > 10.0; }

 private:
  double mean_ = 0.0;
};

/// Decides whether the positions and velocities of a receiver show that the IMU is wrong: both
/// contradict it, more and more but without a step, and they agree with each other. One alone may
/// drift or stand still. Positions alone need the heading as the second witness.
template <typename Scalar>
class FixWitness {
 public:
  /// Processes a position or velocity that is used. `speed`: of the estimate [m/s].
  void on_used(bool is_position, double time, const PoseComparison<Scalar>& c,
               double speed) noexcept {
    Series& s = series_[is_position];
    listen(is_position, time, c);
    if (is_position) {
      place_ = c.measured.position;
      travelled_.setZero();
    }
    s.time = s.used = time;
    s.residual = c.measured.position - c.predicted.position;
    constexpr double memory = 5.0, long_memory = 30.0;  // measurements
    s.mean += (s.residual - s.mean) / Scalar(memory);
    s.agrees = static_cast<double>(s.mean.norm()) <= 1.5 * c.noise;
    s.gated = 0;
    s.has_stepped = false;
    speed_ += (speed - speed_) / long_memory;
  }
  /// Processes one that is above the gate.
  void on_gated(bool is_position, double time, const PoseComparison<Scalar>& c) noexcept {
    Series& s = series_[is_position];
    listen(is_position, time, c);
    constexpr double acceleration = 6.0;  // error by a wrong IMU [m/s^2]
    const Vector3<Scalar> residual = c.measured.position - c.predicted.position;
    const auto size = static_cast<double>(residual.norm()),
               step = static_cast<double>((residual - s.residual).norm());
    const double rate = is_position ? acceleration * (time - s.used) : acceleration;
    if (!(step <= 8.0 * c.noise + rate * (time - s.time))) s.has_stepped = true;
    if (s.gated++ == 0) s.first = size;
    s.grows = s.gated >= 3 && size >= s.first + 3.0 * c.noise;
    s.time = time;
    s.residual = residual;
  }

  /// True if the IMU is wrong, after a measurement of this sensor above the gate.
  [[nodiscard]] bool convicts_imu(bool is_position, bool heading_contradicts) const noexcept {
    const Series &own = series_[is_position], &other = series_[!is_position];
    constexpr double rest = 0.3;  // [m/s]
    const bool other_agrees = other.agrees && other.used > own.used,
               other_contradicts = own.time - other.time < 1.0 && !other.has_stepped &&
                                   (other.gated > 0 || !other.agrees);
    const bool stands_still =
        speed_ > rest && static_cast<double>(velocity_.norm()) <= 1.5 * velocity_noise_;
    return own.grows && !other_agrees &&
           (heading_contradicts || (other_contradicts && !stands_still && moves_alike_));
  }

 private:
  struct Series {
    Vector3<Scalar> residual = Vector3<Scalar>::Zero(), mean = residual;  ///< last; of those used
    double used = -std::numeric_limits<double>::infinity(), time = used, first = 0.0;
    int gated = 0;
    bool agrees = false, has_stepped = false, grows = false;
  };

  /// Compares the way between two positions with the velocities.
  void listen(bool is_position, double time, const PoseComparison<Scalar>& c) noexcept {
    const double dt = time - series_[0].time;  // since the last velocity
    if (is_position) {
      const double error = static_cast<double>((c.measured.position - place_ - travelled_).norm());
      moves_alike_ = error <= 4.0 * c.noise + 0.3 * (time - series_[1].used);
      return;
    }
    constexpr double memory = 5.0;  // measurements
    velocity_ += (c.measured.position - velocity_) / Scalar(memory);
    velocity_noise_ = c.noise;
    if (dt < 1.0) travelled_ += c.measured.position * Scalar(dt);
  }

  std::array<Series, 2> series_;                        ///< of velocities, of positions
  Vector3<Scalar> velocity_ = Vector3<Scalar>::Zero();  ///< mean of those measured [m/s]
  Vector3<Scalar> place_ = velocity_;                   ///< last position that was used [m]
  Vector3<Scalar> travelled_ = velocity_;  ///< since then, by the measured velocities [m]
  double velocity_noise_ = 0.0;
  double speed_ = 0.0;  ///< mean of the estimate before the residuals grew [m/s]
  bool moves_alike_ = false;
};

}  // namespace tilt_ropter::detail
