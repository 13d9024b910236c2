#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <ostream>
#include <sstream>
#include <stdexcept>
#include <string>

/// The Tilt-Ropter as an MJCF model, written from the parameters of a Vehicle: base on a free
/// joint, arms on hinges with rotors and servos, wheels on free hinges or legs, and the
/// ground. This header is long because it contains the complete text of the model.
namespace examples {

/// Parameters that MuJoCo needs beyond the Vehicle. The base gets the remaining mass, so the
/// complete model at zero tilt has the mass, CoM and inertia of the Vehicle.
struct MujocoParameters {
  double time_step = 5e-4;  ///< time step [s]
  /// Mass that tilts with one arm: motor, propeller, mount (estimate) [kg].
  double arm_mass = 0.08;
  /// Height of the arm's CoM over the hinge at zero tilt [m] (estimate: half of the arm's mass is
  /// the motor, 1 cm above the hinge, and the rest is on the hinge).
  double arm_height = 0.005;
  /// Inertia of the arm about its CoM (estimate) [kg m^2].
  Eigen::Vector3d arm_inertia{3e-5, 3e-5, 2e-5};
  double servo_armature = 5e-4;  ///< inertia of gears and motor at the arm (estimate) [kg m^2]
  double servo_damping = 0.2;  ///< gain of the speed loop: torque / speed error (estimate) [N m s]
  double servo_torque = 1.5;   ///< maximum torque of the servo (estimate) [N m]
  double wheel_mass = 0.04;    ///< mass of one wheel (estimate) [kg]
  /// Torque / normal force of a wheel that turns on the spot [m].
  double torsional_friction = 1e-3;
  double contact_time_constant = 0.01;  ///< solref of MuJoCo: time in which a contact settles [s]
  /// solimp of MuJoCo, below 1: a larger value is harder. The tyre is compressed by 0.6 mm; at 0.95
  /// it is so hard that rolling wheels lose contact from time to time.
  double contact_impedance = 0.7;
  /// Friction, rolling resistance and bearing friction, as in our own plant.
  tilt_ropter::WheelContactParameters contact;

