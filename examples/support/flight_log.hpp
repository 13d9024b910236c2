#pragma once

#include "recorded_table.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <cstddef>
#include <limits>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

/// Logs of a flight, with the columns, units and stamps of EuRoC, TUM, rostopic and spreadsheets.
namespace examples {

using InertialLog = std::vector<tilt_ropter::Timed<tilt_ropter::InertialSampled>>;
using PoseLog = std::vector<tilt_ropter::Timed<tilt_ropter::MarkerPosed>>;
using PositionLog = std::vector<tilt_ropter::Timed<Eigen::Vector3d>>;
using StateLog = std::vector<tilt_ropter::Timed<tilt_ropter::BodyStated>>;

/// Poses, and the rows that are none.
struct MarkerLog {
  PoseLog poses;
  PositionLog positions;  ///< rows whose orientation is missing
  long lost = 0;          ///< rows without a position: motion capture had lost the vehicle
};

namespace detail {

/// A column by its name: t, px, qw, wx (angular velocity), fx (specific force), vx, or empty.
struct ColumnRole {
  std::string role, unit;
};

inline ColumnRole role_of(const std::string& name) {
  std::vector<std::string> words(1);
  std::string bracket;
  bool inside = false, was_small = false;
  for (const char c : name) {
    const auto u = static_cast<unsigned char>(c);
    if (c == '[' || c == '(') inside = true;
    if (inside && std::isgraph(u) != 0 && std::string("[]()").find(c) == std::string::npos)
      bracket += static_cast<char>(std::tolower(u));
    if (inside) {
      inside = c != ']' && c != ')';
      continue;
    }
    const bool begins = was_small && std::isupper(u) != 0;  // positionX
    was_small = std::islower(u) != 0;
    if (std::isalnum(u) == 0 || begins) words.emplace_back();
    if (std::isalnum(u) != 0) words.back() += static_cast<char>(std::tolower(u));
  }
  words.erase(std::remove(words.begin(), words.end(), std::string()), words.end());
  ColumnRole column;
  column.unit = bracket;
  const auto is_one_of = [](const std::string& word, const std::vector<std::string>& list) {
    return std::find(list.begin(), list.end(), word) != list.end();
  };
  const std::vector<std::string> axes = {"x", "y", "z", "w"};
  const std::vector<std::string> units = {"s",    "ms",    "us",   "ns",   "sec",       "m",
                                          "mm",   "cm",    "deg",  "dps",  "degps",     "rad",
                                          "mps",  "radps", "mps2", "ms2",  "g",         "nsec",
                                          "rads", "degs",  "usec", "msec", "quaternion"};
  for (std::size_t i = 1; i < words.size(); ++i) {
    if (!is_one_of(words[i], units)) continue;
    if (words[i] == "g" && words[0].compare(0, 1, "a") != 0) continue;  // a gyroscope
    if (column.unit.empty()) column.unit = words[i];
    words.erase(words.begin() + static_cast<std::ptrdiff_t>(i--));
  }
  if (words.empty()) return column;
  const auto any = [&](const std::vector<std::string>& starts,
                       const std::vector<std::string>& whole, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) {
      if (is_one_of(words[i], whole)) return true;
      for (const std::string& start : starts)
        if (words[i].compare(0, start.size(), start) == 0) return true;
    }
    return false;
  };
  if (any({"bias", "cov", "deviation", "error", "std"}, {"b", "bg", "ba"}, words.size()))
    return column;
  std::string& last = words.back();
  if (last.size() == 2 && is_one_of(last.substr(1), axes) &&
      std::string("ptqwgafv").find(last[0]) != std::string::npos) {
    const std::string axis = last.substr(1);
    last.resize(1);
    words.push_back(axis);
  }
  if (!is_one_of(words.back(), axes)) {
    if (any({"time", "stamp"}, {"t"}, words.size()) && !any({}, {"seq"}, words.size()))
      column.role = "t";
    return column;
  }
  const std::size_t count = words.size() - 1;  // without the axis
  const std::string axis = words.back();
  char kind = '\0';
  if (any({"quat", "orient", "rot", "att"}, {"q"}, count))
    kind = 'q';
  else if (any({"ang", "gyr", "omega"}, {"w", "g", "rate"}, count))
    kind = 'w';
  else if (any({"acc", "specific"}, {"a", "f", "force"}, count))
    kind = 'f';
  else if (any({"vel", "speed"}, {"v"}, count))
    kind = 'v';
  else if (any({"pos", "trans", "loc"}, {"p", "t"}, count) || count == 0)
    kind = axis == "w" ? 'q' : 'p';
  if (kind != '\0' && (axis != "w" || kind == 'q')) column.role = kind + axis;
  return column;
}

/// Factor to the unit of `role`: s, m, rad/s, m/s^2. 0 if the unit is not known.
inline double factor_of(const ColumnRole& column) {
  const std::string& unit = column.unit;
  const auto is = [&unit](const std::vector<std::string>& list) {
    return std::find(list.begin(), list.end(), unit) != list.end();
  };
  const double degree = tilt_ropter::pi / 180.0;
  switch (column.role.empty() ? '\0' : column.role[0]) {
    case 't':
      return is({"s", "sec"})     ? 1.0
             : is({"ms", "msec"}) ? 1e-3
             : is({"us", "usec"}) ? 1e-6
             : is({"ns", "nsec"}) ? 1e-9
                                  : 0.0;
    case 'p':
      return is({"mm"}) ? 1e-3 : is({"cm"}) ? 1e-2 : 1.0;
    case 'w':
      return unit.compare(0, 3, "deg") == 0 || unit == "dps" || unit == "\xC2\xB0/s" ? degree : 1.0;
    case 'f':
      return is({"g", "gs", "gees"}) ? tilt_ropter::gravity
             : is({"mg"})            ? 1e-3 * tilt_ropter::gravity
                                     : 1.0;
    default:
      return 1.0;
  }
}

inline std::string short_number(double value) {
  std::ostringstream text;
  text.precision(4);
  text << value;
  return text.str();
}

inline const char* unit_name(double factor) {
  return factor == 1.0 ? "s" : factor == 1e-3 ? "ms" : factor == 1e-6 ? "us" : "ns";
}

/// The middle of the steps between stamps.
inline double median_step(const std::vector<double>& stamps) {
  std::vector<double> steps;
  for (std::size_t i = 1; i < stamps.size(); ++i) steps.push_back(stamps[i] - stamps[i - 1]);
  std::nth_element(steps.begin(), steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2),
                   steps.end());
  return steps[steps.size() / 2];
}

