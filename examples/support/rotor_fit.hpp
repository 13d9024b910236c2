#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

/// Least squares for a rotor on a thrust stand: thrust and torque go with the square of the speed,
/// power with its cube; the thrust also with a linear term beside the square. Intervals are of 95
/// %, for noise that is the same at all speeds.
namespace examples {

/// A number and the half width of its interval.
struct Estimate {
  double value = 0.0, half_width = 0.0;
};

/// How well a law fits.
struct Goodness {
  double residual_rms = 0.0, r_squared = 0.0;
};

/// Thrust and exponent: thrust = coefficient speed^2, and how it goes if the exponent is free.
struct ThrustFit {
  Estimate coefficient, exponent;
  Goodness goodness;
};

/// thrust = quadratic speed^2 + linear speed.
struct CurveFit {
  Estimate quadratic, linear;
  Goodness goodness;
  double linear_share = 0.0;  ///< of the linear term in the thrust at the fastest speed

  [[nodiscard]] double thrust(double speed) const {
    return (quadratic.value * speed + linear.value) * speed;
  }
  /// Whether the interval of the linear term leaves zero out and the term matters: with a share
  /// below 3 %, the thrust without it is off by less than 1 % of the largest thrust.
  [[nodiscard]] bool linear_is_significant() const {
    return std::abs(linear.value) > linear.half_width && std::abs(linear_share) >= 0.03;
  }
};

/// torque = ratio thrust; the residual is that from ratio coefficient speed^2.
struct TorqueFit {
  Estimate ratio;
  Goodness goodness;
};

/// power = idle + coefficient speed^3.
struct PowerFit {
  Estimate idle, coefficient;
  Goodness goodness;
};

namespace detail {

/// Student's t: of so many degrees of freedom, 95 % lie within +- this. For more than two by
/// G. W. Hill's expansion about the normal distribution ("Student's t-quantiles", Algorithm 396,
/// 1970), good to 0.2 %.
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

/// y - factor x.
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

/// Half width for `residuals` after `parameters` were fitted, of what has the variance
/// noise^2 / information.
inline double half_width(const std::vector<double>& residuals, std::size_t parameters,
                         double information) {
  const std::size_t freedom = residuals.size() - parameters;
  return student_95(freedom) *
         std::sqrt(dot(residuals, residuals) / static_cast<double>(freedom) / information);
}

/// b of y = a x^b, x in [0, 1], for the best a; looked for between 0.1 and 10 by golden sections.
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
  // What a step of b does that no step of a undoes.
  const std::vector<double> law = power_of(x, b);
  const double a = dot(law, y) / dot(law, law);
  std::vector<double> by_exponent = law;
  for (std::size_t i = 0; i < x.size(); ++i)
    by_exponent[i] *= x[i] > 0.0 ? a * std::log(x[i]) : 0.0;
  by_exponent = left(by_exponent, dot(law, by_exponent) / dot(law, law), law);
  return {b, half_width(residuals(b), 2, dot(by_exponent, by_exponent))};
}

}  // namespace detail

/// Speeds >= 0 [rad/s], not all of them the same, at least three.
inline ThrustFit fit_thrust(const std::vector<double>& speeds, const std::vector<double>& thrusts) {
  const std::vector<double> squares = detail::power_of(speeds, 2.0);
  const double information = detail::dot(squares, squares);
  ThrustFit fit;
  fit.coefficient.value = detail::dot(squares, thrusts) / information;
  const std::vector<double> residuals = detail::left(thrusts, fit.coefficient.value, squares);
  fit.coefficient.half_width = detail::half_width(residuals, 1, information);
  fit.goodness = detail::goodness(residuals, thrusts);
  std::vector<double> shares = speeds;
  const double fastest = *std::max_element(speeds.begin(), speeds.end());
  for (double& share : shares) share /= fastest;
  fit.exponent = detail::free_exponent(shares, thrusts);
  return fit;
}

/// The same speeds; nothing where all that turn are equal, which leaves the two terms one.
inline std::optional<CurveFit> fit_curve(const std::vector<double>& speeds,
                                         const std::vector<double>& thrusts) {
  // In parts of the fastest speed, so that the two terms are of one size.
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
  fit.linear_share = linear / (quadratic + linear);
  return fit;
}

/// The ratio by which torque - ratio thrust has nothing left that goes with the square of the
/// speed: noise of the thrust does not pull it down, as it would a fit of torque over thrust.
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
