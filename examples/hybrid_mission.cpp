// The main job: take off, fly the paper's figure eight, land, drive a similar one, take off again,
// hover, land. The plant runs at 1 kHz and is not the vehicle that the controller believes in.

#include "support/flight_controller.hpp"
#include "support/mission_figures.hpp"
#include "support/mission_log.hpp"
#include "support/pictures.hpp"
#include "support/progress.hpp"

#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/model/allocation.hpp>
#include <tilt_ropter/model/power.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <CLI/CLI.hpp>

#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <iomanip>
#include <iostream>
#include <string>
#include <vector>

using namespace tilt_ropter;

namespace {

struct Options {
  std::string output = "results";
  std::int64_t seed = 1;
  double mass_error = 0.03, inertia_error = 0.10;
  double servo_speed = tilt_ropter_vehicle().servo.max_rate;
  double servo_time_constant = tilt_ropter_vehicle().servo.time_constant;
  double ground_thrust = GroundContactSettings{}.down_force;
  bool no_actuator_rows = false;
  bool no_pictures = false;
};

constexpr double step = 1e-3;       // of the plant [s]
constexpr int steps_per_tick = 10;  // NMPC at 100 Hz

std::vector<std::string> columns() {
  std::vector<std::string> names = {"time_s", "phase", "on_ground"};
  const auto add = [&names](const std::string& name, const std::vector<std::string>& parts) {
    for (const std::string& part : parts) names.push_back(name + "_" + part);
  };
  const std::vector<std::string> axes = {"x", "y", "z"}, rotors = {"1", "2", "3", "4"};
  add("position_m", axes);
  add("reference_m", axes);
  add("velocity_mps", axes);
  add("orientation", {"w", "x", "y", "z"});
  add("angular_velocity_radps", axes);
  add("command_force_n", axes);
  add("command_torque_nm", axes);
  add("estimated_force_n", axes);
  add("estimated_torque_nm", axes);
  add("external_force_n", axes);
  add("external_torque_nm", axes);
  add("tilt_command_rad", rotors);
  add("tilt_model_rad", rotors);
  add("tilt_true_rad", rotors);
  add("rotor_speed_radps", rotors);
  for (const char* name : {"power_w", "active_rows", "kkt"}) names.emplace_back(name);
  return names;
}

void log_row(examples::MissionLog& log, const Mission& mission, const Plant<4>& plant,
             const examples::FlightController& controller, double power) {
  const double time = plant.time();
  const BodyState<>& body = plant.body();
  const NmpcResult& result = controller.result();
  const Eigen::Quaterniond& q = body.orientation;
  log.add(time).add(static_cast<int>(mission.phase(time))).add(result.on_ground);
  log.add_all(body.position).add_all(mission(time).position).add_all(body.velocity);
  log.add(q.w()).add(q.x()).add(q.y()).add(q.z()).add_all(body.angular_velocity);
  log.add_all(result.wrench.force).add_all(result.wrench.torque);
  log.add_all(controller.external().force).add_all(controller.external().torque);
  log.add_all(plant.external_wrench().force).add_all(plant.external_wrench().torque);
  log.add_all(controller.command().tilt_angle).add_all(controller.applied().tilt_angle);
  log.add_all(plant.actuators().tilt_angle).add_all(plant.actuators().rotor_speed);
  log.add(power).add(result.report.active_rows).add(result.report.kkt);
  log.end_row();
}

void fly(const Options& options) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();  // what the controller believes
  vehicle.servo.max_rate = options.servo_speed;
  Vehicle<4> truth = vehicle;
  truth.body.mass *= 1.0 + options.mass_error;
  truth.body.inertia *= 1.0 + options.inertia_error;
  vehicle.servo.time_constant = options.servo_time_constant;

  const HybridMissionParameters job;
  const Mission mission = hybrid_mission(job);
  NmpcSettings settings;
  settings.actuator_rows = !options.no_actuator_rows;
  settings.ground.down_force = options.ground_thrust;
  for (const BoundViolation& v :
       check_reference(mission, mission.start_time(), mission.end_time(), vehicle, settings))
    std::cout << "the reference asks for " << v.bound << "[" << v.axis << "] = " << v.required
              << " at " << v.time << " s, allowed is " << v.allowed << '\n';

  Plant<4> plant(truth);
  ImuSensorParameters imu_parameters;
  imu_parameters.rate = 1000.0;
  imu_parameters.gyro_bias << 0.01, -0.02, 0.015;
  imu_parameters.accelerometer_bias << 0.05, -0.08, 0.1;
  PoseSensorParameters capture;
  capture.delay = 0.02;
  capture.position_noise = 1e-3;
  capture.orientation_noise = 3e-3;
  EkfSettings estimation;
  estimation.pose_noise = {capture.position_noise, capture.orientation_noise};
  const auto seed = static_cast<std::uint64_t>(options.seed);
  ImuSensor imu(imu_parameters, seed);
  RotorSpeedSensor<4> rotor_speeds({}, seed + 1000);
  PoseSensor poses(capture, seed + 2000);
  examples::FlightController controller(vehicle, settings, estimation);
  const Allocation<4> allocation(vehicle);
  const PowerModel power(truth);

