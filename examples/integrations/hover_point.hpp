#pragma once

#include "../support/solver_choice.hpp"
#include "../support/vehicle_choice.hpp"
#include "messages.hpp"
#include "parameters.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <optional>
#include <stdexcept>
#include <string>

namespace loops {

/// Where a node hovers, and the way there, with at most 1 m/s and 1 m/s^2. Replace it by your
/// mission: any callable that takes a time and returns a ReferencePoint.
class HoverPoint {
 public:
  static constexpr double farthest = 1e4;  ///< longest way [m]

  /// The point of the parameters.
  explicit HoverPoint(Parameters& parameters) {
    point_.position << parameters.number("hover_x", 0.0), parameters.number("hover_y", 0.0),
        parameters.number("hover_z", 1.5);
    point_.yaw = parameters.number("hover_yaw", 0.0);
    validate(point_, "hover_x, hover_y, hover_z, hover_yaw");
  }

  /// The reference at `time` [s].
  tilt_ropter::ReferencePoint operator()(double time) const {
    if (way_) return (*way_)(time);
    tilt_ropter::ReferencePoint point;
    point.position = point_.position;
    point.orientation = tilt_ropter::quaternion_from_yaw(point_.yaw);
    return point;
  }

  /// Flies to the point, at `time` [s], from where the vehicle is or can stop.
  void start(const tilt_ropter::BodyStated& body, double time) {
    constexpr double braking = 2.0;  // [m/s^2]
    begin({body.position + body.velocity.norm() / (2.0 * braking) * body.velocity,
           tilt_ropter::yaw_of(body.orientation)},
          time);
  }

  /// Flies to another point, at `time` [s]: the position and the heading of `pose`. Returns false,
  /// and flies on, if it is no pose or farther away than `farthest`.
  bool fly_to(const geometry_msgs::msg::Pose& pose, double time) {
    const Eigen::Vector3d position(pose.position.x, pose.position.y, pose.position.z);
    const Eigen::Quaterniond orientation(pose.orientation.w, pose.orientation.x, pose.orientation.y,
                                         pose.orientation.z);
    const tilt_ropter::ReferencePoint now = (*this)(time);
    if (!((position - now.position).norm() < farthest) ||
        !(std::abs(orientation.norm() - 1.0) < 0.01))
      return false;
    point_ = {position, tilt_ropter::yaw_of(orientation.normalized())};
    begin({now.position, tilt_ropter::yaw_of(now.orientation)}, time);
    return true;
  }

  /// The frame of all positions has moved by `step` [m], that of headings by `turn` [rad].
  void move(const Eigen::Vector3d& step, double turn) {
    move(point_, step, turn);
    if (!way_) return;
    tilt_ropter::Waypoint from = way_->settings().from;
    move(from, step, turn);
    begin(from, way_->start_time());
  }

 private:
  static void move(tilt_ropter::Waypoint& place, const Eigen::Vector3d& step, double turn) {
    place.position += step;
    place.yaw += turn;
  }

  void begin(const tilt_ropter::Waypoint& from, double time) {
    way_.reset();
    if (!((point_.position - from.position).norm() < farthest)) return;
    tilt_ropter::TransitionSettings settings;
    settings.from = from;
    settings.to = point_;
    way_.emplace(settings);
    way_->set_start_time(time);
  }

  tilt_ropter::Waypoint point_;
  std::optional<tilt_ropter::Transition> way_;
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
