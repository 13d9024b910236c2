#pragma once

#include "../support/flight_controller.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_choice.hpp"
#include "flight_plan.hpp"
#include "messages.hpp"
#include "parameters.hpp"
#include "telemetry.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iostream>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace loops {

inline constexpr const char* ros2_help =
    R"(ROS 2 node: state estimator, wrench observer, NMPC and allocation at 100 Hz.

Subscribes to  imu           sensor_msgs/Imu, in the body frame (FLU), any rate
               pose          geometry_msgs/PoseStamped, of the vehicle in the world (ENU)
               rotor_speeds  sensor_msgs/JointState, velocity [rad/s]: of the joints that
                             rotor_joints names; without names, of all rotors in order
               hover_point   geometry_msgs/PoseStamped, where to hover (ENU); ends a mission
               pause, land   std_msgs/Bool, true: the motion ends, and the vehicle hovers or lands;
                             pause false: it goes on
               trajectory    trajectory_msgs/MultiDOFJointTrajectory, the set points of a planner;
                             ends a mission. One of a single point is valid for 0.5 s
Publishes      actuators     actuator_msgs/Actuators, velocity [rad/s] and position [rad] of
                             the rotors and their servos, as in the vehicle file
               /tf, odometry, path, markers, /diagnostics: the flight, for rviz2 or Foxglove

Parameters (--ros-args -p NAME:=VALUE): vehicle, the path of its JSON file, with 2 to 8 rotors;
level, wrench or actuator, without it wrench if the rotors give every wrench; mission, the path of a
JSON file, or hybrid, air, ground, rolling, excite, inspect; trajectory, the path of a CSV file;
without these two, hover_x, hover_y, hover_z [m], hover_yaw [rad]; position_noise [m],
orientation_noise [rad], pose_clock_offset [s], max_silence [s], telemetry_rate [Hz], status_line
(false: none), use_sim_time (true: the time is that of /clock), solver (automatic, nlopt,
structured), rotor_joints (rotor_1,rotor_2,...). From a file: --ros-args --params-file FILE.yaml.
Topics: --ros-args -r TOPIC:=OTHER_TOPIC. Namespace and name: -r __ns:=/NAMESPACE -r __node:=NAME.
DDS domain: the environment variable ROS_DOMAIN_ID.

The node flies as soon as it has a pose, with at most 1 m/s to where it hovers or to where the
mission begins. It holds its position or lands if the estimate becomes bad.
If the IMU is silent for max_silence, the node publishes nothing, and the time-out of the motors ends
the flight. Stamps must be times of the same clock.)";

/// The onboard control loop for messages of ROS 2. All times are from the stamps of messages. The
/// stamps and the time of tick() must be of the same clock. Not thread-safe.
template <int Rotors>
class Ros2Node {
 public:
  static constexpr double max_clock_difference = 1.0;  ///< [s]
  static constexpr double longest_silence = 1.0;       ///< of the parameter max_silence [s]

  /// For the `vehicle` of `file`. Throws std::invalid_argument for parameters out of range,
  /// examples::VehicleFileError if the level cannot control it.
  Ros2Node(const tilt_ropter::Vehicle<Rotors>& vehicle, const examples::VehicleFile& file,
           Parameters& parameters)
      : vehicle_(vehicle),
        controller_(at_level<examples::FlightController<Rotors>>(vehicle, file, parameters,
                                                                 estimation(parameters))),
        reference_(parameters, file),
        rotor_joints_(joints(parameters)),
        max_silence_(parameters.number("max_silence", 0.1, 0.02, longest_silence)) {}

  /// Ignores a sample whose stamp is more than `max_clock_difference` from the last tick.
  void on_imu(const sensor_msgs::msg::Imu& m) {
    heard_[0].on_message(seconds(m.header.stamp));
    if (!(std::abs(seconds(m.header.stamp) - now_.value_or(seconds(m.header.stamp))) <=
          max_clock_difference)) {
      if (foreign_stamps_++ == 0)
        std::cerr << "ros2_node: stamps of the IMU are not times of this node's clock\n";
      return;
    }
    const auto& w = m.angular_velocity;
    const auto& f = m.linear_acceleration;  // ROS reports the specific force: 9.81 upward at rest
    controller_.on_imu(seconds(m.header.stamp), {{w.x, w.y, w.z}, {f.x, f.y, f.z}});
  }

  void on_pose(const geometry_msgs::msg::PoseStamped& m) {
    heard_[1].on_message(seconds(m.header.stamp));
    const auto& p = m.pose.position;
    const auto& q = m.pose.orientation;
    controller_.on_pose(seconds(m.header.stamp), {{p.x, p.y, p.z}, {q.w, q.x, q.y, q.z}});
  }

