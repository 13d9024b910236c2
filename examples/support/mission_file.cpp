#include "mission_file.hpp"

#include "../../cmake/vehicle_file/tilt_ropter/json_fields.hpp"
#include "push_motion.hpp"
#include "trajectory_file.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/figure_eight.hpp>
#include <tilt_ropter/planning/minimum_snap.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <exception>
#include <filesystem>
#include <fstream>
#include <istream>
#include <utility>
#include <vector>

namespace examples {
namespace {

using namespace tilt_ropter;
using tilt_ropter::json_fields::Fields;
using tilt_ropter::json_fields::Json;
using tilt_ropter::json_fields::list_of;
using tilt_ropter::json_fields::Range;
using tilt_ropter::json_fields::refuse;
using tilt_ropter::json_fields::rounded;
using tilt_ropter::json_fields::shown;

constexpr double degree = pi / 180.0;
constexpr std::size_t most_segments = 200;

const Range metres{-1e3, 1e3, "m"}, seconds{1e-2, 1e4, "s"}, speeds{1e-2, 50.0, "m/s"},
    accelerations{1e-2, 100.0, "m/s^2"}, yaw_rates{1e-2, 20.0, "rad/s"},
    yaw_accelerations{1e-2, 200.0, "rad/s^2"}, degrees{-720.0, 720.0, "deg"};

const std::vector<std::string> types = {"rest",       "hover",        "take_off", "land",
                                        "turn",       "go_to",        "stop",     "way_points",
                                        "trajectory", "figure_eight", "push"};
const std::vector<std::string> phases = {"take_off", "hover", "air", "landing", "ground"};

MissionPhase phase_of(const std::string& name) {
  for (const MissionPhase phase :
       {MissionPhase::take_off, MissionPhase::hover, MissionPhase::air, MissionPhase::landing})
    if (name == to_string(phase)) return phase;
  return MissionPhase::ground;
}

/// End of a segment. Its speed is not known while the segment is read whose end speed is "next".
struct Place {
  ReferencePoint point;
  bool on_ground = false;
  bool speed_known = true;

  [[nodiscard]] double yaw() const { return yaw_of(point.orientation); }
  [[nodiscard]] bool moves() const { return !speed_known || point.velocity.norm() > 1e-6; }
  [[nodiscard]] Waypoint waypoint() const { return {point.position, yaw()}; }
};

/// Returns the heading of the path at the crossing of an eight, relative to its long axis.
double heading_at_crossing(const Eigen::Vector3d& amplitude) {
  return std::atan2(2.0 * amplitude.y(), amplitude.x());
}

/// Phase of a motion between two places.
MissionPhase phase_between(bool from_ground, bool to_ground) {
  if (from_ground) return to_ground ? MissionPhase::ground : MissionPhase::take_off;
  return to_ground ? MissionPhase::landing : MissionPhase::air;
}

/// Reads the segments one after another.
class Reader {
 public:
  Reader(const Json& list, const std::optional<Undercarriage>& undercarriage,
         std::filesystem::path directory)
      : list_(list), undercarriage_(undercarriage), directory_(std::move(directory)) {}

  std::vector<MissionSegment> read(std::optional<Place> place) const {
    std::vector<MissionSegment> segments;
    for (std::size_t i = 0; i < list_.size(); ++i) {
      for (MissionSegment& segment : build(i, place)) {
        check(i, segment);
        if (place) check_join(i, place->point, segment(segment.start_time()));
        place = after(segment);
        segments.push_back(std::move(segment));
      }
    }
    return segments;
  }

  /// A position of two numbers is on the ground.
  Eigen::Vector3d position(const std::vector<double>& numbers, const std::string& name) const {
    if (numbers.size() == 3) {
      const double least = undercarriage_ ? undercarriage_->height : -1e3;
      if (numbers[2] < least)
        refuse(name + "[2]", shown(numbers[2]),
               "at least the height of the CoM on the ground, " + shown(least) + " m");
      return {numbers[0], numbers[1], numbers[2]};
    }
    if (!undercarriage_)
      refuse(name, "two numbers", "three numbers, because the vehicle has no wheels or legs");
    return {numbers[0], numbers[1], undercarriage_->height};
  }

  bool on_ground(const Eigen::Vector3d& position) const {
    return undercarriage_ && position.z() <= undercarriage_->height + 1e-6;
  }

