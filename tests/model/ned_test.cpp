#include <tilt_ropter/model/frames.hpp>

#include "support/autodiff.hpp"
#include "support/random.hpp"
#include "support/states.hpp"

#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>
#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace ned_test {

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;
using test_support::Random;

// Reference in another form: each axis of one frame, written in the other frame.
Matrix3d enu_to_ned() {
  Matrix3d m;
  m.col(0) = Vector3d(0, 1, 0);   // east is y of NED
  m.col(1) = Vector3d(1, 0, 0);   // north is x of NED
  m.col(2) = Vector3d(0, 0, -1);  // up is -z of NED
  return m;
}

Matrix3d flu_to_frd() {
  return Vector3d(1, -1, -1).asDiagonal();
}

double distance(const BodyStated& a, const BodyStated& b) {
  return (a.position - b.position).norm() + (a.velocity - b.velocity).norm() +
         (a.orientation.coeffs() - b.orientation.coeffs()).norm() +
         (a.angular_velocity - b.angular_velocity).norm();
}

TEST(Ned, VectorsMatchAxisDefinitions) {
  Random random(81);
  for (int i = 0; i < 1000; ++i) {
    const Vector3d v = random.vector(10.0);
    EXPECT_EQ(ned_from_enu(v), enu_to_ned() * v);
    EXPECT_EQ(enu_from_ned(v), enu_to_ned().transpose() * v);
    EXPECT_EQ(frd_from_flu(v), flu_to_frd() * v);
    EXPECT_EQ(flu_from_frd(v), flu_to_frd().transpose() * v);
  }
}

TEST(Ned, AttitudeMatchesRotationMatrixInNedAndFrd) {
  Random random(82);
  for (int i = 0; i < 1000; ++i) {
    Quaterniond q = random.orientation();
    if (i < 9) {  // identity, half turns and almost half turns
      const double angle[] = {0.0, pi, pi - 1e-8};
      q = Eigen::AngleAxisd(angle[i % 3], Vector3d::Unit(i / 3));
    }
    const Matrix3d truth = enu_to_ned() * q.toRotationMatrix() * flu_to_frd().transpose();
    EXPECT_LT((ned_from_enu(q).toRotationMatrix() - truth).norm(), 1e-14);
    EXPECT_NEAR(ned_from_enu(q).norm(), 1.0, 1e-15);
    EXPECT_LT((enu_from_ned(ned_from_enu(q)).coeffs() - q.coeffs()).norm(), 1e-15);
    EXPECT_LT((ned_from_enu(enu_from_ned(q)).coeffs() - q.coeffs()).norm(), 1e-15);
  }
}

TEST(Ned, LevelHeadingsAreCompassHeadings) {
  // PX4's heading is measured clockwise from north, seen from above. Our zero heading faces east.
  for (const double yaw : {0.0, 0.3, pi / 2, -2.0, 3.0}) {
    const Quaterniond compass = ned_from_enu(quaternion_from_yaw(yaw));
    EXPECT_NEAR(std::remainder(yaw_of(compass) - (pi / 2 - yaw), 2 * pi), 0.0, 1e-14);
    EXPECT_NEAR(std::hypot(compass.x(), compass.y()), 0.0, 1e-15);
  }
}

TEST(Ned, QuaternionIsContinuousOverTwoTurns) {
  Quaterniond before = ned_from_enu(Quaterniond::Identity());
  const Vector3d axis = Vector3d(1, 2, -0.5).normalized();
  for (int i = 1; i <= 1000; ++i) {  // two whole turns
    const double half = 2e-3 * pi * i;
    const Vector3d v = std::sin(half) * axis;
    const Quaterniond now = ned_from_enu(Quaterniond(std::cos(half), v.x(), v.y(), v.z()));
    EXPECT_LT((now.coeffs() - before.coeffs()).norm(), 0.01);
    before = now;
  }
}

/// A rigid body under a constant body wrench, in one set of axes. It is integrated independently by
/// many small steps, with rotation matrices and the angular momentum in the world frame.
struct PlainBody {
  Vector3d position, velocity;
  Matrix3d rotation;  ///< body -> world
  Vector3d momentum;  ///< angular momentum, in the world frame
};

PlainBody fly(PlainBody x, double mass, const Matrix3d& inertia, const Vector3d& weight,
              const Vector3d& force, const Vector3d& torque, double duration, int steps) {
  const double h = duration / steps;
  const auto spin = [&](const PlainBody& at) {
    return Vector3d(at.rotation * inertia.inverse() * at.rotation.transpose() * at.momentum);
  };
  const auto turned = [](const Vector3d& w, double t, const Matrix3d& r) {
    const double rate = w.norm();
    return rate == 0.0 ? r : Matrix3d(Eigen::AngleAxisd(rate * t, w / rate) * r);
  };
  for (int i = 0; i < steps; ++i) {  // midpoint
    PlainBody middle = x;
    middle.rotation = turned(spin(x), h / 2, x.rotation);
    middle.momentum += h / 2 * (x.rotation * torque);
    const Vector3d acceleration = (middle.rotation * force + weight) / mass;
    x.position += h * x.velocity + h * h / 2 * acceleration;
    x.velocity += h * acceleration;
    x.momentum += h * (middle.rotation * torque);
    x.rotation = turned(spin(middle), h, x.rotation);
  }
  return x;
}

