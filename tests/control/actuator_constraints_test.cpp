#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/detail/actuator_constraints.hpp>
#include <tilt_ropter/math/detail/finite.hpp>

#include "support/autodiff.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Eigenvalues>

#include <algorithm>
#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace actuator_constraints_test {

using test_support::Dual;
using test_support::Random;
using Vector6 = Eigen::Matrix<double, 6, 1>;

Vector6 random_wrench(Random& random, double force, double torque) {
  Vector6 w;
  w << random.vector(force), random.vector(torque);
  return w;
}

Wrenchd unpacked(const Vector6& w) {
  return {w.head<3>(), w.tail<3>()};
}

// The constraints written out as in the class comment, for automatic differentiation.
template <int Rotors, typename S>
Eigen::Matrix<S, 3 * Rotors, 1> written_out(const Vehicle<Rotors>& vehicle,
                                            const Eigen::Matrix<S, 12, 1>& wrench_and_rate) {
  using std::sqrt;
  constexpr double hold_thrust = ActuatorConstraints<Rotors>::hold_thrust;
  const AllocationMatrix<Rotors> allocation(vehicle);
  const Eigen::Matrix<S, 2 * Rotors, 1> T =
      allocation.pseudoinverse.template cast<S>() * wrench_and_rate.template head<6>();
  const Eigen::Matrix<S, 2 * Rotors, 1> dT =
      allocation.pseudoinverse.template cast<S>() * wrench_and_rate.template tail<6>();
  const double hover = vehicle.body.mass * gravity / Rotors;
  Eigen::Matrix<S, 3 * Rotors, 1> constraints = Eigen::Matrix<S, 3 * Rotors, 1>::Zero();
  for (int i = 0; i < Rotors; ++i) {
    const S square = T(2 * i) * T(2 * i) + T(2 * i + 1) * T(2 * i + 1);
    const S cross = dT(2 * i) * T(2 * i + 1) - T(2 * i) * dT(2 * i + 1);
    const double least = hold_thrust * hold_thrust;
    if (vehicle.rotors[static_cast<std::size_t>(i)].tilts) {
      const S allowed = S(NmpcBounds().tilt_rate_fraction * vehicle.servo.max_rate) *
                        (square > S(least) ? square : S(least));
      constraints(i) = (cross - allowed) / S(hover * hover);
      constraints(Rotors + i) = (-cross - allowed) / S(hover * hover);
    }
    if (square > S(0)) constraints(2 * Rotors + i) = sqrt(square);
  }
  return constraints;
}

/// Largest relative error of the values and derivatives.
template <int Rotors>
double error(const Vehicle<Rotors>& vehicle, const Vector6& wrench, const Vector6& rate) {
  const ActuatorConstraints<Rotors> constraints(vehicle);
  Eigen::Matrix<double, 12, 1> at;
  at << wrench, rate;
  using S = Dual<12>;
  const auto truth = test_support::jacobian_at_zero<3 * Rotors, 12>(
      [&](const Eigen::Matrix<S, 12, 1>& d) -> Eigen::Matrix<S, 3 * Rotors, 1> {
        return written_out<Rotors, S>(vehicle, d + at.cast<S>());
      });
  using Jacobian = Eigen::Matrix<double, 3 * Rotors, 6>;
  Jacobian by_wrench = Jacobian::Zero(), by_rate = Jacobian::Zero();
  constraints.derivatives(wrench, rate, by_wrench, by_rate);
  const auto values = written_out<Rotors, double>(vehicle, at);
  const double size = 1.0 + truth.cwiseAbs().maxCoeff();
  return std::max({(by_wrench - truth.template leftCols<6>()).cwiseAbs().maxCoeff() / size,
                   (by_rate - truth.template rightCols<6>()).cwiseAbs().maxCoeff() / size,
                   (constraints.values(wrench, rate) - values).cwiseAbs().maxCoeff() /
                       (1.0 + values.cwiseAbs().maxCoeff())});
}

