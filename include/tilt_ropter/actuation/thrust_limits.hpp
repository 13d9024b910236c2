#pragma once

#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// Which thrusts the rotors and servos of a vehicle can give, and the search for such thrusts that
/// Allocation uses when its first answer is out of limits.
namespace tilt_ropter::detail {

/// The set C of thrusts within limits: for each rotor a part of the plane of (T_l, T_v), namely
/// - servo turns all round: the disc |T| <= max_thrust,
/// - smaller servo range: the sector of that disc,
/// - rotor does not tilt: the ray T_l = 0, min_thrust <= T_v <= max_thrust,
/// with limits that are the rotor's effectiveness times those of RotorParameters.
/// min_thrust would cut a hole into the middle of a disc; so that the set stays convex the hole is
/// left to an optional floor, T . u >= min_thrust along a unit vector u given per rotor.
///
/// Sought is a point of an affine space x = base + directions y in C. It is found by minimising
/// the squared distance from C, a convex function of y (for ranges up to pi or from 2 pi on), with
/// a regularised semismooth Newton method with backtracking. Bounded, deterministic; nothing throws
/// or allocates.
template <int Rotors, typename Scalar>
class ThrustLimits {
 public:
  static constexpr int components = 2 * Rotors;
  /// Null space of an allocation of rank 6, and one column for a share of the force; those not
  /// needed are zero.
  static constexpr int max_directions = components - 5;

  /// (T_1l, T_1v, ..., T_nl, T_nv, share): the last entry is held in [0, share_width].
  using Point = Eigen::Matrix<Scalar, components + 1, 1>;
  using Directions = Eigen::Matrix<Scalar, components + 1, max_directions>;
  using Coordinates = Eigen::Matrix<Scalar, max_directions, 1>;
  using Vector2 = Eigen::Matrix<Scalar, 2, 1>;
  using Matrix2 = Eigen::Matrix<Scalar, 2, 2>;
  using Floors = std::array<Vector2, static_cast<std::size_t>(Rotors)>;

  /// An affine space; `floors` may be null.
  struct Space {
    const Directions& directions;
    const Floors* floors;
    Scalar share_width;
  };

  explicit ThrustLimits(const Vehicle<Rotors>& vehicle)
      : min_angle_(Scalar(vehicle.servo.min_angle)),
        max_angle_(Scalar(vehicle.servo.max_angle)),
        tolerance_(Scalar(100) * std::numeric_limits<Scalar>::epsilon() *
                   Scalar(largest_max_thrust(vehicle))) {
    const double middle = 0.5 * (vehicle.servo.min_angle + vehicle.servo.max_angle);
    const double half_width = 0.5 * (vehicle.servo.max_angle - vehicle.servo.min_angle);
    middle_ = direction(Scalar(middle));
    lower_edge_ = direction(Scalar(middle - half_width));
    upper_edge_ = direction(Scalar(middle + half_width));
    // Below -1 every direction is in range, without regard to rounding.
    cos_half_width_ = Scalar(half_width < pi - 1e-9 ? std::cos(half_width) : -2.0);
    convex_ = half_width <= 0.5 * pi || half_width >= pi - 1e-9;
    for (std::size_t i = 0; i < Rotors; ++i) {
      const RotorGeometry& rotor = vehicle.rotors[i];
      tilts_[i] = rotor.tilts;
      min_thrust_[i] = Scalar(rotor.effectiveness * rotor_parameters(vehicle, i).min_thrust);
      max_thrust_[i] = Scalar(rotor.effectiveness * rotor_parameters(vehicle, i).max_thrust);
    }
  }

  /// Another limit [N] of rotor i, as with another voltage, with its effectiveness counted.
  void set_max_thrust(std::size_t i, Scalar max_thrust) noexcept { max_thrust_[i] = max_thrust; }

  /// `thrust` [N] of rotor i, cut to its limits.
  [[nodiscard]] Scalar bounded_thrust(int i, Scalar thrust) const noexcept {
    const auto rotor = static_cast<std::size_t>(i);
    return std::max(min_thrust_[rotor], std::min(thrust, max_thrust_[rotor]));
  }

  /// (T_l, T_v) of unit thrust at a tilt angle [rad].
  [[nodiscard]] static Vector2 direction(Scalar angle) noexcept {
    return {std::sin(angle), std::cos(angle)};
  }

