#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/rotor.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/thrust_limits.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/SVD>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

/// Control allocation (paper, Sec. Control Allocation): from a wrench to rotor speeds and tilt
/// angles and back.
namespace tilt_ropter {

enum class AllocationStatus {
  ok,               ///< the wanted wrench, by the least thrusts
  null_space_used,  ///< the wanted wrench, by other thrusts that are within limits
  angle_held,       ///< but for a rotor with almost no thrust, whose angle is still on its way
  limited,          ///< out of reach: see AllocationResult::lost
  rejected          ///< an input is not finite: the command repeats the last one, lost is zero
};

struct AllocationParameters {
  /// Thrust below which a tilt angle, undefined at zero, holds on to its last value [N].
  double hold_thrust = 0.02;
};

inline void validate(const AllocationParameters& p) {
  require_positive("AllocationParameters.hold_thrust [N]", p.hold_thrust);
}

/// What to command, what wrench it gives, and what of the wanted wrench it does not: wanted =
/// achieved + lost.
template <int Rotors, typename Scalar = double>
struct AllocationResult {
  AllocationStatus status = AllocationStatus::rejected;
  ActuatorState<Rotors, Scalar> command;  ///< always finite and within limits
  Wrench<Scalar> achieved;
  Wrench<Scalar> lost;
};

/// Time derivative of an ActuatorState.
template <int Rotors, typename Scalar = double>
struct ActuatorRates {
  Eigen::Matrix<Scalar, Rotors, 1> rotor_acceleration =
      Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< [rad/s^2]
  Eigen::Matrix<Scalar, Rotors, 1> tilt_rate =
      Eigen::Matrix<Scalar, Rotors, 1>::Zero();  ///< [rad/s]
};

/// W = A T with W = (F, M) at the CoM in the body frame and T = (T_1l, T_1v, ..., T_nl, T_nv), the
/// lateral and vertical thrusts T_il = T_i sin(alpha_i), T_iv = T_i cos(alpha_i) (paper, Eq.
/// allocation). In its rotor frame rotor i pushes along (0, -T_il, T_iv); its force f = R_i (...)
/// has the torque r_i x f - spin_i torque_ratio f. Column T_il of a rotor that does not tilt is 0.
///
/// Beyond the paper:
/// - An angle turns the nearest way from the last one, within the servo's range; where the range
///   ends it goes over to the equivalent angle (+- 2 pi) inside, if there is one.
/// - Below h = max(hold_thrust, min_thrust) an angle goes only the share (T/h)^2 of the way to its
///   target, so a path of wrenches through zero thrust turns it in many small steps; the rotor
///   pushes with what of its thrust lies along the angle.
/// - Thrusts or angles out of limits are first brought inside by the null space of A, by the least
///   change. If that fails, the torque is kept and the force scaled by the largest factor in
///   [0, 1] that can be reached; if no such factor is enough, the torque is scaled by the largest
///   factor in [0, 1], with any such share of the force. With servo ranges between pi and 2 pi
///   (not convex) or min_thrust > 0 this is a local search: limits hold and `lost` is right, but
///   the factor may be less than the largest.
///
/// The constructor throws and allocates; all else does neither. About 0.3 us per call with 4
/// rotors, a few us when limits are hit.
template <int Rotors = 4, typename Scalar = double>
class Allocation {
  static_assert(Rotors >= 3, "six components of a wrench need at least three tilting rotors");
  using Limits = detail::ThrustLimits<Rotors, Scalar>;
  using Point = typename Limits::Point;

 public:
  static constexpr int components = 2 * Rotors;
  using Matrix = Eigen::Matrix<Scalar, 6, components>;
  using Pseudoinverse = Eigen::Matrix<Scalar, components, 6>;