TEST(ActuatorConstraints, DerivativesAreExact) {
  Random random(51);
  double worst = 0.0;
  for (int i = 0; i < test_support::quick_or_full(500, 10000); ++i) {
    // Thrusts from far below hold_thrust to far above max_thrust.
    const double size = std::pow(10.0, random.uniform(-4.0, 2.0));
    const Vector6 wrench = random_wrench(random, size, 0.1 * size);
    const Vector6 rate = random_wrench(random, 40.0, 4.0);
    worst = std::max({worst, error(tilt_ropter_vehicle(), wrench, rate),
                      error(test_support::tilting_hexacopter(), wrench, rate),
                      error(test_support::omnidirectional_octocopter(), wrench, rate)});
  }
  test_support::check_at_most(7, "actuator constraints: derivatives' relative error", worst, 1e-12);
}

// Second derivatives of the thrusts by differences of the first.
template <int Rotors>
void expect_exact_curvature(const Vehicle<Rotors>& vehicle, const Vector6& wrench, Random& random) {
  const ActuatorConstraints<Rotors> constraints(vehicle);
  using Values = typename ActuatorConstraints<Rotors>::Values;
  using Jacobian = Eigen::Matrix<double, 3 * Rotors, 6>;
  Values multipliers = Values::Zero();
  for (int i = 0; i < 3 * Rotors; ++i) multipliers(i) = random.uniform(-10.0, 10.0);
  Values that_count = multipliers.cwiseMax(0.0);
  that_count.template head<2 * Rotors>().setZero();
  const auto gradient = [&](const Vector6& at) -> Vector6 {
    Jacobian by_wrench = Jacobian::Zero(), by_rate = Jacobian::Zero();
    constraints.derivatives(at, Vector6::Zero(), by_wrench, by_rate);
    return by_wrench.transpose() * that_count;
  };
  using Square = Eigen::Matrix<double, 6, 6>;
  Square expected;
  const double step = 1e-6 * wrench.norm();
  for (int j = 0; j < 6; ++j)
    expected.col(j) =
        (gradient(wrench + step * Vector6::Unit(j)) - gradient(wrench - step * Vector6::Unit(j))) /
        (2.0 * step);
  Square curvature = Square::Ones();  // is added to what is there
  constraints.add_curvature(wrench, multipliers, curvature);
  curvature -= Square::Ones();
  EXPECT_LT((curvature - expected).norm(), 1e-5 * (1.0 + expected.norm()));
  EXPECT_GT(Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(curvature).eigenvalues().minCoeff(),
            -1e-12 * (1.0 + curvature.norm()));
}

TEST(ActuatorConstraints, CurvatureOfThrustLimitsIsExact) {
  Random random(57);
  for (int i = 0; i < 200; ++i) {
    const double size = std::pow(10.0, random.uniform(0.5, 2.0));
    const Vector6 wrench = random_wrench(random, size, 0.1 * size);
    expect_exact_curvature(tilt_ropter_vehicle(), wrench, random);
    expect_exact_curvature(test_support::tilting_hexacopter(), wrench, random);
    expect_exact_curvature(test_support::omnidirectional_octocopter(), wrench, random);
  }
}

TEST(ActuatorConstraints, CurvatureIsFiniteAtAnyThrust) {
  Random random(58);
  const ActuatorConstraints<4> constraints(tilt_ropter_vehicle());
  const Eigen::Matrix<double, 12, 1> penalties = Eigen::Matrix<double, 12, 1>::Constant(1e4);
  const double least = ActuatorConstraints<4>::hold_thrust;
  for (const double size : {0.0, 1e-170, 1e-150, 1e-12, 1e-3, 1.0, 1e6}) {
    Eigen::Matrix<double, 6, 6> curvature = Eigen::Matrix<double, 6, 6>::Zero();
    constraints.add_curvature(random_wrench(random, size, 0.1 * size), penalties, curvature);
    EXPECT_TRUE(all_finite(curvature)) << size;
    EXPECT_LT(curvature.norm(), 4 * 1e4 * 1e3 / least) << size;
  }
  Eigen::Matrix<double, 6, 6> nothing = Eigen::Matrix<double, 6, 6>::Zero();
  ActuatorConstraints<4>().add_curvature(Vector6::Ones(), penalties, nothing);
  EXPECT_EQ(nothing.norm(), 0.0);
}

