#pragma once

#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <cmath>
#include <cstddef>
#include <sstream>
#include <stdexcept>
#include <string>
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

/// An actuator that fails in flight.
struct ActuatorFailureOption {
  tilt_ropter::ActuatorFailure failure;
  double start = 20.0;  ///< [s]
};

/// Reads `servo:rotor=2,angle=90,start=20` (it sticks at this angle [deg]) or
/// `rotor:rotor=1,effectiveness=0,start=20`. Rotors are counted from 1 to `rotors`. Throws
/// std::invalid_argument that names what is wrong.
[[nodiscard]] inline ActuatorFailureOption parse_failure(const std::string& text, int rotors) {
  using tilt_ropter::FailureKind;
  const std::size_t colon = text.find(':');
  const std::string name = text.substr(0, colon), option = "--failure " + name;
  ActuatorFailureOption given;
  given.failure.effectiveness = 0.0;
  double rotor = 1.0, degrees = 0.0;
  std::vector<NamedNumber> fields = {{"rotor", &rotor}, {"start", &given.start}};
  if (name == "servo") {
    given.failure.kind = FailureKind::servo;
    fields.push_back({"angle", &degrees});
  } else if (name == "rotor") {
    given.failure.kind = FailureKind::rotor;
    fields.push_back({"effectiveness", &given.failure.effectiveness});
  } else {
    throw std::invalid_argument(option + ": must be servo or rotor");
  }
  detail::read_fields(option, colon == std::string::npos ? "" : text.substr(colon + 1), fields);
  tilt_ropter::require(rotor >= 1.0 && rotor <= rotors && rotor == std::floor(rotor),
                       option + ": rotor", rotor,
                       "a whole number from 1 to " + std::to_string(rotors));
  tilt_ropter::require_in(option + ": angle [deg]", degrees, -180.0, 180.0);
  tilt_ropter::require_in(option + ": effectiveness", given.failure.effectiveness, 0.0, 1.0);
  tilt_ropter::require_in(option + ": start [s]", given.start, 0.0, 1e6);
  given.failure.rotor = static_cast<std::size_t>(rotor) - 1;
  given.failure.angle = degrees * tilt_ropter::pi / 180.0;
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

}  // namespace examples
