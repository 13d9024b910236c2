#include <tilt_ropter/optimal_control/detail/step_search.hpp>

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/detail/quadratic_program.hpp>

#include "support/benchmark_problem.hpp"
#include "support/random.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter::optimal_control {
namespace merit_test {

using test_support::Random;
using test_support::Unicycle;

using Flight = WheeledFlightProblem<0>;

template <typename Problem>
using ProgramOf = QuadraticProgram<Problem::states, Problem::inputs, Problem::constraints,
                                   typename TransitionPatternOf<Problem>::type>;

/// A problem linearised at a trajectory, with its quadratic program and its merit function.
template <typename Problem>
struct Linearised {
  using D = ProblemDimensions<Problem>;
  using Program = ProgramOf<Problem>;

  Problem problem;
  int n;
  Trajectory<Problem> here;
  Program program;
  AugmentedLagrangian<Problem> equalities;
  Merit<Problem, Program> merit;
  double cost = 0.0, max_defect = 0.0, max_violation = 0.0;
  bool solved = false;

  Linearised(const Problem& a_problem, const Trajectory<Problem>& at)
      : problem(a_problem),
        n(a_problem.horizon()),
        here(at),
        program(n, {}),
        equalities(n, 1e6),
        merit(n) {
    for (int k = 0; k <= n; ++k) {
      auto& s = program.riccati.stage(k);
      auto& node = program.node(k);
      if (k < n) {
        typename D::A A;
        typename D::B B;
        const typename D::Tangent defect =
            problem.difference(problem.step(k, here.x(k), here.u(k), A, B), here.x(k + 1));
        EXPECT_TRUE(program.riccati.set_transition(k, A, B));
        program.riccati.set_defect(k, defect);
        max_defect = std::max(max_defect, defect.cwiseAbs().maxCoeff());
      }
      problem.cost_model(k, here.x(k), here.u(k), s.cost);
      equalities.add_to_model(problem, k, here.x(k), s.cost);
      cost += problem.cost(k, here.x(k), here.u(k));
      node.value = problem.constraint_values(k, here.x(k), here.u(k));
      problem.constraint_derivatives(k, here.x(k), here.u(k), node.C, node.E);
      node.lower = problem.lower(k);
      node.upper = problem.upper(k);
      node.penalty = problem.penalty(k);
      EXPECT_TRUE(program.check_node(k));
      for (int i = 0; i < D::nc; ++i)
        max_violation =
            std::max(max_violation, violation(node.value(i), node.lower(i), node.upper(i)));
    }
  }

  bool solve(double damping = 0.0) {
    return program.prepare(damping) && program.solve(D::Tangent::Zero()) == ProgramStatus::solved;
  }

  [[nodiscard]] double value_along_step(double length) const {
    Trajectory<Problem> at = here;
    for (int k = 0; k <= n; ++k) {
      at.x(k) = problem.retract(here.x(k), length * program.dx(k));
      if (k < n) at.u(k) += length * program.du(k);
    }
    return merit.value(problem, program, equalities, at);
  }
  [[nodiscard]] double value_here() const {
    return merit.value_here(problem, program, equalities, here, cost);
  }
  /// Largest step in any coordinate.
  [[nodiscard]] double step_size() const {
    double size = 0.0;
    for (int k = 0; k <= n; ++k) {
      size = std::max(size, program.dx(k).cwiseAbs().maxCoeff());
      if (k < n) size = std::max(size, program.du(k).cwiseAbs().maxCoeff());
    }
    return size;
  }
  /// The merit's slope minus the result of update(). Constraints that are violated and will be met
  /// with a margin decrease faster. Constraints that are met and will be violated do not increase
  /// yet.
  [[nodiscard]] double slope_of_rows_beyond_update() {
    double sum = 0.0;
    for (int k = 0; k <= n; ++k)
      for (int i = 0; i < D::nc; ++i) {
        const auto& node = program.node(k);
        const double value = node.value(i), predicted = node.predicted(i);
        const double now = violation(value, node.lower(i), node.upper(i));
        const double then = violation(predicted, node.lower(i), node.upper(i));
        const double slope = now == 0.0              ? 0.0
                             : value > node.upper(i) ? predicted - value
                                                     : value - predicted;
        sum += constraint_weight(k, i) * (slope - (then - now));
      }
    return sum;
  }

  /// The weights, measured as the increase of the merit per unit of violation or defect.
  [[nodiscard]] double constraint_weight(int k, int i) {
    auto& node = program.node(k);
    const auto before = node;
    node.lower(i) = -test_support::infinity;
    node.upper(i) = node.value(i);
    const double met = value_here();
    node.upper(i) -= 1.0;
    const double violated = value_here();
    node = before;
    return violated - met;
  }
  [[nodiscard]] double defect_weight(int k, int i) {
    double& defect = program.riccati.stage(k).defect(i);
    const double before = defect;
    defect = 0.0;
    const double none = value_here();
    defect = 1.0;
    const double one = value_here();
    defect = before;
    return one - none;
  }