 private:
  static std::string path(std::size_t i) { return "segments[" + std::to_string(i) + ']'; }

  Place after(const MissionSegment& segment) const {
    Place place;
    place.point = segment(segment.end_time());
    place.on_ground = on_ground(place.point.position);
    return place;
  }

  /// Builds a segment and gives errors of the planner the name of the segment.
  std::vector<MissionSegment> build(std::size_t i, const std::optional<Place>& place) const {
    Fields fields(list_[i], path(i));
    const std::string type = fields.text("type", types);
    try {
      std::vector<MissionSegment> segments = build(i, type, fields, place);
      const auto inside = kept_off(fields);
      for (MissionSegment& segment : segments) segment.inside = inside;
      fields.refuse_unknown();
      return segments;
    } catch (const std::invalid_argument& error) {
      throw tilt_ropter::json_fields::Error(path(i) + " (" + type + "): " + error.what());
    }
  }

  /// Reads the surfaces that the CoM keeps off.
  static std::array<HalfSpace, 4> kept_off(Fields& fields) {
    std::array<HalfSpace, 4> inside;
    const Json* list = fields.find("keep_off");
    if (list == nullptr) return inside;
    const std::string name = fields.name("keep_off");
    if (!list->is_array() || list->size() > inside.size())
      refuse(name, shown(*list), "a list of up to 4 surfaces");
    for (std::size_t k = 0; k < list->size(); ++k) {
      Fields inner((*list)[k], name + '[' + std::to_string(k) + ']');
      Surface surface;
      surface.point = inner.vector("surface_point_m", metres);
      surface.normal = direction(inner);
      inside[k] = in_front_of(surface, inner.number("distance_m", {0.0, 1e3, "m"}));
      inner.refuse_unknown();
    }
    return inside;
  }

  /// Reads the outward normal of a surface.
  static Eigen::Vector3d direction(Fields& fields) {
    const Eigen::Vector3d normal = fields.vector("normal", {-1e3, 1e3, ""});
    if (!(normal.norm() > 1e-3)) refuse(fields.name("normal"), shown(0.0), "a direction");
    return normal.normalized();
  }

  std::vector<MissionSegment> build(std::size_t i, const std::string& type, Fields& fields,
                                    const std::optional<Place>& place) const {
    if (type == "trajectory") {
      const std::filesystem::path file = fields.text("file");
      try {
        return read_trajectory((directory_ / file).string(), undercarriage_).segments();
      } catch (const std::exception& error) {
        throw tilt_ropter::json_fields::Error(fields.name("file") + ": " + error.what());
      }
    }
    if (!place) throw tilt_ropter::json_fields::Error("start is missing: must be an object");
    const bool may_move = type == "stop" || type == "way_points" || type == "figure_eight";
    if (place->moves() && !may_move)
      refuse(path(i) + ".type", '"' + type + '"',
             "\"stop\", \"way_points\" or \"figure_eight\" after a segment that ends in motion");
    if (type == "rest" || type == "hover") return {hold(i, type, fields, *place)};
    if (type == "take_off" || type == "land") return {vertical(i, type, fields, *place)};
    if (type == "turn" || type == "go_to") return {go_to(i, type, fields, *place)};
    if (type == "stop") {
      if (!place->speed_known) refuse(path(i) + ".type", "\"stop\"", "after a known speed");
      ReferencePoint from = place->point;
      if (place->on_ground) {  // wheels give any acceleration across their direction
        const Eigen::Vector3d ahead = from.orientation * Eigen::Vector3d::UnitX();
        from.acceleration = ahead.dot(from.acceleration) * ahead;
      }
      const double limit = fields.number("max_acceleration_mps2", accelerations, 1.5);
      return {{place->on_ground ? MissionPhase::ground : MissionPhase::air, stop(from, limit)}};
    }
    if (type == "way_points") return {way_points(i, fields, *place)};
    if (type == "push") return {push(i, fields, *place)};
    return {figure_eight(i, fields, *place)};
  }

  MissionSegment hold(std::size_t i, const std::string& type, Fields& fields,
                      const Place& place) const {
    if ((type == "rest") != place.on_ground)
      refuse(path(i) + ".type", '"' + type + '"',
             place.on_ground ? "\"rest\" on the ground" : "\"hover\" in the air");
    return {type == "rest" ? MissionPhase::rest : MissionPhase::hover,
            Hold(place.waypoint(), fields.number("duration_s", seconds))};
  }

