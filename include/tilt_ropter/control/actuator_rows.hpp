// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>

/// What servos and rotors can do, as rows of the optimal-control problem (beyond the paper, whose
/// box on the wrench rate lets an arm of little thrust turn at any speed).
namespace tilt_ropter {

/// How much of the actuators a plan may use.
struct ActuatorRowSettings {
  /// Share of the servo's max_rate that a plan may ask for. What reaches the servo is more: a
  /// command that is held for h seconds and runs ahead to invert a lag of T asks for h / (2 T) on
  /// top, 6 % at 100 Hz and 80 ms, and about 10 % come from AllocationParameters.calm_share, by
  /// which commands run ahead farther while a thrust grows.
  double tilt_rate_share = 0.85;
  /// A rotor of less thrust counts as one of this thrust, since its tilt rate is not defined at
  /// zero; as in AllocationParameters [N].
  double hold_thrust = 0.02;
};

inline void validate(const ActuatorRowSettings& s) {
  require(s.tilt_rate_share > 0.0 && s.tilt_rate_share <= 1.0,
          "ActuatorRowSettings.tilt_rate_share", s.tilt_rate_share, "in (0, 1]");
  require_positive("ActuatorRowSettings.hold_thrust [N]", s.hold_thrust);
}

/// Three rows for each rotor under a wrench W = (F, M) that moves at u = dW/dt. With the least
/// thrusts T = A^+ W, dT = A^+ u (see AllocationMatrix) and r = tilt_rate_share max_rate
///
///     ( (dT_l T_v - T_l dT_v) - r max(T_l^2 + T_v^2, hold_thrust^2)) / h^2 <= 0
///     (-(dT_l T_v - T_l dT_v) - r max(T_l^2 + T_v^2, hold_thrust^2)) / h^2 <= 0
///     sqrt(T_l^2 + T_v^2) <= effectiveness max_thrust_at(voltage),
///
/// first the first of all rotors, then the second, then the third. h is the thrust of one rotor in
/// hover, so there the first two are rad/s beyond r. Divided by the thrust's own square they would
/// be so everywhere, in one row with two sides, but nearly singular on the ground, where the
/// thrusts are a thirtieth: one linearisation per tick does not follow that. While u is constant
/// dT_l T_v - T_l dT_v is, too, so between two nodes a tilt rate grows only where the thrust
/// shrinks.
///
/// Wrenches that need the null space of A have other thrusts; the rows do not know of it. A rotor
/// that does not tilt has the third row only, a lost one none.
template <int Rotors>
class ActuatorRows {
 public:
  static constexpr int rows = 3 * Rotors;
  using Values = Eigen::Matrix<double, rows, 1>;
  using Vector = Eigen::Matrix<double, 6, 1>;

  /// No bounds: values and derivatives are zero and take no time.
  ActuatorRows() = default;

  /// Throws std::invalid_argument for a vehicle, settings or a geometry out of range.
  explicit ActuatorRows(const Vehicle<Rotors>& vehicle, const ActuatorRowSettings& settings = {})
      : enabled_(true) {
    validate(vehicle);
    validate(settings);
    pseudoinverse_ = AllocationMatrix<Rotors>(vehicle).pseudoinverse;
    const double hover = vehicle.body.mass * gravity / Rotors;
    scale_ = 1.0 / (hover * hover);
    hold_square_ = settings.hold_thrust * settings.hold_thrust;
    battery_ = vehicle.battery;
    for (int i = 0; i < Rotors; ++i) {
      const auto k = static_cast<std::size_t>(i);
      const RotorGeometry& geometry = vehicle.rotors[k];
      rotors_[k] = rotor_parameters(vehicle, k);
      effectiveness_[k] = geometry.effectiveness;
      if (!(geometry.effectiveness > 0.0)) continue;
      upper_(2 * Rotors + i) = geometry.effectiveness * rotors_[k].max_thrust;
      if (!geometry.tilts) continue;
      servo_rate_(i) = vehicle.servo.max_rate;
      upper_(i) = upper_(Rotors + i) = 0.0;
    }
    max_rate_ = settings.tilt_rate_share * servo_rate_;
  }

  /// The same rows with other settings. Allocates nothing; throws std::invalid_argument for
  /// settings out of range.
  [[nodiscard]] ActuatorRows with(const ActuatorRowSettings& settings) const {
    validate(settings);
    ActuatorRows changed = *this;
    changed.hold_square_ = settings.hold_thrust * settings.hold_thrust;
    changed.max_rate_ = settings.tilt_rate_share * servo_rate_;
    return changed;
  }

