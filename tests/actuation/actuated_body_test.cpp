#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/model/rigid_body.hpp>

#include "support/autodiff.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/states.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace actuated_body_test {

using test_support::Dual;
using test_support::Random;

template <int Rotors>
ActuatedState<Rotors> random_actuated(Random& random) {
  ActuatedState<Rotors> x;
  x.body = test_support::random_state(random).body;
  for (int i = 0; i < Rotors; ++i) {
    x.thrust(i) = random.uniform(0.0, 12.0);
    x.tilt_angle(i) = random.uniform(-3.0, 3.0);
  }
  return x;
}

template <int Rotors>
Eigen::Matrix<double, 2 * Rotors, 1> random_rates(Random& random) {
  Eigen::Matrix<double, 2 * Rotors, 1> u;
  for (int i = 0; i < Rotors; ++i) {
    u(i) = random.uniform(-40.0, 40.0);
    u(Rotors + i) = random.uniform(-8.0, 8.0);
  }
  return u;
}

Freedomd random_freedom(Random& random) {
  Freedomd freedom;
  const Eigen::Vector3d normal = random.vector(1.0).normalized();
  freedom.linear -= normal * normal.transpose();
  freedom.angular << random.vector(1.0), random.vector(1.0), random.vector(1.0);
  return freedom;
}

template <int Rotors, typename Scalar>
ActuatedState<Rotors, Scalar> cast(const ActuatedState<Rotors>& x) {
  State<double> body;
  body.body = x.body;
  return {x.thrust.template cast<Scalar>(), x.tilt_angle.template cast<Scalar>(),
          test_support::cast<Scalar>(body).body};
}

// One servo is stuck, one rotor is lost.
Vehicle<4> damaged() {
  return with_weak_rotor(with_stuck_servo(tilt_ropter_vehicle(), 0, 0.4), 2, 0.0);
}

TEST(ActuatedBody, WrenchIsTheAllocationMatrixTimesTheThrusts) {
  Random random(1);
  for (const Vehicle<4>& vehicle :
       {tilt_ropter_vehicle(), with_stuck_servo(tilt_ropter_vehicle(), 1, -0.7)}) {
    const AllocationMatrix<4> allocation(vehicle);
    const ActuatedBody<4> body(vehicle);
    for (int i = 0; i < 100; ++i) {
      ActuatedState<4> x = random_actuated<4>(random);
      Eigen::Matrix<double, 8, 1> thrusts;
      for (int n = 0; n < 4; ++n) {
        if (!vehicle.rotors[static_cast<std::size_t>(n)].tilts) x.tilt_angle(n) = 0.0;
        thrusts(2 * n) = x.thrust(n) * std::sin(x.tilt_angle(n));
        thrusts(2 * n + 1) = x.thrust(n) * std::cos(x.tilt_angle(n));
      }
      Eigen::Matrix<double, 6, 1> wrench;
      wrench << body.wrench(x).force, body.wrench(x).torque;
      EXPECT_LT((wrench - allocation.matrix * thrusts).norm(), 1e-12 * (1.0 + wrench.norm()));
    }
  }
}

TEST(ActuatedBody, StepsLikeRigidBodyWhileTheWrenchIsLinearInTime) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const ActuatedBody<4> body(vehicle);
  const RigidBodyd rigid(vehicle.body);
  Random random(2);
  for (int i = 0; i < 200; ++i) {
    const ActuatedState<4> x = random_actuated<4>(random);
    Eigen::Matrix<double, 8, 1> u = random_rates<4>(random);
    u.tail<4>().setZero();  // without tilt rates the wrench is linear in time
    const Wrenchd external{random.vector(3.0), random.vector(0.3)};
    const Freedomd freedom = i % 2 == 0 ? Freedomd() : random_freedom(random);
    const double dt = random.uniform(0.01, 0.1);
    ActuatedState<4> pushed = x;
    pushed.thrust = u.head<4>();
    Eigen::Matrix<double, 6, 1> rate;
    rate << body.wrench(pushed).force, body.wrench(pushed).torque;
    const Stated truth = rigid.step({body.wrench(x), x.body}, rate, external, dt, freedom);
    const ActuatedState<4> end = body.step(x, u, external, dt, freedom);
    ActuatedTangent<4> off = ActuatedTangent<4>::Zero();
    detail::subtract_body(end.body, truth.body, off, 8);
    EXPECT_LT(off.norm(), 1e-11);
    EXPECT_LT((end.thrust - x.thrust - dt * u.head<4>()).norm(), 1e-12);
    EXPECT_EQ(end.tilt_angle, x.tilt_angle);
  }
}