  MissionSegment vertical(std::size_t i, const std::string& type, Fields& fields,
                          const Place& place) const {
    const bool up = type == "take_off";
    if (up != place.on_ground || !undercarriage_)
      refuse(path(i) + ".type", '"' + type + '"',
             std::string("where the vehicle is ") +
                 (up ? "on the ground" : "in the air above a ground that carries it"));
    if (up) {
      const Range heights{undercarriage_->height + 0.01, 1e3, "m"};
      const double height = fields.number("height_m", heights);
      return {MissionPhase::take_off,
              take_off(place.waypoint(), height, fields.number("max_speed_mps", speeds, 0.8),
                       fields.number("max_acceleration_mps2", accelerations, 1.0))};
    }
    return {MissionPhase::landing,
            landing(place.waypoint(), undercarriage_->height,
                    fields.number("max_speed_mps", speeds, 0.5),
                    fields.number("max_acceleration_mps2", accelerations, 0.5))};
  }

  /// Reads a motion from rest to rest: "turn" on the spot, or "go_to".
  MissionSegment go_to(std::size_t i, const std::string& type, Fields& fields,
                       const Place& place) const {
    TransitionSettings s;
    s.from = s.to = place.waypoint();
    if (type == "go_to")
      s.to.position =
          position(fields.two_or_three("position_m", metres), fields.name("position_m"));
    if (fields.find("yaw_deg") != nullptr) {
      s.to.yaw = fields.number("yaw_deg", degrees) * degree;
    } else if (type == "turn") {  // into the heading in which the next segment starts
      if (i + 1 >= list_.size())
        throw tilt_ropter::json_fields::Error(fields.name("yaw_deg") +
                                              " is missing: must be a number " + degrees.text() +
                                              " in the last segment");
      s.to.yaw = yaw_of(start_of_next(i, place).orientation);
    }
    s.duration = fields.number("duration_s", seconds, 0.0);
    if (type == "go_to") {
      s.max_speed = fields.number("max_speed_mps", speeds, s.max_speed);
      s.max_acceleration =
          fields.number("max_acceleration_mps2", accelerations, s.max_acceleration);
    }
    s.max_yaw_rate = fields.number("max_yaw_rate_radps", yaw_rates, s.max_yaw_rate);
    s.max_yaw_acceleration =
        fields.number("max_yaw_acceleration_radps2", yaw_accelerations, s.max_yaw_acceleration);
    MissionPhase usual = phase_between(place.on_ground, on_ground(s.to.position));
    if (type == "turn" && usual == MissionPhase::air) usual = MissionPhase::hover;
    return {phase(fields, usual), Transition(s)};
  }

  MissionSegment way_points(std::size_t i, Fields& fields, const Place& place) const {
    if (!place.speed_known)
      refuse(path(i - 1) + ".end_velocity_mps", "\"next\"",
             "three numbers before a segment \"way_points\", which has no speed of its own");
    MinimumSnapSettings s;
    s.max_speed = fields.number("max_speed_mps", speeds, s.max_speed);
    s.max_acceleration = fields.number("max_acceleration_mps2", accelerations, s.max_acceleration);
    const std::string allowed = "a list of 1 to 99 positions";
    const Json& list = fields.get("points_m", allowed);
    const std::string name = fields.name("points_m");
    if (!list.is_array() || list.empty() || list.size() > 99) refuse(name, shown(list), allowed);
    s.points = {place.point.position};
    for (std::size_t k = 0; k < list.size(); ++k) {
      const std::string at = name + '[' + std::to_string(k) + ']';
      s.points.push_back(position(Fields::two_or_three(list[k], at, metres), at));
    }
    s.start_velocity = within(place.point.velocity, s.max_speed);
    s.start_acceleration = within(place.point.acceleration, s.max_acceleration);
    Place end;
    end.point = place.point;
    end.point.position = s.points.back();
    end.on_ground = on_ground(s.points.back());
    const Json* velocity = fields.find("end_velocity_mps");
    if (velocity != nullptr && velocity->is_string()) {
      fields.text("end_velocity_mps", {"next"});
      if (i + 1 >= list_.size())
        refuse(fields.name("end_velocity_mps"), "\"next\"", "three numbers in the last segment");
      end.speed_known = false;
      s.end_velocity = start_of_next(i, end).velocity;
    } else if (velocity != nullptr) {
      s.end_velocity = fields.vector("end_velocity_mps", {-50.0, 50.0, "m/s"});
    }
    fields.vector_if_there("end_acceleration_mps2", {-100.0, 100.0, "m/s^2"}, s.end_acceleration);
    const MissionPhase usual = phase_between(place.on_ground, end.on_ground);
    s.heading = heading(
        fields, usual == MissionPhase::air ? HeadingMode::fixed : HeadingMode::along_velocity);
    s.yaw = place.yaw();
    s.max_yaw_rate = fields.number("max_yaw_rate_radps", yaw_rates, s.max_yaw_rate);
    s.duration = fields.number("duration_s", seconds, 0.0);
    return {phase(fields, usual), MinimumSnap(s)};
  }

