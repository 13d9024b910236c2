#pragma once

#include "statistics.hpp"

#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <algorithm>
#include <iomanip>
#include <limits>
#include <optional>
#include <ostream>

/// The battery during a mission: energy, voltage, current and endurance.
namespace examples {

class BatteryFigures {
 public:
  /// Fraction of the charge that the endurance figures use, as in check_vehicle.
  static constexpr double usable = 0.8;

  /// Without a battery (unknown parameters) only the energy is known. The state of charge at the
  /// start is in [0, 1].
  explicit BatteryFigures(const tilt_ropter::BatteryParameters& parameters,
                          double state_of_charge = 1.0)
      : start_(state_of_charge) {
    if (tilt_ropter::is_known(parameters)) battery_.emplace(parameters, state_of_charge);
  }

  /// Call this after each step of the plant, of `step` [s], with the power during the step [W].
  void on_plant(tilt_ropter::MissionPhase phase, double time, double power, double step) {
    using tilt_ropter::MissionPhase;
    energy_ += power * step;
    if (phase == MissionPhase::air) air_.add(power);
    if (phase == MissionPhase::ground) ground_.add(power);
    if (!battery_) return;
    (void)battery_->update(time, power);
    load_ = battery_->load(power);
    min_voltage_ = std::min(min_voltage_, load_.voltage);
    max_current_ = std::max(max_current_, load_.current);
    if (load_.status == tilt_ropter::BatteryStatus::overloaded) overloaded_ += step;
    if (load_.status == tilt_ropter::BatteryStatus::empty) empty_ += step;
  }

  [[nodiscard]] bool known() const { return battery_.has_value(); }
  /// Current and voltage in the last step.
  [[nodiscard]] const tilt_ropter::BatteryLoad& load() const { return load_; }

  void print(std::ostream& out) const {
    const auto line = [&out](const char* key, double value, int digits) {
      out << key << ": " << std::fixed << std::setprecision(digits) << value << '\n';
    };
    line("energy_Wh", energy_ / 3600.0, 3);
    if (!battery_) return;
    const tilt_ropter::Battery full(battery_->parameters());
    const auto endurance = [&](const char* key, const Mean& power) {
      if (power.count() > 0) line(key, full.endurance(power.value(), 1.0 - usable) / 60.0, 2);
    };
    endurance("endurance_air_min", air_);
    endurance("endurance_ground_min", ground_);
    line("battery_used_percent", 100.0 * (start_ - battery_->state_of_charge()), 2);
    line("min_voltage_V", min_voltage_, 2);
    line("max_current_A", max_current_, 1);
    if (overloaded_ > 0.0) line("battery_overloaded_s", overloaded_, 2);
    if (empty_ > 0.0) line("battery_empty_s", empty_, 2);
  }

 private:
  double start_;
  std::optional<tilt_ropter::Battery> battery_;
  tilt_ropter::BatteryLoad load_;
  Mean air_, ground_;
  double energy_ = 0.0;  // [J]
  double min_voltage_ = std::numeric_limits<double>::infinity(), max_current_ = 0.0;
  double overloaded_ = 0.0, empty_ = 0.0;  // [s]
};

}  // namespace examples
