// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/obstacle_watch.hpp>
#include <tilt_ropter/estimation/detail/surface_touch.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/math/detail/clock.hpp>
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

/// Contact with the ground, the place of the ground, and its part of the external wrench.
namespace tilt_ropter {

/// Decides whether the vehicle is on the ground, by the load first and by the height second. A
/// vehicle that is carried is on the ground, at any height. A vehicle that is not carried is in the
/// air when it leaves the place where it was carried.
///
/// The load has two witnesses. The accelerometer feels it: external force upward. The motion shows
/// it: the change of the vertical velocity, which poses correct, against weight and applied
/// force. An accelerometer that lies, for example about the vibration of a rotor, feels ground in
/// mid-air; therefore both must agree, except near the expected ground. Where they contradict each
/// other for longer than vibration lasts, the disturbance follows the motion. A wrench from another
/// source (ObservedWrench::applied is unknown) has no second witness.
///
/// A vehicle that starts more than 0.3 m above the assumed ground, but feels its weight carried, is
/// taken for one whose rotors turn unknown to the actuator model, as after a take-over from another
/// controller: it is in the air, and the disturbance is zero until model and observer have settled
/// (0.5 s). To start on a table, give its height as the assumed ground.
///
/// The ground is a plane through the lowest points of wheels or feet. Its height follows these
/// points while they carry the vehicle. Its slope follows lines that lie in the plane: the axle and
/// the direction in which the vehicle rolls. If the undercarriage does not pitch, body x is a third
/// line.
///
/// In the air the whole external wrench is a disturbance. On the ground the vertical force and the
/// roll torque come mostly from the ground. The disturbance is then the last disturbance in the
/// air, with two corrections. The ground only pushes, so lift that is missing on the ground is also
/// missing in the air (a heavy vehicle, weak rotors). Freely turning wheels on one axle give no
/// pitch torque (a shifted CoM). A vehicle without an undercarriage is always in the air, and its
/// whole external wrench is a disturbance.
///
/// With a reference, the reaction of an unknown obstacle is told from wind
/// (ContactEstimate::blocked) and is not compensated: the vehicle then presses with 0.1 weights. On
/// wheels only the direction in which they roll counts. Where the reference pushes on a surface,
/// the surface's reaction is no part of the disturbance (ContactEstimate::surface_reaction). The
/// disturbance has limits: 0.3 weights sideways, one upward or downward, and 0.03 m times the
/// weight as a torque. ContactEstimate::limited says when it was cut.
///
/// After take-off the observer's output still contains a decaying part of the ground's wrench,
/// which is known and subtracted. Does not allocate. Only the constructor throws.
class ContactEstimator {
 public:
  /// `assumed_ground` is expected until the vehicle has stood on the ground or flown below it; with
  /// height -infinity, none. Throws std::invalid_argument if a parameter is out of range.
  ContactEstimator(const RigidBodyParameters& body,
                   const std::optional<Undercarriage>& undercarriage,
                   const GroundPlane& assumed_ground = {})
      : weight_(body.mass * gravity),
        undercarriage_(undercarriage),
        watch_(weight_),
        touch_(weight_) {
    validate(body);
    if (undercarriage) validate(*undercarriage);
    require(assumed_ground.height < std::numeric_limits<double>::infinity(),
            "ContactEstimator.assumed_ground.height [m]", assumed_ground.height,
            "finite, or -infinity");
    estimate_ = in_the_air({});
    if (undercarriage) estimate_.ground = assumed_ground;
    assumed_ground_ = estimate_.ground;
  }
  template <int Rotors>
  explicit ContactEstimator(const Vehicle<Rotors>& vehicle, const GroundPlane& assumed_ground = {})
      : ContactEstimator(vehicle.body, undercarriage(vehicle), assumed_ground) {}

