#include <tilt_ropter/planning/mission.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

namespace mission_test {

using namespace tilt_ropter;

template <typename Function>
std::string message_of(const Function& build) {
  try {
    static_cast<void>(build());
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return "accepted";
}

/// Settings that all differ from their defaults.
HybridMissionSettings other_parameters() {
  HybridMissionSettings p;
  p.origin << 3.0, -4.0;
  p.yaw = 2.5;
  p.direction = -1.2;
  p.flight_height = 2.0;
  p.rest_time = 0.5;
  p.hover_time = 1.0;
  p.air_amplitude << 2.0, 1.0, -0.6;
  p.ground_amplitude << 1.0, 0.5;
  p.laps = 1;
  p.max_speed = 1.0;
  p.max_acceleration = 1.2;
  p.max_yaw_rate = 0.9;
  p.start_time = 100.0;
  return p;
}

const Waypoint here{{0.0, 0.0, 1.0}, 0.0};
const std::optional<Undercarriage> rolling = undercarriage(tilt_ropter_vehicle());

TEST(HybridMission, PhasesFollowUndercarriage) {
  using Phase = MissionPhase;
  const auto phases = [](const std::optional<Undercarriage>& undercarriage) {
    std::vector<Phase> all;
    const Mission mission = hybrid_mission(undercarriage);
    for (const MissionSegment& segment : mission.segments()) all.push_back(segment.phase);
    return all;
  };
  EXPECT_EQ(phases(std::nullopt), (std::vector<Phase>{Phase::hover, Phase::air, Phase::hover}));
  EXPECT_EQ(phases(Undercarriage{0.2, false, false, false}),
            (std::vector<Phase>{Phase::rest, Phase::take_off, Phase::hover, Phase::air,
                                Phase::hover, Phase::landing, Phase::rest}));
  EXPECT_EQ(phases(Undercarriage{0.2, true, true, false}), phases(rolling));
  std::vector<Phase> straight = phases(rolling);
  straight.insert(std::find(straight.begin(), straight.end(), Phase::ground), Phase::ground);
  EXPECT_EQ(phases(Undercarriage{0.2, true, false, false}), straight);
  const Mission on_legs = hybrid_mission(Undercarriage{0.2, false, false, false});
  EXPECT_NEAR(on_legs(0.0).position.z(), 0.2, 1e-12);
  EXPECT_NEAR(on_legs(on_legs.end_time()).position.z(), 0.2, 1e-12);
}

TEST(HybridMission, RunsThroughItsPhasesInOrder) {
  using Phase = MissionPhase;
  const std::vector<Phase> expected{Phase::rest,  Phase::take_off, Phase::hover, Phase::air,
                                    Phase::hover, Phase::landing,  Phase::rest,  Phase::ground,
                                    Phase::rest,  Phase::take_off, Phase::hover, Phase::landing,
                                    Phase::rest};
  for (const HybridMissionSettings& p : {HybridMissionSettings{}, other_parameters()}) {
    const Mission mission = hybrid_mission(rolling, p);
    std::vector<Phase> phases;
    for (double time = mission.start_time() - 1.0; time < mission.end_time() + 1.0; time += 0.01)
      if (phases.empty() || phases.back() != mission.phase(time))
        phases.push_back(mission.phase(time));
    EXPECT_EQ(phases, expected);
  }
}

// A circle of one metre, at its own times 5 to 7.
ReferencePoint circle(double time) {
  const double angle = 0.3 * (time - 5.0) * (time - 5.0) * (7.0 - time);
  ReferencePoint point;
  point.position << std::sin(angle), 1.0 - std::cos(angle), 1.0 + time;
  return point;
}

TEST(Mission, AnyCallableIsASegment) {
  const Waypoint low{{0.0, 0.0, 6.0}, 0.0}, high{{0.0, 0.0, 8.0}, 0.0};
  const Mission mission({{MissionPhase::hover, Hold(low, 1.5)},
                         {MissionPhase::air, circle, 5.0, 7.0},
                         {MissionPhase::hover, Hold(high, 1.0)}},
                        10.0);
  EXPECT_DOUBLE_EQ(mission.end_time(), 14.5);
  EXPECT_EQ(mission.phase(12.0), MissionPhase::air);
  for (const double since : {0.0, 0.4, 1.1, 1.9})
    EXPECT_LT((mission(11.5 + since).position - circle(5.0 + since).position).norm(), 1e-12);
  EXPECT_EQ(mission(std::nan("")).position, low.position);
  EXPECT_EQ(mission(1e9).position, high.position);
  // Alone, a segment stays where its curve ends.
  const MissionSegment& air = mission.segments()[1];
  EXPECT_EQ(air(0.0).position, circle(5.0).position);
  EXPECT_LT((air(99.0).position - circle(7.0).position).norm(), 1e-12);
  EXPECT_EQ(air.motion<Hold>(), nullptr);
  EXPECT_NE(mission.segments()[0].motion<Hold>(), nullptr);
  EXPECT_THROW(MissionSegment(MissionPhase::air, circle, 7.0, 5.0), std::invalid_argument);
  EXPECT_THROW(MissionSegment(MissionPhase::air, MissionSegment::Curve(), 0.0, 1.0),
               std::invalid_argument);
}

TEST(HybridMission, LastsAboutAMinute) {
  const Mission mission = hybrid_mission(rolling);
  EXPECT_GT(mission.duration(), 60.0);
  EXPECT_LT(mission.duration(), 80.0);
}

TEST(HybridMission, SegmentsAreContiguousInTime) {
  const Mission mission = hybrid_mission(rolling, other_parameters());
  double time = 100.0;
  EXPECT_DOUBLE_EQ(mission.start_time(), time);
  for (const MissionSegment& segment : mission.segments()) {
    EXPECT_DOUBLE_EQ(segment.start_time(), time);
    EXPECT_GT(segment.end_time(), segment.start_time());
    EXPECT_EQ(mission.phase(0.5 * (segment.start_time() + segment.end_time())), segment.phase);
    EXPECT_EQ(mission.phase(segment.start_time()), segment.phase);
    time = segment.end_time();
  }
  EXPECT_DOUBLE_EQ(mission.end_time(), time);
  EXPECT_DOUBLE_EQ(mission.duration(), time - 100.0);
}

TEST(HybridMission, RatesAreDerivativesAndSmoothAcrossEveryJoin) {
  const double h = 1e-4;
  for (const HybridMissionSettings& p : {HybridMissionSettings{}, other_parameters()}) {
    const Mission mission = hybrid_mission(rolling, p);
    std::vector<double> times;
    for (double time = mission.start_time() - 1.0; time < mission.end_time() + 1.0; time += 0.0173)
      times.push_back(time);
    for (const MissionSegment& segment : mission.segments())
      for (const double shift : {-h, -0.5 * h, 0.0, 0.5 * h, h})
        times.push_back(segment.end_time() + shift);
    for (const double time : times) {
      const ReferencePoint r = mission(time), before = mission(time - h), after = mission(time + h);
      const Eigen::Vector3d velocity = (after.position - before.position) / (2 * h);
      const Eigen::Vector3d acceleration = (after.velocity - before.velocity) / (2 * h);
      const Eigen::Quaterniond turn = before.orientation.conjugate() * after.orientation;
      const Eigen::Vector3d angular_velocity = quaternion_log(turn) / (2 * h);
      const Eigen::Vector3d angular_acceleration =
          (after.angular_velocity - before.angular_velocity) / (2 * h);
      ASSERT_LT((r.velocity - velocity).norm(), 1e-6) << time;
      ASSERT_LT((r.acceleration - acceleration).norm(), 1e-6) << time;
      ASSERT_LT((r.angular_velocity - angular_velocity).norm(), 1e-6) << time;
      ASSERT_LT((r.angular_acceleration - angular_acceleration).norm(), 1e-5) << time;
      ASSERT_LT((after.acceleration - before.acceleration).norm(), 20.0 * h) << time;
      ASSERT_LT((after.angular_acceleration - before.angular_acceleration).norm(), 100.0 * h);
    }
  }
}

TEST(HybridMission, KeepsEveryLimitAndHeight) {
  for (const HybridMissionSettings& p : {HybridMissionSettings{}, other_parameters()}) {
    const Mission mission = hybrid_mission(rolling, p);
    double air_speed = 0.0, ground_speed = 0.0, climb = 0.0, descent = 0.0, ceiling = 0.0;
    for (double time = mission.start_time(); time < mission.end_time(); time += 0.001) {
      const ReferencePoint r = mission(time);
      ASSERT_LE(r.velocity.norm(), p.max_speed);
      ASSERT_LE(r.acceleration.norm(), p.max_acceleration);
      ASSERT_LE(std::abs(r.angular_velocity.z()), p.max_yaw_rate * (1.0 + 1e-9));
      ASSERT_GE(r.position.z(), rolling->height - 1e-12);
      ceiling = std::max(ceiling, r.position.z());
      switch (mission.phase(time)) {
        case MissionPhase::rest:
          ASSERT_NEAR(r.position.z(), rolling->height, 1e-12);
          ASSERT_EQ(r.velocity.norm(), 0.0);
          break;
        case MissionPhase::take_off:
          climb = std::max(climb, r.velocity.z());
          ASSERT_LE(r.acceleration.norm(), 1.0 + 1e-9);
          break;
        case MissionPhase::hover:
          ASSERT_LE(std::abs(r.angular_acceleration.z()), 1.5 * (1.0 + 1e-9));
          ASSERT_LT(
              (r.position - Eigen::Vector3d(p.origin.x(), p.origin.y(), p.flight_height)).norm(),
              1e-9);
          break;
        case MissionPhase::air:
          air_speed = std::max(air_speed, r.velocity.norm());
          ASSERT_LT(r.orientation.angularDistance(quaternion_from_yaw(p.yaw)), 1e-7);
          break;
        case MissionPhase::landing:
          descent = std::max(descent, -r.velocity.z());
          ASSERT_LE(r.acceleration.norm(), 0.5 * (1.0 + 1e-9));
          break;
        case MissionPhase::ground:
          ground_speed = std::max(ground_speed, r.velocity.norm());
          ASSERT_NEAR(r.position.z(), rolling->height, 1e-12);
          ASSERT_LT(std::abs((r.orientation.conjugate() * r.velocity).y()), 1e-9);
          break;
      }
    }
    EXPECT_NEAR(ceiling, p.flight_height + std::abs(p.air_amplitude.z()), 1e-6);
    EXPECT_LE(climb, 0.8 * (1.0 + 1e-9));
    EXPECT_LE(descent, 0.5 * (1.0 + 1e-9));
    EXPECT_GT(air_speed, 0.7 * p.max_speed);
    EXPECT_GT(ground_speed, 0.4 * p.max_speed);
  }
}

TEST(HybridMission, DefaultsFlyAndDriveAtSpeedOfPaper) {
  const Mission mission = hybrid_mission(rolling);
  double speed[2] = {0.0, 0.0}, acceleration[2] = {0.0, 0.0};
  for (double time = 0.0; time < mission.end_time(); time += 0.001) {
    const MissionPhase phase = mission.phase(time);
    if (phase != MissionPhase::air && phase != MissionPhase::ground) continue;
    const int i = phase == MissionPhase::air ? 0 : 1;
    speed[i] = std::max(speed[i], mission(time).velocity.norm());
    acceleration[i] = std::max(acceleration[i], mission(time).acceleration.norm());
  }
  for (const int i : {0, 1}) {
    EXPECT_NEAR(speed[i], 1.5, 0.015);
    EXPECT_GT(acceleration[i], i == 0 ? 1.485 : 1.1);
  }
}

TEST(HybridMission, EverySettingActs) {
  // Each setting, changed alone, must change the mission.
  const auto changed = [](const auto& change) {
    HybridMissionSettings p;
    change(p);
    const Mission a = hybrid_mission(rolling), b = hybrid_mission(rolling, p);
    double most = std::abs(a.end_time() - b.end_time());
    for (double time = 0.0; time < a.end_time(); time += 0.1)
      most = std::max({most, (a(time).position - b(time).position).norm(),
                       a(time).orientation.angularDistance(b(time).orientation)});
    return most;
  };
  using P = HybridMissionSettings;
  EXPECT_GT(changed([](P& p) { p.origin.y() = 1.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.yaw = 1.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.direction = 1.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.flight_height = 2.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.rest_time = 2.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.hover_time = 3.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.air_amplitude.z() = 0.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.ground_amplitude.x() = 2.5; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.laps = 1; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.max_speed = 1.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.max_acceleration = 1.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.max_yaw_rate = 1.0; }), 0.1);
  EXPECT_GT(changed([](P& p) { p.start_time = 1.0; }), 0.1);
  EXPECT_LT(changed([](P&) {}), 1e-12);
}

TEST(Mission, IsAtRestBeforeItsStartAndAfterItsEnd) {
  const double infinity = std::numeric_limits<double>::infinity();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  TransitionSettings p;
  p.from = here;
  p.to.position << 1.0, 0.0, 2.0;
  const Mission mission(
      {{MissionPhase::hover, Transition(p)}, {MissionPhase::landing, landing(p.to, 0.5)}}, 10.0);
  for (const double time : {9.0, -infinity, nan}) {
    EXPECT_LT((mission(time).position - here.position).norm(), 1e-12);
    EXPECT_EQ(mission(time).velocity.norm(), 0.0);
    EXPECT_EQ(mission.phase(time), MissionPhase::hover);
  }
  for (const double time : {mission.end_time() + 1.0, infinity}) {
    EXPECT_LT((mission(time).position - Eigen::Vector3d(1.0, 0.0, 0.5)).norm(), 1e-12);
    EXPECT_EQ(mission(time).velocity.norm(), 0.0);
    EXPECT_EQ(mission.phase(time), MissionPhase::landing);
  }
}

TEST(Mission, RejectsDiscontinuousSegmentsByName) {
  const auto mission_to = [](const Waypoint& next) {
    return message_of([&next] {
      return Mission({{MissionPhase::hover, Hold(here, 1.0)},
                      {MissionPhase::air, Hold(next, 1.0)},
                      {MissionPhase::hover, Hold(here, 1.0)}});
    });
  };
  EXPECT_EQ(mission_to({{0.0, 0.0, 1.00001}, 0.0}),
            "Mission.segments[1] (air) distance from the end of the segment before it "
            "[m] = 1e-05: must be <= 1e-6");
  EXPECT_EQ(mission_to({{0.0, 0.0, 1.0}, 0.5}),
            "Mission.segments[1] (air) turn from the end of the segment before it [rad] "
            "= 0.5: must be <= 1e-6");
  EXPECT_EQ(mission_to({{0.0, 0.0, 1.0 + 5e-7}, 5e-7}), "accepted");
  MinimumSnapSettings moving;
  moving.points = {here.position, {2.0, 0.0, 1.0}};
  moving.start_velocity.x() = 1.0;
  EXPECT_EQ(message_of([&] {
              return Mission({{MissionPhase::hover, Hold(here, 1.0)},
                              {MissionPhase::air, MinimumSnap(moving)}});
            }),
            "Mission.segments[1] (air) change of velocity from the segment before it [m/s] = 1: "
            "must be <= 1e-6");
  // A heading that differs by a whole turn is the same heading.
  EXPECT_EQ(mission_to({{0.0, 0.0, 1.0}, 2.0 * std::acos(-1.0)}), "accepted");
}

TEST(MissionPhase, HasAName) {
  EXPECT_STREQ(to_string(MissionPhase::rest), "rest");
  EXPECT_STREQ(to_string(MissionPhase::take_off), "take_off");
  EXPECT_STREQ(to_string(MissionPhase::hover), "hover");
  EXPECT_STREQ(to_string(MissionPhase::air), "air");
  EXPECT_STREQ(to_string(MissionPhase::landing), "landing");
  EXPECT_STREQ(to_string(MissionPhase::ground), "ground");
  EXPECT_STREQ(to_string(static_cast<MissionPhase>(99)), "unknown");
}

}  // namespace mission_test