  /// Ignores speeds that are those of no rotor or of other joints, and says so once.
  void on_rotor_speeds(const sensor_msgs::msg::JointState& m) {
    heard_[2].on_message(m.header.stamp.sec == 0 ? now_.value_or(0.0) : seconds(m.header.stamp));
    const auto ignore = [this](const char* why) {
      if (ignored_speeds_++ == 0)
        std::cerr << "ros2_node: rotor_speeds are ignored: " << why << '\n';
    };
    const std::optional<Speeds> speeds = in_order(m);
    if (!speeds) return ignore("not the joints of the parameter rotor_joints");
    const double most = 1.3 * vehicle_top_speed();
    if (!(speeds->cwiseAbs().maxCoeff() <= most)) return ignore("not in rad/s, or no numbers");
    if (speeds->isZero() && controller_.command().rotor_speed.minCoeff() > 0.2 * most)
      return ignore("zero while the rotors turn");
    controller_.on_rotor_speeds(*speeds);
  }

  /// Where to hover from now on.
  void on_hover_point(const geometry_msgs::msg::PoseStamped& m) {
    if (!reference_.fly_to(m.pose, now_.value_or(0.0)))
      std::cerr
          << "ros2_node: hover_point is ignored: no pose, too far away, or below the ground\n";
  }

  /// `true`: the motion ends within a second. `false`: it goes on, also after a landing.
  void on_pause(const std_msgs::msg::Bool& m) {
    if (m.data)
      reference_.pause(now_.value_or(0.0));
    else
      reference_.resume(now_.value_or(0.0));
  }
  /// `true`: the motion ends, and the vehicle lands where it is.
  void on_land(const std_msgs::msg::Bool& m) {
    if (m.data) reference_.land(now_.value_or(0.0));
  }

  /// Set points of another program, which end a mission.
  void on_trajectory(const trajectory_msgs::msg::MultiDOFJointTrajectory& m) {
    if (!reference_.follow(set_points(m), now_.value_or(0.0)))
      std::cerr
          << "ros2_node: trajectory is ignored: no set points, too far away, or below the ground\n";
  }

  /// One period of the controller at the time `now` [ns]. Returns the command to publish, which is
  /// valid until the next call, or nothing.
  [[nodiscard]] const actuator_msgs::msg::Actuators* tick(std::int64_t now) {
    const double time = 1e-9 * static_cast<double>(now);
    now_ = time;
    for (Heard& topic : heard_) topic.on_tick(time);
    const tilt_ropter::CalibrationStatus imu = controller_.imu_check();
    const bool was_wrong = wrong_imu_;
    wrong_imu_ = !started() && contradicts_weight(imu);
    if (wrong_imu_ && !was_wrong)
      std::cerr << "ros2_node: does not fly, the accelerometer contradicts the weight: "
                << to_string(imu) << '\n';
    if (!started()) return nullptr;
    controller_.on_tick(time);
    const bool was_silent = silent_;
    silent_ = !(time - controller_.ekf().time() <= max_silence_);
    if (silent_ && !was_silent) std::cerr << "ros2_node: the IMU is silent\n";
    if (silent_ && follows_) reference_.stop(time);
    follows_ = follows_ && !silent_;
    if (silent_) return nullptr;
    if (!follows_) reference_.start(controller_.ekf().state(), time);
    controller_.prepare(time, [this](double t) { return reference_(t); });
    follows_ = follows_ || controller_.mode() != examples::FlightMode::hold;
    const tilt_ropter::ActuatorState<Rotors>& command = controller_.control(time);
    if (started()) solver_.add(controller_.result().status, controller_.result().report);
    for (std::size_t i = 0; i < Rotors; ++i) {
      speeds_[i] = command.rotor_speed(static_cast<Eigen::Index>(i));
      angles_[i] = command.tilt_angle(static_cast<Eigen::Index>(i));
    }
    message_.header.stamp = stamp(now);
    refer_to(message_.velocity, speeds_);
    refer_to(message_.position, angles_);
    return &message_;
  }