  /// Processes the state of the body (of the CoM) at `time` [s] and what the observer knows then.
  /// Call it once per tick or more often: it uses the means since the last call. An external wrench
  /// from another source is a value of unfiltered_wrench(). `reference`: what the vehicle follows
  /// at `time`; without it no obstacle is found. Ignores numbers that are not finite or above 1e6.
  /// Ignores wrenches above ten times the weight (torque: ten times the weight at one metre).
  /// Ignores a time that is not after the last time, unless clock_was_set_back().
  const ContactEstimate& update(
      double time, const BodyStated& measured, const ObservedWrenchd& observed,
      const std::optional<ReferencePoint>& reference = std::nullopt) noexcept {
    auto means = means_between(observed_, observed);
    if (!started_)  // the output of a filter that has just started is meaningless
      means = {observed.external, observed.raw};
    else if (!means)
      means = {observed.external, observed.external};
    observed_ = observed;  // an outlier is not part of the next mean
    const Wrenchd& external = means->external;
    if (!std::isfinite(time) || !is_credible(measured) || !is_credible(external) ||
        !is_credible(means->raw) || !is_finite(observed.external))
      return estimate_;
    BodyStated body = measured;
    body.orientation.normalize();
    double dt = started_ ? time - time_ : 0.0;
    if (started_ && dt <= 0.0 && !clock_was_set_back(time, time_)) return estimate_;
    dt = std::max(dt, 0.0);
    estimate_.external = external;
    judge(body, means->raw, observed.applied, dt);
    const bool starts_carried = !started_ && lift_ > carried_load * weight_;
    if (starts_carried && !(undercarriage_ && clearance_of(body) < start_height))
      settling_ = settling_time;
    settling_ = std::max(0.0, settling_ - dt);
    if (settling_ > 0.0)
      estimate_.disturbance = {};
    else if (undercarriage_)
      decide(body, starts_carried, observed, dt);
    else
      estimate_.disturbance = external;
    if (settling_ == 0.0 && !estimate_.on_ground)
      estimate_.disturbance.force += body.orientation.conjugate() * unfelt();
    touch(body, external, means->raw, reference, dt);
    const bool moves = settling_ == 0.0 && estimate_.touches_for == 0.0 &&
                       (!estimate_.on_ground || undercarriage_->rolls);
    std::optional<Eigen::Vector3d> applied, track;
    if (observed.applied) applied = body.orientation * observed.applied->force;
    if (moves && estimate_.on_ground)
      track =
          body.orientation * roll_axis(body.orientation.conjugate() * estimate_.ground.normal());
    estimate_.blocked =
        watch_.update(body, body.orientation * external.force, body.orientation * means->raw.force,
                      applied, moves ? reference : std::nullopt, track, dt);
    Eigen::Vector3d& free = (estimate_.on_ground ? estimate_.rolling : estimate_.disturbance).force;
    free = body.orientation.conjugate() * watch_.held(body.orientation * free);
    limit(body);
    started_ = true;
    time_ = time;
    return estimate_;
  }

  [[nodiscard]] const ContactEstimate& estimate() const noexcept { return estimate_; }
  /// Number of changes between air and ground after the first update.
  [[nodiscard]] int mode_changes() const noexcept { return mode_changes_; }
  /// Time for which the ground has carried the vehicle without a break by both witnesses [s].
  [[nodiscard]] double standing_for() const noexcept { return standing_for_; }
  /// Upward external force that the accelerometer feels, mean over 0.1 s [N].
  [[nodiscard]] double felt_load() const noexcept { return felt_.z(); }
  /// The same by the motion; felt_load() if the applied wrench is unknown [N].
  [[nodiscard]] double load_by_motion() const noexcept { return moved_.z(); }

