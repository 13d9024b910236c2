// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/identification/detail/window_model.hpp>
#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

/// Least squares of identify_vehicle(): fits WindowModel to a log.
namespace tilt_ropter::detail {

inline constexpr int max_fit_iterations = 30;  ///< steps of one least-squares solution

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

/// Time constant and dead time of the rotors by least squares of their measured speeds. Rotor i has
/// the time constant of the given vehicle times exp(log_scale).
template <int Rotors>
class RotorLagFit {
 public:
  using RotorVector = Eigen::Matrix<double, Rotors, 1>;
  // Depends on Rotors, so that only code that fits a vehicle compiles its algebra.
  using Matrix2 = Eigen::Matrix<double, 2 + 0 * Rotors, 2 + 0 * Rotors>;

  double log_scale = 0.0, dead_time = 0.0;  ///< [-], [s]
  Matrix2 covariance = Matrix2::Identity();

  /// Fits a log that contains measured speeds. Log and vehicle must outlive this.
  RotorLagFit(const VehicleLog<Rotors>& log, const Vehicle<Rotors>& given)
      : log_(log), given_(given) {
    fit();
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
  /// Measured minus modelled speeds at the measured stamps, without each rotor's gain and offset.
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

  void fit() {
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
    for (int iteration = 0; iteration < max_fit_iterations; ++iteration) {
      std::vector<RotorVector> slopes[2];
      for (int p = 0; p < 2; ++p) {
        Eigen::Vector2d more = x, less = x;
        more(p) += steps(p);
        less(p) -= steps(p);
        const auto high = speed_residuals(more(0), more(1));
        slopes[p] = speed_residuals(less(0), less(1));
        for (std::size_t j = 0; j < high.size(); ++j)
          slopes[p][j] = (slopes[p][j] - high[j]) / (2.0 * steps(p));
      }
      const double variance = std::max(cost / count, 1e-12);
      Matrix2 information = Eigen::Vector2d(prior.cwiseProduct(prior).cwiseInverse()).asDiagonal();
      spread = information;
      Eigen::Vector2d slope = Eigen::Vector2d::Zero();
      constexpr std::size_t block = 100;
      std::vector<Eigen::Vector2d> scores(residuals.size());
      for (std::size_t j = 0; j < residuals.size(); ++j) {
        for (int p = 0; p < 2; ++p) {
          scores[j](p) = slopes[p][j].dot(residuals[j]) / variance;
          for (int q = 0; q < 2; ++q)
            information(p, q) += slopes[p][j].dot(slopes[q][j]) / variance;
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

template <int Rotors>
class VehicleFit {
 public:
  using I = FitIndex;
  using Model = WindowModel<Rotors>;
  // The sizes depend on Rotors, so that only code that fits a vehicle compiles their algebra.
  using FitVector = Eigen::Matrix<double, I::count + 0 * Rotors, 1>;
  using FitMatrix = Eigen::Matrix<double, I::count + 0 * Rotors, I::count + 0 * Rotors>;
  using Matrix2 = Eigen::Matrix<double, 2 + 0 * Rotors, 2 + 0 * Rotors>;

  /// As for WindowModel.
  VehicleFit(const VehicleLog<Rotors>& log, const Vehicle<Rotors>& given, bool trust_mass,
             double min_height, const Eigen::Vector3d& imu_position)
      : log_(log), given_(given), model_(log, given, trust_mass, min_height, imu_position) {
    set_prior();
    if (log.rotor_speeds.empty()) return;
    const RotorLagFit<Rotors> lag(log, given_);
    rotor_lag_covariance_ = lag.covariance;
    x_(I::rotor_lag) = prior_(I::rotor_lag) = lag.log_scale;
    x_(I::rotor_delay) = prior_(I::rotor_delay) = lag.dead_time;
    prior_stddev_(I::rotor_lag) = std::sqrt(lag.covariance(0, 0));
    prior_stddev_(I::rotor_delay) = std::sqrt(lag.covariance(1, 1));
    model_.set_speed_corrections(lag.speed_corrections());
  }

  [[nodiscard]] const std::vector<FlightWindow>& windows() const { return model_.windows(); }
  [[nodiscard]] const FitVector& unknowns() const { return x_; }
  [[nodiscard]] const FitVector& stddevs() const { return stddevs_; }
  [[nodiscard]] bool holds(int i) const { return held_[static_cast<std::size_t>(i)]; }
  /// Duration of all windows together [s].
  [[nodiscard]] double duration() const {
    return static_cast<double>(windows().size()) * model_.flight().hop();
  }
  /// Root mean square of the residuals: specific force x y z [m/s^2], angular acceleration x y z
  /// [rad/s^2], vertical acceleration [m/s^2].
  [[nodiscard]] const std::array<double, 7>& residual_rms() const { return rms_; }
  /// Specific force and angular acceleration that the fit predicts in each window.
  [[nodiscard]] const std::vector<double>& predicted() const { return predicted_; }
  /// Fraction of the samples in which a servo turns at its rate limit.
  [[nodiscard]] double rate_limited() const { return features_.rate_limited; }

  /// Holds unknown `i` at the value of the given vehicle.
  void hold(int i) {
    held_[static_cast<std::size_t>(i)] = true;
    x_(i) = i == I::servo_delay ? given_.servo.dead_time : 0.0;
  }

  /// Finds the unknowns that are not held by the Levenberg-Marquardt method, and their standard
  /// deviations. Returns false if it does not converge.
  bool solve() {
    // The arms' own motion is confused with the noise in the commands: it waits for refine().
    const std::array<bool, at_most> held = held_;
    for (const int i : {I::arm_inertia, I::arm_moment}) hold(i);
    bool converged = false;
    for (int round = 0; round < 2; ++round) {
      converged = minimise();
      set_rms();  // the weights of the next round
    }
    held_ = held;
    set_jacobian();
    set_stddevs(jacobian_);
    return converged;
  }

  /// Takes out the error that the controller causes: its commands react to the noise of the IMU, so
  /// the model's derivatives in a window are correlated with the noise in this window. The method
  /// of instrumental variables multiplies the residuals with derivatives that are extrapolated from
  /// commands before the window (Soderstrom & Stoica 1983). Returns false if it fails.
  bool refine() {
    FitMatrix information;
    FitVector slope;
    std::vector<std::vector<double>> instruments;
    const FitVector before = x_;
    double length = 1.0, last = std::numeric_limits<double>::infinity();
    for (int iteration = 0; iteration < 15; ++iteration) {
      set_jacobian();
      instruments = instruments_of(jacobian_);
      set_normal_equations(instruments, information, slope, nullptr);
      FitVector step = information.partialPivLu().solve(slope);
      for (int i = 0; i < I::count; ++i) {
        step(i) = held_[at(i)] ? 0.0 : std::clamp(step(i), -longest_(i), longest_(i));
      }
      const double size = step.cwiseQuotient(stddevs_).cwiseAbs().maxCoeff();
      if (size > 0.7 * last) length *= 0.5;  // ends cycles
      last = size;
      move_to(x_ + length * step);
      set_rms();
      if (!(size < 0.05)) continue;
      set_stddevs(instruments);
      return true;
    }
    move_to(before);
    set_jacobian();
    set_stddevs(instruments_of(jacobian_));
    return false;
  }

 private:
  [[nodiscard]] static std::size_t at(int i) { return static_cast<std::size_t>(i); }

  void set_prior() {
    prior_.setZero();
    x_.setZero();
    x_(I::servo_delay) = prior_(I::servo_delay) = given_.servo.dead_time;
    prior_stddev_.setOnes();
    prior_stddev_.template segment<3>(I::com).setConstant(0.1);
    prior_stddev_(I::servo_delay) = prior_stddev_(I::rotor_delay) = 0.05;
    prior_stddev_.template segment<3>(I::drag).setConstant(5.0 * given_.body.mass);
    prior_stddev_(I::arm_inertia) = 0.5 * given_.body.inertia.trace() / 3.0;
    prior_stddev_(I::arm_moment) = 0.02 * given_.body.mass;
    prior_stddev_.template segment<2>(I::wind).setConstant(0.3 * given_.body.mass * gravity);
    stddevs_ = prior_stddev_;
    longest_ = 0.4 * prior_stddev_;
  }

  /// Residual in standard deviations, and its weight: beyond four they count less (Huber 1964).
  [[nodiscard]] std::pair<double, double> residual(std::size_t row) const {
    const double r = (model_.measured(row) - predicted_[row]) / rms_[model_.group(row)];
    return {r, std::abs(r) > 4.0 ? 4.0 / std::abs(r) : 1.0};
  }
  [[nodiscard]] double cost() const {
    double sum = 0.0;
    for (std::size_t row = 0; row < predicted_.size(); ++row) {
      const auto [r, weight] = residual(row);
      sum += weight < 1.0 ? 8.0 * std::abs(r) - 16.0 : r * r;
    }
    FitVector off = x_ - prior_;
    for (int i = 0; i < I::count; ++i)
      if (held_[at(i)]) off(i) = 0.0;
    return sum + off.dot(prior_information() * off);
  }

  /// Derivatives of all predictions by the unknowns that are not held.
  void set_jacobian() {
    jacobian_.resize(I::count);
    std::vector<double> less;
    for (int i = 0; i < I::count; ++i) {
      if (held_[at(i)]) continue;
      const bool moves_actuators = i >= I::servo_lag && i <= I::rotor_delay;
      const double step = moves_actuators ? (i % 2 == 0 ? 2e-3 : 1e-4) : 1e-6;
      FitVector high = x_, low = x_;
      high(i) += step;
      low(i) -= step;
      model_.predict(high, moves_actuators ? model_.features_of(high) : features_,
                     jacobian_[at(i)]);
      if (moves_actuators) model_.predict(low, model_.features_of(low), less);
      const std::vector<double>& from = moves_actuators ? less : predicted_;
      const double rate = 1.0 / (moves_actuators ? 2.0 * step : step);
      for (std::size_t row = 0; row < from.size(); ++row)
        jacobian_[at(i)][row] = rate * (jacobian_[at(i)][row] - from[row]);
    }
  }

  /// Least-squares prediction of each derivative from windows that end where its window begins, or
  /// earlier. Zero where these windows are missing.
  [[nodiscard]] std::vector<std::vector<double>> instruments_of(
      const std::vector<std::vector<double>>& jacobian) const {
    constexpr int lags = 6;
    constexpr std::size_t lag[lags] = {4, 5, 6, 8, 10, 13};  // a window covers four distances
    using LagVector = Eigen::Matrix<double, lags, 1>;
    std::vector<std::vector<double>> instruments = jacobian;
    for (int i = 0; i < I::count; ++i) {
      if (held_[at(i)]) continue;
      for (std::size_t part = 0; part < 6; ++part) {
        const auto value = [&](std::size_t k) { return jacobian[at(i)][6 * k + part]; };
        const auto past = [&](std::size_t k, LagVector& values) {
          if (k < lag[lags - 1]) return false;
          const double passed = windows()[k].time - windows()[k - lag[lags - 1]].time;
          for (int l = 0; l < lags; ++l) values(l) = value(k - lag[l]);
          return passed < (static_cast<double>(lag[lags - 1]) + 0.5) * model_.flight().hop();
        };
        Eigen::Matrix<double, lags, lags> gram;
        gram.setZero();
        LagVector image = LagVector::Zero(), values;
        for (std::size_t k = 0; k < windows().size(); ++k) {
          if (!past(k, values)) continue;
          for (int l = 0; l < lags; ++l) {
            image(l) += values(l) * value(k);
            for (int m = 0; m < lags; ++m) gram(l, m) += values(l) * values(m);
          }
        }
        gram.diagonal().array() += 1e-9 * gram.trace() + 1e-300;
        const LagVector weights = gram.ldlt().solve(image);
        for (std::size_t k = 0; k < windows().size(); ++k)
          instruments[at(i)][6 * k + part] = past(k, values) ? weights.dot(values) : 0.0;
      }
    }
    return instruments;
  }

  /// Normal equations, with `instruments` in place of one of the two Jacobians. The rows of
  /// unknowns that are held are those of the identity.
  void set_normal_equations(const std::vector<std::vector<double>>& instruments,
                            FitMatrix& information, FitVector& slope,
                            std::vector<FitVector>* scores) const {
    information.setZero();
    slope.setZero();
    if (scores != nullptr) scores->assign(windows().size(), FitVector::Zero());
    for (std::size_t row = 0; row < predicted_.size(); ++row) {
      const auto [r, weight] = residual(row);
      const double scale = 1.0 / rms_[model_.group(row)];
      FitVector left = FitVector::Zero(), right = FitVector::Zero();
      for (int i = 0; i < I::count; ++i) {
        if (held_[at(i)]) continue;
        left(i) = weight * scale * instruments[at(i)][row];
        right(i) = scale * jacobian_[at(i)][row];
      }
      for (int i = 0; i < I::count; ++i) {
        if (held_[at(i)]) continue;
        slope(i) += left(i) * r;
        for (int j = 0; j < I::count; ++j) information(i, j) += left(i) * right(j);
        if (scores == nullptr) continue;
        (*scores)[model_.window_of(row)](i) += left(i) * r;
      }
    }
    const FitMatrix prior = prior_information();
    for (int i = 0; i < I::count; ++i)
      for (int j = 0; j < I::count; ++j) {
        information(i, j) += prior(i, j);
        if (!held_[at(i)] && !held_[at(j)]) slope(i) += prior(i, j) * (prior_(j) - x_(j));
      }
  }

  /// Inverse covariance of what is known without the windows; the identity for held unknowns.
  [[nodiscard]] FitMatrix prior_information() const {
    FitMatrix prior = FitMatrix::Zero();
    for (int i = 0; i < I::count; ++i)
      prior(i, i) = held_[at(i)] ? 1.0 : 1.0 / (prior_stddev_(i) * prior_stddev_(i));
    const int lag = I::rotor_lag, delay = I::rotor_delay;
    if (log_.rotor_speeds.empty() || held_[at(lag)] || held_[at(delay)]) return prior;
    prior.template block<2, 2>(lag, lag) = rotor_lag_covariance_.inverse();
    return prior;
  }

  /// Sets the unknowns and what follows from them.
  void move_to(const FitVector& x) {
    x_ = x;
    features_ = model_.features_of(x_);
    model_.predict(x_, features_, predicted_);
  }

  bool minimise() {
    double damping = 1e-6;
    move_to(x_);
    double now = cost();
    FitMatrix information;
    FitVector slope;
    for (int iteration = 0; iteration < max_fit_iterations; ++iteration) {
      set_jacobian();
      set_normal_equations(jacobian_, information, slope, nullptr);
      const FitVector before = x_;
      bool better = false;
      double change = 0.0;
      while (damping < 1e6) {
        FitMatrix damped = information;
        damped.diagonal() *= 1.0 + damping;
        FitVector step = damped.ldlt().solve(slope);
        for (int i = 0; i < I::count; ++i) {
          if (held_[at(i)]) step(i) = 0.0;
          step(i) = std::clamp(step(i), -longest_(i), longest_(i));
        }
        x_ = before + step;
        typename Model::Features next = model_.features_of(x_);
        model_.predict(x_, next, predicted_);
        const double cost_then = cost();
        if (cost_then < now) {
          features_ = std::move(next);
          change = (now - cost_then) / now;
          now = cost_then;
          better = true;
          damping = std::max(1e-9, 0.1 * damping);
          break;
        }
        damping = std::max(1e-4, 10.0 * damping);
        if (step.cwiseQuotient(prior_stddev_).norm() < 1e-9) break;
      }
      if (!better) {
        x_ = before;
        model_.predict(x_, features_, predicted_);
        return true;
      }
      if (change < 1e-6) return true;
    }
    return false;
  }

  void set_rms() {
    std::array<double, 7> sum{}, count{};
    for (std::size_t row = 0; row < predicted_.size(); ++row) {
      const std::size_t g = model_.group(row);
      const auto [in_stddevs, weight] = residual(row);
      const double r = in_stddevs * rms_[g];
      sum[g] += weight * r * r;
      count[g] += 1.0;
    }
    for (std::size_t g = 0; g < rms_.size(); ++g)
      if (count[g] > 0.0) rms_[g] = std::max(1e-9, std::sqrt(sum[g] / count[g]));
  }

  void set_stddevs(const std::vector<std::vector<double>>& instruments) {
    FitMatrix information;
    FitVector slope;
    std::vector<FitVector> scores;
    set_normal_equations(instruments, information, slope, &scores);
    // Height windows and corrections of the speeds depend on neighbours within half a second.
    FitMatrix spread =
        spread_of(scores, static_cast<std::size_t>(std::lround(1.0 / model_.flight().hop())));
    const FitMatrix prior = prior_information();
    for (int i = 0; i < I::count; ++i)
      for (int j = 0; j < I::count; ++j)
        if (!held_[at(i)] && !held_[at(j)]) spread(i, j) += prior(i, j);
    const FitMatrix inverse = information.partialPivLu().inverse();
    for (int i = 0; i < I::count; ++i) {
      if (held_[at(i)]) continue;
      double variance = 0.0;
      for (int a = 0; a < I::count; ++a)
        for (int b = 0; b < I::count; ++b) variance += inverse(i, a) * spread(a, b) * inverse(i, b);
      stddevs_(i) = std::sqrt(std::max(variance, 0.0));
    }
  }

  static constexpr std::size_t at_most = static_cast<std::size_t>(I::count);

  const VehicleLog<Rotors>& log_;
  Vehicle<Rotors> given_;
  Model model_;
  Matrix2 rotor_lag_covariance_ = Matrix2::Identity();
  FitVector prior_, prior_stddev_, longest_, x_, stddevs_;
  std::array<bool, at_most> held_{};
  std::array<double, 7> rms_{0.05, 0.05, 0.05, 0.3, 0.3, 0.3, 0.05};
  typename Model::Features features_;
  std::vector<double> predicted_;
  std::vector<std::vector<double>> jacobian_;
};

}  // namespace tilt_ropter::detail
