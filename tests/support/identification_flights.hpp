#pragma once

#include "../../examples/support/flight_controller.hpp"
#include "../../examples/support/vehicle_spread.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/identification/vehicle_log.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <Eigen/Core>

#include <cmath>
#include <deque>
#include <limits>
#include <utility>

/// Flights of vehicles whose parameters the controller does not know, with logs of their sensors.
namespace test_support {

struct IdentificationFlight {
  tilt_ropter::VehicleLog<4> log;
  double rmse = 0.0, max_error = 0.0;  ///< of the CoM that the controller assumes [m]
  bool flew = false;                   ///< to the end, within 2 m of the reference
};

/// Draws a vehicle; the delay of its commands is a whole number of steps of the plant.
inline examples::VehicleDraw draw_in_steps(examples::RandomStream& random,
                                           const tilt_ropter::Vehicle<4>& nominal) {
  examples::VehicleDraw draw = examples::draw_vehicle(random, nominal.body.inertia);
  draw.command_delay = std::ceil(1e3 * draw.command_delay) * 1e-3;
  return draw;
}

/// Flies `mission` with the vehicle `truth`, whose CoM is `com` [m] from the origin of the body
/// frame in which `believed`, the IMU and the poses are given. Noise, biases and delays are those
/// of `draw`; there is no wind.
inline IdentificationFlight fly_for_identification(
    const tilt_ropter::Vehicle<4>& truth, const tilt_ropter::Vehicle<4>& believed,
    const Eigen::Vector3d& com, const examples::VehicleDraw& draw, examples::RandomStream& random,
    const tilt_ropter::Mission& mission, const Eigen::Vector3d& drag = Eigen::Vector3d::Zero()) {
  using namespace tilt_ropter;
  constexpr double step = 1e-3;
  const examples::Reference reference = [&mission](double time) { return mission(time); };
  PlantParameters parameters;
  parameters.linear_drag = drag;
  parameters.contact.axle_position = -com;
  Plant<4> plant(truth, parameters);
  ImuSensorParameters imu_parameters;
  imu_parameters.rate = 1000.0;
  imu_parameters.gyro_noise_density *= draw.noise;
  imu_parameters.accelerometer_noise_density *= draw.noise;
  imu_parameters.gyro_bias = draw.gyro_bias;
  imu_parameters.accelerometer_bias = draw.accelerometer_bias;
  PoseSensorParameters capture;
  EkfSettings estimation;
  estimation.pose_noise = {1e-3, 3e-3};
  capture.delay = draw.capture_delay;
  capture.position_noise = 1e-3 * draw.noise;
  capture.orientation_noise = 3e-3 * draw.noise;
  RotorSpeedSensorParameters speed_parameters;
  speed_parameters.noise *= draw.noise;
  ImuSensor imu(imu_parameters, random.bits());
  RotorSpeedSensor<4> rotor_speeds(speed_parameters, random.bits());
  PoseSensor poses(capture, random.bits());

  NmpcSettings settings = nmpc_settings(believed);
  settings.time_limit = std::numeric_limits<double>::infinity();
  examples::FlightController<4> controller(believed, settings, estimation);
  ActuatorState<4> acting = controller.lift(believed.body.mass * gravity);
  controller.start_with(acting);
  BodyStated start;
  start.position = mission(0.0).position + com;
  start.orientation = mission(0.0).orientation;
  plant.reset(start, acting);

  const Eigen::Vector3d centre = -com;
  std::deque<std::pair<double, ActuatorState<4>>> under_way;
  IdentificationFlight flight;
  flight.log.commands.push_back({0.0, acting});
  double squares = 0.0;
  const long steps = std::lround(mission.duration() / step);
  for (long i = 0; i < steps; ++i) {
    const double time = plant.time();
    const Eigen::Vector3d w = plant.body().angular_velocity;
    BodyStated seen = plant.body();
    seen.velocity += seen.orientation * w.cross(centre);
    seen.position += seen.orientation * centre;
    if (const auto m = rotor_speeds.sample(time, plant.actuators().rotor_speed)) {
      controller.on_rotor_speeds(m->rotor_speed);
      flight.log.rotor_speeds.push_back({m->time, m->rotor_speed});
    }
    const Eigen::Vector3d specific_force = plant.specific_force() +
                                           plant.loads().angular_acceleration.cross(centre) +
                                           w.cross(w.cross(centre));
    if (const auto m = imu.sample(time, w, specific_force)) {
      controller.on_imu(m->time, *m);
      flight.log.imu.push_back({m->time, *m});
    }
    if (const auto m = poses.sample(time, seen)) {
      controller.on_pose(m->time, *m);
      flight.log.poses.push_back({m->time, *m});
    }
    if (i % 10 == 0 && controller.started()) {
      controller.prepare(time, reference);
      under_way.emplace_back(time + draw.command_delay, controller.control(time));
      if (time > 0.0) flight.log.commands.push_back({time, under_way.back().second});
    }
    while (!under_way.empty() && under_way.front().first <= time + 1e-9) {
      acting = under_way.front().second;
      under_way.pop_front();
    }
    if (!plant.step(acting, {}, step)) return flight;
    const double square = (seen.position - mission(time).position).squaredNorm();
    squares += square;
    flight.max_error = std::max(flight.max_error, std::sqrt(square));
    if (square > 4.0) return flight;
  }
  flight.rmse = std::sqrt(squares / static_cast<double>(steps));
  flight.flew = true;
  return flight;
}

}  // namespace test_support
