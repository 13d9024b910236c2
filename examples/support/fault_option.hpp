#pragma once

#include <tilt_ropter/simulation/sensor_faults.hpp>

#include <sstream>
#include <stdexcept>
#include <string>

namespace examples {

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
  std::istringstream fields(colon == std::string::npos ? "" : text.substr(colon + 1));
  for (std::string field; std::getline(fields, field, ',');) {
    const std::size_t equals = field.find('=');
    const std::string key = field.substr(0, equals);
    double* value = key == "start"       ? &fault.start
                    : key == "duration"  ? &fault.duration
                    : key == "size"      ? &fault.size
                    : key == "frequency" ? &fault.frequency
                                         : nullptr;
    if (value == nullptr)
      throw std::invalid_argument("--fault " + name + ": unknown field " + key +
                                  ", must be start, duration, size or frequency");
    std::size_t used = 0;
    const std::string number = equals == std::string::npos ? "" : field.substr(equals + 1);
    try {
      *value = std::stod(number, &used);
    } catch (const std::exception&) {
      used = 0;
    }
    if (used == 0 || used != number.size())
      throw std::invalid_argument("--fault " + name + ": " + key + " = " + number +
                                  ": must be a number");
  }
  validate(fault);
  return fault;
}

}  // namespace examples
