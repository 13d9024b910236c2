// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/detail/timing.hpp>
#include <tilt_ropter/planning/figure_eight.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <string>
#include <utility>
#include <vector>

namespace tilt_ropter {

/// Path with the least integral of squared snap through its points (D. Mellinger and V. Kumar,
/// "Minimum snap trajectory generation and control for quadrotors", 2011). Speed and acceleration
/// at both ends are given; the jerk there is zero.
struct MinimumSnapSettings {
  /// Start, way-points and end: 2 to 100 positions of the CoM, world frame [m]. At least 1 cm
  /// apart, except two points with a given duration.
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
  double duration = 0.0;      ///< zero: the shortest duration found within the limits [s]
};

inline void validate(const MinimumSnapSettings& p) {
  require(p.points.size() >= 2 && p.points.size() <= 100, "MinimumSnapSettings.points.size()",
          p.points.size(), "in [2, 100]");
  for (std::size_t i = 0; i < p.points.size(); ++i) {
    const std::string name = "MinimumSnapSettings.points[" + std::to_string(i) + "]";
    require_finite(name + " [m]", p.points[i]);
    if (i == 0) continue;
    const double distance = (p.points[i] - p.points[i - 1]).norm();
    const bool stays = p.points.size() == 2 && p.duration > 0.0;
    require_in(name + " distance from the point before it [m]", distance, stays ? 0.0 : 0.01, 1e4);
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
  require_in("MinimumSnapSettings.duration [s]", p.duration, 0.0, 1e10);
}

/// Reference along the path. The time from point to point is proportional to the distance, and
/// twice as long next to a rest. The total duration is the first one, in a search from below, that
/// keeps the limits on speed, acceleration and yaw rate; the mean speed next to a rest is at most
/// 0.55 of the limit. Limits are checked at 200 samples from point to point.
class MinimumSnap : public detail::Timing {
 public:
  /// Takes milliseconds; allocates. Throws std::invalid_argument if the settings are invalid or no
  /// duration keeps the limits, as along_velocity on a path without a horizontal direction.
  explicit MinimumSnap(const MinimumSnapSettings& settings) : settings_(settings) {
    validate(settings);
    if (settings.duration > 0.0) {
      if (settings.points.size() == 2) {
        set_knots({0.0, settings.duration});
      } else {
        set_durations(1.0);
        set_durations(settings.duration / duration());
      }
      require(keeps_limits(), "MinimumSnapSettings.duration [s]", settings.duration,
              "one with which the path keeps its limits");
      return;
    }
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

  /// Returns the reference at `time` [s], for every time, see Timing: the points at the ends have
  /// their velocity. Does not throw or allocate.
  [[nodiscard]] ReferencePoint operator()(double time) const noexcept { return at(elapsed(time)); }

  [[nodiscard]] const MinimumSnapSettings& settings() const noexcept { return settings_; }
  /// Time at which the path is at MinimumSnapSettings::points[i] [s].
  [[nodiscard]] double time_at(std::size_t i) const noexcept { return start_time() + knots_[i]; }

 private:
  // Position, velocity, acceleration and jerk at one point.
  using PointValues = std::array<Eigen::Vector3d, 4>;
  // Coefficients of a polynomial of degree 7 in x = time / duration of the piece.
  using Piece = std::array<Eigen::Vector3d, 8>;
  // Position, velocity, acceleration and jerk at the start, then at the end -> coefficients.
  using FromEnds = std::array<std::array<double, 8>, 8>;

  static FromEnds from_ends(double duration) {
    // Coefficients of x^4 to x^7 from what is left of the i-th derivative / i! at the end.
    constexpr double late[4][4] = {
        {35, -15, 5, -1}, {-84, 39, -14, 3}, {70, -34, 13, -3}, {-20, 10, -4, 1}};
    constexpr double binomial[4][4] = {{1, 1, 1, 1}, {0, 1, 2, 3}, {0, 0, 1, 3}, {0, 0, 0, 1}};
    FromEnds c{};
    double scale = 1.0;  // duration^i / i!
    for (std::size_t i = 0; i < 4; ++i) {
      c[i][i] = scale;
      for (std::size_t k = 0; k < 4; ++k) {
        c[4 + k][4 + i] = scale * late[k][i];
        for (std::size_t j = 0; j < 4; ++j) c[4 + k][i] -= scale * late[k][j] * binomial[j][i];
      }
      scale *= duration / static_cast<double>(i + 1);
    }
    return c;
  }

  // Derivative of this order at the end (or start) of a piece, by each of the eight values at both.
  static std::array<double, 8> derivative(int order, bool at_end, double duration) {
    const FromEnds c = from_ends(duration);
    std::array<double, 8> row{};
    for (int k = order; k < (at_end ? 8 : order + 1); ++k) {
      double factor = 1.0;
      for (int j = 0; j < order; ++j) factor *= (k - j) / duration;
      for (std::size_t i = 0; i < 8; ++i) row[i] += factor * c[static_cast<std::size_t>(k)][i];
    }
    return row;
  }

  // The times between the points, in units of their distances at the largest speed. Next to a rest
  // the mean speed is half of that: with less time there, the path would swing back.
  void set_durations(double scale) {
    const std::vector<Eigen::Vector3d>& points = settings_.points;
    std::vector<double> knots{0.0};
    for (std::size_t i = 1; i < points.size(); ++i) {
      const bool starts = i == 1 && settings_.start_velocity.isZero(0.0),
                 ends = i + 1 == points.size() && settings_.end_velocity.isZero(0.0);
      const double distance = (starts || ends ? 2.0 : 1.0) * (points[i] - points[i - 1]).norm();
      knots.push_back(knots.back() + scale * distance / settings_.max_speed);
    }
    set_knots(std::move(knots));
  }

  // Between two points, velocity, acceleration and jerk are free. For the least snap, the sixth,
  // fifth and fourth derivatives are continuous: the gradient of the snap by these numbers is zero.
  // With the sign of the gradient, the system is symmetric, positive definite and banded.
  void set_knots(std::vector<double> knots) {
    knots_ = std::move(knots);
    set_timing(0.0, knots_.back());
    const std::size_t last = knots_.size() - 1, size = last > 1 ? 3 * (last - 1) : 0;
    const Eigen::Vector3d zero = Eigen::Vector3d::Zero();
    std::vector<std::array<double, 11>> rows(size);  // five entries to each side of the diagonal
    std::vector<Eigen::Vector3d> right(size, zero);
    std::vector<PointValues> values;
    for (const Eigen::Vector3d& p : settings_.points) values.push_back({p, zero, zero, zero});
    values.front()[1] = settings_.start_velocity;
    values.front()[2] = settings_.start_acceleration;
    values.back()[1] = settings_.end_velocity;
    values.back()[2] = settings_.end_acceleration;
    // Adds the derivative of piece `piece` to the equation of a point.
    const auto add = [&](std::size_t row, std::size_t piece, double sign,
                         const std::array<double, 8>& factors) {
      for (std::size_t i = 0; i < 8; ++i) {
        const std::size_t point = piece + i / 4, number = i % 4;
        const double factor = sign * factors[i];
        if (number > 0 && point > 0 && point < last)
          rows[row][3 * (point - 1) + number - 1 + 5 - row] += factor;
        else
          right[row] -= factor * values[point][number];
      }
    };
    for (std::size_t i = 1; i < last; ++i)
      for (int number = 0; number < 3; ++number) {
        const int order = 6 - number;
        const double sign = number == 1 ? -1.0 : 1.0;
        const std::size_t row = 3 * (i - 1) + static_cast<std::size_t>(number);
        add(row, i - 1, sign, derivative(order, true, knots_[i] - knots_[i - 1]));
        add(row, i, -sign, derivative(order, false, knots_[i + 1] - knots_[i]));
      }
    solve(rows, right);
    for (std::size_t row = 0; row < size; ++row) values[1 + row / 3][1 + row % 3] = right[row];

    pieces_.resize(last);
    for (std::size_t i = 0; i < last; ++i) {
      const FromEnds c = from_ends(knots_[i + 1] - knots_[i]);
      pieces_[i].fill(zero);
      for (std::size_t k = 0; k < 8; ++k)
        for (std::size_t j = 0; j < 8; ++j) pieces_[i][k] += c[k][j] * values[i + j / 4][j % 4];
    }
  }

  // Solves a positive definite banded system by elimination; the solution replaces `right`.
  static void solve(std::vector<std::array<double, 11>>& rows,
                    std::vector<Eigen::Vector3d>& right) {
    const std::size_t size = rows.size();
    for (std::size_t i = 0; i < size; ++i)
      for (std::size_t j = i + 1; j < std::min(i + 6, size); ++j) {
        const double factor = rows[j][i + 5 - j] / rows[i][5];
        for (std::size_t k = i; k < std::min(i + 6, size); ++k)
          rows[j][k + 5 - j] -= factor * rows[i][k + 5 - i];
        right[j] -= factor * right[i];
      }
    for (std::size_t i = size; i-- > 0;) {
      for (std::size_t k = i + 1; k < std::min(i + 6, size); ++k)
        right[i] -= rows[i][k + 5 - i] * right[k];
      right[i] /= rows[i][5];
    }
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
        1e-9 * (settings_.points[i + 1] - settings_.points[i]).norm() / (knots_[i + 1] - knots_[i]);
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
      value = value * x + factor * pieces_[i][static_cast<std::size_t>(k)];
    }
    return value;
  }

  MinimumSnapSettings settings_;
  std::vector<double> knots_;  // times of the points since the start [s]
  std::vector<Piece> pieces_;
};

/// Returns the path on which a vehicle in the moving state `from` comes to rest as soon as
/// `max_acceleration` [m/s^2] allows. It keeps the heading. `from` is a reference point of the
/// motion that is given up, so that position, velocity and acceleration continue; its acceleration
/// must be below the limit. On wheels, set its sideways acceleration to zero: the path is then
/// straight ahead. Throws std::invalid_argument if `from` or the limit is not valid.
[[nodiscard]] inline MinimumSnap stop(const ReferencePoint& from, double max_acceleration) {
  require_finite("stop: position [m]", from.position);
  require_finite("stop: velocity [m/s]", from.velocity);
  require_positive("stop: max_acceleration [m/s^2]", max_acceleration);
  require(from.acceleration.norm() < max_acceleration, "stop: acceleration [m/s^2]",
          from.acceleration.norm(), "below max_acceleration");
  const double speed = from.velocity.norm();
  MinimumSnapSettings path;
  path.start_velocity = from.velocity;
  path.start_acceleration = from.acceleration;
  path.max_acceleration = max_acceleration;
  path.yaw = yaw_of(from.orientation);
  // With x = t / T, the velocity is v (1 - 10 x^3 + 15 x^4 - 6 x^5) + a T (x - 6 x^3 + 8 x^4 - 3
  // x^5) for the velocity v and the acceleration a at the start. The position at its end is exact.
  // For a = 0, the largest deceleration is 1.875 v / T.
  for (double time = std::max(1.875 * speed / max_acceleration, 0.1);; time *= 1.05) {
    const Eigen::Vector3d end =
        from.position + 0.5 * time * from.velocity + 0.1 * time * time * from.acceleration;
    double most = 0.0, fastest = speed;
    for (int i = 0; i <= 100; ++i) {
      const double x = 0.01 * i, hump = x * (1.0 - x);
      most = std::max(most, (from.velocity * (-30.0 * hump * hump / time) +
                             from.acceleration * (1.0 + x * x * (-18.0 + x * (32.0 - 15.0 * x))))
                                .norm());
      fastest = std::max(
          fastest, (from.velocity * (1.0 - x * x * x * (10.0 - x * (15.0 - 6.0 * x))) +
                    from.acceleration * (time * x * (1.0 - x * x * (6.0 - x * (8.0 - 3.0 * x)))))
                       .norm());
    }
    if (most > 1.0001 * max_acceleration && time < 1e4) continue;
    path.points = {from.position, end};
    path.max_speed = 1.001 * fastest + 1e-6;
    path.max_acceleration = 1.001 * max_acceleration;
    path.duration = time;
    return MinimumSnap(path);
  }
}

}  // namespace tilt_ropter
