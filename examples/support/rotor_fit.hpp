#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

/// Least-squares fits for a rotor on a thrust stand. Thrust and torque are proportional to the
/// square of the speed, power to its cube. A second fit of the thrust has an additional linear
/// term. The intervals are 95 % confidence intervals, for noise that is the same at all speeds.
namespace examples {

/// A value and the half width of its interval.
struct Estimate {
  double value = 0.0, half_width = 0.0;
};

/// Quality of a fit.
struct Goodness {
  double residual_rms = 0.0, r_squared = 0.0;
};

/// Fit of thrust = coefficient speed^2, and the exponent of the speed if it is free.
struct ThrustFit {
  Estimate coefficient, exponent;
  Goodness goodness;
};

/// Fit of thrust = quadratic speed^2 + linear speed.
struct CurveFit {
  Estimate quadratic, linear;
  Goodness goodness;
  /// Fraction of the thrust from the linear term, at the highest speed.
  double linear_fraction = 0.0;

  [[nodiscard]] double thrust(double speed) const {
    return (quadratic.value * speed + linear.value) * speed;
  }
  /// True if the interval of the linear term does not contain zero and the term matters. With a
  /// fraction below 3 %, the thrust without this term is wrong by less than 1 % of the largest
  /// thrust.
  [[nodiscard]] bool linear_is_significant() const {
    return std::abs(linear.value) > linear.half_width && std::abs(linear_fraction) >= 0.03;
  }
};

/// Fit of torque = ratio thrust; the residual is torque - ratio coefficient speed^2.
struct TorqueFit {
  Estimate ratio;
  Goodness goodness;
};

/// Fit of power = idle + coefficient speed^3.
struct PowerFit {
  Estimate idle, coefficient;
  Goodness goodness;
};

namespace detail {

/// Student's t distribution with `freedom` degrees of freedom: 95 % of the values are within +- the
/// returned number. Above two degrees of freedom it uses G. W. Hill's expansion about the normal
/// distribution ("Student's t-quantiles", Algorithm 396, 1970), which is accurate to 0.2 %.
inline double student_95(std::size_t freedom) {
  if (freedom == 0) return std::numeric_limits<double>::infinity();
  if (freedom == 1) return 12.7062;
  if (freedom == 2) return 4.30265;
  const double z = 1.959964, z2 = z * z, n = static_cast<double>(freedom);
  const double first = (z2 + 1.0) / 4.0, second = ((5.0 * z2 + 16.0) * z2 + 3.0) / 96.0,
               third = (((3.0 * z2 + 19.0) * z2 + 17.0) * z2 - 15.0) / 384.0,
               fourth =
                   ((((79.0 * z2 + 776.0) * z2 + 1482.0) * z2 - 1920.0) * z2 - 945.0) / 92160.0;
  return z * (1.0 + (first + (second + (third + fourth / n) / n) / n) / n);
}

inline double dot(const std::vector<double>& a, const std::vector<double>& b) {
  double sum = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

inline double mean(const std::vector<double>& a) {
  double sum = 0.0;
  for (const double x : a) sum += x;
  return sum / static_cast<double>(a.size());
}

/// Returns y - factor x.
inline std::vector<double> left(const std::vector<double>& y, double factor,
                                const std::vector<double>& x) {
  std::vector<double> rest = y;
  for (std::size_t i = 0; i < y.size(); ++i) rest[i] -= factor * x[i];
  return rest;
}

inline std::vector<double> less(std::vector<double> values, double offset) {
  for (double& value : values) value -= offset;
  return values;
}

inline std::vector<double> power_of(const std::vector<double>& x, double exponent) {
  std::vector<double> result = x;
  for (double& value : result) value = std::pow(value, exponent);
  return result;
}

inline Goodness goodness(const std::vector<double>& residuals, const std::vector<double>& y) {
  const std::vector<double> spread = less(y, mean(y));
  return {std::sqrt(dot(residuals, residuals) / static_cast<double>(y.size())),
          1.0 - dot(residuals, residuals) / dot(spread, spread)};
}

/// Returns the half width of the interval of a value with the variance noise^2 / information, from
/// the `residuals` after a fit of this number of `parameters`.
inline double half_width(const std::vector<double>& residuals, std::size_t parameters,
                         double information) {
  const std::size_t freedom = residuals.size() - parameters;
  return student_95(freedom) *
         std::sqrt(dot(residuals, residuals) / static_cast<double>(freedom) / information);
}

/// Returns b of y = a x^b, x in [0, 1], for the best a. Searches between 0.1 and 10 by
/// golden-section search.
inline Estimate free_exponent(const std::vector<double>& x, const std::vector<double>& y) {
  const auto residuals = [&](double b) {
    const std::vector<double> law = power_of(x, b);
    return left(y, dot(law, y) / dot(law, law), law);
  };
  const auto squares = [&](double b) { return dot(residuals(b), residuals(b)); };
  const double golden = 0.5 * (std::sqrt(5.0) - 1.0);
  double low = 0.1, high = 10.0;
  while (high - low > 1e-7) {
    const double step = golden * (high - low);
    if (squares(high - step) < squares(low + step))
      high = low + step;
    else
      low = high - step;
  }
  const double b = 0.5 * (low + high);
  // The effect of a step of b that no step of a compensates.
  const std::vector<double> law = power_of(x, b);
  const double a = dot(law, y) / dot(law, law);
  std::vector<double> by_exponent = law;
  for (std::size_t i = 0; i < x.size(); ++i)
    by_exponent[i] *= x[i] > 0.0 ? a * std::log(x[i]) : 0.0;
  by_exponent = left(by_exponent, dot(law, by_exponent) / dot(law, law), law);
  return {b, half_width(residuals(b), 2, dot(by_exponent, by_exponent))};
}

}  // namespace detail

/// Fits the thrust. Needs at least three speeds >= 0 [rad/s] that are not all equal.
inline ThrustFit fit_thrust(const std::vector<double>& speeds, const std::vector<double>& thrusts) {
  const std::vector<double> squares = detail::power_of(speeds, 2.0);
  const double information = detail::dot(squares, squares);
  ThrustFit fit;
  fit.coefficient.value = detail::dot(squares, thrusts) / information;
  const std::vector<double> residuals = detail::left(thrusts, fit.coefficient.value, squares);
  fit.coefficient.half_width = detail::half_width(residuals, 1, information);
  fit.goodness = detail::goodness(residuals, thrusts);
  std::vector<double> fractions = speeds;
  const double fastest = *std::max_element(speeds.begin(), speeds.end());
  for (double& fraction : fractions) fraction /= fastest;
  fit.exponent = detail::free_exponent(fractions, thrusts);
  return fit;
}

/// The same with a linear term. Returns nothing if all non-zero speeds are equal, because the two
/// terms cannot then be separated.
inline std::optional<CurveFit> fit_curve(const std::vector<double>& speeds,
                                         const std::vector<double>& thrusts) {
  // Speeds as fractions of the highest speed, so that both terms have the same magnitude.
  const double fastest = *std::max_element(speeds.begin(), speeds.end());
  std::vector<double> x = speeds;
  for (double& part : x) part /= fastest;
  const std::vector<double> square = detail::power_of(x, 2.0);
  const double of_square = detail::dot(square, square), of_both = detail::dot(square, x),
               of_x = detail::dot(x, x), determinant = of_square * of_x - of_both * of_both;
  if (!(determinant > 1e-9 * of_square * of_x)) return std::nullopt;
  const double by_square = detail::dot(square, thrusts), by_x = detail::dot(x, thrusts);
  const double quadratic = (of_x * by_square - of_both * by_x) / determinant,
               linear = (of_square * by_x - of_both * by_square) / determinant;
  const std::vector<double> residuals =
      detail::left(detail::left(thrusts, quadratic, square), linear, x);
  CurveFit fit;
  fit.quadratic = {quadratic / (fastest * fastest),
                   detail::half_width(residuals, 2, determinant / of_x) / (fastest * fastest)};
  fit.linear = {linear / fastest,
                detail::half_width(residuals, 2, determinant / of_square) / fastest};
  fit.goodness = detail::goodness(residuals, thrusts);
  fit.linear_fraction = linear / (quadratic + linear);
  return fit;
}

/// Fits the ratio such that torque - ratio thrust has no part proportional to the square of the
/// speed. Noise in the thrust does not bias this ratio towards zero, as it would bias a fit of
/// torque over thrust.
inline TorqueFit fit_torque(const std::vector<double>& speeds, const std::vector<double>& thrusts,
                            const std::vector<double>& torques) {
  const std::vector<double> squares = detail::power_of(speeds, 2.0);
  const double information = detail::dot(squares, squares);
  const double thrust = detail::dot(squares, thrusts), torque = detail::dot(squares, torques);
  TorqueFit fit;
  fit.ratio.value = torque / thrust;
  fit.ratio.half_width = detail::half_width(detail::left(torques, fit.ratio.value, thrusts), 1,
                                            thrust * thrust / information);
  fit.goodness = detail::goodness(detail::left(torques, torque / information, squares), torques);
  return fit;
}

inline PowerFit fit_power(const std::vector<double>& speeds, const std::vector<double>& powers) {
  const std::vector<double> cubes = detail::power_of(speeds, 3.0);
  const double centre = detail::mean(cubes);
  const std::vector<double> spread = detail::less(cubes, centre);
  const double information = detail::dot(spread, spread),
               count = static_cast<double>(speeds.size());
  PowerFit fit;
  fit.coefficient.value = detail::dot(spread, powers) / information;
  fit.idle.value = detail::mean(powers) - fit.coefficient.value * centre;
  const std::vector<double> residuals =
      detail::less(detail::left(powers, fit.coefficient.value, cubes), fit.idle.value);
  fit.coefficient.half_width = detail::half_width(residuals, 2, information);
  fit.idle.half_width =
      detail::half_width(residuals, 2, 1.0 / (1.0 / count + centre * centre / information));
  fit.goodness = detail::goodness(residuals, powers);
  return fit;
}

}  // namespace examples
