#pragma once

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstddef>
#include <fstream>
#include <istream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <system_error>
#include <utility>
#include <vector>

/// Logs of numbers as CSV: a header line that names the columns, then one row per line, separated
/// by commas. Numbers have the format of std::from_chars; a `+` before them is allowed. Blanks
/// around a field are ignored. There is no quoting. Blank lines and lines that start with `#` are
/// skipped. Lines may end in CR LF; the last line need not end.
namespace examples {

enum class CsvNumbers { finite, any };  ///< any: `nan` and `inf` are accepted too

/// The columns that were read: one vector for each column, all of the same length.
struct CsvTable {
  std::string file;                          ///< name of the file in messages
  std::vector<std::string> names;            ///< names of the columns
  std::vector<std::vector<double>> columns;  ///< values, in the order of `names`
  std::vector<std::size_t> lines;            ///< line number in the file of each row, from 1

  [[nodiscard]] std::size_t rows() const { return lines.size(); }
  [[nodiscard]] bool has(const std::string& name) const {
    return std::find(names.begin(), names.end(), name) != names.end();
  }
  /// Returns this column. Throws std::runtime_error if there is no such column.
  [[nodiscard]] const std::vector<double>& operator[](const std::string& name) const {
    const auto found = std::find(names.begin(), names.end(), name);
    if (found == names.end()) throw std::runtime_error(file + ": no column " + name);
    return columns[static_cast<std::size_t>(found - names.begin())];
  }
};

namespace detail {

inline std::string_view without_blanks(std::string_view text) {
  constexpr std::string_view blanks = " \t";
  const std::size_t first = std::min(text.find_first_not_of(blanks), text.size());
  text.remove_prefix(first);
  return text.substr(0, text.find_last_not_of(blanks) + 1);
}

inline std::vector<std::string_view> csv_fields(std::string_view line) {
  std::vector<std::string_view> fields;
  for (std::size_t start = 0; start <= line.size();) {
    const std::size_t end = std::min(line.find(',', start), line.size());
    fields.push_back(without_blanks(line.substr(start, end - start)));
    start = end + 1;
  }
  return fields;
}

/// Reads a complete field into `value`. Returns the error, or an empty text.
inline std::string csv_number(std::string_view text, CsvNumbers allowed, double& value) {
  const bool plus = text.size() > 1 && text[0] == '+' && text[1] != '-';
  const std::string_view number = plus ? text.substr(1) : text;
  const auto [end, code] = std::from_chars(number.data(), number.data() + number.size(), value);
  if (code == std::errc::result_out_of_range) return "is out of the range of a double";
  if (code != std::errc() || end != number.data() + number.size()) return "is not a number";
  return std::isfinite(value) || allowed == CsvNumbers::any ? "" : "is not finite";
}

inline bool is_control(char c) {
  return static_cast<unsigned char>(c) < 0x20 || c == 0x7f;
}

/// For messages on a terminal: short and without control characters.
inline std::string csv_quoted(std::string_view text, char mark = '\'') {
  constexpr std::size_t longest = 40;
  std::string shown(text.substr(0, longest));
  std::replace_if(shown.begin(), shown.end(), is_control, '?');
  return mark + shown + (text.size() > longest ? "..." : "") + mark;
}

}  // namespace detail

/// Reads the columns `wanted` in this order, then the available columns of `optional`, and ignores
/// all others. An empty `wanted` means all columns. Throws std::runtime_error with `file`, line,
/// name and number of the column (both from 1) and the error: "log.csv:7: column angle_rad (3): 'x'
/// is not a number".
[[nodiscard]] inline CsvTable read_csv(std::istream& in, const std::string& file,
                                       const std::vector<std::string>& wanted = {},
                                       CsvNumbers allowed = CsvNumbers::finite,
                                       const std::vector<std::string>& optional = {}) {
  CsvTable table{file, wanted, {}, {}};
  std::vector<std::size_t> numbers;  // column numbers in the file, from 0
  std::size_t width = 0, line_number = 0;
  const auto wrong = [&](const std::string& what) {
    throw std::runtime_error(file + ':' + std::to_string(std::max<std::size_t>(line_number, 1)) +
                             ": " + what);
  };
  const auto read_header = [&](const std::vector<std::string_view>& header) {
    width = header.size();
    if (wanted.empty()) table.names.assign(header.begin(), header.end());
    for (const std::string& name : optional)
      if (std::find(header.begin(), header.end(), name) != header.end())
        table.names.push_back(name);
    for (const std::string& name : table.names) {
      const auto found = std::find(header.begin(), header.end(), name);
      const std::size_t number = static_cast<std::size_t>(found - header.begin());
      if (found == header.end()) {
        std::string message = "no column " + name + ", the header line has";
        for (const std::string_view& other : header)
          (message += &other == &header.front() ? " " : ", ") += detail::csv_quoted(other);
        wrong(message);
      }
      if (name.empty()) wrong("column (" + std::to_string(number + 1) + ") has no name");
      if (std::find(found + 1, header.end(), name) != header.end())
        wrong("column " + name + " is there twice");
      numbers.push_back(number);
    }
    table.columns.resize(numbers.size());
  };

  for (std::string text; std::getline(in, text);) {
    std::string_view line = text;
    constexpr std::string_view byte_order_mark = "\xEF\xBB\xBF";
    if (++line_number == 1 && line.substr(0, byte_order_mark.size()) == byte_order_mark)
      line.remove_prefix(byte_order_mark.size());
    if (!line.empty() && line.back() == '\r') line.remove_suffix(1);
    line = detail::without_blanks(line);
    if (line.empty() || line.front() == '#') continue;
    const std::vector<std::string_view> fields = detail::csv_fields(line);
    if (width == 0) {
      read_header(fields);
      continue;
    }
    if (fields.size() != width)
      wrong(std::to_string(fields.size()) + " fields, the header line has " +
            std::to_string(width));
    for (std::size_t i = 0; i < numbers.size(); ++i) {
      const std::string_view field = fields[numbers[i]];
      double value = 0.0;
      const std::string problem = detail::csv_number(field, allowed, value);
      if (!problem.empty())
        wrong("column " + table.names[i] + " (" + std::to_string(numbers[i] + 1) +
              "): " + detail::csv_quoted(field) + ' ' + problem);
      table.columns[i].push_back(value);
    }
    table.lines.push_back(line_number);
  }
  if (in.bad()) throw std::runtime_error("cannot read " + file);
  if (width == 0) wrong("no header line");
  return table;
}

/// The same for the file at `path`. Throws std::runtime_error if it cannot be read.
[[nodiscard]] inline CsvTable read_csv(const std::string& path,
                                       const std::vector<std::string>& wanted = {},
                                       CsvNumbers allowed = CsvNumbers::finite,
                                       const std::vector<std::string>& optional = {}) {
  std::ifstream in(path);
  if (!in) throw std::runtime_error("cannot read " + path);
  return read_csv(in, path, wanted, allowed, optional);
}

}  // namespace examples
