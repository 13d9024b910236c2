// A loop of your own, composed from the pieces: hover at 1.5 m in an unknown side wind.

#include <tilt_ropter/tilt_ropter.hpp>

#include <cmath>
#include <cstdio>
#include <string>

using namespace tilt_ropter;

int main(int argc, char** argv) {
  if (argc > 1) {
    std::puts("usage: own_loop    hovers for 10 s and prints the error; there are no options");
    return std::string(argv[1]) == "--help" ? 0 : 2;
  }
  const Vehicle<4> vehicle = tilt_ropter_vehicle();  // or your own
  const Allocation allocation(vehicle);              // wrench -> rotor speeds, tilt angles
  ActuatorModel<4> actuators(vehicle);               // servo angles, and slow rotors
  Ekfd ekf;                                          // position, velocity, attitude, biases
  WrenchObserverd observer(vehicle.body, observer_settings(20.0));  // external force and torque
  ContactEstimator contact(vehicle);                                // the ground's part of it
  NmpcSettings settings = nmpc_settings(vehicle);
  settings.time_limit = HUGE_VAL;  // none, as time is simulated; on a robot, keep the default
  Nmpc nmpc(vehicle, settings);
  ReferencePoint hover;
  hover.position << 0.0, 0.0, 1.5;
  const auto reference = [&hover](double) { return hover; };  // any callable: time -> point

  Plant<4> robot(vehicle);  // your robot and its sensors go here; these are simulated
  ImuSensor imu({}, 1);
  PoseSensor poses({}, 2);
  const Wrenchd wind{Eigen::Vector3d(0.5, 1.0, 0.0), Eigen::Vector3d::Zero()};
  AllocationResult<4> sent;
  ObservedWrenchd observed;
  for (int i = 0; i < 10000; ++i) {  // IMU and robot at 1 kHz, the controller at 100 Hz, for 10 s
    const double time = robot.time();
    if (const auto m = imu.sample(time, robot.body().angular_velocity, robot.specific_force())) {
      const ActuatorState<4>& applied =  // measured speeds, modelled angles
          actuators.update(time, sent.command, robot.actuators().rotor_speed);
      ekf.on_imu(m->time, *m);
      observed = observer.update(m->time, ekf.corrected(*m), allocation.wrench(applied));
    }
    if (const auto m = poses.sample(time, robot.body())) ekf.on_pose(m->time, *m);
    if (i % 10 == 0 && ekf.running()) {  // it has a pose and an IMU
      const BodyStated state = ekf.take_state();
      const ContactEstimate& ground = contact.update(time, state, observed);
      (void)nmpc.prepare(time, reference, ground);  // feedback() has the status
      const NmpcResult& result = nmpc.feedback(time, state);
      sent = allocation.allocate(time, result.wrench, result.rate, sent);
      actuators.update(time, sent.command);  // acts from now on
    }
    robot.step(actuators.to_send(sent.command), wind, 0.001);  // corrects slow rotors
    if (i % 5000 == 4999)
      std::printf("t %4.1f s  height %.3f m  wind %5.2f %5.2f %5.2f N\n", robot.time(),
                  robot.body().position.z(), observed.external.force.x(),
                  observed.external.force.y(), observed.external.force.z());
  }
  const double error = (robot.body().position - hover.position).norm();
  std::printf("position error %.4f m\n", error);
  return error < 0.02 ? 0 : 1;
}
