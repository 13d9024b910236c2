#include <tilt_ropter/planning/experiments.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <stdexcept>
#include <vector>

namespace tilt_ropter {
namespace {

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

TEST(Experiments, RefuseWhatCannotDriveAndInvalidLengths) {
  const Undercarriage legs{0.11, false, false, false}, four_wheels{0.11, true, false, false};
  for (const Undercarriage& other : {legs, four_wheels}) {
    EXPECT_THROW((void)ground_experiment(other), std::invalid_argument);
    EXPECT_THROW((void)hybrid_experiment(other), std::invalid_argument);
  }
  for (double HybridExperimentSettings::*length :
       {&HybridExperimentSettings::descent_length, &HybridExperimentSettings::climb_length,
        &HybridExperimentSettings::roll_length}) {
    HybridExperimentSettings lengths;
    lengths.*length = 0.0;
    EXPECT_THROW((void)hybrid_experiment(wheels, {}, lengths), std::invalid_argument);
  }
  HybridMissionSettings bad;
  bad.max_speed = -1.0;
  EXPECT_THROW((void)aerial_experiment(bad), std::invalid_argument);
}

}  // namespace
}  // namespace tilt_ropter
