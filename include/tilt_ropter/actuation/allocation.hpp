// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/detail/allocation_settings.hpp>
#include <tilt_ropter/actuation/detail/thrust_limits.hpp>
#include <tilt_ropter/actuation/detail/thrust_search.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
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
/// angles and back; what a vehicle can give beyond hover.
namespace tilt_ropter {

/// Allocation for any number of tilting or fixed rotors. It uses the Moore-Penrose inverse of
/// AllocationMatrix, which is computed once.
///
/// Allocation goes beyond the paper in these steps:
/// 1. Use the minimum-norm thrusts A^+ W if they are within limits. Each angle turns the shortest
///    way from the last angle.
/// 2. Otherwise use other thrusts with the same wrench (the null space of A), with the least
///    change. This step applies if the minimum-norm thrusts violate a limit. It also applies if an
///    angle near the end of the servo's range would have to turn over to the equivalent angle
///    (+- 2 pi) inside. This step reaches every wrench that some thrusts and angles within limits
///    give. The one exception is the min_thrust of tilting rotors: their thrusts are not convex,
///    and the local search may fail there.
/// 3. If the null space cannot prevent the turn and the target is less than range_end_margin beyond
///    the end, the arm waits there (range_end_held). Otherwise the arm turns over, together with
///    the smallest possible number of other arms (turned_over).
/// 4. Scale an unreachable wrench down group by group (AllocationSettings::priorities).
///
/// Below h = max(hold_thrust, min_thrust) an angle approaches its target with a time constant that
/// grows as the thrust falls (AllocationSettings::hold_time). A path of wrenches through zero
/// thrust therefore turns the angle continuously, at any call rate. Meanwhile the rotor gives the
/// component of its thrust along the angle, and at least min_thrust (angle_held).
///
/// A rotor of effectiveness e < 1 turns faster for the same thrust: at 1 / sqrt(e) times the speed
/// without a linear term. Its limits are multiplied by e. A lost rotor gets the slowest speed and
/// keeps its angle. A stuck servo is a fixed rotor (with_stuck_servo).
///
/// Each rotor has the curve, limits and lag of rotor_parameters(). The limits hold for the last
/// voltage that set_voltage() accepted, initially for the nominal voltage.
///
/// The constructor throws and allocates. No other function throws or allocates. A call takes about
/// 0.3 us with 4 rotors, typically 20 us if limits are hit, and 50 us for an unreachable wrench.
/// The work is bounded. The search calculates in double for every Scalar.
template <int Rotors, typename Scalar = double>
class Allocation {
  using Limits = detail::ThrustLimits<Rotors, Scalar>;

 public:
  static constexpr int components = 2 * Rotors;
  using Matrix = Eigen::Matrix<Scalar, 6, components>;
  using Pseudoinverse = Eigen::Matrix<Scalar, components, 6>;

  /// Throws std::invalid_argument if the vehicle or the settings fail validate(), or if the
  /// geometry cannot give every wrench (rank of A below 6).
  explicit Allocation(const Vehicle<Rotors>& vehicle, const AllocationSettings& settings = {});

  /// A of AllocationMatrix, 6 x 2n, and its Moore-Penrose inverse, 2n x 6.
  [[nodiscard]] const Matrix& matrix() const noexcept { return matrix_; }
  [[nodiscard]] const Pseudoinverse& pseudoinverse() const noexcept { return pseudoinverse_; }

  /// Wrench that the rotors apply at the given speeds and tilt angles (measured, modelled or
  /// commanded). `Value` may be an automatic-differentiation scalar. A rotor whose speed or angle
  /// is not finite counts as standing still.
  template <typename Value>
  [[nodiscard]] Wrench<Value> wrench(const ActuatorState<Rotors, Value>& actuators) const noexcept;

  /// Sets the measured battery `voltage` [V]. The next commands observe the top speeds and thrusts
  /// of max_thrust_at(). Returns true if voltage_ratio() accepts the voltage. Otherwise the last
  /// accepted voltage remains in effect.
  bool set_voltage(double voltage) noexcept;

