// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/identification/detail/flight_windows.hpp>
#include <tilt_ropter/identification/detail/rotor_lag_fit.hpp>
#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

/// Prediction of each window of a flight for given values of the unknowns, for VehicleFit.
namespace tilt_ropter::detail {

/// Places of the unknowns in the unknowns of a VehicleFit. Scales are logarithms of the ratio to
/// the given vehicle; all others are in SI units.
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

  /// What the actuators did in each window, for one set of lags: weighted means per rotor.
  struct Features {
    std::vector<RotorVector> lateral, vertical;  ///< thrust sin(tilt), thrust cos(tilt) [N]
    std::vector<RotorVector> turning;            ///< second derivative of the tilt [rad/s^2]
    std::vector<RotorVector> sine, cosine;       ///< second derivatives of sin, cos of the tilt
    double rate_limited = 0.0;
  };

  /// The log must outlive this.
  WindowModel(const VehicleLog<Rotors>& log, const Vehicle<Rotors>& given,
              const VehicleFitSettings& settings)
      : log_(log),
        given_(given),
        trust_mass_(settings.trust_mass),
        imu_position_(settings.imu_position),
        flight_(log, settings.window, settings.min_height, settings.imu_position) {}

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
      for (std::size_t k = 0; k < windows().size(); ++k) {
        const FlightWindow& w = windows()[k];
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
