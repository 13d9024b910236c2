#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/actuation/thrust_limits.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>

/// Control allocation (paper, Sec. Control Allocation): from a wrench to rotor speeds and tilt
/// angles and back.
namespace tilt_ropter {

/// How the wanted wrench was come by.
enum class AllocationStatus {
  ok,               ///< the wanted wrench, by the least thrusts
  null_space_used,  ///< the wanted wrench, by other thrusts that are within limits
  angle_held,       ///< but for rotors of almost no thrust; lost is at most 2 h for each
  limited,          ///< out of reach; force or torque were scaled
  rejected          ///< the wrench is not finite: the command repeats the last one, lost is zero
};

/// What Allocation does beyond the inverse of the matrix.
struct AllocationParameters {
  /// Thrust below which a tilt angle, undefined at zero, holds on to its last value [N].
  double hold_thrust = 0.02;
  /// Share of the actuators' time constants by which commands run ahead of a moving wrench, so that
  /// first-order lags arrive with it: 1 inverts them, 0 leaves them.
  double lag_compensation = 1.0;
  /// Thrust below which an angle runs ahead by less, falling with the thrust's square: its rate is
  /// mostly noise there, and lags matter little. As a share of one rotor's thrust in hover.
  double calm_share = 0.1;
};

inline void validate(const AllocationParameters& p) {
  require_positive("AllocationParameters.hold_thrust [N]", p.hold_thrust);
  require_in("AllocationParameters.lag_compensation", p.lag_compensation, 0.0, 1.0);
  require_positive("AllocationParameters.calm_share", p.calm_share);
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

/// Allocation for any number of tilting or fixed rotors, by the Moore-Penrose inverse of
/// AllocationMatrix, computed once.
///
/// Beyond the paper:
/// - An angle turns the nearest way from the last one, within the servo's range; where the range
///   ends it goes over to the equivalent angle (+- 2 pi) inside, if there is one.
/// - Below h = max(hold_thrust, min_thrust) an angle goes only the share (T/h)^2 of the way to its
///   target, so a path of wrenches through zero thrust turns it in many small steps; meanwhile
///   the rotor pushes with what of its thrust lies along the angle, and with min_thrust at least.
/// - Thrusts or angles out of limits are first brought inside by the null space of A, by the least
///   change. If that fails, the torque is kept and the force scaled by the largest factor in
///   [0, 1] that can be reached; if there is none, the torque is first scaled by the largest factor
///   that some scaled force allows. So a direction that no thrusts have (fixed rotors, servo ranges
///   below 2 pi) ends at zero. With ranges between pi and 2 pi, not a convex set, the factors may
///   be less than the largest; a tilting rotor's min_thrust is enforced after the scaling. In any
///   case limits hold and `lost` says what was given up.
///
/// A rotor of effectiveness e < 1 turns faster for the same thrust, 1 / sqrt(e) times without a
/// linear term, and has that share of the limits; a lost one is told the slowest speed and its
/// angle stays. A stuck servo is a fixed rotor (with_stuck_servo): the rest is the null space's and
/// the ladder's of above.
///
/// Each rotor has the curve, limits and lag of rotor_parameters(). The limits are those of the last
/// voltage that set_voltage() took, at the start of the nominal one.
///
/// The constructor throws and allocates; all else does neither. About 0.3 us per call with 4
/// rotors, 1 to 9 us when limits are hit.
template <int Rotors = 4, typename Scalar = double>
class Allocation {
  using Limits = detail::ThrustLimits<Rotors, Scalar>;
  using Point = typename Limits::Point;

 public:
  static constexpr int components = 2 * Rotors;
  using Matrix = Eigen::Matrix<Scalar, 6, components>;
  using Pseudoinverse = Eigen::Matrix<Scalar, components, 6>;

  /// Throws std::invalid_argument on parameters that validate() refuses and on a geometry that
  /// cannot give every wrench (rank of A below 6).
  explicit Allocation(const Vehicle<Rotors>& vehicle, const AllocationParameters& parameters = {});

  /// A of AllocationMatrix, 6 x 2n, and its Moore-Penrose inverse, 2n x 6.
  [[nodiscard]] const Matrix& matrix() const noexcept { return matrix_; }
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
      const Value thrust = thrust_from_speed(actuators.rotor_speed(i), rotor(i));
      if (!tilts_[static_cast<std::size_t>(i)]) {
        thrusts(2 * i + 1) = thrust;
      } else if (all_finite(actuators.tilt_angle.template segment<1>(i))) {
        thrusts(2 * i) = thrust * sin(actuators.tilt_angle(i));
        thrusts(2 * i + 1) = thrust * cos(actuators.tilt_angle(i));
      }
    }
    const Eigen::Matrix<Value, 6, 1> packed = matrix_.template cast<Value>() * thrusts;
    return {packed.template head<3>(), packed.template tail<3>()};
  }

