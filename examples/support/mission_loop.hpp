#pragma once

#include "battery_figures.hpp"
#include "control_level.hpp"
#include "fault_option.hpp"
#include "flight_controller.hpp"
#include "identification_log.hpp"
#include "loss_reason.hpp"
#include "loss_watch.hpp"
#include "mission_choice.hpp"
#include "mission_figures.hpp"
#include "mission_rows.hpp"
#include "mission_sensors.hpp"
#include "paper_switches.hpp"
#include "progress.hpp"
#include "push_motion.hpp"
#include "sensor_suite.hpp"
#include "solver_choice.hpp"
#include "vehicle_check.hpp"
#include "vehicle_choice.hpp"
#include "wall_option.hpp"

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iomanip>
#include <iostream>
#include <map>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

/// The mission loop on any plant: sensors, controller, log and figures of the hybrid mission.
namespace examples {

/// The values of --observer.
[[nodiscard]] inline const std::map<std::string, ExternalWrench>& observer_inputs() {
  static const std::map<std::string, ExternalWrench> inputs{{"model", ExternalWrench::modelled},
                                                            {"commands", ExternalWrench::commanded},
                                                            {"off", ExternalWrench::unused}};
  return inputs;
}

struct MissionOptions {
  std::string output = "results";
  MissionChoice mission;
  double start_in_air = 0.0, start_speed = 0.0;  // height [m] and speed [m/s], 0: on the ground
  double start_off = 0.0;  // distance from the reference at the start, for missions in flight [m]
  std::int64_t seed = 1;
  double mass_error = 0.03, inertia_error = 0.10, thrust_error = 0.0;
  double height_offset = 0.0, height_drift = 0.0;        // height error of motion capture [m]
  double vibration = 0.0;                                // rms of the gyroscope vibration [rad/s]
  double vibration_frequency = 97.0, imu_rate = 1000.0;  // [Hz]
  std::vector<std::string> faults;                       // see parse_fault()
  std::string sensors = "mocap";                         // see SensorSuite
  double observer_bandwidth = 20.0;                      // bandwidth [1/s]
  std::string vehicle_path, model_path;
  std::string level;                      // "wrench" or "actuator"; empty: see level_for()
  std::string solver = "automatic";       // see add_solver()
  std::string imu_log;                    // file for identify_vehicle, or empty
  std::string mcap;                       // MCAP file beside the logs, or empty
  std::vector<std::string> rotor_speeds;  // see parse_rotor_speed()
  bool no_telemetry = false;
  std::string failure;  // see parse_failure(); empty: none
  WallOptions wall;
  // Defaults mean: the values of the vehicle.
  double servo_speed = 0.0, servo_time_constant = 0.0, ground_thrust = -1.0;
  double battery_charge = 1.0;  // state of charge at the start
  bool no_actuator_constraints = false, no_ground_conditions = false, no_feed_forward = false;
  std::string observer = "model";        // see observer_inputs()
  std::vector<std::string> as_in_paper;  // see paper_switches()
  bool no_pictures = false;
  // No options:
  bool no_log = false;        // for many flights of which only the figures count
  bool stop_at_loss = false;  // ends the flight after a loss, see LossWatch::is_over()
};

/// Adds the options to `app`; parsing fills `options`.
inline void add_options(CLI::App& app, MissionOptions& options) {
  app.add_option("-o,--output", options.output, "directory for the logs and the pictures")
      ->take_last()
      ->capture_default_str();
  app.add_option("--vehicle", options.vehicle_path,
                 "JSON file of the vehicle to fly; default: the Tilt-Ropter");
  app.add_option("--model", options.model_path,
                 "JSON file of the vehicle that the controller assumes, such as identify_vehicle "
                 "writes it; the plant keeps that of --vehicle with the errors");
  add_level(app, options.level);
  add_solver(app, options.solver);
  add_options(app, options.mission);
  app.add_option("--start-off", options.start_off,
                 "if the mission starts in flight: distance from the reference at the start [m]")
      ->check(CLI::Range(0.0, 2.0))
      ->capture_default_str();
  app.add_option(
         "--start-in-air", options.start_in_air,
         "take over in hover at this height above the start [m]: the controller is not told "
         "that the rotors turn")
      ->check(CLI::Range(0.5, 100.0));
  app.add_option("--start-speed", options.start_speed, "forward speed at that take-over [m/s]")
      ->check(CLI::Range(0.0, 5.0));
  app.add_option("--seed", options.seed, "seed of the sensor noise")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  app.add_option("--mass-error", options.mass_error, "true mass / mass in the model - 1")
      ->check(CLI::Range(-0.5, 1.0))
      ->capture_default_str();
  app.add_option("--inertia-error", options.inertia_error,
                 "true inertia / inertia in the model - 1")
      ->check(CLI::Range(-0.5, 1.0))
      ->capture_default_str();
  app.add_option("--thrust-error", options.thrust_error, "true thrust / thrust in the model - 1")
      ->check(CLI::Range(-0.5, 1.0))
      ->capture_default_str();
  app.add_option("--height-offset", options.height_offset,
                 "constant error of the height from motion capture [m]")
      ->check(CLI::Range(-2.0, 2.0))
      ->capture_default_str();
  app.add_option("--height-drift", options.height_drift,
                 "error of that height at the end of the mission; it grows evenly [m]")
      ->check(CLI::Range(-2.0, 2.0))
      ->capture_default_str();
  app.add_option("--vibration", options.vibration,
                 "vibration of the IMU: rms of each angular velocity [rad/s]; ten times this "
                 "number in each specific force [m/s^2]")
      ->check(CLI::Range(0.0, 10.0));
  app.add_option("--vibration-frequency", options.vibration_frequency,
                 "frequency of this vibration [Hz]")
      ->check(CLI::Range(1.0, 5000.0))
      ->capture_default_str();
  app.add_option("--imu-rate", options.imu_rate, "samples of the IMU per second [Hz]")
      ->check(CLI::Range(100.0, 1000.0))
      ->capture_default_str();
  app.add_option("--sensors", options.sensors,
                 "sensors beside the IMU: mocap; vio, odometry whose frame drifts; gps, with two "
                 "antennas and a range finder; wheels, mocap in the air and only wheels on the "
                 "ground")
      ->check(CLI::IsMember({"mocap", "vio", "gps", "wheels"}))
      ->capture_default_str();
  app.add_option("--fault", options.faults,
                 "break a sensor, such as pose_freeze:start=20,duration=1 or "
                 "pose_jump:start=20,duration=2,size=0.1; may be repeated. Kinds: pose_freeze, "
                 "pose_jump, pose_dropout, pose_jitter, pose_clock_step, pose_ghost, imu_dropout, "
                 "imu_clock_step, imu_vibration, imu_saturation, accelerometer_step [m/s^2], "
                 "gyro_step [rad/s], accelerometer_clip [m/s^2], orientation_step [deg], "
                 "pose_late [s], pose_burst [poses]; the units are those of size")
      ->check([](const std::string& text) {
        try {
          (void)parse_fault(text);
        } catch (const std::invalid_argument& error) {
          return std::string(error.what());
        }
        return std::string();
      });
  app.add_option("--rotor-speed", options.rotor_speeds,
                 "measured / commanded speed of all rotors, 0.5 to 1.2; or "
                 "rotor=2,ratio=0.9,start=20 for one rotor from a time on; with end=60 the ratio "
                 "changes evenly from 1 until then; battery: in proportion to the voltage, 1 for "
                 "the full battery. May be repeated")
      ->check([](const std::string& text) {
        try {
          (void)parse_rotor_speed(text, 8);
        } catch (const std::invalid_argument& error) {
          return std::string(error.what());
        }
        return std::string();
      });
  app.add_flag("--no-telemetry", options.no_telemetry,
               "no measured rotor speeds; the controller uses the modelled ones");
  app.add_option("--failure", options.failure, failure_help);
  add_wall(app, options.wall);
  app.add_option("--observer-bandwidth", options.observer_bandwidth,
                 "bandwidth of the wrench observer in all axes [1/s]")
      ->check(CLI::Range(0.1, 1000.0))
      ->capture_default_str();
  app.add_option("--servo-speed", options.servo_speed,
                 "largest speed of the servos, in plant and model; default: the vehicle's [rad/s]")
      ->check(CLI::Range(0.1, 100.0));
  app.add_option("--servo-time-constant", options.servo_time_constant,
                 "time constant of the servos in the model, such as identify_servo finds it; the "
                 "plant keeps the vehicle's [s]")
      ->check(CLI::Range(0.001, 1.0));
  app.add_option("--ground-thrust", options.ground_thrust,
                 "vertical force commanded on the ground; default: by weight and servo speed [N]")
      ->check(CLI::Range(0.0, 1000.0));
  app.add_option("--battery-charge", options.battery_charge,
                 "state of charge of the battery at the start; 1: full")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str();
  app.add_flag("--no-actuator-rows", options.no_actuator_constraints,
               "bound the wrench and its rate by boxes only, as in the paper");
  app.add_option("--observer", options.observer,
                 "the wrench observer gets measured rotor speeds and modelled tilt angles (model) "
                 "or the commands (commands); off: its result does not reach the controller")
      ->check(CLI::IsMember(observer_inputs()))
      ->capture_default_str();
  app.add_flag("--no-ground-conditions", options.no_ground_conditions,
               "no conditions on side slip, roll rate and height on the ground");
  app.add_flag("--no-feed-forward", options.no_feed_forward,
               "the cost expects the wrench of hover, not the wrench that the reference needs");
  add_paper_switches(app, options.as_in_paper);
  app.add_option("--log-imu", options.imu_log,
                 "also write a log for identify_vehicle to this file: one row per IMU sample");
  app.add_option("--mcap", options.mcap,
                 "also write the flight to this MCAP file, as messages of ROS 2, for Foxglove, "
                 "PlotJuggler and ros2 bag");
  app.add_flag("--no-pictures", options.no_pictures,
               "write the log only: no pictures and no page report.html");
}

/// The simulated vehicle and the vehicle that the controller assumes.
template <int Rotors>
struct MissionVehicles {
  tilt_ropter::Vehicle<Rotors> truth, believed;
};

template <int Rotors>
[[nodiscard]] MissionVehicles<Rotors> vehicles(const MissionOptions& options,
                                               tilt_ropter::Vehicle<Rotors> believed) {
  if (options.servo_speed > 0.0) believed.servo.max_rate = options.servo_speed;
  tilt_ropter::Vehicle<Rotors> truth = believed;
  truth.body.mass *= 1.0 + options.mass_error;
  truth.body.inertia *= 1.0 + options.inertia_error;
  tilt_ropter::change_rotor_parameters(truth, [&](tilt_ropter::RotorParameters& rotor) {
    for (double* thrust : {&rotor.thrust_coefficient, &rotor.linear_thrust_coefficient,
                           &rotor.min_thrust, &rotor.max_thrust})
      *thrust *= 1.0 + options.thrust_error;
  });
  if (!options.model_path.empty()) {
    const VehicleFile model = vehicle_or_default(options.model_path);
    const auto* given = std::get_if<tilt_ropter::Vehicle<Rotors>>(&model.vehicle);
    if (given == nullptr)
      throw std::runtime_error("--model " + options.model_path +
                               ": needs as many rotors as the vehicle that flies");
    believed = *given;
  }
  if (options.servo_time_constant > 0.0) believed.servo.time_constant = options.servo_time_constant;
  return {truth, believed};
}

/// Returns the angle of body z to world z [rad].
[[nodiscard]] inline double lean_of(const Eigen::Quaterniond& orientation) {
  return std::acos(std::clamp((orientation * Eigen::Vector3d::UnitZ()).z(), -1.0, 1.0));
}

/// Figures about the trust in the estimate and what the controller made of it.
class TrustFigures {
 public:
  void on_control(const tilt_ropter::EstimateTrust& trust, FlightMode mode,
                  const tilt_ropter::ActuatorFailure& failure, double period) {
    if (trust.state != tilt_ropter::EstimateState::good) not_good_ += period;
    if (trust.imu_contradicted) contradicted_ += period;
    latency_ = trust.latency;
    mode_ = mode;
    failure_ = failure;
  }

