// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/names.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// Finds a failed rotor, a stuck servo or slow servos from the motion and the speeds of the rotors.
namespace tilt_ropter {

/// What has failed.
enum class FailureKind {
  none,
  servo,       ///< the rotor pushes in another direction than commanded
  rotor,       ///< the rotor pushes less than commanded
  slow_servos  ///< all servos follow later than modelled
};

[[nodiscard]] constexpr const char* to_string(FailureKind kind) noexcept {
  return detail::name_in({"none", "servo", "rotor", "slow_servos"}, kind);
}

/// Result of FailureDetector.
struct ActuatorFailure {
  FailureKind kind = FailureKind::none;
  std::size_t rotor = 0;       ///< index of the rotor; without meaning for slow servos
  double angle = 0.0;          ///< of a stuck servo [rad]
  double effectiveness = 1.0;  ///< of a weak rotor, a fraction; 0: lost
  double time = 0.0;           ///< of the report [s]
  double stddev = 0.0;         ///< standard deviation of the angle [rad]
  double time_constant = 0.0;  ///< of slow servos [s]
  bool limp = false;           ///< the servo does not hold this angle: its rotor has to stop
};

/// Returns the vehicle that remains after `failure`, see with_stuck_servo() and with_weak_rotor().
/// With slow servos it has their time constant; the rotor of a limp servo is lost.
template <int Rotors>
[[nodiscard]] Vehicle<Rotors> with_failure(const Vehicle<Rotors>& vehicle,
                                           const ActuatorFailure& failure) {
  switch (failure.kind) {
    case FailureKind::none:
      break;
    case FailureKind::servo:
      return failure.limp ? with_weak_rotor(vehicle, failure.rotor, 0.0)
                          : with_stuck_servo(vehicle, failure.rotor, failure.angle);
    case FailureKind::rotor:
      return with_weak_rotor(vehicle, failure.rotor, failure.effectiveness);
    case FailureKind::slow_servos: {
      Vehicle<Rotors> slower = vehicle;
      slower.servo.time_constant = failure.time_constant;
      return slower;
    }
  }
  return vehicle;
}

/// The difference between the wrench that moves the body and the wrench of the modelled actuators
/// is small in normal flight, and changes slowly. If one rotor fails, this residual changes within
/// a few ticks, and the change is the wrench of one force at this rotor, in the plane in which the
/// rotor tilts. For each rotor, the force that explains most of the change is found by least
/// squares. Together with the modelled force it gives the force that the rotor really has, and so
/// the angle of a stuck servo or what is left of the thrust. Wind, a wrong mass or a wrong time
/// constant change the wrench in ways that no single rotor explains.
///
/// Servos that are 4 or 8 times slower than modelled leave a residual that changes as their
/// angles would, also while the vehicle drives (its yaw torque). They are found if this explains
/// the changes for 1 to 2.5 s, on the ground 0.6 s, better than a wrong mass, one weak rotor or
/// servos of half the speed do.
///
/// In the first 0.5 s of a flight no normal residual is known. A failure from before is then found
/// by the whole residual. Otherwise it becomes a part of what is normal, and the angle of a servo
/// that is found later differs from the truth: its standard deviation says by how much.
///
/// A motor that stops is found earlier, also on the ground, by its measured speed: three readings
/// fall below 0.7 of the speed that the model expects. No reading counts that repeats or rises, so
/// wrong, late, coarse or frozen telemetry and a rotor that spins up are no failure. On the ground
/// a rotor that stands still for 0.4 s is lost, too, if the telemetry of other rotors changes.
/// Rotors that stop together were switched off.
///
/// A failed actuator is watched further. A servo whose arm moves on from the angle that was found
/// is limp. A weak rotor may get weaker, or be weaker than it seemed while the ground held a part
/// of the vehicle.
///
/// A failure that changes nothing is not found, such as a servo that sticks at the angle at which
/// it is commanded, or in the first 0.1 s of a flight, or with less than 20 ticks per second. On
/// wheels a rotor is missed only where the vehicle is free: along x, and turning about y and z.
/// That takes a fifth of its thrust in hover, 0.2 s, and a tenth of a second before, in which the
/// rotors hardly pushed.
///
/// Only the constructor throws. Nothing allocates.
template <int Rotors>
class FailureDetector {
 public:
  /// Throws std::invalid_argument if a parameter of the vehicle is out of range.
  explicit FailureDetector(const Vehicle<Rotors>& vehicle);