  /// Takes the measured `voltage` of the battery [V], with which the bounds of the thrusts fall.
  /// Returns whether voltage_ratio() accepts it; if not, and without bounds, nothing changes.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(battery_, voltage);
    if (!ratio) return false;
    for (int i = 0; i < Rotors; ++i) {
      const auto k = static_cast<std::size_t>(i);
      if (effectiveness_[k] > 0.0)
        upper_(2 * Rotors + i) = effectiveness_[k] * max_thrust_at(rotors_[k], *ratio);
    }
    return true;
  }

  /// Upper bounds of the rows, infinite for what is not bounded; there are no lower ones.
  [[nodiscard]] const Values& upper() const { return upper_; }

  [[nodiscard]] Values values(const Vector& wrench, const Vector& rate) const {
    Values value = Values::Zero();
    if (!enabled_) return value;
    for (int i = 0; i < Rotors; ++i) {
      const Rotor r = rotor(i, wrench, rate);
      const double allowed = max_rate_(i) * std::fmax(r.square, hold_square_);
      value(i) = scale_ * (r.cross - allowed);
      value(Rotors + i) = scale_ * (-r.cross - allowed);
      value(2 * Rotors + i) = std::sqrt(r.square);
    }
    return value;
  }

  /// Writes the derivatives by wrench and by its rate, rows x 6 each, but for those of the thrusts
  /// by the rate, which are zero. A thrust of zero has no derivative; zero, one of its
  /// subgradients, stands for it. Without bounds nothing is written.
  template <typename ByWrench, typename ByRate>
  void derivatives(const Vector& wrench, const Vector& rate, ByWrench&& by_wrench,
                   ByRate&& by_rate) const {
    if (!enabled_) return;
    for (int i = 0; i < Rotors; ++i) {
      const Rotor r = rotor(i, wrench, rate);
      const bool held = r.square < hold_square_;
      const double by_square = held ? 0.0 : 2.0 * scale_ * max_rate_(i),
                   per_thrust = r.square > 0.0 ? 1.0 / std::sqrt(r.square) : 0.0;
      for (int j = 0; j < 6; ++j) {
        const double lateral = pseudoinverse_(2 * i, j), vertical = pseudoinverse_(2 * i + 1, j);
        const double half_square = r.lateral * lateral + r.vertical * vertical,
                     cross = scale_ * (r.lateral_rate * vertical - r.vertical_rate * lateral),
                     cross_by_rate = scale_ * (r.vertical * lateral - r.lateral * vertical);
        by_wrench(i, j) = cross - by_square * half_square;
        by_wrench(Rotors + i, j) = -cross - by_square * half_square;
        by_wrench(2 * Rotors + i, j) = per_thrust * half_square;
        by_rate(i, j) = cross_by_rate;
        by_rate(Rotors + i, j) = -cross_by_rate;
      }
    }
  }

 private:
  struct Rotor {
    double lateral, vertical, lateral_rate, vertical_rate;  // T_l, T_v [N], dT_l, dT_v [N/s]
    double square, cross;  // T_l^2 + T_v^2 [N^2], dT_l T_v - T_l dT_v [N^2/s]
  };

  [[nodiscard]] Rotor rotor(int i, const Vector& wrench, const Vector& rate) const {
    Rotor r{};
    for (int j = 0; j < 6; ++j) {
      const double lateral = pseudoinverse_(2 * i, j), vertical = pseudoinverse_(2 * i + 1, j);
      r.lateral += lateral * wrench(j);
      r.vertical += vertical * wrench(j);
      r.lateral_rate += lateral * rate(j);
      r.vertical_rate += vertical * rate(j);
    }
    r.square = r.lateral * r.lateral + r.vertical * r.vertical;
    r.cross = r.lateral_rate * r.vertical - r.lateral * r.vertical_rate;
    return r;
  }

  bool enabled_ = false;
  double scale_ = 0.0, hold_square_ = 0.0;  // [1/N^2], [N^2]
  BatteryParameters battery_;               // of no voltage without bounds
  std::array<RotorParameters, static_cast<std::size_t>(Rotors)> rotors_{};
  std::array<double, static_cast<std::size_t>(Rotors)> effectiveness_{};
  using PerRotor = Eigen::Matrix<double, Rotors, 1>;
  PerRotor servo_rate_ = PerRotor::Zero(), max_rate_ = PerRotor::Zero();  // [rad/s]
  Values upper_ = Values::Constant(std::numeric_limits<double>::infinity());
  Eigen::Matrix<double, 2 * Rotors, 6, Eigen::RowMajor> pseudoinverse_ =
      Eigen::Matrix<double, 2 * Rotors, 6, Eigen::RowMajor>::Zero();
};

/// None: the problem has the paper's rows alone.
template <>
class ActuatorRows<0> {
 public:
  static constexpr int rows = 0;
};

}  // namespace tilt_ropter
