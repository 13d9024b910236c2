// Plan: composes a mission from pieces and checks it against the bounds of the controller.

#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: plan    prints a mission and its check; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  const Waypoint start{{0.0, 0.0, 1.5}, 0.0}, corner{{3.0, 0.0, 1.5}, pi / 2.0};
  TransitionSettings across;
  across.from = start;
  across.to = corner;
  FigureEightSettings eight;
  eight.center = corner.position;
  eight.yaw = corner.yaw;
  const Mission mission({{MissionPhase::hover, Hold(start, 1.0)},
                         {MissionPhase::air, Transition(across)},
                         {MissionPhase::air, FigureEight(eight)}});
  for (double t = 0.0; t <= mission.end_time(); t += 5.0) {
    const ReferencePoint point = mission(t);  // any callable of this form is a reference
    std::printf("t %4.1f s  %-5s  position %5.2f %5.2f %5.2f m  speed %.2f m/s\n", t,
                to_string(mission.phase(t)), point.position.x(), point.position.y(),
                point.position.z(), point.velocity.norm());
  }

  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  for (const NmpcSettings& settings : {nmpc_settings(vehicle), paper_nmpc_settings()}) {
    const auto violations =
        check_reference(mission, mission.start_time(), mission.end_time(), vehicle, settings);
    std::printf("%zu bounds exceeded\n", violations.size());
    for (const BoundViolation& v : violations)
      std::printf("  %s[%d] = %.2f at %.2f s, allowed is %.2f\n", v.bound, v.axis, v.required,
                  v.time, v.allowed);
  }
}
