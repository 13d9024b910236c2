// Allocation from any wrench and any last command.

#include <tilt_ropter/actuation/allocation.hpp>

#include "fuzz/input.hpp"

#include <array>
#include <cmath>

using namespace tilt_ropter;

namespace {

Vehicle<4> vehicle_of_kind(std::size_t kind) {
  Vehicle<4> v = tilt_ropter_vehicle();
  if (kind == 1 || kind == 3) v.rotor.min_thrust = 0.4;
  if (kind == 2 || kind == 3) v.servo.min_angle = -1.5, v.servo.max_angle = 2.5;
  return v;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  static const std::array<Vehicle<4>, 4> vehicles = {vehicle_of_kind(0), vehicle_of_kind(1),
                                                     vehicle_of_kind(2), vehicle_of_kind(3)};
  static const std::array<Allocation<4>, 4> allocations = {
      Allocation<4>(vehicles[0]), Allocation<4>(vehicles[1]), Allocation<4>(vehicles[2]),
      Allocation<4>(vehicles[3])};
  fuzz::Input input(bytes, size);
  const auto kind = static_cast<std::size_t>(input.integer(0, 3));
  const Vehicle<4>& vehicle = vehicles[kind];
  const Allocation<4>& allocation = allocations[kind];
  AllocationResult<4> last;
  for (int i = 0; i < 4; ++i) {
    last.command.rotor_speed(i) = input.number(3000.0);
    last.command.tilt_angle(i) = input.number(3.0);
  }
  for (int tick = 0; tick < 20 && !input.empty(); ++tick) {
    const Wrenchd wanted = input.wrench(40.0, 4.0), rate = input.wrench(40.0, 4.0);
    const bool bad = !is_finite(wanted);
    const auto result = allocation.allocate(input.number(10.0), wanted, rate, last);
    fuzz::expect((result.status == AllocationStatus::rejected) == bad, "the status is honest");
    fuzz::expect(is_finite(result.achieved) && is_finite(result.lost), "wrenches are finite");
    const ActuatorState<4>& command = result.command;
    const double c = vehicle.rotor.thrust_coefficient, slack = 1.0 + 1e-9;
    for (int i = 0; i < 4; ++i) {
      const double thrust = c * command.rotor_speed(i) * command.rotor_speed(i);
      fuzz::expect(
          thrust * slack >= vehicle.rotor.min_thrust && thrust <= vehicle.rotor.max_thrust * slack,
          "thrusts are within limits");
      fuzz::expect(command.tilt_angle(i) >= vehicle.servo.min_angle &&
                       command.tilt_angle(i) <= vehicle.servo.max_angle,
                   "angles are within the servo's range");
    }
    fuzz::expect(is_finite(allocation.wrench(last.command)), "the wrench of any sensors is finite");
    if (!bad) {
      const auto now = allocation.allocate(wanted, last.command);
      const double scale = 100.0 + wanted.force.stableNorm() + wanted.torque.stableNorm();
      fuzz::expect(!gives_wrench(now.status) || (now.lost.force.stableNorm() <= 1e-9 * scale &&
                                                 now.lost.torque.stableNorm() <= 1e-9 * scale),
                   "nothing is lost unless the status says so");
    }
    last = result;
  }
  return 0;
}