  double ground_height = 0.0;  ///< height of the ground at x = y = 0 [m]
  double slope = 0.0;          ///< slope of the ground [rad]
  /// Azimuth from x of the direction in which the ground rises [rad].
  double slope_direction = 0.0;
  /// Height of a plank across the figure eight on the ground; 0: no plank [m].
  double step_height = 0.0;
  double step_position = 1.0;  ///< position of the middle of the plank along x [m]
  double step_width = 0.3;     ///< width of the plank [m]
  double payload = 0.0;        ///< mass below the body that the controller does not know [kg]
  Eigen::Vector3d payload_position{0.0, 0.0, -0.05};  ///< position of the payload, body frame [m]
  double com_x = 0.0;  ///< offset of the true CoM ahead of the origin of the body frame [m]
  /// Adds geoms for pictures only; they cost time and have no effect on the motion.
  bool seen = false;
};

/// Throws std::invalid_argument with the field, its value and the allowed values.
inline void validate(const MujocoParameters& p) {
  using namespace tilt_ropter;
  require(p.time_step >= 1e-5 && p.time_step <= 2e-3, "MujocoParameters.time_step [s]", p.time_step,
          "1e-5 to 2e-3");
  require_positive("MujocoParameters.arm_mass [kg]", p.arm_mass);
  require_finite("MujocoParameters.arm_height [m]", p.arm_height);
  require_inertia("MujocoParameters.arm_inertia [kg m^2]",
                  Eigen::Matrix3d(p.arm_inertia.asDiagonal()));
  require_non_negative("MujocoParameters.servo_armature [kg m^2]", p.servo_armature);
  require_positive("MujocoParameters.servo_damping [N m s]", p.servo_damping);
  require_positive("MujocoParameters.servo_torque [N m]", p.servo_torque);
  require_positive("MujocoParameters.wheel_mass [kg]", p.wheel_mass);
  require_non_negative("MujocoParameters.torsional_friction [m]", p.torsional_friction);
  require(p.contact_time_constant >= 2.0 * p.time_step,
          "MujocoParameters.contact_time_constant [s]", p.contact_time_constant,
          "at least two time steps");
  require(p.contact_impedance > 0.0 && p.contact_impedance < 1.0,
          "MujocoParameters.contact_impedance", p.contact_impedance, "between 0 and 1");
  validate(p.contact);
  require_finite("MujocoParameters.ground_height [m]", p.ground_height);
  require_finite("MujocoParameters.com_x [m]", p.com_x);
  require(std::abs(p.slope) <= 0.5, "MujocoParameters.slope [rad]", p.slope, "-0.5 to 0.5");
  require_finite("MujocoParameters.slope_direction [rad]", p.slope_direction);
  require_non_negative("MujocoParameters.step_height [m]", p.step_height);
  require_finite("MujocoParameters.step_position [m]", p.step_position);
  require_positive("MujocoParameters.step_width [m]", p.step_width);
  require_non_negative("MujocoParameters.payload [kg]", p.payload);
  require_finite("MujocoParameters.payload_position [m]", p.payload_position);
}

/// Returns the orientation of the sloping ground: its z axis is the normal.
[[nodiscard]] inline Eigen::Quaterniond ground_orientation(const MujocoParameters& p) {
  const Eigen::Vector3d level(std::sin(p.slope_direction), -std::cos(p.slope_direction), 0.0);
  return Eigen::Quaterniond(Eigen::AngleAxisd(p.slope, level));
}

/// Returns the number of wheels.
template <int Rotors>
[[nodiscard]] std::size_t wheel_count(const tilt_ropter::Vehicle<Rotors>& vehicle) {
  if (!vehicle.wheels) return 0;
  return vehicle.wheels->wheel_base > 0.0 ? 4 : 2;
}

/// Mass and inertia of the base: the vehicle without arms and wheels.
struct BaseInertia {
  double mass = 0.0;                                  ///< mass [kg]
  Eigen::Vector3d com = Eigen::Vector3d::Zero();      ///< CoM in the body frame [m]
  Eigen::Matrix3d inertia = Eigen::Matrix3d::Zero();  ///< inertia about `com`, body axes [kg m^2]
};

namespace detail {

/// Returns the inertia of a point mass at `r`.
inline Eigen::Matrix3d point_inertia(double mass, const Eigen::Vector3d& r) {
  return mass * (r.squaredNorm() * Eigen::Matrix3d::Identity() - r * r.transpose());
}

// Inertia of a ring in the wheel frame.
inline Eigen::Vector3d wheel_inertia(const tilt_ropter::WheelParameters& wheels,
                                     const MujocoParameters& p) {
  const double across =
      0.5 * wheels.inertia + p.wheel_mass * wheels.half_width * wheels.half_width / 3.0;
  return {wheels.inertia, across, across};
}

/// Returns numbers for an attribute with the full precision of doubles.
template <typename... Numbers>
std::string numbers(const Numbers&... values) {
  std::ostringstream text;
  text.precision(17);
  ((text << values << ' '), ...);
  std::string result = text.str();
  result.pop_back();
  return result;
}
inline std::string numbers(const Eigen::Vector3d& v) {
  return numbers(v.x(), v.y(), v.z());
}
inline std::string numbers(const Eigen::Quaterniond& q) {
  return numbers(q.w(), q.x(), q.y(), q.z());
}

/// Returns the attributes pos and quat of a frame.
inline std::string placed(const Eigen::Isometry3d& pose) {
  return " pos=\"" + numbers(Eigen::Vector3d(pose.translation())) + "\" quat=\"" +
         numbers(Eigen::Quaterniond(pose.linear())) + "\" ";
}

/// Adds a wheel with its axle. `wheel` is its pose and `inner` the inner end of its axle, both in
/// the frame of the body that carries it.
template <int Rotors>
void add_wheel(std::ostream& xml, const tilt_ropter::Vehicle<Rotors>& vehicle,
               const MujocoParameters& p, std::size_t index, const Eigen::Isometry3d& wheel,
               const Eigen::Vector3d& inner) {
  const auto quoted = [](const std::string& text) { return '"' + text + '"'; };
  const std::string n = std::to_string(index + 1);
  const double radius = vehicle.wheels->radius;
  const Eigen::Vector3d outer = wheel.translation();
  xml << R"(    <geom type="capsule" size="0.004" material="metal" fromto=)"
      << quoted(numbers(inner) + ' ' + numbers(outer)) << "/>\n    <body name=\"wheel" << n << '"'
      << placed(wheel) << R"(>
      <joint name="wheel)"
      << n << R"(" type="hinge" axis="1 0 0" damping=)"
      << quoted(numbers(p.contact.bearing_friction)) << R"(/>
      <inertial mass=)"
      << quoted(numbers(p.wheel_mass)) << R"( pos="0 0 0" diaginertia=)"
      << quoted(numbers(wheel_inertia(*vehicle.wheels, p))) << R"(/>
      <geom name="contact)"
      << n << R"(" class="touches" type="ellipsoid" group="4" size=)"
      << quoted(numbers(vehicle.wheels->half_width, radius, radius)) << R"(/>
      <geom type="cylinder" size="0.012 0.01" quat="0.70710678118654757 0 0.70710678118654757 0"
        material="metal"/>
)";
  constexpr int segments = 36, spokes = 6;  // a rim of short capsules, because MJCF has no torus
  constexpr double tau = 2.0 * tilt_ropter::pi;
  const double rim = radius - 0.007;
  const auto on_rim = [rim](double angle) {
    return numbers(0.0, rim * std::cos(angle), rim * std::sin(angle));
  };
  for (int k = 0; k < segments; ++k)
    xml << R"(      <geom type="capsule" size="0.007" material="tyre" fromto=")"
        << on_rim(tau * k / segments) << ' ' << on_rim(tau * (k + 1) / segments) << "\"/>\n";
  for (int k = 0; k < spokes; ++k)
    xml << R"(      <geom type="capsule" size="0.0025" material=")" << (k == 0 ? "shell" : "metal")
        << R"(" fromto="0 0 0 )" << on_rim(tau * k / spokes) << "\"/>\n";
  xml << "    </body>\n";
}

}  // namespace detail