TEST(Ned, BodyFollowsSameTrajectoryInBothAxes) {
  Random random(83);
  const double mass = 1.5;
  Matrix3d inertia;  // in FLU, with products of inertia, which change sign
  inertia << 0.014, 0.002, -0.001, 0.002, 0.017, 0.003, -0.001, 0.003, 0.025;
  const Matrix3d inertia_frd = flu_to_frd() * inertia * flu_to_frd();
  for (int i = 0; i < 20; ++i) {
    const Stated start = test_support::random_state(random);
    const Wrenchd wrench{random.vector(20.0), random.vector(0.05)};
    const auto plain = [](const auto& body, const Matrix3d& j) {
      const Matrix3d rotation = body.orientation.toRotationMatrix();
      return PlainBody{body.position, body.velocity, rotation,
                       rotation * j * body.angular_velocity};
    };
    const double duration = 1.0;
    const int steps = 1000;
    const PlainBody enu =
        fly(plain(start.body, inertia), mass, inertia, Vector3d(0, 0, -mass * gravity),
            wrench.force, wrench.torque, duration, steps);
    const Wrenchd wrench_frd = frd_from_flu(wrench);
    const PlainBody ned =
        fly(plain(ned_from_enu(start.body), inertia_frd), mass, inertia_frd,
            Vector3d(0, 0, mass * gravity), wrench_frd.force, wrench_frd.torque, duration, steps);
    NedBodyStated end_ned;
    end_ned.position = ned.position;
    end_ned.velocity = ned.velocity;
    end_ned.orientation = Quaterniond(ned.rotation);
    end_ned.angular_velocity = inertia_frd.inverse() * ned.rotation.transpose() * ned.momentum;
    const BodyStated end = enu_from_ned(end_ned);
    EXPECT_LT((end.position - enu.position).norm(), 1e-10);
    EXPECT_LT((end.velocity - enu.velocity).norm(), 1e-10);
    EXPECT_LT((end.orientation.toRotationMatrix() - enu.rotation).norm(), 1e-10);
    EXPECT_LT(
        (end.angular_velocity - inertia.inverse() * enu.rotation.transpose() * enu.momentum).norm(),
        1e-9);
    EXPECT_GT((enu.position - start.body.position).norm(), 0.1);  // the body has moved
  }
}

TEST(Ned, RoundTripIsIdentity) {
  Random random(84);
  for (int i = 0; i < 1000; ++i) {
    const Stated x = test_support::random_state(random);
    EXPECT_LT(distance(enu_from_ned(ned_from_enu(x.body)), x.body), 1e-15);
    const Wrenchd back = flu_from_frd(frd_from_flu(x.wrench));
    EXPECT_EQ(back.force, x.wrench.force);
    EXPECT_EQ(back.torque, x.wrench.torque);
  }
}

TEST(Ned, PowerIsInvariant) {
  Random random(85);
  for (int i = 0; i < 100; ++i) {
    const Stated x = test_support::random_state(random);
    const NedBodyStated ned = ned_from_enu(x.body);
    const Wrenchd frd = frd_from_flu(x.wrench);
    EXPECT_NEAR(
        (ned.orientation * frd.force).dot(ned.velocity) + frd.torque.dot(ned.angular_velocity),
        (x.body.orientation * x.wrench.force).dot(x.body.velocity) +
            x.wrench.torque.dot(x.body.angular_velocity),
        1e-11);
  }
}

TEST(Ned, NonFiniteEntriesStayNonFinite) {
  for (const double bad :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    for (int i = 0; i < 13; ++i) {
      NedBodyStated ned;
      ASSERT_TRUE(is_finite(enu_from_ned(ned)));
      if (i < 3) ned.position(i) = bad;
      if (i >= 3 && i < 6) ned.velocity(i - 3) = bad;
      if (i >= 6 && i < 10) ned.orientation.coeffs()(i - 6) = bad;
      if (i >= 10) ned.angular_velocity(i - 10) = bad;
      EXPECT_FALSE(is_finite(enu_from_ned(ned))) << i;
    }
    EXPECT_FALSE(is_finite(flu_from_frd(Wrenchd{Vector3d(0, bad, 0), Vector3d::Zero()})));
  }
}

TEST(Ned, WorksInSinglePrecisionAndWithDerivatives) {
  const Quaterniond q = Random(86).orientation();
  EXPECT_LT(
      (ned_from_enu(q.cast<float>()).coeffs().cast<double>() - ned_from_enu(q).coeffs()).norm(),
      1e-7);
  EXPECT_EQ(frd_from_flu(Eigen::Vector3f(1, 2, 3)), Eigen::Vector3f(1, -2, -3));
  // A small rotation of the body is the same small rotation in FRD axes.
  const Matrix3d by_turn = test_support::jacobian_at_zero<3, 3>([&](const auto& step) {
    using Dual = test_support::Dual<3>;
    const Eigen::Quaternion<Dual> turned = q.cast<Dual>() * quaternion_exp(step);
    return quaternion_log(
        Eigen::Quaternion<Dual>(ned_from_enu(q).conjugate().cast<Dual>() * ned_from_enu(turned)));
  });
  EXPECT_LT((by_turn - flu_to_frd()).norm(), 1e-14);
}

}  // namespace ned_test
}  // namespace tilt_ropter
