#pragma once

#include "../support/control_level.hpp"
#include "../support/mission_choice.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_choice.hpp"
#include "messages.hpp"
#include "parameters.hpp"
#include "set_points.hpp"

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
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
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
  return std::visit(
      [&](const auto& vehicle) {
        tilt_ropter::Mission result = examples::mission_of(choice, vehicle);
        if constexpr (examples::HasWrenchLevel<std::decay_t<decltype(vehicle)>>::value)
          if (examples::reason_against_wrench_level(file).empty())
            examples::print(std::cerr,
                            check_reference(result, result.start_time(), result.end_time(), vehicle,
                                            file.settings()));
        return result;
      },
      file.vehicle);
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
  /// Nobody means a point that is lower than the CoM of the vehicle on the ground, at z = 0, by
  /// more than this [m]: its z points down.
  static constexpr double deepest = 0.5;

  /// The point or the mission of the parameters. Throws as mission_of(), and std::invalid_argument
  /// for a point below the ground.
  FlightPlan(Parameters& parameters, const examples::VehicleFile& file)
      : undercarriage_(std::visit([](const auto& v) { return undercarriage(v); }, file.vehicle)) {
    const auto coordinate = [&](const char* name, double otherwise) {
      return parameters.number(name, otherwise, -farthest, farthest);
    };
    point_.position << coordinate("hover_x", 0.0), coordinate("hover_y", 0.0),
        coordinate("hover_z", 1.5);
    point_.yaw = parameters.number("hover_yaw", 0.0, -2.0 * tilt_ropter::pi, 2.0 * tilt_ropter::pi);
    if (is_below_ground(point_.position))
      throw std::invalid_argument("hover_z = " + parameters.text("hover_z") +
                                  ": must be above the ground, at 0; z points up");
    if (const auto mission = mission_of(parameters, file))
      mission_ = std::make_shared<const tilt_ropter::Mission>(*mission);
    restart();
    fly_pieces({}, 0.0);
  }

  /// The reference at `time` [s].
  tilt_ropter::ReferencePoint operator()(double time) const {
    tilt_ropter::ReferencePoint point = piece(time)(time);
    if (follows_set_points_ && point.position.z() < floor_) {  // a motion that goes on, or stops
      point.position.z() = floor_;
      point.velocity.z() = std::max(point.velocity.z(), 0.0);
      point.acceleration.z() = std::max(point.acceleration.z(), 0.0);
    }
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
    if (is_over && rests_ != Rest::none) return rests_ == Rest::paused ? "paused" : "landed";
    if (now.motion<SetPoints>()) return "set points";
    return is_over ? "hover point" : "way";
  }

  /// Begins, or goes on after stop(), at `time` [s], from where the vehicle is or can stop.
  void start(const tilt_ropter::BodyStated& body, double time) {
    constexpr double braking = 2.0;  // [m/s^2]
    const Eigen::Vector3d stop = body.velocity.norm() / (2.0 * braking) * body.velocity;
    const tilt_ropter::Waypoint here{body.position + stop - step_,
                                     tilt_ropter::yaw_of(body.orientation) - turn_};
    if (rests_ != Rest::none)
      rest({}, here, rests_, time);
    else
      go_on({}, here, time);
  }

  /// The motion of `time` [s] ends within a second, and the vehicle hovers, or stands, until
  /// resume(), or until it is sent elsewhere.
  void pause(double time) { end(Rest::paused, time); }
  /// The same, and then it lands, straight down, also if stop() comes in between.
  void land(double time) { end(Rest::landed, time); }
  /// Goes on where pause() or land() has ended it, at `time` [s].
  void resume(double time) {
    if (std::exchange(rests_, Rest::none) == Rest::none) return;
    Pieces pieces = ending(time);
    const tilt_ropter::Waypoint here = place(at_rest(pieces, time));
    go_on(std::move(pieces), here, time);
  }

  /// The vehicle does not follow from `time` [s] on. A mission waits for start().
  void stop(double time) {
    const tilt_ropter::MissionSegment& now = piece(time);
    if (const auto* paced = now.motion<PacedMission>())
      progress_ = paced->progress(std::clamp(time - now.start_time(), 0.0, now.duration()));
    if (rests_ == Rest::landed && &now == &pieces_.back()) rests_ = Rest::paused;  // it has landed
  }
  /// The mission begins anew with the next start().
  void restart() {
    progress_ = mission_ ? mission_->start_time() : 0.0;
    rests_ = Rest::none;
  }

  /// Flies to another point, at `time` [s]: the position and the heading of `pose`. This ends a
  /// mission. Returns false, and flies on, if it is no pose, farther away than `farthest` or below
  /// the ground.
  bool fly_to(const geometry_msgs::msg::Pose& pose, double time) {
    const Eigen::Vector3d position(pose.position.x, pose.position.y, pose.position.z);
    const Eigen::Quaterniond orientation(pose.orientation.w, pose.orientation.x, pose.orientation.y,
                                         pose.orientation.z);
    if (!((position - (*this)(time).position).norm() < farthest) ||
        !(std::abs(orientation.norm() - 1.0) < 0.01))
      return false;
    const tilt_ropter::Waypoint to{position - step_,
                                   tilt_ropter::yaw_of(orientation.normalized()) - turn_};
    if (is_below_ground(to.position)) return false;
    if (!mission_ && to.position == point_.position && to.yaw == point_.yaw && rests_ == Rest::none)
      return true;  // a stream of the same point does not hold the vehicle back
    Pieces pieces = ending(time);
    const tilt_ropter::ReferencePoint from = at_rest(pieces, time);
    mission_.reset();
    rests_ = Rest::none;
    point_ = to;
    for (auto& part : way({from.position, tilt_ropter::yaw_of(from.orientation)}))
      pieces.push_back(std::move(part));
    fly_pieces(std::move(pieces), time);
    return true;
  }

  /// Follows `points` from `time` [s] on, until others come; at the end it stops. To a trajectory
  /// that begins somewhere else the vehicle first flies. This ends a mission. Returns false,
  /// and flies on, if there are none, numbers are not finite, times do not rise, or they are
  /// farther away than `farthest` or below the ground. Between and after them the reference stays
  /// above the ground and the lowest of them.
  bool follow(std::vector<SetPoint> points, double time) {
    double floor = lowest();
    for (SetPoint& p : points) {
      p.position -= step_;
      p.yaw -= turn_;
      floor = std::min(floor, p.position.z());
      if (is_below_ground(p.position)) return false;
    }
    std::optional<SetPoints> motion = SetPoints::through(std::move(points));
    if (!motion) return false;
    const tilt_ropter::ReferencePoint now = piece(time)(time), first = (*motion)(0.0);
    if (!((first.position - now.position).norm() < farthest)) return false;
    // The set points of the last message, which a way may lead to.
    const tilt_ropter::MissionSegment* last =
        follows_set_points_ ? &pieces_[pieces_.size() - 3] : nullptr;
    Pieces pieces;
    if (motion->is_single() || are_close(first, now)) {
      motion->begin_at(now);
    } else if (last && time < last->start_time() && are_close(first, (*last)(last->start_time()))) {
      // It is on its way there, and a stream of set points does not hold it back.
      motion->begin_at((*last)(last->start_time()));
      pieces.assign(pieces_.begin(), pieces_.end() - 3);
      time = pieces.front().start_time();
    } else {
      pieces = ending(time);
      const tilt_ropter::ReferencePoint from = at_rest(pieces, time);
      mission_.reset();
      point_ = {first.position, tilt_ropter::yaw_of(first.orientation)};
      for (auto& part : way({from.position, tilt_ropter::yaw_of(from.orientation)}))
        pieces.push_back(std::move(part));
    }
    mission_.reset();
    rests_ = Rest::none;
    const Braking braking{(*motion)(motion->duration())};
    tilt_ropter::ReferencePoint end = braking(Braking::duration);
    end.position.z() = std::max(end.position.z(), floor);
    point_ = {end.position, tilt_ropter::yaw_of(end.orientation)};
    pieces.push_back({tilt_ropter::MissionPhase::air, *motion, 0.0, motion->duration()});
    pieces.push_back({tilt_ropter::MissionPhase::air, braking, 0.0, Braking::duration});
    pieces.push_back({tilt_ropter::MissionPhase::hover, tilt_ropter::Hold(point_, 1e-3)});
    fly_pieces(std::move(pieces), time);
    follows_set_points_ = true;
    floor_ = floor;
    return true;
  }

  /// The frame of all positions has moved by `step` [m], that of headings by `turn` [rad].
  void move(const Eigen::Vector3d& step, double turn) {
    step_ += step;
    turn_ += turn;
  }

 private:
  using Pieces = std::vector<tilt_ropter::MissionSegment>;
  enum class Rest { none, paused, landed };  // after pause() or land()

  // Height of the CoM on the ground [m].
  [[nodiscard]] double lowest() const { return undercarriage_ ? undercarriage_->height : 0.0; }
  [[nodiscard]] bool is_below_ground(const Eigen::Vector3d& position) const {
    return position.z() < lowest() - deepest;
  }

  // The motion of now ends within a second.
  [[nodiscard]] Pieces ending(double time) const {
    const tilt_ropter::MissionSegment& now = piece(time);
    if (const auto* mission = now.motion<PacedMission>()) {
      const double passed = std::clamp(time - now.start_time(), 0.0, now.duration());
      return {paced({mission->mission, mission->progress(passed), mission->pace(passed), 0.0})};
    }
    const tilt_ropter::ReferencePoint point = now(time);
    if (!(point.velocity.norm() > 0.01)) return {};
    return {{tilt_ropter::MissionPhase::air, Braking{point}, 0.0, Braking::duration}};
  }
  static tilt_ropter::Waypoint place(const tilt_ropter::ReferencePoint& point) {
    return {point.position, tilt_ropter::yaw_of(point.orientation)};
  }

  // A mission goes on later from where its `ending` leads.
  void keep_progress(const Pieces& ending) {
    if (ending.empty()) return;
    if (const auto* paced = ending.front().motion<PacedMission>())
      progress_ = paced->progress(PacedMission::ramp);
  }
  void rest(Pieces ending, tilt_ropter::Waypoint here, Rest how, double time) {
    keep_progress(ending);
    if (how == Rest::landed && here.position.z() > lowest() + 1e-3) {
      ending.push_back({tilt_ropter::MissionPhase::landing, landing(here, lowest())});
      here.position.z() = lowest();
    }
    ending.push_back({tilt_ropter::MissionPhase::hover, tilt_ropter::Hold(here, 1e-3)});
    fly_pieces(std::move(ending), time);
    rests_ = how;
  }
  void end(Rest how, double time) {
    Pieces pieces = ending(time);
    const tilt_ropter::Waypoint here = place(at_rest(pieces, time));
    rest(std::move(pieces), here, how, time);
  }
  // After `ending`, from `here`.
  void go_on(Pieces ending, const tilt_ropter::Waypoint& here, double time) {
    keep_progress(ending);
    for (auto& part : way(here)) ending.push_back(std::move(part));
    if (mission_) ending.push_back(paced({mission_, progress_, 0.0, 1.0}));
    fly_pieces(std::move(ending), time);
  }

  // Where ending() leads.
  [[nodiscard]] tilt_ropter::ReferencePoint at_rest(const Pieces& ending, double time) const {
    return ending.empty() ? piece(time)(time) : ending.back()(ending.back().end_time());
  }

  [[nodiscard]] static bool are_close(const tilt_ropter::ReferencePoint& a,
                                      const tilt_ropter::ReferencePoint& b) {
    constexpr double near = 0.5, about = 0.6;  // [m], [rad]
    return (a.position - b.position).norm() < near &&
           a.orientation.angularDistance(b.orientation) < about;
  }

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

  void fly_pieces(Pieces pieces, double time) {
    follows_set_points_ = false;
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
  Rest rests_ = Rest::none;
  bool follows_set_points_ = false;
  double floor_ = 0.0;  // lowest reference of set points [m]
};

