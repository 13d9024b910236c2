// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

/// Are the wheels on the ground, where is it, and which part of the external wrench is its?
namespace tilt_ropter {

/// When the vehicle counts as on the ground. A load is the lift that the air does not give.
struct ContactEstimatorSettings {
  /// Share of the weight as load by which ground is met closer than leave_height to where it should
  /// be.
  double near_load = 0.10;
  /// The same anywhere else: more than what gusts do.
  double far_load = 0.30;
  /// Share of the weight as load that nothing but the ground gives, not even a vehicle much lighter
  /// than believed.
  double carried_load = 0.40;
  double leave_height = 0.030;  ///< above the ground and not carried: in the air [m]
  /// Not carried for unloaded_time, as in a take-off and not in a hop over a plank, it is in the
  /// air so long before its speed takes it there [s].
  double leave_lead = 0.1;
  double unloaded_time = 0.3;  ///< see leave_lead [s]
  /// In the air so far below where the wheels last stood, as after a table's edge, the ground is
  /// forgotten; until then it may only be lower than it was thought to be [m].
  double search_depth = 0.25;
  double load_time = 0.01;   ///< over which the load is averaged [s]
  double air_time = 0.5;     ///< over which what acts in the air is averaged, to be kept [s]
  double ground_time = 0.1;  ///< over which the ground's height is averaged [s]
  double slope_time = 0.4;   ///< over which the ground's slope is averaged [s]
  double max_slope = 0.5;    ///< of the ground, steeper is not believed
  /// Where the ground is taken to be until the vehicle has stood on it or flown below it; height
  /// -infinity: nothing is assumed.
  GroundPlane assumed_ground;
};

inline void validate(const ContactEstimatorSettings& s) {
  require_positive("ContactEstimatorSettings.near_load", s.near_load);
  require(std::isfinite(s.far_load) && s.far_load >= s.near_load,
          "ContactEstimatorSettings.far_load", s.far_load, "finite and >= near_load");
  require_positive("ContactEstimatorSettings.carried_load", s.carried_load);
  require_positive("ContactEstimatorSettings.leave_height [m]", s.leave_height);
  require_non_negative("ContactEstimatorSettings.leave_lead [s]", s.leave_lead);
  require_non_negative("ContactEstimatorSettings.unloaded_time [s]", s.unloaded_time);
  require_positive("ContactEstimatorSettings.search_depth [m]", s.search_depth);
  require_positive("ContactEstimatorSettings.load_time [s]", s.load_time);
  require_positive("ContactEstimatorSettings.air_time [s]", s.air_time);
  require_positive("ContactEstimatorSettings.ground_time [s]", s.ground_time);
  require_positive("ContactEstimatorSettings.slope_time [s]", s.slope_time);
  require_positive("ContactEstimatorSettings.max_slope", s.max_slope);
  require(s.assumed_ground.height < std::numeric_limits<double>::infinity(),
          "ContactEstimatorSettings.assumed_ground.height [m]", s.assumed_ground.height,
          "finite, or -infinity");
}

/// Load first, height second: a vehicle that is carried is on the ground, wherever the ground is,
/// and one that is not is in the air as soon as it has left the place where it was carried.
///
/// The ground is a plane through the lowest points of wheels or feet. Its height follows them while
/// they carry. Its slope follows the axle, which lies in it, the way that the vehicle rolls and,
/// where the undercarriage does not pitch, body x.
///
/// In the air the external wrench is a disturbance, all of it. On the ground the vertical force and
/// the roll torque are mostly the ground's, so the disturbance is what was last seen in the air, in
/// two parts corrected by what the ground cannot do: it only pushes, so lift that is missing on it
/// is missing in the air as well (a heavy vehicle, weak rotors), and freely turning wheels on one
/// axle give no pitch torque (a shifted CoM). A vehicle without an undercarriage is always in the
/// air, and all of the external wrench is a disturbance.
///
/// The observer is a filter and shows for a while what the ground did after it has let go. That
/// part is known and taken out. Nothing allocates; only the constructor throws.
class ContactEstimator {
 public:
  /// Throws std::invalid_argument for parameters or settings out of range.
  ContactEstimator(const RigidBodyParameters& body,
                   const std::optional<Undercarriage>& undercarriage,
                   const ContactEstimatorSettings& settings = {})
      : settings_(settings), weight_(body.mass * gravity), undercarriage_(undercarriage) {
    validate(body);
    if (undercarriage) validate(*undercarriage);
    validate(settings);
    estimate_ = in_the_air({});
    if (undercarriage) estimate_.ground = settings.assumed_ground;
  }
  template <int Rotors>
  explicit ContactEstimator(const Vehicle<Rotors>& vehicle,
                            const ContactEstimatorSettings& settings = {})
      : ContactEstimator(vehicle.body, undercarriage(vehicle), settings) {}

