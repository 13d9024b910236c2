// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/detail/thrust_program.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// Thrusts that the rotors and servos of a vehicle can give.
namespace tilt_ropter::detail {

/// Part of a servo's range. The set of thrusts of a range wider than half a turn is not convex.
/// `lower` and `upper` are the half turns at the two ends of the range. They are convex and cover a
/// range of up to a whole turn. `whole` is the convex hull. A range of half a turn or less has only
/// `whole`.
enum class AnglePart { whole, lower, upper };

/// Set of thrusts within limits. For each rotor the set is a part of the plane of (T_l, T_v):
/// - servo turns all round: the disc |T| <= max_thrust,
/// - smaller servo range: the sector of that disc,
/// - rotor does not tilt: the segment T_l = 0, min_thrust <= T_v <= max_thrust.
///
/// The limits are the limits of RotorParameters times the rotor's effectiveness.
///
/// The min_thrust of a tilting rotor would cut a hole into the disc. To keep the set convex, an
/// optional floor T . u >= min_thrust along a unit vector u replaces the hole. Nothing throws or
/// allocates.
template <int Rotors, typename Scalar>
class ThrustLimits {
 public:
  static constexpr int components = 2 * Rotors;
  using Vector2 = Eigen::Matrix<Scalar, 2, 1>;

  explicit ThrustLimits(const Vehicle<Rotors>& vehicle)
      : min_angle_(Scalar(vehicle.servo.min_angle)),
        max_angle_(Scalar(vehicle.servo.max_angle)),
        tolerance_(Scalar(100) * std::numeric_limits<Scalar>::epsilon() *
                   Scalar(largest_max_thrust(vehicle))),
        half_width_(0.5 * (vehicle.servo.max_angle - vehicle.servo.min_angle)) {
    const double middle = 0.5 * (vehicle.servo.min_angle + vehicle.servo.max_angle);
    middle_ = direction(Scalar(middle));
    // A value below -1 accepts every direction, independent of rounding.
    cos_half_width_ = Scalar(all_round() ? -2.0 : std::cos(half_width_));
    for (std::size_t i = 0; i < Rotors; ++i) {
      const RotorGeometry& rotor = vehicle.rotors[i];
      tilts_[i] = rotor.tilts;
      min_thrust_[i] = Scalar(rotor.effectiveness * rotor_parameters(vehicle, i).min_thrust);
      max_thrust_[i] = Scalar(rotor.effectiveness * rotor_parameters(vehicle, i).max_thrust);
    }
  }

  /// Sets another limit [N] of rotor i, for example for another voltage. `max_thrust` includes the
  /// effectiveness.
  void set_max_thrust(std::size_t i, Scalar max_thrust) noexcept { max_thrust_[i] = max_thrust; }

  [[nodiscard]] bool tilts(int i) const noexcept { return tilts_[std::size_t(i)]; }
  [[nodiscard]] Scalar min_thrust(int i) const noexcept { return min_thrust_[std::size_t(i)]; }
  [[nodiscard]] Scalar max_thrust(int i) const noexcept { return max_thrust_[std::size_t(i)]; }

  /// Returns `thrust` [N] of rotor i, clamped to its limits.
  [[nodiscard]] Scalar bounded_thrust(int i, Scalar thrust) const noexcept {
    return std::max(min_thrust(i), std::min(thrust, max_thrust(i)));
  }

  /// (T_l, T_v) of unit thrust at a tilt angle [rad].
  [[nodiscard]] static Vector2 direction(Scalar angle) noexcept {
    return {std::sin(angle), std::cos(angle)};
  }

  /// Nearest angle within the servo's range [rad].
  [[nodiscard]] Scalar bounded_angle(Scalar angle) const noexcept {
    return std::max(min_angle_, std::min(angle, max_angle_));
  }

  /// Angle equivalent to `angle` (+- 2 pi k) and nearest to `last`, in range or not [rad].
  [[nodiscard]] static Scalar unwrapped_angle(Scalar angle, Scalar last) noexcept {
    const Scalar turn = Scalar(2.0 * pi);
    return angle + turn * std::round((last - angle) / turn);
  }

  /// Angle in range that is equivalent to `angle` (+- 2 pi k) and nearest to `last` [rad]. If there
  /// is no such angle, returns the nearer end of the range.
  [[nodiscard]] Scalar nearest_angle(Scalar angle, Scalar last) const noexcept {
    const Scalar turn = Scalar(2.0 * pi);
    angle = unwrapped_angle(angle, last);
    if (angle > max_angle_) angle -= turn * std::ceil((angle - max_angle_) / turn);
    if (angle >= min_angle_) return angle;
    angle += turn * std::ceil((min_angle_ - angle) / turn);
    if (angle <= max_angle_) return angle;
    return angle - max_angle_ < min_angle_ + turn - angle ? max_angle_ : min_angle_;
  }

  /// Angle by which `angle` is beyond either end of the range [rad]; zero within the range.
  [[nodiscard]] Scalar beyond_range(Scalar angle) const noexcept {
    return std::max(Scalar(0), std::max(angle - max_angle_, min_angle_ - angle));
  }