  std::filesystem::create_directories(options.output);
  examples::MissionLog log(options.output + "/hybrid_mission.csv", columns());
  // Apart, because the same seed gives the same log bit for bit, and not the same wall times.
  examples::MissionLog times(options.output + "/solve_times.csv",
                             {"time_s", "prepare_us", "feedback_us"});
  examples::MissionFigures figures(job.flight_height);
  ActuatorState<4> command;
  examples::Progress progress;
  const auto start = std::chrono::steady_clock::now();
  const long steps = std::lround(mission.duration() / step);
  for (long i = 0; i < steps; ++i) {
    const double time = plant.time();
    if (const auto m = rotor_speeds.sample(time, plant.actuators().rotor_speed))
      controller.on_rotor_speeds(m->rotor_speed);
    if (const auto m = imu.sample(time, plant.body().angular_velocity, plant.specific_force()))
      controller.on_imu(m->time, {m->angular_velocity, m->specific_force});
    if (const auto m = poses.sample(time, plant.body()))
      controller.on_pose(m->time, {m->position, m->orientation});
    if (i % steps_per_tick == 0 && controller.ekf().running()) {  // from the first pose on
      controller.prepare(time, mission);
      command = controller.control(time);
      const NmpcResult& result = controller.result();
      figures.on_control(result.status == NmpcStatus::solved,
                         result.report.prepare_us + result.report.feedback_us,
                         result.report.feedback_us);
      figures.on_servos(command.tilt_angle, plant.actuators().tilt_angle,
                        allocation.rates(result.wrench, result.rate).tilt_rate, truth.servo,
                        steps_per_tick * step);
      times.add(time).add(result.report.prepare_us).add(result.report.feedback_us).end_row();
      log_row(log, mission, plant, controller, power.power(plant.actuators().rotor_speed));
    }
    if (i % 1000 == 0) progress.show(time / mission.duration(), to_string(mission.phase(time)));
    if (!plant.step(command, {}, step)) throw std::runtime_error("the plant broke");
    figures.on_plant(mission.phase(plant.time()), plant.body().position,
                     mission(plant.time()).position, plant.body().velocity.z(),
                     power.power(plant.actuators().rotor_speed), plant.normal_forces().sum() > 0.0);
  }
  const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
  progress.finish();
  figures.print(std::cout, controller.nmpc().contact().mode_changes());
  std::cout << std::setprecision(1) << "mission_duration_s: " << mission.duration() << '\n'
            << "real_time_factor: " << mission.duration() / elapsed.count() << '\n';
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Flies the hybrid mission: take off, figure eight, land, drive, take off, land."};
  Options options;
  app.add_option("-o,--output", options.output, "directory for the logs and the pictures")
      ->take_last()
      ->capture_default_str();
  app.add_option("--seed", options.seed, "of the sensors' noise")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  app.add_option("--mass-error", options.mass_error, "true mass / believed mass - 1")
      ->check(CLI::Range(-0.5, 1.0))
      ->capture_default_str();
  app.add_option("--inertia-error", options.inertia_error, "true inertia / believed inertia - 1")
      ->check(CLI::Range(-0.5, 1.0))
      ->capture_default_str();
  app.add_option("--servo-speed", options.servo_speed, "of the servos, true and believed [rad/s]")
      ->check(CLI::Range(0.1, 100.0))
      ->capture_default_str();
  app.add_option("--servo-time-constant", options.servo_time_constant,
                 "of the servos, believed, such as identify_servo finds it; the true one is 0.08 "
                 "[s]")
      ->check(CLI::Range(0.001, 1.0))
      ->capture_default_str();
  app.add_option("--ground-thrust", options.ground_thrust, "vertical, asked for on the ground [N]")
      ->check(CLI::Range(0.0, 10.0))
      ->capture_default_str();
  app.add_flag("--no-actuator-rows", options.no_actuator_rows,
               "bound the wrench and its rate by boxes alone, as in the paper");
  app.add_flag("--no-pictures", options.no_pictures, "write the log only");
  CLI11_PARSE(app, argc, argv);
  try {
    fly(options);  // the logs are closed when it returns
    if (!options.no_pictures) examples::draw_pictures("hybrid_mission.gp", options.output);
    return 0;
  } catch (const std::exception& error) {
    std::cerr << "hybrid_mission: " << error.what() << '\n';
    return 1;
  }
}
