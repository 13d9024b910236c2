#pragma once

#include "actuator_instances.hpp"
#include "wrench_level.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/optimal_control/solver_settings.hpp>

#include <optional>
#include <stdexcept>
#include <type_traits>

namespace examples {

/// The controller of the level that was chosen at run time, for a loop that knows the state of the
/// body. At the wrench level it also allocates.
template <int Rotors>
class LevelNmpc {
 public:
  using Actuators = tilt_ropter::ActuatorState<Rotors>;

  /// The wrench level. Throws std::invalid_argument if the vehicle has none.
  LevelNmpc(const tilt_ropter::Vehicle<Rotors>& vehicle, const tilt_ropter::NmpcSettings& settings)
      : body_(vehicle) {
    if constexpr (has_wrench_level<Rotors>)
      wrench_.emplace(vehicle, settings);
    else
      throw std::invalid_argument("LevelNmpc: the wrench level needs 4, 6 or 8 rotors");
  }
  /// The actuator level.
  LevelNmpc(const tilt_ropter::Vehicle<Rotors>& vehicle,
            const tilt_ropter::ActuatorNmpcSettings& settings)
      : body_(vehicle) {
    actuator_.emplace(vehicle, settings);
  }

  template <typename Reference>
  void prepare(double time, const Reference& reference,
               const tilt_ropter::ContactEstimate& contact) {
    with_nmpc([&](auto& nmpc) { (void)nmpc.prepare(time, reference, contact); });
  }

  /// Returns the rotor speeds and tilt angles to command; `applied` are those of now. Without a
  /// `body` the last plan goes on.
  const Actuators& control(double time, const std::optional<tilt_ropter::BodyStated>& body,
                           const Actuators& applied) {
    if (actuator_) {
      const auto& result = body ? actuator_->feedback(time, *body, applied) : actuator_->hold(time);
      sent_.command = result.command;
      take(result);
    }
    if constexpr (has_wrench_level<Rotors>)
      if (wrench_) {
        const auto& result = body ? wrench_->nmpc.feedback(time, *body) : wrench_->nmpc.hold(time);
        sent_ = wrench_->allocation.allocate(time, result.wrench, result.rate, sent_);
        take(result);
      }
    return sent_.command;
  }

  /// Returns the rotor speeds and tilt angles for a wrench of another controller, which changes at
  /// `rate`.
  const Actuators& give(double time, const tilt_ropter::Wrenchd& wrench,
                        const tilt_ropter::Wrenchd& rate) {
    if (actuator_) sent_.command = actuator_->command_for(wrench);
    if constexpr (has_wrench_level<Rotors>)
      if (wrench_) sent_ = wrench_->allocation.allocate(time, wrench, rate, sent_);
    return sent_.command;
  }

  /// The actuators stand still.
  void forget() { sent_ = {}; }
  /// The actuators give an upward `force` [N] and no torque.
  void start_with_lift(double force) {
    tilt_ropter::Wrenchd wrench;
    wrench.force.z() = force;
    if (actuator_) sent_.command = actuator_->command_for(wrench);
    if constexpr (has_wrench_level<Rotors>)
      if (wrench_) sent_ = wrench_->allocation.allocate(wrench, {});
  }

  /// The wrench of rotor speeds and tilt angles (body frame).
  [[nodiscard]] tilt_ropter::Wrenchd wrench_of(const Actuators& actuators) const {
    return body_.wrench(actuators);
  }
  [[nodiscard]] const Actuators& command() const { return sent_.command; }
  /// The planned wrench of the last control() (body frame).
  [[nodiscard]] const tilt_ropter::Wrenchd& wrench() const { return planned_; }
  [[nodiscard]] tilt_ropter::NmpcStatus status() const { return status_; }
  [[nodiscard]] const tilt_ropter::optimal_control::SolveReport& report() const { return report_; }

 private:
  struct WrenchLevel {
    WrenchLevel(const tilt_ropter::Vehicle<Rotors>& vehicle,
                const tilt_ropter::NmpcSettings& settings)
        : nmpc(vehicle, settings), allocation(vehicle) {}
    tilt_ropter::Nmpc<Rotors> nmpc;
    tilt_ropter::Allocation<Rotors> allocation;
  };
  struct Nothing {};

  template <typename Action>
  void with_nmpc(const Action& action) {
    if (actuator_) action(*actuator_);
    if constexpr (has_wrench_level<Rotors>)
      if (wrench_) action(wrench_->nmpc);
  }
  template <typename Result>
  void take(const Result& result) {
    planned_ = result.wrench;
    status_ = result.status;
    report_ = result.report;
  }

  tilt_ropter::ActuatedBody<Rotors> body_;
  std::conditional_t<has_wrench_level<Rotors>, std::optional<WrenchLevel>, Nothing> wrench_;
  std::optional<tilt_ropter::ActuatorNmpc<Rotors>> actuator_;
  tilt_ropter::AllocationResult<Rotors> sent_;
  tilt_ropter::Wrenchd planned_;
  tilt_ropter::NmpcStatus status_ = tilt_ropter::NmpcStatus::no_plan;
  tilt_ropter::optimal_control::SolveReport report_;
};

}  // namespace examples
