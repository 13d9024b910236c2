// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/inertial_state.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

namespace tilt_ropter::detail {

/// Finds how far the heading of a start is from the true one, by the motion itself: the way of the
/// IMU alone, from the start on, against positions and velocities of a receiver. In the horizontal
/// plane, with x + i y for a vector, these are p0 + v0 t + a0 t^2 / 2 + j0 t^3 / 6 + c w(t), where
/// w is the way of the IMU, a0 and j0 are the errors by tilt and biases, and c = exp(i error). A
/// recursive least squares for p0, v0, a0, j0 and c. Does not allocate or throw.
///
/// A filter cannot find an error above about 60 degrees: it linearises at the wrong heading, and
/// takes the difference for tilt and biases. Here |c| = 1, and that only noise is left, are the
/// witnesses that nothing else errs, and the vertical that the accelerometer has the right sign.
template <typename Scalar>
class HeadingFromMotion {
 public:
  /// Begins at the state `x`, the heading of which may be wrong.
  void begin(const InertialState<Scalar>& x) noexcept {
    *this = {};
    is_open_ = true;
    alone_ = x;
  }
  void end() noexcept { is_open_ = false; }
  [[nodiscard]] bool is_open() const noexcept { return is_open_; }

  /// Goes on by the mean of two IMU samples, `dt` [s] apart.
  void predict(const InertialSample<Scalar>& mean, const Scalar& dt) noexcept {
    if (!is_open_) return;
    alone_ = propagate(alone_, mean, dt);
    time_ += static_cast<double>(dt);
  }

  /// Processes a position [m] or velocity [m/s] of the IMU in the world, with its standard
  /// deviation. `x` is the state of the filter. Returns true if its heading is wrong, or if a wrong
  /// one has led it far away: then state() is right, from which to begin() again.
  [[nodiscard]] bool finds_error(bool is_position, const Vector3<Scalar>& value, double stddev,
                                 const InertialState<Scalar>& x) noexcept {
    constexpr double farthest = 1e8;  // a sum that overflows would not recover
    if (!is_open_ || !(static_cast<double>(value.cwiseAbs().maxCoeff()) < farthest)) return false;
    add(is_position, static_cast<double>(value.x()), static_cast<double>(value.y()), stddev);
    if (!solve()) return false;
    // While nothing moves, the attitude of the filter is better than that of the gyroscope alone.
    constexpr double long_enough = 10.0, too_long = 30.0, unknown = 1.0;  // [s], of c
    is_stale_ = time_ > (stddev_ > unknown ? long_enough : too_long);
    if (!is_credible(is_position, value, stddev)) return false;
    constexpr double nonlinear = 0.6, sure = 0.12;  // error that the filter does not correct [rad]
    const InertialState<Scalar> right = state(x);
    const double off = std::abs(std::remainder(
        static_cast<double>(yaw_of(right.orientation) - yaw_of(x.orientation)), 2.0 * pi));
    if (off > nonlinear) return off > 5.0 * stddev_;
    if (!(stddev_ < sure)) return false;
    constexpr double memory = 5.0;  // of a filter that a compass has put right [s]
    if (time_ > memory) end();
    const Vector3<Scalar> away =
        is_position ? right.position - x.position : right.velocity - x.velocity;
    return static_cast<double>(away.norm()) > 10.0 * stddev + 1.0;
  }
  /// True if it is time to begin() again.
  [[nodiscard]] bool is_stale() const noexcept { return is_open_ && is_stale_; }

  /// The state with the heading that was found; its height and vertical velocity are the filter's.
  [[nodiscard]] InertialState<Scalar> state(const InertialState<Scalar>& filter) const noexcept {
    InertialState<Scalar> x = alone_;
    const Eigen::Quaternion<Scalar> turn =
        quaternion_from_yaw(static_cast<Scalar>(std::atan2(turn_[1], turn_[0])));
    const auto moved = [this](const Vector3<Scalar>& own, const Basis& by, std::size_t i) {
      const auto x0 = static_cast<double>(own.x()), y0 = static_cast<double>(own.y());
      double sum = i == 0 ? turn_[0] * x0 - turn_[1] * y0 : turn_[0] * y0 + turn_[1] * x0;
      for (std::size_t k = 0; k < rests; ++k) sum += by[k] * rest_[i][k];
      return static_cast<Scalar>(sum);
    };
    const Basis place = basis(true), rate = basis(false);
    x.position << moved(alone_.position, place, 0), moved(alone_.position, place, 1),
        filter.position.z();
    x.velocity << moved(alone_.velocity, rate, 0), moved(alone_.velocity, rate, 1),
        filter.velocity.z();
    if (has_origin_)
      x.position += Vector3<Scalar>(Scalar(origin_[0]), Scalar(origin_[1]), Scalar(0));
    else
      x.position = filter.position;
    x.orientation = (turn * alone_.orientation).normalized();
    return x;
  }
  /// Standard deviation of the heading of state() [rad].
  [[nodiscard]] double stddev() const noexcept { return stddev_; }

 private:
  static constexpr std::size_t rests = 4;  ///< p0, v0, a0 and j0, of one axis
  static constexpr std::size_t way = rests, fix = way + 2, size = fix + 2;
  using Basis = std::array<double, rests>;
  using Gram = std::array<std::array<double, size>, size>;