/// Returns the inertia of the base. Throws std::invalid_argument if arms and wheels have more mass
/// or inertia than the vehicle.
template <int Rotors>
[[nodiscard]] BaseInertia base_inertia(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                       const MujocoParameters& p) {
  BaseInertia base;
  base.mass = vehicle.body.mass;
  base.inertia = vehicle.body.inertia;  // about the CoM of the vehicle at this point
  const auto take = [&base](double mass, const Eigen::Vector3d& at, const Eigen::Matrix3d& own) {
    base.mass -= mass;
    base.com -= mass * at;
    base.inertia -= detail::point_inertia(mass, at) + own;
  };
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i) {
    const Eigen::Isometry3d rotor = rotor_in_body(vehicle, i);
    take(p.arm_mass, rotor * Eigen::Vector3d(0.0, 0.0, p.arm_height),
         rotor.linear() * p.arm_inertia.asDiagonal() * rotor.linear().transpose());
  }
  for (std::size_t i = 0; i < wheel_count(vehicle); ++i) {
    const Eigen::Isometry3d wheel = wheel_in_body(vehicle, i);
    Eigen::Vector3d own = detail::wheel_inertia(*vehicle.wheels, p);
    // The inertia of the vehicle excludes the inertia of the wheels about their axle.
    own.x() = 0.0;
    take(p.wheel_mass, wheel.translation(),
         wheel.linear() * own.asDiagonal() * wheel.linear().transpose());
  }
  tilt_ropter::require_positive("mass of the base without arms and wheels [kg]", base.mass);
  base.com /= base.mass;
  base.inertia -= detail::point_inertia(base.mass, base.com);
  tilt_ropter::require_inertia("inertia of the base without arms and wheels", base.inertia);
  return base;
}

