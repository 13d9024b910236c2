#pragma once

#include "model.hpp"

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <mujoco/mujoco.h>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <deque>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace examples {

/// The model of model.hpp in MuJoCo, with the interface of tilt_ropter::Plant. MuJoCo moves the
/// bodies and computes the contacts. This class computes the lag of rotors and servos, which MuJoCo
/// does not model. A servo turns its arm through the joint of MuJoCo: the reaction acts on the
/// body, and the thrust, the weight and the inertia of the arm act against the servo.
template <int Rotors>
class MujocoPlant {
 public:
  /// Starts at time zero, on the ground with stopped rotors; a vehicle without wheels or legs
  /// starts at the height of the ground. Throws std::invalid_argument for invalid parameters, and
  /// std::runtime_error if MuJoCo rejects the model.
  explicit MujocoPlant(const tilt_ropter::Vehicle<Rotors>& vehicle,
                       const MujocoParameters& parameters = {})
      : vehicle_(vehicle),
        servo_stiffness_(parameters.servo_damping / vehicle.servo.time_constant),
        model_(load(mujoco_model(vehicle, parameters))) {
    servos_.fill(vehicle.servo);
    data_.reset(mj_makeData(model_.get()));
    if (!data_) throw std::runtime_error("MuJoCo: no memory for its data");
    base_ = id(mjOBJ_BODY, "base");
    root_ = joint("root");
    const auto address = [this](int j) { return model_->jnt_qposadr[j]; };
    const auto dof = [this](int j) { return model_->jnt_dofadr[j]; };
    for (std::size_t i = 0; i < rotors; ++i) {
      const std::string n = std::to_string(i + 1);
      tilt_angle_[i] = address(joint("tilt" + n));
      thrust_[i] = id(mjOBJ_ACTUATOR, "thrust" + n);
      servo_[i] = id(mjOBJ_ACTUATOR, "servo" + n);
    }
    for (std::size_t i = 0; i < wheel_count(vehicle); ++i)
      wheel_dof_.push_back(dof(joint("wheel" + std::to_string(i + 1))));
    for (int i = 1; id(mjOBJ_GEOM, "contact" + std::to_string(i)) >= 0; ++i)
      contact_.push_back(id(mjOBJ_GEOM, "contact" + std::to_string(i)));
    wall_ = id(mjOBJ_GEOM, "wall");
    tool_ = id(mjOBJ_GEOM, "tool");
    accelerometer_ = model_->sensor_adr[id(mjOBJ_SENSOR, "imu")];

    const Eigen::Quaterniond ground = ground_orientation(parameters);
    tilt_ropter::BodyStated standing;
    standing.orientation = ground;
    const auto stands = tilt_ropter::undercarriage(vehicle);
    standing.position = ground * Eigen::Vector3d(0.0, 0.0, stands ? stands->height : 0.0);
    standing.position.z() += parameters.ground_height;
    reset(standing, {});
  }

  /// Sets body and actuators; the wheels stand still and the time is zero.
  void reset(const tilt_ropter::BodyStated& body,
             const tilt_ropter::ActuatorState<Rotors>& actuators) {
    mj_resetData(model_.get(), data_.get());
    Eigen::Map<Eigen::Matrix<mjtNum, 7, 1>> q(data_->qpos + model_->jnt_qposadr[root_]);
    Eigen::Map<Twist> v(data_->qvel + model_->jnt_dofadr[root_]);
    const Eigen::Quaterniond unit = body.orientation.normalized();
    q << body.position, unit.w(), unit.x(), unit.y(), unit.z();
    v << body.velocity, body.angular_velocity;
    actuators_ = actuators;
    for (std::size_t i = 0; i < rotors; ++i)
      data_->qpos[tilt_angle_[i]] = actuators.tilt_angle(static_cast<Eigen::Index>(i));
    disturbance_ = {};
    tilt_commands_ = {{-std::numeric_limits<double>::infinity(), actuators.tilt_angle}};
    apply();
    observe();
  }

  /// Sets the parameters of the servo of one arm; `arm` counts from 0.
  void set_servo(std::size_t arm, const tilt_ropter::ServoParameters& servo) {
    tilt_ropter::validate(servo);
    servos_.at(arm) = servo;
  }

  /// Same as tilt_ropter::Plant::set_rotors(), but the arms stay where the model has them.
  void set_rotors(const tilt_ropter::Vehicle<Rotors>& vehicle) { vehicle_.rotors = vehicle.rotors; }

  /// Same as tilt_ropter::Plant::set_wall(), but with contacts of MuJoCo, also of hull and motors;
  /// hull_radius has no effect, and hull_centre is a tool. The deformation at rest is that of the
  /// stiffness.
  void set_wall(const std::optional<tilt_ropter::Wall>& wall) {
    // Touches vehicle, propellers and a tool, or nothing.
    model_->geom_contype[wall_] = !wall ? 4 : wall->hull_centre.isZero(0.0) ? 3 : 11;
    if (!wall) return;
    tilt_ropter::validate(*wall);
    using Vector = Eigen::Matrix<mjtNum, 3, 1>;
    Eigen::Map<Vector>(model_->geom_pos + 3 * tool_) = wall->hull_centre;
    model_->geom_sameframe[tool_] = 0;
    Eigen::Map<Vector>(model_->geom_pos + 3 * wall_) = wall->point;
    const Vector normal = wall->normal;
    mju_quatZ2Vec(model_->geom_quat + 4 * wall_, normal.data());
    model_->geom_sameframe[wall_] = 0;
    model_->geom_friction[3 * wall_] = wall->friction;
    // See solref and solimp of MuJoCo. At this impedance half of the forces are the wall's.
    constexpr double impedance = 0.5, damping_ratio = 0.3;
    const double rate = wall->stiffness / vehicle_.body.mass;
    for (int i = 0; i < 2; ++i) model_->geom_solimp[mjNIMP * wall_ + i] = impedance;
    model_->geom_solref[mjNREF * wall_] = -rate;
    model_->geom_solref[mjNREF * wall_ + 1] = -2.0 * damping_ratio * std::sqrt(rate / impedance);
  }

  /// Takes the torque from a servo: its arm swings freely from now on. `arm` counts from 0.
  void release_servo(std::size_t arm) {
    model_->actuator_gainprm[mjNGAIN * servo_.at(arm)] = 0.0;
    model_->actuator_biasprm[mjNBIAS * servo_.at(arm) + 2] = 0.0;
  }

  /// Advances the plant by `dt` [s] with constant command and constant disturbance, a wrench at the
  /// CoM in the body frame. Returns false if an argument is not finite, if dt is out of range, or
  /// if MuJoCo reports an invalid state. After an invalid state the plant must not be used.
  bool step(const tilt_ropter::ActuatorState<Rotors>& command,
            const tilt_ropter::Wrenchd& disturbance, double dt) {
    if (!(dt > 0.0 && dt <= 10.0) || !tilt_ropter::all_finite(command.rotor_speed) ||
        !tilt_ropter::all_finite(command.tilt_angle) || !tilt_ropter::is_finite(disturbance))
      return false;
    disturbance_ = disturbance;
    const double end = data_->time + dt;
    const int steps = std::max(1, static_cast<int>(std::ceil(dt / longest_step_ - 1e-6)));
    model_->opt.timestep = dt / steps;
    tilt_commands_.emplace_back(data_->time, command.tilt_angle);
    PerRotor passed, speed;
    for (std::size_t i = 0; i < rotors; ++i) {
      const auto k = static_cast<Eigen::Index>(i);
      const tilt_ropter::RotorParameters& rotor = tilt_ropter::rotor_parameters(vehicle_, i);
      passed(k) = -std::expm1(-dt / steps / rotor.time_constant);
      const double least = tilt_ropter::speed_from_thrust(rotor.min_thrust, rotor),
                   most = tilt_ropter::speed_from_thrust(rotor.max_thrust, rotor);
      speed(k) = std::min(std::max(command.rotor_speed(k), least), top_speed_fraction_ * most);
    }
    for (int i = 0; i < steps; ++i) {
      const PerRotor change = passed.cwiseProduct(speed - actuators_.rotor_speed);
      actuators_.rotor_speed += 0.5 * change;  // value in the middle of the step, to first order
      apply();
      mj_step(model_.get(), data_.get());
      actuators_.rotor_speed += 0.5 * change;
    }
    data_->time = end;
    forget_old_commands();
    apply();
    observe();
    // For an invalid state MuJoCo resets itself and counts a warning.
    return data_->warning[mjWARN_BADQPOS].number + data_->warning[mjWARN_BADQVEL].number +
               data_->warning[mjWARN_BADQACC].number ==
           0;
  }

  /// Same as tilt_ropter::Plant::set_voltage().
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = tilt_ropter::voltage_ratio(vehicle_.battery, voltage);
    if (ratio) top_speed_fraction_ = std::min(*ratio, 1.0);
    return ratio.has_value();
  }

  /// Returns the current thrust of `rotor` (from 0) [N].
  [[nodiscard]] double thrust(std::size_t rotor) const {
    return vehicle_.rotors[rotor].effectiveness *
           tilt_ropter::thrust_from_speed(actuators_.rotor_speed(static_cast<Eigen::Index>(rotor)),
                                          tilt_ropter::rotor_parameters(vehicle_, rotor));
  }

  [[nodiscard]] double time() const { return data_->time; }
  [[nodiscard]] const tilt_ropter::BodyStated& body() const { return body_; }
  [[nodiscard]] const tilt_ropter::ActuatorState<Rotors>& actuators() const { return actuators_; }

  /// Wrench of the ground and the disturbance on the body, at the origin of the body frame, in the
  /// body frame. Excludes the torque of the ground that turns the wheels, and also bearings and
  /// wheel momentum.
  [[nodiscard]] const tilt_ropter::Wrenchd& external_wrench() const { return external_; }
  /// The sample of an ideal IMU at the origin of the body frame.
  [[nodiscard]] tilt_ropter::InertialSampled inertial_sample() const {
    return {body_.angular_velocity, specific_force_};
  }
  /// Specific force at the origin of the body frame, without sensor errors [m/s^2].
  [[nodiscard]] const Eigen::Vector3d& specific_force() const { return specific_force_; }
  /// Normal force of the ground on each wheel or foot, in the order of Plant [N].
  [[nodiscard]] const Eigen::Vector4d& normal_forces() const { return normal_forces_; }
  [[nodiscard]] double wall_force() const { return wall_force_; }  ///< normal force [N]
  /// Same as tilt_ropter::Plant::bearing_torque().
  [[nodiscard]] double bearing_torque() const {
    double largest = 0.0;
    for (std::size_t i = 0; i < wheel_dof_.size(); ++i)
      if (axle_arm(vehicle_, i))
        largest = std::max(largest, std::abs(data_->qfrc_passive[wheel_dof_[i]]));
    return largest;
  }
  /// Torque on an arm / angle by which its servo gives way [N m/rad], for slow loads.
  [[nodiscard]] double servo_stiffness() const { return servo_stiffness_; }
  /// Speed of the right and the left wheel relative to their axles [rad/s]. Throws
  /// std::out_of_range for a vehicle without wheels.
  [[nodiscard]] Eigen::Vector2d wheel_speeds() const {
    return {data_->qvel[wheel_dof_.at(0)], data_->qvel[wheel_dof_.at(1)]};
  }

  [[nodiscard]] const tilt_ropter::Vehicle<Rotors>& vehicle() const { return vehicle_; }
  /// Model and data of MuJoCo, for pictures and tests.
  [[nodiscard]] const mjModel& model() const { return *model_; }
  [[nodiscard]] mjData& data() const { return *data_; }

 private:
  static constexpr std::size_t rotors = static_cast<std::size_t>(Rotors);
  using PerRotor = Eigen::Matrix<double, Rotors, 1>;
  struct Delete {
    void operator()(mjModel* model) const { mj_deleteModel(model); }
    void operator()(mjData* data) const { mj_deleteData(data); }
  };
  using Model = std::unique_ptr<mjModel, Delete>;
  /// Velocity or force of the free joint: linear part in the world frame, angular part in the body
  /// frame.
  using Twist = Eigen::Matrix<mjtNum, 6, 1>;

  static Model load(const std::string& xml) {
    // Otherwise it writes a file; step() checks the warning counts.
    mju_user_warning = [](const char*) {};
    const auto files = std::make_unique<mjVFS>();
    mj_defaultVFS(files.get());
    const int length = static_cast<int>(xml.size());
    if (mj_makeEmptyFileVFS(files.get(), "model.xml", length) != 0)
      throw std::runtime_error("MuJoCo: no memory for the model");
    std::memcpy(files->filedata[0], xml.data(), xml.size());
    std::array<char, 1000> error{};
    Model model(mj_loadXML("model.xml", files.get(), error.data(), static_cast<int>(error.size())));
    mj_deleteVFS(files.get());
    if (!model) throw std::runtime_error(std::string("MuJoCo: ") + error.data());
    return model;
  }

  [[nodiscard]] int id(mjtObj type, const std::string& name) const {
    return mj_name2id(model_.get(), type, name.c_str());
  }
  [[nodiscard]] int joint(const std::string& name) const { return id(mjOBJ_JOINT, name); }

  /// Returns the command that the servo of one arm receives now, after its dead time.
  [[nodiscard]] double heard(std::size_t arm) const {
    const double time = data_->time - servos_[arm].dead_time + 1e-9;
    auto command = tilt_commands_.rbegin();
    while (command->first > time) ++command;  // the first command is older than all times
    return command->second(static_cast<Eigen::Index>(arm));
  }

  /// Removes commands that a later command has replaced for every servo.
  void forget_old_commands() {
    double longest = 0.0;
    for (const tilt_ropter::ServoParameters& servo : servos_)
      longest = std::max(longest, servo.dead_time);
    while (tilt_commands_.size() > 1 && tilt_commands_[1].first <= data_->time - longest)
      tilt_commands_.pop_front();
    tilt_commands_.front().first = -std::numeric_limits<double>::infinity();
  }

  /// Passes rotor thrusts, servo speeds and disturbance to MuJoCo.
  void apply() {
    for (std::size_t i = 0; i < rotors; ++i) {
      const tilt_ropter::ServoParameters& servo = servos_[i];
      data_->ctrl[thrust_[i]] = thrust(i);
      const double target = std::clamp(heard(i), servo.min_angle, servo.max_angle);
      data_->ctrl[servo_[i]] =
          std::clamp((target - data_->qpos[tilt_angle_[i]]) / servo.time_constant, -servo.max_rate,
                     servo.max_rate);
    }
    const mjtNum* q = data_->qpos + model_->jnt_qposadr[root_] + 3;
    Eigen::Map<Twist> applied(data_->qfrc_applied + model_->jnt_dofadr[root_]);
    applied << Eigen::Quaterniond(q[0], q[1], q[2], q[3]) * disturbance_.force, disturbance_.torque;
  }

  /// Updates all outputs that follow from the state.
  void observe() {
    mj_forward(model_.get(), data_.get());
    const mjtNum* q = data_->qpos + model_->jnt_qposadr[root_];
    const int dof = model_->jnt_dofadr[root_];
    const Eigen::Map<const Twist> v(data_->qvel + dof), constraint(data_->qfrc_constraint + dof);
    body_.position << q[0], q[1], q[2];
    body_.orientation = Eigen::Quaterniond(q[3], q[4], q[5], q[6]);
    body_.velocity = v.head<3>();
    body_.angular_velocity = v.tail<3>();
    for (std::size_t i = 0; i < rotors; ++i)
      actuators_.tilt_angle(static_cast<Eigen::Index>(i)) = data_->qpos[tilt_angle_[i]];
    specific_force_ = Eigen::Map<const Eigen::Vector3d>(data_->sensordata + accelerometer_);

    external_.force = disturbance_.force + body_.orientation.conjugate() * constraint.head<3>();
    external_.torque = disturbance_.torque + constraint.tail<3>();
    for (const int wheel : wheel_dof_) external_.torque.y() -= data_->qfrc_constraint[wheel];
    normal_forces_.setZero();
    wall_force_ = 0.0;
    for (int i = 0; i < data_->ncon; ++i) {
      std::array<mjtNum, 6> force{};
      mj_contactForce(model_.get(), data_.get(), i, force.data());
      if (data_->contact[i].geom1 == wall_ || data_->contact[i].geom2 == wall_) {
        wall_force_ += force[0];
        continue;
      }
      for (std::size_t w = 0; w < contact_.size(); ++w)
        if (data_->contact[i].geom1 == contact_[w] || data_->contact[i].geom2 == contact_[w])
          normal_forces_(static_cast<Eigen::Index>(w)) += force[0];
    }
  }

  tilt_ropter::Vehicle<Rotors> vehicle_;
  double servo_stiffness_;
  std::array<tilt_ropter::ServoParameters, rotors> servos_;
  Model model_;
  std::unique_ptr<mjData, Delete> data_;
  int base_ = 0, root_ = 0, accelerometer_ = 0, wall_ = 0, tool_ = 0;
  double wall_force_ = 0.0;                                    ///< [N]
  std::array<int, rotors> tilt_angle_{}, thrust_{}, servo_{};  ///< indices in the arrays of MuJoCo
  std::vector<int> wheel_dof_, contact_;
  double longest_step_ = model_->opt.timestep;
  /// Fraction of the top speed of the rotors at the present voltage.
  double top_speed_fraction_ = 1.0;
  tilt_ropter::Wrenchd disturbance_, external_;
  tilt_ropter::BodyStated body_;
  tilt_ropter::ActuatorState<Rotors> actuators_;
  /// Time of the command [s], angles [rad].
  std::deque<std::pair<double, PerRotor>> tilt_commands_;
  Eigen::Vector3d specific_force_ = Eigen::Vector3d::Zero();
  Eigen::Vector4d normal_forces_ = Eigen::Vector4d::Zero();
};

}  // namespace examples
