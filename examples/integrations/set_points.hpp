#pragma once

#include "messages.hpp"
#include "px4_messages.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <type_traits>
#include <utility>
#include <vector>

/// Motions that another program plans while the vehicle flies.
namespace loops {

/// Where the vehicle is to be at a time, and how fast.
struct SetPoint {
  double time = 0.0;                                       ///< from the first set point [s]
  Eigen::Vector3d position = Eigen::Vector3d::Zero();      ///< CoM, world frame (ENU) [m]
  Eigen::Vector3d velocity = Eigen::Vector3d::Zero();      ///< [m/s]
  Eigen::Vector3d acceleration = Eigen::Vector3d::Zero();  ///< of a single set point [m/s^2]
  double yaw = 0.0, yaw_rate = 0.0;                        ///< about world z [rad], [rad/s]
};

/// The motion through set points: cubic between two of them. A single one moves on with its
/// acceleration for `patience`. Where the reference was before fades into it, see begin_at().
class SetPoints {
 public:
  static constexpr double patience = 0.5;  ///< until the next message of a single set point [s]

  /// Nothing if there are no points, a number is not finite or above 1e4, or times do not rise by
  /// 2 ms.
  static std::optional<SetPoints> through(std::vector<SetPoint> points) {
    constexpr double largest = 1e4;
    if (points.empty()) return std::nullopt;
    double last = -1.0;
    for (SetPoint& p : points) {
      const double size = p.position.norm() + p.velocity.norm() + p.acceleration.norm() +
                          std::abs(p.yaw) + std::abs(p.yaw_rate);
      if (!(size < largest) || !(p.time > last + 2e-3) || !(p.time < 1e5)) return std::nullopt;
      last = p.time;
    }
    for (std::size_t i = 1; i < points.size(); ++i)
      points[i].yaw = points[i - 1].yaw +
                      std::remainder(points[i].yaw - points[i - 1].yaw, 2.0 * tilt_ropter::pi);
    return SetPoints(std::move(points));
  }

  /// The same motion, which begins as `now` moves and catches up. A stream of single set points
  /// without their acceleration is followed with a lag: at 0.25 m/s^2 by 13 mm.
  void begin_at(const tilt_ropter::ReferencePoint& now) {
    // At rest, the way has at most 1 m/s and 2 m/s^2, 0.8 rad/s and 2 rad/s^2.
    constexpr double shortest = 0.6, speed = 1.875, acceleration = 5.774;  // of such a polynomial
    const auto time = [](double far, double fastest, double strongest) {
      return std::max(speed * far / fastest, std::sqrt(acceleration * far / strongest));
    };
    way_ = Way::Zero();
    const tilt_ropter::ReferencePoint first = (*this)(0.0);
    Eigen::Vector4d p, v, a;
    p << now.position - first.position, std::remainder(tilt_ropter::yaw_of(now.orientation) -
                                                           tilt_ropter::yaw_of(first.orientation),
                                                       2.0 * tilt_ropter::pi);
    v << now.velocity - first.velocity, now.angular_velocity.z() - first.angular_velocity.z();
    a << now.acceleration - first.acceleration,
        now.angular_acceleration.z() - first.angular_acceleration.z();
    const double T = way_time_ =
        std::max({shortest, time(p.head<3>().norm(), 1.0, 2.0), time(std::abs(p(3)), 0.8, 2.0)});
    // A polynomial of degree 5 from (p, v, a) to rest at zero.
    way_.col(0) = p;
    way_.col(1) = v;
    way_.col(2) = a / 2.0;
    way_.col(3) = (-10.0 * p / T - 6.0 * v - 1.5 * a * T) / (T * T);
    way_.col(4) = (15.0 * p / T + 8.0 * v + 1.5 * a * T) / (T * T * T);
    way_.col(5) = (-6.0 * p / T - 3.0 * v - 0.5 * a * T) / (T * T * T * T);
  }

  [[nodiscard]] bool is_single() const { return points_.size() == 1; }
  [[nodiscard]] double duration() const {
    return is_single() ? patience : points_.back().time - points_.front().time;
  }

  /// The reference `passed` [s] after the first set point.
  tilt_ropter::ReferencePoint operator()(double passed) const {
    const SetPoint p = at(points_.front().time + passed);
    const double t = std::min(passed, way_time_);
    Eigen::Matrix<double, 6, 1> powers, slope, curve;
    powers << 1.0, t, t * t, t * t * t, t * t * t * t, t * t * t * t * t;
    for (int i = 0; i < 6; ++i) {
      slope(i) = i > 0 ? i * powers(i - 1) : 0.0;
      curve(i) = i > 1 ? i * (i - 1) * powers(i - 2) : 0.0;
    }
    const Eigen::Vector4d left = way_ * powers, speed = way_ * slope, change = way_ * curve;
    tilt_ropter::ReferencePoint r;
    r.position = p.position + left.head<3>();
    r.velocity = p.velocity + speed.head<3>();
    r.acceleration = p.acceleration + change.head<3>();
    r.orientation = tilt_ropter::quaternion_from_yaw(p.yaw + left(3));
    r.angular_velocity.z() = p.yaw_rate + speed(3);
    r.angular_acceleration.z() = change(3);
    return r;
  }

 private:
  explicit SetPoints(std::vector<SetPoint> points) : points_(std::move(points)) {}

