// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/delay_queue.hpp>
#include <tilt_ropter/simulation/wheel_contact.hpp>

#include <Eigen/Core>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

/// The vehicle to try a controller on: rigid body, rotors, tilt servos, and wheels or legs on flat
/// ground. It shares parameter and state types with the controller's model but none of its code, so
/// that each can be tested against the other, and its Vehicle is the true one, which the controller
/// need not know exactly.
namespace tilt_ropter {

/// What Plant has beyond its Vehicle.
struct PlantParameters {
  WheelContactParameters contact;
  Eigen::Vector3d linear_drag =
      Eigen::Vector3d::Zero();  ///< drag force / CoM velocity along each body axis [N s/m]
  double max_substep = 2.5e-4;  ///< of the integration [s]
};

/// Throws std::invalid_argument naming the field, its value and what is allowed.
inline void validate(const PlantParameters& p) {
  validate(p.contact);
  require_non_negative("PlantParameters.linear_drag [N s/m]", p.linear_drag);
  require(std::isfinite(p.max_substep) && p.max_substep >= 1e-7, "PlantParameters.max_substep [s]",
          p.max_substep, "finite and >= 1e-7");
}

/// All that changes in a Plant, but commands on their way.
template <int Rotors>
struct PlantState {
  double time = 0.0;  ///< [s]
  BodyState<> body;
  ActuatorState<Rotors> actuators;
  std::array<WheelState, 4> wheels;  ///< or feet, as PlantLoads has them
};

/// Throws std::invalid_argument naming the field, its value and what is allowed.
template <int Rotors>
void validate(const PlantState<Rotors>& x) {
  const BodyState<>& body = x.body;
  require_finite("PlantState.time [s]", x.time);
  require_finite("PlantState.body.position [m]", body.position);
  require_finite("PlantState.body.velocity [m/s]", body.velocity);
  require(all_finite(body.orientation.coeffs()) && body.orientation.squaredNorm() > 1e-6,
          "PlantState.body.orientation", body.orientation.coeffs().transpose(),
          "finite and not zero");
  require_finite("PlantState.body.angular_velocity [rad/s]", body.angular_velocity);
  require_non_negative("PlantState.actuators.rotor_speed [rad/s]", x.actuators.rotor_speed);
  require_finite("PlantState.actuators.tilt_angle [rad]", x.actuators.tilt_angle);
  for (const WheelState& wheel : x.wheels)
    require_finite("PlantState.wheels (angle, spin, bristle)",
                   Eigen::Vector4d(wheel.angle, wheel.spin, wheel.bristle.x(), wheel.bristle.y()));
}

/// What acts on the body, in the body frame.
struct PlantLoads {
  Wrench<> actuators;  ///< of the rotors
  Wrench<> contact;    ///< of the ground
  Wrench<> external;   ///< all but rotors and gravity: contact, disturbance, drag, and the bearing
                       ///< and gyroscopic torque of the spinning wheels
  Eigen::Vector3d specific_force = Eigen::Vector3d::Zero();        ///< at the CoM [m/s^2]
  Eigen::Vector3d angular_acceleration = Eigen::Vector3d::Zero();  ///< [rad/s^2]
  /// Right and left (-y, +y) of the front axle or of the only one, of the rear axle. Feet likewise.
  std::array<WheelForces, 4> wheels;
};

/// The body obeys the paper's Eqs. rb1-rb4 with `actuators` and `external` of PlantLoads; its
/// inertia is that of everything, the wheels' about their axle excepted. Rotor i pushes with
/// its effectiveness times the thrust of its RotorParameters' curve along its axis at its position,
/// tilted by its angle, and turns the body against its spin by torque_ratio times that; rotor
/// inertia is neglected, as in the paper. Rotor speeds and tilt angles follow their commands by
/// first-order lags, the servos within their rate and after their dead time; commands out of range
/// are cut to it.
///
/// A step is divided into equal substeps of a fourth-order Runge-Kutta method. They are no longer
/// than max_substep or the inverse of the fastest rate of the parameters, so that stiff wheels and
/// quick motors stay stable. Contact is not smooth, there the order is lower: at the default
/// substep, energy rises at no step by more than rounding where the contact is dissipative.
template <int Rotors>
class Plant {
 public:
  static constexpr double max_step = 10.0;    ///< longest that step() accepts [s]
  static constexpr double max_speed = 1.0e4;  ///< of body and wheels [m/s, rad/s]

