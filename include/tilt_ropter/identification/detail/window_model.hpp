// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

/// Prediction of each window of a flight for given values of the unknowns, for VehicleFit.
namespace tilt_ropter::detail {

/// Mean values over a window of the log, weighted by a Hann window. Derivatives are integrals with
/// the derivative of the Hann window, so no signal is differentiated.
struct FlightWindow {
  double time = 0.0;                ///< middle of the window [s]
  std::size_t first = 0, last = 0;  ///< IMU samples [first, last)
  std::size_t weights = 0;          ///< of the first sample, in the list of all weights
  Eigen::Vector3d angular_velocity, angular_acceleration, specific_force;
  Eigen::Vector3d velocity;  ///< in the body frame [m/s]
  Eigen::Matrix3d rotation;  ///< body -> world
};

/// Unexplained vertical acceleration in a long window, without and with the accelerometer.
struct HeightWindow {
  std::size_t window = 0;  ///< the FlightWindow in its middle
  double excess = 0.0;     ///< measured upward specific force - acceleration - gravity [m/s^2]
  Eigen::Vector3d up;      ///< world z in the body frame, mean over the window
};

/// Windows of a log, which overlap by three quarters. Allocates in the constructor only.
template <int Rotors>
class FlightWindows {
 public:
  /// `window`: duration of a window [s], at least twelve IMU samples. Windows below `min_height`
  /// [m] are left out. `imu_position`: that of the IMU, body frame [m]. The log must outlive this.
  FlightWindows(const VehicleLog<Rotors>& log, double window, double min_height,
                const Eigen::Vector3d& imu_position)
      : log_(log) {
    set_windows(window, min_height);
    set_height_windows(imu_position);
  }

  [[nodiscard]] const std::vector<FlightWindow>& windows() const { return windows_; }
  [[nodiscard]] const std::vector<HeightWindow>& heights() const { return heights_; }
  /// Time between the middles of two windows [s].
  [[nodiscard]] double hop() const { return hop_; }

  /// Weighted mean over a window of a series with a value for each IMU sample.
  [[nodiscard]] double mean(const FlightWindow& w, const std::vector<double>& series) const {
    return sum(w, weights_, series);
  }
  /// Derivative by time of such a series, in the middle of a window.
  [[nodiscard]] double slope(const FlightWindow& w, const std::vector<double>& series) const {
    return sum(w, slopes_, series);
  }

 private:
  // Depends on Rotors, so that only code that fits a vehicle compiles its algebra.
  using Matrix3 = Eigen::Matrix<double, 3 + 0 * Rotors, 3 + 0 * Rotors>;

