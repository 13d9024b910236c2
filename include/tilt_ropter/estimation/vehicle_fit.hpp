// SPDX-License-Identifier: BSD-3-Clause
#pragma once

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

/// Least squares of identify_vehicle(): the flight in windows, the model of a window, its fit. This
/// header is long because its functions are templates that share the same data.
namespace tilt_ropter::detail {

/// Places of the unknowns in the vector of a VehicleFit. Scales are logarithms of the ratio to the
/// given vehicle; all others are in SI units.
struct FitIndex {
  static constexpr int scale = 0, com = 1, inertia = 4, torque_ratio = 7, servo_lag = 8,
                       servo_delay = 9, rotor_lag = 10, rotor_delay = 11, drag = 12,
                       arm_inertia = 15, arm_moment = 16, bias = 17, wind = 20, count = 22;
};
using FitVector = Eigen::Matrix<double, FitIndex::count, 1>;
using FitMatrix = Eigen::Matrix<double, FitIndex::count, FitIndex::count>;

/// Mean values over a window of the log, weighted by a Hann window. Derivatives are integrals with
/// the derivative of the Hann window, so no signal is differentiated.
struct FlightWindow {
  double time = 0.0;                ///< middle of the window [s]
  std::size_t first = 0, last = 0;  ///< IMU samples [first, last)
  std::size_t weights = 0;          ///< of the first sample, in the list of all weights
  Eigen::Vector3d angular_velocity, angular_acceleration, specific_force;
  Eigen::Matrix3d rate_products;  ///< mean of w w' [rad^2/s^2]
  Eigen::Vector3d velocity;       ///< in the body frame [m/s]
  Eigen::Matrix3d rotation;       ///< body -> world
};

/// Unexplained vertical acceleration in a long window, without and with the accelerometer.
struct HeightWindow {
  std::size_t window = 0;  ///< the FlightWindow in its middle
  double excess = 0.0;     ///< measured upward specific force - acceleration - gravity [m/s^2]
  Eigen::Vector3d up;      ///< world z in the body frame, mean over the window
};

/// Settings of VehicleFit, see VehicleIdentificationSettings.
struct VehicleFitSettings {
  bool trust_mass = true;
  double window = 0.04;
  double min_height = 0.0;
  Eigen::Vector3d imu_position = Eigen::Vector3d::Zero();
  int max_iterations = 30;
};

/// Time constant and dead time of the rotors, from measured speeds.
struct RotorLagFit {
  double log_scale = 0.0, dead_time = 0.0;  ///< of the given time constants; [s]
  Eigen::Matrix2d covariance = Eigen::Matrix2d::Identity();
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
      : log_(log), given_(given), settings_(settings) {
    held_.fill(false);
    set_prior();
    set_windows();
    set_height_windows();
    if (log.rotor_speeds.empty()) return;
    fit_rotor_lag();
    set_speed_corrections();
  }

  [[nodiscard]] const std::vector<FlightWindow>& windows() const { return windows_; }
  [[nodiscard]] const FitVector& unknowns() const { return x_; }
  [[nodiscard]] const FitVector& stddevs() const { return stddevs_; }
  [[nodiscard]] bool holds(int i) const { return held_[static_cast<std::size_t>(i)]; }
  /// Duration of all windows together [s].
  [[nodiscard]] double duration() const { return static_cast<double>(windows_.size()) * hop_; }
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

  /// Mean velocity in the world [m/s] around `time`: slope of the positions within 0.05 s. Returns
  /// false without poses on both sides.
  bool velocity_at(double time, Eigen::Vector3d& velocity, double& height) const {
    const auto& poses = log_.poses;
    const double rate =
        static_cast<double>(poses.size() - 1) / (poses.back().time - poses.front().time);
    const double reach = std::max(0.05, 2.5 / rate);
    double count = 0.0, sum_t = 0.0, sum_tt = 0.0;
    Eigen::Vector3d sum = Eigen::Vector3d::Zero(), sum_tp = Eigen::Vector3d::Zero();
    const std::size_t middle = index_before(poses, time);
    std::size_t i = middle;
    while (i > 0 && poses[i - 1].time >= time - reach) --i;
    for (; i < poses.size() && poses[i].time <= time + reach; ++i) {
      const double t = poses[i].time - time;
      count += 1.0;
      sum_t += t;
      sum_tt += t * t;
      sum += poses[i].value.position;
      sum_tp += t * poses[i].value.position;
    }
    const double spread = sum_tt - sum_t * sum_t / std::max(count, 1.0);
    if (count < 3.0 || !(spread > 1e-9) || std::abs(sum_t) > 0.3 * reach * count) return false;
    velocity = (sum_tp - sum_t / count * sum) / spread;
    height = sum.z() / count;
    return true;
  }