  /// Throws std::invalid_argument on parameters that validate() refuses and on a geometry that
  /// cannot give every wrench (rank of A below 6).
  explicit Allocation(const Vehicle<Rotors>& vehicle, const AllocationParameters& parameters = {})
      : limits_(checked(vehicle, parameters)),
        rotor_(vehicle.rotor),
        hold_thrust_(Scalar(std::max(parameters.hold_thrust, vehicle.rotor.min_thrust))),
        min_angle_(Scalar(vehicle.servo.min_angle)),
        max_angle_(Scalar(vehicle.servo.max_angle)) {
    Eigen::Matrix<double, 6, components> matrix = Eigen::Matrix<double, 6, components>::Zero();
    std::vector<int> columns;
    double size = 0.0, torque = 0.0;
    for (int i = 0; i < Rotors; ++i) {
      const RotorGeometry& rotor = vehicle.rotors[static_cast<std::size_t>(i)];
      tilts_[static_cast<std::size_t>(i)] = rotor.tilts;
      for (const int column : {2 * i, 2 * i + 1}) {
        const bool lateral = column % 2 == 0;
        if (lateral && !rotor.tilts) continue;
        const Eigen::Vector3d force = lateral ? Eigen::Vector3d(-rotor.orientation.col(1))
                                              : Eigen::Vector3d(rotor.orientation.col(2));
        const double drag = static_cast<int>(rotor.spin) * vehicle.rotor.torque_ratio;
        matrix.col(column) << force, rotor.position.cross(force) - drag * force;
        columns.push_back(column);
      }
      size = std::max(size, rotor.position.norm() + vehicle.rotor.torque_ratio);
      torque += (rotor.position.norm() + vehicle.rotor.torque_ratio) * vehicle.rotor.max_thrust;
    }
    max_force_ = Scalar(Rotors * vehicle.rotor.max_thrust);
    max_torque_ = Scalar(torque);
    matrix_ = matrix.template cast<Scalar>();
    invert(matrix, columns, size);
  }

  /// A, 6 x 2n; columns T_1l, T_1v, ..., rows F [1], M [m].
  [[nodiscard]] const Matrix& matrix() const noexcept { return matrix_; }
  /// Moore-Penrose inverse of A, 2n x 6.
  [[nodiscard]] const Pseudoinverse& pseudoinverse() const noexcept { return pseudoinverse_; }

  /// Wrench that rotors apply at given speeds and tilt angles, measured, modelled or commanded.
  /// `Value` may be an automatic-differentiation scalar. A rotor whose speed or angle is not finite
  /// counts as standing still.
  template <typename Value>
  [[nodiscard]] Wrench<Value> wrench(const ActuatorState<Rotors, Value>& actuators) const noexcept {
    using std::cos;
    using std::sin;
    Eigen::Matrix<Value, components, 1> thrusts = Eigen::Matrix<Value, components, 1>::Zero();
    for (int i = 0; i < Rotors; ++i) {
      const Value thrust = thrust_from_speed(actuators.rotor_speed(i), rotor_.thrust_coefficient);
      if (!tilts_[static_cast<std::size_t>(i)]) {
        thrusts(2 * i + 1) = thrust;
      } else if (actuators.tilt_angle.template segment<1>(i).allFinite()) {
        thrusts(2 * i) = thrust * sin(actuators.tilt_angle(i));
        thrusts(2 * i + 1) = thrust * cos(actuators.tilt_angle(i));
      }
    }
    const Eigen::Matrix<Value, 6, 1> packed = matrix_.template cast<Value>() * thrusts;
    return {packed.template head<3>(), packed.template tail<3>()};
  }

  /// Speeds and angles that give `wanted`, as near as limits allow. `last` is what was commanded
  /// before (at the start: what is measured), from which angles turn the nearest way.
  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate(
      const Wrench<Scalar>& wanted, const ActuatorState<Rotors, Scalar>& last) const noexcept {
    AllocationResult<Rotors, Scalar> result;
    const bool usable =
        is_finite(wanted) && last.rotor_speed.allFinite() && last.tilt_angle.allFinite();
    if (!usable) {
      result.command = within_limits(last);
      result.achieved = wrench(result.command);
      return result;
    }
    Point x;
    result.status = thrusts_within_limits(wanted, last, x);
    for (int i = 0; i < Rotors; ++i) {
      auto thrust = x.template segment<2>(2 * i);
      const bool tilts = tilts_[static_cast<std::size_t>(i)];
      const Scalar angle = tilts ? next_angle(thrust, last.tilt_angle(i)) : Scalar(0);
      const auto unit = Limits::direction(angle);
      const Scalar size = std::max(Scalar(rotor_.min_thrust),
                                   std::min(thrust.dot(unit), Scalar(rotor_.max_thrust)));
      const Scalar missed = (thrust - size * unit).norm();
      if (missed > Scalar(4) * limits_.tolerance() && result.status != AllocationStatus::limited)
        result.status = missed <= hold_thrust_ && size > Scalar(rotor_.min_thrust)
                            ? AllocationStatus::angle_held
                            : AllocationStatus::limited;
      thrust = size * unit;
      result.command.rotor_speed(i) = speed_from_thrust(size, rotor_.thrust_coefficient);
      result.command.tilt_angle(i) = angle;
    }
    const Eigen::Matrix<Scalar, 6, 1> achieved = matrix_ * x.template head<components>();
    result.achieved = {achieved.template head<3>(), achieved.template tail<3>()};
    result.lost = {wanted.force - result.achieved.force, wanted.torque - result.achieved.torque};
    return result;
  }