  void on_plant(const tilt_ropter::BodyStated& body, bool touches) {
    if (!lands()) return;
    if (touches && !touched_) speed_ = body.velocity.norm();
    const double lean = lean_of(body.orientation);
    if (!touched_) largest_lean_ = std::max(largest_lean_, lean);
    if (!touched_) last_lean_ = lean;
    touched_ = touched_ || touches;
  }

  void print(std::ostream& out, const tilt_ropter::EkfCounts& counts) const {
    out << std::setprecision(3) << "estimate_not_good_s: " << not_good_
        << "\nimu_contradicted_s: " << contradicted_ << '\n'
        << "poses_used: " << counts.used << "\nposes_refused: " << counts.gated
        << "\nposes_frozen: " << counts.frozen << "\nfilter_restarts: " << counts.restarts
        << "\npose_clock_steps: " << counts.clock_steps
        << "\nflight_mode_at_end: " << to_string(mode_) << '\n';
    if (std::abs(latency_) > 0.003) out << "pose_latency_s: " << latency_ << '\n';
    out << "actuator_failure: " << to_string(failure_.kind) << '\n';
    const double degrees = 180.0 / tilt_ropter::pi;
    if (failure_.kind == tilt_ropter::FailureKind::slow_servos)
      out << "failure_found_at_s: " << failure_.time
          << "\nservo_time_constant_s: " << failure_.time_constant << '\n';
    if (failure_.kind == tilt_ropter::FailureKind::none ||
        failure_.kind == tilt_ropter::FailureKind::slow_servos) {
      if (lands())
        out << "imu_landing_speed_mps: " << speed_
            << "\nimu_landing_lean_deg: " << largest_lean_ * degrees << '\n';
      return;
    }
    out << "failed_rotor: " << failure_.rotor + 1 << "\nfailure_found_at_s: " << failure_.time
        << '\n';
    if (failure_.kind == tilt_ropter::FailureKind::servo)
      out << "stuck_at_deg: " << failure_.angle * degrees
          << "\nstuck_at_stddev_deg: " << failure_.stddev * degrees
          << "\nservo_is_limp: " << failure_.limp << '\n';
    else
      out << "thrust_left: " << failure_.effectiveness << '\n';
    out << "emergency_landing_speed_mps: " << speed_
        << "\nemergency_landing_lean_deg: " << last_lean_ * degrees
        << "\nemergency_largest_lean_deg: " << largest_lean_ * degrees << '\n';
  }