/// The unit of stamps: the one in which they are seconds since 1970, or in which the log is as long
/// as one of `duration` [s]; without that, in which samples come at 2 Hz to 20 kHz.
inline double unit_of_stamps(const std::vector<double>& stamps, double duration) {
  const double step = std::abs(median_step(stamps)), range = stamps.back() - stamps.front();
  double best = 1.0, least = std::numeric_limits<double>::infinity();
  for (const double factor : {1.0, 1e-3, 1e-6, 1e-9}) {
    const double now = factor * stamps.front();
    if (now > 1e9 && now < 3e9 && factor * step > 2e-5 && factor * step < 10.0) return factor;
    const double wrong = duration > 0.0 && range > 0.0
                             ? std::abs(std::log(factor * range / duration))
                             : std::abs(std::log(factor * step / 5e-3));
    if (wrong >= least) continue;
    least = wrong;
    best = factor;
  }
  return best;
}

}  // namespace detail

/// Reads the logs of a flight and notes what it assumed about them.
class FlightLogs {
 public:
  /// What was assumed, one sentence each, with file and line.
  [[nodiscard]] const std::vector<std::string>& notes() const { return notes_; }
  /// Time that was subtracted from all stamps [s].
  [[nodiscard]] double origin() const { return origin_; }

  /// The functions throw InputFileError with file, line and column. Read the IMU first: the other
  /// stamps have its origin and, without a unit, the unit in which they last as long.
  [[nodiscard]] InertialLog imu(const std::string& path) {
    const Log log(*this, path, {"t", "wx", "wy", "wz", "fx", "fy", "fz"},
                  "t, wx, wy, wz, ax, ay, az", Gaps::refused);
    InertialLog imu;
    for (std::size_t i = 0; i < log.rows(); ++i)
      imu.push_back({log.time(i), {log.vector(i, 1), log.vector(i, 4)}});
    duration_ = imu.back().time - imu.front().time;
    return imu;
  }

  /// A row without an orientation is a position; one without a position is lost.
  [[nodiscard]] MarkerLog poses(const std::string& path) {
    const Log log(*this, path, {"t", "px", "py", "pz", "qw", "qx", "qy", "qz"},
                  "t, px, py, pz, qw, qx, qy, qz", Gaps::allowed);
    MarkerLog marker;
    for (std::size_t i = 0; i < log.rows(); ++i) {
      const Eigen::Vector3d position = log.vector(i, 1);
      const bool has_orientation = log.has_orientation(i, 4);
      const bool is_zero = position.isZero(0.0) && !has_orientation;
      if (!tilt_ropter::all_finite(position) || is_zero)
        ++marker.lost;
      else if (has_orientation)
        marker.poses.push_back({log.time(i), {position, log.rotation(i, 4)}});
      else
        marker.positions.push_back({log.time(i), position});
    }
    if (marker.poses.size() < 2)
      throw tilt_ropter::InputFileError(path +
                                        ": fewer than two poses with an orientation; the "
                                        "estimator starts at one");
    return marker;
  }