TEST(ActuatedBody, ManyShortStepsAgreeWithOneStep) {
  const ActuatedBody<4> body(tilt_ropter_vehicle());
  Random random(3);
  double worst = 0.0;
  for (int i = 0; i < 20; ++i) {
    ActuatedState<4> x = random_actuated<4>(random);
    x.body.angular_velocity *= 0.2;
    Eigen::Matrix<double, 8, 1> u = 0.1 * random_rates<4>(random);
    const ActuatedState<4> one = body.step(x, u, {}, 0.02);
    for (int n = 0; n < 20; ++n) x = body.step(x, u, {}, 0.001);
    worst = std::max(worst, difference(one, x).norm());
  }
  EXPECT_LT(worst, 1e-3);
}

template <int Rotors>
double worst_derivative_error(const Vehicle<Rotors>& vehicle, unsigned seed) {
  constexpr int nx = 2 * Rotors + 12, nu = 2 * Rotors, all = nx + nu;
  using S = Dual<all>;
  const ActuatedBody<Rotors> body(vehicle);
  const ActuatedBody<Rotors, S> dual(vehicle);
  Random random(seed);
  double worst = 0.0;
  for (int i = 0; i < test_support::quick_or_full(30, 10000); ++i) {
    const ActuatedState<Rotors> x = random_actuated<Rotors>(random);
    const auto u = random_rates<Rotors>(random);
    const Wrenchd external{random.vector(3.0), random.vector(0.3)};
    const Freedomd freedom = i % 2 == 0 ? Freedomd() : random_freedom(random);
    const Steeringd steering = i % 3 == 0 ? Steeringd() : Steeringd{random.vector(2.0), 0.3};
    const double dt = random.uniform(0.01, 0.1);
    typename ActuatedBody<Rotors>::StateJacobian A;
    typename ActuatedBody<Rotors>::InputJacobian B;
    const ActuatedState<Rotors> end = body.step(x, u, external, dt, freedom, A, B, steering);
    EXPECT_LT(difference(end, body.step(x, u, external, dt, freedom, steering)).norm(), 1e-12);
    const Eigen::Matrix<double, nx, all> truth = test_support::jacobian_at_zero<nx, all>(
        [&](const Eigen::Matrix<S, all, 1>& d) -> Eigen::Matrix<S, nx, 1> {
          const ActuatedTangent<Rotors, S> dx = d.template head<nx>();
          const ActuatedState<Rotors, S> moved = retract(cast<Rotors, S>(x), dx);
          const Eigen::Matrix<S, nu, 1> input = u.template cast<S>() + d.template tail<nu>();
          const Wrench<S> outside{external.force.cast<S>(), external.torque.cast<S>()};
          const Freedom<S> free{freedom.linear.cast<S>(), freedom.angular.cast<S>()};
          const Steering<S> steers{steering.speed.cast<S>(), S(steering.side)};
          return difference(dual.step(moved, input, outside, S(dt), free, steers),
                            cast<Rotors, S>(end));
        });
    Eigen::Matrix<double, nx, all> given;
    given << A, B;
    worst = std::max(worst, (given - truth).cwiseAbs().maxCoeff() / truth.cwiseAbs().maxCoeff());
  }
  return worst;
}

TEST(ActuatedBody, DerivativesEqualAutomaticDifferentiation) {
  EXPECT_LT(worst_derivative_error(tilt_ropter_vehicle(), 4), 1e-12);
  EXPECT_LT(worst_derivative_error(damaged(), 5), 1e-12);
  EXPECT_LT(worst_derivative_error(test_support::tilting_hexacopter(), 6), 1e-12);
}

