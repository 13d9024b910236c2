#pragma once

#include "flight_controller.hpp"
#include "statistics.hpp"
#include "vehicle_spread.hpp"

#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <deque>
#include <functional>
#include <optional>
#include <utility>

/// The hybrid mission flown by one vehicle of a Monte Carlo run, and the result of the flight.
namespace examples {

/// Result of a flight; all values but the first are divergences.
enum class Verdict {
  ok,
  not_finite,  ///< the plant failed: a number was not finite
  lost,        ///< more than 2 m from the reference
  tipped,      ///< tilted by more than 60 degrees
  grounded     ///< contact where it should fly, or ended more than 5 cm above the ground
};

[[nodiscard]] constexpr const char* to_string(Verdict verdict) noexcept {
  switch (verdict) {
    case Verdict::ok:
      return "ok";
    case Verdict::not_finite:
      return "not_finite";
    case Verdict::lost:
      return "lost";
    case Verdict::tipped:
      return "tipped";
    case Verdict::grounded:
      return "grounded";
  }
  return "unknown";
}

/// Errors refer to the point that the controller assumes to be the CoM.
struct FlightRecord {
  Verdict verdict = Verdict::ok;
  double time = 0.0;                                             ///< flight time [s]
  double air_rmse = 0.0, ground_rmse = 0.0, mission_rmse = 0.0;  ///< [m]
  double max_error = 0.0;                                        ///< [m]
  double flight_power = 0.0, ground_power = 0.0;                 ///< mean power [W]
  double touchdown_speed = 0.0;  ///< largest of all touchdowns [m/s]
  int mode_changes = 0, solver_failures = 0;
};

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

/// Called after each tick of the controller.
using OnTick = std::function<void(const tilt_ropter::Mission&, const tilt_ropter::Plant<4>&,
                                  const FlightController<4>&, const tilt_ropter::PowerModel&)>;

/// Flies a hybrid mission with the vehicle of `draw`, while the controller assumes the vehicle
/// `believed`. The same arguments give exactly the same record, with any `on_tick`. The function is
/// compiled only once, because with fused multiply-add (-march=native) two copies can differ by
/// rounding errors.
[[nodiscard, gnu::noinline]] inline FlightRecord fly_spread(
    const VehicleDraw& draw, RandomStream& random, const tilt_ropter::Vehicle<4>& believed,
    const tilt_ropter::NmpcSettings& settings, const tilt_ropter::Mission& mission,
    const OnTick& on_tick) {
  using namespace tilt_ropter;
  constexpr double step = 1e-3;       // step of the plant [s]
  constexpr int steps_per_tick = 10;  // NMPC at 100 Hz
  const Vehicle<4> truth = true_vehicle(draw, believed);
  const Reference reference = [&mission](double time) { return mission(time); };

  PlantParameters parameters;
  parameters.contact.friction = draw.friction;
  parameters.contact.axle_position = -draw.com_offset;
  Plant<4> plant(truth, parameters);
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
  RotorSpeedSensor<4> rotor_speeds(speed_parameters, random.bits());
  PoseSensor poses(capture, random.bits());
  Wind wind(draw, random.bits());
  FlightController<4> controller(believed, settings, estimation);
  const PowerModel power(truth);
  ActuatorState<4> acting;
  PlantState<4> start = plant.state();
  if (!stands) {
    start.actuators = acting = controller.lift(truth.body.mass * gravity);
    start.body.position = mission(0.0).position;
    controller.start_with(acting);
  }
  start.body.position.head<2>() += draw.com_offset.head<2>();
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
  std::deque<std::pair<double, ActuatorState<4>>> under_way;
  Eigen::Vector3d force = Eigen::Vector3d::Zero();
  Rmse error, air_error, ground_error;
  Mean air_power, ground_power;
  bool was_touching = stands.has_value();
  const long steps = std::lround(mission.duration() / step);
  for (long i = 0; i < steps && record.verdict == Verdict::ok; ++i) {
    const double time = plant.time();
    const Eigen::Vector3d& w = plant.body().angular_velocity;
    if (const auto m = rotor_speeds.sample(time, plant.actuators().rotor_speed))
      controller.on_rotor_speeds(m->rotor_speed);
    const Eigen::Vector3d specific_force = plant.specific_force() +
                                           plant.loads().angular_acceleration.cross(centre) +
                                           w.cross(w.cross(centre));
    if (const auto m = imu.sample(time, w, specific_force))
      controller.on_imu(m->time, {m->angular_velocity, m->specific_force});
    if (const auto m = poses.sample(time, body_at_centre()))
      controller.on_pose(m->time, {m->position, m->orientation});
    if (i % steps_per_tick == 0) {
      force = wind.next(steps_per_tick * step);
      if (controller.started()) {
        controller.prepare(time, reference);
        under_way.emplace_back(time + draw.command_delay, controller.control(time));
        if (!has_plan(controller.result().status)) ++record.solver_failures;
        if (on_tick) on_tick(mission, plant, controller, power);
      }
    }
    while (!under_way.empty() && under_way.front().first <= time + 1e-9) {
      acting = under_way.front().second;
      under_way.pop_front();
    }
    const Wrenchd disturbance{plant.body().orientation.conjugate() * force,
                              Eigen::Vector3d::Zero()};
    if (!plant.step(acting, disturbance, step)) {
      record.verdict = Verdict::not_finite;
      break;
    }
    const MissionPhase phase = mission.phase(plant.time());
    const double square =
        (body_at_centre().position - mission(plant.time()).position).squaredNorm();
    const double power_now = power.power(plant.actuators().rotor_speed);
    error.add_square(square);
    if (phase == MissionPhase::air) {
      air_error.add_square(square);
      air_power.add(power_now);
    }
    if (phase == MissionPhase::ground) {
      ground_error.add_square(square);
      ground_power.add(power_now);
    }
    record.max_error = std::max(record.max_error, std::sqrt(square));
    const bool touching = plant.normal_forces().sum() > 0.0;
    if (touching && !was_touching)
      record.touchdown_speed = std::max(record.touchdown_speed, -plant.body().velocity.z());
    was_touching = touching;
    const bool should_fly = phase == MissionPhase::air || phase == MissionPhase::hover;
    if (square > 4.0)
      record.verdict = Verdict::lost;
    else if (plant.body().orientation.toRotationMatrix()(2, 2) < 0.5)
      record.verdict = Verdict::tipped;
    else if ((should_fly && touching) ||
             (stands && i + 1 == steps && body_at_centre().position.z() > stands->height + 0.05))
      record.verdict = Verdict::grounded;
  }
  record.time = plant.time();
  record.mission_rmse = error.value();
  record.air_rmse = air_error.value();
  record.ground_rmse = ground_error.value();
  record.flight_power = air_power.value();
  record.ground_power = ground_power.value();
  record.mode_changes = controller.contact().mode_changes();
  return record;
}

}  // namespace examples