  /// Takes the measured `voltage` of the battery [V]: the next commands keep to the top speeds and
  /// thrusts that max_thrust_at() leaves. Returns whether voltage_ratio() accepts it; if not, the
  /// last one holds.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(battery_, voltage);
    if (!ratio) return false;
    for (std::size_t i = 0; i < Rotors; ++i) {
      const Scalar max_thrust = Scalar(max_thrust_at(rotors_[i], *ratio));
      max_speed_[i] = speed_from_thrust(max_thrust, rotors_[i]);
      limits_.set_max_thrust(i, max_thrust);  // of a lost rotor, too, whose thrust is zero anyway
    }
    return true;
  }

  /// Speeds and angles that give `wanted`, as near as limits allow. `last` is what was commanded
  /// before (at the start: what is measured), from which angles turn the nearest way.
  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate(
      const Wrench<Scalar>& wanted, const ActuatorState<Rotors, Scalar>& last) const noexcept;

  /// The same for a wrench that moves at `rate` [N/s, N m/s]: speeds and angles run ahead by the
  /// share lag_compensation of their time constants, within limits and the servo's rate.
  /// `achieved` and `lost` are those of the wrench now, without the lead.
  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate(
      const Wrench<Scalar>& wanted, const Wrench<Scalar>& rate,
      const ActuatorState<Rotors, Scalar>& last) const noexcept;

  /// Rates of angles and speeds that follow a wrench rate [N/s, N m/s] without limits (paper, Eq.
  /// allocation_inverse). At thrusts T below h the denominators T^2 and T stay at h^2
  /// and h, so everything is finite and falls to zero with T. Inputs that are not finite or
  /// overflow give zero rates.
  [[nodiscard]] ActuatorRates<Rotors, Scalar> rates(
      const Wrench<Scalar>& wrench, const Wrench<Scalar>& wrench_rate) const noexcept;

 private:
  using Vector2 = typename Limits::Vector2;

  [[nodiscard]] static const Vehicle<Rotors>& checked(const Vehicle<Rotors>& vehicle,
                                                      const AllocationParameters& parameters) {
    validate(vehicle);
    validate(parameters);
    return vehicle;
  }

  [[nodiscard]] Eigen::Matrix<Scalar, components, 1> least_thrusts(
      const Vector3<Scalar>& force, const Vector3<Scalar>& torque) const noexcept {
    return pseudoinverse_.template leftCols<3>() * force +
           pseudoinverse_.template rightCols<3>() * torque;
  }

  [[nodiscard]] AllocationStatus thrusts_within_limits(const Wrench<Scalar>& wanted,
                                                       const ActuatorState<Rotors, Scalar>& last,
                                                       Point& x) const noexcept;

  /// Curve and limits of a rotor, times its effectiveness unless it is lost.
  [[nodiscard]] const RotorParameters& rotor(int i) const noexcept {
    return rotors_[static_cast<std::size_t>(i)];
  }

  [[nodiscard]] Scalar hold_thrust(int i) const noexcept {
    return hold_thrust_[static_cast<std::size_t>(i)];
  }

  [[nodiscard]] Scalar bounded_speed(int i, Scalar speed) const noexcept {
    const auto rotor = static_cast<std::size_t>(i);
    return std::max(min_speed_[rotor], std::min(speed, max_speed_[rotor]));
  }

  /// Tilt angle of rotor i for a thrust vector, seen from the last one.
  [[nodiscard]] Scalar next_angle(int i, const Vector2& thrust, Scalar last) const noexcept;

  [[nodiscard]] ActuatorState<Rotors, Scalar> within_limits(
      const ActuatorState<Rotors, Scalar>& last) const noexcept;

  Limits limits_;
  std::array<RotorParameters, static_cast<std::size_t>(Rotors)> rotors_;
  std::array<Scalar, static_cast<std::size_t>(Rotors)> min_speed_{}, max_speed_{}, hold_thrust_{};
  bool has_min_thrust_ = false;
  BatteryParameters battery_;
  Scalar servo_lead_, max_tilt_rate_, calm_thrust_;
  Eigen::Matrix<Scalar, Rotors, 1> rotor_lead_;
  Scalar max_force_{};
  Scalar max_torque_{};
  Matrix matrix_;
  Pseudoinverse pseudoinverse_;
  typename Limits::Directions null_space_ = Limits::Directions::Zero();
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{};
};

