#pragma once

#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

namespace examples {

/// A field of an option such as --fault, and where its value goes.
struct NamedNumber {
  std::string name;
  double* value;
};

namespace detail {

/// Reads `text`, such as `start=20,duration=1`, into `fields`. Throws std::invalid_argument that
/// begins with `option` and names what is wrong.
inline void read_fields(const std::string& option, const std::string& text,
                        const std::vector<NamedNumber>& fields) {
  std::istringstream parts(text);
  for (std::string part; std::getline(parts, part, ',');) {
    const std::size_t equals = part.find('=');
    const std::string key = part.substr(0, equals);
    std::string known;
    double* value = nullptr;
    for (const NamedNumber& field : fields) {
      known += (known.empty() ? "" : &field == &fields.back() ? " or " : ", ") + field.name;
      if (field.name == key) value = field.value;
    }
    if (value == nullptr)
      throw std::invalid_argument(option + ": unknown field " + key + ", must be " + known);
    std::size_t used = 0;
    const std::string number = equals == std::string::npos ? "" : part.substr(equals + 1);
    try {
      *value = std::stod(number, &used);
    } catch (const std::exception&) {
      used = 0;
    }
    if (used == 0 || used != number.size())
      throw std::invalid_argument(option + ": " + key + " = " + number + ": must be a number");
  }
}

}  // namespace detail

/// Reads a fault such as `pose_freeze:start=20,duration=1` or `pose_jump:start=5,size=0.2`. Throws
/// std::invalid_argument that names what is wrong.
[[nodiscard]] inline tilt_ropter::SensorFault parse_fault(const std::string& text) {
  const std::size_t colon = text.find(':');
  const std::string name = text.substr(0, colon);
  const auto kind = tilt_ropter::sensor_fault_kind(name);
  if (!kind) {
    std::string known;
    for (const auto fault : tilt_ropter::sensor_fault_names)
      known += (known.empty() ? "" : ", ") + std::string(fault);
    throw std::invalid_argument("--fault " + name + ": must be one of " + known);
  }
  tilt_ropter::SensorFault fault;
  fault.kind = *kind;
  detail::read_fields("--fault " + name, colon == std::string::npos ? "" : text.substr(colon + 1),
                      {{"start", &fault.start},
                       {"duration", &fault.duration},
                       {"size", &fault.size},
                       {"frequency", &fault.frequency}});
  validate(fault);
  return fault;
}

/// Which actuator of a plant fails, how, and when.
struct ActuatorFailureOption {
  std::string name;            ///< motor, motor_silent, blade, servo or limp
  std::size_t rotor = 0;       ///< from 0
  double effectiveness = 0.0;  ///< fraction of the thrust that a broken blade leaves
  /// To which a servo goes, NaN: the angle at that time [rad].
  double angle = std::numeric_limits<double>::quiet_NaN();
  double start = 20.0;  ///< [s]
};

inline constexpr const char* failure_help =
    "an actuator fails at start (default: 20 s; 0: before the take-off). motor:rotor=1,start=20 "
    "stops, and its telemetry says so; motor_silent stops, but its telemetry goes on with the "
    "commanded speed; blade:rotor=1,effectiveness=0 keeps its speed and this fraction of its "
    "thrust (also named rotor); servo:rotor=2,angle=90 sticks at this angle [deg], by default "
    "where it is; limp:rotor=2,angle=90 holds no torque: its arm sinks to this angle (in MuJoCo "
    "it swings freely). The controller is not told; it has to find the failure, and lands";

/// Reads an option as failure_help describes it. Rotors are counted from 1 to `rotors`. Throws
/// std::invalid_argument that names what is wrong.
[[nodiscard]] inline ActuatorFailureOption parse_failure(const std::string& text, int rotors) {
  const std::size_t colon = text.find(':');
  const std::string name = text.substr(0, colon), option = "--failure " + name;
  ActuatorFailureOption given;
  given.name = name == "rotor" ? "blade" : name;
  double rotor = 1.0, degrees = name == "limp" ? 90.0 : given.angle;
  std::vector<NamedNumber> fields = {{"rotor", &rotor}, {"start", &given.start}};
  if (name == "servo" || name == "limp")
    fields.push_back({"angle", &degrees});
  else if (given.name == "blade")
    fields.push_back({"effectiveness", &given.effectiveness});
  else if (name != "motor" && name != "motor_silent")
    throw std::invalid_argument(option + ": must be motor, motor_silent, blade, servo or limp");
  detail::read_fields(option, colon == std::string::npos ? "" : text.substr(colon + 1), fields);
  tilt_ropter::require(rotor >= 1.0 && rotor <= rotors && rotor == std::floor(rotor),
                       option + ": rotor", rotor,
                       "a whole number from 1 to " + std::to_string(rotors));
  if (!std::isnan(degrees))
    tilt_ropter::require_in(option + ": angle [deg]", degrees, -180.0, 180.0);
  tilt_ropter::require_in(option + ": effectiveness", given.effectiveness, 0.0, 1.0);
  tilt_ropter::require_in(option + ": start [s]", given.start, 0.0, 1e6);
  given.rotor = static_cast<std::size_t>(rotor) - 1;
  given.angle = degrees * tilt_ropter::pi / 180.0;
  return given;
}

/// Rotors that turn slower or faster than commanded, from a time on.
struct RotorSpeedOption {
  int rotor = 0;              ///< from 1; 0: all of them
  double ratio = 1.0;         ///< measured / commanded speed
  double start = 0.0;         ///< [s]
  double end = 0.0;           ///< the ratio changes evenly from 1 until then [s]; 0: at once
  bool with_battery = false;  ///< the speed is proportional to the voltage of the battery