// A vehicle drives at 1 m/s and turns at 1.2 rad/s. Without a force of the rotors it drives a
// circle. A force of the rotors along the axle has no effect.
TEST(ActuatedBody, SteeredWheelsRollAlongTheHeading) {
  const ActuatedBody<4> body(tilt_ropter_vehicle());
  ActuatedState<4> x;
  x.body.velocity.x() = 1.0;
  x.body.angular_velocity.z() = 1.2;
  Freedomd freedom;
  freedom.linear(2, 2) = 0.0;
  freedom.angular(0, 0) = 0.0;
  Steeringd steering;
  steering.speed.z() = 1.0;
  const auto side_slip = [](const ActuatedState<4>& s) {
    return (s.body.orientation.conjugate() * s.body.velocity).y();
  };
  const Eigen::Matrix<double, 8, 1> none = Eigen::Matrix<double, 8, 1>::Zero();
  for (int k = 0; k < 20; ++k) x = body.step(x, none, {}, 0.1, freedom, steering);
  EXPECT_NEAR(side_slip(x), 0.0, 1e-5);
  EXPECT_NEAR(x.body.velocity.norm(), 1.0, 1e-5);
  EXPECT_NEAR((x.body.position - Eigen::Vector3d(0.0, 1.0 / 1.2, 0.0)).norm(), 1.0 / 1.2, 1e-5);
  x.thrust << 0.0, 0.0, 1.0, 1.0;  // front and rear push to the right
  x.tilt_angle << 0.0, 0.0, 0.5 * pi, -0.5 * pi;
  const auto pushed = [&](double side) {
    steering.side = side;
    return side_slip(body.step(x, none, {}, 0.1, freedom, steering));
  };
  EXPECT_LT(pushed(1.0), -0.1);
  EXPECT_NEAR(pushed(0.0), 0.0, 1e-5);
}

TEST(ActuatedBody, LanesGiveTheSameAsDouble) {
  const ActuatedBody<4> body(damaged());
  const ActuatedBody<4, Lanes> four(damaged());
  Random random(7);
  ActuatedState<4> x[4];
  Eigen::Matrix<double, 8, 1> u[4];
  for (int i = 0; i < 4; ++i) {
    x[i] = random_actuated<4>(random);
    u[i] = random_rates<4>(random);
  }
  ActuatedState<4, Lanes> start;
  ActuatedBody<4, Lanes>::Input rates;
  const auto gather_all = [](auto& lanes, const auto& of) {
    for (Eigen::Index j = 0; j < lanes.size(); ++j)
      lanes(j) = gather([&](int i) { return of(i)(j); });
  };
  gather_all(start.thrust, [&](int i) { return x[i].thrust; });
  gather_all(start.tilt_angle, [&](int i) { return x[i].tilt_angle; });
  gather_all(start.body.position, [&](int i) { return x[i].body.position; });
  gather_all(start.body.velocity, [&](int i) { return x[i].body.velocity; });
  gather_all(start.body.orientation.coeffs(),
             [&](int i) -> Eigen::Vector4d { return x[i].body.orientation.coeffs(); });
  gather_all(start.body.angular_velocity, [&](int i) { return x[i].body.angular_velocity; });
  gather_all(rates, [&](int i) { return u[i]; });
  ActuatedBody<4, Lanes>::StateJacobian A;
  ActuatedBody<4, Lanes>::InputJacobian B;
  const Steeringd steering{random.vector(2.0), 0.3};
  const auto all = [](double number) { return Lanes(number); };
  (void)four.step(start, rates, {}, Lanes(0.1), {}, A, B,
                  {{all(steering.speed.x()), all(steering.speed.y()), all(steering.speed.z())},
                   all(steering.side)});
  for (int i = 0; i < 4; ++i) {
    ActuatedBody<4>::StateJacobian A_of;
    ActuatedBody<4>::InputJacobian B_of;
    (void)body.step(x[i], u[i], {}, 0.1, {}, A_of, B_of, steering);
    for (Eigen::Index j = 0; j < A.size(); ++j) EXPECT_NEAR(A(j)[i], A_of(j), 1e-12);
    for (Eigen::Index j = 0; j < B.size(); ++j) EXPECT_NEAR(B(j)[i], B_of(j), 1e-12);
  }
}

}  // namespace actuated_body_test
}  // namespace tilt_ropter
