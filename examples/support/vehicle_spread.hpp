#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <Eigen/Core>

#include <array>
#include <cmath>
#include <cstdint>
#include <random>

/// The vehicles of a Monte Carlo run: the parameters that may differ from the vehicle that the
/// controller assumes, and the ranges of the differences.
namespace examples {

/// One vehicle, its sensors and its wind. Factors multiply the value of the assumed vehicle.
struct VehicleDraw {
  double mass = 1.0;  ///< factor of the mass, 0.8 to 1.2
  /// Factors of the inertia per axis, 0.7 to 1.3.
  Eigen::Vector3d inertia = Eigen::Vector3d::Ones();
  /// Offset of the CoM, up to 1 cm per axis, body frame [m].
  Eigen::Vector3d com_offset = Eigen::Vector3d::Zero();
  double thrust = 1.0;               ///< factor of the thrust, 0.85 to 1.15
  double servo_time_constant = 1.0;  ///< factor of the servo time constant, 0.5 to 2
  double rotor_time_constant = 1.0;  ///< factor of the rotor time constant, 0.5 to 2
  double command_delay = 0.0;        ///< delay of commands to rotors and servos, up to 20 ms [s]
  double capture_delay = 0.0;        ///< delay of motion capture, up to 20 ms [s]
  double noise = 1.0;                ///< factor of the noise of all sensors, 0.5 to 2
  /// Gyroscope bias, up to 0.02 per axis [rad/s].
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();
  /// Accelerometer bias, up to 0.1 per axis [m/s^2].
  Eigen::Vector3d accelerometer_bias = Eigen::Vector3d::Zero();
  double wind = 0.0;  ///< mean wind force, up to 1 N; with gusts up to 1.5 N [N]
  /// Direction into which the wind blows, about world z, -pi to pi [rad].
  double wind_direction = 0.0;
  double friction = 0.8;  ///< friction coefficient of wheels on the ground, 0.3 to 1
};

/// A stream of random numbers that is identical on every machine.
class RandomStream {
 public:
  /// Streams of one seed do not overlap in practice: all bits of seed and index are mixed to seed a
  /// generator with a period of 2^19937 - 1 numbers.
  RandomStream(std::uint64_t seed, std::uint64_t index) {
    std::seed_seq mixed{low(seed), high(seed), low(index), high(index)};
    generator_.seed(mixed);
  }

  [[nodiscard]] std::uint64_t bits() { return generator_(); }

  /// Returns a number in [from, to) with 53 random bits.
  [[nodiscard]] double uniform(double from, double to) {
    return from + (to - from) * static_cast<double>(generator_() >> 11U) * 0x1.0p-53;
  }
  /// Returns a number between `from` and `to` whose logarithm is uniform: half and twice the
  /// geometric mean are equally likely.
  [[nodiscard]] double log_uniform(double from, double to) {
    return std::exp(uniform(std::log(from), std::log(to)));
  }
  [[nodiscard]] Eigen::Vector3d uniform_vector(double from, double to) {
    const double x = uniform(from, to), y = uniform(from, to);
    return {x, y, uniform(from, to)};
  }

 private:
  static std::uint32_t low(std::uint64_t value) { return static_cast<std::uint32_t>(value); }
  static std::uint32_t high(std::uint64_t value) {
    return static_cast<std::uint32_t>(value >> 32U);
  }

  std::mt19937_64 generator_;
};

/// False if no body can have this inertia: the sum of two principal moments must be at least the
/// third. Then half the trace minus the inertia, the second moment of the mass, has no negative
/// eigenvalue.
[[nodiscard]] inline bool is_physical(const Eigen::Matrix3d& inertia) {
  const double half = 0.5 * inertia.diagonal().sum();
  const double x = half - inertia(0, 0), y = half - inertia(1, 1), z = half - inertia(2, 2);
  const double xy = inertia(0, 1), xz = inertia(0, 2), yz = inertia(1, 2);
  return x >= 0.0 && y >= 0.0 && z >= 0.0 && x * y >= xy * xy && x * z >= xz * xz &&
         y * z >= yz * yz &&
         x * y * z - x * yz * yz - y * xz * xz - z * xy * xy - 2.0 * xy * xz * yz >= 0.0;
}

/// Returns the inertia with moments multiplied by `factors`, and products of inertia by the
/// geometric mean of the factors of both axes.
[[nodiscard]] inline Eigen::Matrix3d scaled_inertia(Eigen::Matrix3d inertia,
                                                    const Eigen::Vector3d& factors) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      inertia(i, j) *= i == j ? factors(i) : std::sqrt(factors(i) * factors(j));
  return inertia;
}

