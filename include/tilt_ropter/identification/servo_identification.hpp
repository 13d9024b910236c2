// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/validation.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

/// Identification of a servo from a recorded log: first-order lag with gain, offset and dead time
/// (paper, Sec. External Wrench Estimation, which models the tilt angles by such a lag).
namespace tilt_ropter {

/// Recorded log: arrays of equal length. Stamps must increase; their spacing may be uneven. The
/// functions below take any `Log` with these members, such as views into a larger record. They are
/// templates so that only code that calls them pays for their compile time.
struct ServoLog {
  std::vector<double> times;     ///< [s]
  std::vector<double> commands;  ///< [rad], each held until the next command
  std::vector<double> angles;    ///< measured [rad]
};

/// Model d(angle)/dt = (gain * command(t - dead_time) + offset - angle) / time_constant. Before the
/// first stamp of a log, the command is assumed equal to the command at that stamp.
struct ServoModel {
  double time_constant = 0.0;  ///< [s]
  double dead_time = 0.0;      ///< [s]
  double gain = 0.0;           ///< [rad/rad]
  double offset = 0.0;         ///< [rad]
  double initial_angle = 0.0;  ///< at the first stamp of the log [rad]
};

/// Search range and acceptance limits of identify_servo().
struct ServoIdentificationSettings {
  static constexpr double min_time_constant = 0.002;  ///< shortest time constant of the search [s]
  static constexpr double max_time_constant = 2.0;    ///< longest; never longer than the log [s]
  double max_dead_time = 0.2;  ///< longest dead time of the search; 0: no dead time [s]
  static constexpr double min_excitation = 0.01;   ///< required largest - smallest command [rad]
  static constexpr double min_significance = 5.0;  ///< required gain / its standard deviation
  static constexpr int min_samples = 20;           ///< required number of samples, at least 6
  int max_iterations = 100;  ///< largest number of Gauss-Newton iterations from each start
};

/// Whether the servo was identified and, if not, the reason.
enum class ServoIdentificationStatus {
  identified,
  // Refused before the fit:
  sizes_unequal,
  too_few_samples,
  not_finite,
  stamps_not_increasing,
  command_constant,
  // Refused after the fit, which is reported but not reliable. no_response and
  // time_constant_too_long may also be found before the fit.
  no_convergence,
  no_response,
  time_constant_too_short,
  time_constant_too_long,
  dead_time_too_long,
  reversed,          ///< the angle follows the negative command
  implausible_gain,  ///< below 0.1 or above 10: radians and degrees?
  angle_early        ///< the angle moves before its command
};

/// Result of identify_servo().
struct ServoIdentification {
  ServoIdentificationStatus status = ServoIdentificationStatus::no_convergence;
  ServoModel model;
  /// Half-widths of the 95 % confidence intervals around `model`.
  ServoModel half_width;
  double residual_rms = 0.0;  ///< root mean square of measured minus fitted angle [rad]
  double r_squared = 0.0;     ///< fraction of the angle's variance that the fit explains
  /// Correlation of each residual with the next residual. It is about 0 for white noise. Near 1 the
  /// residual has a shape that the model does not have, such as the shape of a rate limit.
  double residual_correlation = 0.0;
  std::size_t samples = 0;
};

/// Explains the status to the user who recorded the log.
[[nodiscard]] constexpr const char* to_string(ServoIdentificationStatus status) noexcept {
  return detail::name_in({"identified", "times, commands and angles are not of one length",
                          "too few samples", "a time, command or angle is not finite",
                          "the time stamps do not increase", "the command does not move enough",
                          "the fit does not converge", "the angle does not follow the command",
                          "the time constant is too short to be told from zero",
                          "the time constant is longer than looked for, or than the log",
                          "the dead time is longer than looked for",
                          "the angle follows the negative command: is its sign right?",
                          "the gain is implausible: are command and angle in one unit?",
                          "the angle moves before its command: are their times of one clock?"},
                         status);
}

inline void validate(const ServoIdentificationSettings& s) {
  require_non_negative("ServoIdentificationSettings.max_dead_time [s]", s.max_dead_time);
  require(s.max_iterations > 0, "ServoIdentificationSettings.max_iterations", s.max_iterations,
          "> 0");
}

namespace detail {

/// Columns of the response at each stamp, for one time constant and dead time, and their
/// derivatives. It is linear in gain, offset and initial angle. Exact for commands that are held.
struct ServoColumns {
  Eigen::Matrix<double, Eigen::Dynamic, 3> linear;  // n x 3: of gain, offset, initial angle
  Eigen::VectorXd gain_tau, gain_dead, decay_tau;   // d(linear) by time constant and dead time

