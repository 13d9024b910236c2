#pragma once

#include "yaml_parameters.hpp"

#include <cstddef>
#include <initializer_list>
#include <map>
#include <optional>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace loops {

/// What a program received in the form of ROS 2: `--ros-args -p NAME:=VALUE -r TOPIC:=OTHER_TOPIC
/// -r __node:=NAME -r __ns:=/NAMESPACE --params-file FILE --log-level LEVEL`. Names of topics are
/// relative to the namespace unless they begin with "/".
class Parameters {
 public:
  Parameters() = default;
  /// For tests: parameters without a command line.
  Parameters(std::initializer_list<std::pair<const std::string, std::string>> values)
      : values_(values) {}

  /// Takes the part between --ros-args and -- (or the end) out of `arguments`. `node` is the name
  /// of the node unless __node renames it. Later assignments replace earlier ones. Throws
  /// std::invalid_argument if ROS 2 has such an option but these programs do not, and as
  /// yaml_parameters().
  static Parameters from(std::vector<std::string>& arguments, const std::string& node = "node") {
    Parameters result;
    result.node_ = node;
    std::vector<std::string> rest;
    std::vector<Assignment> parameters, remaps;
    bool inside = false;
    for (std::size_t i = 0; i < arguments.size(); ++i) {
      const std::string& word = arguments[i];
      if (!inside || word == "--") {
        if (word != "--ros-args" && !inside) rest.push_back(word);
        inside = word == "--ros-args";
        continue;
      }
      if (word == "--ros-args") continue;  // as launch files repeat it
      const std::string value = i + 1 < arguments.size() ? arguments[++i] : "";
      if (word == "-p" || word == "--param")
        parameters.push_back(assignment(word, value));
      else if (word == "-r" || word == "--remap")
        remaps.push_back(assignment(word, value));
      else if (word == "--params-file")
        parameters.push_back({"", value, true});
      else if (word == "--log-level")
        check_level(value);
      else
        throw std::invalid_argument(
            word + " after --ros-args: allowed are -p, -r, --params-file and --log-level");
    }
    for (const Assignment& a : remaps)
      if (a.name == "__node" || a.name == "__name")
        result.node_ = a.value;
      else if (a.name == "__ns")
        result.set_name_space(a.value);
    for (const Assignment& a : remaps)
      if (a.name.rfind("__", 0) != 0)
        if (const auto name = result.for_this_node(a.name))
          result.topics_[result.expanded(*name)] = result.expanded(a.value);
    for (const Assignment& a : parameters)
      if (a.is_file)
        for (const auto& [name, value] : yaml_parameters(a.value, result.full_name()))
          result.values_[name] = value;
      else if (const auto name = result.for_this_node(a.name))
        result.values_[*name] = a.value;
    arguments = std::move(rest);
    return result;
  }

