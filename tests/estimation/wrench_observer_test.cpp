#include <tilt_ropter/estimation/wrench_observer.hpp>

#include "support/random.hpp"

#include <tilt_ropter/model/rigid_body.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace tilt_ropter {
namespace {

using test_support::Random;

RigidBodyParameters body() {
  return tilt_ropter_vehicle().body;
}

TEST(WrenchObserver, StepResponseIsTheClosedFormForAnyStep) {
  const Eigen::Vector3d force(5.0, -3.0, 1.0), torque(0.3, -0.1, 0.2);
  WrenchObserverSettings settings;
  settings.force_bandwidth << 2.0, 5.0, 20.0;
  settings.torque_bandwidth << 3.0, 6.0, 25.0;
  settings.max_gap = 2.0;
  for (const double dt : {1e-3, 5e-3, 0.02, 0.1, 0.25, 1.0}) {  // dt K up to 25
    WrenchObserver<> observer(body(), settings);
    // At rest apart from the step: w(t) = J^-1 M t about each axis in turn would couple, so each
    // torque axis is tried alone; the force does not care.
    for (int axis = 0; axis < 3; ++axis) {
      observer.reset();
      const Eigen::Vector3d about = torque(axis) * Eigen::Vector3d::Unit(axis);
      for (int i = 0; i <= 40; ++i) {
        const double t = dt * i;
        const Eigen::Vector3d w = body().inertia.inverse() * about * t;
        observer.update(t, force / body().mass, w, {});
        for (int j = 0; j < 3; ++j)
          EXPECT_NEAR(observer.external().force(j),
                      force(j) * (1.0 - std::exp(-settings.force_bandwidth(j) * t)), 1e-12);
        EXPECT_NEAR(observer.external().torque(axis),
                    about(axis) * (1.0 - std::exp(-settings.torque_bandwidth(axis) * t)), 1e-11);
      }
    }
  }
}

TEST(WrenchObserver, DoesNotDependOnHowTimeIsDivided) {
  WrenchObserverSettings settings;
  settings.max_gap = 1.0;
  WrenchObserver<> coarse(body(), settings), fine(body(), settings);
  const Eigen::Vector3d a(1.0, 2.0, 9.0), w = Eigen::Vector3d::Zero();
  coarse.update(0.0, a, w, {});
  fine.update(0.0, a, w, {});
  for (int i = 1; i <= 7; ++i) fine.update(0.1 * i, a, w, {});
  coarse.update(0.7, a, w, {});
  EXPECT_LT((coarse.external().force - fine.external().force).norm(), 1e-12);
}

TEST(WrenchObserver, FindsTheExternalWrenchOfATumblingBody) {
  Random random(51);
  const RigidBody<> plant(body());
  const Wrench<> truth{Eigen::Vector3d(0.5, -0.3, 0.8), Eigen::Vector3d(0.02, -0.01, 0.03)};
  State<> x;
  x.body.angular_velocity << 1.0, -2.0, 0.5;
  WrenchObserver<> observer(body());
  const double dt = 1e-3;
  Wrench<> applied;
  for (int i = 0; i <= 5000; ++i) {
    const double t = dt * i;
    observer.update(t, (applied.force + truth.force) / body().mass, x.body.angular_velocity,
                    applied);
    applied = {random.vector(2.0), -0.02 * x.body.angular_velocity};
    x.wrench = applied;
    x = plant.step(x, Eigen::Matrix<double, 6, 1>::Zero(), truth, dt);
  }
  EXPECT_LT((observer.external().force - truth.force).norm(), 1e-9);
  EXPECT_LT((observer.external().torque - truth.torque).norm(), 1e-5);
}

TEST(WrenchObserver, AnInitialRateIsNotATorque) {
  WrenchObserver<> observer(body());
  const Eigen::Vector3d w(0.0, 0.0, 3.0);
  EXPECT_EQ(observer.update(0.0, Eigen::Vector3d::Zero(), w, {}), ObserverStatus::started);
  EXPECT_EQ(observer.update(0.1, Eigen::Vector3d::Zero(), w, {}), ObserverStatus::updated);
  EXPECT_LT(observer.external().torque.norm(), 1e-15);
}

TEST(WrenchObserver, BadSamplesAreRejectedAndChangeNothing) {
  WrenchObserver<> observer(body());
  const Eigen::Vector3d a(1.0, 0.0, 9.0), w(0.1, 0.0, 0.0);
  observer.update(0.0, a, w, {});
  observer.update(0.1, a, w, {});
  const Wrench<> before = observer.external();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double infinite = std::numeric_limits<double>::infinity();
  const Eigen::Vector3d bad(0.0, nan, 0.0), huge = Eigen::Vector3d::Constant(1e300);
  EXPECT_EQ(observer.update(nan, a, w, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(infinite, a, w, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.1, a, w, {}), ObserverStatus::rejected);  // time stands
  EXPECT_EQ(observer.update(0.05, a, w, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, bad, w, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, a, bad, {}), ObserverStatus::rejected);
  EXPECT_EQ(observer.update(0.2, a, huge, {}), ObserverStatus::rejected);  // overflows
  EXPECT_EQ(observer.update(0.2, a, w, {bad, w}), ObserverStatus::rejected);
  EXPECT_EQ(observer.external().force, before.force);
  EXPECT_EQ(observer.external().torque, before.torque);
  EXPECT_EQ(observer.update(0.2, a, w, {}), ObserverStatus::updated);
}

TEST(WrenchObserver, EstimateCanBeReplaced) {
  WrenchObserver<> observer(body());
  observer.set_external({Eigen::Vector3d(1, 2, 3), Eigen::Vector3d(4, 5, 6)});
  EXPECT_EQ(observer.external().torque.z(), 6.0);
  observer.set_external({Eigen::Vector3d::Constant(std::nan("")), Eigen::Vector3d::Zero()});
  EXPECT_EQ(observer.external().torque.z(), 6.0);
}

TEST(WrenchObserver, WorksInSinglePrecision) {
  WrenchObserver<float> observer(body());
  const Eigen::Vector3f a(1.0f, 0.0f, 0.0f), w = Eigen::Vector3f::Zero();
  for (int i = 0; i <= 100; ++i) observer.update(0.05 * i, a, w, {});
  EXPECT_NEAR(static_cast<double>(observer.external().force.x()), 1.5, 1e-5);
}

TEST(WrenchObserver, SettingsOutOfRangeAreRefused) {
  WrenchObserverSettings s;
  s.torque_bandwidth.y() = 0.0;
  EXPECT_THROW((WrenchObserver<>(body(), s)), std::invalid_argument);
  RigidBodyParameters b = body();
  b.mass = std::nan("");
  EXPECT_THROW(WrenchObserver<>{b}, std::invalid_argument);
}

}  // namespace
}  // namespace tilt_ropter
