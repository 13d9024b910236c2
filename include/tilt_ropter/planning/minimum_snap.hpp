// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/planning/figure_eight.hpp>
#include <tilt_ropter/planning/reference.hpp>

#include <Eigen/Core>
#include <Eigen/LU>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

/// Paths through way-points, also between states that move: rolling landings and take-offs, stops.
namespace tilt_ropter {

/// Path with the least integral of squared snap through its points (D. Mellinger and V. Kumar,
/// "Minimum snap trajectory generation and control for quadrotors", 2011). Speed and acceleration
/// at both ends are given; the jerk there is zero.
struct MinimumSnapSettings {
  /// Start, way-points and end: 2 to 100 positions of the CoM, at least 1 cm apart, world frame
  /// [m].
  std::vector<Eigen::Vector3d> points;
  Eigen::Vector3d start_velocity = Eigen::Vector3d::Zero();      ///< world frame [m/s]
  Eigen::Vector3d end_velocity = Eigen::Vector3d::Zero();        ///< world frame [m/s]
  Eigen::Vector3d start_acceleration = Eigen::Vector3d::Zero();  ///< world frame [m/s^2]
  Eigen::Vector3d end_acceleration = Eigen::Vector3d::Zero();    ///< world frame [m/s^2]
  double max_speed = 1.5;                                        ///< limit [m/s]
  double max_acceleration = 1.5;                                 ///< limit [m/s^2]
  HeadingMode heading = HeadingMode::fixed;
  double yaw = 0.0;           ///< yaw of the body, used with HeadingMode::fixed [rad]
  double max_yaw_rate = 1.5;  ///< limit with HeadingMode::along_velocity [rad/s]
  double start_time = 0.0;    ///< time at which the motion starts [s]
};

/// Throws std::invalid_argument with the field, its value and the allowed values.
inline void validate(const MinimumSnapSettings& p) {
  require(p.points.size() >= 2 && p.points.size() <= 100, "MinimumSnapSettings.points.size()",
          p.points.size(), "in [2, 100]");
  for (std::size_t i = 0; i < p.points.size(); ++i) {
    const std::string name = "MinimumSnapSettings.points[" + std::to_string(i) + "]";
    require_finite(name + " [m]", p.points[i]);
    if (i == 0) continue;
    const double distance = (p.points[i] - p.points[i - 1]).norm();
    require_in(name + " distance from the point before it [m]", distance, 0.01, 1e4);
  }
  require_positive("MinimumSnapSettings.max_speed [m/s]", p.max_speed);
  require_positive("MinimumSnapSettings.max_acceleration [m/s^2]", p.max_acceleration);
  const auto require_below = [](const std::string& name, const Eigen::Vector3d& x, double limit) {
    require_finite(name, x);
    require(x.norm() <= limit, name + " norm", x.norm(), "<= " + std::to_string(limit));
  };
  require_below("MinimumSnapSettings.start_velocity [m/s]", p.start_velocity, p.max_speed);
  require_below("MinimumSnapSettings.end_velocity [m/s]", p.end_velocity, p.max_speed);
  require_below("MinimumSnapSettings.start_acceleration [m/s^2]", p.start_acceleration,
                p.max_acceleration);
  require_below("MinimumSnapSettings.end_acceleration [m/s^2]", p.end_acceleration,
                p.max_acceleration);
  require_finite("MinimumSnapSettings.yaw [rad]", p.yaw);
  require_positive("MinimumSnapSettings.max_yaw_rate [rad/s]", p.max_yaw_rate);
  require_time("MinimumSnapSettings.start_time [s]", p.start_time);
}

/// Reference along the path. The time from point to point is proportional to the distance, and as
/// short as the limits on speed, acceleration and yaw rate allow, to 1 %. Limits are checked at 200
/// samples from point to point.
class MinimumSnap {
 public:
  /// Takes milliseconds; allocates. Throws std::invalid_argument if the settings are invalid, if no
  /// duration keeps the limits. With HeadingMode::along_velocity, a path without a horizontal
  /// direction keeps no limit.
  explicit MinimumSnap(const MinimumSnapSettings& settings) : settings_(settings) {
    validate(settings);
    // Far above its best duration a path that moves at its ends makes detours. The search therefore
    // starts with the shortest duration and grows.
    double scale = 1.0 / 1.1;
    do {
      scale *= 1.1;
      require(
          scale < 1e4, "MinimumSnapSettings' limits", "too tight",
          "limits that some duration keeps; with along_velocity a path that always moves sideways");
      set_durations(scale);
    } while (!keeps_limits());
    for (double last = scale / 1.1; scale - last > 0.005 * scale;) {
      const double between = 0.5 * (last + scale);
      set_durations(between);
      (keeps_limits() ? scale : last) = between;
    }
    set_durations(scale);
    require_in("MinimumSnap's duration within its limits [s]", duration(), 1e-3, 1e10);
  }