  /// Takes the state of the body (of the CoM) and what the observer has seen since the last call
  /// (its take_external()) at `time` [s]; once a tick or more often. Numbers that are not finite or
  /// beyond 1e6, or wrenches beyond ten times the weight (that at a metre), change nothing, nor
  /// does a time that is not after the last, unless by a second or more: the clock has been set.
  const ContactEstimate& update(double time, const BodyState<>& body,
                                WrenchObserver<>& observer) noexcept {
    return update(time, body, observer.take_external(), observer.settings().force_bandwidth,
                  observer.settings().torque_bandwidth, observer.unfiltered_force());
  }

  /// The same with an external wrench (body frame, at the CoM) from elsewhere, filtered to first
  /// order with these bandwidths [1/s]; infinite for one that is not filtered. `first` is the force
  /// without the filter's lag, asked for at the first update only: of a filter that has just begun
  /// its output says nothing.
  const ContactEstimate& update(double time, const BodyState<>& measured, const Wrench<>& external,
                                const Eigen::Vector3d& force_bandwidth,
                                const Eigen::Vector3d& torque_bandwidth,
                                const Eigen::Vector3d& first) noexcept {
    if (!std::isfinite(time) || !is_credible(measured, external) || !all_finite(first))
      return estimate_;
    BodyState<> body = measured;
    body.orientation.normalize();
    double dt = started_ ? time - time_ : 0.0;
    if (started_ && dt <= 0.0 && dt > -1.0) return estimate_;
    if (!undercarriage_) return update_in_the_air(time, external);
    dt = std::max(dt, 0.0);
    // What the observer's filter has passed since the last call, without its lag.
    const Wrench<> now = unfiltered(external, force_bandwidth, torque_bandwidth, dt);
    const double lift = started_
                            ? lift_ + share(dt, settings_.load_time) * (lift_of(now, body) - lift_)
                            : lift_of({first, Eigen::Vector3d::Zero()}, body);
    const double clearance = clearance_of(body);

    const bool was_on_ground = estimate_.on_ground;
    if (was_on_ground) {
      stay(body, external, lift, clearance, dt);
    } else {
      fade(left_over_, force_bandwidth, torque_bandwidth, dt);
      estimate_.disturbance = {external.force - left_over_.force,
                               external.torque - left_over_.torque};
      fly(body, lift, clearance, dt);
    }
    if (started_ && estimate_.on_ground != was_on_ground) ++mode_changes_;
    if (was_on_ground || estimate_.on_ground) estimate_.disturbance = air_;
    split(external, body.orientation);
    started_ = true;
    time_ = time;
    lift_ = lift;
    last_ = external;
    return estimate_;
  }

  [[nodiscard]] const ContactEstimate& estimate() const noexcept { return estimate_; }
  /// Changes of mode after the first update.
  [[nodiscard]] int mode_changes() const noexcept { return mode_changes_; }
  [[nodiscard]] const ContactEstimatorSettings& settings() const noexcept { return settings_; }

 private:
  // Of a vehicle with nothing to stand on.
  const ContactEstimate& update_in_the_air(double time, const Wrench<>& external) noexcept {
    estimate_.disturbance = external;
    started_ = true;
    time_ = time;
    return estimate_;
  }

  // Of wheels or feet over the ground [m].
  [[nodiscard]] double clearance_of(const BodyState<>& body) const noexcept {
    return body.position.z() - undercarriage_->height - estimate_.ground.height_at(body.position);
  }

