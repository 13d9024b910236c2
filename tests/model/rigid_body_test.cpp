#include <tilt_ropter/model/rigid_body.hpp>

#include "support/autodiff.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"
#include "support/states.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

namespace tilt_ropter {
namespace rigid_body_test {

using test_support::cast;
using test_support::Dual;
using test_support::Random;
using test_support::random_state;

RigidBodyParameters lopsided_body() {
  RigidBodyParameters body;
  body.mass = 1.5;
  body.inertia << 0.0137, 0.0004, -0.0007, 0.0004, 0.0143, 0.0003, -0.0007, 0.0003, 0.0246;
  return body;
}

// An independent second model: spatial equation of motion in body coordinates, with a rotation
// matrix instead of a quaternion, integrated by many small steps.
Stated spatial_reference(const RigidBodyParameters& p, Stated x,
                         const Eigen::Matrix<double, 6, 1>& u, const Wrenchd& external,
                         double duration) {
  const int steps = 4000;
  const double dt = duration / steps;
  Eigen::Matrix3d R = x.body.orientation.toRotationMatrix();
  Eigen::Vector3d nu = R.transpose() * x.body.velocity;  // body-frame velocity
  for (int i = 0; i < steps; ++i) {
    const double t = (i + 0.5) * dt;
    const Eigen::Vector3d force = x.wrench.force + t * u.head<3>() + external.force;
    const Eigen::Vector3d torque = x.wrench.torque + t * u.tail<3>() + external.torque;
    const auto rates = [&](const Eigen::Matrix3d& rotation, const Eigen::Vector3d& v,
                           const Eigen::Vector3d& w) {
      const Eigen::Vector3d g = rotation.transpose() * Eigen::Vector3d(0, 0, -gravity);
      return std::make_pair(
          Eigen::Vector3d(force / p.mass + g - w.cross(v)),
          Eigen::Vector3d(p.inertia.ldlt().solve(torque - w.cross(p.inertia * w))));
    };
    Eigen::Vector3d& w = x.body.angular_velocity;
    const auto [a1, b1] = rates(R, nu, w);  // midpoint rule
    const Eigen::Vector3d w_mid = w + dt / 2 * b1, nu_mid = nu + dt / 2 * a1;
    const Eigen::Matrix3d R_mid =
        R * Eigen::AngleAxisd(dt / 2 * w.norm(), w.normalized()).toRotationMatrix();
    const auto [a2, b2] = rates(R_mid, nu_mid, w_mid);
    x.body.position += dt * R_mid * nu_mid;
    R = R * Eigen::AngleAxisd(dt * w_mid.norm(), w_mid.normalized()).toRotationMatrix();
    nu += dt * a2;
    w += dt * b2;
  }
  x.wrench.force += duration * u.head<3>();
  x.wrench.torque += duration * u.tail<3>();
  x.body.velocity = R * nu;
  x.body.orientation = Eigen::Quaterniond(R);
  return x;
}

/// Returns the largest entry of sensitivity minus automatic derivative, relative to the largest
/// derivative plus one.
double sensitivity_error(const Stated& x, const Eigen::Matrix<double, 6, 1>& u,
                         const Wrenchd& external, const Freedomd& freedom, double dt) {
  const RigidBodyParameters parameters = lopsided_body();
  RigidBodyd::StateJacobian A;
  RigidBodyd::InputJacobian B;
  const Stated next = RigidBodyd(parameters).step(x, u, external, dt, freedom, A, B);

  using D = Dual<24>;
  const Eigen::Matrix<double, 18, 24> truth = test_support::jacobian_at_zero<18, 24>(
      [&](const Eigen::Matrix<D, 24, 1>& d) -> Eigen::Matrix<D, 18, 1> {
        const State<D> start = retract<D>(cast<D>(x), d.template head<18>());
        const Eigen::Matrix<D, 6, 1> input = u.cast<D>() + d.template tail<6>();
        Wrench<D> ext;
        ext.force = external.force.cast<D>();
        ext.torque = external.torque.cast<D>();
        Freedom<D> free;
        free.linear = freedom.linear.cast<D>();
        free.angular = freedom.angular.cast<D>();
        return difference<D>(RigidBody<D>(parameters).step(start, input, ext, D(dt), free),
                             cast<D>(next));
      });
  const double scale = 1.0 + truth.cwiseAbs().maxCoeff();
  return std::max((truth.leftCols<18>() - A).cwiseAbs().maxCoeff(),
                  (truth.rightCols<6>() - B).cwiseAbs().maxCoeff()) /
         scale;
}

TEST(RigidBody, SensitivityMatchesAutomaticDifferentiation) {
  Random random(1);
  const int states = test_support::quick_or_full(150, 10000);
  double worst = 0.0;
  for (int i = 0; i < states; ++i) {
    const Stated x = random_state(random);
    Eigen::Matrix<double, 6, 1> u;
    u << random.vector(20.0), random.vector(4.0);
    Freedomd freedom;
    if (i % 3 == 1) {
      freedom.linear << random.vector(1.0), random.vector(1.0), random.vector(1.0);
      freedom.angular << random.vector(1.0), random.vector(1.0), random.vector(1.0);
    }
    const Wrenchd external{random.vector(3.0), random.vector(0.3)};
    worst = std::max(worst, sensitivity_error(x, u, external, freedom, random.uniform(0.01, 0.1)));
  }
  test_support::check_at_most(7, "rigid body: derivative's relative error", worst, 1e-12);
}

TEST(RigidBody, SensitivityIsCorrectAtRestAndAtHalfTurns) {
  const Eigen::Matrix<double, 6, 1> none = Eigen::Matrix<double, 6, 1>::Zero();
  Stated x;
  EXPECT_LT(sensitivity_error(x, none, {}, {}, 0.1), 1e-12);
  for (const Eigen::Quaterniond& half_turn :
       {Eigen::Quaterniond(0, 1, 0, 0), Eigen::Quaterniond(0, 0, 1, 0),
        Eigen::Quaterniond(0, 0, 0, 1), Eigen::Quaterniond(-1, 0, 0, 0)}) {
    x.body.orientation = half_turn;
    EXPECT_LT(sensitivity_error(x, none, {}, {}, 0.1), 1e-12);
    x.body.angular_velocity = Eigen::Vector3d(1e-8, 0, 0);
    EXPECT_LT(sensitivity_error(x, none, {}, {}, 0.1), 1e-12);
  }
}

TEST(RigidBody, MatchesIndependentModelInBodyCoordinates) {
  Random random(2);
  const RigidBodyParameters parameters = lopsided_body();
  const RigidBodyd body(parameters);
  for (int i = 0; i < 20; ++i) {
    Stated x = random_state(random);
    x.body.angular_velocity /= 2.0;
    Eigen::Matrix<double, 6, 1> u;
    u << random.vector(5.0), random.vector(0.2);
    const Wrenchd external{random.vector(1.0), random.vector(0.1)};
    const double duration = 0.1;
    const Stated truth = spatial_reference(parameters, x, u, external, duration);
    Stated y = x;
    for (int k = 0; k < 20; ++k) y = body.step(y, u, external, duration / 20);
    EXPECT_LT(difference(y, truth).norm(), 2e-6);
  }
}

TEST(RigidBody, ConvergesWithOrderFour) {
  Random random(3);
  const RigidBodyd body(lopsided_body());
  const Stated x = random_state(random);
  Eigen::Matrix<double, 6, 1> u;
  u << random.vector(5.0), random.vector(0.5);
  const auto integrate = [&](int steps) {
    Stated y = x;
    for (int k = 0; k < steps; ++k) y = body.step(y, u, {}, 0.4 / steps);
    return y;
  };
  const Stated truth = integrate(4096);
  const double coarse = difference(integrate(16), truth).norm();
  const double fine = difference(integrate(32), truth).norm();
  EXPECT_NEAR(std::log2(coarse / fine), 4.0, 0.4);
}

TEST(RigidBody, FreeBodyKeepsEnergyAndAngularMomentum) {
  const RigidBodyParameters parameters = lopsided_body();
  const RigidBodyd body(parameters);
  Stated x;
  x.body.velocity = Eigen::Vector3d(0.3, -0.2, 0.0);
  x.body.angular_velocity = Eigen::Vector3d(1.0, 2.0, -0.5);
  const auto momentum = [&](const Stated& s) -> Eigen::Vector3d {
    return s.body.orientation * (parameters.inertia * s.body.angular_velocity);
  };
  const auto energy = [&](const Stated& s) {
    return 0.5 * s.body.angular_velocity.dot(parameters.inertia * s.body.angular_velocity);
  };
  const Eigen::Vector3d momentum_before = momentum(x);
  const double energy_before = energy(x);
  for (int i = 0; i < 60000; ++i) x = body.step(x, Eigen::Matrix<double, 6, 1>::Zero(), {}, 1e-3);
  EXPECT_LT((momentum(x) - momentum_before).norm(), 1e-9 * momentum_before.norm());
  EXPECT_NEAR(energy(x), energy_before, 1e-6 * energy_before);
  EXPECT_NEAR(x.body.velocity.x(), 0.3, 1e-12);
  EXPECT_NEAR(x.body.position.z(), -0.5 * gravity * 60.0 * 60.0, 1e-6);
}

TEST(RigidBody, ConstrainedDirectionsDoNotAccelerate) {
  Random random(4);
  const RigidBodyd body(lopsided_body());
  Stated x = random_state(random);
  x.body.angular_velocity.x() = 0.0;
  const Eigen::Vector3d normal = Eigen::Vector3d(-0.2, 0.1, 1.0).normalized();
  Freedomd wheels_down;
  wheels_down.linear -= normal * normal.transpose();
  wheels_down.angular(0, 0) = 0.0;
  const Stated next = body.step(x, Eigen::Matrix<double, 6, 1>::Ones(), {}, 0.1, wheels_down);
  const Eigen::Vector3d gained = next.body.velocity - x.body.velocity;
  EXPECT_NEAR(normal.dot(gained), 0.0, 1e-14);
  EXPECT_DOUBLE_EQ(next.body.angular_velocity.x(), 0.0);
  EXPECT_GT(std::abs(gained.x()), 1e-3);
}

TEST(RigidBody, RollsDownhillOnASlope) {
  const RigidBodyd body(lopsided_body());
  const double slope = 0.2, level = -gravity * slope / (1.0 + slope * slope);
  const Eigen::Vector3d normal = Eigen::Vector3d(-slope, 0.0, 1.0).normalized();
  Freedomd wheels_down;
  wheels_down.linear -= normal * normal.transpose();
  const Stated next = body.step({}, Eigen::Matrix<double, 6, 1>::Zero(), {}, 0.1, wheels_down);
  EXPECT_LT((next.body.velocity - 0.1 * level * Eigen::Vector3d(1.0, 0.0, slope)).norm(), 1e-14);
}

TEST(RigidBody, SmallStepFollowsTheEquationsOfMotion) {
  Random random(5);
  const RigidBodyd body(lopsided_body());
  const Stated x = random_state(random);
  const double dt = 1e-7;
  const Stated next = body.step(x, Eigen::Matrix<double, 6, 1>::Zero(), {}, dt);
  // The paper's Eqs. rb1-rb4, written in Eigen's own products.
  const Eigen::Vector3d& w = x.body.angular_velocity;
  const RigidBodyParameters p = lopsided_body();
  const Eigen::Vector3d acceleration =
      x.body.orientation.toRotationMatrix() * x.wrench.force / p.mass -
      Eigen::Vector3d(0.0, 0.0, gravity);
  const Eigen::Vector3d turn = p.inertia.inverse() * (x.wrench.torque - w.cross(p.inertia * w));
  const Eigen::Quaterniond spin(0.0, 0.5 * w.x(), 0.5 * w.y(), 0.5 * w.z());
  const Eigen::Quaterniond rate = x.body.orientation * spin;
  EXPECT_LT(((next.body.velocity - x.body.velocity) / dt - acceleration).norm(), 1e-5);
  EXPECT_LT(((next.body.position - x.body.position) / dt - x.body.velocity).norm(), 1e-5);
  EXPECT_LT(((next.body.angular_velocity - w) / dt - turn).norm(), 1e-3);
  EXPECT_LT(
      ((next.body.orientation.coeffs() - x.body.orientation.coeffs()) / dt - rate.coeffs()).norm(),
      1e-5);
}

TEST(RigidBody, WorksInSinglePrecision) {
  const RigidBody<float> body(lopsided_body());
  State<float> x;
  x.wrench.force.z() = 1.5f * 9.81f;
  x = body.step(x, Eigen::Matrix<float, 6, 1>::Zero(), {}, 0.1f);
  EXPECT_LT(x.body.velocity.norm(), 1e-5f);
}

TEST(RigidBody, RejectsInvalidParameters) {
  RigidBodyParameters p;
  p.mass = -1.0;
  EXPECT_THROW(RigidBodyd{p}, std::invalid_argument);
  p.mass = 1.0;
  p.inertia = Eigen::Vector3d(1.0, 1.0, 3.0).asDiagonal();
  EXPECT_THROW(RigidBodyd{p}, std::invalid_argument);
}

}  // namespace rigid_body_test
}  // namespace tilt_ropter
