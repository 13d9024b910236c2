// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <Eigen/Core>

#include <nlohmann/json.hpp>

#include <array>
#include <cmath>
#include <cstddef>
#include <istream>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

/// Strict reading of JSON files: every field has a range, and unknown fields are errors. Messages
/// name the field, its value and the allowed values.
namespace tilt_ropter::json_fields {

using Json = nlohmann::ordered_json;

/// A wrong field. Readers add the name of the file.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Text of a value for messages: one line, at most 60 characters.
inline std::string shown(const Json& value) {
  constexpr std::size_t longest = 60;
  const std::string text = value.dump(-1, ' ', true, Json::error_handler_t::replace);
  return text.size() > longest ? text.substr(0, longest) + "..." : text;
}

inline std::string shown(double value) {
  std::ostringstream text;
  text << value;
  return text.str();
}

[[noreturn]] inline void refuse(const std::string& field, const std::string& value,
                                const std::string& allowed) {
  throw Error(field + " = " + value + ": must be " + allowed);
}

struct Range {
  double least, most;
  std::string unit;
  [[nodiscard]] bool has(double value) const { return value >= least && value <= most; }
  [[nodiscard]] std::string text() const {
    return "in [" + shown(least) + ", " + shown(most) + "]" + (unit.empty() ? "" : ' ' + unit);
  }
};

/// One JSON object whose fields are read by name. refuse_unknown() rejects all other fields,
/// because a misspelt name would otherwise be ignored without a message.
class Fields {
 public:
  Fields(const Json& object, std::string path) : object_(object), path_(std::move(path)) {
    if (!object.is_object()) refuse(path_.empty() ? "the file" : path_, shown(object), "an object");
  }

  [[nodiscard]] std::string name(const std::string& key) const {
    return path_.empty() ? key : path_ + '.' + key;
  }

  /// Returns the field, or nullptr if it does not exist.
  const Json* find(const std::string& key) {
    asked_.insert(key);
    const auto found = object_.find(key);
    return found == object_.end() ? nullptr : &*found;
  }

  const Json& get(const std::string& key, const std::string& allowed) {
    const Json* field = find(key);
    if (field == nullptr) throw Error(name(key) + " is missing: must be " + allowed);
    return *field;
  }

  double number(const std::string& key, const Range& range) {
    const std::string allowed = "a number " + range.text();
    return number(get(key, allowed), name(key), range, allowed);
  }

  /// Returns `usual` if the field does not exist.
  double number(const std::string& key, const Range& range, double usual) {
    return find(key) == nullptr ? usual : number(key, range);
  }

  int integer(const std::string& key, int least, int most) {
    const Range range{static_cast<double>(least), static_cast<double>(most), ""};
    const std::string allowed = "a whole number " + range.text();
    const Json& field = get(key, allowed);
    const double value = number(field, name(key), range, allowed);
    if (value > std::floor(value)) refuse(name(key), shown(field), allowed);
    return static_cast<int>(value);
  }

  bool truth(const std::string& key) {
    const std::string allowed = "true or false";
    const Json& field = get(key, allowed);
    if (!field.is_boolean()) refuse(name(key), shown(field), allowed);
    return field.get<bool>();
  }

  std::string text(const std::string& key, const std::vector<std::string>& choices = {}) {
    std::string allowed = choices.empty() ? "a text" : "one of";
    for (const std::string& choice : choices) allowed += " \"" + choice + '"';
    const Json& field = get(key, allowed);
    if (!field.is_string() || field.get<std::string>().empty())
      refuse(name(key), shown(field), allowed);
    auto value = field.get<std::string>();
    bool chosen = choices.empty();
    for (const std::string& choice : choices) chosen = chosen || value == choice;
    if (!chosen) refuse(name(key), shown(field), allowed);
    return value;
  }

  /// Two or three numbers.
  std::vector<double> two_or_three(const std::string& key, const Range& range) {
    const std::string allowed = "two or three numbers " + range.text();
    return two_or_three(get(key, allowed), name(key), range);
  }
  static std::vector<double> two_or_three(const Json& field, const std::string& name,
                                          const Range& range) {
    const std::string allowed = "two or three numbers " + range.text();
    if (!field.is_array() || field.size() < 2 || field.size() > 3)
      refuse(name, shown(field), allowed);
    std::vector<double> values;
    for (std::size_t i = 0; i < field.size(); ++i)
      values.push_back(number(field[i], name + '[' + std::to_string(i) + ']', range, allowed));
    return values;
  }