TEST(ActuatorConstraints, ZeroThrustHasFiniteSatisfiedConstraintsAndDerivatives) {
  Random random(52);
  const ActuatorConstraints<4> constraints(tilt_ropter_vehicle());
  for (int i = 0; i < 100; ++i) {
    const Vector6 rate = random_wrench(random, 1000.0, 100.0);
    EXPECT_LT(error(tilt_ropter_vehicle(), Vector6::Zero(), rate), 1e-12);
    EXPECT_TRUE(
        (constraints.values(Vector6::Zero(), rate).array() <= constraints.upper().array()).all());
    // The squares of these thrusts underflow to zero.
    EXPECT_LT(error(tilt_ropter_vehicle(), 1e-170 * rate, rate), 1e-12);
  }
}

TEST(ActuatorConstraints, TiltRateConstraintsAgreeWithTiltRatesOfAllocation) {
  Random random(53);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation<4> allocation(vehicle);
  const ActuatorConstraints<4> constraints(vehicle);
  const double limit = NmpcBounds().tilt_rate_fraction * vehicle.servo.max_rate;
  int held = 0, broken = 0;
  for (int i = 0; i < 5000; ++i) {
    const double size = std::pow(10.0, random.uniform(-3.0, 1.5));
    const Vector6 wrench = random_wrench(random, size, 0.1 * size);
    const Vector6 rate = random_wrench(random, 12.0 * size, 1.2 * size);
    const Eigen::Vector4d rates = allocation.rates(unpacked(wrench), unpacked(rate)).tilt_rate;
    const auto values = constraints.values(wrench, rate);
    for (int r = 0; r < 4; ++r) {
      if (std::abs(std::abs(rates(r)) - limit) < 1e-9 * limit) continue;
      EXPECT_EQ(values(r) <= 0.0, rates(r) <= limit) << rates(r);
      EXPECT_EQ(values(4 + r) <= 0.0, rates(r) >= -limit) << rates(r);
      ++(std::abs(rates(r)) <= limit ? held : broken);
    }
  }
  EXPECT_GT(held, 2000);
  EXPECT_GT(broken, 2000);
}

TEST(ActuatorConstraints, InHoverTheValueIsTheTiltRateMinusTheLimit) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation<4> allocation(vehicle);
  Vector6 wrench, rate;
  wrench << 0.0, 0.0, vehicle.body.mass * gravity, 0.0, 0.0, 0.0;
  rate << 0.0, 0.0, 0.0, 0.0, 0.0, 4.0;
  const auto values = ActuatorConstraints<4>(vehicle).values(wrench, rate);
  const Eigen::Vector4d rates = allocation.rates(unpacked(wrench), unpacked(rate)).tilt_rate;
  EXPECT_LT(
      (values.head<4>().array() - (rates.array() - 0.85 * vehicle.servo.max_rate)).matrix().norm(),
      1e-12);
  EXPECT_GT(rates.cwiseAbs().minCoeff(), 1.0);
}

