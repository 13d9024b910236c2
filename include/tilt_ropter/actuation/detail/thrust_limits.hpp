// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// Thrusts that the rotors and servos of a vehicle can give.
namespace tilt_ropter::detail {

/// Convex set of thrusts of one rotor, in units of its largest thrust. The set has the half-planes
/// normal . t >= offset and, if `radius` is not zero, the disc |t| <= radius.
struct ThrustRegion {
  static constexpr int most = 3;

  Eigen::Vector2d center = Eigen::Vector2d::Zero();  ///< strictly inside the set
  std::array<Eigen::Vector2d, most> normal;
  std::array<double, most> offset{};
  int half_planes = 0;
  double radius = 1.0;

  void add(const Eigen::Vector2d& inward, double least) noexcept {
    normal[size(half_planes)] = inward;
    offset[size(half_planes)] = least;
    ++half_planes;
  }
};

/// Minimises a linear or a quadratic function of the variables z. The thrusts
/// t_i(z) = base_i + columns_i z must be in the region of each rotor i. The last `Bounded`
/// variables must satisfy lower < z < upper.
///
/// The method is a primal-dual interior-point method with feasible iterates (Boyd and Vandenberghe,
/// Convex Optimization, 2004, Sec. 11.7). Every iterate is strictly inside all constraints, so a
/// search that ends early still gives valid thrusts. Work and memory are bounded, and the result is
/// deterministic. Nothing throws or allocates.
template <int Rotors, int Variables, int Bounded>
class ThrustProgram {
 public:
  using Vector = Eigen::Matrix<double, Variables, 1>;
  static constexpr int first_bounded = Variables - Bounded;
  static constexpr int max_iterations = 80;

  /// Rows 2i and 2i + 1 belong to rotor i. They are zero for a rotor that `used` excludes.
  Eigen::Matrix<double, 2 * Rotors, 1> base;
  Eigen::Matrix<double, 2 * Rotors, Variables> columns;
  std::array<ThrustRegion, size(Rotors)> regions;
  std::array<bool, size(Rotors)> used{};
  std::array<double, size(Bounded)> lower{}, upper{};
  bool cautious = false;  ///< smaller steps, which converge in a few more cases

  /// Fixes variable `j` at its value in `z`.
  void fix(int j, const Vector& z) noexcept {
    for (int i = 0; i < 2 * Rotors; ++i) {
      base(i) += z(j) * columns(i, j);
      columns(i, j) = 0.0;
    }
    free_[size(j)] = false;
  }
  void release(int j) noexcept { free_[size(j)] = true; }
  [[nodiscard]] bool is_free(int j) const noexcept { return free_[size(j)]; }
  /// t(z), in units of `base`.
  [[nodiscard]] Eigen::Matrix<double, 2 * Rotors, 1> thrusts(const Vector& z) const noexcept {
    Thrusts t = base;
    add_product<2 * Rotors, Variables, 1>(columns.data(), entries(z), t.data());
    return t;
  }

  /// Moves `z`, which must be strictly inside, so that sign z(j) increases. Returns true where z(j)
  /// reaches `goal`; then z(j) = goal exactly. Returns false where the duality gap falls below
  /// `tolerance`. With `only_goal` it also returns false where the gap excludes the goal.
  [[nodiscard]] bool push(int j, double sign, double goal, bool only_goal, double tolerance,
                          Vector& z) const noexcept {
    Vector cost = Vector::Zero();
    cost(j) = -sign;
    return minimise(cost, 0.0, z, tolerance, {j, sign, goal, only_goal});
  }

  /// Moves `z` to the point of least |z| over the free variables before `first_bounded`.
  void shorten(double tolerance, Vector& z) const noexcept {
    (void)minimise(Vector::Zero(), 1.0, z, tolerance, {-1, 0.0, 0.0, false});
  }

 private:
  static constexpr int per_rotor = ThrustRegion::most + 1;
  static constexpr int constraints = Rotors * per_rotor + 2 * Bounded;
  using Numbers = std::array<double, size(constraints)>;
  using Thrusts = Eigen::Matrix<double, 2 * Rotors, 1>;

