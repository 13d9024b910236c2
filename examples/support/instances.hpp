#pragma once

#include "csv.hpp"

#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstddef>
#include <istream>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

/// Instances of the optimal-control problem of the benchmark as CSV, one per line below a header
/// line that names every column. Numbers have the format of std::from_chars; a `+` before them is
/// allowed. Blanks around a field are ignored. There is no quoting. Blank lines are skipped. Lines
/// may end in CR LF; the last line need not end.
namespace examples {

enum class InstanceBounds { paper, wide };

struct Instance {
  std::string id;  ///< any text without commas or control characters
  InstanceBounds bounds = InstanceBounds::wide;
  /// Fe, Me: known to the controller, constant, body frame [N; N m].
  tilt_ropter::Wrenchd external;
  tilt_ropter::Stated start;  ///< x_0
  tilt_ropter::BodyStated
      reference;  ///< constant over the horizon; the angular velocity is always zero
};

inline constexpr std::array<std::string_view, 37> instance_columns = {
    "id",      "bounds",  "Fe_x",    "Fe_y",    "Fe_z",    "Me_x",    "Me_y",    "Me_z",
    "F_x",     "F_y",     "F_z",     "M_x",     "M_y",     "M_z",     "p_x",     "p_y",
    "p_z",     "v_x",     "v_y",     "v_z",     "q_w",     "q_x",     "q_y",     "q_z",
    "w_x",     "w_y",     "w_z",     "ref_p_x", "ref_p_y", "ref_p_z", "ref_v_x", "ref_v_y",
    "ref_v_z", "ref_q_w", "ref_q_x", "ref_q_y", "ref_q_z"};

/// An error in a file with its position; both start at 1, columns in UTF-8 characters.
struct InstanceError {
  std::size_t line = 1;
  std::size_t column = 1;
  std::string message;
};

struct InstanceFile {
  std::vector<Instance> instances;    ///< all valid lines
  std::vector<InstanceError> errors;  ///< one for each invalid line
};

namespace detail {

/// Index of each part of InstanceNumbers; `start` is a PackedState.
struct InstanceIndex {
  static constexpr int external_force = 0, external_torque = 3, start = 6, reference_position = 25,
                       reference_velocity = 28, reference_orientation = 31;
};

using InstanceNumbers = Eigen::Matrix<double, 35, 1>;  // the columns after id and bounds, in order

struct Field {
  std::string_view text;  // without surrounding blanks
  std::size_t offset;     // in the line, in bytes
};

inline std::vector<Field> split(std::string_view line) {
  std::vector<Field> fields;
  for (std::size_t start = 0; start <= line.size();) {
    const std::size_t end = std::min(line.find(',', start), line.size());
    const std::string_view text = without_blanks(line.substr(start, end - start));
    const auto offset = text.empty() ? start : static_cast<std::size_t>(text.data() - line.data());
    fields.push_back({text, offset});
    start = end + 1;
  }
  return fields;
}

inline std::size_t column_of(std::string_view line, std::size_t offset) {
  const auto starts_character = [](char c) {
    return (static_cast<unsigned char>(c) & 0xC0) != 0x80;
  };
  const auto end = line.begin() + static_cast<std::ptrdiff_t>(std::min(offset, line.size()));
  return 1 + static_cast<std::size_t>(std::count_if(line.begin(), end, starts_character));
}

/// Normalises q. Returns false if q has no usable direction.
inline bool normalise(Eigen::Quaterniond& q) {
  const double norm = q.coeffs().stableNorm();
  if (!(norm > 1e-3) || !std::isfinite(norm)) return false;
  q.coeffs() /= norm;
  return true;
}

}  // namespace detail

/// Returns the header line without its line end.
[[nodiscard]] inline std::string instance_header() {
  std::string line;
  for (const std::string_view name : instance_columns) (line += line.empty() ? "" : ",") += name;
  return line;
}

/// Returns true if `line` is the header line. Otherwise `error` describes the first difference.
[[nodiscard]] inline bool check_instance_header(std::string_view line, InstanceError& error) {
  const std::vector<detail::Field> fields = detail::split(line);
  const std::string expected = "; the header line must be " + instance_header();
  for (std::size_t i = 0; i < std::min(fields.size(), instance_columns.size()); ++i)
    if (fields[i].text != instance_columns[i]) {
      error.column = detail::column_of(line, fields[i].offset);
      error.message = "column is called " + detail::csv_quoted(fields[i].text, '"') + ", must be " +
                      detail::csv_quoted(instance_columns[i], '"') + expected;
      return false;
    }
  if (fields.size() == instance_columns.size()) return true;
  const bool surplus = fields.size() > instance_columns.size();
  error.column =
      detail::column_of(line, surplus ? fields[instance_columns.size()].offset : line.size());
  error.message = "header has " + std::to_string(fields.size()) + " columns, must have " +
                  std::to_string(instance_columns.size()) + expected;
  return false;
}

/// Returns the instance in `line` (without its line end) with normalised quaternions. Returns
/// nothing on an error, which `error` then describes with its column.
[[nodiscard]] inline std::optional<Instance> parse_instance(std::string_view line,
                                                            InstanceError& error) {
  const std::vector<detail::Field> fields = detail::split(line);
  const auto wrong = [&](std::size_t offset, std::string message) {
    error.column = detail::column_of(line, offset);
    error.message = std::move(message);
    return std::nullopt;
  };
  constexpr std::size_t count = instance_columns.size();
  if (fields.size() != count)
    return wrong(fields.size() > count ? fields[count].offset : line.size(),
                 std::to_string(fields.size()) + " fields, must be " + std::to_string(count));

  Instance instance;
  instance.id = std::string(fields[0].text);
  if (instance.id.empty()) return wrong(fields[0].offset, "id is empty");
  if (std::any_of(instance.id.begin(), instance.id.end(), detail::is_control))
    return wrong(fields[0].offset,
                 "id " + detail::csv_quoted(instance.id, '"') + " has control characters");
  if (fields[1].text != "paper" && fields[1].text != "wide")
    return wrong(fields[1].offset,
                 "bounds = " + detail::csv_quoted(fields[1].text, '"') + ": must be paper or wide");
  instance.bounds = fields[1].text == "paper" ? InstanceBounds::paper : InstanceBounds::wide;

  detail::InstanceNumbers n;
  for (std::size_t i = 2; i < count; ++i) {
    const std::string problem =
        detail::csv_number(fields[i].text, CsvNumbers::finite, n(static_cast<Eigen::Index>(i - 2)));
    if (!problem.empty())
      return wrong(fields[i].offset, std::string(instance_columns[i]) + " = " +
                                         detail::csv_quoted(fields[i].text, '"') + " " + problem);
  }
  using I = detail::InstanceIndex;
  instance.external = {n.segment<3>(I::external_force), n.segment<3>(I::external_torque)};
  const auto start = n.segment<19>(I::start);  // in the paper's order, q as (w, x, y, z)
  instance.start.wrench = {start.segment<3>(0), start.segment<3>(3)};
  instance.start.body.position = start.segment<3>(6);
  instance.start.body.velocity = start.segment<3>(9);
  instance.start.body.orientation = Eigen::Quaterniond(start(12), start(13), start(14), start(15));
  instance.start.body.angular_velocity = start.segment<3>(16);
  instance.reference.position = n.segment<3>(I::reference_position);
  instance.reference.velocity = n.segment<3>(I::reference_velocity);
  const Eigen::Vector4d q = n.segment<4>(I::reference_orientation);
  instance.reference.orientation = Eigen::Quaterniond(q(0), q(1), q(2), q(3));
  if (!detail::normalise(instance.start.body.orientation))
    return wrong(fields[20].offset, "q is too near to zero or too large to be normalised");
  if (!detail::normalise(instance.reference.orientation))
    return wrong(fields[33].offset, "ref_q is too near to zero or too large to be normalised");
  return instance;
}

/// Returns the shortest text that reads back as the same double.
[[nodiscard]] inline std::string to_csv(double value) {
  std::array<char, 32> text{};
  const auto result = std::to_chars(text.data(), text.data() + text.size(), value);
  return {text.data(), result.ptr};
}

/// Returns the line, without its line end, that parse_instance() reads.
[[nodiscard]] inline std::string to_csv(const Instance& instance) {
  const Eigen::Quaterniond &q = instance.reference.orientation,
                           &at_start = instance.start.body.orientation;
  detail::InstanceNumbers n;
  n << instance.external.force, instance.external.torque, instance.start.wrench.force,
      instance.start.wrench.torque, instance.start.body.position, instance.start.body.velocity,
      at_start.w(), at_start.x(), at_start.y(), at_start.z(), instance.start.body.angular_velocity,
      instance.reference.position, instance.reference.velocity, q.w(), q.x(), q.y(), q.z();
  std::string line = instance.id;
  line += instance.bounds == InstanceBounds::paper ? ",paper" : ",wide";
  for (Eigen::Index i = 0; i < n.size(); ++i) (line += ',') += to_csv(n(i));
  return line;
}

/// Reads a complete file. After an invalid header line it reads nothing else.
[[nodiscard]] inline InstanceFile read_instances(std::istream& in) {
  InstanceFile file;
  InstanceError error;
  std::string text;
  for (bool header = true; std::getline(in, text); header = false, ++error.line) {
    std::string_view line = text;
    constexpr std::string_view byte_order_mark = "\xEF\xBB\xBF";
    if (header && line.substr(0, byte_order_mark.size()) == byte_order_mark)
      line.remove_prefix(byte_order_mark.size());
    if (!line.empty() && line.back() == '\r') line.remove_suffix(1);
    if (header) {
      if (check_instance_header(line, error)) continue;
      file.errors.push_back(error);
      return file;
    }
    if (line.find_first_not_of(" \t") == std::string_view::npos) continue;
    if (auto instance = parse_instance(line, error))
      file.instances.push_back(std::move(*instance));
    else
      file.errors.push_back(error);
  }
  // An empty file ends the loop at once.
  if (error.line == 1) {
    (void)check_instance_header("", error);
    file.errors.push_back(error);
  }
  return file;
}

}  // namespace examples
