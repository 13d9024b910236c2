// CTest: optimised

#include <tilt_ropter/control/detail/actuator_level_problem.hpp>
#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/control/nmpc.hpp>

#include "support/actuator_loop.hpp"
#include "support/benchmark_problem.hpp"
#include "support/control_loop.hpp"
#include "support/corridor.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <type_traits>

/// Half-spaces in which the CoM stays: random corridors in closed loop, walls in front of the
/// reference, and the terms of the cost. The plant knows nothing of them.
namespace tilt_ropter {
namespace corridor_test {

using test_support::ActuatorLoop;
using test_support::ControlLoop;
using test_support::Corridor;

// The corridor is 1.3 times as wide as the vehicle with its propellers.
double clearance(const Vehicle<4>& vehicle) {
  constexpr double propeller = 0.065;  // [m]
  return 0.3 * (vehicle.rotors[0].position.norm() + propeller);
}

// Returns how far the vehicle gets out of the corridor at most [m].
template <typename Loop, typename Reference>
double fly(Loop& loop, const Corridor& corridor, const Reference& reference, int& passes) {
  double worst = 0.0;
  while (loop.plant().time() < corridor.duration() + 1.0) {
    const auto& result = loop.tick(reference);
    passes += result.report.passes;
    EXPECT_EQ(result.status, NmpcStatus::solved);
    worst = std::max(worst, corridor.beyond(loop.plant().time(), loop.plant().body().position));
  }
  return worst;
}

double fly(bool at_actuators, unsigned seed, const Corridor& corridor, bool with_walls,
           int& passes) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const auto reference = [&](double time) {
    ReferencePoint point = corridor(time);
    if (!with_walls) point.inside = {};
    return point;
  };
  const Eigen::Vector3d start = corridor(0.0).position;
  if (at_actuators) {
    ActuatorLoop<4> loop(vehicle, vehicle, seed);
    loop.start(start);
    return fly(loop, corridor, reference, passes);
  }
  ControlLoop<Plant<4>> loop(seed);
  loop.start(start.z() - vehicle.wheels->radius, Eigen::Vector3d::Zero(), 0.0);
  return fly(loop, corridor, reference, passes);
}

void fly_corridors(bool at_actuators) {
  const int count = test_support::quick_or_full(6, 200);
  double worst = 0.0, without = 0.0;
  int passes = 0, passes_without = 0;
  for (int i = 0; i < count; ++i) {
    SCOPED_TRACE("corridor " + std::to_string(i));
    test_support::Random random(static_cast<unsigned>(i));
    const Corridor corridor(random, clearance(tilt_ropter_vehicle()));
    const unsigned seed = static_cast<unsigned>(i) + 1;
    worst = std::max(worst, fly(at_actuators, seed, corridor, true, passes));
    without = std::max(without, fly(at_actuators, seed, corridor, false, passes_without));
  }
  EXPECT_GT(without, 0.02);  // they are needed
  EXPECT_LE(worst, 0.01);
  EXPECT_LE(passes, passes_without + count);  // Riccati passes: it costs no time
}

TEST(Corridor, IsNotLeftAtTheWrenchLevel) {
  fly_corridors(false);
}
TEST(Corridor, IsNotLeftAtTheActuatorLevel) {
  fly_corridors(true);
}

// A reference outside two half-spaces: the vehicle stays at their edge, also if it is another one
// than the controller believes.
template <typename Loop>
void expect_stays_at_the_edge(Loop& loop) {
  Vehicle<4> truth = tilt_ropter_vehicle();
  truth.body.mass *= 1.1;
  truth.servo.time_constant *= 1.3;
  loop.fail(truth);
  const auto reference = [](double time) {
    ReferencePoint point;
    point.position << 0.5, 0.5 * std::min(1.0, time), 1.5;
    point.velocity.y() = time < 1.0 ? 0.5 : 0.0;
    point.inside[1] = in_front_of({{0.4, 0.0, 0.0}, -Eigen::Vector3d::UnitX(), {}, 0.0}, 0.3);
    point.inside[3] = {-Eigen::Vector3d::UnitY(), -0.2};
    return point;
  };
  while (loop.plant().time() < 5.0) {
    EXPECT_EQ(loop.tick(reference).status, NmpcStatus::solved);
    const BodyStated& body = loop.plant().body();
    EXPECT_LT(body.position.x(), 0.105);
    EXPECT_LT(body.position.y(), 0.205);
    if (loop.plant().time() < 3.0) continue;
    EXPECT_NEAR(body.position.x(), 0.1, 0.003);
    EXPECT_NEAR(body.position.y(), 0.2, 0.003);
    EXPECT_LT(body.angular_velocity.norm(), 0.05);
  }
}
TEST(Corridor, HoldsAtTheEdge) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  ControlLoop<Plant<4>> loop(1);
  loop.start(1.5 - vehicle.wheels->radius, Eigen::Vector3d::Zero(), 0.0);
  expect_stays_at_the_edge(loop);
  ActuatorLoop<4> of_actuators(vehicle, vehicle);
  of_actuators.start({0.0, 0.0, 1.5});
  expect_stays_at_the_edge(of_actuators);
}

