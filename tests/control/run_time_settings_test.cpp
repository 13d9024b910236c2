// Nmpc accepts new settings between two ticks. They act in the next tick and keep the warm start.

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/hovering.hpp"
#include "support/simulated_time.hpp"

#include <gtest/gtest.h>

#include <stdexcept>
#include <string>

namespace tilt_ropter {
namespace run_time_settings_test {

const Vehicle<4> vehicle = tilt_ropter_vehicle();

// Closed loop: the vehicle flies to a point 1 m away, or stands on the ground.
class Loop {
 public:
  explicit Loop(bool standing) : standing_(standing) {
    contact_ = in_the_air({});
    if (standing) {
      contact_ = {};
      contact_.on_ground = contact_.ground_known = true;
      return;
    }
    sent_ = test_support::level_hover(allocation_, vehicle);
    BodyStated start;
    start.position.z() = 2.0;
    plant_.reset(start, sent_.command);
  }

  const NmpcResult& tick() {
    const double time = plant_.time();
    const auto reference = [this](double) {
      ReferencePoint point;
      point.position << (standing_ ? 0.0 : 1.0), 0.0, (standing_ ? vehicle.wheels->radius : 2.0);
      return point;
    };
    EXPECT_EQ(nmpc.prepare(time, reference, contact_), optimal_control::PrepareStatus::prepared);
    const NmpcResult& result = nmpc.feedback(time, plant_.body());
    EXPECT_EQ(result.status, NmpcStatus::solved);
    sent_ = allocation_.allocate(time, result.wrench, result.rate, sent_);
    EXPECT_TRUE(plant_.step(sent_.command, {}, 0.01));
    return result;
  }
  void run(int ticks) {
    for (int i = 0; i < ticks; ++i) tick();
  }

  Nmpc<4> nmpc{vehicle, test_support::in_simulated_time()};

