#pragma once

#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <ostream>
#include <string>

namespace examples {

namespace detail {

class UrdfWriter {
 public:
  explicit UrdfWriter(std::ostream& out) : out_(out) {}

  void link(const std::string& name, const std::string& inside) {
    out_ << "  <link name=\"" << name << "\">\n" << inside << "  </link>\n";
  }
  /// `limits`: of a revolute joint, as attributes.
  void joint(const std::string& name, const std::string& type, const std::string& parent,
             const std::string& child, const std::string& origin, const std::string& axis,
             const std::string& limits = "") {
    out_ << "  <joint name=\"" << name << "\" type=\"" << type << "\">\n    <parent link=\""
         << parent << "\"/>\n    <child link=\"" << child << "\"/>\n    " << origin << '\n';
    if (!axis.empty()) out_ << "    <axis xyz=\"" << axis << "\"/>\n";
    if (!limits.empty()) out_ << "    <limit " << limits << "/>\n";
    out_ << "  </joint>\n";
  }

  static std::string text(double value) {
    std::array<char, 32> buffer{};
    std::snprintf(buffer.data(), buffer.size(), "%.6g", std::abs(value) < 1e-9 ? 0.0 : value);
    return buffer.data();
  }
  static std::string text(const Eigen::Vector3d& v) {
    return text(v.x()) + ' ' + text(v.y()) + ' ' + text(v.z());
  }
  static std::string origin(const Eigen::Vector3d& position,
                            const Eigen::Matrix3d& orientation = Eigen::Matrix3d::Identity()) {
    // Roll, pitch and yaw about fixed axes.
    const Eigen::Matrix3d& r = orientation;
    const double pitch = std::atan2(-r(2, 0), std::hypot(r(0, 0), r(1, 0)));
    const bool is_vertical = std::hypot(r(0, 0), r(1, 0)) < 1e-9;
    const double roll = is_vertical ? 0.0 : std::atan2(r(2, 1), r(2, 2)),
                 yaw = is_vertical ? std::atan2(-r(0, 1), r(1, 1)) : std::atan2(r(1, 0), r(0, 0));
    return "<origin xyz=\"" + text(position) + "\" rpy=\"" +
           text(Eigen::Vector3d(roll, pitch, yaw)) + "\"/>";
  }
  static std::string visual(const std::string& at, const std::string& shape,
                            const std::string& rgba) {
    return "    <visual>\n      " + at + "\n      <geometry>" + shape +
           "</geometry>\n      <material name=\"" + rgba + "\"><color rgba=\"" + rgba +
           "\"/></material>\n    </visual>\n";
  }
  static std::string box(const Eigen::Vector3d& size) {
    return "<box size=\"" + text(size) + "\"/>";
  }
  static std::string cylinder(double radius, double length) {
    return "<cylinder radius=\"" + text(radius) + "\" length=\"" + text(length) + "\"/>";
  }

 private:
  std::ostream& out_;
};

}  // namespace detail

/// Writes `vehicle` as URDF, for robot_state_publisher and rviz2: base_link at the CoM (x forward,
/// z up), for each rotor the joints tilt_1 (if it tilts) and rotor_1, and so on, with the names and
/// signs of JointState in MCAP files; wheels. base_link has the mass and the inertia of the whole
/// vehicle, so that the other links have none.
template <int Rotors>
void write_urdf(const tilt_ropter::Vehicle<Rotors>& vehicle, const std::string& name,
                std::ostream& out) {
  using Eigen::Vector3d;
  using Writer = detail::UrdfWriter;
  Writer urdf(out);
  std::string robot;
  for (const char c : name) robot += c == '<' || c == '>' || c == '&' || c == '"' ? '_' : c;
  out << "<?xml version=\"1.0\"?>\n<robot name=\"" << robot << "\">\n";
  const Eigen::Matrix3d& inertia = vehicle.body.inertia;
  double arm = 0.05;
  for (const auto& rotor : vehicle.rotors) arm = std::max(arm, rotor.position.norm());
  urdf.link("base_link",
            "    <inertial>\n      <mass value=\"" + Writer::text(vehicle.body.mass) +
                "\"/>\n      <inertia ixx=\"" + Writer::text(inertia(0, 0)) + "\" ixy=\"" +
                Writer::text(inertia(0, 1)) + "\" ixz=\"" + Writer::text(inertia(0, 2)) +
                "\" iyy=\"" + Writer::text(inertia(1, 1)) + "\" iyz=\"" +
                Writer::text(inertia(1, 2)) + "\" izz=\"" + Writer::text(inertia(2, 2)) +
                "\"/>\n    </inertial>\n" +
                Writer::visual(Writer::origin(Vector3d::Zero()),
                               Writer::box({0.6 * arm, 0.6 * arm, 0.2 * arm}), "0.3 0.3 0.35 1"));
  for (std::size_t i = 0; i < Rotors; ++i) {
    const tilt_ropter::RotorGeometry& rotor = vehicle.rotors[i];
    const tilt_ropter::RotorParameters& p = rotor_parameters(vehicle, i);
    const std::string number = std::to_string(i + 1), mount = "arm_" + number;
    const std::string tube = Writer::visual(Writer::origin(Vector3d::Zero()),
                                            Writer::box({0.3 * arm, 0.06 * arm, 0.06 * arm}),
                                            rotor.tilts ? "0.9 0.5 0.1 1" : "0.5 0.5 0.5 1");
    urdf.link(mount, tube);
    const std::string at = Writer::origin(rotor.position, rotor.orientation);
    if (rotor.tilts)
      urdf.joint("tilt_" + number, "revolute", "base_link", mount, at, "1 0 0",
                 "lower=\"" + Writer::text(vehicle.servo.min_angle) + "\" upper=\"" +
                     Writer::text(vehicle.servo.max_angle) + "\" velocity=\"" +
                     Writer::text(vehicle.servo.max_rate) + "\" effort=\"10\"");
    else
      urdf.joint("mount_" + number, "fixed", "base_link", mount, at, "");
    const double radius = p.propeller_radius > 0.0 ? p.propeller_radius : 0.5 * arm;
    urdf.link(
        "propeller_" + number,
        Writer::visual(Writer::origin(Vector3d::Zero()),
                       Writer::box({2.0 * radius, 0.12 * radius, 0.02 * radius}), "0.1 0.1 0.1 1"));
    urdf.joint("rotor_" + number, "continuous", mount, "propeller_" + number,
               Writer::origin({0.0, 0.0, p.propeller_height}),
               rotor.spin == tilt_ropter::Spin::counter_clockwise ? "0 0 1" : "0 0 -1");
  }
  if (vehicle.wheels) {
    const tilt_ropter::WheelParameters& w = *vehicle.wheels;
    const Eigen::Matrix3d axle_along_y =
        (Eigen::Matrix3d() << 1, 0, 0, 0, 0, 1, 0, -1, 0).finished();
    int number = 0;
    for (const double x : {0.5 * w.wheel_base, -0.5 * w.wheel_base}) {
      for (const double y : {w.half_track, -w.half_track}) {
        const std::string wheel = "wheel_" + std::to_string(++number);
        urdf.link(wheel + "_link",
                  Writer::visual(Writer::origin(Vector3d::Zero(), axle_along_y),
                                 Writer::cylinder(w.radius, 2.0 * w.half_width), "0.2 0.2 0.2 1"));
        urdf.joint(wheel, "continuous", "base_link", wheel + "_link", Writer::origin({x, y, 0.0}),
                   "0 1 0");
      }
      if (w.wheel_base == 0.0) break;
    }
  }
  out << "</robot>\n";
}

}  // namespace examples