  template <typename Values>
  ServoColumns(const Values& times, const Values& commands, const Values& stamps,
               double time_constant, double dead_time)
      : linear(stamps.size(), 3),
        gain_tau(stamps.size()),
        gain_dead(stamps.size()),
        decay_tau(stamps.size()) {
    const double rate = 1.0 / time_constant, start = times.front(), first = commands.front();
    double now = start, input = first, angle = 0.0, by_tau = 0.0;
    const auto move_to = [&](double time) {
      const double duration = time - now;
      if (duration <= 0.0) return;
      const double rest = std::exp(-duration * rate);
      by_tau = rest * (by_tau + (angle - input) * duration * rate * rate);
      angle = input + (angle - input) * rest;
      now = time;
    };
    std::size_t next = 1;
    for (std::size_t k = 0; k < stamps.size(); ++k) {
      for (; next < times.size() && times[next] + dead_time <= stamps[k]; ++next) {
        if (commands[next] == input) continue;
        move_to(times[next] + dead_time);
        input = commands[next];
      }
      move_to(stamps[k]);
      const auto row = static_cast<Eigen::Index>(k);
      const double decay = std::exp(-(stamps[k] - start) * rate);
      linear.row(row) << angle, 1.0 - decay, decay;
      gain_tau(row) = by_tau;
      gain_dead(row) = -(input - angle - first * decay) * rate;
      decay_tau(row) = decay * (stamps[k] - start) * rate * rate;
    }
  }
};

}  // namespace detail

/// Angles [rad] of `model` at `stamps` [s], which increase from times[0] on. `commands` [rad] are
/// issued at `times` [s], which increase; both have the same length, at least one. Allocates.
template <typename Values = std::vector<double>>
[[nodiscard]] std::vector<double> servo_response(const ServoModel& model, const Values& times,
                                                 const Values& commands, const Values& stamps) {
  const detail::ServoColumns columns(times, commands, stamps, model.time_constant, model.dead_time);
  const Eigen::VectorXd angles =
      columns.linear.lazyProduct(Eigen::Vector3d(model.gain, model.offset, model.initial_angle));
  return {angles.data(), angles.data() + angles.size()};
}

namespace detail {

using Vector5d = Eigen::Matrix<double, 5, 1>;
using Matrix5d = Eigen::Matrix<double, 5, 5>;

/// Model at one time constant and dead time, with the best gain, offset and initial angle.
template <typename Log>
struct ServoFit {
  ServoColumns columns;
  double time_constant, dead_time;
  Eigen::Vector3d linear;    // gain, offset, initial angle
  Eigen::VectorXd residual;  // measured - fitted
  double cost;               // sum of squared residuals

  ServoFit(const Log& log, double tau, double dead)
      : columns(log.times, log.commands, log.times, tau, dead),
        time_constant(tau),
        dead_time(dead) {
    const Eigen::Map<const Eigen::VectorXd> measured(log.angles.data(), columns.linear.rows());
    // Padded to the size that is factorised elsewhere: each size takes half a second to compile.
    Matrix5d gram = Matrix5d::Identity();
    Vector5d image = Vector5d::Zero();
    gram.topLeftCorner<3, 3>() = columns.linear.transpose().lazyProduct(columns.linear);
    image.head<3>() = columns.linear.transpose().lazyProduct(measured);
    const Vector5d best = gram.ldlt().solve(image);
    linear = best.head<3>();
    residual = measured - columns.linear.lazyProduct(linear);
    cost = residual.squaredNorm();
  }