template <int Rotors, typename Scalar>
Allocation<Rotors, Scalar>::Allocation(const Vehicle<Rotors>& vehicle,
                                       const AllocationParameters& parameters)
    : limits_(checked(vehicle, parameters)),
      battery_(vehicle.battery),
      servo_lead_(Scalar(parameters.lag_compensation * vehicle.servo.time_constant)),
      max_tilt_rate_(Scalar(vehicle.servo.max_rate)),
      calm_thrust_(Scalar(parameters.calm_share * vehicle.body.mass * gravity / Rotors)) {
  const AllocationMatrix<Rotors> allocation(vehicle);
  matrix_ = allocation.matrix.template cast<Scalar>();
  pseudoinverse_ = allocation.pseudoinverse.template cast<Scalar>();
  null_space_.topLeftCorner(components, allocation.null_space.cols()) =
      allocation.null_space.template cast<Scalar>();
  double lever = 0.0;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorGeometry& rotor = vehicle.rotors[i];
    tilts_[i] = rotor.tilts;
    const RotorParameters& whole = rotor_parameters(vehicle, i);
    min_speed_[i] = speed_from_thrust(Scalar(whole.min_thrust), whole);
    max_speed_[i] = speed_from_thrust(Scalar(whole.max_thrust), whole);
    hold_thrust_[i] = Scalar(std::max(parameters.hold_thrust, whole.min_thrust));
    has_min_thrust_ = has_min_thrust_ || whole.min_thrust > 0.0;
    rotor_lead_(static_cast<Eigen::Index>(i)) =
        Scalar(parameters.lag_compensation * whole.time_constant);
    // A lost rotor's thrust is none of A's, whatever its coefficient.
    const double effectiveness = rotor.effectiveness > 0.0 ? rotor.effectiveness : 1.0;
    rotors_[i] = whole;
    for (double RotorParameters::*field :
         {&RotorParameters::thrust_coefficient, &RotorParameters::linear_thrust_coefficient,
          &RotorParameters::min_thrust, &RotorParameters::max_thrust})
      rotors_[i].*field *= effectiveness;
    lever += rotor.position.norm() + whole.torque_ratio;
  }
  max_force_ = Scalar(Rotors * largest_max_thrust(vehicle));
  max_torque_ = Scalar(lever * largest_max_thrust(vehicle));
}

template <int Rotors, typename Scalar>
AllocationResult<Rotors, Scalar> Allocation<Rotors, Scalar>::allocate(
    const Wrench<Scalar>& wanted, const ActuatorState<Rotors, Scalar>& told) const noexcept {
  AllocationResult<Rotors, Scalar> result;
  if (!is_finite(wanted)) {
    result.command = within_limits(told);
    result.achieved = wrench(result.command);
    return result;
  }
  // Speeds play no part; an angle that is not known is one like any other.
  ActuatorState<Rotors, Scalar> last = told;
  for (int i = 0; i < Rotors; ++i)
    if (!std::isfinite(last.tilt_angle(i))) last.tilt_angle(i) = Scalar(0);
  Point x;
  result.status = thrusts_within_limits(wanted, last, x);
  for (int i = 0; i < Rotors; ++i) {
    auto thrust = x.template segment<2>(2 * i);
    const bool tilts = tilts_[static_cast<std::size_t>(i)];
    const Scalar angle = tilts ? next_angle(i, thrust, last.tilt_angle(i)) : Scalar(0);
    const auto unit = Limits::direction(angle);
    const Scalar size = limits_.bounded_thrust(i, thrust.dot(unit));
    const Scalar missed = (thrust - size * unit).norm();
    if (missed > Scalar(4) * limits_.tolerance() && result.status != AllocationStatus::limited)
      result.status = AllocationStatus::angle_held;
    thrust = size * unit;
    result.command.rotor_speed(i) = bounded_speed(i, speed_from_thrust(size, rotor(i)));
    result.command.tilt_angle(i) = angle;
  }
  const Eigen::Matrix<Scalar, 6, 1> achieved = matrix_ * x.template head<components>();
  result.achieved = {achieved.template head<3>(), achieved.template tail<3>()};
  result.lost = {wanted.force - result.achieved.force, wanted.torque - result.achieved.torque};
  return result;
}