  /// Calls plane(k, row, normal, offset) for each half-plane and disc(k, row, radius) for each
  /// disc. Calls bound(k, variable, side, shift) for each bound side z + shift > 0. k counts
  /// constraints. `row` is the first row of the rotor. Returns the number of constraints.
  template <typename Plane, typename Disc, typename Bound>
  std::size_t each(const Plane& plane, const Disc& disc, const Bound& bound) const noexcept {
    std::size_t k = 0;
    for (std::size_t i = 0; i < Rotors; ++i) {
      if (!used[i]) continue;
      const ThrustRegion& region = regions[i];
      for (int p = 0; p < region.half_planes; ++p)
        plane(k++, static_cast<Eigen::Index>(2 * i), region.normal[size(p)],
              region.offset[size(p)]);
      if (region.radius > 0.0) disc(k++, static_cast<Eigen::Index>(2 * i), region.radius);
    }
    for (std::size_t b = 0; b < Bounded; ++b) {
      const auto j = static_cast<Eigen::Index>(b) + first_bounded;
      if (!free_[size(j)]) continue;
      bound(k++, j, 1.0, -lower[b]);
      bound(k++, j, -1.0, upper[b]);
    }
    return k;
  }

  /// Computes the slack of each constraint, > 0 inside. Returns the number of constraints.
  std::size_t slacks(const Vector& z, const Thrusts& t, Numbers& slack) const noexcept {
    return each(
        [&](std::size_t k, Eigen::Index row, const Eigen::Vector2d& normal, double offset) {
          slack[k] = normal.x() * t(row) + normal.y() * t(row + 1) - offset;
        },
        [&](std::size_t k, Eigen::Index row, double radius) {
          const double size = std::sqrt(t(row) * t(row) + t(row + 1) * t(row + 1));
          slack[k] = 0.5 * (radius - size) * (radius + size);
        },
        [&](std::size_t k, Eigen::Index j, double sign, double shift) {
          slack[k] = sign * z(j) + shift;
        });
  }

  /// Writes the slacks at `z` and returns true if all of them are > 0.
  bool inside(const Vector& z, Numbers& slack) const noexcept {
    const std::size_t count = slacks(z, thrusts(z), slack);
    bool all = true;
    for (std::size_t k = 0; k < count; ++k) all = all && slack[k] > 0.0;
    return all;
  }

  struct Target {
    int variable;
    double sign, goal;
    bool only_goal;
  };