  /// Returns the reference at `time` [s], for every time: the first point before the start and the
  /// last point after the end, with its velocity. NaN counts as a time before the start. Does not
  /// throw or allocate.
  [[nodiscard]] ReferencePoint operator()(double time) const noexcept {
    const double elapsed = time - settings_.start_time;
    return at(elapsed > 0.0 ? std::min(elapsed, duration()) : 0.0);
  }

  [[nodiscard]] double start_time() const noexcept { return settings_.start_time; }
  [[nodiscard]] double end_time() const noexcept { return settings_.start_time + duration(); }
  [[nodiscard]] double duration() const noexcept { return knots_.back(); }
  [[nodiscard]] const MinimumSnapSettings& settings() const noexcept { return settings_; }

  /// Shifts the motion to start at `time` [s]. Throws std::invalid_argument if `time` is out of
  /// range.
  void set_start_time(double time) {
    require_time("MinimumSnap.start_time [s]", time);
    settings_.start_time = time;
  }

 private:
  // Coefficients of a polynomial of degree 7 in x = time / duration of the piece, in each axis.
  using Piece = Eigen::Matrix<double, 8, 3>;
  using Ends = Eigen::Matrix<double, 8, 8>;

  // Position and first derivatives at both ends of a piece of this duration [s] -> coefficients.
  static Ends from_ends(double duration) {
    Ends c = Ends::Zero();
    double scale = 1.0;  // duration^i / i!
    // The columns of each row i: the i-th derivative at the start and at the end.
    const double late[4][4] = {
        {35, -15, 5, -1}, {-84, 39, -14, 3}, {70, -34, 13, -3}, {-20, 10, -4, 1}};
    const double binomial[4][4] = {{1, 1, 1, 1}, {0, 1, 2, 3}, {0, 0, 1, 3}, {0, 0, 0, 1}};
    for (int i = 0; i < 4; ++i) {
      c(i, i) = scale;
      for (int k = 0; k < 4; ++k) {
        c(4 + k, 4 + i) = scale * late[k][i];
        for (int j = 0; j < 4; ++j) c(4 + k, i) -= scale * late[k][j] * binomial[j][i];
      }
      scale *= duration / (i + 1);
    }
    return c;
  }

  // Row that takes coefficients to the derivative of this order at x.
  static Eigen::Matrix<double, 1, 8> derivative(int order, double x, double duration) {
    Eigen::Matrix<double, 1, 8> row = Eigen::Matrix<double, 1, 8>::Zero();
    for (int k = order; k < 8; ++k) {
      double factor = std::pow(duration, -order);
      for (int j = 0; j < order; ++j) factor *= k - j;
      row(k) = factor * std::pow(x, k - order);
    }
    return row;
  }

  // Between two points, velocity, acceleration and jerk are free. They follow from the continuity
  // of the fourth to sixth derivative, which is the condition for the least snap.
  void set_durations(double scale) {
    const std::vector<Eigen::Vector3d>& points = settings_.points;
    const std::size_t count = points.size() - 1;
    knots_.assign(1, 0.0);
    for (std::size_t i = 0; i < count; ++i)
      knots_.push_back(knots_.back() +
                       scale * (points[i + 1] - points[i]).norm() / settings_.max_speed);
    const auto size = static_cast<Eigen::Index>(4 * points.size());
    Eigen::MatrixXd equations = Eigen::MatrixXd::Zero(size, size);
    Eigen::MatrixX3d given = Eigen::MatrixX3d::Zero(size, 3);
    for (std::size_t i = 0; i <= count; ++i) {
      const auto at = static_cast<Eigen::Index>(4 * i);
      equations(at, at) = 1.0;
      given.row(at) = points[i];
      if (i == 0 || i == count) {
        for (int j = 1; j < 4; ++j) equations(at + j, at + j) = 1.0;
        given.row(at + 1) = i == 0 ? settings_.start_velocity : settings_.end_velocity;
        given.row(at + 2) = i == 0 ? settings_.start_acceleration : settings_.end_acceleration;
        continue;
      }
      const double before = knots_[i] - knots_[i - 1], after = knots_[i + 1] - knots_[i];
      for (int order = 4; order < 7; ++order) {
        const double unit = std::pow(before, order);  // the rows then have similar sizes
        const Eigen::Index row = at + order - 3;
        equations.block<1, 8>(row, at - 4) +=
            unit * derivative(order, 1.0, before) * from_ends(before);
        equations.block<1, 8>(row, at) -= unit * derivative(order, 0.0, after) * from_ends(after);
      }
    }
    const Eigen::MatrixX3d ends = equations.partialPivLu().solve(given);
    pieces_.clear();
    for (std::size_t i = 0; i < count; ++i)
      pieces_.push_back(from_ends(knots_[i + 1] - knots_[i]) *
                        ends.middleRows<8>(static_cast<Eigen::Index>(4 * i)));
  }