/// Draws a vehicle from `random`: uniform in the ranges above, time constants and noise uniform in
/// their logarithm. Factors that make `inertia` physically impossible are drawn again.
[[nodiscard]] inline VehicleDraw draw_vehicle(RandomStream& random,
                                              const Eigen::Matrix3d& inertia) {
  VehicleDraw draw;
  draw.mass = random.uniform(0.8, 1.2);
  do {
    draw.inertia = random.uniform_vector(0.7, 1.3);
  } while (!is_physical(scaled_inertia(inertia, draw.inertia)));
  draw.com_offset = random.uniform_vector(-0.01, 0.01);
  draw.thrust = random.uniform(0.85, 1.15);
  draw.servo_time_constant = random.log_uniform(0.5, 2.0);
  draw.rotor_time_constant = random.log_uniform(0.5, 2.0);
  draw.command_delay = random.uniform(0.0, 0.02);
  draw.capture_delay = random.uniform(0.0, 0.02);
  draw.noise = random.log_uniform(0.5, 2.0);
  draw.gyro_bias = random.uniform_vector(-0.02, 0.02);
  draw.accelerometer_bias = random.uniform_vector(-0.1, 0.1);
  draw.wind = random.uniform(0.0, 1.0);
  draw.wind_direction = random.uniform(-tilt_ropter::pi, tilt_ropter::pi);
  draw.friction = random.uniform(0.3, 1.0);
  return draw;
}

/// Returns the draw with each difference from the assumed vehicle times `fraction`, 0 to 1.
[[nodiscard]] inline VehicleDraw narrowed(VehicleDraw draw, double fraction) {
  if (fraction == 1.0) return draw;
  const VehicleDraw middle;
  for (double VehicleDraw::*value :
       {&VehicleDraw::mass, &VehicleDraw::thrust, &VehicleDraw::servo_time_constant,
        &VehicleDraw::rotor_time_constant, &VehicleDraw::command_delay, &VehicleDraw::capture_delay,
        &VehicleDraw::noise, &VehicleDraw::wind, &VehicleDraw::friction})
    draw.*value = middle.*value + fraction * (draw.*value - middle.*value);
  for (Eigen::Vector3d VehicleDraw::*value :
       {&VehicleDraw::inertia, &VehicleDraw::com_offset, &VehicleDraw::gyro_bias,
        &VehicleDraw::accelerometer_bias})
    draw.*value = middle.*value + fraction * (draw.*value - middle.*value);
  return draw;
}

/// Returns the vehicle that really flies. Everything that the assumed vehicle has at its CoM (arms,
/// axle, tracked point) is offset from the true CoM. A rotor with less thrust has the same range of
/// speeds.
template <int Rotors>
[[nodiscard]] tilt_ropter::Vehicle<Rotors> true_vehicle(const VehicleDraw& draw,
                                                        tilt_ropter::Vehicle<Rotors> vehicle) {
  vehicle.body.mass *= draw.mass;
  vehicle.body.inertia = scaled_inertia(vehicle.body.inertia, draw.inertia);
  for (tilt_ropter::RotorGeometry& rotor : vehicle.rotors) rotor.position -= draw.com_offset;
  tilt_ropter::change_rotor_parameters(vehicle, [&](tilt_ropter::RotorParameters& rotor) {
    rotor.thrust_coefficient *= draw.thrust;
    rotor.linear_thrust_coefficient *= draw.thrust;
    rotor.min_thrust *= draw.thrust;
    rotor.max_thrust *= draw.thrust;
    rotor.time_constant *= draw.rotor_time_constant;
  });
  vehicle.servo.time_constant *= draw.servo_time_constant;
  return vehicle;
}

}  // namespace examples