  // Of the vehicle away from the ground [m/s].
  [[nodiscard]] double rising_of(const BodyState<>& body) const noexcept {
    return body.velocity.z() - estimate_.ground.slope.dot(body.velocity.head<2>());
  }

  // In the air, until a load says otherwise.
  void fly(const BodyState<>& body, double lift, double clearance, double dt) noexcept {
    const double load = lift - air_lift_, rising = rising_of(body);
    const bool near = std::abs(clearance) < settings_.leave_height;
    const double enough = (near ? settings_.near_load : settings_.far_load) * weight_;
    const bool stands = !started_ && near && body.velocity.norm() < 0.1;
    if (stands || (load > enough && rising < 0.1)) {
      estimate_.on_ground = estimate_.ground_known = true;
      unloaded_for_ = 0.0;
      if (!near) estimate_.ground.slope.setZero();
      set_air_lift(air_lift_, body);
      place_ground(body, 1.0);
      return;
    }
    if (load < 0.5 * enough) {
      const double part = share(dt, settings_.air_time);
      air_.force += part * (estimate_.disturbance.force - air_.force);
      air_.torque += part * (estimate_.disturbance.torque - air_.torque);
      air_lift_ = possible(air_lift_ + part * (lift_of(estimate_.disturbance, body) - air_lift_));
    }
    const double depth = estimate_.ground_known ? settings_.search_depth : settings_.leave_height;
    if (clearance < -depth) {  // it is not there
      estimate_.ground = {-std::numeric_limits<double>::infinity(), Eigen::Vector2d::Zero()};
      estimate_.ground_known = false;
    }
  }

  // On the ground, until the vehicle is neither carried nor where it was.
  void stay(const BodyState<>& body, const Wrench<>& external, double lift, double clearance,
            double dt) noexcept {
    // The ground only pushes, and wheels that turn freely do not pitch.
    if (lift < lift_of(air_, body)) set_air_lift(lift, body);
    if (undercarriage_->pitches) air_.torque.y() = external.torque.y();
    if (lift - lift_of(air_, body) > settings_.carried_load * weight_) {
      unloaded_for_ = 0.0;
      place_ground(body, share(dt, settings_.ground_time));
      learn_slope(body, share(dt, settings_.slope_time));
      return;
    }
    unloaded_for_ += dt;
    const double lead = unloaded_for_ > settings_.unloaded_time ? settings_.leave_lead : 0.0;
    if (std::abs(clearance) > settings_.leave_height ||
        clearance + lead * rising_of(body) > settings_.leave_height) {
      // No ground any more: the lift that there is is all the air's.
      estimate_.on_ground = false;
      air_lift_ = possible(lift);
      set_air_lift(air_lift_, body);
      left_over_ = {external.force - air_.force, external.torque - air_.torque};
    }
  }

  static double share(double dt, double time_constant) noexcept {
    return -std::expm1(-dt / time_constant);
  }

  static double lift_of(const Wrench<>& wrench, const BodyState<>& body) noexcept {
    return (body.orientation * wrench.force).z();
  }

  void set_air_lift(double lift, const BodyState<>& body) noexcept {
    air_.force += body.orientation.conjugate() *
                  Eigen::Vector3d(0.0, 0.0, possible(lift) - lift_of(air_, body));
  }

  // Lift of the air, of a vehicle heavier or lighter than believed, of rotors weaker or stronger.
  // Less is missing than what counts as carried: no error hides that the vehicle has left.
  [[nodiscard]] double possible(double lift) const noexcept {
    return std::clamp(lift, -0.9 * settings_.carried_load * weight_, 0.5 * weight_);
  }

  [[nodiscard]] bool is_credible(const BodyState<>& body, const Wrench<>& external) const noexcept {
    constexpr double most = 1e6;  // in comparisons that NaN does not pass
    const double largest = 10.0 * weight_;
    return is_finite(body) && body.orientation.norm() <= most && body.position.norm() <= most &&
           body.velocity.norm() <= most && external.force.norm() <= largest &&
           external.torque.norm() <= largest;
  }