  Eigen::Vector3d vector(const std::string& key, const Range& range) {
    const std::string allowed = "three numbers " + range.text();
    return vector(get(key, allowed), name(key), range, allowed);
  }

  /// Does not change `value` if the field does not exist.
  void vector_if_there(const std::string& key, const Range& range, Eigen::Vector3d& value) {
    if (find(key) != nullptr) value = vector(key, range);
  }

  Eigen::Matrix3d inertia(const std::string& key, const Range& range) {
    const std::string allowed = "three moments or three rows of three numbers " + range.text();
    const Json& field = get(key, allowed);
    const bool rows = field.is_array() && field.size() == 3 && field[0].is_array();
    if (!rows) return vector(field, name(key), range, allowed).asDiagonal();
    Eigen::Matrix3d value;
    for (std::size_t i = 0; i < 3; ++i)
      value.row(static_cast<Eigen::Index>(i)) =
          vector(field[i], name(key) + '[' + std::to_string(i) + ']', range, allowed).transpose();
    return value;
  }

  void refuse_unknown() const {
    for (const auto& [key, value] : object_.items()) {
      if (asked_.count(key) != 0) continue;
      std::string known;
      for (const std::string& other : asked_) known += (known.empty() ? "" : ", ") + other;
      throw Error(name(key) + " = " + shown(value) + ": there is no such field; known fields are " +
                  known);
    }
  }

 private:
  static double number(const Json& field, const std::string& name, const Range& range,
                       const std::string& allowed) {
    if (!field.is_number() || !range.has(field.get<double>())) refuse(name, shown(field), allowed);
    return field.get<double>();
  }

  static Eigen::Vector3d vector(const Json& field, const std::string& name, const Range& range,
                                const std::string& allowed) {
    if (!field.is_array() || field.size() != 3) refuse(name, shown(field), allowed);
    Eigen::Vector3d value;
    for (std::size_t i = 0; i < 3; ++i)
      value(static_cast<Eigen::Index>(i)) =
          number(field[i], name + '[' + std::to_string(i) + ']', range, allowed);
    return value;
  }

  const Json& object_;
  std::string path_;
  std::set<std::string> asked_;
};

/// Parses JSON. Rejects repeated names in an object: nlohmann::json would silently use the last
/// value.
[[nodiscard]] inline Json parse(std::istream& in) {
  std::vector<std::set<std::string>> names;
  std::string twice;
  const auto watch = [&](int, Json::parse_event_t event, Json& value) {
    if (event == Json::parse_event_t::object_start) names.emplace_back();
    if (event == Json::parse_event_t::object_end) names.pop_back();
    if (event == Json::parse_event_t::key && !names.back().insert(value.get<std::string>()).second)
      twice = value.get<std::string>();
    return true;
  };
  Json root = Json::parse(in, watch);
  if (!twice.empty()) throw Error(twice + " is there twice: must be there once");
  return root;
}

/// Rounds to 12 digits, to write 0.1 instead of 0.10000000000000001.
[[nodiscard]] inline double rounded(double value) {
  std::ostringstream text;
  text.precision(12);
  text << value;
  return std::stod(text.str());
}

[[nodiscard]] inline std::array<double, 3> list_of(const Eigen::Vector3d& v) {
  return {rounded(v.x()), rounded(v.y()), rounded(v.z())};
}

/// Returns the message of the library without its error number.
[[nodiscard]] inline std::string message_of(const Json::exception& error) {
  const std::string text = error.what();
  return text.substr(text.find("] ") + 2);
}

/// Returns JSON text with each list of numbers on one line.
[[nodiscard]] inline std::string text_of(const Json& root) {
  const std::string spread = root.dump(2);
  std::string text;
  for (std::size_t i = 0; i < spread.size(); ++i) {
    text += spread[i];
    const std::size_t end = spread.find_first_of("[]{", i + 1);
    if (spread[i] != '[' || end == std::string::npos || spread[end] != ']') continue;
    for (++i; i < end; ++i)
      if (spread[i] != '\n' && spread[i] != ' ')
        text += spread[i] == ',' ? ", " : spread.substr(i, 1);
    text += ']';
  }
  return text;
}

}  // namespace tilt_ropter::json_fields