  /// Speeds and angles that give `wanted`, within limits, starting from `last`. Angles turn the
  /// shortest way. This overload has no time: `last` counts as infinitely old, so hold_thrust has
  /// no effect, and an angle is held at zero thrust only. Use it for queries and for the first
  /// command; a control loop calls the overload below. Entries of `last` that are not finite count
  /// as zero. The speeds of `last` are used only if `wanted` is not finite.
  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate(
      const Wrench<Scalar>& wanted, const ActuatorState<Rotors, Scalar>& last) const noexcept;

  /// Same at `time` [s] for a wrench that changes at `rate` [N/s, N m/s]. Speeds and angles lead by
  /// the fraction lag_compensation of their time constants, within limits and the servo's rate.
  /// `achieved` and `lost` are for the wrench at `time`, without the lead. `last` is the previous
  /// result; for the first call, its command is the state of the actuators. A time that is not
  /// finite, or not after the time of `last`, counts as zero elapsed time.
  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate(
      double time, const Wrench<Scalar>& wanted, const Wrench<Scalar>& rate,
      const AllocationResult<Rotors, Scalar>& last) const noexcept;

  /// Rates of angles and speeds that follow a wrench rate [N/s, N m/s] without limits
  /// (paper, Eq. allocation_inverse). At a thrust T below h = max(hold_thrust, min_thrust) the
  /// denominators T^2 and T are replaced by h^2 and h. The rates are therefore finite and go to
  /// zero with T. Returns zero rates if an input is not finite or a result overflows.
  [[nodiscard]] ActuatorRates<Rotors, Scalar> rates(
      const Wrench<Scalar>& wrench, const Wrench<Scalar>& wrench_rate) const noexcept;

 private:
  using Vector2 = typename Limits::Vector2;
  using Thrusts = Eigen::Matrix<Scalar, components, 1>;
  using Angles = Eigen::Matrix<Scalar, Rotors, 1>;

  [[nodiscard]] Thrusts least_thrusts(const Wrench<Scalar>& wrench) const noexcept {
    return detail::least_thrusts(pseudoinverse_, wrench);
  }

  [[nodiscard]] AllocationResult<Rotors, Scalar> allocate_after(
      double elapsed, const Wrench<Scalar>& wanted,
      const ActuatorState<Rotors, Scalar>& last) const noexcept;

  /// Returns true if the minimum-norm thrusts, which point along `angles`, are within limits and
  /// turn no arm over from `last`. Arms with a thrust up to `faint` [N] may turn over.
  [[nodiscard]] bool are_good(const Thrusts& thrusts, const Angles& last, const Angles& angles,
                              Scalar faint) const noexcept;

  /// Calls ThrustChoice with doubles. Not inlined, because it is long and rarely called.
  [[gnu::noinline]] void choose(const Wrench<Scalar>& wanted, const Angles& last, Scalar faint,
                                Thrusts& thrusts, AllocationStatus& status,
                                std::array<bool, detail::size(Rotors)>& at_end) const noexcept;

  /// Fraction of the way to its target that an angle covers in `elapsed` [s] at this thrust.
  [[nodiscard]] Scalar follow_fraction(int i, const Vector2& thrust,
                                       double elapsed) const noexcept {
    const Scalar square = thrust.squaredNorm(), hold = hold_thrust(i) * hold_thrust(i);
    if (square >= hold) return Scalar(1);
    if (square <= limits_.tolerance() * limits_.tolerance()) return Scalar(0);
    const auto rate = static_cast<double>(square / (hold - square)) / AllocationSettings::hold_time;
    return Scalar(-std::expm1(-elapsed * rate));
  }

  /// Curve and limits of a rotor, multiplied by its effectiveness unless the rotor is lost.
  [[nodiscard]] const RotorParameters& rotor(int i) const noexcept {
    return rotors_[detail::size(i)];
  }

  [[nodiscard]] Scalar hold_thrust(int i) const noexcept { return hold_thrust_[detail::size(i)]; }

  [[nodiscard]] Scalar bounded_speed(int i, Scalar speed) const noexcept {
    const auto rotor = detail::size(i);
    return std::max(min_speed_[rotor], std::min(speed, max_speed_[rotor]));
  }