  /// Starts at time zero, standing with stopped rotors; a vehicle without wheels or legs starts at
  /// height zero and meets no ground. Allocates, and throws std::invalid_argument for a vehicle or
  /// parameters that are not valid.
  explicit Plant(const Vehicle<Rotors>& vehicle, const PlantParameters& parameters = {})
      : vehicle_(validated(vehicle)),
        parameters_(validated(parameters)),
        inertia_inverse_(vehicle.body.inertia.inverse()),
        mounts_(mounts()),
        min_rotor_speed_(of_rotors([](const auto& p) { return speed_at(p.min_thrust, p); })),
        max_rotor_speed_(of_rotors([](const auto& p) { return speed_at(p.max_thrust, p); })),
        rotor_time_constant_(of_rotors([](const auto& p) { return p.time_constant; })),
        substep_(stable_substep()),
        tilt_commands_(static_cast<std::size_t>(
                           std::min(vehicle.servo.dead_time / substep_, max_pending_commands)) +
                       2) {
    PlantState<Rotors> standing;
    standing.body.position.z() = standing_height();
    reset(standing);
  }

  /// Sets the whole state; commands that wait for the servos' dead time are dropped and the servos
  /// hold their angles. Normalises the quaternion and sets fixed rotors upright. Throws
  /// std::invalid_argument for a state that is not valid.
  void reset(const PlantState<Rotors>& state) {
    validate(state);
    state_ = state;
    state_.body.orientation.normalize();
    for (int i = 0; i < Rotors; ++i)
      if (!rotor(i).tilts) state_.actuators.tilt_angle(i) = 0.0;
    while (tilt_commands_.pop(std::numeric_limits<double>::infinity())) continue;
    command_ = state_.actuators;
    disturbance_ = {};
    loads_ = loads(state_);
  }

  /// The same at time zero, with wheels that do not turn.
  void reset(const BodyState<>& body, const ActuatorState<Rotors>& actuators) {
    PlantState<Rotors> state;
    state.body = body;
    state.actuators = actuators;
    reset(state);
  }

  /// Goes on by `dt` in (0, max_step] [s] with constant command and constant disturbance, a wrench
  /// at the CoM in the body frame. Never throws or allocates. Returns false, with the state as it
  /// was, if an argument is not finite, dt is out of range, or the body or a wheel would become
  /// faster than max_speed.
  bool step(const ActuatorState<Rotors>& command, const Wrench<>& disturbance, double dt) noexcept {
    if (!(dt > 0.0 && dt <= max_step) || !all_finite(command.rotor_speed) ||
        !all_finite(command.tilt_angle) || !is_finite(disturbance))
      return false;
    const PlantState<Rotors> before = state_;
    disturbance_ = disturbance;
    command_.rotor_speed = command.rotor_speed.cwiseMax(min_rotor_speed_)
                               .cwiseMin(top_speed_share_ * max_rotor_speed_);
    tilt_commands_.push(
        before.time + vehicle_.servo.dead_time,
        command.tilt_angle.cwiseMax(vehicle_.servo.min_angle).cwiseMin(vehicle_.servo.max_angle));

    const int substeps = std::max(1, static_cast<int>(std::ceil(dt / substep_ - 1e-6)));
    for (int i = 0; i < substeps; ++i) {
      while (const auto tilt = tilt_commands_.pop(state_.time)) command_.tilt_angle = *tilt;
      integrate(dt / substeps);
      state_.time = before.time + dt * (i + 1) / substeps;
    }

    const bool sound = is_sound(state_);
    if (!sound) {
      state_ = before;
      disturbance_ = {};
    }
    loads_ = loads(state_);
    for (std::size_t i = 0; i < mounts_.size(); ++i)
      state_.wheels[i].bristle = loads_.wheels[i].bristle;
    return sound;
  }