  MissionSegment figure_eight(std::size_t i, Fields& fields, const Place& place) const {
    FigureEightSettings s;
    s.center = place.point.position;
    if (place.on_ground) s.amplitude << 2.0, 0.6, 0.0;
    if (fields.find("amplitude_m") != nullptr) {
      const std::vector<double> size = fields.two_or_three("amplitude_m", {-1e3, 1e3, "m"});
      s.amplitude << size[0], size[1], size.size() > 2 ? size[2] : 0.0;
    }
    if (fields.find("laps") != nullptr) s.laps = fields.integer("laps", 1, 1000);
    s.ramp_laps = fields.number("ramp_laps", {0.05, 1.0, ""}, s.ramp_laps);
    s.max_speed = fields.number("max_speed_mps", speeds, s.max_speed);
    s.max_acceleration = fields.number("max_acceleration_mps2", accelerations, s.max_acceleration);
    s.max_yaw_rate = fields.number("max_yaw_rate_radps", yaw_rates, s.max_yaw_rate);
    s.heading = heading(fields, place.on_ground ? HeadingMode::along_velocity : HeadingMode::fixed);
    s.yaw = place.yaw();
    s.starts_moving = place.moves();
    if (fields.find("starts_moving") != nullptr && fields.truth("starts_moving") != s.starts_moving)
      refuse(fields.name("starts_moving"), s.starts_moving ? "false" : "true",
             s.starts_moving ? "true after a segment that ends in motion"
                             : "false after a segment that ends at rest");
    if (fields.find("ends_moving") != nullptr) s.ends_moving = fields.truth("ends_moving");
    if (fields.find("direction_deg") != nullptr) {
      s.direction = fields.number("direction_deg", degrees) * degree;
    } else if (place.moves()) {  // starts in the direction of motion
      if (!place.speed_known)
        throw tilt_ropter::json_fields::Error(
            path(i) + ".direction_deg is missing: must be a number " + degrees.text() +
            " after an end_velocity_mps of \"next\"");
      const Eigen::Vector3d& v = place.point.velocity;
      s.direction = std::atan2(v.y(), v.x()) - heading_at_crossing(s.amplitude);
    } else if (s.heading == HeadingMode::along_velocity) {  // starts in the present heading
      s.direction = place.yaw() - heading_at_crossing(s.amplitude);
    }
    return {place.on_ground ? MissionPhase::ground : MissionPhase::air, FigureEight(s)};
  }

  static MissionSegment push(std::size_t i, Fields& fields, const Place& place) {
    if (place.on_ground) refuse(path(i) + ".type", "\"push\"", "where the vehicle is in the air");
    PushSettings s;
    s.from = place.waypoint();
    Surface& surface = s.push.surface;
    surface.point = fields.vector("surface_point_m", metres);
    surface.normal = direction(fields);
    surface.tool = fields.vector("tool_m", metres);
    surface.friction = fields.number("friction", {0.0, 2.0, ""}, surface.friction);
    s.push.force = fields.number("force_n", {0.1, 1e4, "N"});
    s.hold = fields.number("hold_s", seconds, s.hold);
    fields.vector_if_there("slide_m", metres, s.slide);
    s.speed = fields.number("speed_mps", speeds, s.speed);
    return {MissionPhase::air, PushMotion(s)};
  }

