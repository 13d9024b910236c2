// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/identification/detail/vehicle_fit.hpp>
#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

/// Identification of a vehicle from the log of one flight.
namespace tilt_ropter {

/// A flight shows only the ratio of mass and thrust. One of the two has to be known.
enum class TrustedScale {
  mass,               ///< the given mass is right; the thrust coefficient is identified
  thrust_coefficient  ///< the given thrust coefficient is right; the mass is identified
};

/// Quantities that identify_vehicle() finds, in the order of VehicleIdentification::parameters.
enum class VehicleParameter {
  thrust_per_mass,  ///< thrust coefficient / mass, as a ratio to that of the given vehicle
  com_x,            ///< CoM in the body frame of the given vehicle [m]
  com_y,
  com_z,
  inertia_x,  ///< about the CoM [kg m^2]
  inertia_y,
  inertia_z,
  torque_ratio,         ///< RotorParameters::torque_ratio of the common rotor [m]
  servo_time_constant,  ///< [s]
  servo_dead_time,      ///< from command to first motion, with the delay of the link [s]
  rotor_time_constant,  ///< of the common rotor [s]
  rotor_dead_time,      ///< from command to first change, with the delay of the link [s]
  drag_x,               ///< drag force / velocity, per body axis [N s/m]
  drag_y,
  drag_z,
  arm_inertia,  ///< of an arm with its motor about the axis of its servo [kg m^2]
  arm_moment,   ///< mass of an arm times height of its CoM above this axis [kg m]
  count
};

/// Name of a parameter, as in the output of the program identify_vehicle.
[[nodiscard]] constexpr const char* to_string(VehicleParameter parameter) noexcept {
  return detail::name_in(
      {"thrust_per_mass", "com_x", "com_y", "com_z", "inertia_x", "inertia_y", "inertia_z",
       "torque_ratio", "servo_time_constant", "servo_dead_time", "rotor_time_constant",
       "rotor_dead_time", "drag_x", "drag_y", "drag_z", "arm_inertia", "arm_moment"},
      parameter);
}

/// How identify_vehicle() reads a log and which results it accepts.
struct VehicleIdentificationSettings {
  TrustedScale trusted = TrustedScale::mass;
  Eigen::Vector3d imu_position =
      Eigen::Vector3d::Zero();  ///< of the IMU in the body frame of the given vehicle [m]
  /// Only parts of the flight higher than this count [m].
  double min_height = -std::numeric_limits<double>::infinity();
  static constexpr double min_duration = 5.0;  ///< required duration of these parts [s]
  /// A parameter counts as excited if the half-width of its 95 % interval is at most this:
  static constexpr double max_ratio = 0.2;  ///< of scales, inertias, time constants: a fraction
  static constexpr double max_com = 0.005;  ///< [m]
  static constexpr double max_dead_time = 0.01;    ///< [s]
  static constexpr double max_drag = 0.2;          ///< per mass [1/s]
  static constexpr double max_arm_inertia = 0.1;   ///< fraction of the smallest moment of inertia
  static constexpr double max_arm_moment = 0.003;  ///< per mass [m]
};

inline void validate(const VehicleIdentificationSettings& s) {
  require_finite("VehicleIdentificationSettings.imu_position [m]", s.imu_position);
  require(!std::isnan(s.min_height), "VehicleIdentificationSettings.min_height [m]", s.min_height,
          "a number");
}

/// Whether the log was identified and, if not, the reason.
enum class VehicleIdentificationStatus {
  identified,
  /// A number is not finite, or the stamps of a list do not increase or are not those of the IMU.
  bad_log,
  no_commands,      ///< fewer than two poses or commands, or fewer than 100 IMU samples
  too_short,        ///< fewer seconds in flight than min_duration
  nothing_excited,  ///< the log determines no parameter
  no_convergence,
  // Refused after a fit, which is reported but is not that of a vehicle like the given one:
  does_not_fit,   ///< more than a fifth of the variance of a measurement is not explained
  implausible,    ///< a parameter is far from that of the given vehicle
  commands_late,  ///< the actuators move before their commands
};

[[nodiscard]] constexpr const char* to_string(VehicleIdentificationStatus status) noexcept {
  return detail::name_in(
      {"identified",
       "a number is not finite, or time stamps do not increase or have another clock or unit",
       "too few IMU samples, poses or commands", "too short: too few seconds in flight",
       "nothing excited: the log determines no parameter", "the fit does not converge",
       "the model does not fit: are axes, signs and the order of the rotors right?",
       "a parameter is implausible: are the units of time, force, angle and speed right?",
       "the actuators move before their commands: are the times those of one clock?"},
      status);
}

/// One identified quantity; its 95 % confidence interval is value +- half_width.
struct IdentifiedParameter {
  double value = 0.0;
  double half_width = 0.0;
  /// False: the flight did not excite it. `value` is that of the given vehicle, and `half_width` is
  /// that of the estimate that was dropped.
  bool excited = false;
};

/// Measured and fitted means in one window of the log, body frame.
struct IdentificationSample {
  double time = 0.0;                                                  ///< [s]
  Eigen::Vector3d specific_force, fitted_specific_force;              ///< [m/s^2]
  Eigen::Vector3d angular_acceleration, fitted_angular_acceleration;  ///< [rad/s^2]
};

/// Result of identify_vehicle().
template <int Rotors>
struct VehicleIdentification {
  VehicleIdentificationStatus status = VehicleIdentificationStatus::no_convergence;
  /// The given vehicle with what was identified. Its body frame has its origin at the identified
  /// CoM. min_thrust and max_thrust belong to the same rotor speeds as before.
  Vehicle<Rotors> vehicle;
  std::array<IdentifiedParameter, static_cast<std::size_t>(VehicleParameter::count)> parameters;
  double duration = 0.0;                           ///< of the part of the flight that was used [s]
  double force_residual_rms = 0.0;                 ///< per axis [m/s^2]
  double angular_acceleration_residual_rms = 0.0;  ///< per axis [rad/s^2]
  /// Fraction of the time in which a servo turns at its rate limit, which the model contains.
  double rate_limited_fraction = 0.0;
  std::vector<IdentificationSample> samples;

