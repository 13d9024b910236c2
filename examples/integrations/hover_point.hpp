#pragma once

#include "../support/solver_choice.hpp"
#include "../support/vehicle_choice.hpp"
#include "parameters.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>

#include <stdexcept>
#include <string>

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

/// Returns the settings of the controller of a node. With `use_sim_time` they have no time limit:
/// a simulated clock runs at any speed, and may wait for the command. `solver` is what solves the
/// quadratic programs: automatic, nlopt or structured.
[[nodiscard]] inline tilt_ropter::NmpcSettings controller_settings(
    const examples::VehicleFile& file, Parameters& parameters) {
  tilt_ropter::NmpcSettings settings = file.settings();
  const std::string solver = parameters.text("solver", "automatic");
  if (examples::program_methods().count(solver) == 0)
    throw std::invalid_argument("solver = " + solver + ": must be automatic, nlopt or structured");
  examples::set_solver(solver, settings.solver);
  return parameters.choice("use_sim_time", false) ? examples::in_simulated_time(settings)
                                                  : settings;
}

}  // namespace loops
