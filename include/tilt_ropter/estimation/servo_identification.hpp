// SPDX-License-Identifier: BSD-3-Clause
#pragma once

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

/// What was recorded: arrays of one length, stamps increasing but as unevenly spaced as they like.
/// The functions below take any `Log` with these members, such as views into a larger record: they
/// are templates so that only those who call them wait for the compiler.
struct ServoLog {
  std::vector<double> times;     ///< [s]
  std::vector<double> commands;  ///< [rad], each held until the next
  std::vector<double> angles;    ///< measured [rad]
};

/// d(angle)/dt = (gain * command(t - dead_time) + offset - angle) / time_constant. Before the first
/// stamp of a log the command is taken to have been as at that stamp.
struct ServoModel {
  double time_constant = 0.0;  ///< [s]
  double dead_time = 0.0;      ///< [s]
  double gain = 0.0;           ///< [rad/rad]
  double offset = 0.0;         ///< [rad]
  double initial_angle = 0.0;  ///< at the first stamp of the log [rad]
};

/// Where identify_servo() searches and what it asks of a log.
struct ServoIdentificationSettings {
  double min_time_constant = 0.002;  ///< shortest that is looked for [s]
  double max_time_constant = 2.0;    ///< longest; never longer than the log [s]
  double max_dead_time = 0.2;        ///< longest that is looked for; 0: there is none [s]
  double min_excitation = 0.01;      ///< largest minus smallest command [rad]
  double min_significance = 5.0;     ///< gain / its standard deviation
  int min_samples = 20;
  int max_iterations = 100;  ///< of Gauss-Newton, from each start
};

/// Whether the servo was identified and, if not, why.
enum class ServoIdentificationStatus {
  identified,
  // Refused before the fit:
  sizes_unequal,
  too_few_samples,
  not_finite,
  stamps_not_increasing,
  command_constant,
  // Refused after it, which is reported, but not to be trusted:
  no_convergence,
  no_response,
  time_constant_too_short,
  time_constant_too_long,
  dead_time_too_long,
};

/// What identify_servo() found.
struct ServoIdentification {
  ServoIdentificationStatus status = ServoIdentificationStatus::no_convergence;
  ServoModel model;
  /// Half-widths of the 95 % confidence intervals around `model`.
  ServoModel half_width;
  double residual_rms = 0.0;  ///< of measured minus fitted angle [rad]
  double r_squared = 0.0;     ///< share of the angle's variance that the fit explains
  /// Of each residual with the next: about 0 for white noise; towards 1 the residual has a shape
  /// that the model has not, such as that of a rate limit.
  double residual_correlation = 0.0;
  std::size_t samples = 0;
};

/// What the status says to whoever made the log.
[[nodiscard]] inline const char* to_string(ServoIdentificationStatus status) {
  switch (status) {
    case ServoIdentificationStatus::identified:
      return "identified";
    case ServoIdentificationStatus::sizes_unequal:
      return "times, commands and angles are not of one length";
    case ServoIdentificationStatus::too_few_samples:
      return "too few samples";
    case ServoIdentificationStatus::not_finite:
      return "a time, command or angle is not finite";
    case ServoIdentificationStatus::stamps_not_increasing:
      return "the time stamps do not increase";
    case ServoIdentificationStatus::command_constant:
      return "the command does not move enough";
    case ServoIdentificationStatus::no_convergence:
      return "the fit does not converge";
    case ServoIdentificationStatus::no_response:
      return "the angle does not follow the command";
    case ServoIdentificationStatus::time_constant_too_short:
      return "the time constant is too short to be told from zero";
    case ServoIdentificationStatus::time_constant_too_long:
      return "the time constant is longer than looked for, or than the log";
    case ServoIdentificationStatus::dead_time_too_long:
      return "the dead time is longer than looked for";
  }
  return "unknown";
}

inline void validate(const ServoIdentificationSettings& s) {
  require_positive("ServoIdentificationSettings.min_time_constant [s]", s.min_time_constant);
  require(std::isfinite(s.max_time_constant) && s.max_time_constant > s.min_time_constant,
          "ServoIdentificationSettings.max_time_constant [s]", s.max_time_constant,
          "finite and > min_time_constant");
  require_non_negative("ServoIdentificationSettings.max_dead_time [s]", s.max_dead_time);
  require_positive("ServoIdentificationSettings.min_excitation [rad]", s.min_excitation);
  require_non_negative("ServoIdentificationSettings.min_significance", s.min_significance);
  require(s.min_samples >= 6, "ServoIdentificationSettings.min_samples", s.min_samples, ">= 6");
  require(s.max_iterations > 0, "ServoIdentificationSettings.max_iterations", s.max_iterations,
          "> 0");
}

namespace detail {

/// The response is linear in gain, offset and initial angle; these are its columns at each stamp
/// for one time constant and dead time, exact for commands that are held, and their derivatives.
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

/// Angles [rad] of `model` at `stamps` [s] (increasing, from times[0] on) under the commands [rad]
/// issued at `times` [s] (increasing, as many, at least one). Allocates.
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

/// The model at one time constant and dead time with the gain, offset and initial angle that fit
/// best there.
template <typename Log>
struct ServoFit {
  ServoColumns columns;
  double time_constant, dead_time;
  Eigen::Vector3d linear;    // gain, offset, initial angle
  Eigen::VectorXd residual;  // measured - fitted
  double cost;               // sum of its squares

