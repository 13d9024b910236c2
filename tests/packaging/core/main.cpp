// Allocates, estimates, keeps settings and identifies, without a solver.

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/identification/servo_identification.hpp>

int main() {
  using namespace tilt_ropter;
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const NmpcSettings settings = nmpc_settings(vehicle);
  validate(settings);
  const Allocation allocation(vehicle);
  WrenchObserverd observer(vehicle.body);
  Wrenchd weight;
  weight.force.z() = vehicle.body.mass * gravity;
  const ActuatorState<4> command = allocation.allocate(weight, {}).command;
  (void)observer.update(0.0, {}, allocation.wrench(command));
  const ServoIdentification none = identify_servo(ServoLog{});
  const bool refused = none.status == ServoIdentificationStatus::too_few_samples;
  return command.rotor_speed.minCoeff() > 0.0 && refused ? 0 : 1;
}
