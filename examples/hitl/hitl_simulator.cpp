// Hardware in the loop, the vehicle: plant and sensors in real time. Sends sensor data to
// hitl_onboard and hitl_flight_controller, and applies the actuator commands of
// hitl_flight_controller.

#include "../support/control_level.hpp"
#include "../support/flight_mcap.hpp"
#include "../support/level_nmpc.hpp"
#include "../support/loss_watch.hpp"
#include "../support/mission_figures.hpp"
#include "../support/mission_sensors.hpp"
#include "../support/progress.hpp"
#include "link.hpp"
#include "options.hpp"

#ifdef HITL_SIMULATOR_MUJOCO
#include "../mujoco/plant.hpp"
#endif

#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <iostream>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <variant>
#include <vector>

using namespace tilt_ropter;

namespace {

struct Options {
  hitl::Line line;
  std::string vehicle, plant = "plant", mcap;
  std::int64_t seed = 1;
  double mass_error = 0.03, inertia_error = 0.10;
  double until = 0.0;
};

constexpr double step = 1e-3;       // time step of the plant [s]
constexpr long steps_of_tick = 10;  // of hitl_onboard

template <int Rotors, typename SimulatedPlant>
examples::FlightSample flight_sample(const Mission& mission, const SimulatedPlant& plant,
                                     const ActuatorState<Rotors>& command, double power,
                                     bool silent) {
  const double time = plant.time() - hitl::head_start;
  const ReferencePoint point = mission(time);
  examples::FlightSample s;
  s.time = plant.time();
  s.truth = plant.body();
  s.reference.position = point.position;
  s.reference.orientation = point.orientation;
  s.true_external = plant.external_wrench();
  s.tilt_command = command.tilt_angle;
  s.tilt = plant.actuators().tilt_angle;
  s.speed_command = command.rotor_speed;
  s.speed = plant.actuators().rotor_speed;
  s.power = power;
  s.phase = time < 0.0 ? "waiting" : to_string(mission.phase(time));
  s.mode = silent ? "silent" : "commanded";
  return s;
}

/// Flies `plant`, which is a Plant or a MujocoPlant of the vehicle `truth`, from the command
/// `hover` on if it has no undercarriage.
template <int Rotors, typename SimulatedPlant>
int simulate(const Options& options, const Vehicle<Rotors>& truth,
             const ActuatorState<Rotors>& hover, SimulatedPlant&& plant) {
  ActuatorState<Rotors> command;
  const bool stands = undercarriage(truth).has_value();
  examples::MissionSensors<Rotors> sensors(static_cast<std::uint64_t>(options.seed));
  const PowerModel power(truth);
  const Mission mission = hybrid_mission(truth);
  if (!stands) {  // in the air: hovers until the first command arrives
    command = hover;
    BodyStated start;
    start.position = mission(0.0).position;
    plant.reset(start, command);
  }
  examples::MissionFigures figures(HybridMissionSettings{}.flight_height, options.vehicle.empty());
  const double end = options.until > 0.0 ? options.until : mission.duration();

  const dds::Participant participant(loops::ros_domain());
  hitl::Rival<sensor_msgs::msg::Imu> rival(participant, hitl::imu_topic);
  dds::Publisher<sensor_msgs::msg::Imu> imu(participant, hitl::imu_topic.name,
                                            hitl::imu_topic.offered());
  dds::Publisher<sensor_msgs::msg::JointState> rotor_speeds(
      participant, hitl::rotor_speeds_topic.name, hitl::rotor_speeds_topic.offered());
  dds::Publisher<geometry_msgs::msg::PoseStamped> poses(participant, hitl::pose_topic.name,
                                                        hitl::pose_topic.offered());
  dds::Publisher<rosgraph_msgs::msg::Clock> clock(participant, "/clock", {true, 1});
  dds::Publisher<std_msgs::msg::Bool> flight_over(participant, hitl::flight_over_topic, {true, 1});
  hitl::Inbox<actuator_msgs::msg::Actuators, Rotors> actuators(participant, hitl::actuators_topic,
                                                               options.line);
  dds::WaitSet waiting(participant);
  waiting.add(actuators.subscriber());
  hitl::Encoder encoder;
  hitl::Times round_trip, lateness;
  std::vector<hitl::Clock::time_point> sent_at;  // the IMU sample of each step
  std::size_t answered = 0;                      // latest step whose sample led to a command
  long misses = 0, silences = 0;
  bool silent = true;
  examples::Progress progress;
  examples::LossWatch loss;
  std::optional<examples::FlightMcap> mcap;
  if (!options.mcap.empty()) mcap.emplace(options.mcap, Rotors);
  const bool lock_step = options.line.lock_step > 0.0;
  const auto take = [&] {
    const auto now = hitl::Clock::now();
    actuators.take(
        lock_step ? hitl::time_point(plant.time()) : now,
        [&](const hitl::ActuatorCommand<Rotors>& m) {
          command = m.command;
          const auto sample = static_cast<std::size_t>(std::max(0L, std::lround(m.time / step)));
          if (sample > answered && sample <= sent_at.size()) {
            const std::chrono::duration<double, std::micro> passed = now - sent_at[sample - 1];
            round_trip.add(passed.count());
            answered = sample;
          }
        });
  };
  const auto start = hitl::Clock::now();
  double time = -hitl::head_start;
  for (long i = 0; time < end && hitl::interrupted == 0; ++i) {
    if (!lock_step) {
      const auto due = start + i * std::chrono::milliseconds(1);
      std::this_thread::sleep_until(due);
      const std::chrono::duration<double, std::micro> late = hitl::Clock::now() - due;
      lateness.add(late.count());
      if (late.count() > 1000.0) ++misses;
    }
    rival.check(hitl::Clock::now());
    take();
    if (lock_step && i % steps_of_tick == 0) {
      // The first ticks have no command: hitl_onboard has no pose yet, or is not connected.
      const double most = actuators.sessions() > 0 ? options.line.lock_step
                                                   : std::min(options.line.lock_step, 0.05);
      const auto until = hitl::Clock::now() + hitl::time_point(most).time_since_epoch();
      while (answered < sent_at.size() && hitl::Clock::now() < until) {
        waiting.wait(10 * hitl::millisecond);
        take();
      }
    }
    const bool commanded = actuators.sessions() > 0;
    const bool was_silent = silent;
    silent = actuators.silent();
    if (silent && (stands || commanded)) command.rotor_speed.setZero();
    if (silent && !was_silent) {
      ++silences;
      std::cerr << "hitl_simulator: hitl_flight_controller is "
                << (actuators.sender_lives() ? "silent\n" : "gone\n");
    }
    if (time >= 0.0 && !commanded) {
      std::cerr << "hitl_simulator: no actuator commands received: are hitl_onboard and "
                   "hitl_flight_controller running?\n";
      return 1;
    }

    if (!plant.step(command, {}, step)) throw std::runtime_error("the plant rejected a step");
    time = plant.time() - hitl::head_start;
    if (const auto m = sensors.rotor_speeds.sample(plant.time(), plant.actuators().rotor_speed))
      rotor_speeds.publish(encoder.encode(hitl::RotorSpeeds<Rotors>{m->time, m->rotor_speed}));
    if (const auto m = sensors.poses.sample(plant.time(), plant.body())) {
      const MarkerPosed pose{m->position, m->orientation};
      poses.publish(encoder.encode(hitl::Pose{m->time, pose}));
      if (mcap) mcap->on_pose(m->time, pose);
    }
    sent_at.push_back(hitl::Clock::now());
    if (const auto m =  // last, because a tick on board begins when it arrives
        sensors.imu.sample(plant.time(), plant.body().angular_velocity, plant.specific_force())) {
      const InertialSampled sample{m->angular_velocity, m->specific_force};
      imu.publish(encoder.encode(hitl::Inertial{m->time, sample}));
      if (mcap) mcap->on_imu(m->time, sample);
    }
    if (!silent) loss.on_step(time, 0.0, examples::is_tipped(plant.body().orientation));
    if (i % 10 == 0) clock.publish({loops::stamp(std::llround(1e9 * plant.time()))});
    const double watts = power.power(plant.actuators().rotor_speed);
    if (time >= 0.0)
      figures.on_plant(mission.phase(time), plant.body().position, mission(time).position,
                       plant.body().velocity.z(), watts, plant.normal_forces().sum() > 0.0);
    if (mcap && i % 10 == 0) mcap->on_tick(flight_sample(mission, plant, command, watts, silent));
    if (i % 1000 == 0)
      progress.show(std::max(0.0, time / end),
                    time < 0.0 ? "waiting" : to_string(mission.phase(time)));
  }
  if (mcap) mcap->close();
  flight_over.publish({true});  // reliable: DDS repeats it until it has arrived
  progress.finish();
  figures.print_flight(std::cout);
  std::cout << "final_position_error_m: " << std::setprecision(4)
            << (plant.body().position - mission(time).position).norm() << '\n';
  round_trip.print(std::cout, "round_trip");
  lateness.print(std::cout, "simulator_lateness");
  std::cout << "simulator_deadline_misses: " << misses << "\nactuator_silences: " << silences
            << '\n';
  actuators.print(std::cout, "actuators");
  std::cout << "foreign_datagrams: " << actuators.counts().rejected << '\n';
  if (loss.sentence().empty()) return 0;
  std::cerr << "hitl_simulator: " << loss.sentence() << '\n';
  return 1;
}

template <int Rotors>
int simulate(const Options& options, const examples::VehicleFile& file, Vehicle<Rotors> truth) {
  truth.body.mass *= 1.0 + options.mass_error;
  truth.body.inertia *= 1.0 + options.inertia_error;
  auto level = examples::at_level("", file, truth, [&](const auto& settings) {
    return examples::LevelNmpc<Rotors>(truth, settings);
  });
  level.start_with_lift(truth.body.mass * gravity);
  const ActuatorState<Rotors>& hover = level.command();
  if (options.plant == "plant") return simulate(options, truth, hover, Plant<Rotors>(truth));
#ifdef HITL_SIMULATOR_MUJOCO
  examples::MujocoParameters parameters;
  parameters.seen = false;
  return simulate(options, truth, hover, examples::MujocoPlant<Rotors>(truth, parameters));
#else
  throw std::runtime_error("--plant mujoco: built without MuJoCo (Debian: libmujoco-dev)");
#endif
}

constexpr const char* footer = R"(
Flies the hybrid mission in real time with hitl_onboard and hitl_flight_controller. Their commands
must arrive within 3 s after the start. Without new actuator commands it holds the last command;
after 1 s the rotors stop. If restarted in flight, it starts a new mission, and the other programs
follow.

With --lock-step it waits for the command to each tick of hitl_onboard: the flight takes less time
than in reality on a fast computer, and is the same, but takes longer, on a slow or busy computer.
Where a program is missing, each tick takes the given time.

The DDS domain is that of ROS 2: the environment variable ROS_DOMAIN_ID.

Exit code: 0 the mission is over, 1 the vehicle tipped over, no commands received or another error,
2 an invalid vehicle file, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Hardware in the loop: the vehicle, its sensors and the world, in real time."};
  Options options;
  app.add_option("--plant", options.plant, "plant: that of this library; mujoco: MuJoCo")
      ->check(CLI::IsMember({"plant", "mujoco"}))
      ->capture_default_str();
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
  app.add_option(
      "--mcap", options.mcap,
      "also write vehicle, sensors and commands to this MCAP file, as messages of ROS 2, "
      "for Foxglove, PlotJuggler and ros2 bag");
  hitl::add_options(app, options.line, options.vehicle);
  app.footer(footer);
  return hitl::run_program(app, "hitl_simulator", argc, argv, [&] {
    const examples::VehicleFile file = examples::vehicle_or_default(options.vehicle);
    return std::visit([&](const auto& vehicle) { return simulate(options, file, vehicle); },
                      file.vehicle);
  });
}