  [[nodiscard]] SetPoint at(double time) const {
    if (is_single()) {
      SetPoint p = points_.front();
      const double t = time - p.time;
      p.position += t * p.velocity + 0.5 * t * t * p.acceleration;
      p.velocity += t * p.acceleration;
      p.yaw += t * p.yaw_rate;
      return p;
    }
    std::size_t i = 0;
    while (i + 2 < points_.size() && time >= points_[i + 1].time) ++i;
    const SetPoint &a = points_[i], &b = points_[i + 1];
    const double dt = b.time - a.time, u = std::clamp((time - a.time) / dt, 0.0, 1.0);
    // Value, slope and curvature of the cubic with these ends.
    const auto cubic = [&](const auto& from, const auto& v, const auto& to, const auto& w) {
      using Value = std::decay_t<decltype(from)>;
      const Value c2 = 3.0 * (to - from) - dt * (2.0 * v + w),
                  c3 = 2.0 * (from - to) + dt * (v + w);
      return std::array<Value, 3>{Value(from + u * (dt * v + u * (c2 + u * c3))),
                                  Value(v + u / dt * (2.0 * c2 + 3.0 * u * c3)),
                                  Value((2.0 * c2 + 6.0 * u * c3) / (dt * dt))};
    };
    SetPoint p;
    const auto place = cubic(a.position, a.velocity, b.position, b.velocity);
    const auto heading = cubic(a.yaw, a.yaw_rate, b.yaw, b.yaw_rate);
    p.position = place[0];
    p.velocity = place[1];
    p.acceleration = place[2];
    p.yaw = heading[0];
    p.yaw_rate = heading[1];
    return p;
  }

  std::vector<SetPoint> points_;
  using Way = Eigen::Matrix<double, 4, 6>;  // coefficients of position and heading
  Way way_ = Way::Zero();                   // from the reference before, see begin_at()
  double way_time_ = 0.0;                   // [s]
};

/// Stops evenly within `duration`, along the line on which `from` moves.
struct Braking {
  static constexpr double duration = 1.0;  ///< [s]

  tilt_ropter::ReferencePoint operator()(double passed) const {
    const double left = 1.0 - std::clamp(passed / duration, 0.0, 1.0);
    const double turned = from.angular_velocity.z() * passed * 0.5 * (1.0 + left);
    tilt_ropter::ReferencePoint r;
    r.position = from.position + passed * 0.5 * (1.0 + left) * from.velocity;
    r.velocity = left * from.velocity;
    r.acceleration = -from.velocity / duration;
    r.orientation =
        tilt_ropter::quaternion_from_yaw(tilt_ropter::yaw_of(from.orientation) + turned);
    r.angular_velocity.z() = left * from.angular_velocity.z();
    return r;
  }

  tilt_ropter::ReferencePoint from;
};

/// The first joint's set points of a trajectory. If a velocity is missing, all between the ends are
/// those from neighbour to neighbour, and the vehicle rests at an end without one.
[[nodiscard]] inline std::vector<SetPoint> set_points(
    const trajectory_msgs::msg::MultiDOFJointTrajectory& m) {
  std::vector<SetPoint> points;
  bool has_velocities = true;
  for (std::uint32_t i = 0; i < m.points._length; ++i) {
    const auto& point = m.points._buffer[i];
    if (point.transforms._length == 0) return {};
    const auto& p = point.transforms._buffer[0].translation;
    const auto& q = point.transforms._buffer[0].rotation;
    const Eigen::Quaterniond orientation(q.w, q.x, q.y, q.z);
    if (!(std::abs(orientation.norm() - 1.0) < 0.01)) return {};
    SetPoint s;
    s.time = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec;
    s.position << p.x, p.y, p.z;
    s.yaw = tilt_ropter::yaw_of(orientation.normalized());
    if (point.velocities._length > 0) {
      const auto& twist = point.velocities._buffer[0];
      s.velocity << twist.linear.x, twist.linear.y, twist.linear.z;
      s.yaw_rate = twist.angular.z;
    } else {
      has_velocities = false;
    }
    if (point.accelerations._length > 0) {
      const auto& linear = point.accelerations._buffer[0].linear;
      s.acceleration << linear.x, linear.y, linear.z;
    }
    points.push_back(s);
  }
  for (std::size_t i = 1; !has_velocities && i + 1 < points.size(); ++i) {
    const SetPoint &a = points[i - 1], &b = points[i + 1];
    points[i].velocity = (b.position - a.position) / (b.time - a.time);
    points[i].yaw_rate = std::remainder(b.yaw - a.yaw, 2.0 * tilt_ropter::pi) / (b.time - a.time);
  }
  return points;
}

/// The same for a set point of PX4 with a position, in NED of PX4's origin, which is
/// `origin_height` [m] above the ground. Velocity, acceleration and turn rate that PX4 would not
/// control are zero; without a heading it stays `yaw` [rad].
[[nodiscard]] inline std::vector<SetPoint> set_points(const px4_msgs::msg::TrajectorySetpoint& m,
                                                      double origin_height, double yaw) {
  const auto enu = [](const Eigen::Vector3d& ned) {
    return Eigen::Vector3d(ned.y(), ned.x(), -ned.z());
  };
  const auto known = [&](const Eigen::Vector3d& ned) {
    return enu(ned.unaryExpr([](double v) { return std::isnan(v) ? 0.0 : v; }));
  };
  SetPoint s;
  s.position = enu(vector(m.position)) + Eigen::Vector3d(0.0, 0.0, origin_height);
  s.velocity = known(vector(m.velocity));
  s.acceleration = known(vector(m.acceleration));
  s.yaw = std::isnan(m.yaw) ? yaw : tilt_ropter::pi / 2.0 - double(m.yaw);
  s.yaw_rate = std::isnan(m.yawspeed) ? 0.0 : -double(m.yawspeed);
  return {s};
}

}  // namespace loops
