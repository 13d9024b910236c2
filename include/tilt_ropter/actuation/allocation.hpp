// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/allocation_parameters.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/actuation/thrust_choice.hpp>
#include <tilt_ropter/actuation/thrust_limits.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>

/// Control allocation (paper, Sec. Control Allocation): from a wrench to rotor speeds and tilt
/// angles and back.
namespace tilt_ropter {

/// Allocation for any number of tilting or fixed rotors, by the Moore-Penrose inverse of
/// AllocationMatrix, computed once.
///
/// Beyond the paper, in this order:
/// 1. The least thrusts, if they are within limits. An angle turns the nearest way from the last
///    one.
/// 2. Other thrusts with the same wrench (the null space of A), by the least change, if the least
///    thrusts leave a limit, or if an angle near the end of the servo's range would have to turn
///    over to the equivalent angle (+- 2 pi) inside. Any wrench is given that some thrusts and
///    angles within limits give. The one exception is the min_thrust of rotors that tilt, whose
///    thrusts are not convex: there a local search may fail.
/// 3. If the null space cannot prevent the turn: an arm waits at the end of its range while its
///    target is less than range_end_margin beyond it (range_end_held). Otherwise it turns over, and
///    as few other arms as possible with it (turned_over).
/// 4. A wrench out of reach is scaled down group by group (AllocationParameters::priorities).
///
/// Below h = max(hold_thrust, min_thrust) an angle approaches its target with a time constant that
/// grows as the thrust falls (AllocationParameters::hold_time), so a path of wrenches through zero
/// thrust turns it continuously, at any rate of calls. Meanwhile the rotor pushes with the part of
/// its thrust that lies along the angle, and with min_thrust at least (angle_held).
///
/// A rotor of effectiveness e < 1 turns faster for the same thrust, 1 / sqrt(e) times without a
/// linear term, and has that fraction of the limits; a lost one is told the slowest speed and its
/// angle stays. A stuck servo is a fixed rotor (with_stuck_servo).
///
/// Each rotor has the curve, limits and lag of rotor_parameters(). The limits are those of the last
/// voltage that set_voltage() took, at the start of the nominal one.
///
/// The constructor throws and allocates; all else does neither. About 0.3 us per call with 4
/// rotors; where limits are hit typically 20 us, 50 us out of reach; work is bounded. The search
/// calculates in double whatever the Scalar is.
template <int Rotors, typename Scalar = double>
class Allocation {
  using Limits = detail::ThrustLimits<Rotors, Scalar>;

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
      const double max_thrust = max_thrust_at(rotors_[i], *ratio);
      max_speed_[i] = speed_from_thrust(Scalar(max_thrust), rotors_[i]);
      limits_.set_max_thrust(i, Scalar(max_thrust));  // of a lost rotor, too: it gives none anyway
      choice_.set_max_thrust(i, max_thrust);
    }
    return true;
  }

  /// Speeds and angles that give `wanted`, as near as limits allow, from `last`: angles turn the
  /// nearest way. Without a time: `last` counts as long ago, so hold_thrust has no effect, and an
  /// angle is held at zero thrust only. For questions and the first command; a loop calls the
  /// overload below. Entries of `last` that are not finite count as zero, its speeds are not used.
  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate(
      const Wrench<Scalar>& wanted, const ActuatorState<Rotors, Scalar>& last) const noexcept;

  /// The same at `time` [s] for a wrench that moves at `rate` [N/s, N m/s]: speeds and angles run
  /// ahead by the fraction lag_compensation of their time constants, within limits and the servo's
  /// rate. `achieved` and `lost` are those of the wrench now, without the lead. `last` is the
  /// result before; at the start one whose command says where the actuators are. A time that is not
  /// finite or not after that of `last` counts as no time passed.
  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate(
      double time, const Wrench<Scalar>& wanted, const Wrench<Scalar>& rate,
      const AllocationResult<Rotors, Scalar>& last) const noexcept;

  /// Rates of angles and speeds that follow a wrench rate [N/s, N m/s] without limits (paper, Eq.
  /// allocation_inverse). At thrusts T below h the denominators T^2 and T stay at h^2
  /// and h, so everything is finite and falls to zero with T. Inputs that are not finite or
  /// overflow give zero rates.
  [[nodiscard]] ActuatorRates<Rotors, Scalar> rates(
      const Wrench<Scalar>& wrench, const Wrench<Scalar>& wrench_rate) const noexcept;

 private:
  using Vector2 = typename Limits::Vector2;
  using Thrusts = Eigen::Matrix<Scalar, components, 1>;
  using Angles = Eigen::Matrix<Scalar, Rotors, 1>;

  [[nodiscard]] Thrusts least_thrusts(const Vector3<Scalar>& force,
                                      const Vector3<Scalar>& torque) const noexcept {
    return pseudoinverse_.template leftCols<3>() * force +
           pseudoinverse_.template rightCols<3>() * torque;
  }

  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate_after(
      double elapsed, const Wrench<Scalar>& wanted,
      const ActuatorState<Rotors, Scalar>& last) const noexcept;

  /// True if the least thrusts, which point along `angles` from `last` on, are within limits and
  /// turn no arm over whose thrust is above `faint` [N].
  [[nodiscard]] bool are_good(const Thrusts& thrusts, const Angles& last, const Angles& angles,
                              Scalar faint) const noexcept;

  /// ThrustChoice in this class's scalar; out of line, because it is long and rarely called.
  [[gnu::noinline]] void choose(
      const Wrench<Scalar>& wanted, const Angles& last, Scalar faint, Thrusts& thrusts,
      AllocationStatus& status,
      std::array<bool, static_cast<std::size_t>(Rotors)>& at_end) const noexcept;

  /// The fraction of the way to its target that an angle goes in a time [s], by its thrust.
  [[nodiscard]] Scalar follow_fraction(int i, const Vector2& thrust,
                                       double elapsed) const noexcept {
    const Scalar square = thrust.squaredNorm(), hold = hold_thrust(i) * hold_thrust(i);
    if (square >= hold) return Scalar(1);
    if (square <= limits_.tolerance() * limits_.tolerance()) return Scalar(0);
    const auto rate = static_cast<double>(square / (hold - square)) / hold_time_;
    return Scalar(-std::expm1(-elapsed * rate));
  }

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

  [[nodiscard]] ActuatorState<Rotors, Scalar> within_limits(
      const ActuatorState<Rotors, Scalar>& last) const noexcept;

  Limits limits_;
  std::array<RotorParameters, static_cast<std::size_t>(Rotors)> rotors_;
  std::array<Scalar, static_cast<std::size_t>(Rotors)> min_speed_{}, max_speed_{}, hold_thrust_{};
  Scalar largest_hold_thrust_{};
  bool has_min_thrust_ = false;
  BatteryParameters battery_;
  Scalar servo_lead_, max_tilt_rate_, calm_thrust_;
  Eigen::Matrix<Scalar, Rotors, 1> rotor_lead_;
  double hold_time_;
  Matrix matrix_;
  Pseudoinverse pseudoinverse_;
  detail::ThrustChoice<Rotors> choice_;
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{};

  Allocation(const Vehicle<Rotors>& vehicle, const AllocationParameters& parameters,
             const AllocationMatrix<Rotors>& allocation);
};

