// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/estimation/detail/inertial_state.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <vector>

/// Least squares over a whole log of an IMU and motion capture: the trajectory, the biases, and
/// what is constant during the log. For calibrate_log() (log_calibration.hpp).
namespace tilt_ropter::detail {

/// Start of each part of the error of the smoother's unknowns. From `gravity` on they are constant.
struct SmootherIndex : InertialIndex {
  static constexpr int gravity = 15, marker_orientation = 17, marker_position = 20, clock = 23,
                       size = 24;
};

/// What is constant during the log. The fields of the marker frame are as in InertialState.
template <typename Scalar>
struct LogConstants {
  Eigen::Quaternion<Scalar> marker_orientation = Eigen::Quaternion<Scalar>::Identity();
  Vector3<Scalar> marker_position = Vector3<Scalar>::Zero();
  Eigen::Matrix<Scalar, 2, 1> gravity =
      Eigen::Matrix<Scalar, 2, 1>::Zero();  ///< its horizontal part, world frame [m/s^2]
  double clock_offset = 0.0;                ///< to add to the stamps of the poses [s]
};

/// Gauss-Newton iterations of the problem: one linear smoother per iteration (Bell, "The iterated
/// Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 1994). The cost of an iteration is
/// linear in the length of the log. The backward pass is the smoother of Bryson and Frazier, which
/// inverts no covariance: an unknown may have no noise, or be known.
///
/// Scalar is double. The class is a template so that only code that calibrates compiles it.
template <typename Scalar>
class LogSmoother {
 public:
  using Index = SmootherIndex;
  using Vector = Eigen::Matrix<Scalar, Index::size, 1>;
  using Covariance = Eigen::Matrix<Scalar, Index::size, Index::size>;
  using Imu = std::vector<Timed<InertialSample<Scalar>>>;
  using Poses = std::vector<Timed<MarkerPose<Scalar>>>;

  /// State at an IMU sample, without its marker frame, and the poses from there to the next node.
  struct Node {
    std::size_t sample = 0;
    std::size_t first_pose = 0, last_pose = 0;  ///< [first, last)
    InertialState<Scalar> state;
    // Of the error, from the measurements up to this node.
    Vector mean = Vector::Zero();
    Covariance covariance = Covariance::Zero();
  };

  /// Residual of a pose: position [m], orientation [rad].
  using Residual = Eigen::Matrix<Scalar, 6, 1>;

  InertialNoise imu_noise;
  MarkerPoseNoise pose_noise;
  LogConstants<Scalar> constants;
  std::vector<Node> nodes;
  std::vector<double> weights;      ///< of each pose, 1 or less
  std::vector<Residual> residuals;  ///< of each pose, at the current trajectory

  /// The logs must outlive this. `prior` holds the standard deviations of the unknowns at the
  /// start; those of biases and gravity are about zero, the others about the current value.
  LogSmoother(const Imu& imu, const Poses& poses, const Vector& prior)
      : weights(poses.size(), 1.0),
        residuals(poses.size(), Residual::Zero()),
        imu_(imu),
        poses_(poses),
        prior_(prior),
        updates_(poses.size()) {}

  /// Computes the residuals of all poses at the current trajectory.
  void find_residuals() {
    for (const Node& node : nodes)
      for (std::size_t i = node.first_pose; i < node.last_pose; ++i)
        residuals[i] = linearise(node, i).residual;
  }

  /// One iteration. Returns the step of the constants and of the state at the last node.
  Vector iterate() {
    filter(0, 0);
    smooth();
    return apply();
  }

  /// Covariance of constants and of the state at the last node, at the last iteration.
  [[nodiscard]] const Covariance& covariance() const { return nodes.back().covariance; }

  /// Returns the change of the unknowns at the last node if the poses [first, last) are left out
  /// and the problem stays linear. Overwrites covariance().
  [[nodiscard]] Vector change_without(std::size_t first, std::size_t last) {
    filter(first, last);
    return nodes.back().mean;
  }

 private:
  using Gain = Eigen::Matrix<Scalar, Index::size, 6>;
  struct LinearPose {
    Residual residual;
    Gain by_error;  ///< H'
  };
  /// What the backward pass needs of a pose.
  struct Update {
    Gain by_error, gain;
    Residual weighted;  ///< S^-1 y
  };
  using Transition = Eigen::Matrix<Scalar, 9, 17>;

  const Imu& imu_;
  const Poses& poses_;
  Vector prior_;
  std::vector<Update> updates_;
  std::vector<Vector> smoothed_;

  [[nodiscard]] Residual pose_variances() const {
    Residual v;
    v.template head<3>().setConstant(pose_noise.position * pose_noise.position);
    v.template tail<3>().setConstant(pose_noise.orientation * pose_noise.orientation);
    return v;
  }

