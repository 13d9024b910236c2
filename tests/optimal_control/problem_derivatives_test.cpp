// The derivatives of the problems that tests solve are exact: the solvers assume that.
// CTest: long

#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/optimal_control/derivative_check.hpp>

#include "support/autodiff.hpp"
#include "support/benchmark_problem.hpp"
#include "support/circle_problem.hpp"
#include "support/contradiction.hpp"
#include "support/double_integrator.hpp"
#include "support/full_run.hpp"
#include "support/pendulum.hpp"
#include "support/quadrotor.hpp"
#include "support/random.hpp"
#include "support/states.hpp"
#include "support/unicycle.hpp"

#include <gtest/gtest.h>

namespace tilt_ropter::optimal_control {
namespace problem_derivatives_test {

using test_support::Contradiction;
using test_support::DoubleIntegrator;
using test_support::Dual;
using test_support::Pendulum;
using test_support::Quadrotor;
using test_support::Random;
using test_support::random_state;
using test_support::sentences;
using test_support::Unicycle;

template <typename Scalar, int Size>
Eigen::Matrix<Scalar, Size, 1> lift(const Eigen::Matrix<double, Size, 1>& x) {
  return x.template cast<Scalar>();
}

template <typename Scalar>
BodyState<Scalar> lift(const BodyStated& x) {
  return {x.position.cast<Scalar>(), x.velocity.cast<Scalar>(), x.orientation.cast<Scalar>(),
          x.angular_velocity.cast<Scalar>()};
}

template <typename Derived, typename Truth>
void expect_equal(const Eigen::MatrixBase<Derived>& value, const Truth& truth) {
  EXPECT_LT((value - truth).cwiseAbs().maxCoeff(), 1e-12 * (1.0 + truth.cwiseAbs().maxCoeff()));
}

template <typename Problem>
void expect_exact_derivatives(const Problem& problem, int k, const typename Problem::State& x,
                              const typename Problem::Input& u) {
  using D = typename Problem::D;
  constexpr int nx = D::nx, nu = D::nu, nc = D::nc, ne = D::ne, nr = Problem::residuals;
  using S = Dual<nx + nu>;
  using Vector = Eigen::Matrix<S, nx + nu, 1>;
  const auto x_of = [&](const Vector& d) {
    return problem.template moved<S>(lift<S>(x), Eigen::Matrix<S, nx, 1>(d.template head<nx>()));
  };
  const auto u_of = [&](const Vector& d) -> Eigen::Matrix<S, nu, 1> {
    return lift<S>(u) + d.template tail<nu>();
  };

  typename D::A A;
  typename D::B B;
  const auto end = problem.step(k, x, u, A, B);
  EXPECT_LT(problem.difference(end, problem.step(k, x, u)).norm(), 1e-13);
  const auto by_both = test_support::jacobian_at_zero<nx, nx + nu>([&](const Vector& d) {
    return problem.template between<S>(problem.template flow<S>(k, x_of(d), u_of(d)), lift<S>(end));
  });
  expect_equal(A, by_both.template leftCols<nx>());
  expect_equal(B, by_both.template rightCols<nu>());

  const auto residual = test_support::jacobian_at_zero<nr, nx + nu>(
      [&](const Vector& d) { return problem.template residual<S>(k, x_of(d), u_of(d)); });
  Eigen::Matrix<double, nr, nx> by_state;
  Eigen::Matrix<double, nr, nu> by_input;
  problem.residual_derivatives(k, x, u, by_state, by_input);
  expect_equal(by_state, residual.template leftCols<nx>());
  expect_equal(by_input, residual.template rightCols<nu>());

  const auto rows = test_support::jacobian_at_zero<nc, nx + nu>(
      [&](const Vector& d) { return problem.template constraints_of<S>(k, x_of(d), u_of(d)); });
  typename D::ConstraintsX C = D::ConstraintsX::Zero();
  typename D::ConstraintsU E = D::ConstraintsU::Zero();
  problem.constraint_derivatives(k, x, u, C, E);
  expect_equal(C, rows.template leftCols<nx>());
  expect_equal(E, rows.template rightCols<nu>());

  if constexpr (ne > 0) {
    const auto equalities = test_support::jacobian_at_zero<ne, nx + nu>(
        [&](const Vector& d) { return problem.template equalities_of<S>(k, x_of(d)); });
    typename D::EqualitiesX H;
    problem.equality_derivatives(k, x, H);
    expect_equal(H, equalities.template leftCols<nx>());
  }
}

Quadrotor::State random_body(Random& random) {
  Quadrotor::State x;
  x.position = random.vector(2.0);
  x.velocity = random.vector(2.0);
  x.orientation = random.orientation();
  x.angular_velocity = random.vector(4.0);
  return x;
}

TEST(ProblemDerivatives, AreExact) {
  Random random(71);
  for (int i = 0; i < test_support::quick_or_full(200, 10000); ++i) {
    const int k = i % 2 == 0 ? 1 : 5;
    const Eigen::Vector3d x = random.vector(3.0), u = random.vector(3.0);
    expect_exact_derivatives(Pendulum({5}), k, x.head<2>(), u.head<1>());
    expect_exact_derivatives(Unicycle({5}), k, x, u.head<2>());
    expect_exact_derivatives(DoubleIntegrator({5}), k, x.head<2>(), u.head<1>());
    expect_exact_derivatives(Contradiction({5}), k, x.head<1>(), u.head<1>());
    expect_exact_derivatives(Quadrotor({5}), k, random_body(random),
                             Eigen::Vector4d(u(0), u(1), u(2), random.uniform(0.0, 4.0)));
  }
}

TEST(ProblemDerivatives, DeclaredTransitionPatternMatchesTheDerivatives) {
  using Pattern = WheeledFlightProblem<0>::TransitionPattern;
  Random random(73);
  auto problem = test_support::step_problem();
  Eigen::Matrix<double, 18, 24> seen = Eigen::Matrix<double, 18, 24>::Zero();
  for (int i = 0; i < 100; ++i) {
    WheeledFlightNode& node = problem.node(0);
    node.external = {random.vector(3.0), random.vector(0.3)};
    node.freedom = {};
    if (i % 2 == 0)
      node.freedom.linear << random.vector(1.0), random.vector(1.0), random.vector(1.0);
    node.freedom.angular(0, 0) = i % 3 == 0 ? 0.0 : 1.0;
    WheeledFlightProblem<0>::D::A A;
    WheeledFlightProblem<0>::D::B B;
    WheeledFlightProblem<0>::D::Input u;
    u << random.vector(5.0), random.vector(1.0);
    (void)problem.step(0, test_support::random_state(random), u, A, B);
    Eigen::Matrix<double, 18, 24> both;
    both << A, B;
    seen += both.cwiseAbs();
  }
  for (int row = 0; row < 18; ++row)
    for (int column = 0; column < 24; ++column)
      EXPECT_EQ(seen(row, column) != 0.0, Pattern::nonzero(row, column)) << row << ' ' << column;
}

TEST(ProblemDerivatives, RetractionsHaveExactDerivatives) {
  Random random(72);
  using S = Dual<18>;
  for (int i = 0; i < test_support::quick_or_full(200, 10000); ++i) {
    Stated x;
    x.body = random_body(random);
    StateTangentd dx = StateTangentd::Random();
    dx.segment<3>(TangentIndex::orientation) = random.vector(1.7);
    if (i % 10 == 0) dx.segment<3>(TangentIndex::orientation) *= 1e-6;
    const Stated end = retract(x, dx);
    const auto pack_body = [](const Stated& y) {
      return State<S>{{lift<S>(y.wrench.force), lift<S>(y.wrench.torque)}, lift<S>(y.body)};
    };
    const auto truth =
        test_support::jacobian_at_zero<18, 18>([&](const Eigen::Matrix<S, 18, 1>& e) {
          return difference<S>(retract<S>(pack_body(x), StateTangent<S>(lift<S>(dx) + e)),
                               pack_body(end));
        });
    expect_equal(test_support::step_problem().retract_derivative(x, dx), truth);
    expect_equal(Quadrotor({5}).retract_derivative(x.body, dx.tail<12>()),
                 Eigen::Matrix<double, 12, 12>(truth.bottomRightCorner<12, 12>()));
  }
}

TEST(ProblemDerivatives, PassTheCheckForUsers) {
  Random random(91);
  for (int i = 0; i < test_support::quick_or_full(20, 1000); ++i) {
    const Eigen::Vector3d x = random.vector(3.0), u = random.vector(3.0);
    const auto expect_none = [](const auto& errors) { EXPECT_EQ(sentences(errors), ""); };
    expect_none(check_derivatives(Pendulum({5}), x.head<2>(), u.head<1>()));
    expect_none(check_derivatives(Unicycle({5}), x, u.head<2>()));
    expect_none(check_derivatives(DoubleIntegrator({5}), x.head<2>(), u.head<1>()));
    expect_none(check_derivatives(Contradiction({5}), x.head<1>(), u.head<1>()));
    Quadrotor::State body = random_state(random).body;
    expect_none(check_derivatives(Quadrotor({5}), body,
                                  Eigen::Vector4d(u(0), u(1), u(2), random.uniform(0.1, 4.0))));
  }
}

}  // namespace problem_derivatives_test
}  // namespace tilt_ropter::optimal_control