  [[nodiscard]] StateLog truth(const std::string& path) {
    const Log log(*this, path, {"t", "px", "py", "pz", "qw", "qx", "qy", "qz", "vx", "vy", "vz"},
                  "t, px, py, pz, qw, qx, qy, qz, vx, vy, vz", Gaps::refused);
    StateLog truth;
    for (std::size_t i = 0; i < log.rows(); ++i)
      truth.push_back(
          {log.time(i),
           {log.vector(i, 1), log.vector(i, 8), log.rotation(i, 4), Eigen::Vector3d::Zero()}});
    return truth;
  }

 private:
  enum class Gaps { refused, allowed };  ///< fields without a number

  /// A table with the columns in the order of `roles`.
  class Log {
   public:
    Log(FlightLogs& logs, const std::string& path, const std::vector<std::string>& roles,
        const std::string& form, Gaps gaps)
        : table_(read_recorded(path)), form_(form) {
      for (const std::string& note : table_.notes) logs.notes_.push_back(note);
      find_columns(logs, roles);
      if (table_.rows() < 2) refuse(table_.file + ": fewer than two samples");
      for (std::size_t i = 0; i < roles.size(); ++i)
        check_numbers(i, i > 0 && gaps == Gaps::allowed);
      find_unit_of_time(logs);
    }

    [[nodiscard]] std::size_t rows() const { return table_.rows(); }
    [[nodiscard]] double time(std::size_t row) const { return times_[row]; }
    [[nodiscard]] Eigen::Vector3d vector(std::size_t row, std::size_t first) const {
      return {value(row, first), value(row, first + 1), value(row, first + 2)};
    }
    [[nodiscard]] bool has_orientation(std::size_t row, std::size_t first) const {
      double square = 0.0;
      for (std::size_t i = 0; i < 4; ++i) square += std::pow(value(row, first + i), 2);
      return square > 0.0;  // false for NaN
    }
    [[nodiscard]] Eigen::Quaterniond rotation(std::size_t row, std::size_t first) const {
      const Eigen::Vector3d v = vector(row, first + 1);
      const Eigen::Quaterniond q(value(row, first), v.x(), v.y(), v.z());
      if (!(std::abs(q.norm() - 1.0) <= 0.1))
        refuse(table_.at_row(row) + "columns " + name(first) + " to " + name(first + 3, false) +
               ": a quaternion of length " + std::to_string(q.norm()) + ", must be 1");
      return q.normalized();
    }

   private:
    [[noreturn]] static void refuse(const std::string& what) {
      throw tilt_ropter::InputFileError(what);
    }
    [[nodiscard]] double value(std::size_t row, std::size_t i) const {
      return factors_[i] * table_.columns[columns_[i]][row];
    }
    [[nodiscard]] std::string name(std::size_t i, bool with_number = true) const {
      const std::size_t column = columns_[i];
      const std::string number = " (" + std::to_string(column + 1) + ')';
      if (table_.names.empty()) return std::to_string(column + 1);
      return table_.names[column] + (with_number ? number : "");
    }