  [[nodiscard]] static double sum(const FlightWindow& w, const std::vector<double>& weights,
                                  const std::vector<double>& series) {
    double result = 0.0;
    for (std::size_t j = w.first, n = w.weights; j < w.last; ++j, ++n)
      result += weights[n] * series[j];
    return result;
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

  void set_windows(double window, double min_height) {
    const auto& imu = log_.imu;
    std::vector<double> steps(imu.size() - 1);
    for (std::size_t i = 0; i < steps.size(); ++i) steps[i] = imu[i + 1].time - imu[i].time;
    const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
    std::nth_element(steps.begin(), middle, steps.end());
    const double usual = *middle, half = 0.5 * std::max(window, 6.0 * usual);
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
      if (height < min_height) continue;
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
    for (std::size_t i = w.weights; i < weights_.size(); ++i) {
      slopes_[i] /= ramp;
      const InertialSampled& sample = imu[w.first + i - w.weights].value;
      w.angular_velocity += weights_[i] * sample.angular_velocity;
      w.angular_acceleration += slopes_[i] * sample.angular_velocity;
      w.specific_force += weights_[i] * sample.specific_force;
    }
  }

  /// Windows of half a second in which poses and accelerometer must agree about the vertical.
  void set_height_windows(const Eigen::Vector3d& imu_position) {
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
        return pose.value.position.z() + (pose.value.orientation.normalized() * imu_position).z();
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

  const VehicleLog<Rotors>& log_;
  double hop_ = 0.01;
  std::vector<FlightWindow> windows_;
  std::vector<HeightWindow> heights_;
  std::vector<double> weights_, slopes_;  ///< for the mean and for the derivative
};

/// Lag of rotor `i`: `log_scale` is the logarithm of the ratio to its given time constant.
template <int Rotors>
[[nodiscard]] LagModel rotor_lag(const Vehicle<Rotors>& given, int i, double log_scale,
                                 double dead_time) {
  return {rotor_parameters(given, static_cast<std::size_t>(i)).time_constant * std::exp(log_scale),
          dead_time};
}

/// Places of the unknowns in the unknowns of a VehicleFit. Scales are logarithms of the ratio to
/// the given vehicle; all others are in SI units.
struct FitIndex {
  static constexpr int scale = 0, com = 1, inertia = 4, torque_ratio = 7, servo_lag = 8,
                       servo_delay = 9, rotor_lag = 10, rotor_delay = 11, drag = 12,
                       arm_inertia = 15, arm_moment = 16, bias = 17, wind = 20, count = 22;
};
using FitVector = Eigen::Matrix<double, FitIndex::count, 1>;

/// Predictions and measurements, one number per row: specific force x y z [m/s^2] and angular
/// acceleration x y z [rad/s^2] of each window, then the excess of each height window [m/s^2].
template <int Rotors>
class WindowModel {
 public:
  using I = FitIndex;
  using RotorVector = Eigen::Matrix<double, Rotors, 1>;
  // Depend on Rotors, so that only code that fits a vehicle compiles their algebra.
  using FitVector = Eigen::Matrix<double, I::count + 0 * Rotors, 1>;
  using Matrix3 = Eigen::Matrix<double, 3 + 0 * Rotors, 3 + 0 * Rotors>;

  static constexpr double window = 0.04;  ///< over which the log is averaged [s]

  /// What the actuators did in each window, for one set of lags: weighted means per rotor.
  struct Features {
    std::vector<RotorVector> lateral, vertical;  ///< thrust sin(tilt), thrust cos(tilt) [N]
    std::vector<RotorVector> turning;            ///< second derivative of the tilt [rad/s^2]
    std::vector<RotorVector> sine, cosine;       ///< second derivatives of sin, cos of the tilt
    double rate_limited = 0.0;
  };

  /// `trust_mass`: the mass of `given` is right, otherwise its thrust coefficient. The rest is as
  /// for FlightWindows. The log must outlive this.
  WindowModel(const VehicleLog<Rotors>& log, const Vehicle<Rotors>& given, bool trust_mass,
              double min_height, const Eigen::Vector3d& imu_position)
      : log_(log),
        given_(given),
        trust_mass_(trust_mass),
        imu_position_(imu_position),
        flight_(log, window, min_height, imu_position) {}

  /// Adds the slow part of measured minus modelled rotor speeds, see RotorLagFit.
  void set_speed_corrections(std::vector<RotorVector> corrections) {
    corrections_ = std::move(corrections);
  }

  [[nodiscard]] const FlightWindows<Rotors>& flight() const { return flight_; }
  [[nodiscard]] const std::vector<FlightWindow>& windows() const { return flight_.windows(); }

  /// What the actuators do with the lags in `x`.
  [[nodiscard]] Features features_of(const FitVector& x) const {
    Features f;
    const RotorVector zero = RotorVector::Zero();
    for (auto* list : {&f.lateral, &f.vertical, &f.turning, &f.sine, &f.cosine})
      list->assign(windows().size(), zero);
    const auto& imu = log_.imu;
    std::vector<double> speed(imu.size()), tilt(imu.size()), rate(imu.size());
    std::vector<double> sine(imu.size()), cosine(imu.size());
    std::array<std::vector<double>, 4> series;
    for (auto& list : series) list.resize(imu.size());
    double limited = 0.0;
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
        limited += std::abs(rate[j]) >= given_.servo.max_rate ? 1.0 : 0.0;
      }
      // Differences of the angles, unlike the rates, do not jump when a command takes effect.
      for (std::size_t j = 1; j + 1 < imu.size(); ++j) {
        const double step = 1.0 / (imu[j + 1].time - imu[j - 1].time);
        series[2][j] = step * (sine[j + 1] - sine[j - 1]);
        series[3][j] = step * (cosine[j + 1] - cosine[j - 1]);
        rate[j] = step * (tilt[j + 1] - tilt[j - 1]);
      }
      for (std::size_t k = 0; k < windows().size(); ++k) {
        const FlightWindow& w = windows()[k];
        f.lateral[k](i) = flight_.mean(w, series[0]);
        f.vertical[k](i) = flight_.mean(w, series[1]);
        f.turning[k](i) = flight_.slope(w, rate);
        f.sine[k](i) = flight_.slope(w, series[2]);
        f.cosine[k](i) = flight_.slope(w, series[3]);
      }
    }
    f.rate_limited = limited / static_cast<double>(Rotors * imu.size());
    return f;
  }

  /// Writes the predictions of all rows to `out`.
  void predict(const FitVector& x, const Features& f, std::vector<double>& out) const {
    out.resize(6 * windows().size() + heights().size());
    const double scale = std::exp(x(I::scale));
    const double mass = given_.body.mass * (trust_mass_ ? 1.0 : 1.0 / scale);
    const double thrust = trust_mass_ ? scale : 1.0;
    const double ratio = std::exp(x(I::torque_ratio));
    const Eigen::Vector3d com = x.template segment<3>(I::com), arm = imu_position_ - com;
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
    for (std::size_t k = 0; k < windows().size(); ++k) {
      const FlightWindow& w = windows()[k];
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
    for (std::size_t h = 0; h < heights().size(); ++h)
      out[6 * windows().size() + h] = heights()[h].up.dot(bias);
  }

  /// Measured value of a row.
  [[nodiscard]] double measured(std::size_t row) const {
    const std::size_t k = row / 6;
    if (k >= windows().size()) return heights()[row - 6 * windows().size()].excess;
    const auto part = static_cast<Eigen::Index>(row % 6);
    return part < 3 ? windows()[k].specific_force(part)
                    : windows()[k].angular_acceleration(part - 3);
  }
  /// Rows of one group have the same noise: six groups of the windows, one of the height windows.
  [[nodiscard]] std::size_t group(std::size_t row) const {
    return row < 6 * windows().size() ? row % 6 : 6;
  }
  /// The window to which a row belongs; for a height window, that in its middle.
  [[nodiscard]] std::size_t window_of(std::size_t row) const {
    return row < 6 * windows().size() ? row / 6 : heights()[row - 6 * windows().size()].window;
  }

 private:
  [[nodiscard]] static std::size_t at(int i) { return static_cast<std::size_t>(i); }
  [[nodiscard]] const RotorGeometry& rotor(int i) const { return given_.rotors[at(i)]; }
  [[nodiscard]] const std::vector<HeightWindow>& heights() const { return flight_.heights(); }

  const VehicleLog<Rotors>& log_;
  Vehicle<Rotors> given_;
  bool trust_mass_;
  Eigen::Vector3d imu_position_;
  FlightWindows<Rotors> flight_;
  std::vector<RotorVector> corrections_;
};

}  // namespace tilt_ropter::detail