  /// The nearest angle within the servo's range [rad].
  [[nodiscard]] Scalar bounded_angle(Scalar angle) const noexcept {
    return std::max(min_angle_, std::min(angle, max_angle_));
  }

  /// The angle in range that is equivalent to `angle` (+- 2 pi k) and nearest to `last`; if there
  /// is none, the nearer end of the range.
  [[nodiscard]] Scalar nearest_angle(Scalar angle, Scalar last) const noexcept {
    const Scalar turn = Scalar(2.0 * pi);
    angle += turn * std::round((last - angle) / turn);
    if (angle > max_angle_) angle -= turn * std::ceil((angle - max_angle_) / turn);
    if (angle >= min_angle_) return angle;
    angle += turn * std::ceil((min_angle_ - angle) / turn);
    if (angle <= max_angle_) return angle;
    return angle - max_angle_ < min_angle_ + turn - angle ? max_angle_ : min_angle_;
  }

  /// Distance [N] up to which a point counts as being in the set.
  [[nodiscard]] Scalar tolerance() const noexcept { return tolerance_; }

  /// True if the base itself is within limits.
  [[nodiscard]] bool contains(const Point& base, const Space& space) const noexcept {
    return evaluate(base, space).distance2 <= tolerance_ * tolerance_;
  }

  /// Looks for the point of base + directions y within limits of small |y|, or the one
  /// nearest to them. `y` is the start and the end of the search. Returns whether `x`, the end
  /// point, is within limits, and `excess`, its vector from the set.
  bool approach(const Point& base, const Space& space, Coordinates& y, Point& x,
                Point& excess) const noexcept {
    // From a cold start a weak pull to y = 0 makes the answer unique, hence continuous in the base;
    // it is let go at the end. Weaker ones make a valley too narrow for Newton's method.
    const Scalar epsilon = std::numeric_limits<Scalar>::epsilon();
    Scalar pull = y.squaredNorm() > Scalar(0) ? Scalar(0) : Scalar(1e-3);
    Evaluation now = evaluate(x = base + space.directions * y, space);
    for (int iteration = 0; iteration < 40; ++iteration) {
      if (now.distance2 <= tolerance_ * tolerance_) break;
      Coordinates gradient = space.directions.transpose() * now.excess;
      gradient += pull * y;
      bool descends = gradient.squaredNorm() > Scalar(100) * epsilon * now.distance2;
      if (descends) {
        const Scalar value = now.distance2 + pull * y.squaredNorm();
        const auto try_step = [&](const Coordinates& step) {
          const Coordinates trial = y + step;
          const Point point = base + space.directions * trial;
          const Evaluation next = evaluate(point, space);
          if (!(next.distance2 + pull * trial.squaredNorm() < value)) return false;
          y = trial;
          x = point;
          now = next;
          return true;
        };
        Coordinates step =
            newton_step(space.directions, now, gradient, pull + Scalar(100) * epsilon);
        descends = false;
        for (int trial = 0; trial < 10 && !descends; ++trial, step /= Scalar(3))
          descends = try_step(step);
      }
      if (!descends && pull <= Scalar(0)) break;
      if (!descends) pull = Scalar(0);
    }
    excess = now.excess;
    return now.distance2 <= tolerance_ * tolerance_;
  }

  /// Largest `share` in [0, 1] for which base + share * along comes within limits, with its `y` and
  /// `x`; false if there is none. The distance from a convex set is a convex function of the
  /// share, so Newton's method on it, started at 1, comes down to the answer and never past it.
  bool largest_share(const Point& base, const Point& along, const Space& space, Scalar& share,
                     Coordinates& y, Point& x) const noexcept {
    Point excess;
    share = Scalar(1);
    bool inside = false;
    for (int iteration = 0; iteration < 20; ++iteration) {
      inside = approach(base + share * along, space, y, x, excess);
      if (inside || !(share > Scalar(0))) break;
      const Scalar slope = excess.dot(along), distance2 = excess.squaredNorm();
      share = slope * share > distance2 ? share - distance2 / slope : Scalar(0);
    }
    if (inside && (convex_ || share > Scalar(0))) return true;
    if (!approach(base, space, y, x, excess)) return false;
    // Without convexity, or at the end of the iterations above: bisection.
    Coordinates start = y;
    Scalar reached(0), upper(1);
    for (int iteration = 0; iteration < 24; ++iteration) {
      const Scalar middle = (reached + upper) / Scalar(2);
      y = start;
      if (approach(base + middle * along, space, y, x, excess)) {
        reached = middle;
        start = y;
      } else {
        upper = middle;
      }
    }
    share = reached;
    y = start;
    x = base + share * along + space.directions * y;
    return true;
  }