  [[nodiscard]] bool keeps_limits() const {
    constexpr int samples = 200;
    for (std::size_t i = 0; i < pieces_.size(); ++i) {
      double fastest_turn = 0.0, turn_at = 0.0;
      for (int j = 0; j <= samples; ++j) {
        const double x = static_cast<double>(j) / samples;
        if (!keeps_limits_at(i, x)) return false;
        const double rate = std::abs(at_piece(i, x).angular_velocity.z());
        if (rate > fastest_turn) turn_at = x;
        fastest_turn = std::max(fastest_turn, rate);
      }
      // Where the path is slow, it can turn fast for a short time.
      for (int j = -20; fastest_turn > 0.0 && j <= 20; ++j)
        if (!keeps_limits_at(i, std::clamp(turn_at + j / (20.0 * samples), 0.0, 1.0))) return false;
    }
    return true;
  }

  [[nodiscard]] bool keeps_limits_at(std::size_t i, double x) const {
    constexpr double tolerance = 1.0 + 1e-9;
    const ReferencePoint point = at_piece(i, x);
    if (!(point.velocity.norm() <= tolerance * settings_.max_speed) ||
        !(point.acceleration.norm() <= tolerance * settings_.max_acceleration))
      return false;
    if (settings_.heading == HeadingMode::fixed) return true;
    // Below this speed a level direction is rounding.
    const double slowest =
        1e-6 * (settings_.points[i + 1] - settings_.points[i]).norm() / (knots_[i + 1] - knots_[i]);
    return std::abs(point.angular_velocity.z()) <= settings_.max_yaw_rate &&
           (near_rest(i, x) != x || std::hypot(point.velocity.x(), point.velocity.y()) > slowest);
  }

  // At rest the velocity has no direction. Returns the nearest place to x in piece i that has one.
  [[nodiscard]] double near_rest(std::size_t i, double x) const noexcept {
    constexpr double next = 0.003;
    if (i == 0 && settings_.start_velocity.isZero(0.0)) x = std::max(x, next);
    if (i + 1 == pieces_.size() && settings_.end_velocity.isZero(0.0)) x = std::min(x, 1.0 - next);
    return x;
  }

  [[nodiscard]] ReferencePoint at(double elapsed) const noexcept {
    std::size_t i = 0;
    while (i + 1 < pieces_.size() && elapsed >= knots_[i + 1]) ++i;
    return at_piece(i, (elapsed - knots_[i]) / (knots_[i + 1] - knots_[i]));
  }

  [[nodiscard]] ReferencePoint at_piece(std::size_t i, double x) const noexcept {
    const double whole = knots_[i + 1] - knots_[i];
    ReferencePoint point;
    point.position = derivative_of(i, 0, x);
    point.velocity = derivative_of(i, 1, x);
    point.acceleration = derivative_of(i, 2, x);
    point.orientation = quaternion_from_yaw(settings_.yaw);
    if (settings_.heading == HeadingMode::fixed) return point;

    const double near = near_rest(i, x);  // the heading there is continued to x
    const Eigen::Vector3d v = derivative_of(i, 1, near), a = derivative_of(i, 2, near),
                          jerk = derivative_of(i, 3, near);
    const double square = v.x() * v.x() + v.y() * v.y();
    if (!(square > 0.0)) return point;
    const double rate = (v.x() * a.y() - v.y() * a.x()) / square;
    point.orientation = quaternion_from_yaw(std::atan2(v.y(), v.x()) + rate * whole * (x - near));
    point.angular_velocity.z() = rate;
    if (x == near)
      point.angular_acceleration.z() =
          (v.x() * jerk.y() - v.y() * jerk.x() - 2.0 * rate * (v.x() * a.x() + v.y() * a.y())) /
          square;
    return point;
  }

  // Derivative of this order of piece i at x in [0, 1].
  [[nodiscard]] Eigen::Vector3d derivative_of(std::size_t i, int order, double x) const noexcept {
    const double whole = knots_[i + 1] - knots_[i];
    Eigen::Vector3d value = Eigen::Vector3d::Zero();
    for (int k = 7; k >= order; --k) {
      double factor = 1.0;
      for (int j = 0; j < order; ++j) factor *= (k - j) / whole;
      value = value * x + factor * pieces_[i].row(k).transpose();
    }
    return value;
  }

  MinimumSnapSettings settings_;
  std::vector<double> knots_;  // times of the points since the start [s]
  std::vector<Piece> pieces_;
};

}  // namespace tilt_ropter
