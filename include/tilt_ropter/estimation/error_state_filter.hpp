// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <limits>

/// Mathematics of the state estimator, without clocks: an error-state Kalman filter on SO(3) after
/// J. Solà, "Quaternion kinematics for the error-state Kalman filter", 2017, Secs. 5-7 (local
/// orientation errors). Ekf (ekf.hpp) passes measurements with time stamps to it. Does not
/// allocate. Only the constructor and validate() throw.
namespace tilt_ropter {

/// Estimated state.
template <typename Scalar>
struct InertialState {
  Vector3<Scalar> position = Vector3<Scalar>::Zero();  ///< of the IMU in the world [m]
  Vector3<Scalar> velocity = Vector3<Scalar>::Zero();  ///< of the IMU in the world [m/s]
  Eigen::Quaternion<Scalar> orientation = Eigen::Quaternion<Scalar>::Identity();  ///< body -> world
  Vector3<Scalar> gyro_bias = Vector3<Scalar>::Zero();                            ///< [rad/s]
  Vector3<Scalar> accelerometer_bias = Vector3<Scalar>::Zero();                   ///< [m/s^2]
  Eigen::Quaternion<Scalar> marker_orientation =
      Eigen::Quaternion<Scalar>::Identity();                  ///< marker frame M -> body
  Vector3<Scalar> marker_position = Vector3<Scalar>::Zero();  ///< origin of M in the body frame [m]
};
using InertialStated = InertialState<double>;  ///< in double precision

/// Error of an InertialState, in the order of its members. Orientation errors are rotation vectors
/// in the frame from which the orientation rotates: body frame for the orientation, M for the
/// marker's orientation.
template <typename Scalar>
using InertialTangent = Eigen::Matrix<Scalar, 21, 1>;
using InertialTangentd = InertialTangent<double>;  ///< in double precision

/// Start of each part of an InertialTangent and of its covariance.
struct InertialIndex {
  static constexpr int position = 0, velocity = 3, orientation = 6, gyro_bias = 9,
                       accelerometer_bias = 12, marker_orientation = 15, marker_position = 18;
};

/// Returns x (+) dx.
template <typename Scalar>
[[nodiscard]] InertialState<Scalar> retract(const InertialState<Scalar>& x,
                                            const InertialTangent<Scalar>& dx) {
  using I = InertialIndex;
  const auto part = [&dx](int start) { return dx.template segment<3>(start); };
  InertialState<Scalar> y;
  y.position = x.position + part(I::position);
  y.velocity = x.velocity + part(I::velocity);
  y.orientation = (x.orientation * quaternion_exp(part(I::orientation))).normalized();
  y.gyro_bias = x.gyro_bias + part(I::gyro_bias);
  y.accelerometer_bias = x.accelerometer_bias + part(I::accelerometer_bias);
  y.marker_orientation =
      (x.marker_orientation * quaternion_exp(part(I::marker_orientation))).normalized();
  y.marker_position = x.marker_position + part(I::marker_position);
  return y;
}

/// Returns y (-) x, so that retract(x, difference(y, x)) = y. With y the true state and P the
/// covariance, the result is the error e of the NEES e' P^-1 e.
template <typename Scalar>
[[nodiscard]] InertialTangent<Scalar> difference(const InertialState<Scalar>& y,
                                                 const InertialState<Scalar>& x) {
  const auto turn = [](const Eigen::Quaternion<Scalar>& to, const Eigen::Quaternion<Scalar>& from) {
    return quaternion_log(Eigen::Quaternion<Scalar>(from.conjugate() * to));
  };
  InertialTangent<Scalar> dx;
  dx << y.position - x.position, y.velocity - x.velocity, turn(y.orientation, x.orientation),
      y.gyro_bias - x.gyro_bias, y.accelerometer_bias - x.accelerometer_bias,
      turn(y.marker_orientation, x.marker_orientation), y.marker_position - x.marker_position;
  return dx;
}

/// Returns the state `dt` [s] later. The sample is constant over the step; the mean of the samples
/// at both ends makes the step second order. The rotation is exact. The acceleration is evaluated
/// in the middle of the step.
template <typename Scalar>
[[nodiscard]] InertialState<Scalar> propagate(const InertialState<Scalar>& x,
                                              const InertialSample<Scalar>& sample,
                                              const Scalar& dt) {
  const Vector3<Scalar> half_turn =
      (sample.angular_velocity - x.gyro_bias) * Scalar(dt / Scalar(2));
  const Eigen::Quaternion<Scalar> half = quaternion_exp(half_turn);
  const Eigen::Quaternion<Scalar> middle = x.orientation * half;
  Vector3<Scalar> acceleration = middle * (sample.specific_force - x.accelerometer_bias);
  acceleration.z() -= Scalar(gravity);
  InertialState<Scalar> y = x;
  y.position += dt * (x.velocity + acceleration * Scalar(dt / Scalar(2)));
  y.velocity += dt * acceleration;
  y.orientation = (middle * half).normalized();
  return y;
}

/// Noise of an IMU. Data sheets give the densities of an IMU at rest. Ten times these values are
/// usual on a vibrating vehicle, also to cover misalignment and scale errors.
struct InertialNoise {
  double gyro_density = 2.0e-3;  ///< noise density of the angular velocity [rad/s/sqrt(Hz)]
  double accelerometer_density = 2.0e-2;  ///< noise density of the specific force [m/s^2/sqrt(Hz)]
  double gyro_bias_walk = 2.0e-5;         ///< random walk of the bias [rad/s^2/sqrt(Hz)]
  double accelerometer_bias_walk = 1.0e-3;  ///< random walk of the bias [m/s^3/sqrt(Hz)]
};

inline void validate(const InertialNoise& n) {
  const double most = 1e3;
  require_in("InertialNoise.gyro_density [rad/s/sqrt(Hz)]", n.gyro_density, 0.0, most);
  require_in("InertialNoise.accelerometer_density [m/s^2/sqrt(Hz)]", n.accelerometer_density, 0.0,
             most);
  require_in("InertialNoise.gyro_bias_walk [rad/s^2/sqrt(Hz)]", n.gyro_bias_walk, 0.0, most);
  require_in("InertialNoise.accelerometer_bias_walk [m/s^3/sqrt(Hz)]", n.accelerometer_bias_walk,
             0.0, most);
}

/// Standard deviations of a MarkerPose, per axis.
struct MarkerPoseNoise {
  double position = 2.0e-3;     ///< of the position, world frame [m]
  double orientation = 5.0e-3;  ///< of the orientation, marker frame [rad]
};

inline void validate(const MarkerPoseNoise& n) {
  require_in("MarkerPoseNoise.position [m]", n.position, 1e-6, 1e3);
  require_in("MarkerPoseNoise.orientation [rad]", n.orientation, 1e-6, 10.0);
}

/// State and covariance of its error. If the covariance of a part of the state is zero, this part
/// is known: the filter uses it and does not change it.
template <typename Scalar>
class ErrorStateFilter {
 public:
  using Covariance = Eigen::Matrix<Scalar, 21, 21>;