template <int Rotors, typename Scalar>
Allocation<Rotors, Scalar>::Allocation(const Vehicle<Rotors>& vehicle,
                                       const AllocationParameters& parameters)
    : Allocation(validated(vehicle), validated(parameters), AllocationMatrix<Rotors>(vehicle)) {}

template <int Rotors, typename Scalar>
Allocation<Rotors, Scalar>::Allocation(const Vehicle<Rotors>& vehicle,
                                       const AllocationParameters& parameters,
                                       const AllocationMatrix<Rotors>& allocation)
    : limits_(vehicle),
      battery_(vehicle.battery),
      servo_lead_(Scalar(parameters.lag_compensation * vehicle.servo.time_constant)),
      max_tilt_rate_(Scalar(vehicle.servo.max_rate)),
      calm_thrust_(Scalar(parameters.calm_share * vehicle.body.mass * gravity / Rotors)),
      hold_time_(parameters.hold_time),
      matrix_(allocation.matrix.template cast<Scalar>()),
      pseudoinverse_(allocation.pseudoinverse.template cast<Scalar>()),
      choice_(vehicle, parameters, allocation) {
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorGeometry& rotor = vehicle.rotors[i];
    tilts_[i] = rotor.tilts;
    const RotorParameters& whole = rotor_parameters(vehicle, i);
    min_speed_[i] = speed_from_thrust(Scalar(whole.min_thrust), whole);
    max_speed_[i] = speed_from_thrust(Scalar(whole.max_thrust), whole);
    hold_thrust_[i] = Scalar(std::max(parameters.hold_thrust, whole.min_thrust));
    largest_hold_thrust_ = std::max(largest_hold_thrust_, hold_thrust_[i]);
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
  }
}

template <int Rotors, typename Scalar>
bool Allocation<Rotors, Scalar>::are_good(const Thrusts& thrusts, const Angles& last,
                                          const Angles& angles, Scalar faint) const noexcept {
  for (int i = 0; i < Rotors; ++i) {
    const Vector2 thrust = thrusts.template segment<2>(2 * i);
    if (!limits_.contains(i, thrust)) return false;
    if (!tilts_[static_cast<std::size_t>(i)]) continue;
    if (limits_.beyond_range(angles(i)) > Scalar(0) &&
        limits_.part_of_end(last(i)) != detail::AnglePart::whole &&
        thrust.squaredNorm() > faint * faint)
      return false;
    if (has_min_thrust_ && thrust.norm() < limits_.min_thrust(i) - limits_.tolerance())
      return false;
  }
  return true;
}