  static Eigen::Vector3d kept(const Eigen::Vector3d& bandwidth, double dt) noexcept {
    return bandwidth.unaryExpr([dt](double k) { return std::exp(-k * dt); });
  }

  // The mean input of the first-order filters between the last output and this one.
  [[nodiscard]] Wrench<> unfiltered(const Wrench<>& external,
                                    const Eigen::Vector3d& force_bandwidth,
                                    const Eigen::Vector3d& torque_bandwidth,
                                    double dt) const noexcept {
    if (!(dt > 0.0) || dt > 0.5) return external;
    const auto undone = [dt](const Eigen::Vector3d& now, const Eigen::Vector3d& before,
                             const Eigen::Vector3d& bandwidth) {
      const Eigen::Array3d e = kept(bandwidth, dt).array();
      return Eigen::Vector3d((now.array() - e * before.array()) / (1.0 - e).max(1e-3));
    };
    return {undone(external.force, last_.force, force_bandwidth),
            undone(external.torque, last_.torque, torque_bandwidth)};
  }

  static void fade(Wrench<>& w, const Eigen::Vector3d& force_bandwidth,
                   const Eigen::Vector3d& torque_bandwidth, double dt) noexcept {
    w.force = w.force.cwiseProduct(kept(force_bandwidth, dt));
    w.torque = w.torque.cwiseProduct(kept(torque_bandwidth, dt));
  }

  void place_ground(const BodyState<>& body, double share) noexcept {
    GroundPlane& ground = estimate_.ground;
    constexpr double largest_step = 0.05;  // [m], of the height that is averaged
    if (!std::isfinite(ground.height)) ground.height = 0.0;
    const double off = clearance_of(body);
    ground.height += share == 1.0 ? off : share * std::clamp(off, -largest_step, largest_step);
  }

  // Turns the plane about the point under the vehicle.
  void learn_slope(const BodyState<>& body, double share) noexcept {
    GroundPlane& ground = estimate_.ground;
    Eigen::Vector2d slope = ground.slope;
    const auto learn = [&](const Eigen::Vector3d& line) {  // that lies in the plane
      const Eigen::Vector2d level = line.head<2>();
      slope += share * level * (line.z() - slope.dot(level)) / level.squaredNorm();
    };
    learn(body.orientation * Eigen::Vector3d::UnitY());
    if (!undercarriage_->pitches) learn(body.orientation * Eigen::Vector3d::UnitX());
    if (body.velocity.head<2>().norm() > 0.3) learn(body.velocity);
    if (!(slope.norm() < settings_.max_slope)) return;
    ground.height += (ground.slope - slope).dot(body.position.head<2>());
    ground.slope = slope;
  }

  void split(const Wrench<>& external, const Eigen::Quaterniond& orientation) noexcept {
    if (!estimate_.on_ground) {
      estimate_.rolling = estimate_.ground_reaction = {};
      return;
    }
    const Eigen::Vector3d normal = orientation.conjugate() * estimate_.ground.normal();
    Wrench<>&held = estimate_.ground_reaction, &free = estimate_.rolling;
    free = {external.force - normal.dot(external.force) * normal, external.torque};
    held = {normal.dot(external.force - air_.force) * normal, Eigen::Vector3d::Zero()};
    if (!undercarriage_->rolls) {
      free.force.setZero();
      held.force = external.force - air_.force;
    }
    const auto hold_torque = [&](int axis) {
      free.torque(axis) = 0.0;
      held.torque(axis) = external.torque(axis) - air_.torque(axis);
    };
    hold_torque(0);
    if (!undercarriage_->pitches) hold_torque(1);
    if (!undercarriage_->turns) hold_torque(2);
  }

  ContactEstimatorSettings settings_;
  double weight_;
  std::optional<Undercarriage> undercarriage_;
  ContactEstimate estimate_;
  Wrench<> air_;        // what acts in the air, averaged; kept on the ground
  Wrench<> left_over_;  // of the ground, in the observer's output
  Wrench<> last_;       // of the observer
  double air_lift_ = 0.0, lift_ = 0.0, time_ = 0.0, unloaded_for_ = 0.0;
  int mode_changes_ = 0;
  bool started_ = false;
};

}  // namespace tilt_ropter
