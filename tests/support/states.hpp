#pragma once

#include <tilt_ropter/model/state.hpp>

#include "support/random.hpp"

namespace test_support {

using tilt_ropter::State;
using tilt_ropter::Stated;

/// Returns a state far from rest with any orientation.
inline Stated random_state(Random& random) {
  Stated x;
  x.wrench = {random.vector(10.0), random.vector(1.0)};
  x.body.position = random.vector(5.0);
  x.body.velocity = random.vector(5.0);
  x.body.orientation = random.orientation();
  x.body.angular_velocity = random.vector(6.0);
  return x;
}

/// Returns the same state in another scalar type, for automatic differentiation.
template <typename Scalar>
State<Scalar> cast(const Stated& x) {
  State<Scalar> y;
  y.wrench.force = x.wrench.force.cast<Scalar>();
  y.wrench.torque = x.wrench.torque.cast<Scalar>();
  y.body.position = x.body.position.cast<Scalar>();
  y.body.velocity = x.body.velocity.cast<Scalar>();
  y.body.orientation = x.body.orientation.cast<Scalar>();
  y.body.angular_velocity = x.body.angular_velocity.cast<Scalar>();
  return y;
}

}  // namespace test_support