  /// Returns the start of the segment after segment i, if segment i ends at `place`.
  ReferencePoint start_of_next(std::size_t i, const Place& place) const {
    const std::vector<MissionSegment> next = build(i + 1, place);
    return next.front()(next.front().start_time());
  }

  /// Reduces a vector that exceeds `limit` by rounding errors only.
  static Eigen::Vector3d within(const Eigen::Vector3d& vector, double limit) {
    const double size = vector.norm();
    return size > limit && size < limit * (1.0 + 1e-7) ? (limit / size * (1.0 - 1e-9)) * vector
                                                       : vector;
  }

  static HeadingMode heading(Fields& fields, HeadingMode usual) {
    if (fields.find("heading") == nullptr) return usual;
    return fields.text("heading", {"fixed", "along_velocity"}) == "fixed"
               ? HeadingMode::fixed
               : HeadingMode::along_velocity;
  }

  static MissionPhase phase(Fields& fields, MissionPhase usual) {
    if (fields.find("phase") == nullptr) return usual;
    const MissionPhase named = phase_of(fields.text("phase", phases));
    const bool ground = usual == MissionPhase::ground;
    if ((named == MissionPhase::ground) != ground)
      refuse(fields.name("phase"), std::string("\"") + to_string(named) + '"',
             ground ? "\"ground\" on the ground" : "any other in the air");
    return named;
  }

  /// Rejects a segment that does not start where the mission starts or the segment before it ends.
  static void check_join(std::size_t i, const ReferencePoint& end, const ReferencePoint& begin) {
    const auto require_small = [&](const char* what, double value, const char* unit) {
      if (!(value <= 1e-6))
        refuse(path(i) + ": " + what + " from the end of the segment before it or the start",
               shown(value) + ' ' + unit, std::string("at most 1e-06 ") + unit);
    };
    require_small("distance", (begin.position - end.position).norm(), "m");
    require_small("change of velocity", (begin.velocity - end.velocity).norm(), "m/s");
    require_small("turn", quaternion_log(end.orientation.conjugate() * begin.orientation).norm(),
                  "rad");
  }

  /// Rejects motions below the ground, and on the ground those that the undercarriage prevents.
  void check(std::size_t i, const MissionSegment& segment) const {
    if (!undercarriage_) return;
    const auto wrong = [&](double value, const std::string& unit, const std::string& what,
                           const std::string& allowed) {
      refuse(path(i) + ": " + what, shown(value) + ' ' + unit, allowed);
    };
    const bool ground =
        segment.phase == MissionPhase::ground || segment.phase == MissionPhase::rest;
    constexpr int samples = 400;
    for (int k = 0; k <= samples; ++k) {
      const double begin = segment.start_time(), end = segment.end_time();
      const ReferencePoint p = segment(begin + (end - begin) * k / samples);
      const double height = p.position.z() - undercarriage_->height;
      if (height < -1e-3)
        wrong(p.position.z(), "m", "height of the CoM",
              "at least its height on the ground, " + shown(undercarriage_->height) + " m");
      if (!ground) continue;
      if (height > 1.1e-3)
        wrong(p.position.z(), "m", "height of the CoM",
              "its height on the ground, " + shown(undercarriage_->height) + " m");
      const Eigen::Vector3d v = p.orientation.conjugate() * p.velocity;
      if (std::abs(v.x()) > 1e-6 && !undercarriage_->rolls)
        wrong(v.x(), "m/s", "speed on the ground", "zero, because the vehicle does not roll");
      if (std::abs(v.y()) > 1e-4)
        wrong(v.y(), "m/s", "sideways speed on the ground",
              "zero: turn before, or heading \"along_velocity\"");
      if (std::abs(p.angular_velocity.z()) > 1e-6 && !undercarriage_->turns)
        wrong(p.angular_velocity.z(), "rad/s", "yaw rate on the ground",
              "zero, because the vehicle does not turn");
    }
  }