  [[nodiscard]] ActuatorState<Rotors, Scalar> within_limits(
      const ActuatorState<Rotors, Scalar>& last) const noexcept;

  Limits limits_;
  std::array<RotorParameters, detail::size(Rotors)> rotors_;
  std::array<Scalar, detail::size(Rotors)> min_speed_{}, max_speed_{}, hold_thrust_{};
  Scalar largest_hold_thrust_{};
  BatteryParameters battery_;
  Scalar servo_lead_, max_tilt_rate_, calm_thrust_;
  Eigen::Matrix<Scalar, Rotors, 1> rotor_lead_;
  Matrix matrix_;
  Pseudoinverse pseudoinverse_;
  detail::ThrustChoice<Rotors> choice_;

  Allocation(const Vehicle<Rotors>& vehicle, const AllocationSettings& settings,
             const AllocationMatrix<Rotors>& allocation);
};

template <int Rotors, typename Scalar>
Allocation<Rotors, Scalar>::Allocation(const Vehicle<Rotors>& vehicle,
                                       const AllocationSettings& settings)
    : Allocation(validated(vehicle), validated(settings), AllocationMatrix<Rotors>(vehicle)) {}

template <int Rotors, typename Scalar>
Allocation<Rotors, Scalar>::Allocation(const Vehicle<Rotors>& vehicle,
                                       const AllocationSettings& settings,
                                       const AllocationMatrix<Rotors>& allocation)
    : limits_(vehicle),
      battery_(vehicle.battery),
      servo_lead_(Scalar(settings.lag_compensation * vehicle.servo.time_constant)),
      max_tilt_rate_(Scalar(vehicle.servo.max_rate)),
      calm_thrust_(Scalar(settings.calm_fraction * vehicle.body.mass * gravity / Rotors)),
      matrix_(allocation.matrix.template cast<Scalar>()),
      pseudoinverse_(allocation.pseudoinverse.template cast<Scalar>()),
      choice_(vehicle, settings, allocation) {
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorParameters& whole = rotor_parameters(vehicle, i);
    min_speed_[i] = speed_from_thrust(Scalar(whole.min_thrust), whole);
    max_speed_[i] = speed_from_thrust(Scalar(whole.max_thrust), whole);
    hold_thrust_[i] = Scalar(std::max(settings.hold_thrust, whole.min_thrust));
    largest_hold_thrust_ = std::max(largest_hold_thrust_, hold_thrust_[i]);
    rotor_lead_(static_cast<Eigen::Index>(i)) =
        Scalar(settings.lag_compensation * whole.time_constant);
    // A contains no thrust of a lost rotor, so its coefficient may have any value.
    const double given = vehicle.rotors[i].effectiveness, effectiveness = given > 0.0 ? given : 1.0;
    rotors_[i] = whole;
    for (double RotorParameters::*field :
         {&RotorParameters::thrust_coefficient, &RotorParameters::linear_thrust_coefficient,
          &RotorParameters::min_thrust, &RotorParameters::max_thrust})
      rotors_[i].*field *= effectiveness;
  }
}

template <int Rotors, typename Scalar>
template <typename Value>
Wrench<Value> Allocation<Rotors, Scalar>::wrench(
    const ActuatorState<Rotors, Value>& actuators) const noexcept {
  using std::cos;
  using std::sin;
  Eigen::Matrix<Value, components, 1> thrusts = Eigen::Matrix<Value, components, 1>::Zero();
  for (int i = 0; i < Rotors; ++i) {
    const Value thrust = thrust_from_speed(actuators.rotor_speed(i), rotor(i));
    if (!limits_.tilts(i)) {
      thrusts(2 * i + 1) = thrust;
    } else if (all_finite(actuators.tilt_angle.template segment<1>(i))) {
      thrusts(2 * i) = thrust * sin(actuators.tilt_angle(i));
      thrusts(2 * i + 1) = thrust * cos(actuators.tilt_angle(i));
    }
  }
  return detail::wrench_of(matrix_, thrusts);
}