/// Returns `p` with arms and wheels whose mass and inertia are halved until they fit into the
/// vehicle: a light vehicle cannot have the arms of the Tilt-Ropter. Returns `p` if no size fits.
template <int Rotors>
[[nodiscard]] MujocoParameters with_fitting_arms(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                                 const MujocoParameters& p) {
  MujocoParameters lighter = p;
  for (int halvings = 0; halvings < 6; ++halvings) {
    try {
      (void)base_inertia(vehicle, lighter);
      return lighter;
    } catch (const std::invalid_argument&) {
      lighter.arm_mass *= 0.5;
      lighter.arm_inertia *= 0.5;
      lighter.wheel_mass *= 0.5;
    }
  }
  return p;
}

/// Returns the MJCF text. Names: body `base`; joints `root`, `tilt1`.., `wheel1`.. with the
/// index of wheel_in_body; actuators `thrust1`.. [N] and `servo1`.. [rad/s]; sensor `imu` at the
/// CoM at zero tilt; geoms `ground`, `wall`, `tool` and `contact1`.., the tyres or the feet. Thrust
/// and reaction torque act at the site of the rotor, which tilts with its arm. A servo is a speed
/// loop. Geoms have no mass.
template <int Rotors>
[[nodiscard]] std::string mujoco_model(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                       const MujocoParameters& p = {}) {
  using detail::numbers;
  tilt_ropter::validate(vehicle);
  validate(p);
  const BaseInertia base = base_inertia(vehicle, p);
  const Eigen::Matrix3d& j = base.inertia;
  constexpr double foot_radius = 0.01;
  const double radius = vehicle.wheels ? vehicle.wheels->radius : foot_radius;
  const auto quoted = [](const std::string& text) { return '"' + text + '"'; };
  std::ostringstream xml;
  // The extent scales the camera's near plane; MuJoCo's own would reach to the wall far below.
  xml << R"(<mujoco model="tilt_ropter">
<compiler angle="radian" inertiafromgeom="false" balanceinertia="false" discardvisual=)"
      << quoted(p.seen ? "false" : "true") << R"(/>
<option integrator="implicit" solver="Newton" cone="elliptic" impratio="100" tolerance="1e-12")"
      << " timestep=" << quoted(numbers(p.time_step))
      << " gravity=" << quoted(numbers(0.0, 0.0, -tilt_ropter::gravity)) << R"(/>
<size nconmax="60" njmax="400"/>
<statistic extent="1"/>
<visual>
  <global offwidth="1920" offheight="1080" fovy="32"/>
  <quality shadowsize="4096" offsamples="4"/>
  <headlight ambient="0.38 0.39 0.42" diffuse="0.30 0.30 0.30" specular="0.1 0.1 0.1"/>
  <map znear="0.02" zfar="60" fogstart="9" fogend="24"/>
  <rgba haze="0.93 0.95 0.97 1" fog="0.93 0.95 0.97 1"/>
</visual>
<asset>
  <texture name="sky" type="skybox" builtin="gradient" rgb1="0.80 0.87 0.94" rgb2="0.97 0.98 0.99"
    width="256" height="256"/>
  <texture name="floor" type="2d" builtin="checker" rgb1="0.87 0.88 0.90" rgb2="0.82 0.83 0.86"
    mark="edge" markrgb="0.76 0.77 0.80" width="256" height="256"/>
  <material name="floor" texture="floor" texrepeat="1 1" texuniform="true" specular="0.1"
    shininess="0.2"/>
  <material name="carbon" rgba="0.13 0.14 0.16 1" specular="0.5" shininess="0.6"/>
  <material name="metal" rgba="0.62 0.64 0.67 1" specular="0.8" shininess="0.8"/>
  <material name="shell" rgba="0.95 0.60 0.13 1" specular="0.4" shininess="0.6"/>
  <material name="tyre" rgba="0.17 0.18 0.20 1" specular="0.1" shininess="0.1"/>
  <material name="plank" rgba="0.70 0.55 0.38 1"/>
  <material name="disc1" rgba="0.12 0.42 0.80 0.38"/>
  <material name="disc-1" rgba="0.85 0.22 0.20 0.38"/>
