#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

/// What the programs print about many numbers.
namespace examples {

/// The smallest value that at least the fraction `fraction` of the values do not exceed: 0.5 gives
/// the median, 1 the largest value. NaN counts as the largest. Zero without values.
[[nodiscard]] inline double percentile(std::vector<double> values, double fraction) {
  if (values.empty()) return 0.0;
  const double rank = std::ceil(fraction * static_cast<double>(values.size()) - 1e-9) - 1.0;
  const auto nth = values.begin() + static_cast<std::ptrdiff_t>(std::max(rank, 0.0));
  std::nth_element(values.begin(), nth, values.end(),
                   [](double a, double b) { return a < b || (std::isnan(b) && !std::isnan(a)); });
  return *nth;
}

/// The mean of numbers as they come, zero without numbers.
class Mean {
 public:
  void add(double value) {
    sum_ += value;
    ++count_;
  }
  [[nodiscard]] long count() const { return count_; }
  [[nodiscard]] double value() const {
    return count_ > 0 ? sum_ / static_cast<double>(count_) : 0.0;
  }

 private:
  double sum_ = 0.0;
  long count_ = 0;
};

/// The root of the mean square of errors, zero without errors.
class Rmse {
 public:
  void add(double error) { add_square(error * error); }
  void add_square(double square) { squares_.add(square); }
  [[nodiscard]] long count() const { return squares_.count(); }
  [[nodiscard]] double value() const { return std::sqrt(squares_.value()); }

 private:
  Mean squares_;
};

}  // namespace examples
