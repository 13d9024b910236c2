#pragma once

#include <cstddef>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace loops {

/// The parameters and topic names that a program received in the form of ROS 2:
/// `--ros-args -p NAME:=VALUE -r TOPIC:=OTHER_TOPIC`.
class Parameters {
 public:
  Parameters() = default;
  /// For tests: parameters without a command line.
  Parameters(std::initializer_list<std::pair<const std::string, std::string>> values)
      : values_(values) {}

  /// Takes the part between --ros-args and -- (or the end) out of `arguments`. Throws
  /// std::invalid_argument if ROS 2 has such an option but these programs do not.
  static Parameters from(std::vector<std::string>& arguments) {
    Parameters result;
    std::vector<std::string> rest;
    bool inside = false;
    for (std::size_t i = 0; i < arguments.size(); ++i) {
      const std::string& word = arguments[i];
      if (!inside || word == "--") {
        if (word != "--ros-args" && !inside) rest.push_back(word);
        inside = word == "--ros-args";
        continue;
      }
      const bool parameter = word == "-p" || word == "--param";
      if (!parameter && word != "-r" && word != "--remap")
        throw std::invalid_argument(word + " after --ros-args: allowed are -p and -r");
      const std::string assignment = i + 1 < arguments.size() ? arguments[++i] : "";
      const std::size_t middle = assignment.find(":=");
      if (middle == std::string::npos || middle == 0)
        throw std::invalid_argument(word + " " + assignment + ": must be NAME:=VALUE");
      (parameter ? result.values_ : result.topics_)[assignment.substr(0, middle)] =
          assignment.substr(middle + 2);
    }
    arguments = std::move(rest);
    return result;
  }

  /// Returns the parameter `name`, or `otherwise` if it is not set.
  [[nodiscard]] std::string text(const std::string& name, const std::string& otherwise = "") {
    known_.insert(name);
    const auto found = values_.find(name);
    return found == values_.end() ? otherwise : found->second;
  }
  /// The same for a number. Throws std::invalid_argument if it is none.
  [[nodiscard]] double number(const std::string& name, double otherwise) {
    const std::string value = text(name);
    if (value.empty()) return otherwise;
    std::istringstream in(value);
    double result = 0.0;
    if (!(in >> result) || !in.eof())
      throw std::invalid_argument(name + " = " + value + ": must be a number");
    return result;
  }
  /// The same for true or false. Throws std::invalid_argument if it is neither.
  [[nodiscard]] bool choice(const std::string& name, bool otherwise) {
    const std::string value = text(name, otherwise ? "true" : "false");
    if (value != "true" && value != "false")
      throw std::invalid_argument(name + " = " + value + ": must be true or false");
    return value == "true";
  }
  /// Returns the topic that is used instead of `topic`.
  [[nodiscard]] std::string topic(const std::string& topic) {
    known_topics_.insert(topic);
    const auto found = topics_.find(topic);
    return found == topics_.end() ? topic : found->second;
  }

  /// Call this after everything was read. Throws std::invalid_argument for a parameter or topic
  /// that nobody asked for.
  void refuse_unknown() const {
    for (const auto& [name, value] : values_)
      if (known_.count(name) == 0)
        throw std::invalid_argument(name + ": no such parameter, there are " + list(known_));
    for (const auto& [name, value] : topics_)
      if (known_topics_.count(name) == 0)
        throw std::invalid_argument(name + ": no such topic, there are " + list(known_topics_));
  }

 private:
  static std::string list(const std::set<std::string>& names) {
    std::string result;
    for (const std::string& name : names) result += (result.empty() ? "" : ", ") + name;
    return result;
  }

  std::map<std::string, std::string> values_, topics_;
  std::set<std::string> known_, known_topics_;
};

}  // namespace loops