TEST(ActuatorConstraints, ThrustConstraintsAgreeWithStatusOfAllocation) {
  Random random(54);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation<4> allocation(vehicle);
  const ActuatorConstraints<4> constraints(vehicle);
  int within = 0, beyond = 0;
  for (int i = 0; i < 2000; ++i) {
    const Vector6 wrench = random_wrench(random, 30.0, 2.0);
    const Eigen::Vector4d thrusts = constraints.values(wrench, Vector6::Zero()).tail<4>();
    const auto result = allocation.allocate(unpacked(wrench), ActuatorState<4>{});
    const bool ok = (thrusts.array() <= constraints.upper().tail<4>().array()).all();
    EXPECT_EQ(ok, result.status == AllocationStatus::ok) << thrusts.transpose();
    ++(ok ? within : beyond);
    if (!ok) continue;
    for (int r = 0; r < 4; ++r)
      EXPECT_NEAR(thrusts(r), thrust_from_speed(result.command.rotor_speed(r), vehicle.rotor),
                  1e-9);
  }
  EXPECT_GT(within, 300);
  EXPECT_GT(beyond, 300);
}

TEST(ActuatorConstraints, FixedRotorsHaveOnlyTheThrustConstraint) {
  const Vehicle<8> vehicle = test_support::omnidirectional_octocopter();
  const ActuatorConstraints<8> constraints(vehicle);
  EXPECT_TRUE(
      (constraints.upper().head<16>().array() == std::numeric_limits<double>::infinity()).all());
  EXPECT_TRUE((constraints.upper().tail<8>().array() == vehicle.rotor.max_thrust).all());
}

TEST(ActuatorConstraints, WeakRotorHasLowerThrustLimitAndLostRotorNoConstraint) {
  const auto vehicle = with_weak_rotor(with_weak_rotor(tilt_ropter_vehicle(), 1, 0.5), 2, 0.0);
  const ActuatorConstraints<4> constraints(vehicle);
  const double infinity = std::numeric_limits<double>::infinity();
  EXPECT_EQ(Eigen::Vector4d(constraints.upper().head<4>()),
            Eigen::Vector4d(0.0, 0.0, infinity, 0.0));
  EXPECT_EQ(Eigen::Vector4d(constraints.upper().segment<4>(4)),
            Eigen::Vector4d(0.0, 0.0, infinity, 0.0));
  EXPECT_EQ(Eigen::Vector4d(constraints.upper().tail<4>()),
            Eigen::Vector4d(12.0, 6.0, infinity, 12.0));
  EXPECT_EQ(constraints.values(Vector6::Ones(), Vector6::Ones())(10), 0.0);
}

TEST(ActuatorConstraints, DefaultConstructedHasNoBounds) {
  const ActuatorConstraints<4> constraints;
  EXPECT_TRUE((constraints.upper().array() == std::numeric_limits<double>::infinity()).all());
  EXPECT_EQ(constraints.values(Vector6::Ones(), Vector6::Ones()),
            ActuatorConstraints<4>::Values::Zero());
  Eigen::Matrix<double, 12, 6> by_wrench = Eigen::Matrix<double, 12, 6>::Constant(3.0),
                               by_rate = by_wrench;
  constraints.derivatives(Vector6::Ones(), Vector6::Ones(), by_wrench, by_rate);
  EXPECT_TRUE((by_wrench.array() == 3.0).all());
  EXPECT_TRUE((by_rate.array() == 3.0).all());
}

TEST(ActuatorConstraints, TiltRateFractionTakesEffect) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Vector6 wrench, rate;
  wrench << 0.0, 0.0, vehicle.body.mass * gravity, 0.0, 0.0, 0.0;
  rate << 0.0, 0.0, 0.0, 0.0, 0.0, 4.0;
  const double usual = ActuatorConstraints<4>(vehicle).values(wrench, rate)(0);
  for (const auto& half :
       {ActuatorConstraints<4>(vehicle, 0.5), ActuatorConstraints<4>(vehicle).with(0.5)})
    EXPECT_NEAR(half.values(wrench, rate)(0) - usual, 0.35 * vehicle.servo.max_rate, 1e-12);
}

}  // namespace actuator_constraints_test
}  // namespace tilt_ropter