  /// Derivatives of a position or velocity of now by the rest.
  [[nodiscard]] Basis basis(bool is_position) const noexcept {
    const double t = time_, square = 0.5 * t * t;
    return is_position ? Basis{1.0, t, square, square * t / 3.0} : Basis{0.0, 1.0, t, square};
  }

  /// The way of the IMU explains that of the receiver, and is as long and as high.
  [[nodiscard]] bool is_credible(bool is_position, const Vector3<Scalar>& value,
                                 double stddev) const noexcept {
    constexpr double shortest = 1.5, fair = 0.25, unit = 0.25;  // [s], of c, of |c| - 1
    constexpr double acceleration = 2.0;                        // error by tilt and bias [m/s^2]
    const double growth = is_position ? 0.5 * time_ * time_ : time_;
    const Scalar own = is_position ? alone_.position.z() : alone_.velocity.z();
    const double length = std::hypot(turn_[0], turn_[1]);
    constexpr double most = 4.0;  // a receiver is twice as noisy as it says
    return time_ > shortest && excess_ < most && stddev_ < fair * length &&
           std::abs(length - 1.0) < unit + 2.0 * stddev_ &&
           std::abs(static_cast<double>(value.z() - own)) <
               5.0 * stddev + 1.0 + acceleration * growth;
  }

  void add(bool is_position, double x, double y, double stddev) noexcept {
    constexpr double memory = 5.0;  // [s]
    const double kept = std::exp((last_ - time_) / memory), weight = 1.0 / (stddev * stddev);
    last_ = time_;
    if (is_position && !has_origin_) {
      origin_ = {x, y};
      has_origin_ = true;
    }
    const Basis by = basis(is_position);
    const Vector3<Scalar>& own = is_position ? alone_.position : alone_.velocity;
    std::array<double, size> all = {
        by[0], by[1], by[2], by[3], static_cast<double>(own.x()), static_cast<double>(own.y()),
        x,     y};
    if (is_position) {
      all[fix] -= origin_[0];
      all[fix + 1] -= origin_[1];
    }
    for (std::size_t i = 0; i < size; ++i)
      for (std::size_t k = 0; k < size; ++k)
        gram_[i][k] = kept * gram_[i][k] + weight * all[i] * all[k];
    count_ = kept * count_ + 2.0;
  }

  /// Eliminates the rest, which leaves the sums of way and fix beside it, and solves for c. Returns
  /// false if there is too little.
  [[nodiscard]] bool solve() noexcept {
    constexpr double few = 20.0, unknown = 10.0;      // numbers
    constexpr Basis known = {1e-6, 1e-4, 1.0, 10.0};  // of the rest without any fix, 1 / variance
    if (!(count_ > few)) return false;
    Gram g = gram_;
    for (std::size_t k = 0; k < rests; ++k) {
      g[k][k] += known[k];
      if (!(g[k][k] > 0.0)) return false;
      for (std::size_t i = k + 1; i < size; ++i) {
        const double factor = g[i][k] / g[k][k];
        for (std::size_t j = k + 1; j < size; ++j) g[i][j] -= factor * g[k][j];
      }
    }
    const double information = g[way][way] + g[way + 1][way + 1];
    if (!(information > 0.0)) return false;
    turn_ = {(g[way][fix] + g[way + 1][fix + 1]) / information,
             (g[way][fix + 1] - g[way + 1][fix]) / information};
    const double explained = information * (turn_[0] * turn_[0] + turn_[1] * turn_[1]),
                 left = g[fix][fix] + g[fix + 1][fix + 1] - explained;
    excess_ = left / (count_ - unknown);
    stddev_ = std::sqrt(std::max(1.0, excess_) / information);
    for (std::size_t k = rests; k-- > 0;) {
      rest_[0][k] = g[k][fix] - turn_[0] * g[k][way] + turn_[1] * g[k][way + 1];
      rest_[1][k] = g[k][fix + 1] - turn_[0] * g[k][way + 1] - turn_[1] * g[k][way];
      for (Basis& rest : rest_) {
        for (std::size_t j = k + 1; j < rests; ++j) rest[k] -= g[k][j] * rest[j];
        rest[k] /= g[k][k];
      }
    }
    return true;
  }

  // Numbers, not matrices: each type of Eigen's costs every user of Ekf time to compile.
  InertialState<Scalar> alone_;     ///< by the IMU alone
  double time_ = 0.0, last_ = 0.0;  ///< since begin(), of the last fix [s]
  Gram gram_ = {};                  ///< sums over the fixes of basis, way and fix, by variances
  double count_ = 0.0;
  std::array<double, 2> origin_ = {};  ///< first position [m]
  // The solution.
  std::array<double, 2> turn_ = {};  ///< c
  std::array<Basis, 2> rest_ = {};
  double stddev_ = 0.0;  ///< of c
  double excess_ = 0.0;  ///< what is left unexplained, over what the noise explains
  bool is_open_ = false, has_origin_ = false, is_stale_ = false;
};

}  // namespace tilt_ropter::detail
