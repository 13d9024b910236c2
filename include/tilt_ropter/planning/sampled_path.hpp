// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/detail/timing.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cstddef>
#include <string>
#include <vector>

/// Reference from samples, such as the output of a planner or a log.
namespace tilt_ropter {

/// Sample of a path at one time.
struct PathSample {
  double time = 0.0;                                   ///< [s]
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< CoM, world frame [m]
  double yaw = 0.0;                                    ///< heading about world z [rad]
};

/// Cubic spline through samples. It starts and ends at rest. Position, yaw and their first two
/// derivatives are continuous. The yaw takes the shorter way from sample to sample.
class SampledPath : public detail::Timing {
 public:
  /// Allocates. Throws std::invalid_argument with the index of the sample if there are fewer than
  /// two samples, if a number is not finite, or if the times do not increase by 1e-6 s or more.
  explicit SampledPath(const std::vector<PathSample>& samples) {
    require(samples.size() >= 2, "SampledPath.samples.size()", samples.size(), ">= 2");
    knots_.reserve(samples.size());
    for (std::size_t i = 0; i < samples.size(); ++i) {
      const PathSample& sample = samples[i];
      const std::string name = "SampledPath.samples[" + std::to_string(i) + "]";
      require_time(name + ".time [s]", sample.time);
      require_finite(name + ".position [m]", sample.position);
      require_finite(name + ".yaw [rad]", sample.yaw);
      const Eigen::Vector3d& p = sample.position;
      Knot knot{sample.time, {p.x(), p.y(), p.z(), sample.yaw}, {}};
      if (i > 0) {
        const Knot& last = knots_.back();
        require(knot.time - last.time >= 1e-6, name + ".time [s]", knot.time,
                "1e-6 or more after the sample before it, " + std::to_string(last.time));
        knot.value[3] = last.value[3] + yaw_of(quaternion_from_yaw(sample.yaw) *
                                               quaternion_from_yaw(last.value[3]).conjugate());
      }
      knots_.push_back(knot);
    }
    find_curvatures();
    from_ = knots_.front().time;
    set_timing(from_, knots_.back().time - from_);
  }

  /// The part of the path between two of its times [s], at the same times. Throws
  /// std::invalid_argument if the times are not in the path or not in this order.
  [[nodiscard]] SampledPath part(double from, double until) const {
    require_in("SampledPath::part from [s]", from, start_time(), end_time());
    require_in("SampledPath::part until [s]", until, from, end_time());
    SampledPath cut = *this;
    cut.from_ += from - start_time();
    cut.set_timing(from, until - from);
    return cut;
  }

  /// Returns the reference at `time` [s], for every time, see Timing. Does not throw or allocate.
  [[nodiscard]] ReferencePoint operator()(double time) const noexcept {
    const double inside = from_ + elapsed(time);
    const auto after =
        std::upper_bound(knots_.begin() + 1, knots_.end() - 1, inside,
                         [](double instant, const Knot& knot) { return instant < knot.time; });
    const Knot &a = *(after - 1), &b = *after;
    const double whole = b.time - a.time, y = (inside - a.time) / whole, x = 1.0 - y;
    Values value, rate, curvature;
    for (std::size_t k = 0; k < value.size(); ++k) {
      const double ca = a.curvature[k], cb = b.curvature[k];
      value[k] = x * a.value[k] + y * b.value[k] +
                 whole * whole / 6.0 * ((x * x * x - x) * ca + (y * y * y - y) * cb);
      rate[k] = (b.value[k] - a.value[k]) / whole +
                whole / 6.0 * ((1.0 - 3.0 * x * x) * ca + (3.0 * y * y - 1.0) * cb);
      curvature[k] = x * ca + y * cb;
    }
    ReferencePoint point;
    point.position = {value[0], value[1], value[2]};
    point.velocity = {rate[0], rate[1], rate[2]};
    point.acceleration = {curvature[0], curvature[1], curvature[2]};
    point.orientation = quaternion_from_yaw(value[3]);
    point.angular_velocity.z() = rate[3];
    point.angular_acceleration.z() = curvature[3];
    return point;
  }

 private:
  using Values = std::array<double, 4>;  // position, yaw
  struct Knot {
    double time;
    Values value, curvature;
  };

  // Second derivatives at the knots: the first derivative is continuous, and zero at both ends.
  // Solves the tridiagonal system by elimination.
  void find_curvatures() {
    const std::size_t last = knots_.size() - 1;
    std::vector<double> above(knots_.size());
    for (std::size_t i = 0; i <= last; ++i) {
      const double before = i > 0 ? knots_[i].time - knots_[i - 1].time : 0.0,
                   after = i < last ? knots_[i + 1].time - knots_[i].time : 0.0;
      Knot& knot = knots_[i];
      const double diagonal = (before + after) / 3.0 - (i > 0 ? before / 6.0 * above[i - 1] : 0.0);
      above[i] = after / 6.0 / diagonal;
      for (std::size_t k = 0; k < knot.value.size(); ++k) {
        double right = 0.0;
        if (i < last) right += (knots_[i + 1].value[k] - knot.value[k]) / after;
        if (i > 0) {
          right -= (knot.value[k] - knots_[i - 1].value[k]) / before;
          right -= before / 6.0 * knots_[i - 1].curvature[k];
        }
        knot.curvature[k] = right / diagonal;
      }
    }
    for (std::size_t i = last; i-- > 0;)
      for (std::size_t k = 0; k < 4; ++k)
        knots_[i].curvature[k] -= above[i] * knots_[i + 1].curvature[k];
  }

  std::vector<Knot> knots_;
  double from_ = 0.0;  // where the used part begins, in the knots' times [s]
};

}  // namespace tilt_ropter