 private:
  // The load is the upward external force (lift) minus the lift that the air gives, here in
  // weights. Load that counts as contact within leave_height of the expected ground.
  static constexpr double near_load = 0.10;
  // Load that counts as contact at any other height. It must exceed the load of gusts.
  static constexpr double far_load = 0.30;
  // Load that only the ground can give, as a fraction of the weight. Above this load the vehicle
  // counts as carried. The value must exceed the error of the believed weight.
  static constexpr double carried_load = 0.40;
  // After one wheel has left, the other one may still touch. For this time [s] only so much load,
  // which the motion shows too, is a landing.
  static constexpr double one_wheel_time = 0.3, one_wheel_load = 0.5;
  // A vehicle that is not carried counts as in the air above this distance from the ground [m].
  static constexpr double leave_height = 0.030;
  // Lead of the take-off detection [s]. After unloaded_time, longer than a hop over a plank, the
  // vehicle counts as in the air if its speed will take it to leave_height within leave_lead.
  static constexpr double leave_lead = 0.1;
  static constexpr double unloaded_time = 0.3;  // time without load before leave_lead acts [s]
  // Depth below the last ground at which the ground is forgotten, such as behind the edge of a
  // table [m]. Up to this depth its height may only be overestimated.
  static constexpr double search_depth = 0.25;
  static constexpr double load_time = 0.01;  // time constant of the load's average [s]
  // Time constant of felt and moved force: the noise of a filter's velocity must cancel in it [s].
  static constexpr double motion_time = 0.1;
  // Difference of both that counts as noise, as a fraction of the weight.
  static constexpr double agreement = 0.1;
  // A vehicle that starts carried this high above the assumed ground is in the air [m].
  static constexpr double start_height = 0.3;
  // Until the actuator model follows the commands, and the observer has forgotten the start [s].
  static constexpr double settling_time = 0.5;
  // Depth of the true below the assumed ground up to which references were planned for it [m].
  static constexpr double planned_reach = 0.6;
  // Largest disturbance, as a fraction of the weight; the torque's has an arm [m].
  static constexpr double most_sideways = 0.3, most_vertical = 1.0, most_arm = 0.03;
  // Time constants of the averages of the wrench in the air, which is kept on the ground, and of
  // the ground's height and slope [s].
  static constexpr double air_time = 0.5, ground_time = 0.1, slope_time = 0.4;
  // Largest slope of the ground; a steeper estimate is ignored.
  static constexpr double max_slope = 0.5;

  // Asks both witnesses. `raw`: mean external wrench since the last update, without a filter's lag.
  void judge(const BodyStated& body, const Wrenchd& raw, const std::optional<Wrenchd>& applied,
             double dt) noexcept {
    const Eigen::Vector3d felt = body.orientation * raw.force;
    const Eigen::Vector3d thrust =
        applied ? body.orientation * applied->force : Eigen::Vector3d::Zero();
    lift_ += (started_ ? fraction(dt, load_time) : 1.0) * (felt.z() - lift_);
    // A state that jumps has not moved. Before its first sample an observer knows no thrust.
    const bool jumped = !((body.velocity - velocity_).norm() < 0.3 + 50.0 * dt);
    const bool begins = !started_ || (applied && !knows_thrust_);
    knows_thrust_ = applied.has_value();
    if (begins || jumped) {
      if (begins) felt_ = felt, thrust_ = thrust;
      slow_velocity_ =
          body.velocity -
          (begins ? motion_time / body_mass() * (felt + thrust - weight_ * Eigen::Vector3d::UnitZ())
                  : Eigen::Vector3d(velocity_ - slow_velocity_));
    }
    velocity_ = body.velocity;
    const double part = fraction(dt, motion_time);
    felt_ += part * (felt - felt_);
    thrust_ += part * (thrust - thrust_);
    slow_velocity_ += part * (body.velocity - slow_velocity_);
    moved_ = felt_;
    if (!applied) return;
    moved_ = body_mass() / motion_time * (body.velocity - slow_velocity_) - thrust_;
    moved_.z() += weight_;
  }

  [[nodiscard]] double body_mass() const noexcept { return weight_ / gravity; }

  // External force that the accelerometer does not feel, beyond what is noise; world frame [N].
  [[nodiscard]] Eigen::Vector3d unfelt() const noexcept {
    const Eigen::Vector3d difference = moved_ - felt_;
    const double size = difference.norm(), noise = agreement * weight_;
    return size > noise ? (difference * (1.0 - noise / size)).eval() : Eigen::Vector3d::Zero();
  }

  // Takes what the surface gives that the reference pushes on out of the disturbance.
  void touch(const BodyStated& body, const Wrenchd& external, const Wrenchd& raw,
             const std::optional<ReferencePoint>& reference, double dt) noexcept {
    const bool may_push = reference && settling_ == 0.0 && !estimate_.on_ground;
    const Eigen::Vector3d force =
        touch_.update(body, body.orientation * external.force, body.orientation * raw.force,
                      may_push ? &*reference : nullptr, dt);
    estimate_.touches_for = touch_.touches_for();
    estimate_.friction = touch_.friction();
    estimate_.push_correction = touch_.correction();
    estimate_.surface_reaction = {};
    if (estimate_.touches_for == 0.0) return;
    Wrenchd& given = estimate_.surface_reaction;
    given.force = body.orientation.conjugate() * force;
    given = transport(given, reference->push->surface.tool);
    estimate_.disturbance.force -= given.force;
    estimate_.disturbance.torque -= given.torque;
  }

