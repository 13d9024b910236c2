#pragma once

#include <algorithm>
#include <cstddef>
#include <fstream>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

namespace loops {

namespace detail {

/// One line of a file of parameters: "KEY:", "KEY: VALUE" or "- VALUE".
struct YamlLine {
  std::size_t indent = 0;
  bool is_element = false, has_value = false;
  std::string key, value;
};

/// Returns `text` without blanks at its ends.
inline std::string trimmed(const std::string& text) {
  const std::size_t begin = text.find_first_not_of(" \t\r"), end = text.find_last_not_of(" \t\r");
  return begin == std::string::npos ? "" : text.substr(begin, end - begin + 1);
}

/// Returns `text` without the comment at its end.
inline std::string without_comment(const std::string& text) {
  char quote = '\0';
  for (std::size_t i = 0; i < text.size(); ++i) {
    if (quote != '\0') {
      if (text[i] == quote) quote = '\0';
    } else if (text[i] == '"' || text[i] == '\'') {
      quote = text[i];
    } else if (text[i] == '#' && (i == 0 || text[i - 1] == ' ' || text[i - 1] == '\t')) {
      return text.substr(0, i);
    }
  }
  return text;
}

/// Returns a scalar without its quotes. Throws std::invalid_argument for what is none.
inline std::string yaml_scalar(const std::string& text) {
  const char first = text.empty() ? ' ' : text.front();
  if (first == '"' || first == '\'') {
    const std::string inner = text.size() > 1 ? text.substr(1, text.size() - 2) : "";
    if (text.size() < 2 || text.back() != first || inner.find(first) != std::string::npos ||
        inner.find('\\') != std::string::npos)
      throw std::invalid_argument("text in quotes without quotes or \\ inside is allowed");
    return inner;
  }
  if (std::string("&*!|>%@`{}[]?,").find(first) != std::string::npos ||
      text.find(": ") != std::string::npos || (!text.empty() && text.back() == ':'))
    throw std::invalid_argument("a value must be a number, a text or a list of these");
  return text;
}

/// Returns the elements of "[A, B]" with commas between, or a scalar.
inline std::string yaml_value(const std::string& text) {
  if (text.empty() || text.front() != '[') return yaml_scalar(text);
  if (text.back() != ']') throw std::invalid_argument("a list must end in its line");
  std::string result;
  for (std::size_t begin = 1; begin < text.size();) {
    const std::size_t end = text.find_first_of(",]", begin);
    result += (begin == 1 ? "" : ",") + yaml_scalar(trimmed(text.substr(begin, end - begin)));
    begin = end + 1;
  }
  return result;
}

/// Throws std::invalid_argument.
inline YamlLine yaml_line(const std::string& text) {
  YamlLine line;
  line.indent = text.find_first_not_of(' ');
  std::string rest = trimmed(text);
  if (text[line.indent] == '\t') throw std::invalid_argument("tabs must not indent");
  if (rest == "-" || rest.rfind("- ", 0) == 0) {
    line.is_element = line.has_value = true;
    line.value = yaml_scalar(trimmed(rest.substr(1)));
    return line;
  }
  const std::size_t colon =
      rest.find(':', rest[0] == '"' || rest[0] == '\'' ? rest.find(rest[0], 1) : 0);
  if (colon == std::string::npos || colon == 0 ||
      (colon + 1 < rest.size() && rest[colon + 1] != ' '))
    throw std::invalid_argument("must be KEY: VALUE, KEY: or - VALUE");
  line.key = yaml_scalar(trimmed(rest.substr(0, colon)));
  const std::string value = trimmed(rest.substr(colon + 1));
  line.has_value = !value.empty();
  if (line.has_value) line.value = yaml_value(value);
  return line;
}

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

}  // namespace detail

/// Returns the parameters for `node` ("/NAMESPACE/NAME") from the YAML file of ROS 2 at `path`:
/// what is under NODE: ros__parameters:, where NODE may have wildcards and nested namespaces.
/// Nested parameters have dots in their names; a list has commas between its elements. A small part
/// of YAML: one key or element a line, no anchors, no texts over several lines. Throws
/// std::invalid_argument with path and line for everything else.
inline std::map<std::string, std::string> yaml_parameters(const std::string& path,
                                                          const std::string& node) {
  std::ifstream file(path);
  if (!file) throw std::invalid_argument("--params-file " + path + ": cannot be read");
  struct Level {
    std::size_t indent;
    std::string key;
  };
  std::map<std::string, std::string> result;
  std::vector<Level> open;  // the keys around the line
  std::string text, list;   // list: the parameter whose elements follow
  for (int number = 1; std::getline(file, text); ++number) try {
      text = detail::without_comment(text);
      if (detail::trimmed(text).empty() || text.rfind("---", 0) == 0) continue;
      const detail::YamlLine line = detail::yaml_line(text);
      // The elements of a list may stand below their key or deeper.
      while (!open.empty() && (line.is_element ? open.back().indent > line.indent
                                               : open.back().indent >= line.indent))
        open.pop_back();
      std::string where, name;
      bool inside = false;
      const auto enter = [&](const std::string& key) {
        if (!inside && key == "ros__parameters")
          inside = true;
        else if (inside)
          name += (name.empty() ? "" : ".") + key;
        else
          where += (where.empty() || key.rfind('/', 0) == 0 ? "" : "/") + key;
      };
      for (const Level& level : open) enter(level.key);
      if (!line.is_element) {
        enter(line.key);
        open.push_back({line.indent, line.key});
        if (!line.has_value) continue;
      }
      if (!inside || name.empty())
        throw std::invalid_argument("a value must be below NODE: and ros__parameters:");
      if (!detail::is_for(where, node)) continue;
      if (!line.is_element)
        result[name] = line.value;
      else if (list == name)
        result[name] += "," + line.value;
      else
        result[name] = line.value;
      list = line.is_element ? name : "";
    } catch (const std::invalid_argument& error) {
      throw std::invalid_argument(path + ", line " + std::to_string(number) + ": " + error.what());
    }
  return result;
}

}  // namespace loops