/// Returns the same settings as the parameters of a node say. With `use_sim_time` they have no time
/// limit: a simulated clock runs at any speed, and may wait for the command. `solver` is what
/// solves the quadratic programs: automatic, nlopt or structured.
template <typename Settings>
[[nodiscard]] Settings as_the_node_says(Settings settings, Parameters& parameters) {
  const std::string solver = parameters.text("solver", "automatic");
  if (examples::program_methods().count(solver) == 0)
    throw std::invalid_argument("solver = " + solver + ": must be automatic, nlopt or structured");
  examples::set_solver(solver, settings.solver);
  if (parameters.choice("use_sim_time", false))
    settings.time_limit = std::numeric_limits<double>::infinity();
  return settings;
}

/// Makes a `Controller` of `vehicle`, its settings at the level of the parameter `level`, and the
/// other arguments. Throws std::invalid_argument for a wrong level.
template <typename Controller, int Rotors, typename... Arguments>
[[nodiscard]] Controller at_level(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                  const examples::VehicleFile& file, Parameters& parameters,
                                  const Arguments&... arguments) {
  const std::string level = parameters.text("level");
  if (!level.empty() && level != "wrench" && level != "actuator")
    throw std::invalid_argument("level = " + level + ": must be wrench or actuator");
  const std::string choice = examples::level_choice(level, file);
  if (!choice.empty()) std::cerr << choice << '\n';
  return examples::at_level(level, file, vehicle, [&](const auto& settings) {
    return Controller(vehicle, as_the_node_says(settings, parameters), arguments...);
  });
}

}  // namespace loops
