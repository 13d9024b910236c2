// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/thrust_program.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// Which thrusts the rotors and servos of a vehicle can give.
namespace tilt_ropter::detail {

/// A part of a servo's range. A range wider than half a turn is not convex as a set of thrusts;
/// `lower` and `upper` are the half turns at its two ends. They are convex, and cover a range of up
/// to a whole turn. `whole` stands for the convex hull. A range of half a turn or less has only
/// `whole`.
enum class AnglePart { whole, lower, upper };

/// The set of thrusts within limits: for each rotor a part of the plane of (T_l, T_v), namely
/// - servo turns all round: the disc |T| <= max_thrust,
/// - smaller servo range: the sector of that disc,
/// - rotor does not tilt: the ray T_l = 0, min_thrust <= T_v <= max_thrust,
/// with limits that are the rotor's effectiveness times those of RotorParameters.
/// The min_thrust of a rotor that tilts would cut a hole into the disc. So that the set stays
/// convex the hole is left to an optional floor, T . u >= min_thrust along a unit vector u.
/// Nothing throws or allocates.
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
    // Below -1 every direction is in range, without regard to rounding.
    cos_half_width_ = Scalar(all_round() ? -2.0 : std::cos(half_width_));
    for (std::size_t i = 0; i < Rotors; ++i) {
      const RotorGeometry& rotor = vehicle.rotors[i];
      tilts_[i] = rotor.tilts;
      min_thrust_[i] = Scalar(rotor.effectiveness * rotor_parameters(vehicle, i).min_thrust);
      max_thrust_[i] = Scalar(rotor.effectiveness * rotor_parameters(vehicle, i).max_thrust);
    }
  }

  /// Another limit [N] of rotor i, as with another voltage, with its effectiveness counted.
  void set_max_thrust(std::size_t i, Scalar max_thrust) noexcept { max_thrust_[i] = max_thrust; }

  [[nodiscard]] bool tilts(int i) const noexcept { return tilts_[std::size_t(i)]; }
  [[nodiscard]] Scalar min_thrust(int i) const noexcept { return min_thrust_[std::size_t(i)]; }
  [[nodiscard]] Scalar max_thrust(int i) const noexcept { return max_thrust_[std::size_t(i)]; }

  /// `thrust` [N] of rotor i, cut to its limits.
  [[nodiscard]] Scalar bounded_thrust(int i, Scalar thrust) const noexcept {
    return std::max(min_thrust(i), std::min(thrust, max_thrust(i)));
  }

  /// (T_l, T_v) of unit thrust at a tilt angle [rad].
  [[nodiscard]] static Vector2 direction(Scalar angle) noexcept {
    return {std::sin(angle), std::cos(angle)};
  }

  /// The nearest angle within the servo's range [rad].
  [[nodiscard]] Scalar bounded_angle(Scalar angle) const noexcept {
    return std::max(min_angle_, std::min(angle, max_angle_));
  }

  /// The angle equivalent to `angle` (+- 2 pi k) that is nearest to `last`, in range or not [rad].
  [[nodiscard]] static Scalar unwrapped_angle(Scalar angle, Scalar last) noexcept {
    const Scalar turn = Scalar(2.0 * pi);
    return angle + turn * std::round((last - angle) / turn);
  }

  /// The angle in range that is equivalent to `angle` (+- 2 pi k) and nearest to `last`; if there
  /// is none, the nearer end of the range.
  [[nodiscard]] Scalar nearest_angle(Scalar angle, Scalar last) const noexcept {
    const Scalar turn = Scalar(2.0 * pi);
    angle = unwrapped_angle(angle, last);
    if (angle > max_angle_) angle -= turn * std::ceil((angle - max_angle_) / turn);
    if (angle >= min_angle_) return angle;
    angle += turn * std::ceil((min_angle_ - angle) / turn);
    if (angle <= max_angle_) return angle;
    return angle - max_angle_ < min_angle_ + turn - angle ? max_angle_ : min_angle_;
  }

  /// By how much `angle` is out of range, either way [rad]; zero within.
  [[nodiscard]] Scalar beyond_range(Scalar angle) const noexcept {
    return std::max(Scalar(0), std::max(angle - max_angle_, min_angle_ - angle));
  }

  /// Distance [N] up to which a thrust counts as being in the set.
  [[nodiscard]] Scalar tolerance() const noexcept { return tolerance_; }

  /// True if (T_l, T_v) of rotor i is within limits, without regard to the min_thrust of a rotor
  /// that tilts.
  [[nodiscard]] bool contains(int i, const Vector2& thrust) const noexcept {
    if (!tilts(i))
      return thrust.y() >= min_thrust(i) - tolerance_ && thrust.y() <= max_thrust(i) + tolerance_;
    const Scalar most = max_thrust(i) + tolerance_;
    return thrust.squaredNorm() <= most * most && in_range(thrust);
  }

  /// True if some angle of the servo gives the direction of `thrust`, to within tolerance().
  [[nodiscard]] bool in_range(const Vector2& thrust) const noexcept {
    return cos_half_width_ < Scalar(-1) || out_of_range(thrust) <= Scalar(0);
  }

  /// Grows with the distance of `thrust` from the servo's range; at most 0 in range [N].
  [[nodiscard]] Scalar out_of_range(const Vector2& thrust) const noexcept {
    return cos_half_width_ * thrust.norm() - thrust.dot(middle_) - tolerance_;
  }

  /// True if the set of a rotor that tilts is not convex.
  [[nodiscard]] bool convex() const noexcept { return half_width_ <= 0.5 * pi || all_round(); }
  /// True if the range has the parts `lower` and `upper`.
  [[nodiscard]] bool has_parts() const noexcept { return half_width_ > 0.5 * pi; }

  /// The part whose end is nearest to `angle`.
  [[nodiscard]] AnglePart nearest_part(Scalar angle) const noexcept {
    if (!has_parts()) return AnglePart::whole;
    return max_angle_ - angle < angle - min_angle_ ? AnglePart::upper : AnglePart::lower;
  }

  /// The part of the end that is within a quarter of a turn of `angle`, else `whole`.
  [[nodiscard]] AnglePart part_of_end(Scalar angle) const noexcept {
    if (!has_parts()) return AnglePart::whole;
    const Scalar to_upper = max_angle_ - angle, to_lower = angle - min_angle_;
    if (std::min(to_upper, to_lower) > Scalar(0.5 * pi)) return AnglePart::whole;
    return to_upper < to_lower ? AnglePart::upper : AnglePart::lower;
  }

  /// `part` of the set of rotor i, in units of its max_thrust, which must not be zero. With `floor`
  /// it keeps the rotor's min_thrust along the tilt angle `floor_angle` [rad]. All limits are wider
  /// by `widening`.
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
      // The center moves from the floor's direction towards the middle, to be inside of both.
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
