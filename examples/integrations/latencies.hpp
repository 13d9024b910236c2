#pragma once

#include "../support/statistics.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <iomanip>
#include <limits>
#include <ostream>
#include <string>
#include <vector>

namespace loops {

/// Stores durations in microseconds. The constructor allocates memory for `most` values.
class Latencies {
 public:
  explicit Latencies(std::size_t most) { values_.reserve(most); }

  void add(double microseconds) { values_.push_back(microseconds); }
  [[nodiscard]] const std::vector<double>& values() const { return values_; }

  /// Prints "NAME_min_us: ..." and so on: minimum, median, 99 %, 99.9 %, maximum. A percentile is
  /// the smallest value that this fraction of the values does not exceed.
  void print(std::ostream& out, const std::string& name) const {
    const auto at = [this](double fraction) { return examples::percentile(values_, fraction); };
    out << std::fixed << std::setprecision(1) << name << "_min_us: " << at(0.0) << '\n'
        << name << "_median_us: " << at(0.5) << '\n'
        << name << "_p99_us: " << at(0.99) << '\n'
        << name << "_p99_9_us: " << at(0.999) << '\n'
        << name << "_max_us: " << at(1.0) << '\n';
  }

 private:
  std::vector<double> values_;
};

/// Prints two histograms side by side, one line per bin, which starts with the upper bound of the
/// bin.
inline void print_histograms(std::ostream& out, const std::string& first_name,
                             const Latencies& first, const std::string& second_name,
                             const Latencies& second) {
  constexpr double infinite = std::numeric_limits<double>::infinity();
  constexpr std::array<double, 17> bounds = {1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0,   500.0,
                                             1e3, 2e3, 5e3, 1e4,  2e4,  5e4,  1e5,   infinite};
  const auto between = [](const Latencies& times, double low, double high) {
    return std::count_if(times.values().begin(), times.values().end(),
                         [=](double t) { return t >= low && t < high; });
  };
  out << "below_us" << std::setw(14) << first_name << std::setw(14) << second_name << '\n'
      << std::setprecision(0);
  double low = -infinite;
  for (const double high : bounds) {
    out << std::setw(8) << high << std::setw(14) << between(first, low, high) << std::setw(14)
        << between(second, low, high) << '\n';
    low = high;
  }
}

}  // namespace loops