 private:
  [[nodiscard]] bool lands() const {
    return mode_ == FlightMode::landing || mode_ == FlightMode::emergency ||
           mode_ == FlightMode::stopped;
  }

  double not_good_ = 0.0, contradicted_ = 0.0, latency_ = 0.0;
  double speed_ = 0.0;                           // at the first touch [m/s]
  double largest_lean_ = 0.0, last_lean_ = 0.0;  // before it [rad]
  tilt_ropter::ActuatorFailure failure_;
  bool touched_ = false;
  FlightMode mode_ = FlightMode::mission;
};

/// How much slower or faster than commanded the rotors turn, as the controller has learnt it.
class RotorSpeedFigures {
 public:
  template <typename Ratios>
  void add(const Ratios& ratios) {
    last_ = ratios.template cast<double>();
    min_ = std::min(min_, last_.minCoeff());
    max_ = std::max(max_, last_.maxCoeff());
  }

  void print(std::ostream& out) const {
    out << std::fixed << std::setprecision(3) << "rotor_speed_ratio_min: " << min_
        << "\nrotor_speed_ratio_max: " << max_ << '\n';
  }

  /// A line for each rotor that is more than 3 % off at the end.
  void print_health(std::ostream& out) const {
    for (Eigen::Index i = 0; i < last_.size(); ++i)
      if (std::abs(last_(i) - 1.0) > 0.03)
        out << "rotor " << i + 1 << " turns " << std::lround(100.0 * std::abs(last_(i) - 1.0))
            << " % " << (last_(i) < 1.0 ? "slower" : "faster") << " than commanded\n";
  }

