// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

/// Time constant and dead time of the rotors of a VehicleLog, from their measured speeds.
namespace tilt_ropter::detail {

/// Sum of the covariances of the scores up to a distance of `block`, with falling weights
/// (Bartlett's window), so that correlated scores are weighted correctly.
template <typename Score>
[[nodiscard]] auto spread_of(const std::vector<Score>& scores, std::size_t block) {
  constexpr int n = Score::RowsAtCompileTime;
  Eigen::Matrix<double, n, n> spread = Eigen::Matrix<double, n, n>::Zero();
  Score sum = Score::Zero();
  for (std::size_t k = 0; k < scores.size() + block; ++k) {
    if (k < scores.size()) sum += scores[k];
    if (k >= block) sum -= scores[k - block];
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) spread(i, j) += sum(i) * sum(j) / static_cast<double>(block);
  }
  return spread;
}

/// Lag of rotor `i`: `log_scale` is the logarithm of the ratio to its given time constant.
template <int Rotors>
[[nodiscard]] LagModel rotor_lag(const Vehicle<Rotors>& given, int i, double log_scale,
                                 double dead_time) {
  return {rotor_parameters(given, static_cast<std::size_t>(i)).time_constant * std::exp(log_scale),
          dead_time};
}

/// Least squares of the measured speeds. Rotor i has the time constant of the given vehicle times
/// exp(log_scale).
template <int Rotors>
class RotorLagFit {
 public:
  using RotorVector = Eigen::Matrix<double, Rotors, 1>;
  // Depends on Rotors, so that only code that fits a vehicle compiles its algebra.
  using Matrix2 = Eigen::Matrix<double, 2 + 0 * Rotors, 2 + 0 * Rotors>;

  double log_scale = 0.0, dead_time = 0.0;  ///< [-], [s]
  Matrix2 covariance = Matrix2::Identity();

  /// Fits a log that contains measured speeds. Log and vehicle must outlive this.
  RotorLagFit(const VehicleLog<Rotors>& log, const Vehicle<Rotors>& given, int max_iterations)
      : log_(log), given_(given) {
    fit(max_iterations);
  }

  /// Slow part of measured minus modelled speed at each IMU sample: mean over 0.6 s. The model
  /// gives the fast part, so that the noise of the measured speeds does not reach the thrusts.
  [[nodiscard]] std::vector<RotorVector> speed_corrections() const {
    const auto& measured = log_.rotor_speeds;
    std::vector<RotorVector> sums(measured.size() + 1, RotorVector::Zero());
    for (int i = 0; i < Rotors; ++i)
      replay(
          log_.commands, measured, rotor_lag(given_, i, log_scale, dead_time),
          [i](const ActuatorState<Rotors>& c) { return c.rotor_speed(i); },
          [&](std::size_t j, double value, double) {
            sums[j + 1](i) = sums[j](i) + measured[j].value(i) - value;
          });
    std::vector<RotorVector> corrections(log_.imu.size());
    for (std::size_t j = 0; j < log_.imu.size(); ++j) {
      const double time = log_.imu[j].time;
      const std::size_t from = index_before(measured, time - 0.3);
      const std::size_t until = std::max(from, index_before(measured, time + 0.3)) + 1;
      corrections[j] = (sums[until] - sums[from]) / static_cast<double>(until - from);
    }
    return corrections;
  }

