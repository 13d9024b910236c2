#include "spread_flight.hpp"

#include "battery_figures.hpp"
#include "control_level.hpp"
#include "flight_controller.hpp"
#include "loss_watch.hpp"
#include "mission_rows.hpp"
#include "paper_switches.hpp"
#include "solver_choice.hpp"

#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <deque>
#include <optional>
#include <utility>
#include <variant>

namespace examples {

namespace {

/// Wind with gusts: a mean and a first-order Gauss-Markov process, limited to 1.5 N.
class Wind {
 public:
  Wind(const VehicleDraw& draw, std::uint64_t seed)
      : mean_(draw.wind *
              Eigen::Vector3d(std::cos(draw.wind_direction), std::sin(draw.wind_direction), 0.0)),
        noise_(seed) {}

  /// Returns the force on the vehicle, world frame [N], `dt` [s] after the last call.
  [[nodiscard]] Eigen::Vector3d next(double dt) {
    constexpr double correlation_time = 1.0, strongest = 1.5;
    const double kept = std::exp(-dt / correlation_time);
    gust_ = kept * gust_ + noise_.draw<3>(0.25 * mean_.norm() * std::sqrt(1.0 - kept * kept));
    const Eigen::Vector3d force = mean_ + gust_;
    return force * std::min(1.0, strongest / std::max(force.norm(), 1e-9));
  }