  ServoFit(const Log& log, double tau, double dead)
      : columns(log.times, log.commands, log.times, tau, dead),
        time_constant(tau),
        dead_time(dead) {
    const Eigen::Map<const Eigen::VectorXd> measured(log.angles.data(), columns.linear.rows());
    // Filled up to the size that is factorised elsewhere: each size costs half a second to compile.
    Matrix5d gram = Matrix5d::Identity();
    Vector5d image = Vector5d::Zero();
    gram.topLeftCorner<3, 3>() = columns.linear.transpose().lazyProduct(columns.linear);
    image.head<3>() = columns.linear.transpose().lazyProduct(measured);
    const Vector5d best = gram.ldlt().solve(image);
    linear = best.head<3>();
    residual = measured - columns.linear.lazyProduct(linear);
    cost = residual.squaredNorm();
  }

  /// n x 5: of the angles by gain, offset, initial angle and, in units of the time constant, by
  /// time constant and dead time.
  [[nodiscard]] Eigen::Matrix<double, Eigen::Dynamic, 5> jacobian() const {
    Eigen::Matrix<double, Eigen::Dynamic, 5> j(columns.linear.rows(), 5);
    j.leftCols<3>() = columns.linear;
    j.col(3) = time_constant *
               (linear(0) * columns.gain_tau + (linear(2) - linear(1)) * columns.decay_tau);
    j.col(4) = time_constant * linear(0) * columns.gain_dead;
    return j;
  }
};

/// Takes the dead time out of J'J.
template <typename Gram>
void hold_dead_time(Gram& gram) {
  gram.row(4).setZero();
  gram.col(4).setZero();
  gram(4, 4) = 1.0;
}

/// One step of Gauss-Newton, shortened until the error decreases. False if it does so no more:
/// `fit` is a minimum then.
template <typename Log>
bool improve(ServoFit<Log>& fit, const Log& log, const ServoIdentificationSettings& settings,
             double longest) {
  const auto jacobian = fit.jacobian();  // auto: of a type that no compiler knows without a log
  auto gram = jacobian.transpose().lazyProduct(jacobian).eval();
  auto slope = jacobian.transpose().lazyProduct(fit.residual).eval();
  Vector5d step = gram.ldlt().solve(slope);
  // A dead time that would leave its range goes to the end of it, and the others follow that.
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

/// Roots of the diagonal of (J'J)^-1, infinite if it has none: J of unit columns, scaled back.
template <typename Log>
Vector5d deviations(const ServoFit<Log>& fit, bool dead_time_is_free) {
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

template <typename Log>
struct ServoMinimum {
  ServoFit<Log> fit;
  int iterations;
};

/// The least of the minima that Gauss-Newton finds from each dead time of a grid, 1/20 of the
/// longest apart, and there from the best of time constants a factor of 1.5 apart.
template <typename Log>
ServoMinimum<Log> least_minimum(const Log& log, const ServoIdentificationSettings& settings,
                                double longest) {
  std::optional<ServoMinimum<Log>> least;
  const int dead_times = settings.max_dead_time > 0.0 ? 20 : 0;
  for (int i = 0; i <= dead_times; ++i) {
    const double dead_time = i * settings.max_dead_time / 20.0;
    ServoMinimum<Log> minimum{ServoFit<Log>(log, settings.min_time_constant, dead_time), 0};
    for (double tau = 1.5 * settings.min_time_constant; tau < longest; tau *= 1.5) {
      ServoFit<Log> fit(log, tau, dead_time);
      if (fit.cost < minimum.fit.cost) minimum.fit = std::move(fit);
    }
    while (minimum.iterations < settings.max_iterations &&
           improve(minimum.fit, log, settings, longest))
      ++minimum.iterations;
    if (!least || minimum.fit.cost < least->fit.cost) least = std::move(minimum);
  }
  return *std::move(least);
}

/// Why `log` is not worth a fit, or `identified`.
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

/// The servo that fits `log` best: least squares over the output error, exact for commands that are
/// held between their stamps. Gain, offset and initial angle follow linearly from time constant and
/// dead time (variable projection: Golub & Pereyra 1973), which Gauss-Newton finds (Kaufman 1975).
/// Over the dead time the error has many minima, from periodic commands and from kinks: the search
/// starts from dead times all over the range, and the least minimum counts.
///
/// Anything that moves the servo will do, best several steps, each held for some time constants.
/// They have to be small, below rate limit times time constant, for the model has no rate limit: a
/// log with that limit in it gives too long a time constant and a residual_correlation near 1.
///
/// Confidence intervals are those of Gauss-Newton, 1.96 sqrt(diag(s^2 (J'J)^-1)), widened by
/// sqrt((1 + c) / (1 - c)) where the residuals have a correlation c > 0 (Bartlett 1935). That of
/// the dead time is approximate: where the command jumps the angle has a kink, and which samples
/// lie behind it changes with the dead time.
///
/// Allocates, and takes about 10 us for each sample. Throws std::invalid_argument for settings out
/// of range, and nothing for a bad log, which the status tells.
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
  const double deviation = std::sqrt(fit.cost / degrees * (1.0 + c) / (1.0 - c));
  detail::Vector5d half_width = 1.96 * deviation * detail::deviations(fit, dead_time_is_free);
  result.half_width = {tau * half_width(3), tau * half_width(4), half_width(0), half_width(1),
                       half_width(2)};

  if (iterations == settings.max_iterations || !std::isfinite(fit.cost))
    result.status = Status::no_convergence;
  else if (!(1.96 * std::abs(result.model.gain) >=
             settings.min_significance * result.half_width.gain))
    result.status = Status::no_response;
  else if (tau >= longest)
    result.status = Status::time_constant_too_long;
  else if (tau <= settings.min_time_constant || !(result.half_width.time_constant < tau))
    result.status = Status::time_constant_too_short;
  else if (dead_time_is_free && fit.dead_time >= settings.max_dead_time)
    result.status = Status::dead_time_too_long;
  return result;
}

}  // namespace tilt_ropter