 private:
  bool standing_;
  Plant<4> plant_{vehicle};
  Allocation<4> allocation_{vehicle};
  AllocationResult<4> sent_;
  ContactEstimate contact_;
};

TEST(RunTimeSettings, SameSettingsChangeNothing) {
  Loop kept(false), set(false);
  for (int i = 0; i < 50; ++i) {
    set.nmpc.set_settings(set.nmpc.settings());
    const NmpcResult &a = kept.tick(), &b = set.tick();
    ASSERT_EQ(a.wrench.force, b.wrench.force) << i;
    ASSERT_EQ(a.rate.torque, b.rate.torque) << i;
    ASSERT_EQ(a.report.passes, b.report.passes) << i;  // no cold start
  }
}

TEST(RunTimeSettings, WeightsAndBoundsActInTheNextTick) {
  Loop kept(false), heavy(false), bounded(false), free(false);
  for (Loop* loop : {&kept, &heavy, &bounded, &free}) loop->run(10);
  NmpcSettings settings = kept.nmpc.settings();
  settings.problem.weights.position *= 4.0;
  heavy.nmpc.set_settings(settings);
  settings = kept.nmpc.settings();
  settings.problem.bounds.force_rate.setConstant(0.5);
  bounded.nmpc.set_settings(settings);
  settings = kept.nmpc.settings();
  settings.actuator_constraints = false;
  free.nmpc.set_settings(settings);
  const double usual = kept.tick().rate.force.norm();
  EXPECT_GT((heavy.tick().rate.force - kept.nmpc.result().rate.force).norm(), 0.01 * usual);
  EXPECT_GT(usual, 1.0);
  EXPECT_LE(bounded.tick().rate.force.cwiseAbs().maxCoeff(), 0.5);
  EXPECT_GT(free.tick().rate.force.norm(), 0.0);
  const auto upper = [](const Loop& loop) { return loop.nmpc.solver().problem().upper(1)(20); };
  EXPECT_LT(upper(kept), 1e3);
  EXPECT_GT(upper(free), 1e300);

  settings = kept.nmpc.settings();
  settings.problem.bounds.tilt_rate_fraction = 0.1;
  const auto row = [](const Loop& loop) {
    Stated hover;
    hover.wrench.force.z() = vehicle.body.mass * gravity;
    return loop.nmpc.solver().problem().constraint_values(1, hover,
                                                          Eigen::Matrix<double, 6, 1>::Zero())(15);
  };
  const double before = row(kept);
  kept.nmpc.set_settings(settings);
  EXPECT_NEAR(row(kept) / before, 0.1 / 0.85, 1e-9);
}

TEST(RunTimeSettings, ThrustOnTheGroundFollowsDownForce) {
  Loop loop(true);
  loop.run(800);
  EXPECT_NEAR(loop.tick().wrench.force.z(), 0.75, 0.02);
  NmpcSettings settings = loop.nmpc.settings();
  settings.ground.down_force = 3.0;
  loop.nmpc.set_settings(settings);
  loop.run(800);
  EXPECT_NEAR(loop.tick().wrench.force.z(), 3.0, 0.02);
}

TEST(RunTimeSettings, RiccatiTerminalCostIsRecomputed) {
  Loop loop(false);
  NmpcSettings settings = loop.nmpc.settings();
  settings.problem.terminal_cost = TerminalCost::riccati;
  loop.nmpc.set_settings(settings);
  const Nmpc<4> built(vehicle, settings);
  Stated off;
  off.wrench.force.z() = vehicle.body.mass * gravity;
  off.body.position.x() = 0.3;
  const auto last_cost = [&off](const Nmpc<4>& nmpc) {
    WheeledFlightProblem<4> problem = nmpc.solver().problem();
    for (int k = 0; k <= problem.horizon(); ++k) problem.node(k) = {};
    return problem.cost(problem.horizon(), off, Eigen::Matrix<double, 6, 1>::Zero());
  };
  EXPECT_DOUBLE_EQ(last_cost(loop.nmpc), last_cost(built));
  loop.run(20);
}

TEST(RunTimeSettings, RejectedSettingsChangeNothing) {
  Loop kept(false), refused(false);
  kept.run(5);
  refused.run(5);
  const auto expect_refused = [&](const std::string& field, void (*spoil)(NmpcSettings&)) {
    NmpcSettings settings = refused.nmpc.settings();
    settings.problem.weights.position *= 2.0;
    spoil(settings);
    try {
      refused.nmpc.set_settings(settings);
      ADD_FAILURE() << field << " was accepted";
    } catch (const std::invalid_argument& error) {
      EXPECT_NE(std::string(error.what()).find(field), std::string::npos) << error.what();
    }
  };
  expect_refused("HorizonSettings.intervals", [](auto& s) { s.problem.intervals = 10; });
  expect_refused("HorizonSettings.interval [s]", [](auto& s) { s.problem.interval = 0.05; });
  expect_refused("ControllerSettings.solver", [](auto& s) { s.solver.program.max_passes = 3; });
  expect_refused("ControllerSettings.period [s]", [](auto& s) { s.period = 0.0; });
  expect_refused("NmpcWeights.force_rate", [](auto& s) { s.problem.weights.force_rate.setZero(); });
  expect_refused("GroundContactSettings", [](auto& s) { s.ground.settling_speed = -1.0; });
  expect_refused("FlightWeights.position", [](auto& s) {
    s.problem.terminal_cost = TerminalCost::riccati;
    s.problem.weights.position.x() = 1.0;
  });
  for (int i = 0; i < 20; ++i) ASSERT_EQ(kept.tick().rate.force, refused.tick().rate.force);
}

TEST(RunTimeSettings, VoltageIsKeptWithNewSettings) {
  Vehicle<4> sagging = vehicle;
  sagging.battery.nominal_voltage = 20.0;
  NmpcSettings settings = test_support::in_simulated_time();
  settings.actuator_constraints = false;
  Nmpc<4> nmpc(sagging, settings);
  const auto bound = [&nmpc] {
    return nmpc.solver().problem().upper(1)(WheeledFlightProblem<4>::Part::actuators + 8);
  };
  EXPECT_TRUE(nmpc.set_voltage(16.0));
  EXPECT_GT(bound(), 1e300);
  settings.actuator_constraints = true;
  nmpc.set_settings(settings);
  EXPECT_NEAR(bound(), 0.8 * 0.8 * vehicle.rotor.max_thrust, 1e-9);
}

TEST(RunTimeSettings, SettingsAfterPrepareNeedAnotherPrepare) {
  Loop loop(false);
  loop.run(5);
  const auto hover = [](double) { return ReferencePoint{}; };
  EXPECT_EQ(loop.nmpc.prepare(0.05, hover, in_the_air({})),
            optimal_control::PrepareStatus::prepared);
  loop.nmpc.set_settings(loop.nmpc.settings());
  EXPECT_EQ(loop.nmpc.feedback(0.05, {}).status, NmpcStatus::solver_failed);
  EXPECT_EQ(loop.nmpc.prepare(0.06, hover, in_the_air({})),
            optimal_control::PrepareStatus::prepared);
  EXPECT_EQ(loop.nmpc.feedback(0.06, {}).status, NmpcStatus::solved);
}

}  // namespace run_time_settings_test
}  // namespace tilt_ropter