  /// Minimises cost . z + weight |z|^2 / 2, with the square over the variables before
  /// `first_bounded`. Returns true if it ends at the target.
  bool minimise(const Vector& cost, double weight, Vector& z, double tolerance,
                const Target& target) const noexcept {
    Numbers slack, multiplier, change;
    Thrusts t = thrusts(z);
    const std::size_t count = slacks(z, t, slack);
    const auto constraint_count = static_cast<double>(count);
    // Start on the central path, with a duality gap of the size of the cost.
    const double first_gap =
        std::max(std::sqrt(cost.squaredNorm()) + weight * std::sqrt(z.squaredNorm()), 1e-6);
    for (std::size_t k = 0; k < count; ++k) multiplier[k] = first_gap / constraint_count / slack[k];

    double last_length = 1.0;
    for (int iteration = 0; iteration < max_iterations; ++iteration) {
      double gap = 0.0;
      for (std::size_t k = 0; k < count; ++k) gap += multiplier[k] * slack[k];

      // Gradient of the Lagrangian, gradient of the barrier sum log(slack), and reduced Hessian.
      // The terms of the rotors are first summed in each rotor's plane.
      Vector gradient = cost, barrier = Vector::Zero();
      Eigen::Matrix<double, Variables, Variables> hessian;
      hessian.setZero();
      for (int j = 0; j < first_bounded; ++j) {
        gradient(j) += weight * z(j);
        hessian(j, j) = weight;
      }
      const Vector cost_gradient = gradient;
      Thrusts thrust_gradient = Thrusts::Zero(), thrust_barrier = Thrusts::Zero();
      std::array<double, size(Rotors)> xx{}, xy{}, yy{};
      const auto add = [&](std::size_t k, Eigen::Index row, double x, double y) {
        const auto rotor = size(row / 2);
        const double ratio = multiplier[k] / slack[k];
        thrust_gradient(row) -= multiplier[k] * x;
        thrust_gradient(row + 1) -= multiplier[k] * y;
        thrust_barrier(row) += x / slack[k];
        thrust_barrier(row + 1) += y / slack[k];
        xx[rotor] += ratio * x * x;
        xy[rotor] += ratio * x * y;
        yy[rotor] += ratio * y * y;
      };
      each([&](std::size_t k, Eigen::Index row, const Eigen::Vector2d& normal,
               double) { add(k, row, normal.x(), normal.y()); },
           [&](std::size_t k, Eigen::Index row, double) {
             add(k, row, -t(row), -t(row + 1));
             xx[size(row / 2)] += multiplier[k];
             yy[size(row / 2)] += multiplier[k];
           },
           [&](std::size_t k, Eigen::Index j, double side, double) {
             gradient(j) -= multiplier[k] * side;
             barrier(j) += side / slack[k];
             hessian(j, j) += multiplier[k] / slack[k];
           });
      // Row vectors times the columns.
      add_product<1, 2 * Rotors, Variables>(thrust_gradient.data(), entries(columns),
                                            gradient.data());
      add_product<1, 2 * Rotors, Variables>(thrust_barrier.data(), entries(columns),
                                            barrier.data());
      const double residual = std::sqrt(gradient.squaredNorm());
      if (gap < tolerance && (residual < 1e-3 * tolerance + 1e-12 || gap < 1e-4 * tolerance))
        return false;
      const bool aims = target.variable >= 0;
      const double ahead = aims ? target.sign * (target.goal - z(target.variable)) : 0.0;
      if (target.only_goal && residual < 1e-6 && ahead > gap + 10.0 * residual + tolerance)
        return false;
      for (int i = 0; i < Rotors; ++i) {
        const auto rotor = size(i);
        if (!used[rotor]) continue;
        for (int j = 0; j < Variables; ++j) {
          const double a = columns(2 * i, j), b = columns(2 * i + 1, j);
          const double x = xx[rotor] * a + xy[rotor] * b, y = xy[rotor] * a + yy[rotor] * b;
          for (int l = 0; l <= j; ++l)
            hessian(j, l) += columns(2 * i, l) * x + columns(2 * i + 1, l) * y;
        }
      }

      // A short step means that the iterate is off the central path. The next one leads back.
      const double centering = cautious            ? 0.5
                               : last_length > 0.7 ? 0.1
                               : last_length > 0.3 ? 0.4
                                                   : 0.9;
      const double mu = centering * gap / constraint_count;
      Vector step;
      for (int j = 0; j < Variables; ++j) step(j) = mu * barrier(j) - cost_gradient(j);
      factorise(hessian);  // directions without curvature get a zero step
      solve_factorised(hessian, step.data());
      for (int j = 0; j < Variables; ++j)
        if (!is_free(j)) step(j) = 0.0;

      // Longest steps that keep slacks and multipliers positive.
      Thrusts move = Filled();
      add_product<2 * Rotors, Variables, 1>(columns.data(), entries(step), move.data());
      double longest = 1e3, dual_longest = 1.0;
      const auto limit_step = [&](std::size_t k, double slope, double square) {
        // The slack after a step of length a is slack + a slope - a^2 square / 2.
        change[k] = mu / slack[k] - multiplier[k] * slope / slack[k] - multiplier[k];
        if (change[k] < 0.0) dual_longest = std::min(dual_longest, -multiplier[k] / change[k]);
        if (square > 0.0) {
          const double root = std::sqrt(slope * slope + 2.0 * square * slack[k]);
          longest = std::min(
              longest, slope > 0.0 ? (slope + root) / square : 2.0 * slack[k] / (root - slope));
        } else if (slope < 0.0) {
          longest = std::min(longest, -slack[k] / slope);
        }
      };
      each([&](std::size_t k, Eigen::Index row, const Eigen::Vector2d& normal,
               double) { limit_step(k, normal.x() * move(row) + normal.y() * move(row + 1), 0.0); },
           [&](std::size_t k, Eigen::Index row, double) {
             limit_step(k, -(t(row) * move(row) + t(row + 1) * move(row + 1)),
                        move(row) * move(row) + move(row + 1) * move(row + 1));
           },
           [&](std::size_t k, Eigen::Index j, double side, double) {
             limit_step(k, side * step(j), 0.0);
           });
      const auto after = [&z, &step](double length) {
        Vector there;
        for (int j = 0; j < Variables; ++j) there(j) = z(j) + length * step(j);
        return there;
      };
      double length = std::min({1.0, 0.95 * longest, 0.95 * dual_longest});
      if (aims) {
        const double progress = target.sign * step(target.variable);
        const double to_goal = ahead / progress;
        if (progress > 0.0 && to_goal <= std::max(length, 0.9 * longest)) {
          Vector there = after(to_goal);
          there(target.variable) = target.goal;
          if (to_goal <= length || inside(there, slack)) {
            z = there;
            return true;
          }
        }
      }
      // Rounding may put a step outside if the feasible region is as thin as rounding errors.
      Vector next = after(length);
      bool stays = inside(next, slack);
      for (int halving = 0; halving < 4 && !stays; ++halving) {
        length *= 0.5;
        next = after(length);
        stays = inside(next, slack);
      }
      if (!stays) return false;
      z = next;
      t = thrusts(z);
      last_length = length;
      for (std::size_t k = 0; k < count; ++k) multiplier[k] += length * change[k];
    }
    return false;
  }

