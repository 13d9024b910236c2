// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/flight_windows.hpp>
#include <tilt_ropter/estimation/rotor_lag_fit.hpp>
#include <tilt_ropter/estimation/vehicle_log.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

/// Least squares of identify_vehicle(): the model of a window of the flight, and its fit.
namespace tilt_ropter::detail {

/// Places of the unknowns in the vector of a VehicleFit. Scales are logarithms of the ratio to the
/// given vehicle; all others are in SI units.
struct FitIndex {
  static constexpr int scale = 0, com = 1, inertia = 4, torque_ratio = 7, servo_lag = 8,
                       servo_delay = 9, rotor_lag = 10, rotor_delay = 11, drag = 12,
                       arm_inertia = 15, arm_moment = 16, bias = 17, wind = 20, count = 22;
};
using FitVector = Eigen::Matrix<double, FitIndex::count, 1>;

/// Settings of VehicleFit, see VehicleIdentificationSettings.
struct VehicleFitSettings {
  bool trust_mass = true;
  double window = 0.04;
  double min_height = 0.0;
  Eigen::Vector3d imu_position = Eigen::Vector3d::Zero();
  int max_iterations = 30;
};

template <int Rotors>
class VehicleFit {
 public:
  using I = FitIndex;
  using RotorVector = Eigen::Matrix<double, Rotors, 1>;
  // The sizes depend on Rotors, so that only code that fits a vehicle compiles their algebra.
  using FitVector = Eigen::Matrix<double, I::count + 0 * Rotors, 1>;
  using FitMatrix = Eigen::Matrix<double, I::count + 0 * Rotors, I::count + 0 * Rotors>;
  using Matrix2 = Eigen::Matrix<double, 2 + 0 * Rotors, 2 + 0 * Rotors>;
  using Matrix3 = Eigen::Matrix<double, 3 + 0 * Rotors, 3 + 0 * Rotors>;

  VehicleFit(const VehicleLog<Rotors>& log, const Vehicle<Rotors>& given,
             const VehicleFitSettings& settings)
      : log_(log),
        given_(given),
        settings_(settings),
        flight_(log, settings.window, settings.min_height, settings.imu_position),
        windows_(flight_.windows()),
        heights_(flight_.heights()) {
    held_.fill(false);
    set_prior();
    if (log.rotor_speeds.empty()) return;
    const RotorLagFit<Rotors> lag(log, given_, settings.max_iterations);
    rotor_lag_covariance_ = lag.covariance;
    x_(I::rotor_lag) = prior_(I::rotor_lag) = lag.log_scale;
    x_(I::rotor_delay) = prior_(I::rotor_delay) = lag.dead_time;
    prior_stddev_(I::rotor_lag) = std::sqrt(lag.covariance(0, 0));
    prior_stddev_(I::rotor_delay) = std::sqrt(lag.covariance(1, 1));
    corrections_ = lag.speed_corrections();
  }

  VehicleFit(const VehicleFit&) = delete;  // has references to its own members
  VehicleFit& operator=(const VehicleFit&) = delete;