  void set_windows() {
    const auto& imu = log_.imu;
    std::vector<double> steps(imu.size() - 1);
    for (std::size_t i = 0; i < steps.size(); ++i) steps[i] = imu[i + 1].time - imu[i].time;
    const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
    std::nth_element(steps.begin(), middle, steps.end());
    const double usual = *middle, half = 0.5 * std::max(settings_.window, 6.0 * usual);
    hop_ = 0.5 * half;
    const double begin =
        std::max({imu.front().time, log_.poses.front().time, log_.commands.front().time + 0.5});
    const double end =
        std::min({imu.back().time, log_.poses.back().time, log_.commands.back().time + 0.05});
    for (double time = begin + half; time + half <= end; time += hop_) {
      FlightWindow w;
      double height = 0.0;
      Eigen::Vector3d velocity;
      w.time = time;
      w.first = index_before(imu, time - half) + 1;
      w.last = index_before(imu, time + half) + 1;
      if (w.last < w.first + 5) continue;
      double gap = std::max(imu[w.first].time - time + half, time + half - imu[w.last - 1].time);
      for (std::size_t i = w.first + 1; i < w.last; ++i)
        gap = std::max(gap, imu[i].time - imu[i - 1].time);
      if (gap > 3.0 * usual || !velocity_at(time, velocity, height)) continue;
      if (height < settings_.min_height) continue;
      w.rotation = orientation_at(log_.poses, time).toRotationMatrix();
      w.velocity = w.rotation.transpose() * velocity;
      add_weights(w, half);
      windows_.push_back(w);
    }
  }

  /// Weights of the Hann window and of its derivative, for uneven stamps; means of the IMU.
  void add_weights(FlightWindow& w, double half) {
    const auto& imu = log_.imu;
    w.weights = weights_.size();
    double sum = 0.0, slopes = 0.0, ramp = 0.0;
    for (std::size_t i = w.first; i < w.last; ++i) {
      const double t = (imu[i].time - w.time) * pi / half;
      const double step = imu[std::min(i + 1, imu.size() - 1)].time - imu[i - 1].time;
      weights_.push_back((1.0 + std::cos(t)) * step);
      slopes_.push_back(std::sin(t) * step);
      sum += weights_.back();
      slopes += slopes_.back();
    }
    for (std::size_t i = w.weights; i < weights_.size(); ++i) {
      weights_[i] /= sum;
      slopes_[i] -= slopes * weights_[i];
      ramp += slopes_[i] * (imu[w.first + i - w.weights].time - w.time);
    }
    w.angular_velocity.setZero();
    w.angular_acceleration.setZero();
    w.specific_force.setZero();
    w.rate_products.setZero();
    for (std::size_t i = w.weights; i < weights_.size(); ++i) {
      slopes_[i] /= ramp;
      const InertialSampled& sample = imu[w.first + i - w.weights].value;
      w.angular_velocity += weights_[i] * sample.angular_velocity;
      w.angular_acceleration += slopes_[i] * sample.angular_velocity;
      w.specific_force += weights_[i] * sample.specific_force;
    }
    w.rate_products = w.angular_velocity * w.angular_velocity.transpose();
  }

