#pragma once

#include "../../cmake/vehicle_file/tilt_ropter/input_file_error.hpp"
#include "csv.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstddef>
#include <fstream>
#include <limits>
#include <map>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

/// Tables of numbers as other programs write them: EuRoC, TUM, rostopic, spreadsheets.
namespace examples {

/// A table of recorded samples. Values are NaN where the field is empty or says that there is no
/// number, and where it is a text.
struct RecordedTable {
  std::string file;
  std::vector<std::string> names;  ///< empty if the file has no header
  std::vector<std::vector<double>> columns;
  std::vector<std::size_t> lines;  ///< line number in the file of each row, from 1
  std::size_t header_line = 1;
  std::vector<std::string> notes;  ///< what was done that the file does not say
  bool by_blanks = false;          ///< fields are separated by blanks
  std::map<std::pair<std::size_t, std::size_t>, std::string> wrong;  ///< row, column: the error

  [[nodiscard]] std::size_t rows() const { return lines.size(); }
  [[nodiscard]] std::string at_row(std::size_t row) const {
    return file + ':' + std::to_string(lines[row]) + ": ";
  }
  /// "column pz (4)", both as in the file.
  [[nodiscard]] std::string column_name(std::size_t column) const {
    const std::string number = '(' + std::to_string(column + 1) + ')';
    return names.empty() ? "column " + number : "column " + names[column] + ' ' + number;
  }
};

namespace detail {

inline bool is_no_number(std::string text) {
  std::transform(text.begin(), text.end(), text.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return text.empty() || text == "nan" || text == "-nan" || text == "na" || text == "n/a" ||
         text == "null" || text == "none" || text == "-" || text == "#n/a";
}

/// Splits a line at `separator`, ' ' for blanks. Removes quotation marks around a field.
inline std::vector<std::string> recorded_fields(std::string_view line, char separator) {
  std::vector<std::string> fields(1);
  bool quoted = false;
  for (const char c : line) {
    if (c == '"')
      quoted = !quoted;
    else if (quoted || (separator == ' ' ? c != ' ' && c != '\t' : c != separator))
      fields.back() += c;
    else if (separator != ' ' || !fields.back().empty())
      fields.emplace_back();
  }
  if (separator == ' ' && fields.back().empty() && fields.size() > 1) fields.pop_back();
  for (std::string& field : fields) field = std::string(without_blanks(field));
  return fields;
}

inline char separator_of(std::string_view line) {
  for (const char c : {';', ',', '\t'})
    if (line.find(c) != std::string_view::npos) return c;
  return ' ';
}

/// Reads a field; a comma before the decimals is one. Returns the error, or an empty text.
inline std::string recorded_number(std::string text, double& value) {
  value = std::numeric_limits<double>::quiet_NaN();
  if (is_no_number(text)) return "";
  if (text.find('.') == std::string::npos && std::count(text.begin(), text.end(), ',') == 1)
    std::replace(text.begin(), text.end(), ',', '.');
  const std::string problem = csv_number(text, CsvNumbers::any, value);
  if (problem.empty() && !std::isnan(value) && std::abs(value) < 1e300) return "";
  value = std::numeric_limits<double>::quiet_NaN();
  return csv_quoted(text) + ' ' + (problem.empty() ? "is not finite" : problem);
}

/// Lines that begin with #, % or // are remarks, or the header.
inline bool is_remark(std::string_view line) {
  return line.front() == '#' || line.front() == '%' || line.substr(0, 2) == "//";
}

}  // namespace detail

/// Reads a table: fields between commas, semicolons (then with decimal commas), tabs or blanks,
/// with or without quotation marks. The header is the last line before the first number, also one
/// that begins with # or %. Remarks anywhere and text after the last row are ignored; the text is
/// noted. Throws InputFileError that names file, line and column.
[[nodiscard]] inline RecordedTable read_recorded(const std::string& path) {
  using tilt_ropter::InputFileError;
  RecordedTable table;
  table.file = path;
  std::ifstream in(path);
  if (!in) throw InputFileError("cannot read " + path);
  const auto at = [&path](std::size_t line) { return path + ':' + std::to_string(line) + ": "; };
  std::vector<std::pair<std::size_t, std::string>> above;  // what may be the header
  std::size_t number = 0, width = 0, text_line = 0;        // text_line: text after the rows
  std::string text_there;
  char separator = ',';
  const auto read_header = [&](std::size_t fields) {
    width = fields;
    for (auto line = above.rbegin(); line != above.rend(); ++line) {
      std::string_view text = line->second;
      const bool marked = detail::is_remark(text);
      while (marked && !text.empty() &&
             (text.front() == '#' || text.front() == '/' || text.front() == '%' ||
              text.front() == ' '))
        text.remove_prefix(1);
      table.names = detail::recorded_fields(text, detail::separator_of(text));
      while (table.names.size() > 1 && table.names.back().empty()) table.names.pop_back();
      table.header_line = line->first;
      if (table.names.size() == fields) return;
      if (marked) continue;
      width = table.names.size();  // a row without mark is the header: the rows must fit
      return;
    }
    table.names.clear();
    table.header_line = number;
  };
  for (std::string text; std::getline(in, text);) {
    std::string_view line = text;
    if (++number == 1 && line.substr(0, 3) == "\xEF\xBB\xBF") line.remove_prefix(3);
    while (!line.empty() && (line.back() == '\r' || line.back() == ' ')) line.remove_suffix(1);
    line = detail::without_blanks(line);
    if (line.empty()) continue;
    if (detail::is_remark(line)) {
      if (width == 0) above.emplace_back(number, line);
      continue;
    }
    if (width == 0) separator = detail::separator_of(line);
    std::vector<std::string> fields = detail::recorded_fields(line, separator);
    double value = 0.0;
    const std::string first = detail::recorded_number(fields.front(), value);
    if (!first.empty() || fields.front().empty()) {  // no row
      if (width == 0) {
        above.emplace_back(number, line);
      } else if (text_line == 0) {
        text_line = number;
        text_there = first.empty() ? "is empty" : first;
      }
      continue;
    }
    if (text_line != 0)
      throw InputFileError(at(text_line) + table.column_name(0) + ": " + text_there);
    if (width == 0) {
      std::size_t used = fields.size();
      while (used > 1 && fields[used - 1].empty()) --used;
      read_header(used);
      table.columns.resize(width);
      table.by_blanks = separator == ' ';
    }
    while (fields.size() > width && fields.back().empty()) fields.pop_back();
    if (fields.size() != width)
      throw InputFileError(at(number) + std::to_string(fields.size()) + " fields, the " +
                           (table.names.empty() ? "first" : "header") + " line has " +
                           std::to_string(width));
    for (std::size_t i = 0; i < width; ++i) {
      const std::string problem = detail::recorded_number(fields[i], value);
      if (!problem.empty()) table.wrong[{table.rows(), i}] = problem;
      table.columns[i].push_back(value);
    }
    table.lines.push_back(number);
  }
  if (in.bad()) throw InputFileError("cannot read " + path);
  if (width == 0) throw InputFileError(at(std::max<std::size_t>(number, 1)) + "no row of numbers");
  if (text_line != 0) table.notes.push_back(at(text_line) + "text after the last row is ignored");
  return table;
}

}  // namespace examples
