#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <fstream>
#include <iomanip>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

/// A table as Markdown, which can also be read as it is, and sections of documents that programs
/// write.
namespace examples::paper {

class Table {
 public:
  /// The first `texts` columns are texts, the others numbers (aligned to the right).
  Table(std::vector<std::string> head, std::size_t texts) : texts_(texts) {
    rows_.push_back(std::move(head));
  }

  void add(std::vector<std::string> row) {
    row.resize(rows_.front().size());
    rows_.push_back(std::move(row));
  }

  [[nodiscard]] std::string markdown() const {
    std::vector<std::size_t> width(rows_.front().size(), 3);
    for (const auto& row : rows_)
      for (std::size_t i = 0; i < row.size(); ++i) width[i] = std::max(width[i], row[i].size());
    std::ostringstream out;
    for (std::size_t r = 0; r < rows_.size(); ++r) {
      for (std::size_t i = 0; i < width.size(); ++i)
        out << "| " << (i < texts_ ? std::left : std::right)
            << std::setw(static_cast<int>(width[i])) << rows_[r][i] << ' ';
      out << "|\n";
      if (r > 0) continue;
      for (std::size_t i = 0; i < width.size(); ++i)
        out << '|' << std::string(width[i] + 1, '-') << (i < texts_ ? '-' : ':');
      out << "|\n";
    }
    return out.str();
  }

 private:
  std::size_t texts_;
  std::vector<std::vector<std::string>> rows_;
};

/// Returns the order of magnitude of `value`, such as ~1e3, or an empty text for NaN.
[[nodiscard]] inline std::string order_of_magnitude(double value) {
  if (std::isnan(value)) return {};
  std::ostringstream out;
  out << "~1e" << std::lround(std::log10(std::abs(value) + 1e-9));
  return out.str();
}

/// Printed below a table with such numbers.
inline constexpr const char* about_unstable_flights =
    "A number after ~ is the order of magnitude of an unstable flight: 0.5 m or more from the "
    "reference, or\ntipped over. Its digits depend on the build.\n";

/// Returns `value` with this number of digits, or an empty text for NaN.
[[nodiscard]] inline std::string number(double value, int digits) {
  if (std::isnan(value)) return {};
  std::ostringstream out;
  out << std::fixed << std::setprecision(digits) << value;
  return out.str();
}

/// Returns an error in millimetres with two or three significant digits.
[[nodiscard]] inline std::string millimetres(double metres) {
  const double mm = 1e3 * metres;
  return number(mm, std::abs(mm) < 99.95 ? 1 : 0);
}

/// Returns the values with a comma before each, for CSV.
[[nodiscard]] inline std::string csv_numbers(const std::vector<double>& values) {
  std::ostringstream out;
  out << std::setprecision(6);
  for (const double value : values) {
    if (std::isnan(value)) {
      out << ",nan";
    } else {
      out << ',' << value;
    }
  }
  return out.str();
}

inline void write_text(const std::string& path, const std::string& text) {
  std::ofstream file(path);
  file << text;
  if (!file.flush()) throw std::runtime_error("cannot write " + path);
}

[[nodiscard]] inline std::string read_text(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw std::runtime_error("cannot read " + path);
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

/// Replaces the text between the lines `<!-- begin NAME -->` and `<!-- end NAME -->` of the
/// document at `path`. Throws std::runtime_error if the document has no such lines.
inline void replace_section(const std::string& path, const std::string& name,
                            const std::string& text) {
  std::string document = read_text(path);
  const std::string begin = "<!-- begin " + name + " -->\n", end = "<!-- end " + name + " -->";
  const std::size_t from = document.find(begin);
  const std::size_t to = from == std::string::npos ? from : document.find(end, from);
  if (to == std::string::npos) throw std::runtime_error(path + " has no section " + name);
  const std::size_t start = from + begin.size();
  document.replace(start, to - start, text);
  write_text(path, document);
}

}  // namespace examples::paper