  /// Windows of half a second in which poses and accelerometer must agree about the vertical.
  void set_height_windows() {
    constexpr double half = 0.25;
    const auto& poses = log_.poses;
    double next = -std::numeric_limits<double>::infinity();
    for (std::size_t k = 0; k < windows_.size(); ++k) {
      const double time = windows_[k].time;
      if (time < next || time - half < log_.imu.front().time || time + half > log_.imu.back().time)
        continue;
      const std::size_t first = index_before(poses, time - half) + 1;
      const std::size_t last = index_before(poses, time + half) + 1;
      if (last < first + 8) continue;
      double gap = std::max(poses[first].time - time + half, time + half - poses[last - 1].time);
      for (std::size_t i = first + 1; i < last; ++i)
        gap = std::max(gap, poses[i].time - poses[i - 1].time);
      if (gap > 0.1) continue;
      next = time + 0.5 * half;
      // The second derivative of the Hann window has to give 0, 0 and 2 for 1, t and t^2.
      Matrix3 moments = Matrix3::Zero();
      Eigen::Vector3d heights = Eigen::Vector3d::Zero();
      const auto height_of = [&](const Timed<MarkerPosed>& pose) {
        return pose.value.position.z() +
               (pose.value.orientation.normalized() * settings_.imu_position).z();
      };
      const double base = height_of(poses[first]);
      for (std::size_t i = first; i < last; ++i) {
        const double t = (poses[i].time - time) / half;
        const double step = poses[std::min(i + 1, poses.size() - 1)].time - poses[i - 1].time;
        const Eigen::Vector3d powers(1.0, t, t * t);
        // Regression on 1, t, t^2 with instruments 1, t and the second derivative.
        const Eigen::Vector3d tests = step * Eigen::Vector3d(1.0, t, -std::cos(pi * t));
        moments += tests * powers.transpose();
        heights += tests * (height_of(poses[i]) - base);
      }
      HeightWindow h;
      h.window = k;
      h.up.setZero();
      const double acceleration = 2.0 * moments.inverse().row(2).dot(heights) / (half * half);
      const std::size_t from = index_before(log_.imu, time - half) + 1;
      const std::size_t until = index_before(log_.imu, time + half) + 1;
      double sum = 0.0, force = 0.0;
      for (std::size_t i = from; i < until; ++i) {
        const double weight = 1.0 + std::cos((log_.imu[i].time - time) * pi / half);
        const Eigen::Vector3d up =
            orientation_at(poses, log_.imu[i].time).toRotationMatrix().row(2);
        sum += weight;
        h.up += weight * up;
        force += weight * up.dot(log_.imu[i].value.specific_force);
      }
      h.up /= sum;
      h.excess = force / sum - acceleration - gravity;
      heights_.push_back(h);
    }
  }

  [[nodiscard]] LagModel rotor_lag_of(int i, double log_scale, double dead_time) const {
    return {rotor_parameters(given_, at(i)).time_constant * std::exp(log_scale), dead_time};
  }

