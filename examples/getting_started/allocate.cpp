// Allocation: computes rotor speeds and tilt angles for a wanted force and torque.

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: allocate    prints the commands for four wrenches; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  const Vehicle<4> vehicle = tilt_ropter_vehicle();  // the paper's vehicle; plain data
  const Allocation allocation(vehicle);
  const double weight = vehicle.body.mass * gravity;  // [N]

  struct Case {
    const char* name;
    Wrenchd wrench;  // body frame, at the CoM: force [N], torque [N m]
  };
  const Case cases[] = {
      {"hover", {{0.0, 0.0, weight}, {0.0, 0.0, 0.0}}},
      {"push forward", {{2.0, 0.0, weight}, {0.0, 0.0, 0.0}}},
      {"turn left", {{0.0, 0.0, weight}, {0.0, 0.0, 0.5}}},
      {"too much", {{60.0, 0.0, weight}, {0.0, 0.0, 0.0}}},
  };
  for (const Case& c : cases) {
    // The second argument is the previous result: here the vehicle starts with level rotors.
    const AllocationResult<4> result = allocation.allocate(c.wrench, {});
    std::printf("%-12s  speeds", c.name);
    for (const double speed : result.command.rotor_speed) std::printf(" %4.0f", speed);
    std::printf(" rad/s  tilt");
    for (const double angle : result.command.tilt_angle) std::printf(" %5.1f", angle * 180.0 / pi);
    const double missing = (c.wrench.force - result.achieved.force).norm();
    std::printf(" deg  missing force %.1f N\n", missing);
  }
}