  void limit(const BodyStated& body) noexcept {
    Wrenchd& d = estimate_.disturbance;
    Eigen::Vector3d force = body.orientation * d.force;
    const double side = force.head<2>().norm(), turn = d.torque.norm();
    const double side_limit = most_sideways * weight_, turn_limit = most_arm * weight_;
    // An obstacle that is not found must not wind up on the ground, either.
    estimate_.rolling.force *= side_limit / std::max(side_limit, estimate_.rolling.force.norm());
    estimate_.limited =
        side > side_limit || turn > turn_limit || std::abs(force.z()) > most_vertical * weight_;
    if (!estimate_.limited) return;
    if (side > side_limit) force.head<2>() *= side_limit / side;
    force.z() = std::clamp(force.z(), -most_vertical * weight_, most_vertical * weight_);
    d.force = body.orientation.conjugate() * force;
    if (turn > turn_limit) d.torque *= turn_limit / turn;
  }

  // Air or ground, for a vehicle with an undercarriage.
  void decide(const BodyStated& body, bool starts_carried, const ObservedWrenchd& observed,
              double dt) noexcept {
    const Wrenchd& external = estimate_.external;
    const double clearance = clearance_of(body);
    const bool was_on_ground = estimate_.on_ground;
    if (was_on_ground) {
      stay(body, clearance, dt);
    } else {
      for (int i = 0; i < 3; ++i) {
        left_over_.force(i) *= kept(observed.force_bandwidth(i), dt);
        left_over_.torque(i) *= kept(observed.torque_bandwidth(i), dt);
      }
      estimate_.disturbance = {external.force - left_over_.force,
                               external.torque - left_over_.torque};
      fly(body, starts_carried, clearance, dt);
    }
    if (!estimate_.on_ground) standing_for_ = 0.0;
    constexpr double a_while = 0.3;  // no bounce of a landing lasts as long [s]
    stood_ = estimate_.on_ground && (stood_ || standing_for_ > a_while);
    if (started_ && estimate_.on_ground != was_on_ground) ++mode_changes_;
    if (was_on_ground || estimate_.on_ground) estimate_.disturbance = air_;
    split(external, body.orientation);
  }

  // Height of wheels or feet above the ground [m].
  [[nodiscard]] double clearance_of(const BodyStated& body) const noexcept {
    return body.position.z() - undercarriage_->height - estimate_.ground.height_at(body.position);
  }

  // Speed of the vehicle away from the ground [m/s].
  [[nodiscard]] double rising_of(const BodyStated& body) const noexcept {
    return body.velocity.z() - estimate_.ground.rise(body.velocity);
  }

  // Update in the air, until a load indicates contact.
  void fly(const BodyStated& body, bool starts_carried, double clearance, double dt) noexcept {
    const double load = lift_ + unfelt().z() - air_lift_, rising = rising_of(body);
    one_wheel_for_ = std::max(0.0, one_wheel_for_ - dt);
    const bool near = std::abs(clearance) < leave_height;
    const bool left = one_wheel_for_ > 0.0;
    const double enough = (left ? one_wheel_load : near ? near_load : far_load) * weight_;
    const bool moves_carried = (near && !left) || moved_.z() - air_lift_ > 0.5 * enough;
    // The velocity of a filter that has just started is uncertain, the load of the ground is not.
    if (starts_carried || (load > enough && moves_carried && rising < 0.1)) {
      estimate_.on_ground = estimate_.ground_known = true;
      unloaded_for_ = 0.0;
      if (!near) estimate_.ground.slope.setZero();
      set_air_lift(air_lift_, body);
      place_ground(body, 1.0);
      return;
    }
    if (load < 0.5 * enough) {
      const double part = fraction(dt, air_time);
      air_.force += part * (estimate_.disturbance.force - air_.force);
      air_.torque += part * (estimate_.disturbance.torque - air_.torque);
      air_lift_ = possible(air_lift_ + part * (lift_of(estimate_.disturbance, body) - air_lift_));
    }
    const double depth = estimate_.ground_known ? search_depth : leave_height;
    if (clearance < -depth) {  // the ground is not there
      estimate_.ground = {-std::numeric_limits<double>::infinity(), Eigen::Vector2d::Zero()};
      estimate_.ground_known = false;
    }
  }