  /// Processes one tick at `time` [s]. `sample` is as for WrenchObserver::update(). `measured` has
  /// the measured rotor speeds and the modelled tilt angles since the last tick; `modelled_speed`
  /// [rad/s] is that of ActuatorModel. It replaces a measured speed that is more than 30 % off, as
  /// it is not finite or not measured. Set `airborne` to false if the vehicle touches the ground or
  /// may touch it, and `touches` to true if it touches an obstacle: then only the measured speeds
  /// show a failure. Returns the first failure that was found; reset() forgets it. Later only
  /// `limp` may become true, and `effectiveness` smaller. Ignores ticks with other numbers that are
  /// not finite or above 1e6.
  const ActuatorFailure& update(double time, const InertialSampled& sample,
                                const ActuatorState<Rotors>& measured,
                                const Eigen::Matrix<double, Rotors, 1>& modelled_speed,
                                bool airborne, bool touches = false) noexcept;

  [[nodiscard]] const ActuatorFailure& failure() const noexcept { return failure_; }

  /// Starts again, as after construction.
  void reset() noexcept {
    failure_ = {};
    started_ = false;
    forget();
  }

 private:
  // With these a failure is found that would crash the reference vehicle, and the errors of its
  // model raise no alarm (tests/actuation/failure_detector_test.cpp).
  static constexpr double window = 0.06;  // time over which forces and torques are averaged [s]
  // A failure is reported if it is the explanation this long [s].
  static constexpr double confirmation = 0.05;
  // Time constant with which the normal residual is learnt: wind, wrong mass, wrong thrust [s].
  static constexpr double baseline_time = 1.0;
  // After this time in the air it is known [s].
  static constexpr double known_after = 0.5;
  // Until then a rotor is lost that keeps less than this fraction of its thrust. For the reference
  // vehicle the same torque needs the CoM 2.5 cm off, and the same force a payload of 0.2 kg.
  static constexpr double max_weak_at_start = 0.4;
  // Smallest change of a rotor's force that is a failure, as a fraction of its thrust in hover.
  static constexpr double min_change = 0.35;
  // The same, as a fraction of this rotor's present thrust.
  static constexpr double min_fraction = 0.35;
  // Largest residual that the failure may leave unexplained, as a fraction of the residual.
  static constexpr double max_unexplained = 0.35;
  // On the ground: the smallest change that is a failure, and the largest thrust at which none
  // shows, as fractions of the thrust in hover. It has to last this long, and what is normal is
  // known after this time with so little thrust [s].
  static constexpr double min_change_on_ground = 0.2, without_thrust = 0.1,
                          confirmation_on_ground = 0.2, known_on_ground = 0.1;
  // A rotor whose force is smaller than this fraction of its model is lost.
  static constexpr double lost_fraction = 0.25;
  // The servo is all right if the force keeps its direction within this angle [rad].
  static constexpr double max_angle_error = 0.26;
  // A rotor whose measured speed is below this fraction of the expected speed is too slow. An empty
  // battery and a wrong thrust map leave 0.8.
  static constexpr double min_speed_fraction = 0.7;
  // It also lacks this fraction of the hover speed, because idle speeds differ by any factor.
  static constexpr double min_missing_speed = 0.25;
  static constexpr int falling_readings = 3;     // that show a motor that stops
  static constexpr double falling_time = 0.006,  // they take at least [s]
      standing_time = 0.4;                       // in which a motor starts to turn [s]
  // The expected speed follows a rise of the modelled speed with this time constant, because
  // telemetry is late and a rotor may be slower than its model [s].
  static constexpr double rise_time = 0.05;
  // Servos may be slower than modelled by these factors. The one that explains most is reported;
  // the first, as a healthy vehicle may have it, only if it begins to swing, and as the second.
  static constexpr std::array<double, 3> slower{2.0, 4.0, 8.0};
  // Slower changes of the residual are wind, a load or a wrong mass [s].
  static constexpr double change_time = 0.3;
  // Then the vehicle begins to swing: rms of the changes by servos, as a fraction of the weight.
  static constexpr double unstable_changes = 0.015;
  // Until then they explain at least this fraction of the changes. Healthy servos explain a fifth.
  static constexpr double min_explained = 0.25;
  // Slow servos explain the changes this long, less if they explain nearly all of them; on the
  // ground the changes of the yaw torque [s].
  static constexpr double slow_for = 2.5, surely_slow_for = 1.0, slow_on_ground_for = 0.6;
  // Changes are compared for about this time, because noise is as large as they are [s].
  static constexpr double servo_time = 3.0;
  // No servo is slower; the next finding would only repeat the last one [s].
  static constexpr double slowest_lag = 10.0;