 private:
  /// Measured minus modelled speeds at the stamps of the measurements, without each rotor's gain
  /// and offset.
  [[nodiscard]] std::vector<RotorVector> speed_residuals(double scale, double delay) const {
    const auto& measured = log_.rotor_speeds;
    std::vector<RotorVector> residuals(measured.size());
    for (int i = 0; i < Rotors; ++i) {
      std::vector<double> model(measured.size());
      replay(
          log_.commands, measured, rotor_lag(given_, i, scale, delay),
          [i](const ActuatorState<Rotors>& c) { return c.rotor_speed(i); },
          [&](std::size_t j, double value, double) { model[j] = value; });
      double count = 0.0, sum = 0.0, sum_y = 0.0, square = 0.0, product = 0.0;
      const double start = log_.commands.front().time + 0.5;
      for (std::size_t j = 0; j < model.size(); ++j) {
        if (measured[j].time < start) continue;
        const double y = measured[j].value(i) - model[j];
        count += 1.0;
        sum += model[j];
        sum_y += y;
      }
      const double mean = sum / std::max(count, 1.0), mean_y = sum_y / std::max(count, 1.0);
      for (std::size_t j = 0; j < model.size(); ++j) {
        if (measured[j].time < start) continue;
        square += (model[j] - mean) * (model[j] - mean);
        product += (model[j] - mean) * (measured[j].value(i) - model[j] - mean_y);
      }
      const double gain = square > count ? product / square : 0.0;
      for (std::size_t j = 0; j < model.size(); ++j)
        residuals[j](i) = measured[j].time < start
                              ? 0.0
                              : measured[j].value(i) - model[j] - mean_y - gain * (model[j] - mean);
    }
    return residuals;
  }

  void fit(int max_iterations) {
    const auto cost_of = [](const std::vector<RotorVector>& r) {
      double sum = 0.0;
      for (const RotorVector& entry : r) sum += entry.squaredNorm();
      return sum;
    };
    Eigen::Vector2d x(0.0, 0.0);
    std::vector<RotorVector> residuals = speed_residuals(x(0), x(1));
    double cost = cost_of(residuals);
    const double count = std::max(1.0, static_cast<double>(Rotors * residuals.size()));
    const Eigen::Vector2d steps(1e-3, 1e-4), prior(1.0, 0.05);
    Matrix2 inverse = Matrix2::Identity(), spread = Matrix2::Zero();
    for (int iteration = 0; iteration < max_iterations; ++iteration) {
      std::array<std::vector<RotorVector>, 2> slopes;
      for (int p = 0; p < 2; ++p) {
        Eigen::Vector2d more = x, less = x;
        more(p) += steps(p);
        less(p) -= steps(p);
        const auto high = speed_residuals(more(0), more(1));
        slopes[static_cast<std::size_t>(p)] = speed_residuals(less(0), less(1));
        for (std::size_t j = 0; j < high.size(); ++j)
          slopes[static_cast<std::size_t>(p)][j] =
              (slopes[static_cast<std::size_t>(p)][j] - high[j]) / (2.0 * steps(p));
      }
      const double variance = std::max(cost / count, 1e-12);
      Matrix2 information = Eigen::Vector2d(prior.cwiseProduct(prior).cwiseInverse()).asDiagonal();
      spread = information;
      Eigen::Vector2d slope = Eigen::Vector2d::Zero();
      constexpr std::size_t block = 100;
      std::vector<Eigen::Vector2d> scores(residuals.size());
      for (std::size_t j = 0; j < residuals.size(); ++j) {
        for (int p = 0; p < 2; ++p) {
          scores[j](p) = slopes[static_cast<std::size_t>(p)][j].dot(residuals[j]) / variance;
          for (int q = 0; q < 2; ++q)
            information(p, q) +=
                slopes[static_cast<std::size_t>(p)][j].dot(slopes[static_cast<std::size_t>(q)][j]) /
                variance;
        }
        slope += scores[j];
      }
      spread += spread_of(scores, block);
      inverse = information.inverse();
      Eigen::Vector2d step = inverse * slope;
      step(0) = std::clamp(step(0), -0.7, 0.7);
      step(1) = std::clamp(step(1), -0.02, 0.02);
      double length = 1.0;
      for (; length > 1e-3; length *= 0.5) {
        auto next = speed_residuals(x(0) + length * step(0), x(1) + length * step(1));
        const double next_cost = cost_of(next);
        if (!(next_cost < cost)) continue;
        x += length * step;
        cost = next_cost;
        residuals = std::move(next);
        break;
      }
      if (length <= 1e-3 || std::abs(step(0)) + 50.0 * std::abs(step(1)) < 1e-5) break;
    }
    covariance = inverse * spread * inverse;
    covariance.diagonal() += Eigen::Vector2d(1e-12, 1e-16);
    log_scale = x(0);
    dead_time = x(1);
  }

  const VehicleLog<Rotors>& log_;
  const Vehicle<Rotors>& given_;
};

}  // namespace tilt_ropter::detail