  /// The battery has `voltage` [V] from the next step on, also after a reset: commands are cut to
  /// top speeds that fall with it in proportion, and do not rise above the nominal voltage. Returns
  /// whether voltage_ratio() accepts it; if not, nothing changes.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(vehicle_.battery, voltage);
    if (ratio) top_speed_share_ = std::min(*ratio, 1.0);
    return ratio.has_value();
  }

  [[nodiscard]] const PlantState<Rotors>& state() const noexcept { return state_; }
  [[nodiscard]] double time() const noexcept { return state_.time; }
  [[nodiscard]] const BodyState<>& body() const noexcept { return state_.body; }
  [[nodiscard]] const ActuatorState<Rotors>& actuators() const noexcept { return state_.actuators; }

  /// What acts on the body in state(), with the last step's disturbance.
  [[nodiscard]] const PlantLoads& loads() const noexcept { return loads_; }
  [[nodiscard]] const Wrench<>& actuator_wrench() const noexcept { return loads_.actuators; }
  [[nodiscard]] const Wrench<>& contact_wrench() const noexcept { return loads_.contact; }
  [[nodiscard]] const Wrench<>& external_wrench() const noexcept { return loads_.external; }
  /// What an ideal IMU at the CoM reports.
  [[nodiscard]] InertialSample<> inertial_sample() const noexcept {
    return {state_.body.angular_velocity, loads_.specific_force};
  }
  [[nodiscard]] const Eigen::Vector3d& specific_force() const noexcept {
    return loads_.specific_force;
  }

  /// Normal force of the ground on each wheel or foot of PlantLoads [N].
  [[nodiscard]] Eigen::Vector4d normal_forces() const noexcept {
    return {loads_.wheels[0].normal_force, loads_.wheels[1].normal_force,
            loads_.wheels[2].normal_force, loads_.wheels[3].normal_force};
  }

  /// Height of the CoM at which wheels or legs carry the whole upright vehicle, zero without [m].
  [[nodiscard]] double standing_height() const noexcept {
    if (mounts_.empty()) return 0.0;
    return mounts_[0].radius - mounts_[0].centre.z() -
           vehicle_.body.mass * gravity /
               (static_cast<double>(mounts_.size()) * parameters_.contact.stiffness);
  }

  /// Longest substep that is used [s].
  [[nodiscard]] double substep() const noexcept { return substep_; }

 private:
  /// The time derivative of a state, field by field; that of the quaternion is not a unit.
  using Rate = PlantState<Rotors>;

  static constexpr double max_pending_commands = 1e5;

  [[nodiscard]] const RotorGeometry& rotor(int i) const noexcept {
    return vehicle_.rotors[static_cast<std::size_t>(i)];
  }

  using RotorVector = Eigen::Matrix<double, Rotors, 1>;

  [[nodiscard]] const RotorParameters& parameters_of(int i) const noexcept {
    return rotor_parameters(vehicle_, static_cast<std::size_t>(i));
  }

  template <typename Value>
  [[nodiscard]] RotorVector of_rotors(const Value& value) const {
    RotorVector values;
    for (int i = 0; i < Rotors; ++i) values(i) = value(parameters_of(i));
    return values;
  }

  /// The speed [rad/s] at which the curve gives `thrust` [N], the larger root of a square.
  [[nodiscard]] static double speed_at(double thrust, const RotorParameters& p) noexcept {
    const double middle = -0.5 * p.linear_thrust_coefficient / p.thrust_coefficient;
    const double square = thrust / p.thrust_coefficient, root = std::sqrt(middle * middle + square);
    return middle < 0.0 ? square / (root - middle) : middle + root;  // without cancellation
  }

