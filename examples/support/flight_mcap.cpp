#include "flight_mcap.hpp"

#include <algorithm>
#include <array>
#include <cmath>

namespace examples {

using tilt_ropter::BodyStated;

FlightMcap::FlightMcap(const std::string& path, int rotors)
    : writer_(path),
      tf_(writer_.add_channel("/tf", "tf2_msgs/msg/TFMessage")),
      estimate_(writer_.add_channel("/odometry", "nav_msgs/msg/Odometry")),
      truth_(writer_.add_channel("/ground_truth/odometry", "nav_msgs/msg/Odometry")),
      reference_(writer_.add_channel("/reference", "geometry_msgs/msg/PoseStamped")),
      pose_(writer_.add_channel("/pose", "geometry_msgs/msg/PoseStamped")),
      imu_(writer_.add_channel("/imu", "sensor_msgs/msg/Imu")),
      command_(writer_.add_channel("/wrench_command", "geometry_msgs/msg/WrenchStamped")),
      external_(writer_.add_channel("/external_wrench", "geometry_msgs/msg/WrenchStamped")),
      true_external_(
          writer_.add_channel("/ground_truth/external_wrench", "geometry_msgs/msg/WrenchStamped")),
      tilt_(writer_.add_channel("/tilt_angles", "sensor_msgs/msg/JointState")),
      tilt_command_(writer_.add_channel("/tilt_commands", "sensor_msgs/msg/JointState")),
      speed_(writer_.add_channel("/rotor_speeds", "sensor_msgs/msg/JointState")),
      speed_command_(writer_.add_channel("/rotor_speed_commands", "sensor_msgs/msg/JointState")),
      power_(writer_.add_channel("/power", "std_msgs/msg/Float64")),
      phase_(writer_.add_channel("/phase", "std_msgs/msg/String")),
      mode_(writer_.add_channel("/flight_mode", "std_msgs/msg/String")) {
  for (int i = 1; i <= rotors; ++i) {
    arms_.push_back("tilt_" + std::to_string(i));
    rotors_.push_back("rotor_" + std::to_string(i));
  }
}

namespace {
std::uint64_t nanoseconds(double time) {
  return static_cast<std::uint64_t>(std::llround(1e9 * std::max(0.0, time)));
}
Cdr& add(Cdr& to, const Eigen::Quaterniond& q) {
  return to.add_all(q.coeffs());  // x y z w, as in ROS
}
}  // namespace

Cdr FlightMcap::header(const char* frame) const {
  Cdr message;
  message.add(static_cast<std::int32_t>(now_ / 1000000000))
      .add(static_cast<std::uint32_t>(now_ % 1000000000))
      .add(std::string(frame));
  return message;
}

void FlightMcap::write(std::uint16_t channel, const Cdr& message) {
  writer_.write(channel, now_, message);
}

void FlightMcap::on_imu(double time, const tilt_ropter::InertialSampled& sample) {
  now_ = nanoseconds(time);
  std::array<double, 9> unknown{};
  Cdr message = header("base_link");
  add(message, Eigen::Quaterniond::Identity());
  unknown[0] = -1.0;  // an IMU without orientation
  message.add_all(unknown);
  unknown[0] = 0.0;
  message.add_all(sample.angular_velocity).add_all(unknown);
  message.add_all(sample.specific_force).add_all(unknown);
  write(imu_, message);
}

void FlightMcap::on_pose(double time, const tilt_ropter::MarkerPosed& measured) {
  now_ = nanoseconds(time);
  pose(pose_, measured.position, measured.orientation);
}

void FlightMcap::pose(std::uint16_t channel, const Eigen::Vector3d& position,
                      const Eigen::Quaterniond& q) {
  Cdr message = header("map");
  write(channel, add(message.add_all(position), q));
}

void FlightMcap::odometry(std::uint16_t channel, const BodyStated& body) {
  const std::array<double, 36> unknown{};
  Cdr message = header("map");
  message.add(std::string("base_link")).add_all(body.position);
  add(message, body.orientation).add_all(unknown);
  message.add_all(Eigen::Vector3d(body.orientation.conjugate() * body.velocity));
  write(channel, message.add_all(body.angular_velocity).add_all(unknown));
}

void FlightMcap::wrench(std::uint16_t channel, const tilt_ropter::Wrenchd& wrench) {
  write(channel, header("base_link").add_all(wrench.force).add_all(wrench.torque));
}

void FlightMcap::joints(std::uint16_t channel, const std::vector<std::string>& names,
                        const Eigen::VectorXd& values, bool are_speeds) {
  const Eigen::VectorXd none;
  Cdr message = header("base_link");
  message.add(static_cast<std::uint32_t>(names.size()));
  for (const std::string& name : names) message.add(name);
  message.add_sequence(are_speeds ? none : values).add_sequence(are_speeds ? values : none);
  write(channel, message.add_sequence(none));
}

void FlightMcap::text(std::uint16_t channel, const std::string& now, std::string& last) {
  if (now != last) write(channel, Cdr().add(now));
  last = now;
}

void FlightMcap::on_tick(const FlightSample& s) {
  now_ = nanoseconds(s.time);
  const BodyStated& shown = s.estimate ? *s.estimate : s.truth;
  Cdr transforms;
  transforms.add(std::uint32_t{1})
      .add(static_cast<std::int32_t>(now_ / 1000000000))
      .add(static_cast<std::uint32_t>(now_ % 1000000000))
      .add(std::string("map"))
      .add(std::string("base_link"))
      .add_all(shown.position);
  write(tf_, add(transforms, shown.orientation));
  if (s.estimate) odometry(estimate_, *s.estimate);
  odometry(truth_, s.truth);
  pose(reference_, s.reference.position, s.reference.orientation);
  if (s.command) wrench(command_, *s.command);
  if (s.external) wrench(external_, *s.external);
  wrench(true_external_, s.true_external);
  joints(tilt_, arms_, s.tilt, false);
  joints(tilt_command_, arms_, s.tilt_command, false);
  joints(speed_, rotors_, s.speed, true);
  joints(speed_command_, rotors_, s.speed_command, true);
  write(power_, Cdr().add(s.power));
  text(phase_, s.phase, last_phase_);
  text(mode_, s.mode, last_mode_);
}

}  // namespace examples