  /// Returns the parameter `name`, or `otherwise` if it is not set.
  [[nodiscard]] std::string text(const std::string& name, const std::string& otherwise = "") {
    known_.insert(name);
    const auto found = values_.find(name);
    return found == values_.end() ? otherwise : found->second;
  }
  /// The same for a number in [least, most]. Throws std::invalid_argument if it is none.
  [[nodiscard]] double number(const std::string& name, double otherwise, double least,
                              double most) {
    const std::string value = text(name);
    if (value.empty()) return otherwise;
    std::istringstream in(value);
    double result = 0.0;
    if (!(in >> result) || !in.eof() || !(result >= least && result <= most)) {
      std::ostringstream range;
      range << name << " = " << value << ": must be a number from " << least << " to " << most;
      throw std::invalid_argument(range.str());
    }
    return result;
  }
  /// The same for numbers with commas; none if it is not set.
  [[nodiscard]] std::vector<double> numbers(const std::string& name) {
    std::vector<double> result;
    const std::string value = text(name);
    std::istringstream parts(value);
    for (std::string part; std::getline(parts, part, ',');) {
      std::istringstream in(part);
      if (!(in >> result.emplace_back()) || !(in >> std::ws).eof())
        throw std::invalid_argument(name + " = " + value + ": must be numbers, with commas");
    }
    return result;
  }
  /// The same for true or false, also as Python writes them. Throws std::invalid_argument if it is
  /// neither.
  [[nodiscard]] bool choice(const std::string& name, bool otherwise) {
    const std::string value = text(name, otherwise ? "true" : "false");
    if (value == "true" || value == "True" || value == "TRUE") return true;
    if (value == "false" || value == "False" || value == "FALSE") return false;
    throw std::invalid_argument(name + " = " + value + ": must be true or false");
  }
  /// Returns the full name of the topic that is used as `topic`.
  [[nodiscard]] std::string topic(const std::string& topic) {
    const std::string name = expanded(topic);
    known_topics_.insert(name);
    const auto found = topics_.find(name);
    return found == topics_.end() ? name : found->second;
  }
  /// Returns "NAMESPACE/", without a slash in front, or nothing for a node in no namespace.
  [[nodiscard]] std::string prefix() const {
    return name_space_.empty() ? "" : name_space_.substr(1) + "/";
  }
  /// Returns "/NAMESPACE/NODE".
  [[nodiscard]] std::string full_name() const { return name_space_ + "/" + node_; }
  [[nodiscard]] const std::string& node() const { return node_; }
  /// Returns "/NAMESPACE", or "/" for a node in no namespace.
  [[nodiscard]] std::string name_space() const { return name_space_.empty() ? "/" : name_space_; }

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
  struct Assignment {
    std::string name, value;
    bool is_file = false;
  };

  static Assignment assignment(const std::string& word, const std::string& text) {
    const std::size_t middle = text.find(":=");
    if (middle == std::string::npos || middle == 0)
      throw std::invalid_argument(word + " " + text + ": must be NAME:=VALUE");
    return {text.substr(0, middle), text.substr(middle + 2)};
  }

  // These programs write only what an operator must read, at every level.
  static void check_level(const std::string& text) {
    const std::size_t middle = text.find(":=");  // LOGGER:=LEVEL
    std::string level = middle == std::string::npos ? text : text.substr(middle + 2);
    for (char& c : level)
      if (c >= 'A' && c <= 'Z') c = static_cast<char>(c - 'A' + 'a');
    for (const char* known : {"debug", "info", "warn", "error", "fatal", "unset"})
      if (level == known) return;
    throw std::invalid_argument("--log-level " + text +
                                ": must be debug, info, warn, error, fatal or unset");
  }

  void set_name_space(const std::string& name) {
    name_space_ = name == "/" ? "" : name;
    if (name.empty() || name[0] != '/' || (name.size() > 1 && name.back() == '/'))
      throw std::invalid_argument("__ns = " + name + ": must begin, and must not end, with \"/\"");
  }

  // "NODE:NAME" is for the node of that name only.
  [[nodiscard]] std::optional<std::string> for_this_node(const std::string& name) const {
    const std::size_t colon = name.find(':');
    if (colon == std::string::npos) return name;
    if (name.substr(0, colon) != node_) return std::nullopt;
    return name.substr(colon + 1);
  }

  [[nodiscard]] std::string expanded(const std::string& topic) const {
    if (topic.rfind('/', 0) == 0) return topic;
    if (topic.rfind("~/", 0) == 0) return full_name() + topic.substr(1);
    return name_space_ + "/" + topic;
  }

  static std::string list(const std::set<std::string>& names) {
    std::string result;
    for (const std::string& name : names) result += (result.empty() ? "" : ", ") + name;
    return result;
  }

  std::string node_ = "node", name_space_;  // "" or "/a/b"
  std::map<std::string, std::string> values_, topics_;
  std::set<std::string> known_, known_topics_;
};

}  // namespace loops
