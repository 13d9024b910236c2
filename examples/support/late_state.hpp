#pragma once

#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <algorithm>
#include <array>
#include <cstddef>

namespace examples {

/// The state of now from one that arrives late, by the wrenches that were applied since. Does not
/// allocate.
class LateState {
 public:
  explicit LateState(const tilt_ropter::RigidBodyParameters& body) : body_(body) {}

  /// The wrench of the actuators at `time` [s] (body frame), in each tick. Kept for 32 ticks.
  void on_wrench(double time, const tilt_ropter::Wrenchd& applied) {
    if (count_ > 0 && !(time > newest().time)) count_ = 0;  // a clock that begins anew
    if (count_ == past_.size()) std::rotate(past_.begin(), past_.begin() + 1, past_.end());
    count_ = std::min(count_ + 1, past_.size());
    past_[count_ - 1] = {time, applied};
  }

  /// Time of the last on_wrench() [s], or a time before all others.
  [[nodiscard]] double last_time() const { return count_ > 0 ? newest().time : -1e9; }

  /// The applied wrench at `time` [s], between two that are known or at the next known time.
  [[nodiscard]] tilt_ropter::Wrenchd applied(double time) const {
    if (count_ == 0) return {};
    if (!(time > past_[0].time)) return past_[0].wrench;
    for (std::size_t i = 1; i < count_; ++i) {
      const Past &a = past_[i - 1], &b = past_[i];
      if (time > b.time) continue;
      const double u = (time - a.time) / (b.time - a.time);
      tilt_ropter::Wrenchd between;
      between.force = (1.0 - u) * a.wrench.force + u * b.wrench.force;
      between.torque = (1.0 - u) * a.wrench.torque + u * b.wrench.torque;
      return between;
    }
    return newest().wrench;
  }

  /// Returns the state at `time`, of which `body` was measured at `stamp` [s]. The `external`
  /// wrench (body frame) is constant meanwhile.
  [[nodiscard]] tilt_ropter::BodyStated at(double time, const tilt_ropter::BodyStated& body,
                                           double stamp,
                                           const tilt_ropter::Wrenchd& external) const {
    constexpr double longest = 0.01;  // step [s]
    tilt_ropter::Stated x;
    x.body = body;
    for (double t = stamp, next = 0.0; t < time; t = next) {
      next = std::min(time, t + longest);
      const double dt = next - t;
      x.wrench = applied(t);
      const tilt_ropter::Wrenchd end = applied(next);
      tilt_ropter::RigidBodyd::WrenchRate rate;
      rate << (end.force - x.wrench.force) / dt, (end.torque - x.wrench.torque) / dt;
      x = body_.step(x, rate, external, dt);
    }
    return x.body;
  }

 private:
  struct Past {
    double time;
    tilt_ropter::Wrenchd wrench;
  };
  [[nodiscard]] const Past& newest() const { return past_[count_ - 1]; }

  tilt_ropter::RigidBodyd body_;
  std::array<Past, 32> past_{};
  std::size_t count_ = 0;
};

}  // namespace examples