 private:
  Eigen::Vector3d mean_, gust_ = Eigen::Vector3d::Zero();
  tilt_ropter::GaussianNoise noise_;
};

/// Returns the speeds of the true rotors that give the thrusts of the controller's allocation for
/// the true weight [rad/s].
template <int Rotors>
Eigen::Matrix<double, Rotors, 1> hover_speeds(const FlightController<Rotors>& controller,
                                              const tilt_ropter::Vehicle<Rotors>& believed,
                                              const tilt_ropter::Vehicle<Rotors>& truth) {
  using namespace tilt_ropter;
  Eigen::Matrix<double, Rotors, 1> speeds = controller.lift(truth.body.mass * gravity).rotor_speed;
  for (int i = 0; i < Rotors; ++i) {
    const auto rotor = static_cast<std::size_t>(i);
    const double thrust = thrust_from_speed(speeds(i), rotor_parameters(believed, rotor));
    speeds(i) = speed_from_thrust(thrust, rotor_parameters(truth, rotor));
  }
  return speeds;
}

template <int Rotors>
FlightRecord fly(const VehicleDraw& draw, RandomStream& random, const VehicleFile& file,
                 const tilt_ropter::Vehicle<Rotors>& believed, const std::string& level,
                 const std::string& solver, const std::string& log_directory,
                 const SpreadChoice& choice) {
  using namespace tilt_ropter;
  constexpr double step = 1e-3;       // step of the plant [s]
  constexpr int steps_per_tick = 10;  // NMPC at 100 Hz
  const Vehicle<Rotors> truth = true_vehicle(draw, believed);
  const Mission mission = mission_of(choice.mission, believed);
  const Reference reference = [&mission](double time) { return mission(time); };

  PlantParameters parameters;
  parameters.contact.friction = draw.friction;
  parameters.contact.axle_position = -draw.com_offset;
  Plant<Rotors> plant(truth, parameters);
  const std::optional<Undercarriage> stands = undercarriage(believed);

  ImuSensorParameters imu_parameters;
  imu_parameters.rate = 1000.0;
  imu_parameters.gyro_noise_density *= draw.noise;
  imu_parameters.accelerometer_noise_density *= draw.noise;
  imu_parameters.gyro_bias = draw.gyro_bias;
  imu_parameters.accelerometer_bias = draw.accelerometer_bias;
  PoseSensorParameters capture;
  capture.position_noise = 1e-3;
  capture.orientation_noise = 3e-3;
  EkfSettings estimation;
  estimation.pose_noise = {capture.position_noise, capture.orientation_noise};
  capture.delay = draw.capture_delay;
  capture.position_noise *= draw.noise;
  capture.orientation_noise *= draw.noise;
  RotorSpeedSensorParameters speed_parameters;
  speed_parameters.noise *= draw.noise;
  ImuSensor imu(imu_parameters, random.bits());
  RotorSpeedSensor<Rotors> rotor_speeds(speed_parameters, random.bits());
  PoseSensor poses(capture, random.bits());
  Wind wind(draw, random.bits());
  ControllerSettings controls{in_simulated_time(file.settings()), {}};
  set_as_in_paper(choice.as_in_paper, controls);
  NmpcSettings& settings = controls.nmpc;
  set_solver(solver, settings.solver);
  ActuatorNmpcSettings actuator_settings = actuator_level_settings(file, believed);
  actuator_settings.time_limit = settings.time_limit;
  set_solver(solver, actuator_settings.solver);
  FlightController<Rotors> controller =
      level == "actuator" ? FlightController<Rotors>(believed, actuator_settings, estimation)
                          : FlightController<Rotors>(believed, settings, estimation,
                                                     observer_settings(20.0), controls.allocation);
  const PowerModel power(truth, hover_speeds(controller, believed, truth));
  BatteryFigures battery(truth.battery);
  double power_now = power.power(plant.actuators().rotor_speed);  // during the last step [W]
  battery.on_plant(mission.phase(0.0), plant.time(), power_now, 0.0);
  std::optional<MissionLogs<Rotors>> logs;
  if (!log_directory.empty()) logs.emplace(log_directory, battery.known(), choice.mcap);
  FlightMcap* const mcap = logs ? logs->mcap() : nullptr;
  ActuatorState<Rotors> acting;
  PlantState<Rotors> start = plant.state();
  const ReferencePoint first = mission(0.0);
  const MissionPhase first_phase = mission.phase(0.0);
  if (!stands || first_phase == MissionPhase::hover || first_phase == MissionPhase::air) {
    start.actuators = acting = controller.lift(truth.body.mass * gravity);
    start.body.position = first.position;
    start.body.position.y() += choice.start_off;
    start.body.orientation = first.orientation;
    controller.start_with(acting);
  } else {
    start.body.position.template head<2>() = first.position.head<2>();
    start.body.orientation = first.orientation;
  }
  start.body.position.template head<2>() += draw.com_offset.head<2>();
  plant.reset(start);

  // CoM of the assumed vehicle relative to the true CoM.
  const Eigen::Vector3d centre = -draw.com_offset;
  const auto body_at_centre = [&] {
    BodyStated body = plant.body();
    body.velocity += body.orientation * body.angular_velocity.cross(centre);
    body.position += body.orientation * centre;
    return body;
  };
  FlightRecord record;
  record.duration = mission.duration();
  record.figures = MissionFigures(flight_height(mission), false);
  std::deque<std::pair<double, ActuatorState<Rotors>>> under_way;
  Eigen::Vector3d force = Eigen::Vector3d::Zero();
  const MissionFigures& figures = record.figures;
  const long steps = std::lround(mission.duration() / step);
  for (long i = 0; i < steps && record.verdict == Verdict::ok; ++i) {
    const double time = plant.time();
    const Eigen::Vector3d& w = plant.body().angular_velocity;
    if (const auto m = rotor_speeds.sample(time, plant.actuators().rotor_speed))
      controller.on_rotor_speeds(m->rotor_speed);
    const Eigen::Vector3d specific_force = plant.specific_force() +
                                           plant.loads().angular_acceleration.cross(centre) +
                                           w.cross(w.cross(centre));
    if (const auto m = imu.sample(time, w, specific_force)) {
      controller.on_imu(m->time, {m->angular_velocity, m->specific_force});
      if (mcap != nullptr) mcap->on_imu(m->time, {m->angular_velocity, m->specific_force});
    }
    if (const auto m = poses.sample(time, body_at_centre())) {
      controller.on_pose(m->time, {m->position, m->orientation});
      if (mcap != nullptr) mcap->on_pose(m->time, {m->position, m->orientation});
    }
    if (i % steps_per_tick == 0) {
      force = wind.next(steps_per_tick * step);
      if (controller.started()) {
        if (battery.known()) controller.on_voltage(battery.load().voltage);
        controller.prepare(time, reference);
        under_way.emplace_back(time + draw.command_delay, controller.control(time));
        const NmpcResult& result = controller.result();
        if (!has_plan(result.status)) ++record.solver_failures;
        record.solver.add(result.status, result.report);
        record.figures.on_control(has_plan(result.status), result.report.prepare_us,
                                  result.report.feedback_us);
        record.figures.on_servos(under_way.back().second.tilt_angle, plant.actuators().tilt_angle,
                                 controller.planned_tilt_rate(), truth.servo,
                                 steps_per_tick * step);
        if (logs) logs->add(mission, plant, controller, power_now, battery);
      }
    }
    while (!under_way.empty() && under_way.front().first <= time + 1e-9) {
      acting = under_way.front().second;
      under_way.pop_front();
    }
    const Wrenchd disturbance{plant.body().orientation.conjugate() * force,
                              Eigen::Vector3d::Zero()};
    if (battery.known()) (void)plant.set_voltage(battery.load().voltage);
    const Eigen::Matrix<double, Rotors, 1> tilt = plant.actuators().tilt_angle;
    if (!plant.step(acting, disturbance, step)) {
      record.verdict = Verdict::not_finite;
      break;
    }
    const MissionPhase phase = mission.phase(plant.time());
    const Eigen::Vector3d position = body_at_centre().position;
    const Eigen::Vector3d wanted = mission(plant.time()).position;
    const double distance = (position - wanted).norm();
    power_now = power.power(plant.actuators().rotor_speed,
                            ((plant.actuators().tilt_angle - tilt) / step).eval());
    battery.on_plant(phase, plant.time(), power_now, step);
    const bool touching = plant.normal_forces().sum() > 0.0;
    record.figures.on_plant(phase, position, wanted, plant.body().velocity.z(), power_now,
                            touching);
    const bool should_fly = phase == MissionPhase::air || phase == MissionPhase::hover;
    if (distance > lost_distance)
      record.verdict = Verdict::lost;
    else if (is_tipped(plant.body().orientation))
      record.verdict = Verdict::tipped;
    else if ((should_fly && touching) ||
             (i + 1 == steps && stands && position.z() > wanted.z() + 0.05))
      record.verdict = Verdict::grounded;
  }
  if (logs) logs->close();
  record.time = plant.time();
  record.mission_rmse = figures.all().value();
  record.air_rmse = figures.air().value();
  record.ground_rmse = figures.ground().value();
  record.max_error = figures.all().max();
  record.flight_power = figures.air_power().value();
  record.ground_power = figures.ground_power().value();
  record.touchdown_speed = figures.touchdown_speed();
  record.mode_changes = controller.contact().mode_changes();
  record.failure = controller.failure();
  const FailureKind found = record.failure.kind;
  const bool slow = truth.servo.time_constant > 1.5 * believed.servo.time_constant;
  record.false_alarms = found != FailureKind::none && !(found == FailureKind::slow_servos && slow);
  return record;
}

}  // namespace

SpreadFlight fly_spread(const VehicleFile& file, const std::string& level,
                        const std::string& solver, std::uint64_t seed, std::uint64_t index,
                        const std::string& log_directory, const SpreadChoice& choice) {
  RandomStream random(seed, index);
  return std::visit(
      [&](const auto& believed) {
        SpreadFlight flight;
        flight.draw = narrowed(draw_vehicle(random, believed.body.inertia), choice.fraction);
        flight.record =
            fly(flight.draw, random, file, believed, level, solver, log_directory, choice);
        return flight;
      },
      file.vehicle);
}

}  // namespace examples
