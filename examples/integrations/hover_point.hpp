#pragma once

#include "parameters.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/planning/reference.hpp>

namespace loops {

/// The hover point of a node, from its parameters. Replace it by your mission: any callable that
/// takes a time and returns a ReferencePoint.
struct HoverPoint {
  explicit HoverPoint(Parameters& parameters) {
    point.position << parameters.number("hover_x", 0.0), parameters.number("hover_y", 0.0),
        parameters.number("hover_z", 1.5);
    point.orientation = tilt_ropter::quaternion_from_yaw(parameters.number("hover_yaw", 0.0));
  }
  tilt_ropter::ReferencePoint operator()(double) const { return point; }

  tilt_ropter::ReferencePoint point;
};

}  // namespace loops
