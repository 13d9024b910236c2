#pragma once

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cstddef>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

namespace loops {

namespace detail {

/// Whether the parameters under `pattern` are for the node "/NAMESPACE/NAME": its full name, its
/// name if it is in no namespace, with * for one and ** for any part.
inline bool is_for(const std::string& pattern, const std::string& node) {
  const auto parts = [](const std::string& name) {
    std::vector<std::string> result;
    for (std::size_t begin = name.rfind('/', 0) == 0 ? 1 : 0; begin <= name.size();) {
      const std::size_t end = std::min(name.find('/', begin), name.size());
      result.push_back(name.substr(begin, end - begin));
      begin = end + 1;
    }
    return result;
  };
  const std::vector<std::string> wanted = parts(pattern), given = parts(node);
  // reached[j]: the parts of the pattern so far match the first j parts of the name.
  std::vector<char> reached(given.size() + 1, 0);
  reached[0] = 1;
  for (const std::string& part : wanted) {
    std::vector<char> next(reached.size(), 0);
    for (std::size_t j = 0; j < reached.size(); ++j)
      if (part == "**")
        next[j] = static_cast<char>(reached[j] != 0 || (j > 0 && next[j - 1] != 0));
      else if (j > 0 && reached[j - 1] != 0 && (part == "*" || part == given[j - 1]))
        next[j] = 1;
    reached = next;
  }
  return reached.back() != 0;
}

/// Adds the parameters of `values` to `to`, with `name` and a dot before their names. Throws
/// YAML::Exception with the place of what is no parameter.
inline void add_parameters(const YAML::Node& values, const std::string& name,
                           std::map<std::string, std::string>& to) {
  std::string list;
  switch (values.Type()) {
    case YAML::NodeType::Map:
      for (const auto& entry : values)
        add_parameters(entry.second,
                       (name.empty() ? "" : name + ".") + entry.first.as<std::string>(), to);
      return;
    case YAML::NodeType::Sequence:
      for (std::size_t i = 0; i < values.size(); ++i)
        list += (i == 0 ? "" : ",") + values[i].as<std::string>();
      to[name] = list;
      return;
    case YAML::NodeType::Scalar:
      to[name] = values.Scalar();
      return;
    default:
      throw YAML::Exception(values.Mark(), "must be a number, a text or a list of these");
  }
}

/// Looks for ros__parameters under `where`, and adds those for `node`.
inline void find_parameters(const YAML::Node& tree, const std::string& where,
                            const std::string& node, std::map<std::string, std::string>& to) {
  if (!tree.IsMap())
    throw YAML::Exception(tree.Mark(), "a value must be below NODE: and ros__parameters:");
  for (const auto& entry : tree) {
    const auto name = entry.first.as<std::string>();
    if (name != "ros__parameters")
      find_parameters(entry.second,
                      where + (where.empty() || name.rfind('/', 0) == 0 ? "" : "/") + name, node,
                      to);
    else if (is_for(where, node))
      add_parameters(entry.second, "", to);
  }
}

}  // namespace detail

/// Returns the parameters for `node` ("/NAMESPACE/NAME") from the YAML file of ROS 2 at `path`:
/// what is under NODE: ros__parameters:, where NODE may have wildcards and nested namespaces.
/// Nested parameters have dots in their names; a list has commas between its elements. Throws
/// std::invalid_argument with path and line.
inline std::map<std::string, std::string> yaml_parameters(const std::string& path,
                                                          const std::string& node) {
  std::map<std::string, std::string> result;
  try {
    detail::find_parameters(YAML::LoadFile(path), "", node, result);
  } catch (const YAML::BadFile&) {
    throw std::invalid_argument("--params-file " + path + ": cannot be read");
  } catch (const YAML::Exception& error) {
    throw std::invalid_argument(
        path + ", line " + std::to_string(std::max(error.mark.line, 0) + 1) + ": " + error.msg);
  }
  return result;
}

}  // namespace loops
