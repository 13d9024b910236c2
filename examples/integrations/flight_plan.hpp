#pragma once

#include "../support/mission_choice.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_choice.hpp"
#include "messages.hpp"
#include "parameters.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <iostream>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace loops {

/// Returns the mission of the parameters `mission`, a name or a JSON file, or `trajectory`, a CSV
/// file; nothing without them. Prints which limits of the controller it passes. Throws
/// std::invalid_argument if both are set or the vehicle cannot do it, InputFileError for a wrong
/// file.
[[nodiscard]] inline std::optional<tilt_ropter::Mission> mission_of(
    Parameters& parameters, const examples::VehicleFile& file) {
  const std::string mission = parameters.text("mission");
  examples::MissionChoice choice;
  choice.trajectory = parameters.text("trajectory");
  if (mission.empty() && choice.trajectory.empty()) return std::nullopt;
  if (!mission.empty() && !choice.trajectory.empty())
    throw std::invalid_argument("mission = " + mission + ", trajectory = " + choice.trajectory +
                                ": must be only one of the two");
  const auto& names = examples::mission_names();
  const bool is_name = std::find(names.begin(), names.end(), mission) != names.end();
  (is_name ? choice.name : choice.file) = mission;
  const tilt_ropter::Vehicle<4> vehicle = examples::quadrotor(file);
  tilt_ropter::Mission result = examples::mission_of(choice, vehicle);
  examples::print(std::cerr, check_reference(result, result.start_time(), result.end_time(),
                                             vehicle, file.settings()));
  return result;
}

/// A mission from `from` [s] on whose pace changes evenly from `first` to `last` within `ramp`, so
/// that it begins and ends in motion without a jump.
struct PacedMission {
  static constexpr double ramp = 1.0;  ///< [s]

  /// Time of the mission after `passed` [s].
  [[nodiscard]] double progress(double passed) const {
    const double u = std::min(passed, ramp);
    return from + first * u + (last - first) * u * u / (2.0 * ramp) + last * (passed - u);
  }
  [[nodiscard]] double pace(double passed) const {
    return first + (last - first) * std::min(passed / ramp, 1.0);
  }
  [[nodiscard]] double duration() const {
    return last == 0.0 ? ramp : std::max(mission->end_time() - from, 0.0) + ramp / 2.0;
  }
  tilt_ropter::ReferencePoint operator()(double passed) const {
    tilt_ropter::ReferencePoint point = (*mission)(progress(passed));
    const double rate = pace(passed), change = passed < ramp ? (last - first) / ramp : 0.0;
    point.acceleration = rate * rate * point.acceleration + change * point.velocity;
    point.angular_acceleration =
        rate * rate * point.angular_acceleration + change * point.angular_velocity;
    point.velocity *= rate;
    point.angular_velocity *= rate;
    return point;
  }

  std::shared_ptr<const tilt_ropter::Mission> mission;
  double from, first, last;
};

/// What a node flies: to a point, where it hovers, or a mission. The way from where the vehicle is
/// to the point, or to where the mission begins or goes on, has at most 1 m/s and 1 m/s^2. Replace
/// it by any callable that takes a time and returns a ReferencePoint.
class FlightPlan {
 public:
  static constexpr double farthest = 1e4;  ///< longest way [m]

  /// The point or the mission of the parameters. Throws as mission_of().
  FlightPlan(Parameters& parameters, const examples::VehicleFile& file)
      : undercarriage_(undercarriage(examples::quadrotor(file))) {
    point_.position << parameters.number("hover_x", 0.0), parameters.number("hover_y", 0.0),
        parameters.number("hover_z", 1.5);
    point_.yaw = parameters.number("hover_yaw", 0.0);
    validate(point_, "hover_x, hover_y, hover_z, hover_yaw");
    if (const auto mission = mission_of(parameters, file))
      mission_ = std::make_shared<const tilt_ropter::Mission>(*mission);
    restart();
    follow({}, 0.0);
  }

  /// The reference at `time` [s].
  tilt_ropter::ReferencePoint operator()(double time) const {
    tilt_ropter::ReferencePoint point = piece(time)(time);
    point.position += step_;
    point.orientation = tilt_ropter::quaternion_from_yaw(turn_) * point.orientation;
    if (point.push) point.push->surface.point += step_;
    return point;
  }

  /// What the reference does at `time` [s]: a phase of the mission, or the other words here.
  [[nodiscard]] const char* activity(double time) const {
    const tilt_ropter::MissionSegment& now = piece(time);
    const bool is_over = time >= now.end_time();
    if (const auto* paced = now.motion<PacedMission>())
      return is_over ? "mission is over"
                     : to_string(paced->mission->phase(paced->progress(time - now.start_time())));
    return is_over ? "hover point" : "way";
  }

  /// Begins, or goes on after stop(), at `time` [s], from where the vehicle is or can stop.
  void start(const tilt_ropter::BodyStated& body, double time) {
    constexpr double braking = 2.0;  // [m/s^2]
    const Eigen::Vector3d stop = body.velocity.norm() / (2.0 * braking) * body.velocity;
    std::vector<tilt_ropter::MissionSegment> pieces =
        way({body.position + stop - step_, tilt_ropter::yaw_of(body.orientation) - turn_});
    if (mission_) pieces.push_back(paced({mission_, progress_, 0.0, 1.0}));
    follow(std::move(pieces), time);
  }

