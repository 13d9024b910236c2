// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/figure_eight.hpp>
#include <tilt_ropter/planning/minimum_snap.hpp>
#include <tilt_ropter/planning/sampled_path.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cmath>
#include <cstddef>
#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

/// Mission: a sequence of motions, each with its mission phase; the mission of the paper.
namespace tilt_ropter {

/// Phase of a mission. In `rest` and `ground` the vehicle is on wheels or legs, else it flies.
enum class MissionPhase { rest, take_off, hover, air, landing, ground };

[[nodiscard]] constexpr const char* to_string(MissionPhase phase) noexcept {
  return detail::name_in({"rest", "take_off", "hover", "air", "landing", "ground"}, phase);
}

/// Reference at rest at one place.
class Hold : public detail::Timing {
 public:
  /// `duration` [s]. Throws std::invalid_argument if it is out of range or `place` is not finite.
  Hold(const Waypoint& place, double duration) {
    validate(place, "Hold.place");
    require_in("Hold.duration [s]", duration, 1e-3, 1e10);
    set_timing(0.0, duration);
    point_.position = place.position;
    point_.orientation = quaternion_from_yaw(place.yaw);
  }

  [[nodiscard]] ReferencePoint operator()(double) const noexcept { return point_; }

 private:
  ReferencePoint point_;
};

/// One motion of a mission: any callable from time [s] to ReferencePoint. It is called only with
/// times from its start to its end, and must not throw: an exception would end the program.
class MissionSegment : public detail::Timing {
 public:
  using Curve = std::function<ReferencePoint(double)>;

  /// A motion that knows its times, such as Transition, FigureEight or MinimumSnap.
  template <typename Motion>
  MissionSegment(MissionPhase at, Motion motion)
      : MissionSegment(at, motion, motion.start_time(), motion.end_time()) {}
  /// Any other curve, between two of its times [s]. Throws std::invalid_argument if `curve` is
  /// empty or the times are not 1 ms to 1e10 s apart.
  MissionSegment(MissionPhase at, Curve curve, double from, double until)
      : phase(at), curve_(std::move(curve)), from_(from) {
    require(curve_ != nullptr, "MissionSegment.curve", "empty", "a callable");
    require_time("MissionSegment.from [s]", from);
    require_in("MissionSegment.until - from [s]", until - from, 1e-3, 1e10);
    set_timing(from, until - from);
  }

  [[nodiscard]] ReferencePoint operator()(double time) const noexcept {
    ReferencePoint point = curve_(from_ + elapsed(time));
    for (std::size_t i = 0; i < inside.size(); ++i)
      if (!inside[i].normal.isZero(0.0)) point.inside[i] = inside[i];
    return point;
  }
  /// The motion, if it is one of this type, else nullptr. Its own times are those that it had.
  template <typename Motion>
  [[nodiscard]] const Motion* motion() const noexcept {
    return curve_.template target<Motion>();
  }

  MissionPhase phase;
  /// Half-spaces in which the CoM stays during this motion, see ReferencePoint. Those that are set
  /// replace those of the curve.
  std::array<HalfSpace, 4> inside;

 private:
  Curve curve_;
  double from_;  // the curve's own time at the start [s]
};

/// Reference that consists of segments. Position, velocity and rotation are continuous where two
/// segments meet; the sign of the quaternion may change there.
class Mission {
 public:
  /// Places the segments one after another, starting at `start_time` [s]. Replaces their own start
  /// times. Throws std::invalid_argument if there is no segment, or with the name of one that does
  /// not start where the segment before it ends and with its velocity (1e-6 m, 1e-6 m/s, 1e-6 rad).
  explicit Mission(std::vector<MissionSegment> segments, double start_time = 0.0)
      : segments_(std::move(segments)) {
    require(!segments_.empty(), "Mission.segments.size()", segments_.size(), ">= 1");
    double time = start_time;
    for (std::size_t i = 0; i < segments_.size(); ++i) {
      segments_[i].set_start_time(time);
      if (i > 0) require_join(i, segments_[i - 1](time), segments_[i](time));
      time = segments_[i].end_time();
    }
  }

  /// Returns the reference at `time` [s], for every time, see Timing. Does not throw, and allocates
  /// only if a curve of the user does.
  [[nodiscard]] ReferencePoint operator()(double time) const noexcept {
    return segment_at(time)(time);
  }

  /// Returns the phase at `time` [s]: the first one before the start, the last one after the end.
  [[nodiscard]] MissionPhase phase(double time) const noexcept { return segment_at(time).phase; }

  [[nodiscard]] double start_time() const noexcept { return segments_.front().start_time(); }
  [[nodiscard]] double end_time() const noexcept { return segments_.back().end_time(); }
  [[nodiscard]] double duration() const noexcept { return end_time() - start_time(); }