  /// Jacobian (n x 5) of the angles by gain, offset, initial angle, time constant and dead time.
  /// The last two are in units of the time constant.
  [[nodiscard]] Eigen::Matrix<double, Eigen::Dynamic, 5> jacobian() const {
    Eigen::Matrix<double, Eigen::Dynamic, 5> j(columns.linear.rows(), 5);
    j.leftCols<3>() = columns.linear;
    j.col(3) = time_constant *
               (linear(0) * columns.gain_tau + (linear(2) - linear(1)) * columns.decay_tau);
    j.col(4) = time_constant * linear(0) * columns.gain_dead;
    return j;
  }
};

/// Removes the dead time from J'J.
template <typename Gram>
void hold_dead_time(Gram& gram) {
  gram.row(4).setZero();
  gram.col(4).setZero();
  gram(4, 4) = 1.0;
}

/// Takes one Gauss-Newton step, shortened until the error decreases. Returns false if the error
/// does not decrease further; `fit` is then a minimum.
template <typename Log>
bool improve(ServoFit<Log>& fit, const Log& log, const ServoIdentificationSettings& settings,
             double longest) {
  const auto jacobian = fit.jacobian();  // auto: the type is resolved only when a log is given
  auto gram = jacobian.transpose().lazyProduct(jacobian).eval();
  auto slope = jacobian.transpose().lazyProduct(fit.residual).eval();
  Vector5d step = gram.ldlt().solve(slope);
  // A dead time that would leave its range is set to the end. The others are solved for it.
  const double dead_end = fit.dead_time + step(4) * fit.time_constant;
  if (dead_end < 0.0 || dead_end > settings.max_dead_time) {
    const double end = dead_end < 0.0 ? 0.0 : settings.max_dead_time;
    const double dead_step = (end - fit.dead_time) / fit.time_constant;
    slope -= gram.col(4) * dead_step;
    slope(4) = dead_step;
    hold_dead_time(gram);
    step = gram.ldlt().solve(slope);
  }
  for (double length = 1.0; length > 1e-4; length *= 0.5) {
    const double tau = fit.time_constant * std::exp(std::clamp(length * step(3), -1.0, 1.0));
    const double dead = fit.dead_time + length * step(4) * fit.time_constant;
    ServoFit<Log> next(log, std::clamp(tau, settings.min_time_constant, longest),
                       std::clamp(dead, 0.0, settings.max_dead_time));
    if (!(next.cost < fit.cost)) continue;
    const bool better = next.cost < (1.0 - 1e-10) * fit.cost;
    fit = std::move(next);
    return better;
  }
  return false;
}

/// Square roots of the diagonal of (J'J)^-1, infinite if J'J has no inverse. Uses J with unit
/// columns and scales the result back.
template <typename Log>
Vector5d stddevs(const ServoFit<Log>& fit, bool dead_time_is_free) {
  const auto jacobian = fit.jacobian();
  auto gram = jacobian.transpose().lazyProduct(jacobian).eval();
  if (!dead_time_is_free) hold_dead_time(gram);
  const auto scale = gram.diagonal().cwiseSqrt().cwiseInverse().eval();
  gram = scale.asDiagonal() * gram * scale.asDiagonal();
  const auto cholesky = gram.ldlt();
  if (!(cholesky.vectorD().minCoeff() > 1e-14))
    return Vector5d::Constant(std::numeric_limits<double>::infinity());
  Vector5d roots;
  for (int i = 0; i < 5; ++i) {
    const Vector5d unit = Vector5d::Unit(i), column = cholesky.solve(unit);
    roots(i) = scale(i) * std::sqrt(column(i));
  }
  if (!dead_time_is_free) roots(4) = 0.0;
  return roots;
}

/// Best of the minima that Gauss-Newton finds, with its number of iterations. The starts are dead
/// times on a grid with a spacing of 1/20 of the longest. Each start uses the best of time
/// constants that are a factor of 1.5 apart.
template <typename Log>
std::pair<ServoFit<Log>, int> least_minimum(const Log& log,
                                            const ServoIdentificationSettings& settings,
                                            double longest) {
  std::optional<std::pair<ServoFit<Log>, int>> least;
  const int dead_times = settings.max_dead_time > 0.0 ? 20 : 0;
  for (int i = 0; i <= dead_times; ++i) {
    const double dead_time = i * settings.max_dead_time / 20.0;
    ServoFit<Log> best(log, settings.min_time_constant, dead_time);
    for (double tau = 1.5 * settings.min_time_constant; tau < longest; tau *= 1.5) {
      ServoFit<Log> fit(log, tau, dead_time);
      if (fit.cost < best.cost) best = std::move(fit);
    }
    int iterations = 0;
    while (iterations < settings.max_iterations && improve(best, log, settings, longest))
      ++iterations;
    if (!least || best.cost < least->first.cost) least.emplace(std::move(best), iterations);
  }
  return *std::move(least);
}

/// True if commands that are brought forward, by more than the interval of the samples, leave less
/// than this `cost` without a dead time.
template <typename Log>
bool moves_early(const Log& log, double cost, double longest) {
  constexpr double tolerance = 0.003, step = 0.005, most = 0.2;  // [s]
  const double interval =
      (log.times.back() - log.times.front()) / static_cast<double>(log.times.size());
  for (double early = step; early < most; early += step)
    for (double tau = ServoIdentificationSettings::min_time_constant; tau < longest; tau *= 1.5)
      if (early > tolerance + interval && ServoFit<Log>(log, tau, -early).cost < 0.8 * cost)
        return true;
  return false;
}

/// Returns the reason why `log` is not suitable for a fit, or `identified`.
template <typename Log>
ServoIdentificationStatus check(const Log& log, const ServoIdentificationSettings& settings) {
  using Status = ServoIdentificationStatus;
  const auto &times = log.times, &commands = log.commands;
  if (times.size() != commands.size() || times.size() != log.angles.size())
    return Status::sizes_unequal;
  if (times.size() < static_cast<std::size_t>(settings.min_samples)) return Status::too_few_samples;
  for (const auto* values : {&times, &commands, &log.angles})
    if (!std::all_of(values->begin(), values->end(), [](double x) { return std::isfinite(x); }))
      return Status::not_finite;
  if (std::adjacent_find(times.begin(), times.end(), std::greater_equal<>()) != times.end())
    return Status::stamps_not_increasing;
  const auto [low, high] = std::minmax_element(commands.begin(), commands.end());
  if (*high - *low < settings.min_excitation) return Status::command_constant;
  if (std::all_of(log.angles.begin(), log.angles.end(),
                  [&log](double angle) { return angle == log.angles.front(); }))
    return Status::no_response;
  if (times.back() - times.front() <= settings.min_time_constant)
    return Status::time_constant_too_long;
  return Status::identified;
}

}  // namespace detail

/// Identifies the servo that fits `log` best, by least squares of the output error. The response is
/// exact for commands that are held between their stamps. Gain, offset and initial angle follow
/// linearly from time constant and dead time (variable projection: Golub & Pereyra 1973).
/// Gauss-Newton finds time constant and dead time (Kaufman 1975). Over the dead time the error has
/// many minima, from periodic commands and from kinks. The search therefore starts from dead times
/// over the whole range and returns the best minimum.
///
/// Any motion of the servo is suitable. Several steps, each held for some time constants, are best.
/// The steps must be small, below rate limit times time constant, because the model has no rate
/// limit. With an active limit the time constant is too long and residual_correlation near 1.
///
/// Confidence intervals follow from Gauss-Newton: 1.96 sqrt(diag(s^2 (J'J)^-1)). They are widened
/// by sqrt((1 + c) / (1 - c)) if the residuals have a correlation c > 0 (Bartlett 1935). The
/// interval of the dead time is approximate. The angle has a kink where the command jumps, and the
/// dead time determines which samples lie behind the kink.
///
/// Allocates. Takes about 10 us per sample. Throws std::invalid_argument if a setting is out of
/// range. Does not throw for a bad log; the status reports it.
template <typename Log = ServoLog>
[[nodiscard]] ServoIdentification identify_servo(const Log& log,
                                                 const ServoIdentificationSettings& settings = {}) {
  using Status = ServoIdentificationStatus;
  validate(settings);
  ServoIdentification result;
  result.samples = log.times.size();
  result.status = detail::check(log, settings);
  if (result.status != Status::identified) return result;

  const double longest = std::min(settings.max_time_constant, log.times.back() - log.times.front());
  const auto [fit, iterations] = detail::least_minimum(log, settings, longest);
  const auto n = fit.residual.size();
  const double tau = fit.time_constant;
  result.model = {tau, fit.dead_time, fit.linear(0), fit.linear(1), fit.linear(2)};
  result.residual_rms = std::sqrt(fit.cost / static_cast<double>(n));
  const Eigen::Map<const Eigen::ArrayXd> measured(log.angles.data(), n);
  result.r_squared = 1.0 - fit.cost / (measured - measured.mean()).square().sum();
  if (fit.cost > 0.0)
    result.residual_correlation = fit.residual.head(n - 1).dot(fit.residual.tail(n - 1)) / fit.cost;

  const bool dead_time_is_free = settings.max_dead_time > 0.0;
  const double c = std::max(result.residual_correlation, 0.0);
  const double degrees = static_cast<double>(n - (dead_time_is_free ? 5 : 4));
  const double stddev = std::sqrt(fit.cost / degrees * (1.0 + c) / (1.0 - c));
  detail::Vector5d half_width = 1.96 * stddev * detail::stddevs(fit, dead_time_is_free);
  result.half_width = {tau * half_width(3), tau * half_width(4), half_width(0), half_width(1),
                       half_width(2)};

  if (iterations == settings.max_iterations || !std::isfinite(fit.cost))
    result.status = Status::no_convergence;
  else if (!(1.96 * std::abs(result.model.gain) >=
             settings.min_significance * result.half_width.gain))
    result.status = Status::no_response;
  else if (dead_time_is_free && fit.dead_time == 0.0 && detail::moves_early(log, fit.cost, longest))
    result.status = Status::angle_early;
  else if (tau >= longest)
    result.status = Status::time_constant_too_long;
  else if (tau <= settings.min_time_constant || !(result.half_width.time_constant < tau))
    result.status = Status::time_constant_too_short;
  else if (dead_time_is_free && fit.dead_time >= settings.max_dead_time)
    result.status = Status::dead_time_too_long;
  else if (result.model.gain < 0.0)
    result.status = Status::reversed;
  else if (result.model.gain < 0.1 || result.model.gain > 10.0)
    result.status = Status::implausible_gain;
  return result;
}

}  // namespace tilt_ropter