 private:
  double min_ = 1.0, max_ = 1.0;
  Eigen::VectorXd last_;
};

/// The largest residuals between the sources, over their spread.
class ResidualFigures {
 public:
  void add(const tilt_ropter::Consistency& consistency) {
    const auto residuals = named_residuals(consistency);
    for (std::size_t i = 0; i < max_.size(); ++i)
      max_[i] = std::max(max_[i], std::abs(residuals[i].second));
  }

  void print(std::ostream& out) const {
    const auto residuals = named_residuals({});
    for (std::size_t i = 0; i < max_.size(); ++i)
      out << residuals[i].first << "_max: " << std::fixed << std::setprecision(2) << max_[i]
          << '\n';
  }

 private:
  std::array<double, 5> max_{};
};

/// A flown mission.
struct FlownMission {
  MissionFigures figures{0.0};
  BatteryFigures battery{{}};
  TrustFigures trust;
  RotorSpeedFigures rotor_speeds;
  ResidualFigures residuals;
  WallFigures wall;
  std::optional<PushFigures> push;
  std::optional<double> outside;  ///< largest distance of the CoM outside a half-space [m]
  SolverTicks solver;
  tilt_ropter::EkfCounts counts;  ///< of the filter, at the end
  int contact_mode_changes = 0;
  double duration = 0.0;                              ///< of the mission [s]
  double flown_time = 0.0;                            ///< shorter after a loss [s]
  double elapsed = 0.0;                               ///< [s], on the clock
  double lean = 0.0;                                  ///< largest angle of body z to world z [rad]
  double take_over_drop = 0.0, take_over_lean = 0.0;  ///< within 3 s of a take-over [m], [rad]
  std::string loss;      ///< how the vehicle was lost; empty if it was not
  double lost_at = 0.0;  ///< [s]
  std::string loss_reason;
  std::vector<tilt_ropter::BoundViolation> violations;  ///< bounds that the reference passes
};

/// Returns the settings of controller and allocation for `options`.
template <int Rotors>
[[nodiscard]] ControllerSettings controller_settings(const MissionOptions& options,
                                                     VehicleFile file,
                                                     const tilt_ropter::Vehicle<Rotors>& believed) {
  file.vehicle = believed;
  ControllerSettings controls{examples::in_simulated_time(file.settings()), {}};
  set_as_in_paper(options.as_in_paper, controls);
  tilt_ropter::NmpcSettings& settings = controls.nmpc;
  if (options.no_actuator_constraints) settings.actuator_constraints = false;
  if (options.no_ground_conditions) settings.problem.weights.ground.setZero();
  if (options.no_feed_forward) settings.wrench_reference = tilt_ropter::WrenchReference::hover;
  if (options.ground_thrust >= 0.0) settings.ground.down_force = options.ground_thrust;
  set_solver(options.solver, settings.solver);
  return controls;
}

/// Returns the surface on which `mission` pushes, if it does. Throws std::invalid_argument if there
/// is more than one, or a wall beside it.
[[nodiscard]] inline std::optional<tilt_ropter::Surface> pushed_surface(
    const tilt_ropter::Mission& mission, const WallOptions& wall) {
  std::optional<tilt_ropter::Surface> pushed;
  for (const tilt_ropter::MissionSegment& segment : mission.segments()) {
    const auto* motion = segment.motion<PushMotion>();
    if (motion == nullptr) continue;
    const tilt_ropter::Surface& surface = motion->settings().push.surface;
    if (wall.x || (pushed && (pushed->point != surface.point || pushed->normal != surface.normal ||
                              pushed->tool != surface.tool)))
      throw std::invalid_argument("the mission pushes on a surface: no other wall is possible");
    pushed = surface;
  }
  return pushed;
}

/// Flies the mission on `plant`, returns its figures, and writes hybrid_mission.csv and
/// solve_times.csv to the output directory, unless told not to. If the battery is known, plant and
/// controller receive its voltage under load. Plant has the interface of tilt_ropter::Plant.
/// `disturbance()` returns the wrench on the body during the next step;
/// `on_step(mission)` is called after every step, `on_progress(fraction, phase)` every second of
/// the flight. `ground_is_off`: the ground is not where the mission assumes it. The figures are
/// relative to the output of motion capture. If the height is wrong, the figures on the ground
/// contain only horizontal errors. A vehicle without wheels or legs starts in hover. Prints
/// nothing; several threads may fly, each its own plant to its own directory. Throws
/// std::runtime_error if the plant rejects a step.
template <int Rotors, typename Plant, typename Disturbance, typename OnStep, typename OnProgress>
FlownMission fly(const MissionOptions& options, const VehicleFile& file,
                 const MissionVehicles<Rotors>& vehicles, Plant& plant, Disturbance&& disturbance,
                 OnStep&& on_step, bool ground_is_off, OnProgress&& on_progress) {
  using namespace tilt_ropter;
  constexpr double step = 1e-3;       // step of the plant [s]
  constexpr int steps_per_tick = 10;  // NMPC at 100 Hz
  constexpr double take_over_time = 3.0;

  const Mission mission = mission_of(options.mission, vehicles.believed);
  const Reference reference = [&mission](double time) { return mission(time); };
  const ControllerSettings controls = controller_settings(options, file, vehicles.believed);
  const NmpcSettings& settings = controls.nmpc;
  FlownMission flown;
  flown.figures = MissionFigures(flight_height(mission), options.vehicle_path.empty());
  flown.battery = BatteryFigures(vehicles.truth.battery, options.battery_charge);
  BatteryFigures& battery = flown.battery;
  flown.duration = mission.duration();
  const bool actuator_level = level_for(options.level, file) == "actuator";
  if (actuator_level) require_no_nlopt_alone(options.solver);
  if constexpr (has_wrench_level<Rotors>)
    if (!actuator_level)  // the actuator level has no boxes for the wrench
      flown.violations = check_reference(mission, mission.start_time(), mission.end_time(),
                                         vehicles.believed, settings);

  MissionSensors<Rotors> sensors(static_cast<std::uint64_t>(options.seed), options.imu_rate);
  sensors.vibration = options.vibration;
  sensors.vibration_frequency = options.vibration_frequency;
  SuiteSensors<Rotors> suite(sensor_suite(options.sensors), vehicles.believed,
                             static_cast<std::uint64_t>(options.seed));
  suite.set_up(sensors, static_cast<std::uint64_t>(options.seed));
  for (const std::string& fault : options.faults) sensors.add_fault(parse_fault(fault));
  sensors.has_rotor_speeds = !options.no_telemetry;
  std::vector<RotorSpeedOption> speeds;
  for (const std::string& text : options.rotor_speeds)
    speeds.push_back(parse_rotor_speed(text, Rotors));
  const WrenchObserverSettings observer = observer_settings(options.observer_bandwidth);
  const ExternalWrench external = observer_inputs().at(options.observer);
  ActuatorNmpcSettings actuator_settings = actuator_level_settings(file, vehicles.believed);
  actuator_settings.time_limit = settings.time_limit;
  set_solver(options.solver, actuator_settings.solver);
  const double down_force = actuator_settings.ground.down_force;
  actuator_settings.ground = settings.ground;
  if (options.ground_thrust < 0.0) actuator_settings.ground.down_force = down_force;
  FlightController<Rotors> controller =
      actuator_level
          ? FlightController<Rotors>(vehicles.believed, actuator_settings, suite.estimation(),
                                     observer, external)
          : FlightController<Rotors>(vehicles.believed, settings, suite.estimation(), observer,
                                     controls.allocation, external, options.solver == nlopt_alone);
  const PowerModel power_model(vehicles.truth,
                               controller.lift(vehicles.truth.body.mass * gravity).rotor_speed);
  ActuatorState<Rotors> command;
  const MissionPhase first = mission.phase(0.0);
  const bool in_flight = first == MissionPhase::hover || first == MissionPhase::air;
  // The plant already stands at the origin; there the wheels or legs carry it.
  const Eigen::Vector3d away = mission(0.0).position - plant.body().position;
  const bool at_origin =
      options.mission.file.empty()
          ? options.mission.name == "hybrid" && options.mission.trajectory.empty()
          : std::hypot(away.x(), away.y()) < 1e-9 &&
                std::abs(yaw_of(mission(0.0).orientation)) < 1e-9;
  if (in_flight || !at_origin || options.start_in_air > 0.0) {
    BodyStated start;
    start.position = mission(0.0).position;
    start.orientation = mission(0.0).orientation;
    if (options.start_in_air > 0.0) {
      start.position.z() += options.start_in_air;
      start.velocity = start.orientation * Eigen::Vector3d(options.start_speed, 0.0, 0.0);
      command = controller.lift(vehicles.truth.body.mass * gravity);
    }
    if (in_flight && options.start_in_air == 0.0) {
      command = controller.lift(vehicles.believed.body.mass * gravity);
      controller.start_with(command);
      start.position.y() += options.start_off;
    }
    plant.reset(start, command);
  }

  std::optional<MissionLogs<Rotors>> logs;
  if (!options.no_log) logs.emplace(options.output, battery.known(), options.mcap);
  MissionFigures& figures = flown.figures;
  const auto height_error_at = [&](double time) {
    return options.height_offset + options.height_drift * time / mission.duration();
  };
  const bool height_is_off =
      options.height_offset != 0.0 || options.height_drift != 0.0 || ground_is_off;
  double power = power_model.power(plant.actuators().rotor_speed);  // during the last step [W]
  battery.on_plant(mission.phase(0.0), plant.time(), power, 0.0);
  const auto charge = [&] {  // voltage as a fraction of that of the full battery
    return battery.known() ? battery.load().voltage / vehicles.truth.battery.full_voltage : 1.0;
  };
  double upright = 1.0;  // smallest cosine of the angle between body z and world z
  IdentificationTap<Rotors, FlightController<Rotors>> tap(controller, options.imu_log,
                                                          logs ? logs->mcap() : nullptr);
  LossWatch loss;
  LossReason loss_reason;
  // Until then the vehicle was not on its mission, and may take some time to return.
  double away_until = options.start_in_air > 0.0 ? 5.0 : 0.0;
  const double start_height = plant.body().position.z();
  FailingActuator<Rotors> failing(options.failure, vehicles.truth);
  const auto start = std::chrono::steady_clock::now();
  const long steps = std::lround(mission.duration() / step);
  WallOptions walls = options.wall;
  walls.pushed = pushed_surface(mission, walls);
  if (walls.pushed) flown.push.emplace();
  if (walls.pushed && !(has_wrench_level<Rotors> && allocation_rank(vehicles.believed) == 6))
    throw std::invalid_argument(
        "the mission pushes on a surface: needs a vehicle that gives every force and torque");
  std::optional<Wall> wall = walls.at(0.0);
  if (wall) plant.set_wall(wall);
  for (long i = 0; i < steps; ++i) {
    const double time = plant.time();
    const double height_error = height_error_at(time);
    suite.sense(plant, sensors, controller);
    sensors.sense(plant, tap, height_error);
    if (i % steps_per_tick == 0 && controller.started()) {  // after the first pose
      if (battery.known()) controller.on_voltage(battery.load().voltage);
      controller.prepare(time, reference);
      command = controller.control(time);
      const NmpcResult& result = controller.result();
      figures.on_control(has_plan(result.status),
                         result.report.prepare_us + result.report.feedback_us,
                         result.report.feedback_us);
      figures.on_external_force(mission.phase(time), controller.external().force,
                                plant.external_wrench().force);
      figures.on_servos(command.tilt_angle, plant.actuators().tilt_angle,
                        controller.planned_tilt_rate(), vehicles.truth.servo,
                        steps_per_tick * step);
      flown.solver.add(result.status, result.report);
      if (loss.sentence().empty())
        loss_reason.on_control(vehicles.believed, command, has_plan(result.status),
                               controller.trust(), controller.failure(),
                               controller.external().force, steps_per_tick * step);
      flown.trust.on_control(controller.trust(), controller.mode(), controller.failure(),
                             steps_per_tick * step);
      flown.rotor_speeds.add(controller.speed_ratio());
      flown.residuals.add(controller.consistency());
      if (logs) logs->add(mission, plant, controller, power, battery);
    }
    tap.end_step(time, command);
    if (wall && !walls.at(time)) plant.set_wall(wall = std::nullopt);
    if (i % 1000 == 0) on_progress(time / mission.duration(), mission.phase(time));
    if (battery.known()) (void)plant.set_voltage(battery.load().voltage);
    const Eigen::Matrix<double, Rotors, 1> tilt = plant.actuators().tilt_angle;
    ActuatorState<Rotors> turned = command;
    for (const RotorSpeedOption& speed : speeds)
      for (int k = 0; k < Rotors; ++k) turned.rotor_speed(k) *= speed.factor(k, time, charge());
    if (!plant.step(failing.command(plant, turned), disturbance(), step))
      throw std::runtime_error("the plant rejected a step");
    if (options.wall.x)
      flown.wall.on_step(plant.time(), wall, plant.wall_force(), plant.body(),
                         mission(plant.time()).position.z(),
                         controller.contact().estimate().blocked.has_value());
    if (flown.push)
      flown.push->on_step(plant.time(), mission(plant.time()), plant.wall_force(),
                          plant.body().position);
    flown.trust.on_plant(plant.body(), plant.normal_forces().sum() > 0.0);
    const MissionPhase phase = mission.phase(plant.time());
    const ReferencePoint planned = mission(plant.time());
    const Eigen::Vector3d& wanted = planned.position;
    for (const HalfSpace& h : planned.inside)
      if (!h.normal.isZero(0.0))
        flown.outside = std::max(flown.outside.value_or(0.0), h.beyond(plant.body().position));
    Eigen::Vector3d seen = plant.body().position;
    seen.z() += height_error_at(plant.time());
    if (height_is_off && phase == MissionPhase::ground) seen.z() = wanted.z();
    power = power_model.power(plant.actuators().rotor_speed,
                              ((plant.actuators().tilt_angle - tilt) / step).eval());
    battery.on_plant(phase, plant.time(), power, step);
    figures.on_plant(phase, seen, wanted, plant.body().velocity.z(), power,
                     plant.normal_forces().sum() > 0.0);
    if (phase == MissionPhase::ground)
      figures.on_bearings(plant.bearing_torque(), plant.servo_stiffness());
    if (options.start_in_air > 0.0 && plant.time() < take_over_time &&
        controller.mode() != FlightMode::returning) {
      flown.take_over_drop =
          std::max(flown.take_over_drop, start_height - plant.body().position.z());
      flown.take_over_lean = std::max(flown.take_over_lean, lean_of(plant.body().orientation));
    }
    upright = std::min(upright, plant.body().orientation.toRotationMatrix()(2, 2));
    const bool blocked = controller.contact().estimate().blocked.has_value();
    if (controller.mode() != FlightMode::mission || (wall && blocked))
      away_until = plant.time() + 5.0;
    const bool follows = plant.time() >= away_until;
    const bool touches = plant.normal_forces().sum() > 0.0;
    // An actuator that fails may turn the vehicle far before it recovers.
    const bool tipped = is_tipped(plant.body().orientation) && (options.failure.empty() || touches);
    if (controller.mode() != FlightMode::stopped)
      loss.on_step(plant.time(), follows ? (seen - wanted).norm() - options.start_off : 0.0, tipped,
                   (seen - wanted).norm());
    on_step(mission);
    const bool ends = loss.is_over() || controller.mode() == FlightMode::stopped;
    if (options.stop_at_loss && options.failure.empty() && !loss.sentence().empty() && ends) break;
  }
  const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
  if (logs) logs->close();
  flown.elapsed = elapsed.count();
  flown.lean = std::acos(std::max(-1.0, upright));
  flown.loss = loss.sentence();
  flown.lost_at = loss.time();
  if (!flown.loss.empty()) flown.loss_reason = loss_reason.sentence(flown.violations);
  flown.flown_time = plant.time();
  flown.contact_mode_changes = controller.contact().mode_changes();
  flown.counts = controller.ekf().counts();
  return flown;
}

/// For the help of a program that returns FlightReport::exit_code().
inline constexpr const char* mission_exit_codes =
    "Exit code: 0 the mission was flown, 1 the vehicle was lost (more than 2 m from its reference\n"
    "or 60 degrees from upright) or another error, 2 an invalid vehicle or mission file, above "
    "100\n"
    "wrong options.";

struct FlightReport {
  std::string figures;            ///< as they were printed
  std::string loss, loss_reason;  ///< as in FlownMission