  /// Derivative of move() by the first 17 errors.
  [[nodiscard]] static Transition transition_of(const InertialState<Scalar>& x,
                                                const InertialSample<Scalar>& sample, double dt) {
    Transition f = Transition::Zero();
    Eigen::Matrix<Scalar, 15, 15> all = Eigen::Matrix<Scalar, 15, 15>::Identity();
    InertialTransition<Scalar>(x, sample, dt).template apply<1, 15, 15>(all.data());
    f.template leftCols<15>() = all.template topRows<9>();
    f.template block<2, 2>(Index::position, Index::gravity).diagonal().setConstant(dt * dt / 2.0);
    f.template block<2, 2>(Index::velocity, Index::gravity).diagonal().setConstant(dt);
    return f;
  }
  [[nodiscard]] InertialState<Scalar> move(const InertialState<Scalar>& x,
                                           const InertialSample<Scalar>& sample, double dt) const {
    InertialState<Scalar> y = propagate(x, sample, dt);
    y.velocity.template head<2>() += dt * constants.gravity;
    y.position.template head<2>() += dt * dt / 2.0 * constants.gravity;
    return y;
  }

  /// Mean of the IMU between sample j and `dt` [s] later.
  [[nodiscard]] InertialSample<Scalar> mean_sample(std::size_t j, double dt) const {
    const InertialSample<Scalar>&from = imu_[j].value, &to = imu_[j + 1].value;
    const double fraction = dt / (imu_[j + 1].time - imu_[j].time) / 2.0;
    return {from.angular_velocity + fraction * (to.angular_velocity - from.angular_velocity),
            from.specific_force + fraction * (to.specific_force - from.specific_force)};
  }

  [[nodiscard]] LinearPose linearise(const Node& node, std::size_t i) const {
    const double dt = poses_[i].time + constants.clock_offset - imu_[node.sample].time;
    const InertialSample<Scalar> sample = mean_sample(node.sample, dt);
    InertialState<Scalar> x = move(node.state, sample, dt);
    x.marker_orientation = constants.marker_orientation;
    x.marker_position = constants.marker_position;
    const MarkerPose<Scalar> pose{poses_[i].value.position,
                                  poses_[i].value.orientation.normalized()};
    const LinearisedPose<Scalar> at(x, pose, Residual::Ones());
    const Vector3<Scalar> rate = mean_sample(node.sample, 2.0 * dt).angular_velocity - x.gyro_bias;
    Eigen::Matrix<Scalar, 6, 9> by_state = Eigen::Matrix<Scalar, 6, 9>::Zero();
    by_state.template topLeftCorner<3, 3>().setIdentity();
    by_state.template topRightCorner<3, 3>() = at.by_turn;
    by_state.template bottomRightCorner<3, 3>() = at.to_marker;
    Eigen::Matrix<Scalar, 6, Index::size> h = Eigen::Matrix<Scalar, 6, Index::size>::Zero();
    add_product<6, 9, 17>(by_state.data(), entries(transition_of(node.state, sample, dt)),
                          h.data());
    h.template block<3, 3>(3, Index::marker_orientation).setIdentity();
    h.template block<3, 3>(0, Index::marker_position) = at.rotation;
    h.col(Index::clock) << x.velocity + at.by_turn * rate, at.to_marker * rate;
    return {at.residual, h.transpose()};
  }

  /// Forward pass: Kalman filter of the errors, without the poses [from, to).
  void filter(std::size_t from, std::size_t to) {
    using Part = Eigen::Matrix<Scalar, 9, Index::size>;
    Vector mean = Vector::Zero();
    Covariance p = prior_.cwiseAbs2().asDiagonal();
    mean.template segment<6>(Index::gyro_bias) << -nodes.front().state.gyro_bias,
        -nodes.front().state.accelerometer_bias;
    mean.template segment<2>(Index::gravity) = -constants.gravity;
    for (std::size_t k = 0; k < nodes.size(); ++k) {
      Node& node = nodes[k];
      for (std::size_t i = node.first_pose; i < node.last_pose; ++i)
        if (i < from || i >= to) update(node, i, mean, p);
      node.mean = mean;
      node.covariance = p;
      if (k + 1 == nodes.size()) break;
      InertialState<Scalar> x = node.state;
      for (std::size_t j = node.sample; j < nodes[k + 1].sample; ++j) {
        const double dt = imu_[j + 1].time - imu_[j].time;
        const InertialSample<Scalar> sample = mean_sample(j, dt);
        const Transition f = transition_of(x, sample, dt);
        Part moved = Part::Zero();  // F P
        add_product<9, 17, Index::size>(f.data(), entries(p), moved.data());
        Eigen::Matrix<Scalar, 9, 9> own = Eigen::Matrix<Scalar, 9, 9>::Zero();  // F P F'
        add_product<9, 17, 9>(moved.data(), transposed_entries(f), own.data());
        symmetrise(own);
        for (int row = 0; row < 9; ++row)
          for (int c = 0; c < Index::size; ++c)
            p(row, c) = p(c, row) = c < 9 ? own(row, c) : moved(row, c);
        const auto add = [&](int part, double density) {
          add_variance(p, part, std::sqrt(dt) * density);
        };
        add(Index::velocity, imu_noise.accelerometer_density);
        add(Index::orientation, imu_noise.gyro_density);
        add(Index::gyro_bias, imu_noise.gyro_bias_walk);
        add(Index::accelerometer_bias, imu_noise.accelerometer_bias_walk);
        Eigen::Matrix<Scalar, 9, 1> later = Eigen::Matrix<Scalar, 9, 1>::Zero();
        add_product<9, 17, 1>(f.data(), entries(mean), later.data());
        mean.template head<9>() = later;
        x = move(x, sample, dt);
      }
      mean.template head<15>() += difference(x, nodes[k + 1].state).template head<15>();
    }
  }

