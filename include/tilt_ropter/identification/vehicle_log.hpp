// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

/// Log of one flight for the identification of a vehicle, and replay of its actuator commands.
namespace tilt_ropter {

/// Measurements and commands of one flight. The stamps of each list must increase, also unevenly.
template <int Rotors>
struct VehicleLog {
  using RotorVector = Eigen::Matrix<double, Rotors, 1>;

  std::vector<Timed<InertialSampled>> imu;  ///< at least 100 Hz
  std::vector<Timed<MarkerPosed>> poses;    ///< of the body frame of the vehicle
  /// Commands to the actuators; each holds from its time until the next one.
  std::vector<Timed<ActuatorState<Rotors>>> commands;
  std::vector<Timed<RotorVector>> rotor_speeds;  ///< measured [rad/s]; may be empty
};

namespace detail {

/// True if the stamps of `list` are finite and increase, and `value_is_good` accepts each value.
template <typename List, typename Check>
[[nodiscard]] bool is_good_list(const List& list, const Check& value_is_good) {
  for (std::size_t i = 0; i < list.size(); ++i) {
    if (!std::isfinite(list[i].time) || !value_is_good(list[i].value)) return false;
    if (i > 0 && !(list[i].time > list[i - 1].time)) return false;
  }
  return true;
}

template <int Rotors>
[[nodiscard]] bool is_good_log(const VehicleLog<Rotors>& log) {
  const auto imu = [](const InertialSampled& x) {
    return all_finite(x.angular_velocity) && all_finite(x.specific_force);
  };
  const auto pose = [](const MarkerPosed& x) {
    return all_finite(x.position) && all_finite(x.orientation.coeffs()) &&
           x.orientation.squaredNorm() > 1e-6;
  };
  const auto command = [](const ActuatorState<Rotors>& x) {
    return all_finite(x.rotor_speed) && all_finite(x.tilt_angle);
  };
  const auto is_during = [&log](const auto& list) {  // of one clock and in one unit
    if (list.empty() || log.imu.empty()) return true;
    const double middle = list[list.size() / 2].time;
    return middle > log.imu.front().time - 1.0 && middle < log.imu.back().time + 1.0;
  };
  return is_good_list(log.imu, imu) && is_good_list(log.poses, pose) &&
         is_good_list(log.commands, command) &&
         is_good_list(log.rotor_speeds, [](const auto& x) { return all_finite(x); }) &&
         is_during(log.poses) && is_during(log.commands) && is_during(log.rotor_speeds);
}

/// Index of the last element of `list` at or before `time`, or 0 if there is none.
template <typename List>
[[nodiscard]] std::size_t index_before(const List& list, double time) {
  const auto after = std::upper_bound(list.begin(), list.end(), time,
                                      [](double t, const auto& x) { return t < x.time; });
  return after == list.begin() ? 0 : static_cast<std::size_t>(after - list.begin()) - 1;
}

/// Orientation at `time`, interpolated between two poses.
[[nodiscard]] inline Eigen::Quaterniond orientation_at(const std::vector<Timed<MarkerPosed>>& poses,
                                                       double time) {
  const std::size_t i = index_before(poses, time), next = std::min(i + 1, poses.size() - 1);
  Eigen::Quaterniond from = poses[i].value.orientation.normalized();
  if (next == i) return from;
  const double part = (time - poses[i].time) / (poses[next].time - poses[i].time);
  const Eigen::Quaterniond to = poses[next].value.orientation.normalized();
  const Vector3<double> turn = quaternion_log(Eigen::Quaterniond(from.conjugate() * to));
  return from * quaternion_exp(Vector3<double>(std::clamp(part, 0.0, 1.0) * turn));
}

/// First-order lag with dead time and rate limit.
struct LagModel {
  double time_constant = 0.1;  ///< [s]
  double dead_time = 0.0;      ///< [s]; a negative one brings the commands forward
  double max_rate = 1e9;       ///< [1/s]
};

/// Replays `value_of(command)` through `lag` and calls `on_stamp(i, value, rate)` for each of
/// `stamps`. Exact for commands that hold until the next one. Starts at the first command.
template <typename Commands, typename Stamps, typename ValueOf, typename OnStamp>
void replay(const Commands& commands, const Stamps& stamps, const LagModel& lag,
            const ValueOf& value_of, const OnStamp& on_stamp) {
  const double knee = lag.max_rate * lag.time_constant;
  double value = value_of(commands.front().value), target = value;
  double now = std::min(commands.front().time + lag.dead_time, stamps.front().time);
  double known_duration = -1.0, known_rest = 1.0;  // spares most calls of exp
  const auto move_to = [&](double time) {
    double duration = time - now;
    if (!(duration > 0.0)) return;
    now = time;
    double error = target - value;
    if (std::abs(error) > knee) {
      const double direction = error > 0.0 ? 1.0 : -1.0;
      const double ramp = (std::abs(error) - knee) / lag.max_rate;
      if (ramp >= duration) {
        value += direction * lag.max_rate * duration;
        return;
      }
      error = direction * knee;
      duration -= ramp;
    }
    if (std::abs(duration - known_duration) > 1e-12) {
      known_duration = duration;
      known_rest = std::exp(-duration / lag.time_constant);
    }
    value = target - error * known_rest;
  };
  std::size_t next = 1;
  for (std::size_t i = 0; i < stamps.size(); ++i) {
    for (; next < commands.size() && commands[next].time + lag.dead_time <= stamps[i].time;
         ++next) {
      move_to(commands[next].time + lag.dead_time);
      target = value_of(commands[next].value);
    }
    move_to(stamps[i].time);
    on_stamp(i, value,
             std::clamp((target - value) / lag.time_constant, -lag.max_rate, lag.max_rate));
  }
}

}  // namespace detail

}  // namespace tilt_ropter
