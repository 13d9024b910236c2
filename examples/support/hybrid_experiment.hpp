#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/planning/excitation.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <optional>

/// The trajectories of the paper's experiments, and that of a flight for the identification.
namespace examples {

inline void require_drives(const tilt_ropter::Undercarriage& undercarriage) {
  validate(undercarriage);
  tilt_ropter::require(undercarriage.rolls && undercarriage.turns, "Undercarriage",
                       undercarriage.rolls ? "one that does not turn" : "one that does not roll",
                       "one that rolls and turns");
}

/// The aerial figure eight: hover, the eight, hover (paper, Sec. Aerial Flight). Uses the settings
/// of the eight in the air. Throws std::invalid_argument if the settings are invalid.
[[nodiscard]] inline tilt_ropter::Mission aerial_experiment(
    const tilt_ropter::HybridMissionSettings& p = {}) {
  return tilt_ropter::hybrid_mission(std::nullopt, p);
}

/// A flight that excites all axes, for the identification of the vehicle: hover, an Excitation of
/// the position, another of the attitude, hover. One after the other, so that the rates of the
/// force stay within the limits of the Tilt-Ropter. Takes origin, yaw, flight_height, hover_time
/// and start_time of `p`. Throws std::invalid_argument if the settings are invalid.
[[nodiscard]] inline tilt_ropter::Mission excitation_experiment(
    const tilt_ropter::HybridMissionSettings& p = {}) {
  using namespace tilt_ropter;
  validate(p);
  ExcitationSettings moves;
  moves.center.position << p.origin, p.flight_height;
  moves.center.yaw = p.yaw;
  const Hold hover(moves.center, p.hover_time);
  ExcitationSettings turns = moves;
  moves.angular_acceleration = turns.acceleration = 0.0;
  return Mission({{MissionPhase::hover, hover},
                  {MissionPhase::air, Excitation(moves)},
                  {MissionPhase::air, Excitation(turns)},
                  {MissionPhase::hover, hover}},
                 p.start_time);
}

/// The figure eight on the ground: rest, the eight, rest (paper, Sec. Ground Locomotion). The
/// heading follows the path. Throws std::invalid_argument if the settings are invalid or if the
/// undercarriage cannot drive the eight.
[[nodiscard]] inline tilt_ropter::Mission ground_experiment(
    const tilt_ropter::Undercarriage& undercarriage,
    const tilt_ropter::HybridMissionSettings& p = {}) {
  using namespace tilt_ropter;
  validate(p);
  require_drives(undercarriage);
  const FigureEight eight(tilt_ropter::detail::ground_eight(p, undercarriage.height));
  const ReferencePoint start = eight(eight.start_time());
  const Hold rest({start.position, yaw_of(start.orientation)}, p.rest_time);
  return Mission(
      {{MissionPhase::rest, rest}, {MissionPhase::ground, eight}, {MissionPhase::rest, rest}},
      p.start_time);
}

/// Lengths of hybrid_experiment() between the two eights and after them.
struct HybridExperimentSettings {
  double descent_length = 4.0;  ///< level distance of the landing [m]
  double climb_length = 4.0;    ///< level distance of the take-off [m]
  double roll_length = 0.5;     ///< distance on the ground after touch-down and before take-off [m]
};

/// The hybrid trajectory (paper, Sec. Air-Ground Mode Transition): hover, the eight in the air, a
/// landing while rolling, the eight on the ground, a take-off while rolling, hover. Between the
/// first and the last hover the vehicle never stops. The eight in the air ends with its full speed.
/// From there the path goes in the direction in which the eight on the ground crosses itself.
/// Throws std::invalid_argument if the settings are invalid or if the undercarriage cannot drive
/// the eight.
[[nodiscard]] inline tilt_ropter::Mission hybrid_experiment(
    const tilt_ropter::Undercarriage& undercarriage,
    const tilt_ropter::HybridMissionSettings& p = {},
    const HybridExperimentSettings& lengths = {}) {
  using namespace tilt_ropter;
  validate(p);
  require_drives(undercarriage);
  require_positive("HybridExperimentSettings.descent_length [m]", lengths.descent_length);
  require_positive("HybridExperimentSettings.climb_length [m]", lengths.climb_length);
  require_positive("HybridExperimentSettings.roll_length [m]", lengths.roll_length);

  FigureEightSettings air = tilt_ropter::detail::air_eight(p);
  air.ends_moving = true;
  FigureEightSettings ground = tilt_ropter::detail::ground_eight(p, undercarriage.height);
  ground.starts_moving = ground.ends_moving = true;
  const ReferencePoint crossing = FigureEight(ground)(0.0);
  const Eigen::Vector3d velocity = crossing.velocity, ahead = velocity.normalized();
  const Eigen::Vector3d above(0.0, 0.0, p.flight_height - undercarriage.height);

  // The body keeps the heading in which the eight in the air ends.
  const FigureEight air_eight(air);
  const ReferencePoint end = air_eight(air_eight.end_time());
  air.yaw = std::atan2(end.velocity.y(), end.velocity.x());
  const Waypoint start{air.center, air.yaw};

  MinimumSnapSettings piece;
  piece.heading = HeadingMode::along_velocity;
  piece.max_acceleration = p.max_acceleration;
  piece.max_yaw_rate = p.max_yaw_rate;
  const auto straight = [&](const Eigen::Vector3d& from, const Eigen::Vector3d& to) {
    MinimumSnapSettings s = piece;
    s.points = {from, to};
    s.start_velocity = s.end_velocity = velocity;
    s.max_speed = velocity.norm();
    return MinimumSnap(s);
  };
  // Places along the line: touch-down, the crossing of the eight on the ground, lift-off, hover.
  const Eigen::Vector3d touch_down = end.position - above + lengths.descent_length * ahead;
  ground.center = touch_down + lengths.roll_length * ahead;
  const Eigen::Vector3d lift_off = ground.center + lengths.roll_length * ahead;
  const Eigen::Vector3d stop = lift_off + lengths.climb_length * ahead + above;

  MinimumSnapSettings down = piece, up = piece;
  down.points = {end.position, touch_down};
  down.start_velocity = end.velocity;
  down.end_velocity = velocity;
  down.max_speed = std::max(end.velocity.norm(), velocity.norm()) * 1.1;
  up.points = {lift_off, stop};
  up.start_velocity = velocity;
  up.max_speed = velocity.norm() * 1.1;
  const Waypoint last{stop, yaw_of(crossing.orientation)};
  return Mission({{MissionPhase::hover, Hold(start, p.hover_time)},
                  {MissionPhase::air, FigureEight(air)},
                  {MissionPhase::landing, MinimumSnap(down)},
                  {MissionPhase::ground, straight(touch_down, ground.center)},
                  {MissionPhase::ground, FigureEight(ground)},
                  {MissionPhase::ground, straight(ground.center, lift_off)},
                  {MissionPhase::take_off, MinimumSnap(up)},
                  {MissionPhase::hover, Hold(last, p.hover_time)}},
                 p.start_time);
}

}  // namespace examples