  [[nodiscard]] const IdentifiedParameter& operator[](VehicleParameter p) const {
    return parameters[static_cast<std::size_t>(p)];
  }
};

namespace detail {

/// Value of the given vehicle, and whether the unknown is the logarithm of a ratio to it.
struct GivenParameter {
  double value;
  bool is_ratio;
};

template <int Rotors>
[[nodiscard]] GivenParameter given_parameter(const Vehicle<Rotors>& v, int i) {
  using I = FitIndex;
  if (i == I::scale) return {1.0, true};
  if (i >= I::inertia && i < I::torque_ratio)
    return {v.body.inertia(i - I::inertia, i - I::inertia), true};
  if (i == I::torque_ratio) return {v.rotor.torque_ratio, true};
  if (i == I::servo_lag) return {v.servo.time_constant, true};
  if (i == I::rotor_lag) return {v.rotor.time_constant, true};
  if (i == I::servo_delay) return {v.servo.dead_time, false};
  return {0.0, false};
}

/// Largest half-width, of the unknown, with which it counts as excited.
template <int Rotors>
[[nodiscard]] double largest_half_width(const VehicleIdentificationSettings& s,
                                        const Vehicle<Rotors>& v, int i) {
  using I = FitIndex;
  if (given_parameter(v, i).is_ratio) return s.max_ratio;
  if (i >= I::com && i < I::inertia) return s.max_com;
  if (i == I::servo_delay || i == I::rotor_delay) return s.max_dead_time;
  if (i == I::arm_inertia) return s.max_arm_inertia * v.body.inertia.diagonal().minCoeff();
  return (i == I::arm_moment ? s.max_arm_moment : s.max_drag) * v.body.mass;
}

/// Half-width of an error of the model in unknown `i`: the bearings of wheels, which the model does
/// not have, turn body and arms about body y. In simulation this is 0.06 % of the inertia.
template <int Rotors>
[[nodiscard]] double model_error(const Vehicle<Rotors>& v, int i) {
  return v.wheels && i == FitIndex::inertia + 1 ? 1e-3 : 0.0;
}

/// True if no vehicle like the given one has unknown `i`: ratios from a fifth to five, a CoM within
/// 0.1 m. A scale beyond 0.4 to 2.5 is another unit of force or speed.
[[nodiscard]] inline bool is_implausible(const FitVector& x, int i, bool is_ratio) noexcept {
  using I = FitIndex;
  if (is_ratio) return !(std::abs(x(i)) <= std::log(i == I::scale ? 2.5 : 5.0));
  return i >= I::com && i < I::inertia && !(std::abs(x(i)) <= 0.1);
}

/// Fraction of the variance of a measurement, over its three axes, that the fit or noise explains:
/// noise differs from one window to the next.
template <typename Sample, typename Vector>
[[nodiscard]] double explained(const std::vector<Sample>& samples, Vector Sample::*measured,
                               Vector Sample::*fitted) {
  Vector mean = Vector::Zero();
  for (const Sample& s : samples) mean += s.*measured / static_cast<double>(samples.size());
  double all = 0.0, left = 0.0;
  Vector last = Vector::Zero();
  for (const Sample& s : samples) {
    const Vector rest = s.*measured - s.*fitted;
    all += (s.*measured - mean).squaredNorm();
    left += rest.dot(last);
    last = rest;
  }
  return 1.0 - left / all;
}

/// The given vehicle with the identified parameters `x`.
template <int Rotors>
[[nodiscard]] Vehicle<Rotors> identified_vehicle(Vehicle<Rotors> v, const FitVector& x,
                                                 TrustedScale trusted) {
  using I = FitIndex;
  const double scale = std::exp(x(I::scale));
  const bool trust_mass = trusted == TrustedScale::mass;
  if (!trust_mass) v.body.mass /= scale;
  for (int i = 0; i < 3; ++i) v.body.inertia(i, i) *= std::exp(x(I::inertia + i));
  for (RotorGeometry& rotor : v.rotors) rotor.position -= x.segment<3>(I::com);
  change_rotor_parameters(v, [&](RotorParameters& rotor) {
    if (trust_mass)
      for (double* thrust : {&rotor.thrust_coefficient, &rotor.linear_thrust_coefficient,
                             &rotor.min_thrust, &rotor.max_thrust})
        *thrust *= scale;
    rotor.torque_ratio *= std::exp(x(I::torque_ratio));
    rotor.time_constant *= std::exp(x(I::rotor_lag));
  });
  v.servo.time_constant *= std::exp(x(I::servo_lag));
  v.servo.dead_time = std::max(0.0, x(I::servo_delay));
  return v;
}

}  // namespace detail

/// Identifies a vehicle from one flight. Geometry, rate limit and range of the servos, and all that
/// the flight did not excite, are those of `given`. The model is that of the library: rigid body,
/// actuators with first-order lags and dead times, thrust along the tilted
/// rotor axes, linear drag, and the reaction of the arms to their own turning. The wind may be a
/// constant horizontal force. The vehicle must not touch anything: see min_height.
///
/// Method: actuator states follow from the commands. Specific force and angular acceleration are
/// averaged in short windows; the angular acceleration is the integral of the gyroscope with the
/// derivative of the window (M. Shinbrot 1957, "modulating functions"), so that no measurement is
/// differentiated. Levenberg-Marquardt fits all unknowns at once, with the accelerometer's bias and
/// the wind. Poses give velocity, attitude and the vertical bias of the accelerometer. Measured
/// rotor speeds give the rotors' lag by themselves and correct the slow part of the modelled speed.
/// Without them, the lag is one of the unknowns.
///
/// The commands of a controller react to the noise of the IMU, which would bias the fit. The last
/// steps therefore use instrumental variables, see detail::VehicleFit::refine().
///
/// Intervals: covariance of the fit with the autocorrelation of the residuals up to 1 s (Newey &
/// West 1987). Without errors of the model, except 0.1 % of inertia_y for the bearings of wheels.
///
/// Allocates; takes about a second for 30 s of log. Throws std::invalid_argument if a setting or
/// the given vehicle is invalid. Does not throw for a bad log; the status reports it.
template <int Rotors>
[[nodiscard]] VehicleIdentification<Rotors> identify_vehicle(
    const VehicleLog<Rotors>& log, const Vehicle<Rotors>& given,
    const VehicleIdentificationSettings& settings = {}) {
  using I = detail::FitIndex;
  using Status = VehicleIdentificationStatus;
  validate(settings);
  validate(given);
  constexpr int count = static_cast<int>(VehicleParameter::count);
  VehicleIdentification<Rotors> result;
  result.vehicle = given;
  result.status = Status::no_commands;
  if (log.imu.size() < 100 || log.poses.size() < 2 || log.commands.size() < 2) return result;
  result.status = Status::bad_log;
  if (!detail::is_good_log(log)) return result;

  detail::VehicleFit<Rotors> fit(log, given, settings.trusted == TrustedScale::mass,
                                 settings.min_height, settings.imu_position);
  result.duration = fit.duration();
  result.status = Status::too_short;
  if (result.duration < settings.min_duration) return result;

  // Holds what the log does not determine, the worst first, and fits the others again.
  // 1.96 for a normal distribution, more because the covariance itself is an estimate.
  constexpr double quantile = 2.1;
  detail::FitVector half_width = detail::FitVector::Zero();
  std::array<bool, static_cast<std::size_t>(count)> dropped{};
  const auto drop_worst = [&] {
    double worst = 1.0;
    int drop = -1;
    for (int i = 0; i < count; ++i) {
      if (fit.holds(i)) continue;
      half_width(i) = std::hypot(quantile * fit.stddevs()(i), detail::model_error(given, i));
      const double excess = half_width(i) / detail::largest_half_width(settings, given, i);
      if (!(excess > worst)) continue;
      worst = excess;
      drop = i;
    }
    if (drop < 0) return false;
    dropped[static_cast<std::size_t>(drop)] = true;
    fit.hold(drop);
    return true;
  };
  bool converged = false;
  do {
    do converged = fit.solve();
    while (drop_worst());
    converged = fit.refine();
  } while (drop_worst());

  const detail::FitVector& x = fit.unknowns();
  bool any = false, implausible = false, late = false;
  for (int i = 0; i < count; ++i) {
    const detail::GivenParameter of_given = detail::given_parameter(given, i);
    IdentifiedParameter& p = result.parameters[static_cast<std::size_t>(i)];
    p.excited = !dropped[static_cast<std::size_t>(i)];
    any = any || p.excited;
    const bool is_delay = i == I::servo_delay || i == I::rotor_delay;
    implausible = implausible || (p.excited && detail::is_implausible(x, i, of_given.is_ratio));
    constexpr double tolerance = 0.003;  // of stamps [s]
    late = late || (p.excited && is_delay && x(i) < -tolerance - half_width(i));
    const double estimate = of_given.is_ratio ? of_given.value * std::exp(x(i)) : x(i);
    p.value = !p.excited ? of_given.value : is_delay ? std::max(0.0, estimate) : estimate;
    p.half_width = of_given.is_ratio ? p.value * half_width(i) : half_width(i);
  }
  result.vehicle = detail::identified_vehicle(given, x, settings.trusted);
  result.rate_limited_fraction = fit.rate_limited();
  const std::array<double, 7>& rms = fit.residual_rms();
  result.force_residual_rms =
      std::sqrt((rms[0] * rms[0] + rms[1] * rms[1] + rms[2] * rms[2]) / 3.0);
  result.angular_acceleration_residual_rms =
      std::sqrt((rms[3] * rms[3] + rms[4] * rms[4] + rms[5] * rms[5]) / 3.0);
  const std::vector<double>& fitted = fit.predicted();
  result.samples.reserve(fit.windows().size());
  for (const detail::FlightWindow& w : fit.windows()) {
    const double* row = fitted.data() + 6 * result.samples.size();
    IdentificationSample sample;
    sample.time = w.time;
    sample.specific_force = w.specific_force;
    sample.angular_acceleration = w.angular_acceleration;
    sample.fitted_specific_force << row[0], row[1], row[2];
    sample.fitted_angular_acceleration << row[3], row[4], row[5];
    result.samples.push_back(sample);
  }
  // The moments must be those of a body: each at most the sum of the others.
  const Eigen::Vector3d moments = result.vehicle.body.inertia.diagonal();
  const bool is_body = 2.0 * moments.maxCoeff() <= moments.sum() * (1.0 + 1e-9);
  using Sample = IdentificationSample;
  constexpr double enough = 0.8;
  const bool unexplained = !(detail::explained(result.samples, &Sample::specific_force,
                                               &Sample::fitted_specific_force) >= enough &&
                             detail::explained(result.samples, &Sample::angular_acceleration,
                                               &Sample::fitted_angular_acceleration) >= enough);
  result.status = !any          ? Status::nothing_excited
                  : !converged  ? Status::no_convergence
                  : implausible ? Status::implausible
                  : unexplained ? Status::does_not_fit
                  : late        ? Status::commands_late
                  : is_body     ? Status::identified
                                : Status::no_convergence;
  return result;
}

}  // namespace tilt_ropter