  /// Distance [N] up to which a thrust counts as inside the set.
  [[nodiscard]] Scalar tolerance() const noexcept { return tolerance_; }

  /// Returns true if (T_l, T_v) of rotor i is within limits. Ignores the min_thrust of a tilting
  /// rotor.
  [[nodiscard]] bool contains(int i, const Vector2& thrust) const noexcept {
    if (!tilts(i))
      return thrust.y() >= min_thrust(i) - tolerance_ && thrust.y() <= max_thrust(i) + tolerance_;
    const Scalar most = max_thrust(i) + tolerance_;
    return thrust.squaredNorm() <= most * most && in_range(thrust);
  }

  /// Returns true if an angle of the servo gives the direction of `thrust`, within tolerance().
  [[nodiscard]] bool in_range(const Vector2& thrust) const noexcept {
    return cos_half_width_ < Scalar(-1) || out_of_range(thrust) <= Scalar(0);
  }

  /// Measure [N] that increases with the distance of `thrust` from the servo's range. At most 0
  /// within the range.
  [[nodiscard]] Scalar out_of_range(const Vector2& thrust) const noexcept {
    return cos_half_width_ * thrust.norm() - thrust.dot(middle_) - tolerance_;
  }

  /// Returns true if the set of a tilting rotor is convex.
  [[nodiscard]] bool convex() const noexcept { return half_width_ <= 0.5 * pi || all_round(); }
  /// Returns true if the range has the parts `lower` and `upper`.
  [[nodiscard]] bool has_parts() const noexcept { return half_width_ > 0.5 * pi; }

  /// Part whose end is nearest to `angle`.
  [[nodiscard]] AnglePart nearest_part(Scalar angle) const noexcept {
    if (!has_parts()) return AnglePart::whole;
    return max_angle_ - angle < angle - min_angle_ ? AnglePart::upper : AnglePart::lower;
  }

  /// Part whose end is within a quarter turn of `angle`, otherwise `whole`.
  [[nodiscard]] AnglePart part_of_end(Scalar angle) const noexcept {
    if (!has_parts()) return AnglePart::whole;
    const Scalar to_upper = max_angle_ - angle, to_lower = angle - min_angle_;
    if (std::min(to_upper, to_lower) > Scalar(0.5 * pi)) return AnglePart::whole;
    return to_upper < to_lower ? AnglePart::upper : AnglePart::lower;
  }

  /// `part` of the set of rotor i, in units of its max_thrust, which must not be zero. With `floor`
  /// the region keeps the rotor's min_thrust along the tilt angle `floor_angle` [rad]. All limits
  /// are widened by `widening`.
  [[nodiscard]] ThrustRegion region(int i, AnglePart part, bool floor, Scalar floor_angle,
                                    double widening) const noexcept {
    using Plane = Eigen::Vector2d;
    const double least = static_cast<double>(min_thrust(i) / max_thrust(i));
    ThrustRegion region;
    if (!tilts(i)) {
      region.radius = 0.0;
      region.add({0.0, 1.0}, least - widening);
      region.add({0.0, -1.0}, -1.0 - widening);
      region.center << 0.0, 0.5 * (1.0 + least);
      return region;
    }
    region.radius = 1.0 + widening;
    const auto unit = [](double angle) { return Plane(std::sin(angle), std::cos(angle)); };
    const auto ahead = [](double angle) { return Plane(std::cos(angle), -std::sin(angle)); };
    double low = static_cast<double>(min_angle_), high = static_cast<double>(max_angle_);
    if (has_parts()) {
      if (part == AnglePart::lower) high = low + pi;
      if (part == AnglePart::upper) low = high - pi;
    }
    const double middle = 0.5 * (low + high), half = 0.5 * (high - low);
    if (half <= 0.5 * pi + 1e-12) {
      const double apex = widening * std::sin(half);
      region.add(ahead(low), -apex);
      if (half < 0.5 * pi - 1e-9) region.add(-ahead(high), -apex);
      region.center = unit(middle) / (1.0 + std::sin(half));
    } else if (!all_round()) {
      region.add(unit(middle), std::cos(half) - widening);
      region.center = 0.5 * (1.0 + std::cos(half)) * unit(middle);
    }
    if (floor && least > 0.0) {
      // The center moves from the floor's direction towards the middle, to be inside both.
      const double angle = std::max(low, std::min(static_cast<double>(floor_angle), high));
      const double most = 0.5 * std::acos(std::min(1.0, 0.5 * (1.0 + least)));
      const double shift = std::max(-most, std::min(0.5 * (middle - angle), most));
      region.add(unit(angle), least - widening);
      region.center = 0.5 * (1.0 + least / std::cos(shift)) * unit(angle + shift);
    }
    return region;
  }

 private:
  [[nodiscard]] bool all_round() const noexcept { return half_width_ >= pi - 1e-9; }

  std::array<Scalar, static_cast<std::size_t>(Rotors)> min_thrust_{}, max_thrust_{};
  Scalar min_angle_;
  Scalar max_angle_;
  Scalar tolerance_;
  Scalar cos_half_width_;
  Vector2 middle_;
  double half_width_;
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{};
};

}  // namespace tilt_ropter::detail