  const Json& list_;
  const std::optional<Undercarriage>& undercarriage_;
  std::filesystem::path directory_;
};

Mission read(const Json& root, const std::string& file,
             const std::optional<Undercarriage>& undercarriage) {
  Fields fields(root, "");
  (void)fields.text("name");
  const std::string allowed = "a list of 1 to " + std::to_string(most_segments) + " segments";
  const Json& list = fields.get("segments", allowed);
  if (!list.is_array() || list.empty() || list.size() > most_segments)
    refuse("segments", shown(list), allowed);
  const Reader reader(list, undercarriage, std::filesystem::path(file).parent_path());
  std::optional<Place> start;
  if (const Json* object = fields.find("start")) {
    Fields inner(*object, "start");
    start.emplace();
    start->point.position =
        reader.position(inner.two_or_three("position_m", metres), "start.position_m");
    start->point.orientation = quaternion_from_yaw(inner.number("yaw_deg", degrees, 0.0) * degree);
    start->on_ground = reader.on_ground(start->point.position);
    inner.refuse_unknown();
  }
  fields.refuse_unknown();
  return Mission(reader.read(start));
}

/// Writes the segments of a mission.
class Writer {
 public:
  explicit Writer(const std::optional<Undercarriage>& undercarriage)
      : undercarriage_(undercarriage) {}

  Json segment(const MissionSegment& s) const {
    const bool from = on_ground(s(s.start_time()).position),
               to = on_ground(s(s.end_time()).position);
    Json object;
    MissionPhase usual = phase_between(from, to);
    if (!writes<Hold, Transition, FigureEight, MinimumSnap, SampledPath, PushMotion>(object, s,
                                                                                     usual))
      throw MissionFileError(
          "--write-mission: a mission file has no type for the motion in phase " +
          std::string(to_string(s.phase)));
    const bool has_phase =
        object["type"] == "turn" || object["type"] == "go_to" || object["type"] == "way_points";
    if (has_phase && s.phase != usual) object["phase"] = to_string(s.phase);
    for (const HalfSpace& h : s.inside)
      if (!h.normal.isZero(0.0))
        object["keep_off"].push_back({{"surface_point_m", list_of(h.least * h.normal)},
                                      {"normal", list_of(h.normal)},
                                      {"distance_m", 0.0}});
    return object;
  }

  Json position(const Eigen::Vector3d& p) const {
    if (on_ground(p)) return {p.x(), p.y()};
    return {p.x(), p.y(), p.z()};
  }

 private:
  bool on_ground(const Eigen::Vector3d& p) const {
    return undercarriage_ && p.z() <= undercarriage_->height + 1e-6;
  }

  // Writes the motion if it is one of these types.
  template <typename... Motions>
  bool writes(Json& object, const MissionSegment& s, MissionPhase& usual) const {
    const auto try_it = [&](const auto* motion) {
      if (motion != nullptr) write(object, s.phase, *motion, usual);
      return motion != nullptr;
    };
    return (try_it(s.motion<Motions>()) || ...);
  }

  static void write(Json& object, MissionPhase phase, const Hold& hold, MissionPhase&) {
    object["type"] = phase == MissionPhase::rest ? "rest" : "hover";
    object["duration_s"] = rounded(hold.end_time() - hold.start_time());
  }

  void write(Json& object, MissionPhase phase, const Transition& motion,
             MissionPhase& usual) const {
    const TransitionSettings& s = motion.settings();
    const Eigen::Vector3d way = s.to.position - s.from.position;
    const bool turns = std::abs(s.to.yaw - s.from.yaw) > 0.0;
    const bool vertical = way.head<2>().isZero(0.0) && !turns && !(s.duration > 0.0);
    const bool up = vertical && phase == MissionPhase::take_off && phase == usual,
               down = vertical && phase == MissionPhase::landing && phase == usual,
               stays = way.isZero(0.0);
    object["type"] = up ? "take_off" : down ? "land" : stays ? "turn" : "go_to";
    if (up) object["height_m"] = s.to.position.z();
    if (!up && !down && !stays) object["position_m"] = position(s.to.position);
    if (!up && !down) object["yaw_deg"] = s.to.yaw / degree;
    if (s.duration > 0.0) object["duration_s"] = s.duration;
    if (!stays) {
      object["max_speed_mps"] = s.max_speed;
      object["max_acceleration_mps2"] = s.max_acceleration;
    }
    if (!up && !down) {
      object["max_yaw_rate_radps"] = s.max_yaw_rate;
      object["max_yaw_acceleration_radps2"] = s.max_yaw_acceleration;
    }
    if (stays && usual == MissionPhase::air) usual = MissionPhase::hover;
  }