  std::array<bool, size(Variables)> free_{};
};

/// Part of a servo's range. The set of thrusts of a range wider than half a turn is not convex.
/// `lower` and `upper` are the half turns at the two ends of the range. They are convex and cover a
/// range of up to a whole turn. `whole` is the convex hull. Half a turn or less has only `whole`.
enum class AnglePart { whole, lower, upper };

/// Set of thrusts within limits. For each rotor the set is a part of the plane of (T_l, T_v):
/// - servo turns all round: the disc |T| <= max_thrust,
/// - smaller servo range: the sector of that disc,
/// - rotor does not tilt: the segment T_l = 0, min_thrust <= T_v <= max_thrust.
///
/// The limits are the limits of RotorParameters times the rotor's effectiveness.
///
/// The min_thrust of a tilting rotor would cut a hole into the disc. To keep the set convex, a
/// floor T . u >= min_thrust along a unit vector u may replace it. Nothing throws or allocates.
template <int Rotors, typename Scalar>
class ThrustLimits {
 public:
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

  /// Sets another limit [N] of rotor i, which includes the effectiveness.
  void set_max_thrust(std::size_t i, Scalar max_thrust) noexcept { max_thrust_[i] = max_thrust; }

  [[nodiscard]] bool tilts(int i) const noexcept { return tilts_[std::size_t(i)]; }
  [[nodiscard]] Scalar min_thrust(int i) const noexcept { return min_thrust_[std::size_t(i)]; }
  [[nodiscard]] Scalar max_thrust(int i) const noexcept { return max_thrust_[std::size_t(i)]; }

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

  /// True if (T_l, T_v) of rotor i is within limits, except for the min_thrust of a tilting rotor.
  [[nodiscard]] bool contains(int i, const Vector2& thrust) const noexcept {
    if (!tilts(i))
      return thrust.y() >= min_thrust(i) - tolerance_ && thrust.y() <= max_thrust(i) + tolerance_;
    const Scalar most = max_thrust(i) + tolerance_;
    return thrust.squaredNorm() <= most * most &&
           (cos_half_width_ < Scalar(-1) || out_of_range(thrust) <= Scalar(0));
  }

  /// Increases with the distance of `thrust` from the servo's range, at most 0 within it [N].
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

  std::array<Scalar, size(Rotors)> min_thrust_{}, max_thrust_{};
  Scalar min_angle_;
  Scalar max_angle_;
  Scalar tolerance_;
  Scalar cos_half_width_;
  Vector2 middle_;
  double half_width_;
  std::array<bool, size(Rotors)> tilts_{};
};

}  // namespace tilt_ropter::detail