template <int Rotors, typename Scalar>
void Allocation<Rotors, Scalar>::choose(
    const Wrench<Scalar>& wanted, const Angles& last, Scalar faint, Thrusts& thrusts,
    AllocationStatus& status,
    std::array<bool, static_cast<std::size_t>(Rotors)>& at_end) const noexcept {
  const Wrench<double> wrench{wanted.force.template cast<double>(),
                              wanted.torque.template cast<double>()};
  const auto chosen = choice_.choose(wrench, thrusts.template cast<double>(),
                                     last.template cast<double>(), static_cast<double>(faint));
  thrusts = chosen.thrusts.template cast<Scalar>();
  status = chosen.status;
  at_end = chosen.at_end;
}

template <int Rotors, typename Scalar>
AllocationResult<Rotors, Scalar> Allocation<Rotors, Scalar>::allocate_after(
    double elapsed, const Wrench<Scalar>& wanted,
    const ActuatorState<Rotors, Scalar>& last) const noexcept {
  using Status = AllocationStatus;
  AllocationResult<Rotors, Scalar> result;
  if (!is_finite(wanted)) {
    result.command = within_limits(last);
    result.achieved = wrench(result.command);
    return result;
  }
  Thrusts thrusts =
      least_thrusts(choice_.shortened_force(wanted.force), choice_.shortened_torque(wanted.torque));
  Angles from, angles;
  const auto point_angles = [&] {
    for (int i = 0; i < Rotors; ++i)
      angles(i) = Limits::unwrapped_angle(std::atan2(thrusts(2 * i), thrusts(2 * i + 1)), from(i));
  };
  for (int i = 0; i < Rotors; ++i) {
    const Scalar angle = last.tilt_angle(i);
    from(i) = limits_.bounded_angle(std::isfinite(angle) ? angle : Scalar(0));
  }
  point_angles();
  std::array<bool, static_cast<std::size_t>(Rotors)> at_end{};
  result.status = Status::ok;
  // Below hold_thrust an arm that has time never turns over.
  const Scalar faint = std::isfinite(elapsed) ? largest_hold_thrust_ : limits_.tolerance();
  if (!are_good(thrusts, from, angles, faint)) {
    choose(wanted, from, faint, thrusts, result.status, at_end);
    point_angles();
  }

  bool holds = false, waits = result.status == Status::range_end_held, cuts = false;
  for (int i = 0; i < Rotors; ++i) {
    const auto arm = static_cast<std::size_t>(i);
    auto thrust = thrusts.template segment<2>(2 * i);
    Scalar angle(0), follow(1);
    bool waiting = at_end[arm];
    if (tilts_[arm]) {
      follow = follow_fraction(i, thrust, elapsed);
      const Scalar beyond = limits_.beyond_range(angles(i));
      const bool rounding =
          thrust.norm() * std::min(beyond, Scalar(1)) <= Scalar(choice_.negligible());
      angle = waiting || rounding || follow < Scalar(1) ? limits_.bounded_angle(angles(i))
                                                        : limits_.nearest_angle(angles(i), from(i));
      waiting = waiting || (result.status == Status::ok && beyond > Scalar(0));
      if (follow < Scalar(1)) angle = from(i) + follow * (angle - from(i));
      if (std::abs(angle - from(i)) > Scalar(pi * (1.0 + 1e-6))) ++result.turned_over;
    }
    const auto unit = Limits::direction(angle);
    const Scalar size = limits_.bounded_thrust(i, thrust.dot(unit));
    if ((thrust - size * unit).norm() > Scalar(4) * limits_.tolerance())
      (follow < Scalar(1) ? holds : waiting ? waits : cuts) = true;
    thrust = size * unit;
    result.command.rotor_speed(i) = bounded_speed(i, speed_from_thrust(size, rotor(i)));
    result.command.tilt_angle(i) = angle;
  }
  if (result.status != Status::limited) {
    if (waits)
      result.status = Status::range_end_held;
    else if (cuts)
      result.status = Status::limited;
    else if (holds)
      result.status = Status::angle_held;
    else if (result.turned_over > 0)
      result.status = Status::turned_over;
  }
  const Eigen::Matrix<Scalar, 6, 1> achieved = matrix_ * thrusts;
  result.achieved = {achieved.template head<3>(), achieved.template tail<3>()};
  result.lost = {wanted.force - result.achieved.force, wanted.torque - result.achieved.torque};
  return result;
}

template <int Rotors, typename Scalar>
AllocationResult<Rotors, Scalar> Allocation<Rotors, Scalar>::allocate(
    const Wrench<Scalar>& wanted, const ActuatorState<Rotors, Scalar>& last) const noexcept {
  return allocate_after(std::numeric_limits<double>::infinity(), wanted, last);
}

template <int Rotors, typename Scalar>
AllocationResult<Rotors, Scalar> Allocation<Rotors, Scalar>::allocate(
    double time, const Wrench<Scalar>& wanted, const Wrench<Scalar>& rate,
    const AllocationResult<Rotors, Scalar>& last) const noexcept {
  const double elapsed = time > last.time ? time - last.time : 0.0;
  AllocationResult<Rotors, Scalar> result = allocate_after(elapsed, wanted, last.command);
  result.time = std::isfinite(time) ? time : last.time;
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

}  // namespace tilt_ropter
