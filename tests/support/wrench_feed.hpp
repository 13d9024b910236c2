#pragma once

#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

/// Samples for tests of the wrench observer.
namespace test_support {

/// Returns the body whose wrench is observed.
inline tilt_ropter::RigidBodyParameters body() {
  return tilt_ropter::tilt_ropter_vehicle().body;
}

/// Passes samples of a body without actuators, on which a wrench acts, at 100 Hz.
class Feed {
 public:
  explicit Feed(tilt_ropter::WrenchObserverd& observer) : observer_(observer) {}

  tilt_ropter::ObserverStatus operator()(const tilt_ropter::Wrenchd& wrench, double dt = 0.01) {
    time_ += dt;
    // Rotation about x alone causes no gyroscopic torque.
    rate_.x() += wrench.torque.x() / body().inertia(0, 0) * dt;
    return observer_.update(time_, {rate_, wrench.force / body().mass}, {}).status;
  }
  void operator()(const tilt_ropter::Wrenchd& wrench, int samples) {
    for (int i = 0; i < samples; ++i) (*this)(wrench);
  }
  [[nodiscard]] double time() const { return time_; }

 private:
  tilt_ropter::WrenchObserverd& observer_;
  double time_ = 0.0;
  Eigen::Vector3d rate_ = Eigen::Vector3d::Zero();
};

/// Returns the sum of the norms of the differences of force [N] and torque [N m].
inline double distance(const tilt_ropter::Wrenchd& a, const tilt_ropter::Wrenchd& b) {
  return (a.force - b.force).norm() + (a.torque - b.torque).norm();
}

/// A wrench with a torque about x only, as Feed needs it.
inline const tilt_ropter::Wrenchd pushed{Eigen::Vector3d(2.0, -1.0, 0.5),
                                         Eigen::Vector3d(0.2, 0.0, 0.0)};

}  // namespace test_support