  /// Rates of angles and speeds that follow a wrench rate [N/s, N m/s] without limits (paper, Eq.
  /// allocation_inverse). At thrusts T below h = hold_thrust the denominators T^2 and T stay at h^2
  /// and h, so everything is finite and falls to zero with T. Inputs that are not finite or
  /// overflow give zero rates.
  [[nodiscard]] ActuatorRates<Rotors, Scalar> rates(
      const Wrench<Scalar>& wrench, const Wrench<Scalar>& wrench_rate) const noexcept {
    const auto thrusts = least_thrusts(wrench.force, wrench.torque);
    const auto slopes = least_thrusts(wrench_rate.force, wrench_rate.torque);
    ActuatorRates<Rotors, Scalar> rates;
    for (int i = 0; i < Rotors; ++i) {
      const Scalar lateral = thrusts(2 * i), vertical = thrusts(2 * i + 1);
      const Scalar size = std::max(hold_thrust_, std::hypot(lateral, vertical));
      rates.tilt_rate(i) = (slopes(2 * i) * vertical - lateral * slopes(2 * i + 1)) / (size * size);
      const Scalar thrust_rate = (slopes(2 * i) * lateral + slopes(2 * i + 1) * vertical) / size;
      rates.rotor_acceleration(i) =
          thrust_rate / (Scalar(2) * std::sqrt(Scalar(rotor_.thrust_coefficient) * size));
    }
    if (!rates.tilt_rate.allFinite() || !rates.rotor_acceleration.allFinite()) return {};
    return rates;
  }

 private:
  using Vector2 = typename Limits::Vector2;

  [[nodiscard]] static const Vehicle<Rotors>& checked(const Vehicle<Rotors>& vehicle,
                                                      const AllocationParameters& parameters) {
    validate(vehicle);
    validate(parameters);
    return vehicle;
  }

  /// Pseudo-inverse and null space, without the columns that no rotor has. Torques are measured in
  /// units of `size` [m] times a force, so that the rank is that of the shape and not of its size.
  void invert(const Eigen::Matrix<double, 6, components>& matrix, const std::vector<int>& columns,
              double size) {
    Eigen::Matrix<double, 6, 1> scale;
    scale << 1.0, 1.0, 1.0, Eigen::Vector3d::Constant(1.0 / std::max(size, 1e-9));
    const auto count = static_cast<Eigen::Index>(columns.size());
    Eigen::MatrixXd scaled(6, count);
    for (Eigen::Index j = 0; j < count; ++j)
      scaled.col(j) = scale.asDiagonal() * matrix.col(columns[static_cast<std::size_t>(j)]);
    Eigen::JacobiSVD<Eigen::MatrixXd> svd(scaled, Eigen::ComputeFullU | Eigen::ComputeFullV);
    svd.setThreshold(1e-6);
    require_rank(svd.matrixU(), svd.rank());

    const Eigen::MatrixXd inverse = svd.matrixV().leftCols(6) *
                                    svd.singularValues().cwiseInverse().asDiagonal() *
                                    svd.matrixU().transpose() * scale.asDiagonal();
    pseudoinverse_.setZero();
    null_space_.setZero(components + 1, count - 6);
    for (Eigen::Index j = 0; j < count; ++j) {
      const int row = columns[static_cast<std::size_t>(j)];
      pseudoinverse_.row(row) = inverse.row(j).template cast<Scalar>();
      null_space_.row(row) = svd.matrixV().row(j).tail(count - 6).template cast<Scalar>();
    }
  }

  static void require_rank(const Eigen::MatrixXd& left, Eigen::Index rank) {
    static constexpr const char* names[] = {"force x",  "force y",  "force z",
                                            "torque x", "torque y", "torque z"};
    std::string missing;
    for (int axis = 0; axis < 6 && rank < 6; ++axis)
      if (left.row(axis).tail(6 - rank).norm() > 1e-6)
        missing += (missing.empty() ? "" : ", ") + std::string(names[axis]);
    require(rank == 6, "rank of Allocation.matrix()", rank,
            "6, but " + std::to_string(6 - rank) +
                " direction(s) of the wrench cannot be produced; out of reach by themselves: " +
                missing);
  }

  [[nodiscard]] Eigen::Matrix<Scalar, components, 1> least_thrusts(
      const Vector3<Scalar>& force, const Vector3<Scalar>& torque) const noexcept {
    return pseudoinverse_.template leftCols<3>() * force +
           pseudoinverse_.template rightCols<3>() * torque;
  }

  [[nodiscard]] AllocationStatus thrusts_within_limits(const Wrench<Scalar>& wanted,
                                                       const ActuatorState<Rotors, Scalar>& last,
                                                       Point& x) const noexcept;