  /// Difference between a measured pose and the state.
  struct Innovation {
    Eigen::Matrix<Scalar, 6, 1> residual;    ///< position, world [m]; rotation vector, M [rad]
    Eigen::Matrix<Scalar, 6, 6> covariance;  ///< S, covariance of the residual
    /// NIS, r' S^-1 r: chi-square of 6 degrees of freedom. The largest number if rounding has made
    /// S indefinite.
    Scalar distance;
    /// P H', cross-covariance of the state's error and the residual.
    Eigen::Matrix<Scalar, 21, 6> correlation;
  };

  /// Throws std::invalid_argument if a noise value is out of range.
  ErrorStateFilter(const InertialNoise& inertial, const MarkerPoseNoise& pose) {
    validate(inertial);
    validate(pose);
    const auto square = [](double stddev) { return Scalar(stddev * stddev); };
    const auto set_noise = [&](int start, double density) {
      process_noise_.template segment<3>(start - noisy).setConstant(square(density));
    };
    using I = InertialIndex;
    set_noise(I::velocity, inertial.accelerometer_density);
    set_noise(I::orientation, inertial.gyro_density);
    set_noise(I::gyro_bias, inertial.gyro_bias_walk);
    set_noise(I::accelerometer_bias, inertial.accelerometer_bias_walk);
    pose_noise_.template head<3>().setConstant(square(pose.position));
    pose_noise_.template tail<3>().setConstant(square(pose.orientation));
  }

