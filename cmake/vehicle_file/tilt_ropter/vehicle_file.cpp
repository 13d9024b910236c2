// SPDX-License-Identifier: BSD-3-Clause
#include "vehicle_file.hpp"

#include "json_fields.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <nlohmann/json.hpp>

#include <cmath>
#include <cstddef>
#include <fstream>
#include <istream>
#include <sstream>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace tilt_ropter {
namespace {

using json_fields::Fields;
using json_fields::Json;
using json_fields::list_of;
using json_fields::parse;
using json_fields::Range;
using json_fields::refuse;
using json_fields::rounded;
using json_fields::shown;
using json_fields::text_of;

constexpr double degree = pi / 180.0;

/// Returns true if `fields` has at least one rotor parameter.
bool has_rotor_parameters(Fields& fields) {
  bool has = false;
  for (const char* key :
       {"thrust_coefficient_n_s2_per_rad2", "linear_thrust_coefficient_n_s_per_rad",
        "torque_ratio_m", "min_thrust_n", "max_thrust_n", "time_constant_s", "propeller_radius_m",
        "propeller_height_m"})
    has = fields.find(key) != nullptr || has;
  return has;
}

/// Reads the rotor parameters of the object `path`. A missing field takes the value of `common`; if
/// `common` is nullptr, a missing field is an error.
RotorParameters read_rotor_parameters(Fields& fields, const std::string& path,
                                      const RotorParameters* common) {
  const auto number = [&](const char* key, const Range& range, double RotorParameters::*field) {
    return common != nullptr && fields.find(key) == nullptr ? common->*field
                                                            : fields.number(key, range);
  };
  RotorParameters rotor;
  rotor.thrust_coefficient = number("thrust_coefficient_n_s2_per_rad2", {1e-10, 1.0, "N s^2/rad^2"},
                                    &RotorParameters::thrust_coefficient);
  rotor.torque_ratio = number("torque_ratio_m", {0.0, 1.0, "m"}, &RotorParameters::torque_ratio);
  rotor.min_thrust = number("min_thrust_n", {0.0, 1e4, "N"}, &RotorParameters::min_thrust);
  rotor.max_thrust = number("max_thrust_n", {1e-3, 1e4, "N"}, &RotorParameters::max_thrust);
  rotor.time_constant =
      number("time_constant_s", {1e-3, 1.0, "s"}, &RotorParameters::time_constant);
  if (common != nullptr) rotor.propeller_radius = common->propeller_radius;
  if (fields.find("propeller_radius_m") != nullptr)
    rotor.propeller_radius = fields.number("propeller_radius_m", {0.0, 5.0, "m"});
  if (common != nullptr) rotor.propeller_height = common->propeller_height;
  if (fields.find("propeller_height_m") != nullptr)
    rotor.propeller_height = fields.number("propeller_height_m", {-1.0, 1.0, "m"});
  const char* linear = "linear_thrust_coefficient_n_s_per_rad";
  if (common != nullptr) rotor.linear_thrust_coefficient = common->linear_thrust_coefficient;
  if (fields.find(linear) != nullptr) {
    const double least = -std::sqrt(0.5 * rotor.thrust_coefficient * rotor.max_thrust);
    rotor.linear_thrust_coefficient = fields.number(linear, {least, 1.0, "N s/rad"});
  }
  if (rotor.min_thrust >= rotor.max_thrust)
    refuse(path + ".min_thrust_n", shown(rotor.min_thrust),
           "less than max_thrust_n, " + shown(rotor.max_thrust) + " N");
  return rotor;
}

RotorGeometry read_rotor(const Json& object, const std::string& path,
                         const RotorParameters& common) {
  Fields fields(object, path);
  const Range metres{-10.0, 10.0, "m"}, any{-1e3, 1e3, ""};
  RotorGeometry rotor;
  const bool clockwise = fields.text("spin", {"counter_clockwise", "clockwise"}) == "clockwise";
  const Spin spin = clockwise ? Spin::clockwise : Spin::counter_clockwise;
  const bool tilts = fields.truth("tilts");
  if (fields.find("position_m") == nullptr && fields.find("thrust_axis") == nullptr) {
    const double azimuth = fields.number("azimuth_deg", {-360.0, 360.0, "deg"});
    rotor = rotor_on_arm(azimuth * degree, fields.number("length_m", {0.01, 10.0, "m"}), spin);
  } else {
    rotor.position = fields.vector("position_m", metres);
    const auto axis = [&](const std::string& key) -> Eigen::Vector3d {
      const Eigen::Vector3d value = fields.vector(key, any);
      if (!(value.norm() > 1e-3))
        refuse(fields.name(key), "of length " + shown(value.norm()), "longer than 0.001");
      return value.normalized();
    };
    const Eigen::Vector3d up = axis("thrust_axis");
    const Eigen::Vector3d out = tilts ? axis("arm_axis") : up.unitOrthogonal().eval();
    if (std::abs(up.dot(out)) > 1e-3)
      refuse(fields.name("arm_axis"),
             shown(std::acos(up.dot(out)) / degree) + " deg from thrust_axis",
             "at a right angle to it, within 0.06 deg");
    rotor.spin = spin;
    rotor.orientation.col(2) = up;
    rotor.orientation.col(1) = up.cross(out).normalized();
    rotor.orientation.col(0) = rotor.orientation.col(1).cross(up);
  }
  rotor.tilts = tilts;
  if (has_rotor_parameters(fields)) rotor.parameters = read_rotor_parameters(fields, path, &common);
  fields.refuse_unknown();
  return rotor;
}

RigidBodyParameters read_body(const Json& object) {
  Fields fields(object, "body");
  RigidBodyParameters body;
  body.mass = fields.number("mass_kg", {0.01, 1e3, "kg"});
  body.inertia = fields.inertia("inertia_kg_m2", {-1e4, 1e4, "kg m^2"});
  fields.refuse_unknown();
  require_inertia("body.inertia_kg_m2", body.inertia);
  return body;
}

RotorParameters read_rotor_parameters(const Json& object) {
  Fields fields(object, "rotor");
  const RotorParameters rotor = read_rotor_parameters(fields, "rotor", nullptr);
  fields.refuse_unknown();
  return rotor;
}

ServoParameters read_servo(const Json& object) {
  Fields fields(object, "servo");
  ServoParameters servo;
  servo.time_constant = fields.number("time_constant_s", {1e-3, 1.0, "s"});
  servo.max_rate = fields.number("max_rate_radps", {0.1, 100.0, "rad/s"});
  servo.min_angle = fields.number("min_angle_deg", {-720.0, 0.0, "deg"}) * degree;
  servo.max_angle = fields.number("max_angle_deg", {0.0, 720.0, "deg"}) * degree;
  servo.dead_time = fields.number("dead_time_s", {0.0, 0.5, "s"});
  fields.refuse_unknown();
  if (!(servo.min_angle < servo.max_angle))
    refuse("servo.max_angle_deg", shown(servo.max_angle / degree), "more than min_angle_deg");
  return servo;
}

/// `mass` is that of the vehicle [kg]. Without a field for their inertia, the wheels have the same
/// part of it as the wheels of the Tilt-Ropter.
WheelParameters read_wheels(const Json& object, double mass) {
  Fields fields(object, "wheels");
  WheelParameters wheels;
  wheels.radius = fields.number("radius_m", {0.005, 1.0, "m"});
  wheels.half_track = fields.number("half_track_m", {0.01, 5.0, "m"});
  if (fields.find("wheel_base_m") != nullptr)
    wheels.wheel_base = fields.number("wheel_base_m", {0.0, 5.0, "m"});
  if (fields.find("half_width_m") != nullptr)
    wheels.half_width = fields.number("half_width_m", {0.0, 1.0, "m"});
  wheels.inertia = 0.022 * mass * wheels.radius * wheels.radius;
  if (fields.find("inertia_kg_m2") != nullptr)
    wheels.inertia = fields.number("inertia_kg_m2", {1e-8, 10.0, "kg m^2"});
  if (fields.find("on_arms") != nullptr) wheels.on_arms = fields.truth("on_arms");
  fields.refuse_unknown();
  return wheels;
}

LegParameters read_legs(const Json& object) {
  Fields fields(object, "legs");
  LegParameters legs;
  legs.height = fields.number("height_m", {0.01, 5.0, "m"});
  legs.half_length = fields.number("half_length_m", {0.01, 5.0, "m"});
  legs.half_width = fields.number("half_width_m", {0.01, 5.0, "m"});
  fields.refuse_unknown();
  return legs;
}

constexpr double unknown_power = 0.0;  // of hover, until the rotors are known

/// Power of hover by the torques of the rotors, each with the same part of the weight [W].
template <int Rotors>
double estimated_hover_power(const Vehicle<Rotors>& vehicle) {
  constexpr double efficiency = 0.65;  // of motors and their controllers; the Tilt-Ropter has 0.6
  const double thrust = vehicle.body.mass * gravity / Rotors;
  double power = 0.0;
  for (std::size_t i = 0; i < Rotors; ++i) {
    const RotorParameters& rotor = rotor_parameters(vehicle, i);
    power += rotor.torque_ratio * thrust * std::sqrt(thrust / rotor.thrust_coefficient);
  }
  return vehicle.power.electronics + servo_count(vehicle) * vehicle.power.servo_hold +
         power / efficiency;
}

PowerParameters read_power(const Json& object) {
  Fields fields(object, "power");
  PowerParameters power;
  power.electronics = fields.number("electronics_w", {0.0, 1e5, "W"});
  const bool is_known = fields.find("hover_w") != nullptr;
  power.hover = is_known ? fields.number("hover_w", {1e-3, 1e6, "W"}) : unknown_power;
  if (fields.find("servo_hold_w") != nullptr)
    power.servo_hold = fields.number("servo_hold_w", {0.0, 1e3, "W"});
  if (fields.find("servo_move_j_per_rad") != nullptr)
    power.servo_move = fields.number("servo_move_j_per_rad", {0.0, 1e3, "J/rad"});
  fields.refuse_unknown();
  if (is_known && power.hover <= power.electronics)
    refuse("power.hover_w", shown(power.hover),
           "more than electronics_w, " + shown(power.electronics) + " W");
  return power;
}

/// Reads the battery, which is known if at least one of the fields after battery_nominal_v is
/// there.
BatteryParameters read_battery(Fields& fields) {
  BatteryParameters battery;
  if (fields.find("battery_nominal_v") != nullptr)
    battery.nominal_voltage = fields.number("battery_nominal_v", {0.1, 1e4, "V"});
  bool known = false;
  for (const char* key :
       {"battery_capacity_ah", "battery_full_v", "battery_empty_v", "battery_resistance_ohm"})
    known = fields.find(key) != nullptr || known;
  if (!known) return battery;
  battery.capacity = fields.number("battery_capacity_ah", {1e-3, 1e5, "A h"});
  battery.full_voltage = fields.number("battery_full_v", {0.1, 1e4, "V"});
  battery.empty_voltage = fields.number("battery_empty_v", {0.1, 1e4, "V"});
  battery.resistance = fields.number("battery_resistance_ohm", {0.0, 100.0, "ohm"});
  if (battery.empty_voltage > battery.full_voltage)
    refuse("battery_empty_v", shown(battery.empty_voltage),
           "at most battery_full_v, " + shown(battery.full_voltage) + " V");
  return battery;
}

/// Calls action(key, range, field) for each field of NmpcBounds.
template <typename Bounds, typename Action>
void for_limits(Bounds& b, const Action& action) {
  const auto up_to = [](const char* unit) { return Range{1e-6, 1e6, unit}; };
  const auto either = [](const char* unit) { return Range{-1e6, 1e6, unit}; };
  action("force_min_n", either("N"), b.force_min);
  action("force_max_n", either("N"), b.force_max);
  action("torque_min_nm", either("N m"), b.torque_min);
  action("torque_max_nm", either("N m"), b.torque_max);
  action("angular_velocity_radps", up_to("rad/s"), b.angular_velocity);
  action("force_rate_nps", up_to("N/s"), b.force_rate);
  action("torque_rate_nmps", up_to("N m/s"), b.torque_rate);
}

/// Calls action(key, range, field) for each field of VehicleFileGround.
template <typename Ground, typename Action>
void for_ground(Ground& g, const Action& action) {
  action("down_force_n", Range{0.0, 1e6, "N"}, g.down_force);
  action("rotor_thrust_n", Range{0.0, 1e6, "N"}, g.rotor_thrust);
  action("settling_speed_mps", Range{0.01, 10.0, "m/s"}, g.settling_speed);
}

void require_limits(const NmpcBounds& limits, double weight) {
  for (Eigen::Index i = 0; i < 3; ++i) {
    const std::string at = '[' + std::to_string(i) + ']';
    if (limits.force_min(i) > limits.force_max(i))
      refuse("limits.force_min_n" + at, shown(limits.force_min(i)),
             "at most force_max_n" + at + ", " + shown(limits.force_max(i)) + " N");
    if (limits.torque_min(i) > limits.torque_max(i))
      refuse("limits.torque_min_nm" + at, shown(limits.torque_min(i)),
             "at most torque_max_nm" + at + ", " + shown(limits.torque_max(i)) + " N m");
  }
  if (limits.force_max.z() <= weight)
    refuse("limits.force_max_n[2]", shown(limits.force_max.z()),
           "more than the weight, " + shown(weight) + " N");
  if (limits.force_min.z() >= weight)
    refuse("limits.force_min_n[2]", shown(limits.force_min.z()),
           "less than the weight, " + shown(weight) + " N");
}

template <int Rotors>
Vehicle<Rotors> with_rotors(const Json& list, Vehicle<Rotors> vehicle) {
  for (std::size_t i = 0; i < Rotors; ++i)
    vehicle.rotors[i] = read_rotor(list[i], "rotors[" + std::to_string(i) + ']', vehicle.rotor);
  const double weight = vehicle.body.mass * gravity;
  // Necessary condition: the sum of all thrusts exceeds the weight. check_vehicle checks more.
  const double per_rotor = weight / Rotors;
  double lift = 0.0;
  bool alike = true;
  for (std::size_t i = 0; i < Rotors; ++i) {
    lift += rotor_parameters(vehicle, i).max_thrust;
    alike = alike && !vehicle.rotors[i].parameters;
  }
  if (alike && vehicle.rotor.max_thrust <= per_rotor)
    refuse("rotor.max_thrust_n", shown(vehicle.rotor.max_thrust),
           "more than " + shown(per_rotor) + " N per rotor: the weight is " + shown(weight) + " N");
  if (!alike && lift <= weight)
    refuse("sum of max_thrust_n of all rotors", shown(lift),
           "more than the weight, " + shown(weight) + " N");
  if (vehicle.power.hover == unknown_power) vehicle.power.hover = estimated_hover_power(vehicle);
  const double at_rest =
      vehicle.power.electronics + servo_count(vehicle) * vehicle.power.servo_hold;
  if (vehicle.power.hover <= at_rest)
    refuse("power.hover_w", shown(vehicle.power.hover),
           "more than electronics and servos at rest, " + shown(at_rest) + " W");
  if (vehicle.wheels && vehicle.wheels->on_arms && !(axle_arm(vehicle, 0) && axle_arm(vehicle, 1)))
    refuse("wheels.on_arms", shown(Json(true)),
           "false, unless wheel_base_m is 0 and two arms point along -y and +y, within 5 cm of the "
           "CoM, and end before the wheels (length_m below half_track_m)");
  validate(vehicle);
  return vehicle;
}

/// Reads the whole file. The number of rotors determines the type of the vehicle.
VehicleFile read(const Json& root) {
  Fields fields(root, "");
  const std::string object = "an object";
  VehicleFile file;
  file.name = fields.text("name");
  Vehicle<4> common;
  common.body = read_body(fields.get("body", object));
  common.rotor = read_rotor_parameters(fields.get("rotor", object));
  common.servo = read_servo(fields.get("servo", object));
  const auto there = [&fields](const char* key) -> const Json* {  // null counts as missing
    const Json* value = fields.find(key);
    return value == nullptr || value->is_null() ? nullptr : value;
  };
  if (const Json* wheels = there("wheels")) common.wheels = read_wheels(*wheels, common.body.mass);
  if (const Json* legs = there("legs")) common.legs = read_legs(*legs);
  if (common.wheels && common.legs) refuse("legs", "an object", "absent for a vehicle with wheels");
  common.power = read_power(fields.get("power", object));
  if (fields.find("battery_wh") != nullptr)
    file.battery_wh = fields.number("battery_wh", {0.1, 1e6, "W h"});
  common.battery = read_battery(fields);

  const std::string rotor_list = "a list of 2 to 8 rotors";
  const Json& list = fields.get("rotors", rotor_list);
  if (!list.is_array()) refuse("rotors", shown(list), rotor_list);
  const auto with = [&](auto vehicle) {
    vehicle.body = common.body;
    vehicle.rotor = common.rotor;
    vehicle.servo = common.servo;
    vehicle.wheels = common.wheels;
    vehicle.legs = common.legs;
    vehicle.power = common.power;
    vehicle.battery = common.battery;
    file.vehicle = with_rotors(list, vehicle);
  };
  const auto with_their_number = [&](const auto&... vehicles) {
    return ((vehicles.rotors.size() == list.size() && (with(vehicles), true)) || ...);
  };
  if (!with_their_number(Vehicle<2>{}, Vehicle<3>{}, Vehicle<4>{}, Vehicle<5>{}, Vehicle<6>{},
                         Vehicle<7>{}, Vehicle<8>{}))
    refuse("rotors", "a list of " + std::to_string(list.size()), rotor_list);

  if (const Json* errors = fields.find("allowed_errors")) {
    Fields inner(*errors, "allowed_errors");
    for_allowed_errors(file.allowed_errors, [&](const char* key, const char* unit, auto& value) {
      const Range range{1e-6, 1e6, unit};
      if constexpr (std::is_same_v<decltype(value), double&>)
        value = inner.number(key, range, value);
      else
        inner.vector_if_there(key, range, value);
    });
    inner.refuse_unknown();
  }
  file.limits =
      std::visit([](const auto& v) { return nmpc_settings(v).problem.bounds; }, file.vehicle);
  if (const Json* limits = fields.find("limits")) {
    Fields inner(*limits, "limits");
    for_limits(file.limits, [&](const char* key, const Range& range, auto& value) {
      inner.vector_if_there(key, range, value);
    });
    inner.refuse_unknown();
  }
  if (const Json* ground = fields.find("ground")) {
    Fields inner(*ground, "ground");
    for_ground(file.ground, [&](const char* key, const Range& range, auto& value) {
      if (inner.find(key) != nullptr) value = inner.number(key, range);
    });
    inner.refuse_unknown();
  }
  fields.refuse_unknown();
  require_limits(file.limits, common.body.mass * gravity);
  return file;
}

/// Returns the fields of `rotor` that differ from `common`. If `common` is nullptr: all required
/// fields, and optional fields that differ from the default.
Json json_of(const RotorParameters& rotor, const RotorParameters* common) {
  Json object = Json::object();
  const auto add = [&](const char* key, double RotorParameters::*field, bool needed) {
    const double usual = common != nullptr ? common->*field : RotorParameters{}.*field;
    const bool same = !(std::abs(rotor.*field - usual) > 0.0);
    if (!same || (common == nullptr && needed)) object[key] = rotor.*field;
  };
  add("thrust_coefficient_n_s2_per_rad2", &RotorParameters::thrust_coefficient, true);
  add("linear_thrust_coefficient_n_s_per_rad", &RotorParameters::linear_thrust_coefficient, false);
  add("torque_ratio_m", &RotorParameters::torque_ratio, true);
  add("min_thrust_n", &RotorParameters::min_thrust, true);
  add("max_thrust_n", &RotorParameters::max_thrust, true);
  add("time_constant_s", &RotorParameters::time_constant, true);
  add("propeller_radius_m", &RotorParameters::propeller_radius, false);
  add("propeller_height_m", &RotorParameters::propeller_height, false);
  return object;
}

Json json_of(const RotorGeometry& rotor, const RotorParameters& common) {
  Json object;
  const double length = rotor.position.norm();
  const double azimuth = std::atan2(rotor.position.y(), rotor.position.x());
  const RotorGeometry on_arm = rotor_on_arm(azimuth, length, rotor.spin);
  if (on_arm.position.isApprox(rotor.position) && on_arm.orientation.isApprox(rotor.orientation)) {
    object["azimuth_deg"] = rounded(azimuth / degree);
    object["length_m"] = rounded(length);
  } else {
    object["position_m"] = list_of(rotor.position);
    object["thrust_axis"] = list_of(rotor.orientation.col(2));
    if (rotor.tilts) object["arm_axis"] = list_of(rotor.orientation.col(0));
  }
  object["spin"] = rotor.spin == Spin::clockwise ? "clockwise" : "counter_clockwise";
  object["tilts"] = rotor.tilts;
  if (rotor.parameters) object.update(json_of(*rotor.parameters, &common));
  return object;
}

template <int Rotors>
Json json_of(const VehicleFile& file, const Vehicle<Rotors>& v) {
  Json root;
  root["name"] = file.name;
  const Eigen::Matrix3d& inertia = v.body.inertia;
  root["body"]["mass_kg"] = v.body.mass;
  if (inertia.isDiagonal(0.0)) {
    root["body"]["inertia_kg_m2"] = list_of(inertia.diagonal());
  } else {
    for (int i = 0; i < 3; ++i)
      root["body"]["inertia_kg_m2"].push_back(list_of(inertia.row(i).transpose()));
  }
  root["rotor"] = json_of(v.rotor, nullptr);
  root["servo"] = {{"time_constant_s", v.servo.time_constant},
                   {"max_rate_radps", v.servo.max_rate},
                   {"min_angle_deg", rounded(v.servo.min_angle / degree)},
                   {"max_angle_deg", rounded(v.servo.max_angle / degree)},
                   {"dead_time_s", v.servo.dead_time}};
  for (const RotorGeometry& rotor : v.rotors) root["rotors"].push_back(json_of(rotor, v.rotor));
  if (v.wheels) {
    root["wheels"] = {{"radius_m", v.wheels->radius}, {"half_track_m", v.wheels->half_track}};
    if (v.wheels->wheel_base > 0.0) root["wheels"]["wheel_base_m"] = v.wheels->wheel_base;
    root["wheels"]["half_width_m"] = v.wheels->half_width;
    root["wheels"]["inertia_kg_m2"] = v.wheels->inertia;
    root["wheels"]["on_arms"] = v.wheels->on_arms;
  }
  if (v.legs)
    root["legs"] = {{"height_m", v.legs->height},
                    {"half_length_m", v.legs->half_length},
                    {"half_width_m", v.legs->half_width}};
  root["power"] = {{"electronics_w", v.power.electronics}, {"hover_w", v.power.hover}};
  if (v.power.servo_hold > 0.0) root["power"]["servo_hold_w"] = v.power.servo_hold;
  if (v.power.servo_move > 0.0) root["power"]["servo_move_j_per_rad"] = v.power.servo_move;
  if (file.battery_wh > 0.0) root["battery_wh"] = file.battery_wh;
  if (v.battery.nominal_voltage > 0.0) root["battery_nominal_v"] = v.battery.nominal_voltage;
  if (is_known(v.battery)) {
    root["battery_capacity_ah"] = v.battery.capacity;
    root["battery_full_v"] = v.battery.full_voltage;
    root["battery_empty_v"] = v.battery.empty_voltage;
    root["battery_resistance_ohm"] = v.battery.resistance;
  }
  for_allowed_errors(file.allowed_errors, [&](const char* key, const char*, const auto& value) {
    if constexpr (std::is_same_v<decltype(value), const double&>)
      root["allowed_errors"][key] = rounded(value);
    else
      root["allowed_errors"][key] = list_of(value);
  });
  // Writes only limits that differ from the defaults. The defaults scale with mass and size, so
  // that changes of mass and size in the file need no new limits.
  std::vector<Eigen::Vector3d> defaults;
  const NmpcBounds usual = nmpc_settings(v).problem.bounds;
  for_limits(usual, [&](const char*, const Range&, const Eigen::Vector3d& value) {
    defaults.push_back(value);
  });
  std::size_t i = 0;
  for_limits(file.limits, [&](const char* key, const Range&, const Eigen::Vector3d& value) {
    if (!value.isApprox(defaults[i++], 1e-9)) root["limits"][key] = list_of(value);
  });
  for_ground(file.ground, [&](const char* key, const Range&, const std::optional<double>& value) {
    if (value) root["ground"][key] = *value;
  });
  return root;
}

}  // namespace

VehicleFile read_vehicle(std::istream& in, const std::string& file) {
  try {
    return read(parse(in));
  } catch (const Json::exception& error) {
    throw VehicleFileError(file + ": " + json_fields::message_of(error));
  } catch (const std::exception& error) {
    throw VehicleFileError(file + ": " + error.what());
  }
}

VehicleFile read_vehicle(const std::string& path) {
  std::ifstream in(path);
  if (!in) throw VehicleFileError("cannot read " + path);
  return read_vehicle(in, path);
}

void write_vehicle(const VehicleFile& file, const std::string& path) {
  const Json root = std::visit([&](const auto& v) { return json_of(file, v); }, file.vehicle);
  std::ofstream out(path);
  out << text_of(root) << '\n';
  if (!out.flush()) throw std::runtime_error("cannot write " + path);
}

}  // namespace tilt_ropter