 private:
  struct Evaluation {
    Point excess;  ///< x minus its projection onto the set
    std::array<Matrix2, static_cast<std::size_t>(Rotors)> curvature;  ///< derivative of the excess
    Scalar share_curvature;
    Scalar distance2;
  };

  [[nodiscard]] Evaluation evaluate(const Point& x, const Space& space) const noexcept {
    Evaluation at;
    at.excess.setZero();
    for (int i = 0; i < Rotors; ++i) {
      const auto rotor = static_cast<std::size_t>(i);
      Vector2 excess = Vector2::Zero();
      Matrix2& curvature = at.curvature[rotor];
      const Scalar min_thrust = min_thrust_[rotor], max_thrust = max_thrust_[rotor];
      curvature.setZero();
      const Vector2 thrust = x.template segment<2>(2 * i);
      const Scalar size = thrust.norm();
      if (!tilts_[rotor]) {
        from_ray(thrust, Vector2(Scalar(0), Scalar(1)), min_thrust, max_thrust, excess, curvature);
      } else if (thrust.dot(middle_) < cos_half_width_ * size) {
        const bool above = thrust.x() * middle_.y() - thrust.y() * middle_.x() > Scalar(0);
        from_ray(thrust, above ? upper_edge_ : lower_edge_, Scalar(0), max_thrust, excess,
                 curvature);
      } else if (size > max_thrust) {
        const Vector2 unit = thrust / size;
        excess = (size - max_thrust) * unit;
        curvature = (max_thrust / size) * unit * unit.transpose();
        curvature.diagonal().array() += Scalar(1) - max_thrust / size;
      } else if (space.floors != nullptr) {
        const Vector2& unit = (*space.floors)[rotor];
        const Scalar missing = min_thrust - thrust.dot(unit);
        if (missing > Scalar(0)) {
          excess = -missing * unit;
          curvature = unit * unit.transpose();
        }
      }
      at.excess.template segment<2>(2 * i) = excess;
    }
    const Scalar share = x(components);
    at.excess(components) = share - std::max(Scalar(0), std::min(share, Scalar(space.share_width)));
    at.share_curvature = std::abs(at.excess(components)) > Scalar(0) ? Scalar(1) : Scalar(0);
    at.distance2 = at.excess.squaredNorm();
    return at;
  }

  static void from_ray(const Vector2& thrust, const Vector2& unit, Scalar lower, Scalar upper,
                       Vector2& excess, Matrix2& curvature) noexcept {
    const Scalar size = thrust.dot(unit);
    const Scalar bounded = std::max(lower, std::min(size, upper));
    excess = thrust - bounded * unit;
    curvature.setIdentity();
    if (size > lower && size < upper) curvature -= unit * unit.transpose();
  }

  [[nodiscard]] static Coordinates newton_step(const Directions& directions, const Evaluation& at,
                                               const Coordinates& gradient,
                                               Scalar regularisation) noexcept {
    Eigen::Matrix<Scalar, max_directions, max_directions> hessian;
    hessian.setZero();
    hessian.diagonal().setConstant(regularisation);
    for (int i = 0; i < Rotors; ++i) {
      const Matrix2& curvature = at.curvature[static_cast<std::size_t>(i)];
      if (!(curvature.squaredNorm() > Scalar(0))) continue;
      const auto rows = directions.template middleRows<2>(2 * i);
      hessian += rows.transpose().lazyProduct(curvature.lazyProduct(rows).eval());
    }
    const auto share = directions.row(components);
    hessian += at.share_curvature * share.transpose().lazyProduct(share);
    return -hessian.llt().solve(gradient);
  }

  std::array<Scalar, static_cast<std::size_t>(Rotors)> min_thrust_{}, max_thrust_{};
  Scalar min_angle_;
  Scalar max_angle_;
  Scalar tolerance_;
  Scalar cos_half_width_;
  Vector2 middle_;
  Vector2 lower_edge_;
  Vector2 upper_edge_;
  bool convex_;
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{};
};

}  // namespace tilt_ropter::detail