  void reset(const InertialState<Scalar>& state, const Covariance& covariance) noexcept {
    state_ = state;
    covariance_ = covariance;
  }

  /// Propagates state and covariance by `dt` > 0 [s] under `sample` (see propagate).
  void predict(const InertialSample<Scalar>& sample, const Scalar& dt) noexcept {
    using I = InertialIndex;
    const Vector3<Scalar> turn = (sample.angular_velocity - state_.gyro_bias) * dt;
    const Vector3<Scalar> force = sample.specific_force - state_.accelerometer_bias;
    const Scalar half = dt / Scalar(2);
    const Matrix3<Scalar> rotation =
        (state_.orientation * quaternion_exp(turn / Scalar(2))).toRotationMatrix();
    const Matrix3<Scalar> half_rotation =
        quaternion_exp(turn / Scalar(2)).conjugate().toRotationMatrix();
    // Derivatives of the acceleration by orientation, gyro bias and accelerometer bias. In the
    // middle of the step, an orientation error from the start is rotated by half the turn.
    const Matrix3<Scalar> by_middle = -rotation * skew(force);

    // The nine rows of the transition matrix that differ from the identity, without the marker's
    // columns, which are zero.
    Eigen::Matrix<Scalar, 9, 15> f = Eigen::Matrix<Scalar, 9, 15>::Zero();
    auto acceleration = f.template block<3, 9>(I::velocity, I::orientation);
    acceleration.template leftCols<3>().noalias() = dt * by_middle * half_rotation;
    acceleration.template middleCols<3>(I::gyro_bias - I::orientation).noalias() =
        (-dt * half) * by_middle * right_jacobian(turn / Scalar(2));
    acceleration.template rightCols<3>() = -dt * rotation;
    f.template block<3, 9>(I::position, I::orientation) = half * acceleration;
    f.template block<3, 3>(I::position, I::velocity).diagonal().setConstant(dt);
    f.template topLeftCorner<6, 6>().diagonal().setOnes();
    f.template block<3, 3>(I::orientation, I::orientation) = half_rotation * half_rotation;
    f.template block<3, 3>(I::orientation, I::gyro_bias) = -dt * right_jacobian(turn);

    const Eigen::Matrix<Scalar, 9, 21> moved = f * covariance_.template topRows<15>();
    const Eigen::Matrix<Scalar, 9, 9> own = moved.template leftCols<15>() * f.transpose();
    // Rounding leaves an asymmetric part, which would grow from step to step.
    covariance_.template topLeftCorner<9, 9>() = (own + own.transpose()) / Scalar(2);
    covariance_.template topRightCorner<9, 12>() = moved.template rightCols<12>();
    covariance_.template bottomLeftCorner<12, 9>() = moved.template rightCols<12>().transpose();
    covariance_.diagonal().template segment<12>(noisy) += dt * process_noise_;
    state_ = propagate(state_, sample, dt);
  }

