// The step of a program without time for a solution: inputs that follow the gains, or those of the
// plan, whichever costs less. Both are within the hard bounds.

#include <tilt_ropter/optimal_control/detail/quadratic_program.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <chrono>
#include <limits>
#include <vector>

namespace tilt_ropter::optimal_control {
namespace quadratic_program_interrupted_test {

using Program = QuadraticProgram<2, 1, 2>;
using Vector = Program::Program::Vector;
using Steps = std::vector<Vector>;

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr int horizon = 30;
const Eigen::Vector2d start(0.05, -0.02);  // of the step

// A mass on a line that should move by 1 m. The plan so far is a constant force. The bounds of the
// force are hard, that of the speed has a penalty.
class Interrupted : public testing::Test {
 protected:
  void set(double planned_force, double most_speed) {
    Eigen::Matrix2d A;
    A << 1.0, 0.1, 0.0, 1.0;
    const Eigen::Vector2d B(0.005, 0.1);
    double position = 0.0, speed = 0.0;
    for (int k = 0; k <= horizon; ++k) {
      auto& model = program.riccati.stage(k).cost;
      model.lxx() << 2.0, 0.0, 0.0, 0.02;
      model.lx() << 2.0 * (position - 1.0), 0.02 * speed;
      auto& node = program.node(k);
      node.value << planned_force, speed;
      node.E << 1.0, 0.0;
      node.C << 0.0, 0.0, 0.0, 1.0;
      node.lower << -1.0, -infinity;
      node.upper << 1.0, most_speed;
      node.penalty << infinity, 100.0;
      if (k < horizon) {
        model.luu()(0, 0) = 0.02;
        model.lu()(0) = 0.02 * planned_force;
        EXPECT_TRUE(program.riccati.set_transition(k, A, B));
      } else {
        node.E.setZero();
        node.value(0) = 0.0;
      }
      EXPECT_TRUE(program.check_node(k));
      position += 0.1 * speed + 0.005 * planned_force;
      speed += 0.1 * planned_force;
    }
    ASSERT_TRUE(program.prepare());
  }

  // The step that `input(k, w)` gives; `w` has the input of the gains.
  template <typename Input>
  Steps step(const Input& input) const {
    Steps steps(horizon + 1, Vector::Zero());
    steps[0].head<2>() = start;
    program.riccati.sweep_with(steps, [&](int k, Vector& w) {
      const double force = program.node(k).value(0);
      w(2) = std::clamp(input(w), -1.0 - force, 1.0 - force);
    });
    return steps;
  }

  double penalty(const Steps& steps) {
    program.steps() = steps;
    program.predict();
    return program.cost_of_step(0.0);
  }

  // Solves without time. Expects the cheaper of the two steps, with its prediction.
  void expect_cheaper(bool gains_are_cheaper) {
    const Steps by_gains = step([](const Vector&w) { return w(2); }),
                of_plan = step([](const Vector&) { return 0.0; });
    const double gains_cost = penalty(by_gains), plan_cost = penalty(of_plan);
    ASSERT_EQ(gains_cost < plan_cost, gains_are_cheaper);
    EXPECT_EQ(program.solve(start, SolverClock::time_point()), ProgramStatus::interrupted);
    EXPECT_TRUE(program.late());
    EXPECT_NEAR(program.cost_of_step(0.0), std::min(gains_cost, plan_cost), 1e-9);
    const Steps& expected = gains_are_cheaper ? by_gains : of_plan;
    for (int k = 0; k <= horizon; ++k) {
      const Vector& w = program.step(k);
      const auto& node = program.node(k);
      EXPECT_LT((w - expected[static_cast<std::size_t>(k)]).norm(), 1e-9) << k;
      const Eigen::Vector2d value = node.value + node.C * w.head<2>() + node.E * w(2);
      EXPECT_LT((node.predicted - value).norm(), 1e-12) << k;
    }
    EXPECT_GT(program.residual(), 1e-3);
  }

  static QuadraticProgramSettings settings() {
    QuadraticProgramSettings dual;
    dual.method = ProgramMethod::nlopt;
    return dual;
  }

  Program program{horizon, settings()};
};

// Without bounds the speed would be above its limit, but with the bounds of the force it is not.
TEST_F(Interrupted, FollowsTheGainsIfTheClampedInputsKeepTheOtherBounds) {
  set(0.0, 1.3);
  expect_cheaper(true);
}

TEST_F(Interrupted, KeepsThePlanIfTheGainsViolateABoundWithAPrice) {
  set(0.0, 0.1);
  expect_cheaper(false);
}

TEST_F(Interrupted, ClampsThePlanToItsHardBounds) {
  set(-1.5, infinity);
  expect_cheaper(true);
  set(-1.5, -10.0);  // every step violates it, the plan least
  expect_cheaper(false);
}

}  // namespace quadratic_program_interrupted_test
}  // namespace tilt_ropter::optimal_control
