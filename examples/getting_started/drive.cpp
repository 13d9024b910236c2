// Drive: on its wheels, the vehicle follows a figure eight with tilted rotors and little power.

#include <tilt_ropter/tilt_ropter.hpp>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: drive    drives a figure eight; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Plant<4> robot(vehicle);  // your robot goes here: it stands on its wheels
  FigureEightSettings settings;
  settings.center = robot.body().position;
  settings.amplitude << 2.0, 0.6, 0.0;  // [m], level
  settings.heading = HeadingMode::along_velocity;
  settings.laps = 1;
  FigureEight eight(settings);
  eight.set_start_time(1.0);  // [s]

  const Allocation allocation(vehicle);
  WrenchObserverd observer(vehicle.body, observer_settings(20.0));
  ContactEstimator contact(vehicle);  // estimates the ground and its force
  NmpcSettings control = nmpc_settings(vehicle);
  control.time_limit = HUGE_VAL;  // none, as time is simulated; on a robot, keep the default
  Nmpc nmpc(vehicle, control);
  const PowerModel power(vehicle);
  AllocationResult<4> sent;
  ObservedWrenchd observed;
  double worst = 0.0, energy = 0.0;
  while (robot.time() < eight.end_time()) {  // the controller at 100 Hz, the IMU at 1 kHz
    const double time = robot.time();
    (void)nmpc.prepare(time, eight, contact.update(time, robot.body(), observed));
    const NmpcResult& result = nmpc.feedback(time, robot.body());
    sent = allocation.allocate(time, result.wrench, result.rate, sent);
    for (int i = 0; i < 10; ++i) {
      robot.step(sent.command, {}, 0.001);
      observed = observer.update(robot.time(), robot.inertial_sample(),
                                 allocation.wrench(robot.actuators()));
      energy += 0.001 * power.power(robot.actuators().rotor_speed);
    }
    worst = std::max(worst, (robot.body().position - eight(robot.time()).position).norm());
  }
  std::printf("drove %.0f s, largest error %.1f mm, mean power %.0f W of %.0f W in hover\n",
              robot.time(), 1e3 * worst, energy / robot.time(), vehicle.power.hover);
  return worst < 0.05 ? 0 : 1;
}
