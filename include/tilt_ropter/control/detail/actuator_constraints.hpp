// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>

/// Servo and rotor limits as constraints of the optimal-control problem. They go beyond the paper.
/// The paper's box on the wrench rate lets an arm with little thrust turn at any speed.
namespace tilt_ropter {

/// Three constraints for each rotor under a wrench W = (F, M) with the rate u = dW/dt. With the
/// minimum-norm thrusts T = A^+ W, dT = A^+ u (see AllocationMatrix) and
/// r = tilt_rate_fraction max_rate:
///
///     ( (dT_l T_v - T_l dT_v) - r max(T_l^2 + T_v^2, hold_thrust^2)) / h^2 <= 0
///     (-(dT_l T_v - T_l dT_v) - r max(T_l^2 + T_v^2, hold_thrust^2)) / h^2 <= 0
///     sqrt(T_l^2 + T_v^2) <= effectiveness max_thrust_at(voltage),
///
/// Order: the first constraint of all rotors, then the second, then the third. h is the thrust of
/// one rotor in hover. At this thrust the first two values are the excess of the tilt rate over r
/// [rad/s]. Division by the rotor's own squared thrust would give rad/s at every thrust, and one
/// two-sided constraint. But this form is nearly singular on the ground, where the thrusts are 30
/// times smaller: one linearisation per tick cannot follow it. While u is constant,
/// dT_l T_v - T_l dT_v is constant, too. Between two nodes a tilt rate therefore grows only where
/// the thrust shrinks.
///
/// A wrench that needs the null space of A has other thrusts than A^+ W. The constraints ignore the
/// null space. A rotor that does not tilt has only the third constraint. A lost rotor has none.
/// With `Rotors` = 0 the problem has only the paper's constraints.
template <int Rotors>
class ActuatorConstraints {
 public:
  static constexpr int count = 3 * Rotors;
  using Values = Eigen::Matrix<double, count, 1>;
  using Vector = Eigen::Matrix<double, 6, 1>;
  /// Smallest thrust in the tilt-rate constraint [N]: a rotor with less thrust counts as a rotor
  /// with this thrust, because the tilt rate is not defined at zero thrust. Same meaning as in
  /// AllocationSettings.
  static constexpr double hold_thrust = 0.02;

  /// No bounds: values and derivatives are zero and cost no time.
  ActuatorConstraints() = default;

  /// For FlightBounds::tilt_rate_fraction. Throws std::invalid_argument if the vehicle or the
  /// geometry are out of range.
  explicit ActuatorConstraints(const Vehicle<Rotors>& vehicle,
                               double tilt_rate_fraction = NmpcBounds().tilt_rate_fraction)
      : enabled_(true), vehicle_(validated(vehicle)) {
    pseudoinverse_ = AllocationMatrix<Rotors>(vehicle).pseudoinverse;
    const double hover = vehicle.body.mass * gravity / Rotors;
    scale_ = 1.0 / (hover * hover);
    for (int i = 0; i < Rotors; ++i) {
      const auto k = static_cast<std::size_t>(i);
      const RotorGeometry& geometry = vehicle.rotors[k];
      if (!(geometry.effectiveness > 0.0)) continue;
      upper_(2 * Rotors + i) = geometry.effectiveness * rotor_parameters(vehicle, k).max_thrust;
      if (!geometry.tilts) continue;
      servo_rate_(i) = vehicle.servo.max_rate;
      upper_(i) = upper_(Rotors + i) = 0.0;
    }
    max_rate_ = tilt_rate_fraction * servo_rate_;
  }

  /// Returns the same constraints with another FlightBounds::tilt_rate_fraction. Does not allocate.
  [[nodiscard]] ActuatorConstraints with(double tilt_rate_fraction) const noexcept {
    ActuatorConstraints changed = *this;
    changed.max_rate_ = tilt_rate_fraction * servo_rate_;
    return changed;
  }

  /// Sets the measured `voltage` of the battery [V]. The thrust bounds fall with the voltage.
  /// Returns true if voltage_ratio() accepts the voltage; if not, or without bounds, nothing
  /// changes.
  bool set_voltage(double voltage) noexcept {
    const std::optional<double> ratio = voltage_ratio(vehicle_.battery, voltage);
    if (!ratio) return false;
    for (int i = 0; i < Rotors; ++i) {
      const auto k = static_cast<std::size_t>(i);
      const double effectiveness = vehicle_.rotors[k].effectiveness;
      if (effectiveness > 0.0)
        upper_(2 * Rotors + i) =
            effectiveness * max_thrust_at(rotor_parameters(vehicle_, k), *ratio);
    }
    return true;
  }

  /// Upper bounds of the constraints, infinite where there is no bound. There are no lower bounds.
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

  /// Writes the derivatives by the wrench and by its rate, count x 6 each. The derivatives of the
  /// thrusts by the rate are zero and are not written. At zero thrust there is no derivative; zero,
  /// one of the subgradients, is used instead. Without bounds nothing is written.
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

  /// Adds the second derivatives of the thrust constraints by the wrench to `hessian` (6 x 6), each
  /// times its multiplier. `multipliers`: of all constraints; those <= 0 add nothing. The thrust is
  /// a convex function of the wrench, so the sum is positive semidefinite. Below hold_thrust the
  /// second derivative at hold_thrust is used, so it is finite. The tilt-rate constraints are not
  /// convex and add nothing.
  template <typename Multipliers, typename Hessian>
  void add_curvature(const Vector& wrench, const Multipliers& multipliers,
                     Hessian&& hessian) const {
    for (int i = 0; i < Rotors; ++i) {
      const double multiplier = multipliers(2 * Rotors + i);
      if (!(enabled_ && multiplier > 0.0)) continue;
      const Rotor r = rotor(i, wrench, Vector::Zero());
      if (!(r.square > 0.0)) continue;
      const double thrust = std::sqrt(r.square);
      Vector across;  // derivative of the thrust at right angles to its direction
      for (int j = 0; j < 6; ++j)
        across(j) = (r.vertical / thrust) * pseudoinverse_(2 * i, j) -
                    (r.lateral / thrust) * pseudoinverse_(2 * i + 1, j);
      const double factor = multiplier / std::fmax(thrust, std::sqrt(hold_square_));
      for (int k = 0; k < 6; ++k)
        for (int j = 0; j < 6; ++j) hessian(j, k) += factor * across(j) * across(k);
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
  static constexpr double hold_square_ = hold_thrust * hold_thrust;
  double scale_ = 0.0;  // [1/N^2]
  using PerRotor = Eigen::Matrix<double, Rotors, 1>;
  PerRotor servo_rate_ = PerRotor::Zero(), max_rate_ = PerRotor::Zero();  // [rad/s]
  Values upper_ = Values::Constant(std::numeric_limits<double>::infinity());
  Eigen::Matrix<double, 2 * Rotors, 6, Eigen::RowMajor> pseudoinverse_ =
      Eigen::Matrix<double, 2 * Rotors, 6, Eigen::RowMajor>::Zero();
  Vehicle<Rotors> vehicle_{};  // its battery has no voltage if there are no bounds
};

}  // namespace tilt_ropter
