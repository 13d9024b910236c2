// Wrench observer: the force and torque on the vehicle that do not come from its rotors.

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: observe    estimates a gust; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  const Wrenchd weight{{0.0, 0.0, vehicle.body.mass * gravity}, {0.0, 0.0, 0.0}};
  const ActuatorState<4> hover = allocation.allocate(weight, {}).command;

  Plant<4> robot(vehicle);  // your robot goes here; it starts in the air, in hover
  BodyStated start;
  start.position.z() = 10.0;  // [m]
  robot.reset(start, hover);

  WrenchObserverd observer(vehicle.body, observer_settings(20.0));  // bandwidth [1/s]
  const Wrenchd gust{{1.0, -0.5, 0.0}, {0.0, 0.0, 0.02}};           // body frame [N; N m]
  for (int i = 0; i < 400; ++i) {                                   // IMU at 1 kHz
    robot.step(hover, i < 100 ? Wrenchd{} : gust, 0.001);
    // Inputs: the IMU sample, and the wrench of the rotors at measured speeds and tilt angles.
    const Wrenchd external =
        observer.update(robot.time(), robot.inertial_sample(), allocation.wrench(robot.actuators()))
            .external;
    if (i % 50 != 49) continue;
    std::printf("t %.2f s  force %5.2f %5.2f %5.2f N  torque %6.3f %6.3f %6.3f N m\n", robot.time(),
                external.force.x(), external.force.y(), external.force.z(), external.torque.x(),
                external.torque.y(), external.torque.z());
  }
}