// Of both levels, at the last node and before; with and without TerminalCost::riccati.
template <typename Problem>
void expect_model_of_the_cost(Problem&& problem, int k) {
  using P = std::decay_t<Problem>;
  constexpr int first = P::states - 12;
  const Eigen::Vector3d at(0.1, -0.2, 0.05);
  typename P::State x;
  const auto cost_at = [&](const Eigen::Vector3d& position) {
    x.body.position = position;
    return problem.cost(k, x, P::Input::Zero());
  };
  typename P::Model model;
  for (double least : {0.3, -0.3}) {  // outside; inside, which leaves nothing of that behind
    SCOPED_TRACE(least);
    problem.node(k).inside[2] = {{0.48, 0.6, -0.64}, least};
    const double cost = cost_at(at);
    problem.cost_model(k, x, P::Input::Zero(), model);
    constexpr double h = 0.01;
    for (int i = 0; i < 3; ++i) {
      const Eigen::Vector3d step = h * Eigen::Vector3d::Unit(i);
      EXPECT_NEAR(model.gradient(first + i), (cost_at(at + step) - cost_at(at - step)) / (2.0 * h),
                  1e-8 * cost);
      for (int j = 0; j < 3; ++j) {
        const Eigen::Vector3d other = h * Eigen::Vector3d::Unit(j);
        EXPECT_NEAR(model.hessian(first + i, first + j),
                    (cost_at(at + step + other) - cost_at(at + step - other) -
                     cost_at(at - step + other) + cost_at(at - step - other)) /
                        (4.0 * h * h),
                    1e-8 * cost);
      }
    }
  }
}

TEST(Corridor, CostHasTheDistanceOutside) {
  WheeledFlightSettings settings = test_support::benchmark_settings();
  const int end = settings.intervals;
  for (TerminalCost terminal : {TerminalCost::weights, TerminalCost::riccati}) {
    settings.terminal_cost = terminal;
    const RigidBodyParameters body = test_support::benchmark_body();
    expect_model_of_the_cost(WheeledFlightProblem<0>(body, settings), 3);
    expect_model_of_the_cost(WheeledFlightProblem<0>(body, settings), end);
  }
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const ActuatorLevelSettings of_actuators = actuator_nmpc_settings(vehicle).problem;
  expect_model_of_the_cost(ActuatorLevelProblem<4>(vehicle, of_actuators), 3);
  expect_model_of_the_cost(ActuatorLevelProblem<4>(vehicle, of_actuators), of_actuators.intervals);
}

// What is no half-space is not believed: the reference ends before it.
TEST(Corridor, EndsWhereAHalfSpaceIsNone) {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  for (const HalfSpace& wrong :
       {HalfSpace{{nan, 0.0, 0.0}, 0.0}, HalfSpace{{1.0, 0.0, 0.0}, nan},
        HalfSpace{{1.0, 1.0, 0.0}, 0.0}, HalfSpace{{0.0, 0.0, 0.0}, 1.0}}) {
    EXPECT_FALSE(is_usable(wrong));
    ControlLoop<Plant<4>> loop(1);
    loop.start(1.0, Eigen::Vector3d::Zero(), 0.0);
    double from = 0.3;  // [s]
    const auto reference = [&](double time) {
      ReferencePoint point;
      point.position.z() = loop.plant().body().position.z();
      if (time >= from) point.inside[3] = wrong;
      return point;
    };
    EXPECT_EQ(loop.tick(reference).status, NmpcStatus::approximate);
    from = 1e9;
    EXPECT_EQ(loop.tick(reference).status, NmpcStatus::solved);
    from = 0.0;
    EXPECT_EQ(loop.tick(reference).status, NmpcStatus::solver_failed);
  }
}

}  // namespace corridor_test
}  // namespace tilt_ropter