  [[nodiscard]] std::vector<WheelMount> mounts() const {
    constexpr double foot_radius = 0.01;
    double along = 0.0, aside = 0.0, below = 0.0;
    WheelMount mount;
    if (vehicle_.wheels) {
      along = 0.5 * vehicle_.wheels->wheel_base;
      aside = vehicle_.wheels->half_track;
      mount.radius = vehicle_.wheels->radius;
    } else if (vehicle_.legs) {
      along = vehicle_.legs->half_length;
      aside = vehicle_.legs->half_width;
      mount.radius = std::min(foot_radius, vehicle_.legs->height);
      mount.locked = true;
      below = vehicle_.legs->height - mount.radius;
    } else {
      return {};
    }
    std::vector<WheelMount> all(along > 0.0 ? 4 : 2, mount);
    for (std::size_t i = 0; i < all.size(); ++i)
      all[i].centre = parameters_.contact.axle_position +
                      Eigen::Vector3d(i < 2 ? along : -along, i % 2 == 0 ? -aside : aside, -below);
    return all;
  }

  /// At most max_substep; throws if that cannot be made stable in reasonable time.
  [[nodiscard]] double stable_substep() const {
    double fastest = 1.0 / vehicle_.servo.time_constant;
    for (int i = 0; i < Rotors; ++i)
      fastest = std::max(fastest, 1.0 / parameters_of(i).time_constant);
    for (const WheelMount& mount : mounts_)
      fastest = std::max(fastest, fastest_contact_rate(parameters_.contact, mount, vehicle_.body));
    require(fastest <= 1e7, "Plant: fastest rate of rotors, servos and contact [1/s]", fastest,
            "at most 1e7");
    return std::min(parameters_.max_substep, 1.0 / fastest);
  }

  [[nodiscard]] static bool is_sound(const PlantState<Rotors>& x) noexcept {
    const auto slow = [](const auto& rate) { return rate.squaredNorm() <= max_speed * max_speed; };
    bool sound = std::isfinite(x.time) && is_finite(x.body) && slow(x.body.velocity) &&
                 slow(x.body.angular_velocity) && all_finite(x.actuators.rotor_speed) &&
                 all_finite(x.actuators.tilt_angle);
    for (const WheelState& wheel : x.wheels)
      sound = sound && std::isfinite(wheel.angle) && std::abs(wheel.spin) <= max_speed &&
              all_finite(wheel.bristle);
    return sound;
  }

  [[nodiscard]] Wrench<> rotor_wrench(const ActuatorState<Rotors>& actuators) const noexcept {
    Wrench<> sum;
    for (int i = 0; i < Rotors; ++i) {
      const RotorGeometry& geometry = rotor(i);
      const RotorParameters& p = parameters_of(i);
      const double speed = actuators.rotor_speed(i), tilt = actuators.tilt_angle(i);
      const double per_speed = geometry.effectiveness * p.thrust_coefficient * speed +
                               geometry.effectiveness * p.linear_thrust_coefficient;
      const double thrust = std::max(per_speed, 0.0) * speed;
      const double reaction = -static_cast<int>(geometry.spin) * p.torque_ratio;
      const Eigen::Vector3d force = thrust * (std::cos(tilt) * geometry.orientation.col(2) -
                                              std::sin(tilt) * geometry.orientation.col(1));
      sum.force += force;
      sum.torque += geometry.position.cross(force) + reaction * force;
    }
    return sum;
  }

  [[nodiscard]] PlantLoads loads(const PlantState<Rotors>& x) const noexcept {
    const Eigen::Matrix3d rotation = x.body.orientation.toRotationMatrix();
    const Eigen::Vector3d& w = x.body.angular_velocity;
    const Eigen::Vector3d axle = Eigen::Vector3d::UnitY();
    PlantLoads result;
    result.actuators = rotor_wrench(x.actuators);
    Wrench<>& external = result.external;
    external = disturbance_;
    external.force -= parameters_.linear_drag.cwiseProduct(rotation.transpose() * x.body.velocity);
    for (std::size_t i = 0; i < mounts_.size(); ++i) {
      const WheelForces forces =
          wheel_contact(parameters_.contact, mounts_[i], x.body, rotation, x.wheels[i]);
      const double momentum = parameters_.contact.wheel_inertia * x.wheels[i].spin;
      result.contact.force += forces.ground.force;
      result.contact.torque += forces.ground.torque;
      external.torque += forces.bearing_torque * axle - w.cross(momentum * axle);
      result.wheels[i] = forces;
    }
    external.force += result.contact.force;
    external.torque += result.contact.torque;
    result.specific_force = (result.actuators.force + external.force) / vehicle_.body.mass;
    result.angular_acceleration = inertia_inverse_ * (result.actuators.torque + external.torque -
                                                      w.cross(vehicle_.body.inertia * w));
    return result;
  }

