#include <tilt_ropter/planning/mission.hpp>

#include "../../examples/support/hybrid_experiment.hpp"
#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <string>
#include <vector>

namespace tilt_ropter {
namespace experiments_test {

using examples::aerial_experiment;
using examples::excitation_experiment;
using examples::ground_experiment;
using examples::hybrid_experiment;
using examples::HybridExperimentSettings;
using Phase = MissionPhase;

const Undercarriage wheels = *undercarriage(tilt_ropter_vehicle());

std::vector<Phase> phases_of(const Mission& mission) {
  std::vector<Phase> all;
  for (const MissionSegment& segment : mission.segments())
    if (all.empty() || all.back() != segment.phase) all.push_back(segment.phase);
  return all;
}

TEST(Experiments, AerialAndGroundAreThePartsOfTheHybridMission) {
  HybridMissionSettings p;
  p.start_time = 3.0;
  const Mission air = aerial_experiment(p), ground = ground_experiment(wheels, p);
  EXPECT_EQ(phases_of(air), (std::vector<Phase>{Phase::hover, Phase::air, Phase::hover}));
  EXPECT_EQ(phases_of(ground), (std::vector<Phase>{Phase::rest, Phase::ground, Phase::rest}));
  EXPECT_EQ(air.start_time(), 3.0);
  EXPECT_EQ(ground.start_time(), 3.0);
  for (double t = 3.0; t < ground.end_time(); t += 0.1)
    EXPECT_DOUBLE_EQ(ground(t).position.z(), wheels.height);
}

TEST(Experiments, HybridMovesAllTheTimeWithinItsLimits) {
  for (const double speed : {1.0, 1.5, 2.0}) {
    HybridMissionSettings p;
    p.max_speed = speed;
    p.max_acceleration = speed * speed / 1.5;
    p.max_yaw_rate = 2.0;
    const Mission mission = hybrid_experiment(wheels, p);
    EXPECT_EQ(phases_of(mission),
              (std::vector<Phase>{Phase::hover, Phase::air, Phase::landing, Phase::ground,
                                  Phase::take_off, Phase::hover}));
    const std::vector<MissionSegment>& segments = mission.segments();
    const double moves_from = segments[2].start_time(), moves_until = segments[5].end_time();
    double before = mission(moves_from).position.z();
    for (double t = moves_from; t < moves_until; t += 0.01) {
      const ReferencePoint point = mission(t);
      const double along = (point.orientation.conjugate() * point.velocity).x();
      EXPECT_GT(along, 0.3) << t;  // never stops, and the heading is that of the path
      EXPECT_LT((point.orientation.conjugate() * point.velocity).y(), 1e-6);
      EXPECT_GE(point.position.z(), wheels.height - 1e-9);
      EXPECT_LE(point.velocity.norm(), 1.101 * speed);
      EXPECT_LE(point.acceleration.norm(), 1.01 * p.max_acceleration);
      EXPECT_LE(std::abs(point.angular_velocity.z()), 1.01 * p.max_yaw_rate);
      if (mission.phase(t) == Phase::ground) {
        EXPECT_NEAR(point.position.z(), wheels.height, 1e-9);
      }
      EXPECT_LT(std::abs(point.position.z() - before), 0.012 * 1.101 * speed);
      before = point.position.z();
    }
  }
}

TEST(Experiments, ExcitationHoversBeforeAndAfter) {
  const Mission mission = excitation_experiment();
  EXPECT_EQ(mission.phase(0.0), Phase::hover);
  EXPECT_EQ(mission.phase(0.5 * mission.duration()), Phase::air);
  EXPECT_EQ(mission.phase(mission.end_time()), Phase::hover);
  EXPECT_LT(mission.duration(), 45.0);
}

TEST(Experiments, CheckMissionUndercarriageAndLengths) {
  using namespace test_support;
  HybridMissionSettings no_lap;
  no_lap.laps = 0;
  const std::string laps = "HybridMissionSettings.laps";
  expect_refused(laps, [&] { (void)hybrid_mission(wheels, no_lap); });
  expect_refused(laps, [&] { (void)excitation_experiment(no_lap); });
  expect_refused(laps, [&] { (void)aerial_experiment(no_lap); });
  expect_refused(laps, [&] { (void)ground_experiment(wheels, no_lap); });
  expect_refused(laps, [&] { (void)hybrid_experiment(wheels, no_lap); });
  const Undercarriage slides{0.1, false, true, true}, straight{0.1, true, false, true};
  for (const auto& drive : {+[](const Undercarriage& u) { (void)ground_experiment(u); },
                            +[](const Undercarriage& u) { (void)hybrid_experiment(u); }}) {
    expect_accepted([&] { drive(wheels); });
    expect_refused(
        "Undercarriage", [&] { drive(slides); }, "one that does not roll: must be");
    expect_refused(
        "Undercarriage", [&] { drive(straight); }, "one that does not turn: must be");
    expect_refused("Undercarriage.height [m]", [&] { drive({-0.1, true, true, true}); });
  }
  const auto check_length = [&](const char* name, double HybridExperimentSettings::*length) {
    expect_range(name, {{}, {0.0, -1.0, not_a_number, infinite}}, true, [&](double value) {
      HybridExperimentSettings lengths;
      lengths.*length = value;
      (void)hybrid_experiment(wheels, {}, lengths);
    });
  };
  check_length("HybridExperimentSettings.descent_length [m]",
               &HybridExperimentSettings::descent_length);
  check_length("HybridExperimentSettings.climb_length [m]",
               &HybridExperimentSettings::climb_length);
  check_length("HybridExperimentSettings.roll_length [m]", &HybridExperimentSettings::roll_length);
}

}  // namespace experiments_test
}  // namespace tilt_ropter
