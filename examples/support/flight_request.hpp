#pragma once

#include <tilt_ropter/version.hpp>

#include <nlopt.h>

#include <Eigen/Core>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <system_error>
#include <utility>
#include <vector>

/// What a Monte Carlo run was asked for. A file beside the table holds it, so that only tables of
/// the same run are continued or merged.
namespace examples {

/// Writes the file under a temporary name and renames it, so that at every moment it has its old or
/// its new text. Throws std::runtime_error if it cannot be written.
inline void write_atomically(const std::string& path, const std::string& text) {
  const std::string temporary = path + ".new";
  std::ofstream file(temporary, std::ios::binary);
  file << text;
  file.close();
  std::error_code error;
  if (file) std::filesystem::rename(temporary, path, error);
  if (!file || error) throw std::runtime_error("cannot write " + path);
}

/// Returns the bytes of a file. Throws std::runtime_error if it cannot be read.
[[nodiscard]] inline std::string read_bytes(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::string text{std::istreambuf_iterator<char>(file), {}};
  if (!file) throw std::runtime_error("cannot read " + path);
  return text;
}

/// Returns a hash of the text as 16 hexadecimal digits (FNV-1a, 64 bits).
[[nodiscard]] inline std::string hash_of(const std::string& text) {
  std::uint64_t hash = 0xcbf29ce484222325U;
  for (const char c : text) hash = (hash ^ static_cast<unsigned char>(c)) * 0x100000001b3U;
  char digits[17];
  std::snprintf(digits, sizeof digits, "%016llx", static_cast<unsigned long long>(hash));
  return digits;
}

/// Returns a hash of many results of mathematical functions. It differs if this processor or its
/// mathematical library rounds differently, as with and without fused multiply-add.
[[nodiscard]] inline std::string hash_of_arithmetic() {
  std::string bytes;
  for (int i = 1; i <= 4000; ++i) {
    volatile const double input = 1e-3 * i;  // computed when the program runs
    const double x = input;
    const Eigen::Vector3d v(x, std::sin(x), std::cos(7.0 * x));
    for (const double y : {std::exp(x) * x + v.dot(v), std::log(x) - v.norm(), v.x() + v.y(), v.z(),
                           std::atan2(v.y(), v.z()), std::pow(x, 0.3)}) {
      char part[sizeof y];
      std::memcpy(part, &y, sizeof y);
      bytes.append(part, sizeof y);
    }
  }
  return hash_of(bytes);
}

/// Flights of two requests that agree in all but `first` and `count` have the same results to the
/// bit.
struct FlightRequest {
  std::string version, build;  ///< of the program; see this_build()
  std::uint64_t seed = 1, first = 0, count = 0;
  std::string vehicle;           ///< path as given, empty: the Tilt-Ropter
  std::string vehicle_contents;  ///< hash of this file, or empty
  std::string level;             ///< as given, empty: as the vehicle needs
  std::string solver = "automatic";

  [[nodiscard]] std::uint64_t end() const { return first + count; }
};

[[nodiscard]] inline std::string this_version() {
  using namespace tilt_ropter;
  return std::to_string(version_major) + '.' + std::to_string(version_minor) + '.' +
         std::to_string(version_patch);
}

/// Returns what rounding errors depend on: compiler, libraries and processor.
[[nodiscard]] inline std::string this_build() {
  int major = 0, minor = 0, patch = 0;
  nlopt_version(&major, &minor, &patch);
  const auto dotted = [](int a, int b, int c) {
    return std::to_string(a) + '.' + std::to_string(b) + '.' + std::to_string(c);
  };
  return std::string(__VERSION__) + ", Eigen " +
         dotted(EIGEN_WORLD_VERSION, EIGEN_MAJOR_VERSION, EIGEN_MINOR_VERSION) + ", NLopt " +
         dotted(major, minor, patch) + ", arithmetic " + hash_of_arithmetic();
}

/// Name of the file with the request for the table at `path`: results/monte_carlo.run for
/// results/monte_carlo.csv.
[[nodiscard]] inline std::string request_path(const std::string& table) {
  return std::filesystem::path(table).replace_extension(".run").string();
}

namespace detail {

/// Keys and values of a request, in the order of the file.
inline std::vector<std::pair<std::string, std::string>> request_lines(const FlightRequest& r) {
  return {{"version", r.version},
          {"build", r.build},
          {"seed", std::to_string(r.seed)},
          {"first", std::to_string(r.first)},
          {"count", std::to_string(r.count)},
          {"vehicle", r.vehicle},
          {"vehicle_contents", r.vehicle_contents},
          {"level", r.level},
          {"solver", r.solver}};
}

}  // namespace detail

/// Writes the request for the table at `table`, one line "key: value" for each value.
inline void write_request(const FlightRequest& request, const std::string& table) {
  std::string text;
  for (const auto& [key, value] : detail::request_lines(request)) text += key + ": " + value + '\n';
  write_atomically(request_path(table), text);
}

/// Reads the request for the table at `table`. Throws std::runtime_error with the file and the
/// reason if it cannot.
[[nodiscard]] inline FlightRequest read_request(const std::string& table) {
  const std::string path = request_path(table);
  std::ifstream file(path);
  if (!file)
    throw std::runtime_error("cannot read " + path + ", which says what " + table +
                             " was asked for");
  std::map<std::string, std::string> values;
  for (std::string line; std::getline(file, line);) {
    const std::size_t colon = line.find(": ");
    if (colon != std::string::npos) values[line.substr(0, colon)] = line.substr(colon + 2);
  }
  const auto text = [&](const char* key) {
    const auto found = values.find(key);
    if (found == values.end()) throw std::runtime_error(path + ": no line " + key);
    return found->second;
  };
  const auto number = [&](const char* key) -> std::uint64_t {
    const std::string value = text(key);
    constexpr std::size_t most_digits = 16;  // below 2^64
    if (value.empty() || value.size() > most_digits ||
        value.find_first_not_of("0123456789") != std::string::npos)
      throw std::runtime_error(path + ": " + key + " = '" + value + "': must be a whole number");
    return std::stoull(value);
  };
  FlightRequest r;
  r.version = text("version");
  r.build = text("build");
  r.seed = number("seed");
  r.first = number("first");
  r.count = number("count");
  r.vehicle = text("vehicle");
  r.vehicle_contents = text("vehicle_contents");
  r.level = text("level");
  r.solver = text("solver");
  return r;
}

/// Throws std::runtime_error if the flights of both requests cannot be in one table. `where` and
/// `other_where` name the requests in the message.
inline void require_same_run(const FlightRequest& request, const std::string& where,
                             const FlightRequest& other, const std::string& other_where) {
  const auto shown = [](const std::string& value) { return value.empty() ? "none" : value; };
  const auto a = detail::request_lines(request), b = detail::request_lines(other);
  for (std::size_t i = 0; i < a.size(); ++i) {
    const std::string& key = a[i].first;
    // The contents of the vehicle's file count, not its path.
    if (key == "first" || key == "count" || key == "vehicle" || a[i].second == b[i].second)
      continue;
    std::string message = where + ": " + key + " is " + shown(a[i].second) + ", but " +
                          shown(b[i].second) + " in " + other_where;
    if (key == "vehicle_contents")
      message += "; the vehicles are '" + request.vehicle + "' and '" + other.vehicle + '\'';
    throw std::runtime_error(message);
  }
}

}  // namespace examples