  /// What the last tick() did, except the counts.
  [[nodiscard]] Snapshot snapshot(std::int64_t now) const {
    using examples::FlightMode;
    Snapshot s;
    s.time = now;
    s.located = started();
    s.heard = heard_;
    s.waits_for = !heard_[0].ever()           ? "imu"
                  : !heard_[1].ever()         ? "pose"
                  : !started() && !wrong_imu_ ? "an estimate"
                                              : "";
    s.body = controller_.ekf().state();
    s.reference = reference_(now_.value_or(0.0));
    s.failure = controller_.failure();
    s.activity = reference_.activity(now_.value_or(0.0));
    s.rotor_speed = controller_.applied().rotor_speed;
    s.tilt_angle = controller_.applied().tilt_angle;
    s.contact = controller_.contact().estimate();
    s.estimate = tilt_ropter::to_string(controller_.trust().state);
    s.planned = has_plan(controller_.result().status);
    s.mode = silent_      ? "silent"
             : wrong_imu_ ? "refuses to fly"
             : !started() ? "not located"
                          : examples::to_string(controller_.mode());
    s.level = silent_ || wrong_imu_ || controller_.mode() == FlightMode::landing ||
                      controller_.mode() == FlightMode::emergency ||
                      controller_.mode() == FlightMode::stopped
                  ? Level::error
              : controller_.mode() != FlightMode::mission || !s.planned ? Level::warning
                                                                        : Level::ok;
    return s;
  }

  [[nodiscard]] const examples::SolverTicks& solver() const { return solver_; }
  [[nodiscard]] bool started() const { return controller_.started(); }
  [[nodiscard]] const tilt_ropter::Vehicle<Rotors>& vehicle() const { return vehicle_; }

 private:
  using Speeds = Eigen::Matrix<double, Rotors, 1>;

  // The parameter rotor_joints, or rotor_1,rotor_2 and so on.
  static std::vector<std::string> joints(Parameters& parameters) {
    std::string usual;
    for (int i = 1; i <= Rotors; ++i) usual += (i > 1 ? ",rotor_" : "rotor_") + std::to_string(i);
    const std::string names = parameters.text("rotor_joints", usual);
    std::vector<std::string> parts;
    std::stringstream stream(names);
    for (std::string part; std::getline(stream, part, ',');) parts.push_back(part);
    if (parts.size() != Rotors)
      throw std::invalid_argument("rotor_joints = " + names + ": must be " +
                                  std::to_string(Rotors) + " names, with commas");
    return parts;
  }

  [[nodiscard]] double vehicle_top_speed() const {
    double top = 0.0;
    for (std::size_t i = 0; i < Rotors; ++i) {
      const tilt_ropter::RotorParameters& rotor = rotor_parameters(vehicle_, i);
      top = std::max(top, speed_from_thrust(rotor.max_thrust, rotor));
    }
    return top;
  }

  // The speeds of all rotors; nothing if a joint is missing.
  [[nodiscard]] std::optional<Speeds> in_order(const sensor_msgs::msg::JointState& m) const {
    if (m.name._length == 0 && m.velocity._length == Rotors)
      return Speeds(Eigen::Map<const Speeds>(m.velocity._buffer));
    if (m.name._length != m.velocity._length) return std::nullopt;
    Speeds speeds = Speeds::Constant(std::nan(""));
    int found = 0;
    for (std::uint32_t k = 0; k < m.name._length; ++k)
      for (std::size_t i = 0; i < Rotors; ++i)
        if (rotor_joints_[i] == m.name._buffer[k]) {
          speeds(static_cast<Eigen::Index>(i)) = m.velocity._buffer[k];
          ++found;
        }
    return found == Rotors ? std::optional(speeds) : std::nullopt;
  }

  static tilt_ropter::EkfSettings estimation(Parameters& parameters) {
    tilt_ropter::EkfSettings s;
    s.pose_noise = {parameters.number("position_noise", 1e-3, 1e-6, 1.0),
                    parameters.number("orientation_noise", 3e-3, 1e-6, 1.0)};
    s.clock_offset = parameters.number("pose_clock_offset", 0.0, -1e10, 1e10);
    return s;
  }

  tilt_ropter::Vehicle<Rotors> vehicle_;
  examples::FlightController<Rotors> controller_;
  examples::SolverTicks solver_;
  FlightPlan reference_;
  std::vector<std::string> rotor_joints_;
  double max_silence_;
  std::array<Heard, 5> heard_{Heard("imu"), Heard("pose"), Heard("rotor_speeds")};
  bool silent_ = false, wrong_imu_ = false;
  bool follows_ = false;       // the reference has begun
  std::optional<double> now_;  // of the last tick [s]
  long foreign_stamps_ = 0, ignored_speeds_ = 0;
  std::vector<double> speeds_ = std::vector<double>(Rotors), angles_ = speeds_;
  actuator_msgs::msg::Actuators message_{};
};

}  // namespace loops