  /// Tilt angle for a thrust vector, seen from the last one.
  [[nodiscard]] Scalar next_angle(const Vector2& thrust, Scalar last) const noexcept {
    last = std::max(min_angle_, std::min(last, max_angle_));
    const Scalar target = nearest_angle(std::atan2(thrust.x(), thrust.y()), last);
    const Scalar weight = thrust.squaredNorm() / (hold_thrust_ * hold_thrust_);
    return weight < Scalar(1) ? last + weight * (target - last) : target;
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

  [[nodiscard]] ActuatorState<Rotors, Scalar> within_limits(
      const ActuatorState<Rotors, Scalar>& last) const noexcept {
    const Scalar slowest = speed_from_thrust(Scalar(rotor_.min_thrust), rotor_.thrust_coefficient);
    const Scalar fastest = speed_from_thrust(Scalar(rotor_.max_thrust), rotor_.thrust_coefficient);
    ActuatorState<Rotors, Scalar> command;
    for (int i = 0; i < Rotors; ++i) {
      const Scalar speed = last.rotor_speed(i), angle = last.tilt_angle(i);
      command.rotor_speed(i) =
          std::isfinite(speed) ? std::max(slowest, std::min(speed, fastest)) : slowest;
      if (tilts_[static_cast<std::size_t>(i)])
        command.tilt_angle(i) =
            std::max(min_angle_, std::min(std::isfinite(angle) ? angle : Scalar(0), max_angle_));
    }
    return command;
  }

  Limits limits_;
  RotorParameters rotor_;
  Scalar hold_thrust_;
  Scalar min_angle_;
  Scalar max_angle_;
  Scalar max_force_{};
  Scalar max_torque_{};
  Matrix matrix_;
  Pseudoinverse pseudoinverse_;
  typename Limits::Directions null_space_;
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{};
};

template <int Rotors>
Allocation(const Vehicle<Rotors>&) -> Allocation<Rotors, double>;
template <int Rotors>
Allocation(const Vehicle<Rotors>&, const AllocationParameters&) -> Allocation<Rotors, double>;

/// Writes the thrusts to command to `x`, by the ladder of the class comment.
template <int Rotors, typename Scalar>
AllocationStatus Allocation<Rotors, Scalar>::thrusts_within_limits(
    const Wrench<Scalar>& wanted, const ActuatorState<Rotors, Scalar>& last,
    Point& x) const noexcept {
  // Forces and torques out of any reach are shortened first, which changes no answer and keeps
  // the arithmetic from overflowing.
  const auto shorten = [](const Vector3<Scalar>& v, Scalar limit) {
    const Scalar size = v.stableNorm();
    return size > limit ? Vector3<Scalar>(v / size * limit) : v;
  };
  Point force = Point::Zero(), torque = Point::Zero();
  force.template head<components>() =
      least_thrusts(shorten(wanted.force, Scalar(2) * max_force_), Vector3<Scalar>::Zero());
  torque.template head<components>() =
      least_thrusts(Vector3<Scalar>::Zero(), shorten(wanted.torque, Scalar(2) * max_torque_));

  typename Limits::Floors floors;
  x = force + torque;
  if (rotor_.min_thrust > 0.0) {
    for (int i = 0; i < Rotors; ++i) {
      const Vector2 thrust = x.template segment<2>(2 * i);
      floors[static_cast<std::size_t>(i)] =
          Limits::direction(next_angle(thrust, last.tilt_angle(i)));
    }
  }
  const typename Limits::Space plain{null_space_, nullptr, Scalar(0)};
  const typename Limits::Space floored{null_space_, rotor_.min_thrust > 0.0 ? &floors : nullptr,
                                       Scalar(0)};
  if (limits_.contains(x, floored)) return AllocationStatus::ok;

  typename Limits::Coordinates y = Limits::Coordinates::Zero(null_space_.cols());
  Point excess;
  if (limits_.approach(force + torque, floored, y, x, excess))
    return AllocationStatus::null_space_used;

  Scalar share;
  y.setZero();
  if (limits_.largest_share(torque, force, plain, share, y, x)) return AllocationStatus::limited;

  // The force, at right angles to the null space, becomes one more direction; its share of [0, 1]
  // is the last component, at the same scale.
  const Scalar size = force.norm();
  typename Limits::Directions directions(components + 1, null_space_.cols() + 1);
  directions << null_space_, force;
  directions(components, null_space_.cols()) = size;
  if (size > Scalar(0)) directions.col(null_space_.cols()) /= std::sqrt(Scalar(2)) * size;
  y.setZero(directions.cols());
  limits_.largest_share(Point::Zero(), torque, {directions, nullptr, size}, share, y, x);
  return AllocationStatus::limited;
}

}  // namespace tilt_ropter