  // Update on the ground, until the vehicle is not carried and has left its place.
  void stay(const BodyStated& body, double clearance, double dt) noexcept {
    // The ground only pushes, and freely turning wheels give no pitch torque. What was sideways in
    // the air may be lift now: it has to stay possible, or the vehicle would seem carried anywhere.
    const double air = lift_of(air_, body), lift = lift_ + unfelt().z();
    if (lift < air || possible(air) != air) set_air_lift(std::min(lift, air), body);
    if (undercarriage_->pitches) air_.torque.y() = estimate_.external.torque.y();
    const double missing = lift_of(air_, body), enough = carried_load * weight_;
    const bool carried = lift - missing > enough;
    standing_for_ = carried && moved_.z() - missing > enough ? standing_for_ + dt : 0.0;
    if (carried && moved_.z() - missing > 0.5 * enough) {
      unloaded_for_ = 0.0;
      const double lower = assumed_ground_.height - estimate_.ground.height_at(body.position);
      if (lower > 0.01 && lower < planned_reach) estimate_.planned_height = assumed_ground_.height;
      place_ground(body, fraction(dt, ground_time));
      learn_slope(body, fraction(dt, slope_time));
      return;
    }
    unloaded_for_ += dt;
    const double lead = unloaded_for_ > unloaded_time ? leave_lead : 0.0;
    const bool one_wheel = one_wheel_stands(body, lift - missing);
    if (std::abs(clearance) > leave_height || one_wheel ||
        clearance + lead * rising_of(body) > leave_height) {
      one_wheel_for_ = one_wheel ? one_wheel_time : 0.0;
      // Without the ground, the whole lift comes from the air.
      estimate_.on_ground = false;
      air_lift_ = possible(lift_);
      set_air_lift(air_lift_, body);
      left_over_ = {estimate_.external.force - air_.force, estimate_.external.torque - air_.torque};
    }
  }

  // True if the axle has turned out of the ground: one of its wheels hardly carries, the other one
  // has left. From now on the body has to be held level.
  [[nodiscard]] bool one_wheel_stands(const BodyStated& body, double load) const noexcept {
    constexpr double most = 0.004, hardly = 0.15, rises = 0.01;  // [rad], of the weight, [m/s]
    const Eigen::Vector3d axle = body.orientation * Eigen::Vector3d::UnitY();
    return stood_ && undercarriage_->pitches && load < hardly * weight_ &&
           rising_of(body) > rises && std::abs(axle.dot(estimate_.ground.normal())) > most;
  }

  static double fraction(double dt, double time_constant) noexcept {
    return -std::expm1(-dt / time_constant);
  }

  static double lift_of(const Wrenchd& wrench, const BodyStated& body) noexcept {
    return (body.orientation * wrench.force).z();
  }

  void set_air_lift(double lift, const BodyStated& body) noexcept {
    air_.force += body.orientation.conjugate() *
                  Eigen::Vector3d(0.0, 0.0, possible(lift) - lift_of(air_, body));
  }

  // Clamps the lift of the air to what a wrong mass or wrong rotor thrust can cause. The missing
  // lift stays below carried_load, so no error hides that the vehicle has left the ground.
  [[nodiscard]] double possible(double lift) const noexcept {
    return std::clamp(lift, -0.9 * carried_load * weight_, 0.5 * weight_);
  }

  static bool is_credible(const BodyStated& body) noexcept {
    constexpr double most = 1e6;
    return is_finite(body) && body.orientation.norm() <= most && body.position.norm() <= most &&
           body.velocity.norm() <= most;
  }
  [[nodiscard]] bool is_credible(const Wrenchd& w) const noexcept {  // NaN fails the comparisons
    return w.force.norm() <= 10.0 * weight_ && w.torque.norm() <= 10.0 * weight_;
  }