  using Vector6 = Eigen::Matrix<double, 6, 1>;
  static constexpr int explanations = Rotors + static_cast<int>(slower.size());
  static constexpr int blocks = 6;             // of a window
  static constexpr double longest_gap = 0.05;  // between two ticks [s]

  /// Sums over a part of the window.
  struct Block {
    double duration = 0.0;
    Vector6 residual = Vector6::Zero(),  ///< force [N s] and torque [N s, by the longest arm]
        applied = Vector6::Zero();       ///< by the modelled actuators
    Eigen::Matrix<double, Rotors, 1> thrust = Eigen::Matrix<double, Rotors, 1>::Zero(),
                                     lateral = Eigen::Matrix<double, Rotors, 1>::Zero(),
                                     vertical = Eigen::Matrix<double, Rotors, 1>::Zero();
    /// Residual that the loss of each rotor would leave, then each slower servo.
    Eigen::Matrix<double, 6, explanations> left = Eigen::Matrix<double, 6, explanations>::Zero();
  };

  static constexpr std::size_t index(int i) { return static_cast<std::size_t>(i); }

  /// What the telemetry of a rotor shows.
  struct Telemetry {
    double expected = 0.0, last = 0.0;  ///< speed, last reading [rad/s]
    double slow_for = 0.0;              ///< [s]
    int falls = 0, others = 0;          ///< readings since then: that fell, of other rotors
  };

  [[nodiscard]] Vector6 scaled(const Wrenchd& wrench) const noexcept {
    Vector6 v;
    v << wrench.force, per_torque_ * wrench.torque;
    return v;
  }

  [[nodiscard]] Eigen::Vector3d gyroscopic_torque(const Eigen::Vector3d& w) const noexcept {
    return w.cross(parameters_.inertia * w);
  }

  // True if nothing more can be found out about the failure.
  [[nodiscard]] bool is_final() const noexcept {
    if (failure_.kind == FailureKind::servo) return failure_.limp;
    if (failure_.kind == FailureKind::rotor) return failure_.effectiveness == 0.0;
    return failure_.kind == FailureKind::slow_servos;
  }
  // The failed actuator misses another force than was found: its rotor pushes with `fraction` of
  // the force that it still should have.
  void worsen(double fraction) noexcept;
  // From now on with the failure that was found.
  void start_window() noexcept {
    filled_ = next_ = 0;
    suspect_ = -1;
  }
  void forget() noexcept;
  void watch_speeds(double time, double dt, const Eigen::Matrix<double, Rotors, 1>& measured,
                    const Eigen::Matrix<double, Rotors, 1>& modelled, bool airborne) noexcept;
  void add(double dt, const InertialSampled& sample,
           const ActuatorState<Rotors>& actuators) noexcept;
  void end_block(double time, const InertialSampled& sample) noexcept;
  void judge_servos(double time, const Block& block) noexcept;

  // A mean at first, then exponentially weighted.
  void learn(double dt, const Vector6& residual) noexcept {
    learnt_for_ += dt;
    const Vector6 change = residual - baseline_;
    baseline_ += dt / std::min(learnt_for_, baseline_time) * change;
  }

  // Compares the window with each failure.
  void judge(double time, double dt) noexcept;
  void judge_on_ground(double time, double dt) noexcept;
  [[nodiscard]] Block window_sum() const noexcept;

  // Force of rotor i (lateral, vertical) that explains most of `change`.
  [[nodiscard]] Eigen::Vector2d fit(int i, const Vector6& change) const noexcept;

  // `rest` is the residual that `force` does not explain.
  void report(double time, int rotor, const Eigen::Vector2d& force, double thrust, double angle,
              double rest) noexcept;