  void update(const Node& node, std::size_t i, Vector& mean, Covariance& p) {
    const LinearPose at = linearise(node, i);
    Update& u = updates_[i];
    u.by_error = at.by_error;
    constexpr int size = Index::size;
    Gain correlation = Gain::Zero();  // P H'
    add_product<size, size, 6>(p.data(), entries(at.by_error), correlation.data());
    Eigen::Matrix<Scalar, 6, 6> s = Eigen::Matrix<Scalar, 6, 6>::Zero();  // H P H'
    for (int row = 0; row < 6; ++row)
      add_product<1, size, 6>(at.by_error.data() + size * row, entries(correlation),
                              s.data() + 6 * row);
    symmetrise(s);
    const Residual variances = pose_variances();
    for (int row = 0; row < 6; ++row) s(row, row) += variances(row) / weights[i];
    const Cholesky factor(s);
    Residual residual = at.residual;
    add_product<1, size, 6>(mean.data(), entries(at.by_error), residual.data(), Scalar(-1));
    u.weighted = factor.solve(residual);
    u.gain = factor.solve_rows(correlation);
    add_product<size, 6, 1>(correlation.data(), entries(u.weighted), mean.data());
    add_product<size, 6, size>(u.gain.data(), transposed_entries(correlation), p.data(),
                               Scalar(-1));
    symmetrise(p);
  }

  /// Backward pass: smoothed errors at the nodes, mean + P r.
  void smooth() {
    Vector r = Vector::Zero();
    smoothed_.resize(nodes.size());
    std::vector<Transition> steps;
    for (std::size_t k = nodes.size(); k-- > 0;) {
      const Node& node = nodes[k];
      smoothed_[k] = node.mean;
      add_product<Index::size, Index::size, 1>(node.covariance.data(), entries(r),
                                               smoothed_[k].data());
      for (std::size_t i = node.last_pose; i-- > node.first_pose;) {
        const Update& u = updates_[i];
        Residual pull = u.weighted;
        add_product<1, Index::size, 6>(r.data(), entries(u.gain), pull.data(), Scalar(-1));
        add_product<Index::size, 6, 1>(u.by_error.data(), entries(pull), r.data());
      }
      if (k == 0) break;
      steps.clear();
      InertialState<Scalar> x = nodes[k - 1].state;
      for (std::size_t j = nodes[k - 1].sample; j < node.sample; ++j) {
        const double dt = imu_[j + 1].time - imu_[j].time;
        const InertialSample<Scalar> sample = mean_sample(j, dt);
        steps.push_back(transition_of(x, sample, dt));
        x = move(x, sample, dt);
      }
      for (std::size_t m = steps.size(); m-- > 0;) {
        Eigen::Matrix<Scalar, 17, 1> pulled = Eigen::Matrix<Scalar, 17, 1>::Zero();
        add_product<1, 9, 17>(r.data(), entries(steps[m]), pulled.data());
        r.template head<9>().setZero();
        r.template head<17>() += pulled;
      }
    }
  }

  /// Adds the smoothed errors to trajectory and constants.
  Vector apply() {
    for (std::size_t k = 0; k < nodes.size(); ++k) {
      InertialTangent<Scalar> step = InertialTangent<Scalar>::Zero();
      step.template head<15>() = smoothed_[k].template head<15>();
      nodes[k].state = retract(nodes[k].state, step);
    }
    const Vector& last = smoothed_.back();
    constants.gravity += last.template segment<2>(Index::gravity);
    constants.marker_orientation =
        (constants.marker_orientation *
         quaternion_exp(last.template segment<3>(Index::marker_orientation)))
            .normalized();
    constants.marker_position += last.template segment<3>(Index::marker_position);
    constants.clock_offset += last(Index::clock);
    return last;
  }
};

}  // namespace tilt_ropter::detail
