// Hardware in the loop, the vehicle: plant and sensors in real time. Sends sensor data to
// hitl_onboard and hitl_flight_controller, and applies the actuator commands of
// hitl_flight_controller.

#include "../support/mission_figures.hpp"
#include "../support/mission_sensors.hpp"
#include "../support/progress.hpp"
#include "link.hpp"
#include "options.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <CLI/CLI.hpp>

#include <chrono>
#include <cmath>
#include <cstdint>
#include <exception>
#include <iostream>
#include <string>
#include <thread>

using namespace tilt_ropter;

namespace {

struct Options {
  hitl::Addresses addresses;
  hitl::BadLine line;
  std::string vehicle;
  std::int64_t seed = 1;
  double mass_error = 0.03, inertia_error = 0.10;
  double until = 0.0;
};

constexpr double step = 1e-3;          // time step of the plant [s]
constexpr double head_start = 3.0;     // time on the ground for all programs to connect [s]
constexpr double command_timeout = 1;  // the rotors stop after this time without commands [s]

hitl::Message inertial(double time, const ImuSensor::Measurement& imu,
                       const Eigen::Vector4d& rotor_speeds) {
  hitl::Message m;
  m.type = hitl::MessageType::inertial;
  m.time = time;
  m.stamp = hitl::nanoseconds_now();
  Eigen::Map<Eigen::Matrix<double, 10, 1>>(m.values.data()) << imu.angular_velocity,
      imu.specific_force, rotor_speeds;
  return m;
}

hitl::Message pose(double time, const PoseSensor::Measurement& seen) {
  hitl::Message m;
  m.type = hitl::MessageType::pose;
  m.time = time;
  m.stamp = hitl::nanoseconds_now();
  const Eigen::Quaterniond& q = seen.orientation;
  Eigen::Map<Eigen::Matrix<double, 7, 1>>(m.values.data()) << seen.position, q.w(), q.x(), q.y(),
      q.z();
  return m;
}

int simulate(const Options& options) {
  const examples::VehicleFile file = examples::vehicle_or_default(options.vehicle);
  Vehicle<4> truth = examples::quadrotor(file);
  truth.body.mass *= 1.0 + options.mass_error;
  truth.body.inertia *= 1.0 + options.inertia_error;
  Plant<4> plant(truth);
  ActuatorState<4> command;
  const bool stands = undercarriage(truth).has_value();
  examples::MissionSensors<4> sensors(static_cast<std::uint64_t>(options.seed));
  const PowerModel power(truth);
  const Mission mission = hybrid_mission(truth);
  if (!stands) {  // in the air: hovers until the first command arrives
    Wrenchd weight;
    weight.force.z() = truth.body.mass * gravity;
    command = Allocation<4>(truth).allocate(weight, {}).command;
    BodyStated start;
    start.position = mission(0.0).position;
    plant.reset(start, command);
  }
  examples::MissionFigures figures(HybridMissionSettings{}.flight_height, options.vehicle.empty());
  const double end = options.until > 0.0 ? options.until : mission.duration();

  hitl::Link link(options.addresses.simulator,
                  {options.addresses.onboard, options.addresses.flight_controller}, options.line);
  hitl::Times round_trip, lateness;
  Eigen::Vector4d speeds = Eigen::Vector4d::Zero();
  std::uint64_t answered = 0;  // latest sample stamp that a command has returned
  double commanded_at = -1e9;
  long commands = 0, misses = 0, silences = 0;
  bool silent = true;
  examples::Progress progress;
  const auto start = hitl::Clock::now();
  double time = -head_start;
  for (long i = 0; time < end && hitl::interrupted == 0; ++i) {
    const auto due = start + i * std::chrono::milliseconds(1);
    std::this_thread::sleep_until(due);
    const std::chrono::duration<double, std::micro> late = hitl::Clock::now() - due;
    lateness.add(late.count());
    if (late.count() > 1000.0) ++misses;

    while (const auto m = link.receive()) {
      if (m->type != hitl::MessageType::actuators) continue;
      command.rotor_speed = Eigen::Map<const Eigen::Vector4d>(m->values.data());
      command.tilt_angle = Eigen::Map<const Eigen::Vector4d>(m->values.data() + 4);
      commanded_at = time;
      ++commands;
      if (m->stamp > answered) {
        round_trip.add(static_cast<double>(hitl::nanoseconds_now() - m->stamp) / 1e3);
        answered = m->stamp;
      }
    }
    const bool was_silent = silent;
    silent = time - commanded_at > command_timeout;
    if (silent && (stands || commands > 0)) command.rotor_speed.setZero();
    if (silent && !was_silent) ++silences;
    if (time >= 0.0 && commands == 0) {
      std::cerr << "hitl_simulator: no actuator commands received: are hitl_onboard and "
                   "hitl_flight_controller running?\n";
      return 1;
    }

    if (!plant.step(command, {}, step)) throw std::runtime_error("the plant rejected a step");
    time = plant.time() - head_start;
    if (const auto m = sensors.rotor_speeds.sample(plant.time(), plant.actuators().rotor_speed))
      speeds = m->rotor_speed;
    if (const auto m = sensors.imu.sample(plant.time(), plant.body().angular_velocity,
                                          plant.specific_force())) {
      const hitl::Message message = inertial(m->time - head_start, *m, speeds);
      link.send(0, message);
      link.send(1, message);
    }
    if (const auto m = sensors.poses.sample(plant.time(), plant.body()))
      link.send(0, pose(m->time - head_start, *m));
    if (time >= 0.0)
      figures.on_plant(mission.phase(time), plant.body().position, mission(time).position,
                       plant.body().velocity.z(), power.power(plant.actuators().rotor_speed),
                       plant.normal_forces().sum() > 0.0);
    if (i % 1000 == 0)
      progress.show(std::max(0.0, time / end),
                    time < 0.0 ? "waiting" : to_string(mission.phase(time)));
  }
  for (int i = 0; i < 5; ++i)  // repeated, since messages can be lost
    for (const std::size_t peer : {0U, 1U}) link.send(peer, {});
  progress.finish();
  figures.print_flight(std::cout);
  std::cout << "final_position_error_m: " << std::setprecision(4)
            << (plant.body().position - mission(time).position).norm() << '\n';
  round_trip.print(std::cout, "round_trip");
  lateness.print(std::cout, "simulator_lateness");
  std::cout << "simulator_deadline_misses: " << misses << "\nactuator_silences: " << silences
            << '\n';
  link.print(std::cout, "actuators", hitl::MessageType::actuators);
  std::cout << "foreign_datagrams: " << link.foreign() << '\n';
  return 0;
}

constexpr const char* footer = R"(
Flies the hybrid mission in real time with hitl_onboard and hitl_flight_controller. Their commands
must arrive within 3 s after the start. Without new actuator commands it holds the last command;
after 1 s the rotors stop. If restarted in flight, it starts a new mission, and the other programs
follow.

Exit code: 0 the mission is over, 1 no commands received or another error, 2 an invalid vehicle
file, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Hardware in the loop: the vehicle, its sensors and the world, in real time."};
  Options options;
  app.add_option("--seed", options.seed, "random seed of the sensor noise")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  app.add_option("--mass-error", options.mass_error, "true mass / mass in the controller - 1")
      ->check(CLI::Range(-0.5, 1.0))
      ->capture_default_str();
  app.add_option("--inertia-error", options.inertia_error,
                 "true inertia / inertia in the controller - 1")
      ->check(CLI::Range(-0.5, 1.0))
      ->capture_default_str();
  app.add_option("--until", options.until,
                 "end the flight at this mission time; 0: full mission [s]")
      ->check(CLI::Range(0.0, 1000.0))
      ->capture_default_str();
  hitl::add_options(app, options.addresses, options.line, options.vehicle);
  app.footer(footer);
  return hitl::run_program(app, "hitl_simulator", argc, argv, [&] { return simulate(options); });
}