  /// The exit code of `program`: 1 if the vehicle was lost, which this says on stderr.
  [[nodiscard]] int exit_code(const char* program) const {
    if (!loss.empty())
      std::cerr << program << ": " << loss << "; likely reason: " << loss_reason << '\n';
    return loss.empty() ? 0 : 1;
  }
};

/// For a program that flies one mission: prints what is wrong with the vehicle, calls
/// flight(on_progress), which returns a FlownMission,
/// and shows its progress. Prints and returns the figures.
template <typename Flight>
FlightReport report_flight(const MissionOptions& options, const VehicleFile& file,
                           const Flight& flight) {
  const std::string choice = level_choice(options.level, file);
  if (!choice.empty()) std::cout << choice << '\n';
  std::string found;  // before the flight
  for (const VehicleFinding& finding : static_findings(file)) {
    std::cout << finding.line() << '\n';
    found += finding.text + "; ";
  }
  Progress progress;
  FlownMission flown = flight([&progress](double fraction, tilt_ropter::MissionPhase phase) {
    progress.show(fraction, to_string(phase));
  });
  progress.finish();
  print(std::cout, flown.violations);
  std::ostringstream printed;
  printed << "level: " << level_for(options.level, file) << '\n';
  flown.figures.print(printed, flown.contact_mode_changes);
  flown.solver.print(printed);
  flown.battery.print(printed);
  flown.trust.print(printed, flown.counts);
  if (options.start_in_air > 0.0)
    printed << "take_over_drop_m: " << flown.take_over_drop
            << "\ntake_over_lean_deg: " << flown.take_over_lean * 180.0 / tilt_ropter::pi << '\n';
  if (options.wall.x) flown.wall.print(printed, options.wall.until);
  if (flown.push) flown.push->print(printed);
  if (flown.outside)
    printed << std::fixed << std::setprecision(4) << "outside_max_m: " << *flown.outside << '\n';
  flown.rotor_speeds.print(printed);
  flown.residuals.print(printed);
  printed << std::setprecision(1) << "mission_duration_s: " << flown.duration << '\n'
          << "real_time_factor: " << flown.flown_time / flown.elapsed << '\n';
  if (!flown.loss.empty())
    printed << std::setprecision(2) << "lost_at_s: " << flown.lost_at
            << "\nlikely_reason: " << found << flown.loss_reason << '\n';
  std::cout << printed.str();
  flown.rotor_speeds.print_health(std::cout);
  return {printed.str(), flown.loss, found + flown.loss_reason};
}

/// The same for any plant, with the arguments of fly().
template <int Rotors, typename Plant, typename Disturbance, typename OnStep>
FlightReport fly_mission(const MissionOptions& options, const VehicleFile& file,
                         const MissionVehicles<Rotors>& vehicles, Plant& plant,
                         Disturbance&& disturbance, OnStep&& on_step, bool ground_is_off = false) {
  return report_flight(options, file, [&](const auto& on_progress) {
    return fly(options, file, vehicles, plant, disturbance, on_step, ground_is_off, on_progress);
  });
}

}  // namespace examples