  /// The vehicle does not follow from `time` [s] on. A mission waits for start().
  void stop(double time) {
    const tilt_ropter::MissionSegment& now = piece(time);
    if (const auto* paced = now.motion<PacedMission>())
      progress_ = paced->progress(std::clamp(time - now.start_time(), 0.0, now.duration()));
  }
  /// The mission begins anew with the next start().
  void restart() { progress_ = mission_ ? mission_->start_time() : 0.0; }

  /// Flies to another point, at `time` [s]: the position and the heading of `pose`. This ends a
  /// mission. Returns false, and flies on, if it is no pose or farther away than `farthest`.
  bool fly_to(const geometry_msgs::msg::Pose& pose, double time) {
    const Eigen::Vector3d position(pose.position.x, pose.position.y, pose.position.z);
    const Eigen::Quaterniond orientation(pose.orientation.w, pose.orientation.x, pose.orientation.y,
                                         pose.orientation.z);
    if (!((position - (*this)(time).position).norm() < farthest) ||
        !(std::abs(orientation.norm() - 1.0) < 0.01))
      return false;
    const tilt_ropter::Waypoint to{position - step_,
                                   tilt_ropter::yaw_of(orientation.normalized()) - turn_};
    if (!mission_ && to.position == point_.position && to.yaw == point_.yaw)
      return true;  // a stream of the same point does not hold the vehicle back
    const tilt_ropter::MissionSegment now = piece(time);
    tilt_ropter::ReferencePoint from = now(time);
    std::vector<tilt_ropter::MissionSegment> pieces;
    if (const auto* paced = now.motion<PacedMission>()) {
      const double passed = std::clamp(time - now.start_time(), 0.0, now.duration());
      pieces.push_back(
          this->paced({paced->mission, paced->progress(passed), paced->pace(passed), 0.0}));
      from = pieces.back()(PacedMission::ramp);
    }
    mission_.reset();
    point_ = to;
    for (auto& part : way({from.position, tilt_ropter::yaw_of(from.orientation)}))
      pieces.push_back(std::move(part));
    follow(std::move(pieces), time);
    return true;
  }

  /// The frame of all positions has moved by `step` [m], that of headings by `turn` [rad].
  void move(const Eigen::Vector3d& step, double turn) {
    step_ += step;
    turn_ += turn;
  }

 private:
  using Pieces = std::vector<tilt_ropter::MissionSegment>;

  static tilt_ropter::MissionSegment paced(const PacedMission& mission) {
    return {mission.mission->phase(mission.from), mission, 0.0, mission.duration()};
  }

  // Where the way leads.
  [[nodiscard]] tilt_ropter::Waypoint target() const {
    if (!mission_) return point_;
    const tilt_ropter::ReferencePoint point = (*mission_)(progress_);
    return {point.position, tilt_ropter::yaw_of(point.orientation)};
  }

  // From rest at `from` to the target. Wheels do not go sideways: to another place on the ground,
  // or low above it, the vehicle flies, and there straight down. No way to where it stands.
  [[nodiscard]] Pieces way(const tilt_ropter::Waypoint& from) const {
    constexpr double near = 0.05, about = 0.1, above = 0.5, low = 0.2;  // [m], [rad], [m], [m]
    const tilt_ropter::Waypoint to = target();
    const double far = (to.position - from.position).norm(), height = to.position.z();
    const bool is_low = undercarriage_ && height < undercarriage_->height + low;
    if (!(far < farthest)) return {};
    if (is_low && far < near &&
        std::abs(std::remainder(to.yaw - from.yaw, 2.0 * tilt_ropter::pi)) < about)
      return {};
    tilt_ropter::TransitionSettings settings;
    settings.from = from;
    settings.to = to;
    if (is_low) settings.to.position.z() = std::max(from.position.z(), height + above);
    Pieces pieces = {{tilt_ropter::MissionPhase::air, tilt_ropter::Transition(settings)}};
    if (is_low)
      pieces.push_back({tilt_ropter::MissionPhase::landing, landing(settings.to, height)});
    return pieces;
  }

  void follow(Pieces pieces, double time) {
    if (pieces.empty())
      pieces.push_back({tilt_ropter::MissionPhase::hover, tilt_ropter::Hold(target(), 1e-3)});
    for (auto& part : pieces) {
      part.set_start_time(time);
      time = part.end_time();
    }
    pieces_ = std::move(pieces);
  }

  [[nodiscard]] const tilt_ropter::MissionSegment& piece(double time) const {
    std::size_t i = 0;
    while (i + 1 < pieces_.size() && time >= pieces_[i].end_time()) ++i;
    return pieces_[i];
  }

  std::optional<tilt_ropter::Undercarriage> undercarriage_;
  tilt_ropter::Waypoint point_;
  std::shared_ptr<const tilt_ropter::Mission> mission_;
  double progress_ = 0.0;                           // where the mission begins or goes on [s]
  Pieces pieces_;                                   // one after another
  Eigen::Vector3d step_ = Eigen::Vector3d::Zero();  // of the frame, see move() [m]
  double turn_ = 0.0;                               // [rad]
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
