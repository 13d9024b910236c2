// Force as a reference: push on a wall with 5 N, slide along it by half a metre, and let go.

#include <tilt_ropter/tilt_ropter.hpp>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: push    pushes on a wall and prints the force; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserverd observer(vehicle.body, observer_settings(20.0));
  ContactEstimator contact(vehicle);
  NmpcSettings settings = nmpc_settings(vehicle);
  settings.time_limit = HUGE_VAL;  // none, as time is simulated
  Nmpc nmpc(vehicle, settings);

  SurfacePush push;  // what touches, where, and how hard
  push.surface.point.x() = 1.0;
  push.surface.tool.x() = 0.3;  // a rod ahead of the front propeller
  push.force = 5.0;
  const auto reference = [&push](double time) {
    ReferencePoint point;
    const double u = std::clamp((time - 5.0) / 4.0, 0.0, 1.0);  // of the slide, in 4 s
    point.position << 0.65, 1.0 + 0.5 * u * u * (3.0 - 2.0 * u), 1.5;
    point.velocity.y() = 0.75 * u * (1.0 - u);
    if (time > 1.0 && time < 13.0) point.push = push;  // comes closer, touches, holds the force
    return point;
  };

  Plant<4> robot(vehicle);
  robot.set_wall(Wall{push.surface.point, push.surface.normal, 0.5, 1e4, 0.0, push.surface.tool});
  BodyStated start;
  start.position = reference(0.0).position;
  AllocationResult<4> sent = allocation.allocate({{0, 0, 9.81 * vehicle.body.mass}, {0, 0, 0}}, {});
  robot.reset(start, sent.command);
  actuators.reset(sent.command);
  for (int i = 0; i < 1400; ++i) {  // 14 s
    const double time = robot.time();
    const auto& observed = observer.update(time, robot.inertial_sample(),
                                           allocation.wrench(actuators.update(time, sent.command)));
    (void)nmpc.prepare(time, reference,
                       contact.update(time, robot.body(), observed, reference(time)));
    const NmpcResult& result = nmpc.feedback(time, robot.body());
    sent = allocation.allocate(time, result.wrench, result.rate, sent);
    for (int k = 0; k < 10; ++k) robot.step(sent.command, {}, 0.001);
    if (i % 200 == 199)
      std::printf("t %4.1f s  force %3.1f N  y %4.2f m\n", robot.time(), robot.wall_force(),
                  robot.body().position.y());
  }
  return robot.wall_force() == 0.0 ? 0 : 1;
}