  ActuatedBody<Rotors> body_;
  RigidBodyParameters parameters_;
  double hover_thrust_ = 0.0, per_torque_ = 0.0, time_constant_ = 0.0;
  std::array<bool, static_cast<std::size_t>(Rotors)> tilts_{}, lost_{};
  std::array<Vector6, 2 * static_cast<std::size_t>(Rotors)> columns_;
  ActuatorFailure failure_;
  bool started_ = false, airborne_ = false, rolls_ = false;
  double time_ = 0.0, learnt_for_ = 0.0, suspected_for_ = 0.0;
  Eigen::Vector3d start_rate_ = Eigen::Vector3d::Zero(),  // at the start of the block [rad/s]
      gyroscopic_ = Eigen::Vector3d::Zero();              // at the last sample [N m]
  Block block_;
  std::array<Block, blocks> ring_;
  int filled_ = 0, next_ = 0, suspect_ = -1;
  Vector6 baseline_ = Vector6::Zero();
  std::array<Telemetry, static_cast<std::size_t>(Rotors)> telemetry_{};
  // Angles behind the modelled ones, of the slower servos [rad]; NaN: not started.
  std::array<Eigen::Matrix<double, Rotors, 1>, slower.size()> behind_;
  // Changes over time of the residual, of the modelled wrench, and of what explanations leave.
  struct Changes {
    Vector6 mean = Vector6::Zero();
    double size = 0.0, by_applied = 0.0, by_residual = 0.0;  ///< mean products
  };
  Changes residual_, applied_;
  std::array<Changes, index(explanations)> left_;
  Vector6 last_residual_;
  double noise_ = 0.0, watched_for_ = 0.0, slow_for_ = 0.0;
  Eigen::Matrix<double, Rotors, 1> hover_speed_;  // [rad/s]
};

template <int Rotors>
FailureDetector<Rotors>::FailureDetector(const Vehicle<Rotors>& vehicle)
    : body_(vehicle), parameters_(vehicle.body) {
  hover_thrust_ = vehicle.body.mass * gravity / Rotors;
  time_constant_ = vehicle.servo.time_constant;
  rolls_ = vehicle.wheels.has_value();
  forget();
  double arm = 0.0;
  for (const RotorGeometry& rotor : vehicle.rotors) arm = std::max(arm, rotor.position.norm());
  per_torque_ = 1.0 / std::max(arm, 1e-3);
  for (int i = 0; i < Rotors; ++i) {
    tilts_[index(i)] = vehicle.rotors[index(i)].tilts;
    lost_[index(i)] = !(vehicle.rotors[index(i)].effectiveness > 0.0);
    hover_speed_(i) = speed_from_thrust(hover_thrust_, rotor_parameters(vehicle, index(i)));
    for (const bool vertical : {false, true}) {
      ActuatedState<Rotors> one;
      one.thrust(i) = 1.0;
      one.tilt_angle(i) = vertical ? 0.0 : 0.5 * pi;
      columns_[index(2 * i + vertical)] = scaled(body_.wrench(one));
    }
  }
}

template <int Rotors>
const ActuatorFailure& FailureDetector<Rotors>::update(
    double time, const InertialSampled& sample, const ActuatorState<Rotors>& measured,
    const Eigen::Matrix<double, Rotors, 1>& modelled_speed, bool airborne, bool touches) noexcept {
  const double dt = time - time_;
  const auto plausible = [](const auto& values) {
    return (values.array().abs() <= 1e6).all();  // false for NaN
  };
  const bool valid = std::isfinite(time) && plausible(sample.specific_force) &&
                     plausible(sample.angular_velocity) && plausible(measured.tilt_angle) &&
                     plausible(modelled_speed);
  const bool is_found = failure_.kind != FailureKind::none;
  if (!valid || is_final()) return failure_;
  const bool in_time = started_ && dt > 0.0 && dt <= longest_gap;
  if (in_time && !is_found)
    watch_speeds(time, dt, measured.rotor_speed, modelled_speed, airborne);
  else
    telemetry_.fill({});
  if (!in_time || airborne != airborne_ || touches) {
    forget();
    started_ = true;
    airborne_ = airborne;
  } else {
    // A speed far from the model is that of a motor that fails, or a wrong measurement. The model
    // is right about the wrench that the body then misses, or does not miss.
    ActuatorState<Rotors> actuators{modelled_speed, measured.tilt_angle};
    for (int i = 0; i < Rotors; ++i)
      if (std::abs(measured.rotor_speed(i) - modelled_speed(i)) <
          (1.0 - min_speed_fraction) * modelled_speed(i))
        actuators.rotor_speed(i) = measured.rotor_speed(i);
    if (failure_.kind == FailureKind::servo)
      actuators.tilt_angle(static_cast<int>(failure_.rotor)) = failure_.angle;
    add(dt, sample, actuators);
    if (block_.duration >= window / blocks - 1e-6) end_block(time, sample);
  }
  time_ = time;
  gyroscopic_ = gyroscopic_torque(sample.angular_velocity);
  if (block_.duration == 0.0) start_rate_ = sample.angular_velocity;
  return failure_;
}

template <int Rotors>
void FailureDetector<Rotors>::forget() noexcept {
  block_ = {};
  filled_ = next_ = 0;
  learnt_for_ = 0.0;
  baseline_.setZero();
  suspect_ = -1;
  suspected_for_ = 0.0;
  for (auto& angles : behind_) angles.setConstant(std::numeric_limits<double>::quiet_NaN());
  residual_ = applied_ = {};
  left_.fill({});
  last_residual_.setZero();
  noise_ = watched_for_ = slow_for_ = 0.0;
}

template <int Rotors>
void FailureDetector<Rotors>::watch_speeds(double time, double dt,
                                           const Eigen::Matrix<double, Rotors, 1>& measured,
                                           const Eigen::Matrix<double, Rotors, 1>& modelled,
                                           bool airborne) noexcept {
  int changed = 0, slow = 0, stopped = -1;
  for (int i = 0; i < Rotors; ++i) changed += measured(i) != telemetry_[index(i)].last;
  for (int i = 0; i < Rotors; ++i) {
    Telemetry& rotor = telemetry_[index(i)];
    const double speed = measured(i), change = speed - rotor.last;
    rotor.last = speed;
    rotor.expected =
        std::min(modelled(i), rotor.expected + dt / rise_time * (modelled(i) - rotor.expected));
    const double missing = min_missing_speed * hover_speed_(i);
    const bool is_slow = speed < min_speed_fraction * rotor.expected &&
                         speed < rotor.expected - missing && !lost_[index(i)];
    if (!is_slow || change > 0.1 * missing) {
      rotor.slow_for = 0.0;
      rotor.falls = rotor.others = 0;
    }
    if (!is_slow) continue;
    ++slow;
    rotor.slow_for += dt;
    rotor.falls += change < 0.0;
    rotor.others += changed - (change != 0.0);
    const bool falls = rotor.falls >= falling_readings && rotor.slow_for >= falling_time,
               stands = speed < 0.1 * missing && rotor.others >= falling_readings &&
                        rotor.slow_for >= standing_time && !airborne;
    if (falls || stands) stopped = i;
  }
  if (stopped >= 0 && slow == 1)
    failure_ = {FailureKind::rotor, index(stopped), 0.0, 0.0, time, 0.0};
}

template <int Rotors>
void FailureDetector<Rotors>::add(double dt, const InertialSampled& sample,
                                  const ActuatorState<Rotors>& actuators) noexcept {
  ActuatedState<Rotors> x;
  for (int i = 0; i < Rotors; ++i) {
    x.thrust(i) = (index(i) == failure_.rotor ? failure_.effectiveness : 1.0) *
                  body_.thrust(i, actuators.rotor_speed(i));
    x.tilt_angle(i) = tilts_[index(i)] ? actuators.tilt_angle(i) : 0.0;
    block_.thrust(i) += dt * x.thrust(i);
    block_.lateral(i) += dt * x.thrust(i) * std::sin(x.tilt_angle(i));
    block_.vertical(i) += dt * x.thrust(i) * std::cos(x.tilt_angle(i));
  }
  for (int i = 0; i < Rotors; ++i)
    block_.left.col(i) -= dt * x.thrust(i) *
                          (std::sin(x.tilt_angle(i)) * columns_[index(2 * i)] +
                           std::cos(x.tilt_angle(i)) * columns_[index(2 * i + 1)]);
  for (std::size_t k = 0; k < slower.size(); ++k) {
    if (!all_finite(behind_[k])) behind_[k] = x.tilt_angle;
    // A lag of T instead of t: t / T of the angle, and the rest through the lag of T.
    const double lag = slower[k] * time_constant_;
    behind_[k] += (1.0 - std::exp(-dt / lag)) * (x.tilt_angle - behind_[k]);
    for (int i = 0; i < Rotors; ++i) {
      const double angle = x.tilt_angle(i),
                   late = angle + (1.0 - 1.0 / slower[k]) * (behind_[k](i) - angle);
      block_.left.col(Rotors + static_cast<int>(k)) +=
          dt * x.thrust(i) *
          ((std::sin(late) - std::sin(angle)) * columns_[index(2 * i)] +
           (std::cos(late) - std::cos(angle)) * columns_[index(2 * i + 1)]);
    }
  }
  const Wrenchd applied = body_.wrench(x);
  const Eigen::Vector3d gyroscopic = gyroscopic_torque(sample.angular_velocity),
                        sum = gyroscopic + gyroscopic_;
  const Wrenchd needed{parameters_.mass * sample.specific_force, 0.5 * sum};
  block_.residual += dt * scaled(needed);
  block_.residual -= dt * scaled(applied);
  block_.applied += dt * scaled(applied);
  block_.duration += dt;
}

template <int Rotors>
void FailureDetector<Rotors>::end_block(double time, const InertialSampled& sample) noexcept {
  const Eigen::Vector3d change = sample.angular_velocity - start_rate_;
  block_.residual += scaled({Eigen::Vector3d::Zero(), parameters_.inertia * change});
  const bool is_found = failure_.kind != FailureKind::none;
  // What leaves the window is learnt, unless the window may contain a failure.
  Block& oldest = ring_[index(next_)];
  if (airborne_ && filled_ == blocks && suspect_ < 0)
    learn(oldest.duration, oldest.residual / oldest.duration);
  const double dt = block_.duration;
  oldest = block_;
  block_ = {};
  next_ = (next_ + 1) % blocks;
  filled_ = std::min(filled_ + 1, blocks);
  if (!is_found) judge_servos(time, oldest);
  if (filled_ < blocks || (!is_found && failure_.kind != FailureKind::none)) return;
  if (airborne_)
    judge(time, dt);
  else if (!is_found && rolls_)
    judge_on_ground(time, dt);
}

template <int Rotors>
auto FailureDetector<Rotors>::window_sum() const noexcept -> Block {
  Block sum;
  for (const Block& block : ring_) {
    sum.duration += block.duration;
    sum.residual += block.residual;
    sum.thrust += block.thrust;
    sum.lateral += block.lateral;
    sum.vertical += block.vertical;
    sum.left += block.left;
  }
  return sum;
}

// On wheels the vehicle is free to move along x and to turn about y and z, on legs it is not: there
// a rotor that does not push is missed, and one that pushes sideways shows. What else acts there,
// such as a CoM off the axle, is in proportion to the load, and learnt while rotors hardly push.
template <int Rotors>
void FailureDetector<Rotors>::judge_on_ground(double time, double dt) noexcept {
  const Block sum = window_sum();
  const double per_second = 1.0 / sum.duration, weight = Rotors * hover_thrust_,
               load = per_second * sum.residual(2) / weight,
               least = min_change_on_ground * hover_thrust_;
  Vector6 free;
  free << 1.0, 0.0, 0.0, 0.0, 1.0, 1.0;
  const auto freely = [&free](double factor, const Vector6& v) {
    Vector6 product;
    for (int i = 0; i < 6; ++i) product(i) = factor * free(i) * v(i);
    return product;
  };
  Vector6 change = freely(per_second, sum.residual);
  if (per_second * sum.thrust.maxCoeff() < without_thrust * hover_thrust_ && load > 0.5)
    learn(dt, change / load);
  if (learnt_for_ < known_on_ground) return;
  change -= std::max(load, 0.0) * baseline_;
  const double leaning = 0.2 * std::max(load, 0.0) * weight;
  int best = -1;
  double unexplained = std::numeric_limits<double>::infinity(), push = 0.0;
  const auto compare = [&](int explanation, const Vector6& by_this) {
    Vector6 left = change - by_this;
    // A body that leans on its wheels feels a part of the load along x: only torques convict.
    left(0) -= std::clamp(left(0), -leaning, leaning);
    const double rest = left.norm(), size = by_this.template tail<3>().norm();
    if (!(size > least && rest < max_unexplained * size && rest < unexplained)) return false;
    best = explanation;
    unexplained = rest;
    return true;
  };
  for (int i = 0; i < Rotors; ++i) {
    if (lost_[index(i)]) continue;
    compare(i, freely(per_second, sum.left.col(i)));
    const Vector6 sideways = freely(1.0, columns_[index(2 * i)]);
    const double force = sideways.dot(change) / sideways.squaredNorm();
    if (tilts_[index(i)] && compare(Rotors + i, force * sideways)) push = force;
  }
  suspected_for_ = best >= 0 && best == suspect_ ? suspected_for_ + dt : 0.0;
  suspect_ = best;
  if (best < 0 || suspected_for_ < confirmation_on_ground) return;
  failure_ = {best < Rotors ? FailureKind::rotor : FailureKind::servo, index(best % Rotors)};
  failure_.time = time;
  if (best < Rotors) {
    failure_.effectiveness = 0.0;
    return;
  }
  const int i = best % Rotors;
  failure_.angle = std::atan2(per_second * sum.lateral(i) + push, per_second * sum.vertical(i));
  failure_.stddev = std::atan2(unexplained, per_second * sum.thrust(i));
  start_window();
}

template <int Rotors>
void FailureDetector<Rotors>::judge_servos(double time, const Block& block) noexcept {
  const double dt = block.duration;
  watched_for_ += dt;
  const double part = std::min(1.0, dt / std::min(change_time, watched_for_));
  double fades = std::min(1.0, dt / servo_time);
  // In the air the forces, because a wrong CoM and inertia change the torques in many ways. On the
  // ground only the turning is free.
  const auto change_of = [&](const Vector6& sum, Vector6& mean) {
    Vector6 counted = Vector6::Zero();
    for (int i = 0; i < 6; ++i) {
      const double change = sum(i) / dt - mean(i);
      mean(i) += part * change;
      if (airborne_ ? i < 3 : i == 5) counted(i) = change;
    }
    return counted;
  };
  const auto average = [&](const Vector6& a, const Vector6& b, double& product) {
    product += fades * (a.dot(b) - product);
  };
  if (watched_for_ < known_after) fades = 0.0;
  const Vector6 residual = change_of(block.residual, residual_.mean),
                applied = change_of(block.applied, applied_.mean);
  average(residual, residual, residual_.size);
  average(applied, applied, applied_.size);
  average(residual, applied, residual_.by_applied);
  // White noise from one block to the next: servos are slower.
  const Vector6 step = residual - last_residual_;
  noise_ += fades * (0.5 * step.squaredNorm() - noise_);
  last_residual_ = residual;
  const double gain = residual_.by_applied / (applied_.size + 1e-12);
  const double changes = residual_.size - gain * residual_.by_applied;
  const double unstable = unstable_changes * Rotors * hover_thrust_;
  bool is_slow = false;
  double most = 0.0, slowest = 1.0;
  for (int k = 0; k < explanations; ++k) {
    Changes& left = left_[index(k)];
    const Vector6 by_this = change_of(block.left.col(k), left.mean);
    average(by_this, by_this, left.size);
    average(by_this, applied, left.by_applied);
    average(by_this, residual, left.by_residual);
    // A wrong mass, inertia or thrust is a gain, which explains its part first.
    const double size = left.size - left.by_applied * left.by_applied / (applied_.size + 1e-12),
                 common = left.by_residual - gain * left.by_applied, slope = common / size,
                 explained = slope * common,
                 surely = slope - 5.0 * std::sqrt(changes * fades / 3.0 / size);
    const bool fits = k < Rotors ? slope > 0.0
                                 : surely > 0.5 && slope < 2.0 &&
                                       changes - explained < 2.0 * noise_ + 0.5 * explained;
    if (!fits || !(explained > most)) continue;
    is_slow = k >= Rotors && (!airborne_ || explained > unstable * unstable ||
                              (k > Rotors && explained > min_explained * changes));
    most = explained;
    slowest = slower[index(std::max(k - Rotors, 1))];
  }
  slow_for_ = is_slow ? slow_for_ + dt : 0.0;
  const double in_air = most > 0.85 * changes ? surely_slow_for : slow_for;
  if (slow_for_ < (airborne_ ? in_air : slow_on_ground_for)) return;
  if (slowest * time_constant_ > slowest_lag) return;
  failure_ = {FailureKind::slow_servos};
  failure_.time = time;
  failure_.time_constant = slowest * time_constant_;
}

template <int Rotors>
void FailureDetector<Rotors>::judge(double time, double dt) noexcept {
  const Block sum = window_sum();
  const double per_second = 1.0 / sum.duration;
  Vector6 change = per_second * sum.residual;
  if (learnt_for_ >= known_after) change -= baseline_;
  int best = -1;
  double least = max_unexplained * change.norm();
  Eigen::Vector2d force = Eigen::Vector2d::Zero();
  for (int i = 0; i < Rotors; ++i) {
    if (lost_[index(i)]) continue;
    const Eigen::Vector2d fitted = fit(i, change);
    const double rest =
        (change - columns_[index(2 * i)] * fitted(0) - columns_[index(2 * i + 1)] * fitted(1))
            .norm();
    const double needed =
        std::max(min_change * hover_thrust_, min_fraction * per_second * sum.thrust(i));
    if (!(rest < least) || !(fitted.norm() > needed)) continue;
    best = i;
    least = rest;
    force << per_second * sum.lateral(i) + fitted(0), per_second * sum.vertical(i) + fitted(1);
  }
  suspected_for_ = best >= 0 && best == suspect_ ? suspected_for_ + dt : 0.0;
  suspect_ = best;
  // By then nothing before the failure is left in the window.
  const double needed_time = std::max(confirmation, sum.duration - dt) - 1e-6;
  if (best < 0 || suspected_for_ < needed_time) return;
  if (failure_.kind != FailureKind::none) {
    if (index(best) == failure_.rotor) worsen(force.norm() / (per_second * sum.thrust(best)));
    return;
  }
  report(time, best, force, per_second * sum.thrust(best),
         std::atan2(sum.lateral(best), sum.vertical(best)), least);
}

template <int Rotors>
Eigen::Vector2d FailureDetector<Rotors>::fit(int i, const Vector6& change) const noexcept {
  const Vector6 &a = columns_[index(2 * i)], &b = columns_[index(2 * i + 1)];
  const double bb = b.dot(b), by = b.dot(change);
  if (!tilts_[index(i)]) return {0.0, by / bb};
  const double aa = a.dot(a), ab = a.dot(b), ay = a.dot(change), d = aa * bb - ab * ab;
  return {(bb * ay - ab * by) / d, (aa * by - ab * ay) / d};
}

template <int Rotors>
void FailureDetector<Rotors>::report(double time, int rotor, const Eigen::Vector2d& force,
                                     double thrust, double angle, double rest) noexcept {
  const double size = force.norm(), actual = std::atan2(force.x(), force.y());
  const double fraction = std::min(size / std::max(thrust, 1e-3), 1.0);
  const bool turned =
      tilts_[index(rotor)] && std::abs(std::remainder(actual - angle, 2.0 * pi)) > max_angle_error;
  // No failure makes a rotor push more than its model; a wrong measured speed seems to. At the
  // start a load off the CoM looks like a weak rotor.
  if (!turned && fraction >= (learnt_for_ < known_after ? max_weak_at_start : 1.0)) return;
  failure_.rotor = index(rotor);
  failure_.time = time;
  const bool is_lost = fraction < lost_fraction;
  if (turned && !is_lost) {
    failure_.kind = FailureKind::servo;
    failure_.angle = actual;
    // What is normal may be wrong by all of it.
    const double uncertain = learnt_for_ >= known_after ? fit(rotor, baseline_).norm() : 0.0;
    failure_.stddev = std::atan2(std::hypot(rest, uncertain), size);
  } else {
    failure_.kind = FailureKind::rotor;
    failure_.effectiveness = is_lost ? 0.0 : fraction;
  }
  start_window();
}

template <int Rotors>
void FailureDetector<Rotors>::worsen(double fraction) noexcept {
  if (failure_.kind == FailureKind::servo) {
    failure_.limp = true;
  } else if (fraction < 1.0) {
    const double left = fraction * failure_.effectiveness;
    failure_.effectiveness = left < lost_fraction ? 0.0 : left;
    start_window();
  }
}

}  // namespace tilt_ropter
