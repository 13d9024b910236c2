// Each ablation of reproduce_paper is seen to act, in a short flight.
// CTest: flight long

#include "../../examples/paper/ablations.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <map>
#include <string>

namespace ablations_test {

using namespace examples;
using namespace examples::paper;

const MissionFigures& flown(const std::string& ablation, const std::string& mission) {
  static std::map<std::string, FlightResult> flights;
  FlightResult& result = flights[ablation + ' ' + mission];
  if (result.flown.duration > 0.0) return result.flown.figures;
  FlightCase flight;
  flight.options.no_log = true;
  flight.options.mission.name = mission;
  for (const Ablation& one : ablations())
    if (one.name == ablation) one.set(flight.options);
  result = fly_case(flight, "", [](double) {});
  EXPECT_EQ(result.error, "") << ablation;
  EXPECT_GT(result.flown.duration, 10.0);
  return result.flown.figures;
}

// The list and this test change together.
TEST(Ablations, EachOneActs) {
  struct Effect {
    std::string mission;
    std::function<bool(const MissionFigures& shipped, const MissionFigures& ablation)> is_there;
  };
  using F = MissionFigures;
  const auto ground_rmse = [](double least, double most) {
    return [=](const F& a, const F& b) {
      const double ratio = b.ground().value() / a.ground().value();
      return ratio >= least && ratio <= most;
    };
  };
  const std::map<std::string, Effect> effects{
      {"observer_off",
       {"air", [](const F& a, const F& b) { return b.air().value() > 5.0 * a.air().value(); }}},
      {"observer_commands",
       {"air", [](const F& a, const F& b) { return b.air().value() > 2.0 * a.air().value(); }}},
      {"observer_slow", {"ground", ground_rmse(1.05, 10.0)}},
      {"observer_fast", {"ground", ground_rmse(0.3, 0.99)}},
      {"actuators_off",
       {"ground",
        [](const F& a, const F& b) { return b.planned_tilt_rate() > a.planned_tilt_rate(); }}},
      {"conditions_off", {"ground", ground_rmse(1.1, 10.0)}},
      {"unloading_off",
       {"ground",
        [](const F& a, const F& b) {
          return b.ground_power().value() > 10.0 * a.ground_power().value();
        }}},
      {"ground_as_wrench",
       {"ground",
        [](const F& a, const F& b) {
          return b.ground_power().value() > 1.5 * a.ground_power().value();
        }}},
      {"lead_off",
       {"air", [](const F& a, const F& b) { return b.air().value() > 3.0 * a.air().value(); }}},
      {"contact_by_height",
       {"ground", [](const F& a, const F& b) { return b.ground().value() != a.ground().value(); }}},
      {"feed_forward_off",
       {"air",
        [](const F& a, const F& b) { return std::abs(b.air().value() - a.air().value()) > 1e-4; }}},
      {"wrench_in_cost", {"ground", ground_rmse(2.0, 1000.0)}},
  };
  std::size_t seen = 0;
  for (const Ablation& ablation : ablations()) {
    const auto effect = effects.find(ablation.name);
    if (std::string(ablation.shipped) != "shipped") continue;  // the same under a condition
    if (effect == effects.end()) {
      EXPECT_STREQ(ablation.name, "shipped");
      continue;
    }
    ++seen;
    const std::string& mission = effect->second.mission;
    const F &shipped = flown("shipped", mission), &other = flown(ablation.name, mission);
    EXPECT_TRUE(effect->second.is_there(shipped, other))
        << ablation.name << ": air " << shipped.air().value() << " -> " << other.air().value()
        << ", ground " << shipped.ground().value() << " -> " << other.ground().value() << ", power "
        << shipped.ground_power().value() << " -> " << other.ground_power().value() << ", tilt "
        << shipped.planned_tilt_rate() << " -> " << other.planned_tilt_rate();
  }
  EXPECT_EQ(seen, effects.size());
}

TEST(Ablations, EffectNamesWhatGetsWorseAndBetter) {
  AblationFigures shipped, other;
  shipped.air = shipped.ground = shipped.mission = 0.005;
  shipped.ground_power = 40.0;
  shipped.servo_demand = 5.0;
  other = shipped;
  EXPECT_EQ(effect(other, shipped), "none");
  other.air = 0.02;
  other.ground = 0.002;
  other.ground_power = 41.0;  // less than a tenth
  EXPECT_EQ(effect(other, shipped), "worse: air; better: ground");
  other.error = "lost";
  EXPECT_EQ(effect(other, shipped), "lost");
}

TEST(Ablations, EachIsComparedWithTheShippedControllerUnderItsCondition) {
  for (const Ablation& ablation : ablations()) {
    MissionOptions options, shipped;
    ablation.set(options);
    for (const Ablation& other : ablations())
      if (std::string(other.name) == ablation.shipped) other.set(shipped);
    EXPECT_EQ(options.height_offset, shipped.height_offset) << ablation.name;
    EXPECT_EQ(options.servo_speed, shipped.servo_speed) << ablation.name;
    EXPECT_EQ(options.vibration, shipped.vibration) << ablation.name;
    EXPECT_TRUE(shipped.as_in_paper.empty() && !shipped.no_actuator_constraints) << ablation.name;
  }
}

TEST(Ablations, TableAndCsvHaveOneRowForEachFlight) {
  std::vector<AblationFigures> rows(4);
  rows[0].name = rows[1].name = "shipped";
  rows[2].name = rows[3].name = "observer_off";
  rows[0].plant = rows[2].plant = "plant";
  rows[1].plant = rows[3].plant = "mujoco";
  rows[2].air = 0.043;
  const std::string csv = ablation_csv(rows);
  EXPECT_NE(csv.find("shipped,mujoco,0,nan"), std::string::npos) << csv;
  EXPECT_NE(csv.find("observer_off,plant,1,0.043,"), std::string::npos) << csv;
}

}  // namespace ablations_test
