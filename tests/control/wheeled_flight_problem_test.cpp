// CTest: optimised

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>

#include "support/autodiff.hpp"
#include "support/benchmark_problem.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/refusals.hpp"
#include "support/states.hpp"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>

#include <algorithm>
#include <limits>

namespace tilt_ropter {
namespace wheeled_flight_problem_test {

using test_support::Dual;
using test_support::Random;
using test_support::random_state;
using D = WheeledFlightProblem<0>::D;

constexpr double infinity = std::numeric_limits<double>::infinity();

WheeledFlightProblem<0> random_problem(Random& random,
                                       TerminalCost terminal = TerminalCost::weights) {
  WheeledFlightSettings settings = test_support::benchmark_settings();
  settings.terminal_cost = terminal;
  if (terminal == TerminalCost::weights) settings.weights.orientation << 30.0, 20.0, 10.0;
  settings.weights.ground_thrust = 0.3;
  WheeledFlightProblem<0> problem(test_support::benchmark_body(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    const Stated r = random_state(random);
    problem.node(k).reference = r.body;
    problem.node(k).wrench_reference = r.wrench;
    problem.node(k).external = {random.vector(1.0), random.vector(0.1)};
    problem.node(k).on_ground = true;
    problem.node(k).com_plane = {0.1, {0.05, -0.02}};
  }
  return problem;
}

// The cost's error vector as written in the paper, for automatic differentiation.
template <typename Scalar>
Eigen::Matrix<Scalar, 18, 1> paper_error(const State<Scalar>& x, const WheeledFlightNode& node) {
  using Quaternion = Eigen::Quaternion<Scalar>;
  Quaternion turn =
      x.body.orientation * Quaternion(node.reference.orientation.conjugate().cast<Scalar>());
  Vector3<Scalar> eq = Scalar(2) * turn.vec();
  if (turn.w() < Scalar(0)) eq = -eq;
  Eigen::Matrix<Scalar, 18, 1> e;
  e << x.wrench.force - node.wrench_reference.force.cast<Scalar>(),
      x.wrench.torque - node.wrench_reference.torque.cast<Scalar>(),
      x.body.position - node.reference.position.cast<Scalar>(),
      x.body.velocity - node.reference.velocity.cast<Scalar>(), eq,
      x.body.angular_velocity - node.reference.angular_velocity.cast<Scalar>();
  return e;
}

template <typename Scalar>
State<Scalar> moved(const Stated& x, const Eigen::Matrix<Scalar, 18, 1>& d) {
  return retract<Scalar>(test_support::cast<Scalar>(x), d);
}

template <typename Value, typename Truth>
double relative(const Value& value, const Truth& truth) {
  return (value - truth).cwiseAbs().maxCoeff() / truth.cwiseAbs().maxCoeff();
}

TEST(WheeledFlightProblem, CostModelIsGaussNewtonModelOfThePapersCost) {
  Random random(41);
  double worst = 0.0;
  for (int i = 0; i < test_support::quick_or_full(200, 10000); ++i) {
    WheeledFlightProblem<0> problem = random_problem(random);
    const int k = i % 2 == 0 ? 3 : problem.horizon();
    problem.node(k).on_ground = i % 4 < 2;
    const NmpcWeights& w = problem.settings().weights;
    const Stated x = random_state(random);
    D::Input u;
    u << random.vector(10.0), random.vector(2.0);

    using S = Dual<18>;
    const Eigen::MatrixXd jacobian = test_support::jacobian_at_zero<18, 18>(
        [&](const Eigen::Matrix<S, 18, 1>& d) -> Eigen::Matrix<S, 18, 1> {
          return paper_error<S>(moved<S>(x, d), problem.node(k));
        });
    const Eigen::VectorXd e = paper_error<double>(x, problem.node(k));
    Eigen::VectorXd q(18);
    q << w.force, w.torque, w.position, w.velocity, w.orientation, w.angular_velocity;
    if (problem.node(k).on_ground) q(TangentIndex::force + 2) += w.ground_thrust;
    if (k == problem.horizon()) q *= w.terminal;

    WheeledFlightProblem<0>::Model model;
    problem.cost_model(k, x, u, model);
    const Eigen::MatrixXd hessian = 2.0 * jacobian.transpose() * q.asDiagonal() * jacobian;
    const Eigen::VectorXd gradient = 2.0 * jacobian.transpose() * q.cwiseProduct(e);
    worst = std::max({worst, relative(model.lxx(), hessian), relative(model.lx(), gradient)});
    double cost = e.dot(q.cwiseProduct(e));
    if (k < problem.horizon()) {
      Eigen::Matrix<double, 6, 1> r;
      r << w.force_rate, w.torque_rate;
      cost += u.dot(r.cwiseProduct(u));
      EXPECT_LT((model.lu() - 2.0 * r.cwiseProduct(u)).norm(), 1e-12);
    }
    EXPECT_NEAR(problem.cost(k, x, u), cost, 1e-12 * cost);
  }
  test_support::check_at_most(7, "cost: model's relative error", worst, 1e-12);
}

// Hessian of the cost at the node's reference, in tangent coordinates.
Eigen::MatrixXd hessian_at_reference(const WheeledFlightProblem<0>& problem, int k) {
  Stated x;
  x.wrench = problem.node(k).wrench_reference;
  x.body = problem.node(k).reference;
  WheeledFlightProblem<0>::Model model;
  problem.cost_model(k, x, D::Input::Zero(), model);
  return model.lxx();
}

WheeledFlightProblem<0> hovering_problem(double yaw) {
  WheeledFlightSettings settings = test_support::benchmark_settings();
  settings.terminal_cost = TerminalCost::riccati;
  WheeledFlightProblem<0> problem(test_support::benchmark_body(), settings);
  for (int k = 0; k <= problem.horizon(); ++k) {
    problem.node(k).reference.position << 1.0, 2.0, 3.0;
    problem.node(k).reference.orientation = quaternion_from_yaw(yaw);
    problem.node(k).wrench_reference.force = test_support::benchmark_hover_force();
  }
  return problem;
}

TEST(WheeledFlightProblem, RiccatiCostIsCostToGoOfHoverAtEveryHeading) {
  for (const double yaw : {0.0, 0.4, 1.9, -2.5, pi}) {
    const WheeledFlightProblem<0> problem = hovering_problem(yaw);
    Stated x;
    x.wrench = problem.node(0).wrench_reference;
    x.body = problem.node(0).reference;
    D::A A;
    D::B B;
    (void)problem.step(0, x, D::Input::Zero(), A, B);
    const Eigen::MatrixXd a = A, b = B;  // products of fixed size take seconds to compile
    WheeledFlightProblem<0>::Model model;
    problem.cost_model(0, x, D::Input::Zero(), model);
    const Eigen::MatrixXd P = hessian_at_reference(problem, problem.horizon());
    const Eigen::MatrixXd by_input = model.luu() + b.transpose() * P * b;
    const Eigen::MatrixXd mixed = b.transpose() * P * a;
    const Eigen::MatrixXd residual =
        model.lxx() + a.transpose() * P * a - mixed.transpose() * by_input.llt().solve(mixed) - P;
    EXPECT_LT(residual.cwiseAbs().maxCoeff(), 1e-11 * P.cwiseAbs().maxCoeff()) << yaw;
    EXPECT_LT((P - P.transpose()).cwiseAbs().maxCoeff(), 1e-14 * P.cwiseAbs().maxCoeff());
    EXPECT_EQ(Eigen::LLT<Eigen::MatrixXd>(P - model.lxx()).info(), Eigen::Success);  // P > Q
  }
}

TEST(WheeledFlightProblem, RiccatiCostHasExactDerivatives) {
  Random random(46);
  double worst = 0.0;
  const Eigen::MatrixXd level = 0.5 * hessian_at_reference(hovering_problem(0.0), 20);
  for (int i = 0; i < test_support::quick_or_full(200, 10000); ++i) {
    const WheeledFlightProblem<0> problem = random_problem(random, TerminalCost::riccati);
    const int k = problem.horizon();
    const Stated x = random_state(random);
    Eigen::MatrixXd turn = Eigen::MatrixXd::Identity(18, 18);
    const double yaw = yaw_of(problem.node(k).reference.orientation);
    for (const int axes : {6, 9, 12})
      turn.block<3, 3>(axes, axes) =
          Eigen::AngleAxisd(-yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    const Eigen::MatrixXd P = turn.transpose() * level * turn;

    using S = Dual<18>;
    const Eigen::MatrixXd jacobian = test_support::jacobian_at_zero<18, 18>(
        [&](const Eigen::Matrix<S, 18, 1>& d) -> Eigen::Matrix<S, 18, 1> {
          return paper_error<S>(moved<S>(x, d), problem.node(k));
        });
    const Eigen::VectorXd e = paper_error<double>(x, problem.node(k));
    WheeledFlightProblem<0>::Model model;
    problem.cost_model(k, x, D::Input::Zero(), model);
    const Eigen::MatrixXd hessian = 2.0 * jacobian.transpose() * P * jacobian;
    const Eigen::VectorXd gradient = 2.0 * jacobian.transpose() * P * e;
    worst = std::max({worst, relative(model.lxx(), hessian), relative(model.lx(), gradient)});
    const double cost = e.dot(P * e);
    EXPECT_NEAR(problem.cost(k, x, D::Input::Zero()), cost, 1e-12 * cost);
  }
  test_support::check_at_most(7, "Riccati cost: model's relative error", worst, 1e-12);
}

TEST(WheeledFlightProblem, GroundConditionsHaveExactDerivatives) {
  Random random(42);
  double worst = 0.0;
  for (int i = 0; i < test_support::quick_or_full(200, 10000); ++i) {
    const WheeledFlightProblem<0> problem = random_problem(random);
    const Stated x = random_state(random);
    using S = Dual<18>;
    const Eigen::Matrix<double, 3, 18> truth = test_support::jacobian_at_zero<3, 18>(
        [&](const Eigen::Matrix<S, 18, 1>& d) -> Eigen::Matrix<S, 3, 1> {
          const State<S> y = moved<S>(x, d);
          const Vector3<S> velocity =
              y.body.orientation.toRotationMatrix().transpose() * y.body.velocity;
          return {velocity.y(), y.body.angular_velocity.x(),
                  y.body.position.z() - 0.05 * y.body.position.x() + 0.02 * y.body.position.y()};
        });
    D::EqualitiesX H;
    problem.equality_derivatives(1, x, H);
    worst = std::max(worst, relative(H, truth));
    const Eigen::Vector3d& p = x.body.position;
    EXPECT_NEAR(problem.equality_values(1, x)(2), p.z() - (0.1 + 0.05 * p.x() - 0.02 * p.y()),
                1e-15);
  }
  test_support::check_at_most(7, "ground conditions: derivatives' relative error", worst, 1e-12);
}

TEST(WheeledFlightProblem, ConstraintsArePapersBoundsWithExactDerivatives) {
  Random random(43);
  WheeledFlightSettings settings = test_support::benchmark_settings();
  settings.bounds = paper_bounds();
  const WheeledFlightProblem<0> problem(test_support::benchmark_body(), settings);
  const Stated x = random_state(random);
  const D::Input u = D::Input::Ones();
  D::ConstraintsX C = D::ConstraintsX::Zero();
  D::ConstraintsU E = D::ConstraintsU::Zero();
  problem.constraint_derivatives(2, x, u, C, E);
  const D::Constraints before = problem.constraint_values(2, x, u);
  for (int i = 0; i < 18; ++i) {
    const D::Tangent d = 1e-3 * D::Tangent::Unit(i);
    EXPECT_LT((problem.constraint_values(2, problem.retract(x, d), u) - before - C * d).norm(),
              1e-12);
  }
  for (int i = 0; i < 6; ++i)
    EXPECT_LT((problem.constraint_values(2, x, u + D::Input::Unit(i)) - before - E.col(i)).norm(),
              1e-12);

  EXPECT_DOUBLE_EQ(problem.upper(2)(0), 0.2);    // F_x
  EXPECT_DOUBLE_EQ(problem.lower(2)(2), 0.0);    // F_z
  EXPECT_DOUBLE_EQ(problem.upper(2)(8), 1.5);    // w_z
  EXPECT_DOUBLE_EQ(problem.lower(2)(14), -2.0);  // dM_z
  EXPECT_TRUE(std::isinf(problem.upper(0)(0)));  // the measured state is not bounded
  EXPECT_DOUBLE_EQ(problem.upper(0)(9), 2.0);
  EXPECT_TRUE(std::isinf(problem.upper(20)(9)));  // the last node has no input
}

TEST(WheeledFlightProblem, ActuatorConstraintsFollowThePapersConstraints) {
  Random random(45);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const ActuatorConstraints<4> actuators(vehicle);
  using Problem = WheeledFlightProblem<4>;
  using Constraints = optimal_control::ProblemDimensions<Problem>;
  const Problem problem(vehicle.body, {}, actuators);
  const WheeledFlightProblem<0> paper(vehicle.body);
  Constraints::ConstraintsX C = Constraints::ConstraintsX::Zero();
  Constraints::ConstraintsU E = Constraints::ConstraintsU::Zero();
  for (int i = 0; i < 100; ++i) {
    // C and E keep the entries of earlier calls.
    const Stated x = random_state(random);
    D::Input u, w;
    u << random.vector(20.0), random.vector(4.0);
    w << x.wrench.force, x.wrench.torque;
    const Constraints::Constraints values = problem.constraint_values(2, x, u);
    EXPECT_EQ(values.head<15>(), paper.constraint_values(2, x, u));
    EXPECT_EQ(values.tail<12>(), actuators.values(w, u));
    problem.constraint_derivatives(2, x, u, C, E);
    const double h = 1e-6;
    for (int j = 0; j < 18; ++j) {
      const D::Tangent d = h * D::Tangent::Unit(j);
      const Constraints::Constraints slope =
          (problem.constraint_values(2, problem.retract(x, d), u) -
           problem.constraint_values(2, problem.retract(x, -d), u)) /
          (2.0 * h);
      EXPECT_LT((slope - C.col(j)).norm(), 1e-6 * (1.0 + slope.norm()));
    }
    for (int j = 0; j < 6; ++j) {
      const D::Input d = h * D::Input::Unit(j);
      const Constraints::Constraints slope =
          (problem.constraint_values(2, x, u + d) - problem.constraint_values(2, x, u - d)) /
          (2.0 * h);
      EXPECT_LT((slope - E.col(j)).norm(), 1e-6 * (1.0 + slope.norm()));
    }
  }
  for (const int k : {0, 1, problem.horizon()}) {
    EXPECT_EQ(problem.upper(k).head<15>(), paper.upper(k));
    EXPECT_EQ(problem.lower(k).head<15>(), paper.lower(k));
    EXPECT_TRUE((problem.lower(k).tail<12>().array() == -infinity).all());
    // The last node has no input. The thrust at the first node is measured.
    EXPECT_TRUE((problem.upper(k).segment<8>(Problem::Part::actuators).array() ==
                 (k == problem.horizon() ? infinity : 0.0))
                    .all());
    EXPECT_TRUE(
        (problem.upper(k).tail<4>().array() == (k == 0 ? infinity : vehicle.rotor.max_thrust))
            .all());
  }
  const Problem off(vehicle.body);
  EXPECT_TRUE((off.upper(1).tail<12>().array() == infinity).all());
}

TEST(WheeledFlightProblem, NodesInTheAirHaveNoGroundConditions) {
  Random random(44);
  WheeledFlightProblem<0> problem = random_problem(random);
  problem.node(4).on_ground = false;
  EXPECT_EQ(problem.equality_weights(4), Eigen::Vector3d::Zero());
  EXPECT_EQ(problem.equality_weights(5), Eigen::Vector3d(2.0 * problem.settings().weights.ground));
}

TEST(WheeledFlightProblem, CostAfterTheHorizonNeedsWeightsThatObserveTheState) {
  WheeledFlightSettings valid;  // position and yaw observe roll, pitch and all velocities
  valid.terminal_cost = TerminalCost::riccati;
  valid.weights.velocity.setZero();
  valid.weights.angular_velocity.setZero();
  valid.weights.orientation << 0.0, 0.0, 30.0;
  const auto construct = [](const WheeledFlightSettings& settings) {
    WheeledFlightProblem<0>(test_support::benchmark_body(), settings);
  };
  test_support::expect_accepted([&] { construct(valid); });
  const auto expect_refused = [&](Eigen::Vector3d NmpcWeights::*weight) {
    WheeledFlightSettings settings = valid;
    (settings.weights.*weight).z() = 0.0;
    test_support::expect_refused(
        "WheeledFlightSettings.terminal_cost", [&] { construct(settings); },
        "riccati: must be used with weights");
  };
  expect_refused(&NmpcWeights::position);
  expect_refused(&NmpcWeights::orientation);
}

TEST(WheeledFlightProblem, ChecksItsSettings) {
  const WheeledFlightSettings valid;
  WheeledFlightProblem<0> problem(test_support::benchmark_body(), valid);
  const auto expect_refused = [&](const char* name, bool by_constructor,
                                  void (*spoil)(WheeledFlightSettings&)) {
    WheeledFlightSettings settings = valid;
    spoil(settings);
    if (by_constructor)
      test_support::expect_refused(
          name, [&] { WheeledFlightProblem<0>(test_support::benchmark_body(), settings); });
    test_support::expect_refused(name, [&] { problem.set_settings(settings); });
  };
  expect_refused("FlightWeights.terminal", true, [](auto& s) { s.weights.terminal = 0.0; });
  expect_refused("HorizonSettings.intervals", false, [](auto& s) { s.intervals = 19; });
  expect_refused("HorizonSettings.intervals", false, [](auto& s) { s.intervals = 21; });
  expect_refused("HorizonSettings.interval [s]", false, [](auto& s) { s.interval = 0.05; });
  expect_refused("HorizonSettings.interval [s]", false, [](auto& s) { s.interval = 0.2; });
}

}  // namespace wheeled_flight_problem_test
}  // namespace tilt_ropter