  [[nodiscard]] const std::vector<FlightWindow>& windows() const { return windows_; }
  [[nodiscard]] const FitVector& unknowns() const { return x_; }
  [[nodiscard]] const FitVector& stddevs() const { return stddevs_; }
  [[nodiscard]] bool holds(int i) const { return held_[static_cast<std::size_t>(i)]; }
  /// Duration of all windows together [s].
  [[nodiscard]] double duration() const {
    return static_cast<double>(windows_.size()) * flight_.hop();
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

  /// Takes out the error that the controller causes: its commands react to the noise of the IMU,
  /// so the model's derivatives in a window are correlated with the noise in this window. The
  /// method of instrumental variables multiplies the residuals with other derivatives: those of
  /// commands before the window, extrapolated (Soderstrom & Stoica 1983). Returns false if it does
  /// not converge.
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
  /// What the actuators did in each window, for one set of lags: weighted means per rotor.
  struct Features {
    std::vector<RotorVector> lateral, vertical;  ///< thrust sin(tilt), thrust cos(tilt) [N]
    std::vector<RotorVector> turning;            ///< second derivative of the tilt [rad/s^2]
    std::vector<RotorVector> sine, cosine;       ///< second derivatives of sin, cos of the tilt
    double rate_limited = 0.0;
  };

  [[nodiscard]] static std::size_t at(int i) { return static_cast<std::size_t>(i); }
  [[nodiscard]] const RotorGeometry& rotor(int i) const { return given_.rotors[at(i)]; }

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

  [[nodiscard]] Features features_of(const FitVector& x) const {
    Features f;
    const RotorVector zero = RotorVector::Zero();
    for (auto* list : {&f.lateral, &f.vertical, &f.turning, &f.sine, &f.cosine})
      list->assign(windows_.size(), zero);
    const auto& imu = log_.imu;
    std::vector<double> speed(imu.size()), tilt(imu.size()), rate(imu.size());
    std::vector<double> sine(imu.size()), cosine(imu.size());
    std::array<std::vector<double>, 4> series;
    for (auto& list : series) list.resize(imu.size());
    double limited = 0.0, moving = 0.0;
    const LagModel servo{given_.servo.time_constant * std::exp(x(I::servo_lag)), x(I::servo_delay),
                         given_.servo.max_rate};
    for (int i = 0; i < Rotors; ++i) {
      replay(
          log_.commands, imu, rotor_lag(given_, i, x(I::rotor_lag), x(I::rotor_delay)),
          [i](const ActuatorState<Rotors>& c) { return c.rotor_speed(i); },
          [&](std::size_t j, double value, double) { speed[j] = value; });
      if (rotor(i).tilts)
        replay(
            log_.commands, imu, servo,
            [i](const ActuatorState<Rotors>& c) { return c.tilt_angle(i); },
            [&](std::size_t j, double value, double now) {
              tilt[j] = value;
              rate[j] = now;
            });
      else
        for (std::size_t j = 0; j < imu.size(); ++j) tilt[j] = rate[j] = 0.0;
      const RotorParameters& p = rotor_parameters(given_, at(i));
      for (std::size_t j = 0; j < imu.size(); ++j) {
        const double turns =
            std::max(0.0, speed[j] + (corrections_.empty() ? 0.0 : corrections_[j](i)));
        const double thrust =
            rotor(i).effectiveness * turns *
            std::max(0.0, p.thrust_coefficient * turns + p.linear_thrust_coefficient);
        const double s = std::sin(tilt[j]), c = std::cos(tilt[j]);
        series[0][j] = thrust * s;
        series[1][j] = thrust * c;
        sine[j] = s;
        cosine[j] = c;
        moving += 1.0;
        limited += std::abs(rate[j]) >= given_.servo.max_rate ? 1.0 : 0.0;
      }
      // Differences of the angles, unlike the rates, do not jump when a command takes effect.
      for (std::size_t j = 1; j + 1 < imu.size(); ++j) {
        const double step = 1.0 / (imu[j + 1].time - imu[j - 1].time);
        series[2][j] = step * (sine[j + 1] - sine[j - 1]);
        series[3][j] = step * (cosine[j + 1] - cosine[j - 1]);
        rate[j] = step * (tilt[j + 1] - tilt[j - 1]);
      }
      for (std::size_t k = 0; k < windows_.size(); ++k) {
        const FlightWindow& w = windows_[k];
        f.lateral[k](i) = flight_.mean(w, series[0]);
        f.vertical[k](i) = flight_.mean(w, series[1]);
        f.turning[k](i) = flight_.slope(w, rate);
        f.sine[k](i) = flight_.slope(w, series[2]);
        f.cosine[k](i) = flight_.slope(w, series[3]);
      }
    }
    f.rate_limited = limited / std::max(1.0, moving);
    return f;
  }

  /// Specific force and angular acceleration in each window, then the excess of each height window.
  void predict(const FitVector& x, const Features& f, std::vector<double>& out) const {
    out.resize(6 * windows_.size() + heights_.size());
    const double scale = std::exp(x(I::scale));
    const double mass = given_.body.mass * (settings_.trust_mass ? 1.0 : 1.0 / scale);
    const double thrust = settings_.trust_mass ? scale : 1.0;
    const double ratio = std::exp(x(I::torque_ratio));
    const Eigen::Vector3d com = x.template segment<3>(I::com), arm = settings_.imu_position - com;
    const Eigen::Vector3d bias = x.template segment<3>(I::bias);
    Matrix3 inertia = given_.body.inertia;
    for (int i = 0; i < 3; ++i) inertia(i, i) *= std::exp(x(I::inertia + i));
    const Matrix3 inverse = inertia.inverse();
    Eigen::Matrix<double, 3, Rotors> sideways, upward, axis, side_torque, up_torque, place;
    for (int i = 0; i < Rotors; ++i) {
      const RotorGeometry& r = rotor(i);
      const double reaction =
          -static_cast<int>(r.spin) * ratio * rotor_parameters(given_, at(i)).torque_ratio;
      sideways.col(i) = -r.orientation.col(1);
      upward.col(i) = r.orientation.col(2);
      axis.col(i) = r.orientation.col(0);
      place.col(i) = r.position - com;
      const Eigen::Vector3d s = sideways.col(i), u = upward.col(i), at_com = place.col(i);
      side_torque.col(i) = at_com.cross(s) + reaction * s;
      up_torque.col(i) = at_com.cross(u) + reaction * u;
    }
    for (std::size_t k = 0; k < windows_.size(); ++k) {
      const FlightWindow& w = windows_[k];
      Eigen::Vector3d force = Eigen::Vector3d::Zero(), torque = Eigen::Vector3d::Zero();
      for (int i = 0; i < Rotors; ++i) {
        const double l = thrust * f.lateral[k](i), v = thrust * f.vertical[k](i);
        const Eigen::Vector3d swing =
            -x(I::arm_moment) * (f.sine[k](i) * sideways.col(i) + f.cosine[k](i) * upward.col(i));
        force += l * sideways.col(i) + v * upward.col(i) + swing;
        torque += l * side_torque.col(i) + v * up_torque.col(i) -
                  x(I::arm_inertia) * f.turning[k](i) * axis.col(i) +
                  Eigen::Vector3d(place.col(i)).cross(swing);
      }
      force -= x.template segment<3>(I::drag).cwiseProduct(w.velocity);
      force += x(I::wind) * w.rotation.row(0).transpose() +
               x(I::wind + 1) * w.rotation.row(1).transpose();
      const Eigen::Vector3d& rates = w.angular_velocity;
      const Eigen::Vector3d specific =
          force / mass + w.angular_acceleration.cross(arm) + rates.cross(rates.cross(arm)) + bias;
      const Eigen::Vector3d turning = inverse * (torque - rates.cross(inertia * rates));
      for (std::size_t i = 0; i < 3; ++i) {
        out[6 * k + i] = specific(static_cast<Eigen::Index>(i));
        out[6 * k + 3 + i] = turning(static_cast<Eigen::Index>(i));
      }
    }
    for (std::size_t h = 0; h < heights_.size(); ++h)
      out[6 * windows_.size() + h] = heights_[h].up.dot(bias);
  }

  [[nodiscard]] double measured(std::size_t row) const {
    const std::size_t k = row / 6;
    if (k >= windows_.size()) return heights_[row - 6 * windows_.size()].excess;
    const auto part = static_cast<Eigen::Index>(row % 6);
    return part < 3 ? windows_[k].specific_force(part) : windows_[k].angular_acceleration(part - 3);
  }
  [[nodiscard]] std::size_t group(std::size_t row) const {
    return row < 6 * windows_.size() ? row % 6 : 6;
  }

  /// Residual in standard deviations, and its weight: beyond four they count less (Huber 1964).
  [[nodiscard]] double residual(std::size_t row, double& weight) const {
    const double r = (measured(row) - predicted_[row]) / rms_[group(row)];
    weight = std::abs(r) > 4.0 ? 4.0 / std::abs(r) : 1.0;
    return r;
  }
  [[nodiscard]] double cost() const {
    double sum = 0.0;
    for (std::size_t row = 0; row < predicted_.size(); ++row) {
      double weight = 1.0;
      const double r = residual(row, weight);
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
      predict(high, moves_actuators ? features_of(high) : features_, jacobian_[at(i)]);
      if (moves_actuators) predict(low, features_of(low), less);
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
          const double passed = windows_[k].time - windows_[k - lag[lags - 1]].time;
          for (int l = 0; l < lags; ++l) values(l) = value(k - lag[l]);
          return passed < (static_cast<double>(lag[lags - 1]) + 0.5) * flight_.hop();
        };
        Eigen::Matrix<double, lags, lags> gram;
        gram.setZero();
        LagVector image = LagVector::Zero(), values;
        for (std::size_t k = 0; k < windows_.size(); ++k) {
          if (!past(k, values)) continue;
          for (int l = 0; l < lags; ++l) {
            image(l) += values(l) * value(k);
            for (int m = 0; m < lags; ++m) gram(l, m) += values(l) * values(m);
          }
        }
        gram.diagonal().array() += 1e-9 * gram.trace() + 1e-300;
        const LagVector weights = gram.ldlt().solve(image);
        for (std::size_t k = 0; k < windows_.size(); ++k)
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
    if (scores != nullptr) scores->assign(windows_.size(), FitVector::Zero());
    for (std::size_t row = 0; row < predicted_.size(); ++row) {
      double weight = 1.0;
      const double r = residual(row, weight), scale = 1.0 / rms_[group(row)];
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
        const std::size_t k =
            row < 6 * windows_.size() ? row / 6 : heights_[row - 6 * windows_.size()].window;
        (*scores)[k](i) += left(i) * r;
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
    features_ = features_of(x_);
    predict(x_, features_, predicted_);
  }

  bool minimise() {
    double damping = 1e-6;
    move_to(x_);
    double now = cost();
    FitMatrix information;
    FitVector slope;
    for (int iteration = 0; iteration < settings_.max_iterations; ++iteration) {
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
        Features next = features_of(x_);
        predict(x_, next, predicted_);
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
        predict(x_, features_, predicted_);
        return true;
      }
      if (change < 1e-6) return true;
    }
    return false;
  }

  void set_rms() {
    std::array<double, 7> sum{}, count{};
    for (std::size_t row = 0; row < predicted_.size(); ++row) {
      double weight = 1.0;
      const double r = residual(row, weight) * rms_[group(row)];
      sum[group(row)] += weight * r * r;
      count[group(row)] += 1.0;
    }
    for (std::size_t g = 0; g < rms_.size(); ++g)
      if (count[g] > 0.0) rms_[g] = std::max(1e-9, std::sqrt(sum[g] / count[g]));
  }

  void set_stddevs(const std::vector<std::vector<double>>& instruments) {
    FitMatrix information;
    FitVector slope;
    std::vector<FitVector> scores;
    set_normal_equations(instruments, information, slope, &scores);
    // The height windows of half a second and the corrections of the speeds depend on their
    // neighbours over that time.
    FitMatrix spread =
        spread_of(scores, static_cast<std::size_t>(std::lround(1.0 / flight_.hop())));
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
  VehicleFitSettings settings_;
  FlightWindows<Rotors> flight_;
  const std::vector<FlightWindow>& windows_;
  const std::vector<HeightWindow>& heights_;
  std::vector<RotorVector> corrections_;
  Matrix2 rotor_lag_covariance_ = Matrix2::Identity();
  FitVector prior_, prior_stddev_, longest_, x_, stddevs_;
  std::array<bool, at_most> held_{};
  std::array<double, 7> rms_{0.05, 0.05, 0.05, 0.3, 0.3, 0.3, 0.05};
  Features features_;
  std::vector<double> predicted_;
  std::vector<std::vector<double>> jacobian_;
};

}  // namespace tilt_ropter::detail
