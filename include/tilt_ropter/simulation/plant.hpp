// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/detail/delay_queue.hpp>
#include <tilt_ropter/simulation/detail/wall.hpp>
#include <tilt_ropter/simulation/detail/wheel_contact.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <vector>

/// Simulated vehicle for tests of a controller: rigid body, rotors, tilt servos, wheels or legs on
/// flat ground, and a wall. It shares parameter and state types with the controller's model but no
/// code, so each can test the other. Its Vehicle is the true one; the controller may have another.
namespace tilt_ropter {

/// Parameters of Plant in addition to its Vehicle.
struct PlantParameters {
  WheelContactParameters contact;
  Eigen::Vector3d linear_drag =
      Eigen::Vector3d::Zero();  ///< drag force / CoM velocity, per body axis [N s/m]
  /// Torque on the arm / angle by which the servo gives way [N m/rad]. With the default servo it
  /// equals that of a speed loop of 0.2 N m s.
  double servo_stiffness = 2.5;
  double max_substep = 2.5e-4;  ///< longest substep of the integration [s]
};

inline void validate(const PlantParameters& p) {
  validate(p.contact);
  require_non_negative("PlantParameters.linear_drag [N s/m]", p.linear_drag);
  require_positive("PlantParameters.servo_stiffness [N m/rad]", p.servo_stiffness);
  require(std::isfinite(p.max_substep) && p.max_substep >= 1e-7, "PlantParameters.max_substep [s]",
          p.max_substep, "finite and >= 1e-7");
}

/// State of a Plant, without the commands that wait for the servos' dead time.
template <int Rotors>
struct PlantState {
  double time = 0.0;  ///< [s]
  BodyStated body;
  ActuatorState<Rotors> actuators;
  std::array<WheelState, 4> wheels;  ///< or feet, in the order of PlantLoads::wheels
};

template <int Rotors>
void validate(const PlantState<Rotors>& x) {
  const BodyStated& body = x.body;
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

/// Loads and accelerations of the body, in the body frame. Wrenches act at the CoM.
struct PlantLoads {
  Wrenchd actuators;  ///< wrench of the rotors
  Wrenchd contact;    ///< wrench of the ground
  Wrenchd external;  ///< all loads except rotors and gravity: contact, wall, disturbance, drag, and
                     ///< the bearing and gyroscopic torque of the spinning wheels
  double wall_force = 0.0;                                         ///< normal force of the wall [N]
  Eigen::Vector3d specific_force = Eigen::Vector3d::Zero();        ///< at the CoM [m/s^2]
  Eigen::Vector3d angular_acceleration = Eigen::Vector3d::Zero();  ///< [rad/s^2]
  /// Right and left wheel (-y, +y) of the front axle or of the single axle, then of the rear axle.
  /// Feet have the same order.
  std::array<WheelForces, 4> wheels;
  /// Torque of each wheel's bearing on its servo about the tilt axis, zero without one [N m].
  std::array<double, 4> servo_torque{};
};

/// Simulation of a vehicle. The body follows the paper's Eqs. rb1-rb4 with the wrenches `actuators`
/// and `external` of PlantLoads. Its inertia includes all parts except the wheels' inertia about
/// their axle. Rotor i applies a force at its position, along its axis tilted by its angle. The
/// force is its effectiveness times the thrust curve of its RotorParameters. The reaction torque
/// against its spin is torque_ratio times this force. Rotor inertia is neglected, as in the paper.
/// Rotor speeds and tilt angles follow their commands with first-order lags. The servos also have a
/// rate limit and a dead time. Commands out of range are clamped. If the wheels sit on tilting arms
/// (WheelParameters::on_arms), their bearings turn these arms away from the servo's angle by the
/// torque over servo_stiffness.
///
/// A step consists of equal substeps of a fourth-order Runge-Kutta method. A substep is not longer
/// than max_substep or the inverse of the fastest rate of the parameters, so stiff wheels and fast
/// motors stay stable. Contact is not smooth, so the order is lower in contact. If the contact is
/// dissipative, no step at the default substep increases the energy by more than rounding errors.
template <int Rotors>
class Plant {
 public:
  static constexpr double max_step = 10.0;    ///< longest dt that step() accepts [s]
  static constexpr double max_speed = 1.0e4;  ///< limit for body and wheels [m/s, rad/s]

  /// Starts at time zero, standing with stopped rotors. A vehicle without wheels or legs starts at
  /// height zero and has no ground contact. Allocates. Throws std::invalid_argument if the vehicle
  /// or the parameters are invalid, or if their fastest rate exceeds 1e7 1/s.
  explicit Plant(const Vehicle<Rotors>& vehicle, const PlantParameters& parameters = {})
      : vehicle_(validated(vehicle)),
        parameters_(validated(parameters)),
        inertia_inverse_(detail::inverse(vehicle.body.inertia)),
        mounts_(mounts()),
        min_rotor_speed_(of_rotors([](const auto& p) { return speed_at(p.min_thrust, p); })),
        max_rotor_speed_(of_rotors([](const auto& p) { return speed_at(p.max_thrust, p); })),
        rotor_time_constant_(of_rotors([](const auto& p) { return p.time_constant; })),
        substep_(stable_substep()),
        tilt_commands_(static_cast<std::size_t>(
                           std::min(vehicle.servo.dead_time / substep_, max_pending_commands)) +
                       2) {
    for (std::size_t i = 0; i < mounts_.size(); ++i) axle_arms_[i] = axle_arm(vehicle_, i);
    PlantState<Rotors> standing;
    standing.body.position.z() = standing_height();
    reset(standing);
  }

  /// Sets the whole state. Drops the commands that wait for the servos' dead time; the servos hold
  /// their angles. Normalises the quaternion and sets the tilt angle of fixed rotors to zero.
  /// Throws std::invalid_argument if the state is invalid.
  void reset(const PlantState<Rotors>& state) {
    validate(state);
    state_ = state;
    state_.body.orientation.normalize();
    for (int i = 0; i < Rotors; ++i)
      if (!rotor(i).tilts) state_.actuators.tilt_angle(i) = 0.0;
    tilt_commands_.clear();
    command_ = state_.actuators;
    disturbance_ = {};
    loads_ = loads(state_);
  }

  /// The same, at time zero and with wheels that do not turn.
  void reset(const BodyStated& body, const ActuatorState<Rotors>& actuators) {
    PlantState<Rotors> state;
    state.body = body;
    state.actuators = actuators;
    reset(state);
  }

  /// Simulates `dt` in (0, max_step] [s] with constant `command` and constant `disturbance`, a
  /// wrench at the CoM in the body frame. Returns false and keeps the state if an argument is not
  /// finite, `dt` out of range, or a speed would exceed max_speed. Does not throw or allocate.
  bool step(const ActuatorState<Rotors>& command, const Wrenchd& disturbance, double dt) noexcept {
    if (!(dt > 0.0 && dt <= max_step) || !all_finite(command.rotor_speed) ||
        !all_finite(command.tilt_angle) || !is_finite(disturbance))
      return false;
    const PlantState<Rotors> before = state_;
    disturbance_ = disturbance;
    for (int i = 0; i < Rotors; ++i)
      command_.rotor_speed(i) = std::min(std::max(command.rotor_speed(i), min_rotor_speed_(i)),
                                         top_speed_fraction_ * max_rotor_speed_(i));
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

  /// Sets the battery voltage `voltage` [V] from the next step on. A reset keeps it. Commands are
  /// clamped to the top rotor speeds, which fall in proportion below the nominal voltage. Returns
  /// false and changes nothing if voltage_ratio() does not accept the voltage.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(vehicle_.battery, voltage);
    if (ratio) top_speed_fraction_ = std::min(*ratio, 1.0);
    return ratio.has_value();
  }

  /// Replaces the rotors by those of `vehicle` from the next step on, for example to let one fail
  /// (with_weak_rotor()). Time constants of rotors remain, a servo that no longer tilts keeps its
  /// angle. Throws std::invalid_argument if the vehicle is out of range.
  void set_rotors(const Vehicle<Rotors>& vehicle) {
    vehicle_.rotors = validated(vehicle).rotors;
    min_rotor_speed_ = of_rotors([](const auto& p) { return speed_at(p.min_thrust, p); });
  }

  /// Puts a wall into the world, or removes it, from the next step on. Allocates. Throws
  /// std::invalid_argument if the wall is out of range.
  void set_wall(const std::optional<Wall>& wall) {
    if (wall) validate(*wall);
    hull_ = wall ? detail::hull_of(vehicle_, mounts_, *wall) : std::vector<detail::HullDisc>();
    wall_ = wall.value_or(Wall());
  }

  [[nodiscard]] const PlantState<Rotors>& state() const noexcept { return state_; }
  [[nodiscard]] double time() const noexcept { return state_.time; }
  [[nodiscard]] const BodyStated& body() const noexcept { return state_.body; }
  [[nodiscard]] const ActuatorState<Rotors>& actuators() const noexcept { return state_.actuators; }

  /// Loads on the body in state(), including the disturbance of the last step.
  [[nodiscard]] const PlantLoads& loads() const noexcept { return loads_; }
  [[nodiscard]] const Wrenchd& actuator_wrench() const noexcept { return loads_.actuators; }
  [[nodiscard]] const Wrenchd& contact_wrench() const noexcept { return loads_.contact; }
  [[nodiscard]] const Wrenchd& external_wrench() const noexcept { return loads_.external; }
  [[nodiscard]] double wall_force() const noexcept { return loads_.wall_force; }  ///< normal [N]
  /// Measurement of an ideal IMU at the CoM.
  [[nodiscard]] InertialSampled inertial_sample() const noexcept {
    return {state_.body.angular_velocity, loads_.specific_force};
  }
  [[nodiscard]] const Eigen::Vector3d& specific_force() const noexcept {
    return loads_.specific_force;
  }

  /// Normal force of the ground on each wheel or foot [N], in the order of PlantLoads::wheels.
  [[nodiscard]] Eigen::Vector4d normal_forces() const noexcept {
    return {loads_.wheels[0].normal_force, loads_.wheels[1].normal_force,
            loads_.wheels[2].normal_force, loads_.wheels[3].normal_force};
  }

  /// Largest torque of a wheel's bearing on the servo of its arm [N m]. Zero if no axle tilts.
  [[nodiscard]] double bearing_torque() const noexcept {
    double largest = 0.0;
    for (const double torque : loads_.servo_torque) largest = std::max(largest, std::abs(torque));
    return largest;
  }
  /// Torque on an arm / angle by which its servo gives way [N m/rad].
  [[nodiscard]] double servo_stiffness() const noexcept { return parameters_.servo_stiffness; }

  /// Height of the CoM at which the upright vehicle stands [m]; zero without wheels and legs.
  [[nodiscard]] double standing_height() const noexcept {
    if (mounts_.empty()) return 0.0;
    return mounts_[0].radius - mounts_[0].centre.z() -
           vehicle_.body.mass * gravity /
               (static_cast<double>(mounts_.size()) * parameters_.contact.stiffness);
  }

  /// Longest substep that is used [s].
  [[nodiscard]] double substep() const noexcept { return substep_; }

 private:
  /// Time derivative of a state, field by field; that of the quaternion has no unit length.
  using Rate = PlantState<Rotors>;

  static constexpr double max_pending_commands = 1e5;

  [[nodiscard]] const RotorGeometry& rotor(int i) const noexcept {
    return vehicle_.rotors[static_cast<std::size_t>(i)];
  }

  using RotorVector = Eigen::Matrix<double, Rotors, 1>;
  using Vector = detail::Triple<double>;

  [[nodiscard]] static Wrenchd wrench_of(const Vector& force, const Vector& torque) noexcept {
    Wrenchd wrench;
    put(force, wrench.force);
    put(torque, wrench.torque);
    return wrench;
  }

  [[nodiscard]] const RotorParameters& parameters_of(int i) const noexcept {
    return rotor_parameters(vehicle_, static_cast<std::size_t>(i));
  }

  template <typename Value>
  [[nodiscard]] RotorVector of_rotors(const Value& value) const {
    RotorVector values;
    for (int i = 0; i < Rotors; ++i) values(i) = value(parameters_of(i));
    return values;
  }

  /// Speed [rad/s] at which the thrust curve gives `thrust` [N]: the larger root of a parabola.
  [[nodiscard]] static double speed_at(double thrust, const RotorParameters& p) noexcept {
    const double middle = -0.5 * p.linear_thrust_coefficient / p.thrust_coefficient;
    const double square = thrust / p.thrust_coefficient, root = std::sqrt(middle * middle + square);
    return middle < 0.0 ? square / (root - middle) : middle + root;  // avoids cancellation
  }

  [[nodiscard]] std::vector<WheelMount> mounts() const {
    constexpr double foot_radius = 0.01;
    double along = 0.0, aside = 0.0, below = 0.0;
    WheelMount mount;
    if (vehicle_.wheels) {
      along = 0.5 * vehicle_.wheels->wheel_base;
      aside = vehicle_.wheels->half_track;
      mount.radius = vehicle_.wheels->radius;
      mount.inertia = vehicle_.wheels->inertia;
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

  /// Returns the sign of the tilt axis of a wheel's arm along body y: right arm -1, left arm +1.
  [[nodiscard]] static double tilt_sign(std::size_t wheel) noexcept {
    return wheel % 2 == 0 ? -1.0 : 1.0;
  }

  /// Tilt rate [rad/s] at which the servo of `arm` moves to its command plus `deflection` [rad].
  [[nodiscard]] double tilt_rate(const PlantState<Rotors>& x, int arm,
                                 double deflection) const noexcept {
    const double free = (command_.tilt_angle(arm) + deflection - x.actuators.tilt_angle(arm)) /
                        vehicle_.servo.time_constant;
    const double limit = rotor(arm).tilts ? vehicle_.servo.max_rate : 0.0;
    return std::clamp(free, -limit, limit);
  }

  /// Returns the rate of the axle of `wheel`, an arm, relative to the body about body y [rad/s].
  /// The torque of the bearing depends on this rate, and the rate on this torque; both are linear.
  [[nodiscard]] double axle_rate_of(const PlantState<Rotors>& x, std::size_t wheel) const noexcept {
    const int arm = static_cast<int>(*axle_arms_[wheel]);
    const double gain = parameters_.contact.bearing_friction /
                        (parameters_.servo_stiffness * vehicle_.servo.time_constant);
    const double drag = tilt_sign(wheel) * (x.wheels[wheel].spin - x.body.angular_velocity.y());
    const double free =
        (command_.tilt_angle(arm) - x.actuators.tilt_angle(arm)) / vehicle_.servo.time_constant;
    const double limit = rotor(arm).tilts ? vehicle_.servo.max_rate : 0.0;
    return tilt_sign(wheel) * std::clamp((free + gain * drag) / (1.0 + gain), -limit, limit);
  }

  /// Longest stable substep [s], at most max_substep. Throws if it is too short to compute with.
  [[nodiscard]] double stable_substep() const {
    double fastest = 1.0 / std::min(vehicle_.servo.time_constant, rotor_time_constant_.minCoeff());
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
  [[nodiscard]] Wrenchd rotor_wrench(const ActuatorState<Rotors>& actuators) const noexcept {
    Vector force{}, torque{};
    for (int i = 0; i < Rotors; ++i) {
      const RotorGeometry& geometry = rotor(i);
      const RotorParameters& p = parameters_of(i);
      const double speed = actuators.rotor_speed(i), tilt = actuators.tilt_angle(i);
      const double per_speed = geometry.effectiveness * p.thrust_coefficient * speed +
                               geometry.effectiveness * p.linear_thrust_coefficient;
      const double thrust = std::max(per_speed, 0.0) * speed;
      const double reaction = -static_cast<int>(geometry.spin) * p.torque_ratio;
      const auto arm = detail::square(geometry.orientation);
      const Vector own = thrust * (std::cos(tilt) * arm.z - std::sin(tilt) * arm.y);
      force += own;
      torque += cross(detail::triple(geometry.position), own) + reaction * own;
    }
    return wrench_of(force, torque);
  }
  [[nodiscard]] PlantLoads loads(const PlantState<Rotors>& x) const noexcept {
    const Eigen::Matrix3d rotation = x.body.orientation.toRotationMatrix();
    const Vector w = detail::triple(x.body.angular_velocity);
    const Vector drag =
        scaled(transposed(detail::square(rotation)) * detail::triple(x.body.velocity),
               detail::triple(parameters_.linear_drag));
    PlantLoads result;
    result.actuators = rotor_wrench(x.actuators);
    Vector force = detail::triple(disturbance_.force) - drag,
           torque = detail::triple(disturbance_.torque), contact_force{}, contact_torque{};
    for (std::size_t i = 0; i < mounts_.size(); ++i) {
      double axle_rate = 0.0;
      if (axle_arms_[i]) axle_rate = axle_rate_of(x, i);
      const WheelForces forces =
          wheel_contact(parameters_.contact, mounts_[i], x.body, rotation, x.wheels[i], axle_rate);
      const double momentum = mounts_[i].inertia * x.wheels[i].spin;
      if (axle_arms_[i]) result.servo_torque[i] = tilt_sign(i) * forces.bearing_torque;
      contact_force += detail::triple(forces.ground.force);
      contact_torque += detail::triple(forces.ground.torque);
      torque += Vector{0.0, forces.bearing_torque, 0.0} - cross(w, Vector{0.0, momentum, 0.0});
      result.wheels[i] = forces;
    }
    for (const detail::HullDisc& disc : hull_) {
      const detail::WallForce forces = detail::wall_force(wall_, disc, x.body, rotation);
      force += detail::triple(forces.wrench.force);
      torque += detail::triple(forces.wrench.torque);
      result.wall_force += forces.normal_force;
    }
    force += contact_force;
    torque += contact_torque;
    result.contact = wrench_of(contact_force, contact_torque);
    result.external = wrench_of(force, torque);
    put((1.0 / vehicle_.body.mass) * (detail::triple(result.actuators.force) + force),
        result.specific_force);
    const Vector gyroscopic = cross(w, detail::square(vehicle_.body.inertia) * w);
    put(detail::square(inertia_inverse_) *
            (detail::triple(result.actuators.torque) + torque - gyroscopic),
        result.angular_acceleration);
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
    for (int i = 0; i < Rotors; ++i) r.actuators.tilt_angle(i) = tilt_rate(x, i, 0.0);
    for (std::size_t i = 0; i < mounts_.size(); ++i) {
      if (axle_arms_[i]) {
        const auto arm = static_cast<int>(*axle_arms_[i]);
        r.actuators.tilt_angle(arm) =
            tilt_rate(x, arm, on_x.servo_torque[i] / parameters_.servo_stiffness);
      }
      r.wheels[i].angle = x.wheels[i].spin;
      r.wheels[i].spin = on_x.wheels[i].axle_torque / mounts_[i].inertia;
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

  /// One substep of `h` [s] by the classical Runge-Kutta method.
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
  std::vector<WheelMount> mounts_;  ///< 0, 2 or 4 wheels or feet
  Wall wall_;
  std::vector<detail::HullDisc> hull_;  ///< touches the wall; empty without a wall
  /// Arms that are the axles of the wheels, in the order of mounts_.
  std::array<std::optional<std::size_t>, 4> axle_arms_;
  RotorVector min_rotor_speed_, max_rotor_speed_;  ///< [rad/s]
  RotorVector rotor_time_constant_;                ///< [s]
  double top_speed_fraction_ = 1.0;                ///< of max_rotor_speed_, at the present voltage
  double substep_;
  detail::DelayQueue<Eigen::Matrix<double, Rotors, 1>> tilt_commands_;
  ActuatorState<Rotors> command_;  ///< clamped to the limits; tilt angles after the dead time
  Wrenchd disturbance_;
  PlantState<Rotors> state_;
  PlantLoads loads_;
};

}  // namespace tilt_ropter
