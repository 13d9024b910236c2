// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/inertial_state.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

namespace tilt_ropter::detail {

/// Finds how far the heading of a start is from the true one, by the motion itself: the way of the
/// IMU alone, from the start on, against positions and velocities of a receiver. In the horizontal
/// plane, with x + i y for a vector, these are p0 + v0 t + a0 t^2 / 2 + j0 t^3 / 6 + c w(t), where
/// w is the way of the IMU, a0 and j0 are the errors by tilt and biases, and c = exp(i error). A
/// recursive least squares for p0, v0, a0, j0 and c. Does not allocate or throw.
///
/// A filter cannot find an error above about 60 degrees: it linearises at the wrong heading, and
/// takes the difference for tilt and biases. Here |c| = 1 is the witness that nothing else errs,
/// and the vertical that the accelerometer has the right sign.
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
    if (!is_open_) return false;
    add(is_position, value.template head<2>().template cast<double>(), stddev);
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
    const auto turned = [this](double re, double im) {
      return Eigen::Vector2d(turn_(0) * re - turn_(1) * im, turn_(0) * im + turn_(1) * re);
    };
    const Vector3<Scalar> w = alone_.position, u = alone_.velocity;
    const Eigen::Vector2d way = turned(double(w.x()), double(w.y())),
                          rate = turned(double(u.x()), double(u.y()));
    const Basis by = basis(true), by_rate = basis(false);
    for (int i = 0; i < 2; ++i) {
      x.position(i) =
          !has_origin_ ? filter.position(i) : Scalar(origin_(i) + way(i) + by.dot(rest_.col(i)));
      x.velocity(i) = Scalar(rate(i) + by_rate.dot(rest_.col(i)));
    }
    x.position.z() = filter.position.z();
    x.velocity.z() = filter.velocity.z();
    x.orientation =
        (quaternion_from_yaw(Scalar(heading_error())) * alone_.orientation).normalized();
    return x;
  }
  /// Standard deviation of the heading of state() [rad].
  [[nodiscard]] double stddev() const noexcept { return stddev_; }

 private:
  [[nodiscard]] double heading_error() const noexcept { return std::atan2(turn_(1), turn_(0)); }

  /// The way of the IMU is as long as that of the receiver, and as high.
  [[nodiscard]] bool is_credible(bool is_position, const Vector3<Scalar>& value,
                                 double stddev) const noexcept {
    constexpr double shortest = 1.0, fair = 0.25, unit = 0.25;  // [s], of c, of |c| - 1
    constexpr double acceleration = 2.0;                        // error by tilt and bias [m/s^2]
    const double growth = is_position ? 0.5 * time_ * time_ : time_;
    const Scalar own = is_position ? alone_.position.z() : alone_.velocity.z();
    const double length = turn_.norm();
    return time_ > shortest && stddev_ < fair * length &&
           std::abs(length - 1.0) < unit + 2.0 * stddev_ &&
           std::abs(static_cast<double>(value.z() - own)) <
               5.0 * stddev + 1.0 + acceleration * growth;
  }

  void add(bool is_position, const Eigen::Vector2d& value, double stddev) noexcept {
    constexpr double memory = 5.0;  // [s]
    const double kept = std::exp((last_ - time_) / memory);
    last_ = time_;
    for (double* sum : {&ways_, &fixes_, &count_}) *sum *= kept;
    rests_ *= kept;
    rest_by_way_ *= kept;
    rest_by_fix_ *= kept;
    fix_by_way_ *= kept;
    if (is_position && !has_origin_) {
      origin_ = value;
      has_origin_ = true;
    }
    const double weight = 1.0 / (stddev * stddev);
    const Basis by = basis(is_position);
    const Vector3<Scalar>& own = is_position ? alone_.position : alone_.velocity;
    const Eigen::Vector2d way(double(own.x()), double(own.y())),
        fix = is_position ? Eigen::Vector2d(value - origin_) : value;
    rests_ += weight * by * by.transpose();
    rest_by_way_ += weight * by * way.transpose();
    rest_by_fix_ += weight * by * fix.transpose();
    fix_by_way_ += weight * Eigen::Vector2d(way.dot(fix), way.x() * fix.y() - way.y() * fix.x());
    ways_ += weight * way.squaredNorm();
    fixes_ += weight * fix.squaredNorm();
    count_ += 2.0;
  }

  /// Solves for c by the Schur complement of the rest. Returns false if there is too little.
  [[nodiscard]] bool solve() noexcept {
    constexpr double few = 20.0;  // numbers, for 10 unknown ones
    // What is known of the rest without any fix.
    const Basis known(1e-6, 1e-4, 1.0, 10.0);
    const Cholesky factor(Eigen::Matrix4d(rests_ + known.asDiagonal().toDenseMatrix()));
    if (!(count_ > few) || !factor.is_definite) return false;
    const auto solved = [&](const Rest& of) {
      Rest result;
      for (int i = 0; i < 2; ++i) result.col(i) = factor.solve(Basis(of.col(i)));
      return result;
    };
    const Rest by_way = solved(rest_by_way_), by_fix = solved(rest_by_fix_);
    const auto product = [](const Rest& a, const Rest& b) {  // of conj(a) and b
      return Eigen::Vector2d(a.col(0).dot(b.col(0)) + a.col(1).dot(b.col(1)),
                             a.col(0).dot(b.col(1)) - a.col(1).dot(b.col(0)));
    };
    const double information = ways_ - product(rest_by_way_, by_way).x();
    if (!(information > 0.0)) return false;
    const Eigen::Vector2d score = fix_by_way_ - product(rest_by_way_, by_fix);
    turn_ = score / information;
    const double left =
        fixes_ - product(rest_by_fix_, by_fix).x() - score.squaredNorm() / information;
    stddev_ = std::sqrt(std::max(1.0, left / (count_ - 10.0)) / information);
    rest_.col(0) = by_fix.col(0) - turn_(0) * by_way.col(0) + turn_(1) * by_way.col(1);
    rest_.col(1) = by_fix.col(1) - turn_(0) * by_way.col(1) - turn_(1) * by_way.col(0);
    return true;
  }

  using Basis = Eigen::Vector4d;
  using Rest = Eigen::Matrix<double, 4, 2>;  ///< p0, v0, a0, j0 along x and y

  /// Derivatives of a position or velocity of now by the rest.
  [[nodiscard]] Basis basis(bool is_position) const noexcept {
    const double t = time_, square = 0.5 * t * t;
    return is_position ? Basis(1.0, t, square, square * t / 3.0) : Basis(0.0, 1.0, t, square);
  }

  InertialState<Scalar> alone_;     ///< by the IMU alone
  double time_ = 0.0, last_ = 0.0;  ///< since begin(), of the last fix [s]
  // Sums over the fixes, by their variances.
  Eigen::Matrix4d rests_ = Eigen::Matrix4d::Zero();
  Rest rest_by_way_ = Rest::Zero(), rest_by_fix_ = Rest::Zero();
  Eigen::Vector2d fix_by_way_ = Eigen::Vector2d::Zero();
  double ways_ = 0.0, fixes_ = 0.0, count_ = 0.0;
  // The solution.
  Eigen::Vector2d origin_ = Eigen::Vector2d::Zero(), turn_ = origin_;  ///< c
  Rest rest_ = Rest::Zero();
  double stddev_ = 0.0;  ///< of c
  bool is_open_ = false, has_origin_ = false, is_stale_ = false;
};

}  // namespace tilt_ropter::detail
