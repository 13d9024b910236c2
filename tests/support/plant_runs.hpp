#pragma once

#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/detail/wheel_contact.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/random.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>

/// Commands, states and runs that the tests of the plant share.
namespace test_support {

/// Rotor speed of the Tilt-Ropter in level hover [rad/s].
inline const double hover_speed = std::sqrt(1.5 * tilt_ropter::gravity / 4.0 / 1.4e-6);

/// Stopped rotors with vertical arms.
inline tilt_ropter::ActuatorState<4> idle() {
  return {};
}

/// Vertical arms at hover_speed.
inline tilt_ropter::ActuatorState<4> hover() {
  tilt_ropter::ActuatorState<4> command;
  command.rotor_speed.setConstant(hover_speed);
  return command;
}

/// Steps the plant for `duration` [s] with constant inputs.
template <int Rotors>
void run(tilt_ropter::Plant<Rotors>& plant, const tilt_ropter::ActuatorState<Rotors>& command,
         const tilt_ropter::Wrenchd& disturbance, double duration, double dt = 1e-3) {
  const int steps = static_cast<int>(std::lround(duration / dt));
  for (int i = 0; i < steps; ++i) ASSERT_TRUE(plant.step(command, disturbance, dt));
}

/// Returns kinetic, potential and elastic energy [J].
inline double energy(const tilt_ropter::Plant<4>& plant, const tilt_ropter::Vehicle<4>& v,
                     tilt_ropter::WheelContactParameters p) {
  const tilt_ropter::BodyStated& body = plant.body();
  double sum = 0.5 * v.body.mass * body.velocity.squaredNorm() +
               0.5 * body.angular_velocity.dot(v.body.inertia * body.angular_velocity) +
               v.body.mass * tilt_ropter::gravity * body.position.z();
  p.dissipation = 0.0;  // the normal force then gives the depth
  for (int i = 0; i < 2; ++i) {
    const tilt_ropter::WheelState& wheel = plant.state().wheels[static_cast<std::size_t>(i)];
    const double spring =
        tilt_ropter::wheel_contact(
            p,
            {{0.0, i == 0 ? -v.wheels->half_track : v.wheels->half_track, 0.0}, v.wheels->radius},
            body, body.orientation.toRotationMatrix(), wheel)
            .normal_force;
    sum += 0.5 * v.wheels->inertia * wheel.spin * wheel.spin + 0.5 * spring * spring / p.stiffness +
           0.5 * p.bristle_stiffness * wheel.bristle.squaredNorm();
  }
  return sum;
}

/// A random state at `height` [m], rotors stopped, which turns about any axis.
inline tilt_ropter::PlantState<4> tumbling(Random& random, double height) {
  tilt_ropter::PlantState<4> x;
  x.body.position.z() = height;
  x.body.velocity = random.vector(1.0);
  x.body.orientation = random.orientation();
  x.body.angular_velocity = random.vector(5.0);
  x.wheels[0].spin = random.uniform(-20.0, 20.0);
  x.wheels[1].spin = random.uniform(-20.0, 20.0);
  return x;
}

}  // namespace test_support