  /// Compares a pose (orientation of unit length) with the state. Changes nothing.
  [[nodiscard]] Innovation innovation(const MarkerPose<Scalar>& pose) const noexcept {
    using I = InertialIndex;
    const PoseJacobian h = pose_jacobian();
    Innovation in;
    const Vector3<Scalar> marker = state_.position + h.rotation * state_.marker_position;
    in.residual.template head<3>() = pose.position - marker;
    in.residual.template tail<3>() = quaternion_log(Eigen::Quaternion<Scalar>(
        (state_.orientation * state_.marker_orientation).conjugate() * pose.orientation));
    in.correlation = times_transpose(covariance_, h);
    const auto rows = [&in](int start) { return in.correlation.template middleRows<3>(start); };
    Eigen::Matrix<Scalar, 6, 6> s;
    s.template topRows<3>() = rows(I::position);
    s.template topRows<3>().noalias() += h.by_turn * rows(I::orientation);
    s.template topRows<3>().noalias() += h.rotation * rows(I::marker_position);
    s.template bottomRows<3>() = rows(I::marker_orientation);
    s.template bottomRows<3>().noalias() += h.to_marker * rows(I::orientation);
    in.covariance = (s + s.transpose()) / Scalar(2);
    in.covariance.diagonal() += pose_noise_;
    const auto factor = in.covariance.llt();
    in.distance = factor.info() == Eigen::Success ? in.residual.dot(factor.solve(in.residual))
                                                  : std::numeric_limits<Scalar>::max();
    return in;
  }

  /// Updates state and covariance with an innovation of the current state. The covariance is
  /// updated in Joseph's form, (I - K H) P (I - K H)' + K R K'. An error of the gain, or of
  /// rounding, does not make this form negative. Returns false and changes nothing if S is not
  /// positive definite. Rounding can cause this if P is larger than the pose's noise by more digits
  /// than a Scalar has.
  bool update(const Innovation& in) noexcept {
    const auto factor = in.covariance.llt();
    if (factor.info() != Eigen::Success) return false;
    const Eigen::Matrix<Scalar, 21, 6> gain = factor.solve(in.correlation.transpose()).transpose();
    Covariance left = covariance_;  // (I - K H) P
    left.noalias() -= gain * in.correlation.transpose();
    Eigen::Matrix<Scalar, 21, 6> rest = gain * pose_noise_.asDiagonal();
    rest -= times_transpose(left, pose_jacobian());
    left.noalias() += rest * gain.transpose();
    covariance_ = (left + left.transpose()) / Scalar(2);
    state_ = retract(state_, InertialTangent<Scalar>(gain * in.residual));
    return true;
  }

  [[nodiscard]] const InertialState<Scalar>& state() const noexcept { return state_; }
  [[nodiscard]] const Covariance& covariance() const noexcept { return covariance_; }

 private:
  /// Jacobian H = [I 0 by_turn 0 0 0 rotation; 0 0 to_marker 0 0 I 0] of a pose by the state's
  /// error.
  struct PoseJacobian {
    Matrix3<Scalar> rotation, to_marker, by_turn;
  };

  [[nodiscard]] PoseJacobian pose_jacobian() const noexcept {
    PoseJacobian h;
    h.rotation = state_.orientation.toRotationMatrix();
    h.to_marker = state_.marker_orientation.conjugate().toRotationMatrix();
    h.by_turn = -h.rotation * skew(state_.marker_position);
    return h;
  }

  /// Returns m H'.
  [[nodiscard]] static Eigen::Matrix<Scalar, 21, 6> times_transpose(
      const Covariance& m, const PoseJacobian& h) noexcept {
    using I = InertialIndex;
    const auto columns = [&m](int start) { return m.template middleCols<3>(start); };
    Eigen::Matrix<Scalar, 21, 6> product;
    product.template leftCols<3>() = columns(I::position);
    product.template leftCols<3>().noalias() += columns(I::orientation) * h.by_turn.transpose();
    product.template leftCols<3>().noalias() +=
        columns(I::marker_position) * h.rotation.transpose();
    product.template rightCols<3>() = columns(I::marker_orientation);
    product.template rightCols<3>().noalias() += columns(I::orientation) * h.to_marker.transpose();
    return product;
  }

  static constexpr int noisy = InertialIndex::velocity;  // first state with process noise

  InertialState<Scalar> state_;
  Covariance covariance_ = Covariance::Zero();
  /// Variance rates of velocity ... accelerometer bias [1/s].
  Eigen::Matrix<Scalar, 12, 1> process_noise_;
  Eigen::Matrix<Scalar, 6, 1> pose_noise_;
};
using ErrorStateFilterd = ErrorStateFilter<double>;  ///< in double precision

}  // namespace tilt_ropter