  static void write(Json& object, MissionPhase, const FigureEight& eight, MissionPhase&) {
    const FigureEightSettings& s = eight.settings();
    object["type"] = "figure_eight";
    object["amplitude_m"] = list_of(s.amplitude);
    object["direction_deg"] = s.direction / degree;
    object["laps"] = s.laps;
    object["ramp_laps"] = s.ramp_laps;
    object["starts_moving"] = s.starts_moving;
    object["ends_moving"] = s.ends_moving;
    object["max_speed_mps"] = s.max_speed;
    object["max_acceleration_mps2"] = s.max_acceleration;
    write_heading(object, s.heading, s.max_yaw_rate);
  }

  void write(Json& object, MissionPhase, const MinimumSnap& path, MissionPhase&) const {
    const MinimumSnapSettings& s = path.settings();
    object["type"] = "way_points";
    for (std::size_t i = 1; i < s.points.size(); ++i)
      object["points_m"].push_back(position(s.points[i]));
    object["end_velocity_mps"] = {s.end_velocity.x(), s.end_velocity.y(), s.end_velocity.z()};
    if (!s.end_acceleration.isZero(0.0))
      object["end_acceleration_mps2"] = {s.end_acceleration.x(), s.end_acceleration.y(),
                                         s.end_acceleration.z()};
    if (s.duration > 0.0) object["duration_s"] = s.duration;
    object["max_speed_mps"] = s.max_speed;
    object["max_acceleration_mps2"] = s.max_acceleration;
    write_heading(object, s.heading, s.max_yaw_rate);
  }

  static void write(Json& object, MissionPhase, const SampledPath&, MissionPhase&) {
    object["type"] = "trajectory";
  }

  static void write(Json& object, MissionPhase, const PushMotion& motion, MissionPhase&) {
    const PushSettings& s = motion.settings();
    object["type"] = "push";
    object["surface_point_m"] = list_of(s.push.surface.point);
    object["normal"] = list_of(s.push.surface.normal);
    object["tool_m"] = list_of(s.push.surface.tool);
    object["friction"] = s.push.surface.friction;
    object["force_n"] = s.push.force;
    object["hold_s"] = s.hold;
    object["slide_m"] = list_of(s.slide);
    object["speed_mps"] = s.speed;
  }

  static void write_heading(Json& object, HeadingMode heading, double max_yaw_rate) {
    object["heading"] = heading == HeadingMode::fixed ? "fixed" : "along_velocity";
    if (heading == HeadingMode::along_velocity) object["max_yaw_rate_radps"] = max_yaw_rate;
  }

  const std::optional<Undercarriage>& undercarriage_;
};

}  // namespace

Mission read_mission(std::istream& in, const std::string& file,
                     const std::optional<Undercarriage>& undercarriage) {
  try {
    return read(tilt_ropter::json_fields::parse(in), file, undercarriage);
  } catch (const Json::exception& error) {
    throw MissionFileError(file + ": " + tilt_ropter::json_fields::message_of(error));
  } catch (const std::exception& error) {
    throw MissionFileError(file + ": " + error.what());
  }
}

Mission read_mission(const std::string& path, const std::optional<Undercarriage>& undercarriage) {
  std::ifstream in(path);
  if (!in) throw MissionFileError("cannot read " + path);
  return read_mission(in, path, undercarriage);
}

void write_mission(const Mission& mission, const std::optional<Undercarriage>& undercarriage,
                   const std::string& path, const std::string& trajectory) {
  const Writer writer(undercarriage);
  Json root;
  root["name"] = std::filesystem::path(path).stem().string();
  if (trajectory.empty()) {
    const ReferencePoint start = mission(mission.start_time());
    root["start"] = {{"position_m", writer.position(start.position)},
                     {"yaw_deg", yaw_of(start.orientation) / degree}};
    for (const MissionSegment& segment : mission.segments())
      root["segments"].push_back(writer.segment(segment));
  } else {
    root["segments"] = Json::array(
        {{{"type", "trajectory"}, {"file", std::filesystem::absolute(trajectory).string()}}});
  }
  std::ofstream out(path);
  out << tilt_ropter::json_fields::text_of(root) << '\n';
  if (!out.flush()) throw std::runtime_error("cannot write " + path);
}

}  // namespace examples