template <int Rotors, typename Scalar>
bool Allocation<Rotors, Scalar>::set_voltage(double voltage) noexcept {
  const std::optional<double> ratio = voltage_ratio(battery_, voltage);
  if (!ratio) return false;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const double max_thrust = max_thrust_at(rotors_[i], *ratio);
    max_speed_[i] = speed_from_thrust(Scalar(max_thrust), rotors_[i]);
    // Also set for a lost rotor, which gives no thrust.
    limits_.set_max_thrust(i, Scalar(max_thrust));
    choice_.set_max_thrust(i, max_thrust);
  }
  return true;
}

template <int Rotors, typename Scalar>
bool Allocation<Rotors, Scalar>::are_good(const Thrusts& thrusts, const Angles& last,
                                          const Angles& angles, Scalar faint) const noexcept {
  for (int i = 0; i < Rotors; ++i) {
    const Vector2 thrust = thrusts.template segment<2>(2 * i);
    if (!limits_.contains(i, thrust)) return false;
    if (!limits_.tilts(i)) continue;
    if (limits_.beyond_range(angles(i)) > Scalar(0) &&
        limits_.part_of_end(last(i)) != detail::AnglePart::whole &&
        thrust.squaredNorm() > faint * faint)
      return false;
    if (limits_.min_thrust(i) > Scalar(0) &&
        thrust.norm() < limits_.min_thrust(i) - limits_.tolerance())
      return false;
  }
  return true;
}