</asset>
<default>
  <geom contype="0" conaffinity="0"/>
  <default class="touches"><geom contype="0" conaffinity="1" condim="6" )"
      << "solref=" << quoted(numbers(p.contact_time_constant, 1.0))
      << " solimp=" << quoted(numbers(p.contact_impedance, p.contact_impedance, 1e-3))
      << " friction="
      << quoted(numbers(p.contact.friction, p.torsional_friction,
                        p.contact.rolling_resistance * radius))
      << R"(/></default>
  <default class="ground"><geom contype="1" conaffinity="0" condim="6" )"
      // MuJoCo uses the larger friction of two geoms; the ground has less friction than the wheels.
      << R"(friction="1e-5 1e-5 1e-5" solref=)" << quoted(numbers(p.contact_time_constant, 1.0))
      << " solimp=" << quoted(numbers(p.contact_impedance, p.contact_impedance, 1e-3))
      << R"(/></default>
</default>
<worldbody>
  <light directional="true" pos="-2 -3 6" dir="0.3 0.45 -1" diffuse="0.62 0.60 0.57"
    specular="0.2 0.2 0.2" castshadow="true"/>
  <geom name="ground" class="ground" type="plane" size="30 30 0.5" material="floor" quat=)"
      << quoted(numbers(ground_orientation(p)))
      << " pos=" << quoted(numbers(0.0, 0.0, p.ground_height)) << "/>\n";
  if (p.step_height > 0.0)
    xml << R"(  <geom name="step" class="ground" type="box" material="plank" size=)"
        << quoted(numbers(0.5 * p.step_width, 1.2, p.step_height))
        << " pos=" << quoted(numbers(p.step_position, 0.0, p.ground_height)) << "/>\n";

  // The wall touches nothing until MujocoPlant::set_wall() places it.
  xml << R"(  <geom name="wall" type="plane" size="30 30 0.5" pos="0 0 -1000" contype="4"
    priority="1" condim="3"/>
  <body name="base">
    <freejoint name="root"/>
    <inertial mass=)"
      << quoted(numbers(base.mass)) << " pos="
      << quoted(numbers(base.com.x() + p.com_x * vehicle.body.mass / base.mass, base.com.y(),
                        base.com.z()))
      << " fullinertia=" << quoted(numbers(j(0, 0), j(1, 1), j(2, 2), j(0, 1), j(0, 2), j(1, 2)))
      << R"(/>
    <site name="imu"/>
    <geom name="tool" type="sphere" size="0.001" conaffinity="8" material="metal"/>
    <geom class="touches" type="ellipsoid" size="0.075 0.05 0.032" material="shell"/>
    <geom type="box" size="0.05 0.033 0.008" pos="0 0 -0.03" material="carbon"/>
    <geom type="cylinder" size="0.006 0.012" pos="0 0 0.036" material="metal"/>
    <geom type="sphere" size="0.009" pos="0.068 0 0.006" material="carbon"/>
)";
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i) {
    const std::string n = std::to_string(i + 1);
    const Eigen::Isometry3d rotor = rotor_in_body(vehicle, i);
    const double arm = rotor.translation().norm();
    const int spin = static_cast<int>(vehicle.rotors[i].spin);
    const tilt_ropter::RotorParameters& propeller = rotor_parameters(vehicle, i);
    const bool known = propeller.propeller_radius > 0.0;  // otherwise drawn in a usual size
    const double disc = known ? propeller.propeller_radius : 0.075,
                 height = known ? propeller.propeller_height : 0.034;
    xml << "    <body name=\"arm" << n << '"' << detail::placed(rotor) << R"(>
      <joint name="tilt)"
        << n << R"(" type="hinge" axis="1 0 0" armature=)" << quoted(numbers(p.servo_armature))
        << R"(/>
      <inertial mass=)"
        << quoted(numbers(p.arm_mass)) << " pos=" << quoted(numbers(0.0, 0.0, p.arm_height))
        << " diaginertia=" << quoted(numbers(p.arm_inertia)) << R"(/>
      <site name="rotor)"
        << n << R"("/>
      <geom type="capsule" size="0.008" fromto=)"
        << quoted(numbers(-arm + 0.045, 0, 0, 0, 0, 0)) << R"( material="carbon"/>
      <geom class="touches" type="cylinder" size="0.015 0.014" pos="0 0 0.006" material="metal"/>
      <geom type="cylinder" size="0.004 0.01" pos="0 0 0.026" material="metal"/>
      <geom type="cylinder" size=)"
        << quoted(numbers(disc, 0.0012)) << " pos=" << quoted(numbers(0.0, 0.0, height))
        << R"( conaffinity="2" material="disc)" << spin << R"("/>
      <geom type="ellipsoid" size=)"
        << quoted(numbers(0.97 * disc, 0.006, 0.002))
        << " pos=" << quoted(numbers(0.0, 0.0, height)) << R"( euler="0 0 )"
        << 0.7 * static_cast<double>(i) << "\" material=\"carbon\"/>\n";
    for (std::size_t w = 0; w < wheel_count(vehicle); ++w)
      if (axle_arm(vehicle, w) == i)
        detail::add_wheel(xml, vehicle, p, w, rotor.inverse() * wheel_in_body(vehicle, w),
                          Eigen::Vector3d::Zero());
    xml << "    </body>\n";
  }
  for (std::size_t i = 0; i < wheel_count(vehicle); ++i)
    if (!axle_arm(vehicle, i)) {
      const Eigen::Isometry3d wheel = wheel_in_body(vehicle, i);
      const double arm = rotor_in_body(vehicle, i % 2).translation().norm();
      const Eigen::Vector3d inner(wheel.translation().x(),
                                  wheel.translation().y() * arm / vehicle.wheels->half_track, 0.0);
      detail::add_wheel(xml, vehicle, p, i, wheel, inner);
    }
  if (vehicle.legs) {
    const tilt_ropter::LegParameters& legs = *vehicle.legs;
    for (int i = 0; i < 4; ++i) {
      const std::string foot =
          numbers(i < 2 ? legs.half_length : -legs.half_length,
                  i % 2 == 0 ? -legs.half_width : legs.half_width, -legs.height + foot_radius);
      xml << "    <geom name=\"contact" << i + 1 << R"(" class="touches" type="sphere" size=)"
          << quoted(numbers(foot_radius)) << " pos=" << quoted(foot)
          << " material=\"tyre\"/>\n    <geom type=\"capsule\" size=\"0.004\" material=\"metal\" "
             "fromto="
          << quoted("0 0 0 " + foot) << "/>\n";
    }
  }
  if (p.payload > 0.0) {
    const double half = 0.02;
    xml << "    <body name=\"payload\" pos=" << quoted(numbers(p.payload_position))
        << ">\n      <inertial mass=" << quoted(numbers(p.payload))
        << R"( pos="0 0 0" diaginertia=)"
        << quoted(numbers(
               Eigen::Vector3d(Eigen::Vector3d::Constant(2.0 / 3.0 * p.payload * half * half))))
        << "/>\n      <geom type=\"box\" material=\"plank\" size="
        << quoted(numbers(half, half, half)) << "/>\n    </body>\n";
  }
  xml << "  </body>\n</worldbody>\n<actuator>\n";
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i)
    xml << "  <motor name=\"thrust" << i + 1 << "\" site=\"rotor" << i + 1 << "\" gear=\"0 0 1 0 0 "
        << numbers(-static_cast<int>(vehicle.rotors[i].spin) *
                   rotor_parameters(vehicle, i).torque_ratio)
        << "\"/>\n";
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i)
    xml << "  <velocity name=\"servo" << i + 1 << "\" joint=\"tilt" << i + 1
        << "\" kv=" << quoted(numbers(p.servo_damping)) << R"( forcelimited="true" forcerange=)"
        << quoted(numbers(-p.servo_torque, p.servo_torque)) << "/>\n";
  xml << "</actuator>\n<sensor>\n  <accelerometer name=\"imu\" "
         "site=\"imu\"/>\n</sensor>\n</mujoco>\n";
  return xml.str();
}

}  // namespace examples