template <int Rotors, typename Scalar>
AllocationResult<Rotors, Scalar> Allocation<Rotors, Scalar>::allocate(
    const Wrench<Scalar>& wanted, const Wrench<Scalar>& rate,
    const ActuatorState<Rotors, Scalar>& last) const noexcept {
  AllocationResult<Rotors, Scalar> result = allocate(wanted, last);
  if (result.status == AllocationStatus::rejected) return result;
  const ActuatorRates<Rotors, Scalar> ahead = rates(wanted, rate);
  for (int i = 0; i < Rotors; ++i) {
    const Scalar thrust = thrust_from_speed(result.command.rotor_speed(i), rotor(i));
    const Scalar calm = std::min(Scalar(1), thrust / calm_thrust_);
    const Scalar turn = std::max(-max_tilt_rate_, std::min(ahead.tilt_rate(i), max_tilt_rate_));
    result.command.tilt_angle(i) += servo_lead_ * calm * calm * turn;
  }
  result.command.rotor_speed += rotor_lead_.cwiseProduct(ahead.rotor_acceleration);
  result.command = within_limits(result.command);
  return result;
}

template <int Rotors, typename Scalar>
ActuatorRates<Rotors, Scalar> Allocation<Rotors, Scalar>::rates(
    const Wrench<Scalar>& wrench, const Wrench<Scalar>& wrench_rate) const noexcept {
  const auto thrusts = least_thrusts(wrench.force, wrench.torque);
  const auto slopes = least_thrusts(wrench_rate.force, wrench_rate.torque);
  ActuatorRates<Rotors, Scalar> rates;
  for (int i = 0; i < Rotors; ++i) {
    const Scalar lateral = thrusts(2 * i), vertical = thrusts(2 * i + 1);
    const Scalar size = std::max(hold_thrust(i), std::hypot(lateral, vertical));
    rates.tilt_rate(i) = (slopes(2 * i) * vertical - lateral * slopes(2 * i + 1)) / (size * size);
    const Scalar thrust_rate = (slopes(2 * i) * lateral + slopes(2 * i + 1) * vertical) / size;
    rates.rotor_acceleration(i) = thrust_rate / thrust_slope(size, rotor(i));
  }
  if (!all_finite(rates.tilt_rate) || !all_finite(rates.rotor_acceleration)) return {};
  return rates;
}

template <int Rotors, typename Scalar>
Scalar Allocation<Rotors, Scalar>::next_angle(int i, const Vector2& thrust,
                                              Scalar last) const noexcept {
  last = limits_.bounded_angle(last);
  const Scalar target = limits_.nearest_angle(std::atan2(thrust.x(), thrust.y()), last);
  const Scalar weight = thrust.squaredNorm() / (hold_thrust(i) * hold_thrust(i));
  return weight < Scalar(1) ? last + weight * (target - last) : target;
}

template <int Rotors, typename Scalar>
ActuatorState<Rotors, Scalar> Allocation<Rotors, Scalar>::within_limits(
    const ActuatorState<Rotors, Scalar>& last) const noexcept {
  ActuatorState<Rotors, Scalar> command;
  for (int i = 0; i < Rotors; ++i) {
    const Scalar speed = last.rotor_speed(i), angle = last.tilt_angle(i);
    command.rotor_speed(i) = bounded_speed(i, std::isfinite(speed) ? speed : Scalar(0));
    if (tilts_[static_cast<std::size_t>(i)])
      command.tilt_angle(i) = limits_.bounded_angle(std::isfinite(angle) ? angle : Scalar(0));
  }
  return command;
}

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
  if (has_min_thrust_) {
    for (int i = 0; i < Rotors; ++i) {
      const Vector2 thrust = x.template segment<2>(2 * i);
      floors[static_cast<std::size_t>(i)] =
          Limits::direction(next_angle(i, thrust, last.tilt_angle(i)));
    }
  }
  const typename Limits::Space plain{null_space_, nullptr, Scalar(0)};
  const typename Limits::Space floored{null_space_, has_min_thrust_ ? &floors : nullptr, Scalar(0)};
  if (limits_.contains(x, floored)) return AllocationStatus::ok;

  typename Limits::Coordinates y = Limits::Coordinates::Zero();
  Point excess;
  if (limits_.approach(force + torque, floored, y, x, excess))
    return AllocationStatus::null_space_used;

  Scalar share;
  if (limits_.largest_share(torque, force, plain, share, y, x))
    return share < Scalar(1) ? AllocationStatus::limited : AllocationStatus::null_space_used;

  // The force, at right angles to the null space, becomes one more direction; its share of [0, 1]
  // is the last component, at the same scale.
  const Scalar size = force.norm();
  typename Limits::Directions directions = null_space_;
  auto column = directions.template rightCols<1>();
  column = force;
  column(components) = size;
  if (size > Scalar(0)) column /= std::sqrt(Scalar(2)) * size;
  y.setZero();
  limits_.largest_share(Point::Zero(), torque, {directions, nullptr, size}, share, y, x);
  return AllocationStatus::limited;
}

}  // namespace tilt_ropter