    void find_columns(FlightLogs& logs, const std::vector<std::string>& roles) {
      const std::string header = table_.file + ':' + std::to_string(table_.header_line) + ": ";
      const std::size_t width = table_.columns.size();
      if (width < roles.size())
        refuse(header + std::to_string(width) + " columns, expected are " + form_);
      const bool has_orientation = roles.back() == "qz";
      if (table_.names.empty() && table_.by_blanks && has_orientation && width == 8) {
        logs.notes_.push_back(header + "no header: read as TUM, t px py pz qx qy qz qw");
        columns_ = {0, 1, 2, 3, 7, 4, 5, 6};
        factors_.assign(roles.size(), 1.0);
        return;
      }
      if (table_.names.empty()) refuse(header + "no header line, expected is " + form_);
      std::vector<detail::ColumnRole> found;
      for (const std::string& column : table_.names) found.push_back(detail::role_of(column));
      const auto column_of = [&found](const std::string& role) {
        const auto is_it = [&role](const detail::ColumnRole& c) { return c.role == role; };
        return static_cast<std::size_t>(std::find_if(found.begin(), found.end(), is_it) -
                                        found.begin());
      };
      const bool none = std::none_of(roles.begin() + 1, roles.end(), [&](const std::string& role) {
        return column_of(role) < width;
      });
      const bool other = std::any_of(found.begin(), found.end(), [](const detail::ColumnRole& c) {
        return !c.role.empty() && c.role != "t";
      });
      if (none && !other)
        logs.notes_.push_back(header + "unknown names, read in the order " + form_);
      for (std::size_t i = 0; i < roles.size(); ++i) {
        const std::size_t column = none && !other ? i : column_of(roles[i]);
        if (column == width) {
          std::string message =
              header + "no column for " + roles[i] + ", expected are " + form_ + "; the header has";
          for (const std::string& heading : table_.names)
            message += (&heading == &table_.names.front() ? " " : ", ") + csv_quoted(heading);
          refuse(message);
        }
        for (std::size_t j = column + 1; j < width && i > 0; ++j)
          if (found[j].role == roles[i] && !found[j].role.empty())
            refuse(header + "two columns for " + roles[i] + ": " + table_.names[column] + " and " +
                   table_.names[j]);
        columns_.push_back(column);
        const double factor = i == 0 ? 1.0 : detail::factor_of(found[column]);
        factors_.push_back(factor);
        if (factor != 1.0)
          logs.notes_.push_back(header + table_.column_name(column) + " is in " +
                                found[column].unit + ", converted to SI");
      }
      given_unit_ = detail::factor_of(found[columns_[0]]);
    }

    void check_numbers(std::size_t i, bool may_be_missing) const {
      const std::size_t column = columns_[i];
      for (std::size_t row = 0; row < rows(); ++row) {
        const double number = table_.columns[column][row];
        if (std::isfinite(number)) continue;
        const auto problem = table_.wrong.find({row, column});
        if (problem == table_.wrong.end() && may_be_missing) continue;
        refuse(table_.at_row(row) + table_.column_name(column) + ": " +
               (problem == table_.wrong.end() ? "no number" : problem->second) +
               ", expected is a number");
      }
    }

    void find_unit_of_time(FlightLogs& logs) {
      const std::vector<double>& stamps = table_.columns[columns_[0]];
      const std::string header = table_.file + ": " + table_.column_name(columns_[0]);
      std::size_t still = 0, line = 0;
      for (std::size_t i = 1; i < stamps.size(); ++i) {
        if (stamps[i] > stamps[i - 1]) continue;
        ++still;
        if (line == 0) line = table_.lines[i];
      }
      const std::string first_back = table_.file + ':' + std::to_string(line) + ": " +
                                     table_.column_name(columns_[0]) + " does not increase";
      if (stamps.size() >= 20 && 10 * still > stamps.size())
        refuse(first_back + ", as " + std::to_string(still) + " of " +
               std::to_string(stamps.size()) +
               " stamps: numbers that a spreadsheet has rounded, or rows in another order");
      if (still > 0) logs.notes_.push_back(first_back);
      double unit = detail::unit_of_stamps(stamps, logs.duration_);
      const double step = detail::median_step(stamps);
      if (given_unit_ > 0.0 && given_unit_ != unit &&
          (!(given_unit_ * step > 2e-5) || !(given_unit_ * step < 5.0))) {
        logs.notes_.push_back(header + " says " + detail::unit_name(given_unit_) +
                              " but has steps of " + detail::short_number(step) + ": read as " +
                              detail::unit_name(unit));
      } else if (given_unit_ > 0.0) {
        unit = given_unit_;
      } else if (unit != 1.0) {
        logs.notes_.push_back(header + " has steps of " + detail::short_number(step) +
                              ": read as " + detail::unit_name(unit));
      }
      const double start = unit * stamps.front();
      double origin = start > 1e6 ? logs.origin_ : 0.0;
      if (logs.duration_ == 0.0 && start > 1e6) {
        logs.origin_ = origin = std::floor(start);
      } else if (std::abs(start - origin) > 1e6) {
        origin = std::floor(start);
        logs.notes_.push_back(header +
                              ": another clock than that of the IMU, each log counts "
                              "from its start: see --calibrate");
      }
      for (const double stamp : stamps) times_.push_back(unit * stamp - origin);
    }

    static std::string csv_quoted(const std::string& text) { return detail::csv_quoted(text); }

    RecordedTable table_;
    std::string form_;
    std::vector<std::size_t> columns_;
    std::vector<double> factors_, times_;
    double given_unit_ = 0.0;
  };

  std::vector<std::string> notes_;
  double duration_ = 0.0, origin_ = 0.0;
};

}  // namespace examples
