// A loop of one's own, composed from the pieces: hover at 1.5 m against an unknown side wind.

#include <tilt_ropter/tilt_ropter.hpp>

#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: own_loop    hovers for 10 s and says how; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  const Vehicle<4> vehicle = tilt_ropter_vehicle();  // or your own
  const Allocation allocation(vehicle);              // wrench -> rotor speeds, tilt angles
  ActuatorModel<4> actuators(vehicle);               // where the servos are, without encoders
  WrenchObserver<> observer(vehicle.body);           // external force and torque
  ContactEstimator contact(vehicle);                 // what of it is the ground's
  Nmpc nmpc(vehicle);                                // the controller
  const auto reference = [](double) {                // any callable: time -> ReferencePoint
    ReferencePoint point;
    point.position << 0.0, 0.0, 1.5;
    return point;
  };

  Plant<4> robot(vehicle);  // your robot goes here: this one is simulated, standing on its wheels
  const Wrench<> wind{Eigen::Vector3d(0.5, 1.0, 0.0), Eigen::Vector3d::Zero()};
  AllocationResult<4> sent;
  for (int tick = 0; tick < 1000; ++tick) {  // 100 Hz for 10 s
    const double time = robot.time();
    const ActuatorState<4> applied{robot.actuators().rotor_speed,  // measured
                                   actuators.update(time, sent.command).tilt_angle};
    observer.update(time, robot.inertial_sample(), allocation.wrench(applied));
    contact.update(time, robot.body(), observer);
    (void)nmpc.prepare(time, reference, contact.estimate());       // before the state is measured
    const NmpcResult& result = nmpc.feedback(time, robot.body());  // after
    sent = allocation.allocate(time, result.wrench, result.rate, sent);
    actuators.update(time, sent.command);  // acts from now on
    robot.step(sent.command, wind, 0.01);
    if (tick % 100 == 99)
      std::printf("t %4.1f s  height %.3f m  wind %5.2f %5.2f %5.2f N  solve %.0f us\n",
                  robot.time(), robot.body().position.z(), observer.external().force.x(),
                  observer.external().force.y(), observer.external().force.z(),
                  result.report.prepare_us + result.report.feedback_us);
  }
  const double error = (robot.body().position - reference(0.0).position).norm();
  std::printf("position error %.4f m\n", error);
  return error < 0.01 ? 0 : 1;
}