  /// Factor for the speed of rotor `i` (from 0) at `time` [s]; `voltage` is a fraction of the full
  /// battery's.
  [[nodiscard]] double factor(int i, double time, double voltage) const {
    if (with_battery) return voltage;
    if ((rotor > 0 && rotor != i + 1) || time < start) return 1.0;
    return time < end ? 1.0 + (ratio - 1.0) * (time - start) / (end - start) : ratio;
  }
};

/// Reads `0.9`, `battery` or `rotor=2,ratio=0.9,start=20,end=60`. Throws std::invalid_argument that
/// names what is wrong.
[[nodiscard]] inline RotorSpeedOption parse_rotor_speed(const std::string& text, int rotors) {
  RotorSpeedOption given;
  given.with_battery = text == "battery";
  if (given.with_battery) return given;
  double rotor = 0.0;
  const bool one_number = text.find('=') == std::string::npos;
  detail::read_fields(
      "--rotor-speed", one_number ? "ratio=" + text : text,
      {{"rotor", &rotor}, {"ratio", &given.ratio}, {"start", &given.start}, {"end", &given.end}});
  tilt_ropter::require(rotor >= 0.0 && rotor <= rotors && rotor == std::floor(rotor),
                       "--rotor-speed: rotor", rotor,
                       "a whole number from 0 (all) to " + std::to_string(rotors));
  tilt_ropter::require_in("--rotor-speed: ratio", given.ratio, 0.5, 1.2);
  tilt_ropter::require_in("--rotor-speed: start [s]", given.start, 0.0, 1e6);
  tilt_ropter::require_in("--rotor-speed: end [s]", given.end, 0.0, 1e6);
  given.rotor = static_cast<int>(rotor);
  return given;
}

/// Breaks an actuator of a plant by what it does to the rotors and to the commands.
template <int Rotors>
class FailingActuator {
 public:
  /// `truth` is the vehicle of the plant. Throws like parse_failure(); nothing fails if `option` is
  /// empty.
  FailingActuator(const std::string& option, const tilt_ropter::Vehicle<Rotors>& truth)
      : truth_(truth) {
    if (!option.empty()) failure_ = parse_failure(option, Rotors);
  }

  /// Call before each step of `plant`; returns what its actuators receive instead of `command`.
  template <typename Plant>
  [[nodiscard]] tilt_ropter::ActuatorState<Rotors> command(
      Plant& plant, tilt_ropter::ActuatorState<Rotors> command) {
    const double passed = failure_ ? plant.time() - failure_->start : -1.0;
    if (passed < 0.0) return command;
    const std::string& name = failure_->name;
    const auto row = static_cast<Eigen::Index>(failure_->rotor);
    double& angle = command.tilt_angle(row);
    const bool begins = std::isnan(began_at_);
    if (begins) began_at_ = plant.actuators().tilt_angle(row);
    const double to = std::isnan(failure_->angle) ? began_at_ : failure_->angle;
    if (name == "motor") {
      command.rotor_speed(row) = 0.0;
      tilt_ropter::RotorParameters stopped = rotor_parameters(truth_, failure_->rotor);
      stopped.min_thrust = 0.0;
      auto vehicle = truth_;
      vehicle.rotors[failure_->rotor].parameters = stopped;
      if (begins) plant.set_rotors(vehicle);
    } else if (name == "motor_silent") {  // the thrust falls with the square of the speed
      const double lag = rotor_parameters(truth_, failure_->rotor).time_constant;
      plant.set_rotors(with_weak_rotor(truth_, failure_->rotor, std::exp(-2.0 * passed / lag)));
    } else if (name == "blade") {
      if (begins)
        plant.set_rotors(with_weak_rotor(truth_, failure_->rotor, failure_->effectiveness));
    } else if (name == "servo") {
      angle = to;  // for a plant whose arms are bodies and cannot jump
      // The rotor no longer tilts from the angle at which it was.
      if (begins) plant.set_rotors(with_stuck_servo(truth_, failure_->rotor, to - began_at_));
    } else if constexpr (has_free_servos<Plant>::value) {
      plant.release_servo(failure_->rotor);
    } else {
      constexpr double sinks = 1.0;  // against the friction of its gear [rad/s]
      angle = began_at_ + std::clamp(to - began_at_, -sinks * passed, sinks * passed);
    }
    return command;
  }

 private:
  // True for a plant that moves an arm by its forces: it has release_servo().
  template <typename Plant, typename = void>
  struct has_free_servos : std::false_type {};
  template <typename Plant>
  struct has_free_servos<Plant, std::void_t<decltype(&Plant::release_servo)>> : std::true_type {};

  tilt_ropter::Vehicle<Rotors> truth_;
  std::optional<ActuatorFailureOption> failure_;
  double began_at_ = std::numeric_limits<double>::quiet_NaN();  // its angle at the failure [rad]
};

}  // namespace examples