  // What a first-order filter keeps of its last output.
  static double kept(double bandwidth, double dt) noexcept {
    return dt > 0.0 ? std::exp(-bandwidth * dt) : 1.0;  // also for an infinite bandwidth
  }

  void place_ground(const BodyStated& body, double fraction) noexcept {
    GroundPlane& ground = estimate_.ground;
    constexpr double largest_step = 0.05;  // [m], limit of the averaged height error
    if (!std::isfinite(ground.height)) ground.height = 0.0;
    const double off = clearance_of(body);
    ground.height +=
        fraction == 1.0 ? off : fraction * std::clamp(off, -largest_step, largest_step);
  }

  // Rotates the plane about the point under the vehicle.
  void learn_slope(const BodyStated& body, double fraction) noexcept {
    GroundPlane& ground = estimate_.ground;
    Eigen::Vector2d slope = ground.slope;
    const auto learn = [&](const Eigen::Vector3d& line) {  // `line` lies in the plane
      const double x = line.x(), y = line.y();
      const double part = fraction * (line.z() - slope.x() * x - slope.y() * y) / (x * x + y * y);
      slope += Eigen::Vector2d(part * x, part * y);
    };
    learn(body.orientation * Eigen::Vector3d::UnitY());
    if (!undercarriage_->pitches) learn(body.orientation * Eigen::Vector3d::UnitX());
    if (body.velocity.head<2>().norm() > 0.3) learn(body.velocity);
    if (!(slope.norm() < max_slope)) return;
    ground.height += (ground.slope - slope).dot(body.position.head<2>());
    ground.slope = slope;
  }

  void split(const Wrenchd& external, const Eigen::Quaterniond& orientation) noexcept {
    if (!estimate_.on_ground) {
      estimate_.rolling = estimate_.ground_reaction = {};
      return;
    }
    const Eigen::Vector3d normal = orientation.conjugate() * estimate_.ground.normal();
    Wrenchd &held = estimate_.ground_reaction, &free = estimate_.rolling;
    free = {external.force - normal.dot(external.force) * normal, external.torque};
    held = {normal.dot(external.force - air_.force) * normal, Eigen::Vector3d::Zero()};
    if (!undercarriage_->rolls) {
      free.force.setZero();
      held.force = external.force - air_.force;
    }
    const auto hold_torque = [&](const Eigen::Vector3d& axis) {
      free.torque -= axis.dot(free.torque) * axis;
      held.torque += axis.dot(external.torque - air_.torque) * axis;
    };
    // Both wheels of an axle hold the rotation about the direction in which they roll.
    hold_torque(undercarriage_->pitches ? roll_axis(normal) : Eigen::Vector3d::UnitX());
    if (!undercarriage_->pitches) hold_torque(Eigen::Vector3d::UnitY());
    if (!undercarriage_->turns) hold_torque(Eigen::Vector3d::UnitZ());
  }

  double weight_;
  std::optional<Undercarriage> undercarriage_;
  detail::ObstacleWatch watch_;
  detail::SurfaceTouch touch_;
  GroundPlane assumed_ground_;
  ContactEstimate estimate_;
  Wrenchd air_;               // average wrench in the air; kept on the ground
  Wrenchd left_over_;         // ground's part that remains in the observer's output
  ObservedWrenchd observed_;  // at the last update
  // World frame, all averaged over motion_time but the first: velocity, force of the actuators, and
  // the external force as felt and as the motion shows it.
  Eigen::Vector3d velocity_ = Eigen::Vector3d::Zero(), slow_velocity_ = velocity_;
  Eigen::Vector3d thrust_ = velocity_, felt_ = velocity_, moved_ = velocity_;
  double air_lift_ = 0.0, lift_ = 0.0, time_ = 0.0, unloaded_for_ = 0.0, one_wheel_for_ = 0.0;
  double settling_ = 0.0, standing_for_ = 0.0;  // [s]
  int mode_changes_ = 0;
  bool started_ = false, knows_thrust_ = false, stood_ = false;
};

}  // namespace tilt_ropter