  /// Segments in the order of time.
  [[nodiscard]] const std::vector<MissionSegment>& segments() const noexcept { return segments_; }

 private:
  [[nodiscard]] const MissionSegment& segment_at(double time) const noexcept {
    std::size_t i = 0;
    while (i + 1 < segments_.size() && time >= segments_[i].end_time()) ++i;
    return segments_[i];
  }

  void require_join(std::size_t i, const ReferencePoint& end, const ReferencePoint& begin) const {
    const std::string name =
        "Mission.segments[" + std::to_string(i) + "] (" + to_string(segments_[i].phase) + ")";
    const double gap = (begin.position - end.position).norm();
    require(gap <= 1e-6, name + " distance from the end of the segment before it [m]", gap,
            "<= 1e-6");
    const double jump = (begin.velocity - end.velocity).norm();
    require(jump <= 1e-6, name + " change of velocity from the segment before it [m/s]", jump,
            "<= 1e-6");
    const Eigen::Quaterniond turn = end.orientation.conjugate() * begin.orientation;
    const double angle = quaternion_log(turn).norm();
    require(angle <= 1e-6, name + " turn from the end of the segment before it [rad]", angle,
            "<= 1e-6");
  }

  std::vector<MissionSegment> segments_;
};

/// Settings of the paper's mission: eights in the air and on the ground, and a second flight.
struct HybridMissionSettings {
  Eigen::Vector2d origin = Eigen::Vector2d::Zero();  ///< start and crossing of the eights [m]
  double yaw = 0.0;                                  ///< yaw at the start and in the air [rad]
  double direction = 0.0;      ///< angle of the eights' long axis about world z [rad]
  double flight_height = 1.5;  ///< height of the CoM in hover [m]
  double rest_time = 1.0;      ///< duration of each rest on the ground [s]
  double hover_time = 2.0;     ///< duration of each hover [s]
  Eigen::Vector3d air_amplitude{1.5, 0.5, 0.5};  ///< see FigureEightSettings (estimate) [m]
  Eigen::Vector2d ground_amplitude{2.0, 0.6};    ///< same on the ground, level (estimate) [m]
  int laps = 2;                                  ///< number of laps of each eight
  double max_speed = 1.5;         ///< limit in both eights (paper, Sec. Aerial Flight) [m/s]
  double max_acceleration = 1.5;  ///< limit in both eights (paper, Sec. Aerial Flight) [m/s^2]
  double max_yaw_rate = 1.5;      ///< limit on the ground and in the turn before landing [rad/s]
  double start_time = 0.0;        ///< time at which the mission starts [s]
};

/// FigureEight checks the shape of the eights, hybrid_mission() the height of the one in the air.
inline void validate(const HybridMissionSettings& p) {
  require_finite("HybridMissionSettings.origin [m]", p.origin);
  require_finite("HybridMissionSettings.yaw [rad]", p.yaw);
  require_finite("HybridMissionSettings.direction [rad]", p.direction);
  require_finite("HybridMissionSettings.flight_height [m]", p.flight_height);
  require_in("HybridMissionSettings.rest_time [s]", p.rest_time, 1e-3, 1e10);
  require_in("HybridMissionSettings.hover_time [s]", p.hover_time, 1e-3, 1e10);
  require(p.laps >= 1, "HybridMissionSettings.laps", p.laps, ">= 1");
  require_positive("HybridMissionSettings.max_speed [m/s]", p.max_speed);
  require_positive("HybridMissionSettings.max_acceleration [m/s^2]", p.max_acceleration);
  require_positive("HybridMissionSettings.max_yaw_rate [rad/s]", p.max_yaw_rate);
  require_time("HybridMissionSettings.start_time [s]", p.start_time);
}

namespace detail {

[[nodiscard]] inline FigureEightSettings air_eight(const HybridMissionSettings& p) {
  FigureEightSettings air;
  air.center << p.origin, p.flight_height;
  air.amplitude = p.air_amplitude;
  air.direction = p.direction;
  air.laps = p.laps;
  air.max_speed = p.max_speed;
  air.max_acceleration = p.max_acceleration;
  air.yaw = p.yaw;
  return air;
}

// The CoM is `standing` [m] above the ground at height zero.
[[nodiscard]] inline FigureEightSettings ground_eight(const HybridMissionSettings& p,
                                                      double standing) {
  FigureEightSettings ground = air_eight(p);
  ground.center.z() = standing;
  ground.amplitude << p.ground_amplitude, 0.0;
  ground.heading = HeadingMode::along_velocity;
  ground.max_yaw_rate = p.max_yaw_rate;
  return ground;
}

}  // namespace detail

/// Returns the part of the paper's mission that a vehicle can do. `undercarriage` is the result of
/// undercarriage(vehicle).
/// - Vehicle that rolls: rest, take-off, hover, an eight in the air, a turn into the ground eight's
///   direction, hover, landing, rest, the eight on the ground with the heading along it, rest,
///   take-off, hover, landing, rest. A vehicle that cannot turn on the spot drives straight ahead
///   by ground_amplitude.x and back instead of the eight on the ground.
/// - Vehicle that only stands: rest, take-off, hover, the eight in the air, hover, landing, rest.
/// - Vehicle without an undercarriage: hover, the eight in the air, hover.
/// Take-offs and landings have the limits that take_off() and landing() have by default. The ground
/// is at height zero. Throws std::invalid_argument if the settings are invalid.
[[nodiscard]] inline Mission hybrid_mission(const std::optional<Undercarriage>& undercarriage,
                                            const HybridMissionSettings& p = {}) {
  validate(p);
  const FigureEightSettings air = detail::air_eight(p);
  const Waypoint above_start{air.center, p.yaw};
  const Hold hover_at_start(above_start, p.hover_time);
  if (!undercarriage)
    return Mission({{MissionPhase::hover, hover_at_start},
                    {MissionPhase::air, FigureEight(air)},
                    {MissionPhase::hover, hover_at_start}},
                   p.start_time);

  validate(*undercarriage);
  const double standing = undercarriage->height;
  require(p.flight_height > standing, "HybridMissionSettings.flight_height [m]", p.flight_height,
          "more than Undercarriage.height, " + std::to_string(standing));
  require(std::abs(p.air_amplitude.z()) < p.flight_height - standing,
          "HybridMissionSettings.air_amplitude.z [m]", p.air_amplitude.z(),
          "less than flight_height - Undercarriage.height to either side");
  const Waypoint start{{p.origin.x(), p.origin.y(), standing}, p.yaw};
  const Hold rest_at_start(start, p.rest_time);
  if (!undercarriage->rolls)
    return Mission({{MissionPhase::rest, rest_at_start},
                    {MissionPhase::take_off, take_off(start, p.flight_height)},
                    {MissionPhase::hover, hover_at_start},
                    {MissionPhase::air, FigureEight(air)},
                    {MissionPhase::hover, hover_at_start},
                    {MissionPhase::landing, landing(above_start, standing)},
                    {MissionPhase::rest, rest_at_start}},
                   p.start_time);

  const FigureEightSettings ground = detail::ground_eight(p, standing);
  const FigureEight ground_eight(ground);

  // Places after the turn: on the ground and above it.
  const double ground_yaw = yaw_of(ground_eight(ground_eight.start_time()).orientation);
  const Waypoint turned{ground.center, ground_yaw}, above_turned{air.center, ground_yaw};
  TransitionSettings turn;
  turn.from = above_start;
  turn.to = above_turned;
  turn.max_yaw_rate = p.max_yaw_rate;

  const Hold rest(turned, p.rest_time), hover(above_turned, p.hover_time);
  std::vector<MissionSegment> segments = {
      {MissionPhase::rest, rest_at_start},
      {MissionPhase::take_off, take_off(start, p.flight_height)},
      {MissionPhase::hover, hover_at_start},
      {MissionPhase::air, FigureEight(air)},
      {MissionPhase::hover, Transition(turn)},
      {MissionPhase::hover, hover},
      {MissionPhase::landing, landing(above_turned, standing)},
      {MissionPhase::rest, rest}};
  if (undercarriage->turns) {
    segments.push_back({MissionPhase::ground, ground_eight});
  } else {
    TransitionSettings straight;
    straight.max_speed = p.max_speed;
    straight.max_acceleration = p.max_acceleration;
    straight.from = straight.to = turned;
    straight.to.position.head<2>() +=
        p.ground_amplitude.x() * Eigen::Vector2d(std::cos(ground_yaw), std::sin(ground_yaw));
    segments.push_back({MissionPhase::ground, Transition(straight)});
    std::swap(straight.from, straight.to);
    segments.push_back({MissionPhase::ground, Transition(straight)});
  }
  segments.push_back({MissionPhase::rest, rest});
  segments.push_back({MissionPhase::take_off, take_off(turned, p.flight_height)});
  segments.push_back({MissionPhase::hover, hover});
  segments.push_back({MissionPhase::landing, landing(above_turned, standing)});
  segments.push_back({MissionPhase::rest, rest});
  return Mission(std::move(segments), p.start_time);
}
template <int Rotors>
[[nodiscard]] Mission hybrid_mission(const Vehicle<Rotors>& vehicle,
                                     const HybridMissionSettings& p = {}) {
  return hybrid_mission(undercarriage(vehicle), p);
}

}  // namespace tilt_ropter