template <int Rotors, typename Scalar>
void Allocation<Rotors, Scalar>::choose(
    const Wrench<Scalar>& wanted, const Angles& last, Scalar faint, Thrusts& thrusts,
    AllocationStatus& status, std::array<bool, detail::size(Rotors)>& at_end) const noexcept {
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
  Thrusts thrusts = least_thrusts(choice_.shortened(wanted));
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
  std::array<bool, detail::size(Rotors)> at_end{};
  result.status = Status::ok;
  // With a finite elapsed time, an arm never turns over below hold_thrust.
  const Scalar faint = std::isfinite(elapsed) ? largest_hold_thrust_ : limits_.tolerance();
  if (!are_good(thrusts, from, angles, faint)) {
    choose(wanted, from, faint, thrusts, result.status, at_end);
    point_angles();
  }

  bool holds = false, waits = result.status == Status::range_end_held, cuts = false;
  for (int i = 0; i < Rotors; ++i) {
    const Vector2 thrust(thrusts(2 * i), thrusts(2 * i + 1));
    Scalar angle(0), follow(1);
    bool waiting = at_end[detail::size(i)];
    if (limits_.tilts(i)) {
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
    const Vector2 unit = Limits::direction(angle);
    const Scalar size =
        std::max(limits_.min_thrust(i), std::min(thrust.dot(unit), limits_.max_thrust(i)));
    const Vector2 given = size * unit, lost = thrust - given;
    if (lost.norm() > Scalar(4) * limits_.tolerance())
      (follow < Scalar(1) ? holds : waiting ? waits : cuts) = true;
    thrusts(2 * i) = given.x();
    thrusts(2 * i + 1) = given.y();
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
  result.achieved = detail::wrench_of(matrix_, thrusts);
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
  for (int i = 0; i < Rotors; ++i)
    result.command.rotor_speed(i) += rotor_lead_(i) * ahead.rotor_acceleration(i);
  result.command = within_limits(result.command);
  return result;
}

template <int Rotors, typename Scalar>
ActuatorRates<Rotors, Scalar> Allocation<Rotors, Scalar>::rates(
    const Wrench<Scalar>& wrench, const Wrench<Scalar>& wrench_rate) const noexcept {
  const Thrusts thrusts = least_thrusts(wrench), slopes = least_thrusts(wrench_rate);
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
    if (limits_.tilts(i))
      command.tilt_angle(i) = limits_.bounded_angle(std::isfinite(angle) ? angle : Scalar(0));
  }
  return command;
}

/// Largest s in [0, most] up to which `allocation` gives the wrench from + s along with a status
/// other than limited. Computed by bisection to `accuracy` of `most`, at least 1e-12. Returns zero
/// if `allocation` does not give `from`. If the set of reachable wrenches is not convex, as with
/// servos of a short range, there may be a gap below the result.
template <int Rotors>
[[nodiscard]] double reach(const Allocation<Rotors>& allocation, const Wrenchd& from,
                           const Wrenchd& along, double most, double accuracy = 1e-12) {
  double within = 0.0, beyond = most;
  for (double width = 1.0; width > std::max(1e-12, accuracy); width /= 2.0) {
    const double middle = 0.5 * (within + beyond);
    const Wrenchd wrench{from.force + middle * along.force, from.torque + middle * along.torque};
    const bool reached = allocation.allocate(wrench, {}).status != AllocationStatus::limited;
    (reached ? within : beyond) = middle;
  }
  return within;
}

/// Level hover and the wrench that remains beyond it, at rest. Ignores lags of servos and rotors.
struct ControlAuthority {
  /// Rank of A, see AllocationMatrix; below 6 Allocation and Nmpc reject the vehicle.
  int rank = 0;
  /// Largest singular value of A / smallest, with torques in units of the vehicle's size: thrusts
  /// of the most expensive wrench / those of the cheapest. Infinite below rank 6.
  double condition = std::numeric_limits<double>::infinity();
  /// True if the vehicle carries its weight without torque, with all thrusts within limits.
  bool hovers = false;
  /// Smallest thrust of a rotor that is not lost, in hover by the command of Allocation [N]. If it
  /// is near zero, a thrust in the opposite direction requires half a turn of the servo.
  double least_thrust = 0.0;
  /// Largest force [N] and torque [N m] along each body axis, F then M, that Allocation adds to
  /// hover with nothing lost. One magnitude per direction. Zero if the vehicle does not hover.
  Eigen::Matrix<double, 6, 1> forward = Eigen::Matrix<double, 6, 1>::Zero();
  Eigen::Matrix<double, 6, 1> backward = Eigen::Matrix<double, 6, 1>::Zero();
};

/// Control authority of a vehicle of any rank. Below rank 6 all members except the rank keep their
/// defaults, although a flat quadrotor, for example, does hover. Uses bisection and takes about a
/// millisecond. Allocates. Throws std::invalid_argument if the vehicle fails validate().
template <int Rotors>
[[nodiscard]] ControlAuthority control_authority(const Vehicle<Rotors>& vehicle) {
  validate(vehicle);
  ControlAuthority authority;
  const auto singular = AllocationMatrix<Rotors>::singular_values(vehicle);
  authority.rank = static_cast<int>((singular.array() > 1e-6 * singular(0)).count());
  if (authority.rank < 6) return authority;
  authority.condition = singular(0) / singular(5);

  const Allocation<Rotors> allocation(vehicle);
  Wrenchd hover;
  hover.force.z() = vehicle.body.mass * gravity;
  const auto level = allocation.allocate(hover, {});
  authority.hovers = level.status != AllocationStatus::limited;
  if (!authority.hovers) return authority;

  authority.least_thrust = largest_max_thrust(vehicle);
  double lever = 0.0;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorGeometry& rotor = vehicle.rotors[i];
    const RotorParameters& parameters = rotor_parameters(vehicle, i);
    lever = std::max(lever, rotor.position.norm() + parameters.torque_ratio);
    const double thrust =
        rotor.effectiveness *
        thrust_from_speed(level.command.rotor_speed(static_cast<Eigen::Index>(i)), parameters);
    if (rotor.effectiveness > 0.0)
      authority.least_thrust = std::min(authority.least_thrust, thrust);
  }

  const double most = 2.0 * Rotors * largest_max_thrust(vehicle);  // hover thrust plus full thrust
  for (int axis = 0; axis < 6; ++axis) {
    const double end = axis < 3 ? most : most * lever;
    Wrenchd along;
    double& component = axis < 3 ? along.force(axis) : along.torque(axis - 3);
    component = 1.0;
    authority.forward(axis) = reach(allocation, hover, along, end);
    component = -1.0;
    authority.backward(axis) = reach(allocation, hover, along, end);
  }
  return authority;
}

}  // namespace tilt_ropter
