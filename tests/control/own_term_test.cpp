// A term of the user in the prediction: its derivatives, and flights with drag that the term and
// the observer know or do not know.

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/detail/own_term.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include "support/benchmark_problem.hpp"
#include "support/hovering.hpp"
#include "support/random.hpp"
#include "support/simulated_time.hpp"
#include "support/states.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>

namespace tilt_ropter {
namespace own_term_test {

using test_support::Random;
using test_support::random_state;

// Of the air: force and torque against the motion, along each body axis.
struct Drag {
  double force = 0.8, torque = 0.02;  // [N s/m], [N m s/rad]

  OwnTerm operator()(const BodyStated& body) const {
    const Eigen::Matrix3d to_body = body.orientation.conjugate().toRotationMatrix();
    const Eigen::Vector3d velocity = to_body * body.velocity;
    OwnTerm drag;
    drag.wrench = {-force * velocity, -torque * body.angular_velocity};
    drag.derivative.block<3, 3>(0, 0) = -force * to_body;
    drag.derivative.block<3, 3>(0, 3) = -force * skew(velocity);
    drag.derivative.block<3, 3>(3, 6).diagonal().setConstant(-torque);
    return drag;
  }
};

using Plain = WheeledFlightProblem<0>;
using Problem = detail::ProblemWithTerm<0, Drag>;

// At a node that the ground holds, too.
Problem problem_with_drag(Random& random) {
  Problem problem(Plain(test_support::benchmark_body()), Drag{0.8, 0.05});
  for (int k = 0; k < problem.horizon(); ++k)
    problem.node(k).external = {random.vector(2.0), random.vector(0.2)};
  problem.node(1).freedom.linear(2, 2) = problem.node(1).freedom.angular(0, 0) = 0.0;
  return problem;
}

TEST(OwnTerm, StepHasExactDerivativesWithinItsPattern) {
  Random random(71);
  const Problem problem = problem_with_drag(random);
  for (int n = 0; n < 200; ++n) {
    const Stated x = random_state(random);
    Problem::Input u;
    u << random.vector(20.0), random.vector(4.0);
    const int k = n % 3;
    Problem::StateJacobian A, differences;
    Problem::InputJacobian B;
    const Stated end = problem.step(k, x, u, A, B);
    EXPECT_LT(problem.difference(end, problem.step(k, x, u)).norm(), 1e-12);
    const double h = 1e-5;
    const auto moved = [&](int column, double length) {
      return problem.step(k, problem.retract(x, length * Problem::Tangent::Unit(column)), u);
    };
    for (int j = 0; j < 18; ++j)
      differences.col(j) = problem.difference(moved(j, h), moved(j, -h)) / (2.0 * h);
    EXPECT_LT((A - differences).cwiseAbs().maxCoeff(), 1e-7 * (1.0 + A.cwiseAbs().maxCoeff()));
    for (int j = 0; j < 6; ++j) {
      const Problem::Input d = 1e-2 * Problem::Input::Unit(j);
      const Problem::Tangent slope =
          problem.difference(problem.step(k, x, u + d), problem.step(k, x, u - d)) / 2e-2;
      EXPECT_LT((B.col(j) - slope).cwiseAbs().maxCoeff(), 1e-7);
    }
    for (int i = 0; i < 18; ++i)
      for (int j = 0; j < 24; ++j) {
        if (Problem::TransitionPattern::nonzero(i, j)) continue;
        EXPECT_EQ(j < 18 ? A(i, j) : B(i, j - 18), 0.0) << i << ' ' << j;
      }
    const auto by_velocity =
        A.block<3, 3>(TangentIndex::velocity, TangentIndex::velocity) - Eigen::Matrix3d::Identity();
    EXPECT_GT(by_velocity.norm(), 0.01);  // zero without the term
  }
  static_assert(optimal_control::HasLanes<Plain>::value);
  static_assert(!optimal_control::HasLanes<Problem>::value);
}

// Flies a circle at 2 m/s through air that brakes. Returns the RMS error of the position [m].
template <typename Term>
double circle(const Term& term, bool observer_knows) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Drag air;
  const auto reference = [](double time) {
    constexpr double radius = 1.0, rate = 2.0;
    const double c = std::cos(rate * time), s = std::sin(rate * time);
    ReferencePoint point;
    point.position << radius * s, radius * (1.0 - c), 1.5;
    point.velocity << radius * rate * c, radius * rate * s, 0.0;
    point.acceleration << -radius * rate * rate * s, radius * rate * rate * c, 0.0;
    return point;
  };
  Plant<4> plant(vehicle);
  const Allocation<4> allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserverd observer(vehicle.body, observer_settings(20.0));
  Nmpc nmpc(vehicle, test_support::in_simulated_time(nmpc_settings(vehicle)), term);
  AllocationResult<4> sent = test_support::level_hover(allocation, vehicle);
  BodyStated start;
  start.position = reference(0.0).position;
  start.velocity = reference(0.0).velocity;
  plant.reset(start, sent.command);
  actuators.reset(sent.command, 0.0);
  double sum = 0.0;
  const int ticks = 800;
  for (int i = 0; i < ticks; ++i) {
    const double time = plant.time();
    const ActuatorState<4> applied{plant.actuators().rotor_speed,
                                   actuators.update(time, sent.command).tilt_angle};
    const Wrenchd explained = observer_knows ? air(plant.body()).wrench : Wrenchd{};
    (void)observer.update(time, plant.inertial_sample(), allocation.wrench(applied) + explained);
    (void)nmpc.prepare(time, reference, in_the_air(observer.external()));
    const NmpcResult& result = nmpc.feedback(time, plant.body());
    EXPECT_EQ(result.status, NmpcStatus::solved);
    sent = allocation.allocate(time, result.wrench, result.rate, sent);
    actuators.update(time, sent.command);
    for (int n = 0; n < 20; ++n)
      EXPECT_TRUE(plant.step(sent.command, air(plant.body()).wrench, 5e-4));
    const double error = (plant.body().position - reference(plant.time()).position).norm();
    if (i >= ticks / 2) sum += error * error;
  }
  const int counted = ticks - ticks / 2;
  return std::sqrt(sum / counted);
}

TEST(OwnTerm, DragInThePredictionReducesTheTrackingError) {
  const double without = circle(NoOwnTerm(), false), with = circle(Drag(), true),
               counted_twice = circle(Drag(), false);
  EXPECT_LT(with, 0.01);
  EXPECT_LT(with, 0.2 * without);
  EXPECT_GT(counted_twice, 2.0 * without);
}

// The wrench reference contains the term: at rest in a wind that a learnt term knows, no offset
// stays, without an observer.
TEST(OwnTerm, AnyCallableIsATerm) {
  const Eigen::Vector3d wind(0.8, -0.5, 0.3);
  const auto learnt = [&wind](const BodyStated& body) {
    OwnTerm term;
    term.wrench.force = body.orientation.conjugate() * wind;
    term.derivative.block<3, 3>(0, 3) = skew(term.wrench.force);
    return term;
  };
  Nmpc nmpc(tilt_ropter_vehicle(), test_support::in_simulated_time(), learnt);
  const RigidBodyd plant(tilt_ropter_vehicle().body);
  Stated x;
  x.body = test_support::hovering();
  for (int i = 0; i < 500; ++i) {
    const double time = 0.01 * i;
    (void)nmpc.prepare(time, test_support::hover, in_the_air({}));
    const NmpcResult& result = nmpc.feedback(time, x.body);
    EXPECT_EQ(result.status, NmpcStatus::solved);
    x.wrench = result.wrench;
    Eigen::Matrix<double, 6, 1> rate;
    rate << result.rate.force, result.rate.torque;
    x = plant.step(x, rate, learnt(x.body).wrench, 0.01);
  }
  EXPECT_LT((x.body.position - test_support::hovering().position).norm(), 1e-4);
}

TEST(OwnTerm, ValueThatIsNotFiniteLeavesTheCommandFinite) {
  bool broken = false;
  const auto term = [&broken](const BodyStated&) {
    OwnTerm own;
    if (broken) own.wrench.force.x() = std::nan("");
    return own;
  };
  Nmpc nmpc(tilt_ropter_vehicle(), test_support::in_simulated_time(), term);
  for (int i = 0; i < 60; ++i) {
    broken = i >= 10 && i < 50;
    (void)nmpc.prepare(0.01 * i, test_support::hover, in_the_air({}));
    const NmpcResult& result = nmpc.feedback(0.01 * i, test_support::hovering());
    test_support::expect_within_bounds(result, nmpc.settings().problem.bounds);
    EXPECT_EQ(result.status, !broken  ? NmpcStatus::solved
                             : i < 30 ? NmpcStatus::solver_failed
                                      : NmpcStatus::no_plan)
        << i;
  }
}

}  // namespace own_term_test
}  // namespace tilt_ropter