  /// The program's optimal value: model, damping and the cost of violated constraints, including
  /// active constraints that are met only nearly.
  [[nodiscard]] double optimum(double damping) const {
    double sum = 0.0;
    for (int k = 0; k <= n; ++k) {
      const auto& cost_here = program.riccati.stage(k).cost;
      const auto& node = program.node(k);
      const auto& dx = program.dx(k);
      sum += cost_here.lx().dot(dx) + 0.5 * dx.dot(cost_here.lxx() * dx);
      sum += 0.5 * damping * dx.squaredNorm();
      for (int i = 0; i < D::nc; ++i)
        sum += std::abs(node.multiplier(i)) *
               violation(node.predicted(i), node.lower(i), node.upper(i));
      if (k == n) break;
      const auto& du = program.du(k);
      sum += cost_here.lu().dot(du) + du.dot(cost_here.lux() * dx) +
             0.5 * du.dot(cost_here.luu() * du);
      sum += 0.5 * damping * du.squaredNorm();
    }
    return sum;
  }
  /// The multiplier of a continuity condition: the increase of the optimal value per unit of
  /// defect. NaN if the increase depends on the sign, because the active constraints change there.
  [[nodiscard]] double defect_multiplier(int k, int i, double damping) {
    constexpr double h = 1e-4;
    double& defect = program.riccati.stage(k).defect(i);
    const double before = defect;
    double slope[2];
    for (int side = 0; side < 2; ++side) {
      const double step = side == 0 ? h : -h;
      double optima[3];
      for (int m = 0; m < 3; ++m) {
        defect = before + m * step;
        EXPECT_TRUE(solve(damping));
        optima[m] = optimum(damping);
      }
      slope[side] = (4.0 * optima[1] - optima[2] - 3.0 * optima[0]) / (2.0 * step);
    }
    defect = before;
    EXPECT_TRUE(solve(damping));
    if (std::abs(slope[0] - slope[1]) > 1e-3 * (1.0 + std::abs(slope[0])))
      return std::numeric_limits<double>::quiet_NaN();
    return 0.5 * (slope[0] + slope[1]);
  }
};

Linearised<Unicycle> random_unicycle(Random& random) {
  Trajectory<Unicycle> t(6);
  for (int k = 0; k <= 6; ++k) {
    t.x(k) = Eigen::Vector3d(-1.0, 0.0, 0.0) + random.vector(0.5);
    if (k < 6) t.u(k) = random.vector(3.0).head<2>();
  }
  return {Unicycle({6}), t};
}

Linearised<Flight> random_flight(Random& random) {
  Flight problem = test_support::step_problem();
  const int n = problem.horizon();
  Trajectory<Flight> t(n);
  for (int k = 0; k <= n; ++k) {
    problem.node(k).on_ground = k > n / 2;
    t.x(k) = test_support::step_start();
    t.x(k).body.position += random.vector(0.5);
    t.x(k).body.velocity += random.vector(0.5);
    t.x(k).body.orientation = t.x(k).body.orientation * quaternion_exp(random.vector(0.3));
    t.x(k).body.angular_velocity += random.vector(4.0);
    t.x(k).wrench.force += random.vector(4.0);
    if (k < n) t.u(k) << random.vector(25.0), random.vector(5.0);
    if (k > 0)
      t.x(k).body.orientation = problem.step(k - 1, t.x(k - 1), t.u(k - 1)).body.orientation;
  }
  return {problem, t};
}

template <typename Make>
void expect_value_here_is_value(unsigned seed, const Make& make) {
  Random random(seed);
  for (int trial = 0; trial < 10; ++trial) {
    auto it = make(random);
    ASSERT_TRUE(it.solve());
    const double without_weights = it.value_here();
    it.merit.update(it.program, it.n);
    const double value = it.merit.value(it.problem, it.program, it.equalities, it.here);
    EXPECT_NEAR(it.value_here(), value, 1e-12 * value);
    EXPECT_GT(value, without_weights);  // defects and violations count
    it.merit.forget();
    EXPECT_EQ(it.value_here(), without_weights);
  }
}

TEST(Merit, ValueHereEqualsValueAtTheLinearisationPoint) {
  expect_value_here_is_value(101, random_unicycle);
  expect_value_here_is_value(103, random_flight);
}

template <typename Make>
void expect_slope(unsigned seed, const Make& make) {
  Random random(seed);
  double defect = 0.0, row = 0.0;
  for (int trial = 0; trial < 40; ++trial) {
    auto it = make(random);
    ASSERT_TRUE(it.solve());
    const double slope = it.merit.update(it.program, it.n);
    EXPECT_LT(slope, 0.0);
    const double t = 1e-6 / std::max(1.0, it.step_size());
    const double numerical =
        (4.0 * it.value_along_step(t) - it.value_along_step(2.0 * t) - 3.0 * it.value_here()) /
        (2.0 * t);
    EXPECT_NEAR(numerical, slope + it.slope_of_rows_beyond_update(),
                1e-4 * (std::abs(slope) + 1e-10 * it.value_here() / t))
        << "trial " << trial;
    EXPECT_LE(numerical, slope + 1e-4 * std::abs(slope));
    defect = std::max(defect, it.max_defect);
    row = std::max(row, it.max_violation);
  }
  EXPECT_GT(defect, 0.1);  // both occur in the trials
  EXPECT_GT(row, 0.1);
}

TEST(Merit, SlopeIsTheOneSidedDerivativeAlongTheStep) {
  {
    SCOPED_TRACE("unicycle");
    expect_slope(104, random_unicycle);
  }
  {
    SCOPED_TRACE("flight");
    expect_slope(106, random_flight);
  }
}

template <typename Make>
void expect_weights_above_multipliers(unsigned seed, const Make& make, double damping) {
  Random random(seed);
  double largest = 0.0;
  int checked = 0;
  for (int trial = 0; trial < 4; ++trial) {
    auto it = make(random);
    ASSERT_TRUE(it.solve(damping));
    double most = 0.0;
    for (int k = 1; k <= it.n; ++k) most = std::max(most, detail::largest(it.program.costate(k)));
    for (int i = 0; i < std::decay_t<decltype(it)>::D::nx; ++i) {
      const int k = trial * (it.n - 1) / 3;
      const double multiplier = it.defect_multiplier(k, i, damping);
      it.merit.forget();
      it.merit.update(it.program, it.n);
      if (std::isnan(multiplier)) continue;
      ++checked;
      EXPECT_NEAR(it.defect_weight(k, i), 1.1 * std::max(0.01 * most, std::abs(multiplier)),
                  0.01 * (1.0 + std::abs(multiplier)))
          << "node " << k << " component " << i;
    }
    for (int k = 0; k <= it.n; ++k)
      for (int i = 0; i < std::decay_t<decltype(it)>::D::nc; ++i) {
        const double m = std::abs(it.program.node(k).multiplier(i));
        const double penalty = it.program.node(k).penalty(i);
        EXPECT_NEAR(it.constraint_weight(k, i), std::min(1.1 * m, penalty), 1e-6 * (1.0 + m));
        largest = std::max(largest, m);
      }
  }
  EXPECT_GT(largest, 0.1);
  EXPECT_GT(checked, 5);
}

// Of a hundredth of the largest multiplier at least: a component whose multiplier is near zero
// would cost nothing.
TEST(Merit, FirstWeightsAre110PercentOfTheMultipliers) {
  expect_weights_above_multipliers(107, random_unicycle, 0.0);
  expect_weights_above_multipliers(109, random_flight, 0.0);
}

TEST(Merit, WeightsRiseAtOnceAndFallHalfWay) {
  Random random(110);
  auto it = random_flight(random);
  ASSERT_TRUE(it.solve());
  it.merit.update(it.program, it.n);
  int checked = 0;
  for (int k = 0; k < it.n; ++k)
    for (int i = 0; i < Flight::constraints; ++i) {
      double& m = it.program.node(k).multiplier(i);
      const double weight = 1.1 * std::abs(m);
      // No weight is above the penalty.
      if (weight < 1e-3 || 3.0 * weight > it.program.node(k).penalty(i)) continue;
      ++checked;
      const double kept = m;
      m = 0.0;
      it.merit.update(it.program, it.n);
      EXPECT_NEAR(it.constraint_weight(k, i), 0.5 * weight, 1e-6 * weight);
      m = -3.0 * kept;
      it.merit.update(it.program, it.n);
      EXPECT_NEAR(it.constraint_weight(k, i), 3.0 * weight, 1e-6 * weight);
      m = 2.9 * kept;  // half way down to the new weight
      it.merit.update(it.program, it.n);
      EXPECT_NEAR(it.constraint_weight(k, i), 2.95 * weight, 1e-6 * weight);
      m = kept;
      it.merit.forget();
      it.merit.update(it.program, it.n);
    }
  EXPECT_GT(checked, 2);
}

TEST(Merit, WeightsOfDampedProgramFollowItsOwnMultipliers) {
  expect_weights_above_multipliers(111, random_unicycle, 10.0);
}

TEST(Merit, ViolationIsTheDistanceOutsideTheBounds) {
  const double infinity = test_support::infinity;
  EXPECT_EQ(violation(2.0, -1.0, 1.0), 1.0);
  EXPECT_EQ(violation(-3.0, -1.0, 1.0), 2.0);
  EXPECT_EQ(violation(1.0, -1.0, 1.0), 0.0);
  EXPECT_EQ(violation(0.0, 1.0, -1.0), 1.0);  // contradictory bounds
  EXPECT_EQ(violation(1e300, -infinity, infinity), 0.0);
}

}  // namespace merit_test
}  // namespace tilt_ropter::optimal_control