  /// Measured minus modelled speeds at the stamps of the measurements, without each rotor's gain
  /// and offset.
  [[nodiscard]] std::vector<RotorVector> speed_residuals(double log_scale, double dead_time) const {
    const auto& measured = log_.rotor_speeds;
    std::vector<RotorVector> residuals(measured.size());
    for (int i = 0; i < Rotors; ++i) {
      std::vector<double> model(measured.size());
      replay(
          log_.commands, measured, rotor_lag_of(i, log_scale, dead_time),
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

  void fit_rotor_lag() {
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
    for (int iteration = 0; iteration < settings_.max_iterations; ++iteration) {
      std::array<std::vector<RotorVector>, 2> slopes;
      for (int p = 0; p < 2; ++p) {
        Eigen::Vector2d more = x, less = x;
        more(p) += steps(p);
        less(p) -= steps(p);
        const auto high = speed_residuals(more(0), more(1));
        slopes[at(p)] = speed_residuals(less(0), less(1));
        for (std::size_t j = 0; j < high.size(); ++j)
          slopes[at(p)][j] = (slopes[at(p)][j] - high[j]) / (2.0 * steps(p));
      }
      const double variance = std::max(cost / count, 1e-12);
      Matrix2 information = Eigen::Vector2d(prior.cwiseProduct(prior).cwiseInverse()).asDiagonal();
      spread = information;
      Eigen::Vector2d slope = Eigen::Vector2d::Zero();
      constexpr std::size_t block = 100;
      std::vector<Eigen::Vector2d> scores(residuals.size());
      for (std::size_t j = 0; j < residuals.size(); ++j) {
        for (int p = 0; p < 2; ++p) {
          scores[j](p) = slopes[at(p)][j].dot(residuals[j]) / variance;
          for (int q = 0; q < 2; ++q)
            information(p, q) += slopes[at(p)][j].dot(slopes[at(q)][j]) / variance;
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
    Matrix2 covariance = inverse * spread * inverse;
    covariance.diagonal() += Eigen::Vector2d(1e-12, 1e-16);
    rotor_lag_ = {x(0), x(1), covariance};
    x_(I::rotor_lag) = prior_(I::rotor_lag) = x(0);
    x_(I::rotor_delay) = prior_(I::rotor_delay) = x(1);
    prior_stddev_(I::rotor_lag) = std::sqrt(covariance(0, 0));
    prior_stddev_(I::rotor_delay) = std::sqrt(covariance(1, 1));
  }

  /// Sum of the covariances of the scores up to a distance of `block`, with falling weights
  /// (Bartlett's window), so that scores that depend on one another count right.
  template <typename Score>
  [[nodiscard]] static auto spread_of(const std::vector<Score>& scores, std::size_t block) {
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

  /// Slow part of measured minus modelled speed at each IMU sample: mean over 0.6 s. The model
  /// gives the fast part, so that the noise of the measured speeds does not reach the thrusts.
  void set_speed_corrections() {
    const auto& measured = log_.rotor_speeds;
    std::vector<RotorVector> sums(measured.size() + 1, RotorVector::Zero());
    for (int i = 0; i < Rotors; ++i)
      replay(
          log_.commands, measured, rotor_lag_of(i, rotor_lag_.log_scale, rotor_lag_.dead_time),
          [i](const ActuatorState<Rotors>& c) { return c.rotor_speed(i); },
          [&](std::size_t j, double value, double) {
            sums[j + 1](i) = sums[j](i) + measured[j].value(i) - value;
          });
    corrections_.resize(log_.imu.size());
    for (std::size_t j = 0; j < log_.imu.size(); ++j) {
      const double time = log_.imu[j].time;
      const std::size_t from = index_before(measured, time - 0.3);
      const std::size_t until = std::max(from, index_before(measured, time + 0.3)) + 1;
      corrections_[j] = (sums[until] - sums[from]) / static_cast<double>(until - from);
    }
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
          log_.commands, imu, rotor_lag_of(i, x(I::rotor_lag), x(I::rotor_delay)),
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
        double lateral = 0.0, vertical = 0.0, turning = 0.0, sines = 0.0, cosines = 0.0;
        for (std::size_t j = w.first, n = w.weights; j < w.last; ++j, ++n) {
          lateral += weights_[n] * series[0][j];
          vertical += weights_[n] * series[1][j];
          turning += slopes_[n] * rate[j];
          sines += slopes_[n] * series[2][j];
          cosines += slopes_[n] * series[3][j];
        }
        f.lateral[k](i) = lateral;
        f.vertical[k](i) = vertical;
        f.turning[k](i) = turning;
        f.sine[k](i) = sines;
        f.cosine[k](i) = cosines;
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
          return passed < (static_cast<double>(lag[lags - 1]) + 0.5) * hop_;
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
    prior.template block<2, 2>(lag, lag) = rotor_lag_.covariance.inverse();
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
    FitMatrix spread = spread_of(scores, static_cast<std::size_t>(std::lround(1.0 / hop_)));
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
  double hop_ = 0.01;  ///< between the middles of two windows [s]
  std::vector<FlightWindow> windows_;
  std::vector<HeightWindow> heights_;
  std::vector<double> weights_, slopes_;
  std::vector<RotorVector> corrections_;
  RotorLagFit rotor_lag_;
  FitVector prior_, prior_stddev_, longest_, x_, stddevs_;
  std::array<bool, at_most> held_{};
  std::array<double, 7> rms_{0.05, 0.05, 0.05, 0.3, 0.3, 0.3, 0.05};
  Features features_;
  std::vector<double> predicted_;
  std::vector<std::vector<double>> jacobian_;
};

}  // namespace tilt_ropter::detail