  [[nodiscard]] Rate rate(const PlantState<Rotors>& x, const PlantLoads& on_x) const noexcept {
    Rate r;
    const Eigen::Quaterniond& q = x.body.orientation;
    r.body.position = x.body.velocity;
    r.body.velocity = q.toRotationMatrix() * on_x.specific_force;
    r.body.velocity.z() -= gravity;
    const Eigen::Vector3d half = 0.5 * x.body.angular_velocity;
    r.body.orientation = q * Eigen::Quaterniond(0.0, half.x(), half.y(), half.z());
    r.body.angular_velocity = on_x.angular_acceleration;
    r.actuators.rotor_speed =
        (command_.rotor_speed - x.actuators.rotor_speed).cwiseQuotient(rotor_time_constant_);
    for (int i = 0; i < Rotors; ++i) {
      const double free =
          (command_.tilt_angle(i) - x.actuators.tilt_angle(i)) / vehicle_.servo.time_constant;
      const double limit = rotor(i).tilts ? vehicle_.servo.max_rate : 0.0;
      r.actuators.tilt_angle(i) = std::clamp(free, -limit, limit);
    }
    for (std::size_t i = 0; i < mounts_.size(); ++i) {
      r.wheels[i].angle = x.wheels[i].spin;
      r.wheels[i].spin = on_x.wheels[i].axle_torque / parameters_.contact.wheel_inertia;
      r.wheels[i].bristle = on_x.wheels[i].slip;
    }
    return r;
  }

  /// x += h * r, without normalising the quaternion.
  static void advance(PlantState<Rotors>& x, const Rate& r, double h) noexcept {
    x.body.position += h * r.body.position;
    x.body.velocity += h * r.body.velocity;
    x.body.orientation.coeffs() += h * r.body.orientation.coeffs();
    x.body.angular_velocity += h * r.body.angular_velocity;
    x.actuators.rotor_speed += h * r.actuators.rotor_speed;
    x.actuators.tilt_angle += h * r.actuators.tilt_angle;
    for (std::size_t i = 0; i < x.wheels.size(); ++i) {
      x.wheels[i].angle += h * r.wheels[i].angle;
      x.wheels[i].spin += h * r.wheels[i].spin;
      x.wheels[i].bristle += h * r.wheels[i].bristle;
    }
  }

  /// One substep of the classical Runge-Kutta method.
  void integrate(double h) noexcept {
    const PlantLoads now = loads(state_);
    for (std::size_t i = 0; i < mounts_.size(); ++i)
      state_.wheels[i].bristle = now.wheels[i].bristle;
    PlantState<Rotors> next = state_, stage;
    Rate r = rate(state_, now);
    advance(next, r, h / 6.0);
    for (const double part : {0.5, 0.5, 1.0}) {
      stage = state_;
      advance(stage, r, part * h);
      r = rate(stage, loads(stage));
      advance(next, r, h / (part < 1.0 ? 3.0 : 6.0));
    }
    next.body.orientation.normalize();
    state_ = next;
  }

  Vehicle<Rotors> vehicle_;
  PlantParameters parameters_;
  Eigen::Matrix3d inertia_inverse_;
  std::vector<WheelMount> mounts_;                 ///< none, two or four
  RotorVector min_rotor_speed_, max_rotor_speed_;  ///< [rad/s]
  RotorVector rotor_time_constant_;                ///< [s]
  double top_speed_share_ = 1.0;                   ///< that the voltage leaves of max_rotor_speed_
  double substep_;
  detail::DelayQueue<Eigen::Matrix<double, Rotors, 1>> tilt_commands_;
  ActuatorState<Rotors> command_;  ///< within range; its tilt angles after the dead time
  Wrench<> disturbance_;
  PlantState<Rotors> state_;
  PlantLoads loads_;
};

}  // namespace tilt_ropter
