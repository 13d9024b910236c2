// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/estimation/detail/delayed_filter.hpp>
#include <tilt_ropter/estimation/detail/ekf_settings.hpp>
#include <tilt_ropter/estimation/detail/ekf_start.hpp>
#include <tilt_ropter/estimation/detail/ekf_trust.hpp>
#include <tilt_ropter/estimation/detail/error_state_filter.hpp>
#include <tilt_ropter/estimation/detail/fix_witness.hpp>
#include <tilt_ropter/estimation/detail/measurement_faults.hpp>
#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

/// Decides what Ekf does with each measurement and each IMU sample. Nothing here throws or
/// allocates. Times are in the clock of the IMU [s].
namespace tilt_ropter::detail {

/// What Ekf does with a measurement or an IMU sample. The last three use a measurement after they
/// have widened a noise or forgotten the heading. `start_over` restarts at a position although it
/// does not move like the IMU.
enum class Action {
  use,
  wait,
  drop,
  restart,
  start_over,
  widen_accelerometer,
  widen_gyro,
  forget_heading
};

/// Decision about a measurement or an IMU sample.
struct Verdict {
  Action action = Action::use;
  EkfStatus status = EkfStatus::updated;  ///< for the caller
  bool clock_changed = false;             ///< measurements that wait have wrong stamps
  KnownAtStart known = {};                ///< for a start or restart at a pose
  bool needs_motion = false;              ///< a motion has to confirm the restart
  bool position_only = false;             ///< the orientation of the pose is not used
  double latency = 0.0;                   ///< of the stamps, found by this pose [s]
};

/// A pose and the time between its stamp and its arrival [s].
template <typename Scalar>
struct ArrivedPose {
  MarkerPose<Scalar> pose;
  double lag;
};

/// Judges IMU samples and measurements at their arrival, by values and stamps: use, wait or drop.
/// Judges measurements when the filter is at their time, by the innovation: use, drop or restart.
template <typename Scalar>
class MeasurementGuard {
 public:
  using Filter = DelayedFilter<Scalar>;

  explicit MeasurementGuard(const EkfSettings& settings) noexcept : settings_(settings) {
    last_used_.fill(never);
  }

  [[nodiscard]] Scalar nis() const noexcept { return nis_; }
  [[nodiscard]] const EkfCounts& counts() const noexcept { return counts_; }
  [[nodiscard]] const StampMonitor& stamps() const noexcept { return stamps_; }
  /// Orientations that have stepped are turned back.
  [[nodiscard]] const OrientationStep<Scalar>& turn() const noexcept { return turn_; }
  /// Poses by their noise among each other.
  [[nodiscard]] const PoseContinuity<Scalar>& continuity() const noexcept { return continuity_; }
  [[nodiscard]] const HeadingNoise& heading() const noexcept { return heading_; }
  /// Too few poses have confirmed the start.
  [[nodiscard]] bool has_just_started() const noexcept { return used_since_start_ < 25; }

  /// Judges an IMU sample. `restart`: the first, after a gap, or after a step to late_since().
  Verdict on_imu(double time, const InertialSample<Scalar>& sample, const Filter& filter) noexcept {
    if (!std::isfinite(time) || !within(sample.angular_velocity, 1e3) ||
        !within(sample.specific_force, 1e5))
      return {Action::drop, EkfStatus::rejected};
    const double newest = filter.newest().time, pause = time - newest;
    const bool has_imu = filter.has_imu(), is_late = has_imu && pause < 0.0;
    if (has_imu && pause == 0.0) return {Action::drop, EkfStatus::duplicate};
    if (is_late) {
      // The clock was set back if several samples in a row are late but follow each other.
      late_samples_ = late_samples_ > 0 && time <= late_time_ ? 1 : late_samples_ + 1;
      if (late_samples_ == 1) late_since_ = time;
      late_time_ = time;
      if (late_samples_ < std::min(settings_.max_rejections, 5))
        return {Action::drop, EkfStatus::late};
    }
    late_samples_ = 0;
    repetitions_.on_imu(sample);
    if (!has_imu) return {Action::restart};
    // Over a pause or a clock step, the estimate goes on along its path: late poses look alike.
    constexpr double longest_pause = 0.02, doubt = 1.0;  // [s]
    if (!is_late && pause > longest_pause) refused_until_ = std::max(refused_until_, time + doubt);
    if (!is_late && pause <= settings_.max_imu_gap) return {};
    if (!is_late) return {Action::restart, EkfStatus::stopped};
    const double step = late_since_ - newest;
    for (double& last : last_used_) last += step;
    for (double* last :
         {&last_pose_, &full_restart_, &restarted_, &doubtful_until_, &trial_end_, &refused_until_})
      *last += step;
    compared_ = never;
    for (GateMonitor<Scalar>& gate : gates_) gate.clear();
    fixes_ = {};
    constexpr bool clock_changed = true;
    return {Action::restart, EkfStatus::stopped, clock_changed};
  }
  [[nodiscard]] double late_since() const noexcept { return late_since_; }

  /// Judges a pose that arrives with this corrected stamp. `has_room`: it may wait.
  Verdict on_pose(double stamp, const MarkerPose<Scalar>& pose, bool has_room,
                  const Filter& filter) noexcept {
    using std::abs;
    if (!std::isfinite(stamp) || !within(pose.position, 1e6) ||
        !(abs(pose.orientation.norm() - Scalar(1)) < Scalar(0.1)))
      return drop(EkfStatus::rejected);
    if (!filter.has_imu()) return drop(EkfStatus::early);
    if (counts_.used > 0 && stamp == received_) return drop(EkfStatus::duplicate);
    received_ = stamp;
    faults_.poses_frozen = repetitions_.repeats(pose);
    if (faults_.poses_frozen) return drop(EkfStatus::frozen);
    stamps_.on_stamp(stamp);
    const double newest = filter.newest().time;
    const Verdict verdict = when(stamp, newest, has_room);
    return verdict.action == Action::drop ? drop(verdict.status, newest - stamp) : verdict;
  }

  /// Judges another measurement that arrives.
  template <typename Measurement>
  Verdict on_measurement(double time, const Measurement& measurement, bool has_room,
                         const Filter& filter) noexcept {
    if (!std::isfinite(time)) return {Action::drop, EkfStatus::rejected};
    if (!filter.has_imu()) return {Action::drop, EkfStatus::early};
    if (const Vector3<Scalar>* value = vector_of<Scalar>(measurement)) {
      const bool repeats = repetitions_.repeats(*value);
      if (is_position(kind_of<Measurement>)) faults_.poses_frozen = repeats;
      if (repeats) return {Action::drop, EkfStatus::frozen};
    }
    return when(time, filter.newest().time, has_room);
  }

  /// Judges a pose of this `time`, which the filter has reached unless the pose is late, by its
  /// innovation at the state of the filter. After `use` or `restart` comes on_used().
  Verdict judge(double time, const ArrivedPose<Scalar>& arrived,
                const MeasurementInnovation<Scalar, 6>& innovation, const Filter& filter) noexcept {
    if (time == compared_) return drop(EkfStatus::duplicate);
    if (time < filter.time()) return drop(EkfStatus::late, arrived.lag);
    compared_ = time;
    // With such an attitude error an update is far from linear.
    constexpr double linear = 0.3;  // [rad]
    if (!filter.running()) return start(time, filter.stopped_at(), arrived.lag, filter);
    if (largest_stddev(filter.filter().covariance(), InertialIndex::orientation) > linear)
      return start_over(time, arrived.lag, start(time, last_pose_, arrived.lag, filter));
    GateMonitor<Scalar>& gate = gates_[0];
    const PoseComparison<Scalar> c = compare(arrived.pose, filter);
    continuity_.on_pose(time, c, settings_.pose_noise.orientation);
    const double small = std::max(0.1, 6.0 * c.noise);  // the controller can follow [m]
    if (passes(innovation) && gate.accepts(time, c.distance, small, settings_.restart_time)) {
      stamps_.on_used(arrived.lag);
      turn_.end();
      surprise(false);
      if (++used_since_start_ >= enough) wrong_starts_ = 0;
      Verdict verdict;
      const auto found = static_cast<double>(filter.filter().latency());
      if (time > trial_end_)
        verdict.latency = end_trial(time, mean_nis_ > std::max(1.5, nis_before_));
      else if (std::abs(found) > std::max(least_latency, stamps_.stddev()))
        verdict.latency = try_latency(time, found, 1.2 * mean_nis_);
      return use(time, verdict);
    }
    if (filter.is_bridged()) return start(time, filter.stopped_at(), arrived.lag, filter);
    if (has_turned(innovation)) {
      turn_.on_pose(time, c, settings_.pose_noise.orientation);
      stamps_.on_used(arrived.lag);
      Verdict verdict;
      verdict.position_only = true;
      return use(time, verdict);
    }
    gate.on_gated(time, c);
    const double offset = latency_of(innovation);
    if (const double found = stamps_.on_displaced(offset); found != 0.0) {
      (void)try_latency(time, found, inconsistent);
      return drop(EkfStatus::gated);
    }
    if (gate.gated() >= (std::isfinite(offset) ? many : some) && trial_end_ < infinity) {
      (void)end_trial(time, true);
      return drop(EkfStatus::gated);
    }
    surprise(!std::isfinite(offset) && continuity_.positions_continue() && !continuity_.turned() &&
             !is_noise(c, few_stddevs));
    const Action contradiction = which_is_wrong(time, c, offset, filter);
    if (contradiction != Action::drop) {
      stamps_.on_used(arrived.lag);
      return use(time, Verdict{contradiction});
    }
    const int needed = settings_.max_rejections;
    // Poses that continue those that were used have not been displaced.
    const bool is_displaced = !continuity_.positions_continue() &&
                              gate.moves_like_imu(time, needed, settings_) &&
                              gate.tilt() < Scalar(0.1);
    const Scalar far(60);  // no valid pose has such a NIS
    const bool is_far = !(distance_of(c) <= close);
    const bool start_was_wrong = has_just_started() && (is_far || wrong_starts_ < most_starts) &&
                                 gate.is_confirmed() && nis_ > far &&
                                 gate.smooth() >= std::min(5, needed);
    const bool is_lost = time - last_pose_ >= settings_.full_restart_time && gate.is_confirmed() &&
                         gate.smooth() >= needed && gate.extent() > 0.3;
    if (!is_displaced && !start_was_wrong && !is_lost) return drop(EkfStatus::gated, arrived.lag);
    Verdict verdict{Action::restart, EkfStatus::restarted};
    verdict.known.all_but_place = is_displaced;
    verdict.known.marker_frame = counts_.used > 0;
    verdict.needs_motion = !start_was_wrong;
    if (is_displaced) return use(time, verdict);
    turn_ = {};
    forget_latency();
    used_since_start_ = 0;
    wrong_starts_ += start_was_wrong;
    if (is_lost) verdict = start_over(time, arrived.lag, verdict);
    return use(time, verdict);
  }

  /// Processes the `position` of the estimate [m] after a pose was used with this verdict.
  void on_used(const Verdict& verdict, const Vector3<Scalar>& position) noexcept {
    continuity_.on_used();
    if (verdict.action != Action::restart) return gates_[0].on_used(position);
    if (verdict.needs_motion) return gates_[0].on_restart(position);
    gates_[0].clear();
  }

  /// Judges another measurement, linearised at the state of the filter. If it is a position or a
  /// velocity, `part` is that part of the state, and `restart` concerns it alone.
  template <typename Linear>
  Verdict judge(MeasurementKind kind, int part, const Linear& at,
                const MeasurementInnovation<Scalar, Linear::rows>& innovation,
                const Filter& filter) noexcept {
    const bool is_likely = passes(innovation);
    if constexpr (Linear::rows == 1) {
      using std::sqrt;
      const Scalar noise = at.noise(0, 0), believed = noise / Scalar(heading_.factor());
      if (kind == MeasurementKind::heading) {
        heading_.add(static_cast<double>(at.residual(0) /
                                         sqrt(innovation.covariance(0, 0) - noise + believed)));
        if (heading_.contradicts() && !heading_known_) {
          heading_ = {};
          heading_known_ = true;
          use(filter.time(), kind);
          return {Action::forget_heading};
        }
      }
    }
    if constexpr (Linear::rows == 3 || Linear::rows == 6) {
      constexpr bool is_pose = Linear::rows == 6;
      GateMonitor<Scalar>& gate = gates_[is_pose ? 3 : is_position(kind) ? 1 : 2];
      if (is_position(kind) || (kind == MeasurementKind::velocity && !is_pose))
        return judge_series(kind, compare(part, at, filter), is_likely, filter, gate);
    }
    return is_likely ? use(filter.time(), kind) : Verdict{Action::drop, EkfStatus::gated};
  }

  /// Processes a measurement that is too late or too early.
  void on_mistimed(MeasurementKind kind) noexcept { faults_.poses_mistimed |= is_position(kind); }

  /// Processes a start at `time` by other means than a measurement.
  void on_start(double time) noexcept {
    gates_ = {};
    heading_ = {};
    fixes_ = {};
    heading_known_ = false;
    last_pose_ = time;
    used_since_start_ = 0;
  }

  /// Processes a restart with the heading that a motion has shown.
  void on_heading(double time) noexcept {
    on_start(time);
    on_restart(time);
    heading_known_ = true;
  }

  /// Ages of the measurements at `now`, and the faults of poses if the filter has `started`.
  [[nodiscard]] EstimateTrust report(double now, bool started) const noexcept {
    EstimateTrust t = started ? faults_ : EstimateTrust();
    for (std::size_t i = 0; i < t.age.size(); ++i) t.age[i] = age(now, last_used_[i]);
    t.restarted = now < doubtful_until_;
    t.inconsistent = mean_nis_ > inconsistent || heading_.contradicts();
    for (const GateMonitor<Scalar>& gate : gates_) t.unconfirmed |= !gate.is_confirmed();
    t.latency = stamps_.latency();
    t.orientation_unused = turn_.is_open();
    t.marker_turned = turn_.is_known();
    return t;
  }

 private:
  static constexpr double infinity = std::numeric_limits<double>::infinity(), never = -infinity;
  /// After so many restarts at once the start is right, and the IMU is wrong.
  static constexpr int most_starts = 2;
  static constexpr int enough = 100;              ///< poses that make a start right
  static constexpr double least_latency = 0.003;  ///< that is corrected [s]
  static constexpr double inconsistent = 3.0;     ///< mean NIS of a row
  /// Gated poses that show more than an outlier, and those that show a latency.
  static constexpr int some = 3, many = 12;
  /// Of the noise of poses among each other, which explain a pose above the gate.
  static constexpr double few_stddevs = 4.0;
  static constexpr double close = 0.5;  ///< to an estimate that a wrong IMU has moved [m]

  static constexpr bool is_position(MeasurementKind kind) noexcept {
    return kind == MeasurementKind::pose || kind == MeasurementKind::position;
  }
  static bool within(const Vector3<Scalar>& v, double limit) noexcept {
    return all_finite(v) && v.cwiseAbs().maxCoeff() <= Scalar(limit);
  }
  static double velocity_stddev(const Filter& filter) noexcept {
    return std::min(0.3, largest_stddev(filter.filter().covariance(), InertialIndex::velocity));
  }

  /// Judges the time of a measurement.
  [[nodiscard]] Verdict when(double time, double newest, bool has_room) const noexcept {
    if (time <= newest - settings_.fusion_delay) return {};
    if (time > newest + settings_.max_delay || !has_room) return {Action::drop, EkfStatus::early};
    return {Action::wait, EkfStatus::waiting};
  }

  /// Compares the NIS with the gate, which has the same probability for any number of rows.
  template <int Rows>
  bool passes(const MeasurementInnovation<Scalar, Rows>& innovation) noexcept {
    nis_ = innovation.distance;
    nis_per_row_ = static_cast<double>(nis_) / Rows;
    return innovation.is_definite && nis_ <= Scalar(gate_of(Rows));
  }
  [[nodiscard]] double gate_of(std::size_t rows) const noexcept {
    constexpr std::array<double, 6> quantile = {15.14, 18.42, 21.11, 23.51, 25.74, 27.86};
    return settings_.gate * quantile[rows - 1] / quantile[5];
  }

  /// Drops a pose. With its `lag` [s], corrects the clock if all poses have arrived alike.
  Verdict drop(EkfStatus status) noexcept {
    ++(status == EkfStatus::gated ? counts_.gated : counts_.unused);
    if (status == EkfStatus::frozen) ++counts_.frozen;
    return {Action::drop, status};
  }
  Verdict drop(EkfStatus status, double lag) noexcept {
    (status == EkfStatus::gated ? faults_.poses_gated : faults_.poses_mistimed) = true;
    Verdict verdict = drop(status);
    verdict.clock_changed = stamps_.on_unused(lag, settings_.max_rejections);
    if (!verdict.clock_changed) return verdict;
    ++counts_.clock_steps;
    gates_[0].clear();
    return verdict;
  }

  /// Judges a position, velocity or pose after the series of gated ones before it.
  Verdict judge_series(MeasurementKind kind, const PoseComparison<Scalar>& c, bool is_likely,
                       const Filter& filter, GateMonitor<Scalar>& gate) noexcept {
    const double time = filter.time();
    const bool is_place = is_position(kind);
    const auto speed = static_cast<double>(filter.filter().state().velocity.norm());
    if (is_likely && gate.accepts(time, c.distance, 6.0 * c.noise, settings_.restart_time)) {
      gate.on_used(c.predicted.position);
      fixes_.on_used(is_place, time, c, speed);
      // Until a motion has shown it, the heading is what start() was told.
      constexpr double known = 0.03;  // [rad]
      heading_known_ |= heading_stddev(filter.filter()) < known;
      return use(time, kind);
    }
    gate.on_gated(time, c);
    fixes_.on_gated(is_place, time, c);
    faults_.poses_gated |= is_place;
    if (fixes_.convicts_imu(is_place, heading_.contradicts()) && gate.is_confirmed() &&
        !filter.filter().is_widest()) {
      gate.on_used(c.predicted.position);
      fixes_.on_used(is_place, time, c, speed);
      use(time, kind);
      const bool gyro = heading_.contradicts() || filter.filter().is_wider();
      return {gyro ? Action::widen_gyro : Action::widen_accelerometer};
    }
    // An estimate without positions errs without limit. A receiver that has lost its satellites may
    // stand still.
    const bool is_lost =
        is_place &&
        time - last_used_[static_cast<std::size_t>(kind)] >= settings_.full_restart_time &&
        gate.smooth() >= settings_.max_rejections && gate.extent() > 0.3 + 8.0 * c.noise;
    if (is_lost) {
      gates_ = {};
      fixes_ = {};
      on_restart(time);
      use(time, kind);
      return {Action::start_over, EkfStatus::restarted};
    }
    if (!gate.moves_like_imu(time, std::min(5, settings_.max_rejections), settings_) ||
        !(c.measured.orientation.angularDistance(c.predicted.orientation) < Scalar(0.1)))
      return {Action::drop, EkfStatus::gated};
    gate.on_restart(c.predicted.position);
    on_restart(time);
    use(time, kind);
    return {Action::restart, EkfStatus::restarted};
  }

  Verdict use(double time, MeasurementKind kind) noexcept {
    last_used_[static_cast<std::size_t>(kind)] = time;
    constexpr double memory = 50.0;  // measurements
    mean_nis_ += (std::min(nis_per_row_, 5.0) - mean_nis_) / memory;
    if (is_position(kind)) faults_.poses_gated = faults_.poses_mistimed = false;
    return {};
  }
  void on_restart(double time) noexcept {
    const bool again = time - restarted_ < 10.0;
    doubtful_until_ = time + (again ? 5.0 : 1.0);
    restarted_ = time;
    nis_per_row_ = mean_nis_ = 1.0;
  }
  /// Uses a pose.
  Verdict use(double time, const Verdict& verdict) noexcept {
    if (verdict.status == EkfStatus::restarted) {
      ++counts_.restarts;
      on_restart(time);
    }
    if (verdict.position_only) nis_per_row_ = 1.0;
    ++counts_.used;
    last_pose_ = time;
    use(time, MeasurementKind::pose);
    return verdict;
  }
  /// Changes the latency of the stamps by `found` [s], on trial: what is used in the next second
  /// must have a mean NIS below `nis`. Returns the change [s].
  double try_latency(double time, double found, double nis) noexcept {
    if (time < refused_until_) return 0.0;
    if (trial_end_ == infinity) {
      nis_before_ = nis;
      latency_before_ = stamps_.latency();
    }
    trial_end_ = time + 1.0;
    return stamps_.on_latency(found, settings_.max_delay);
  }
  /// Ends the trial. If it `failed`, takes the latency back. Returns the change [s].
  double end_trial(double time, bool failed) noexcept {
    trial_end_ = infinity;
    if (!failed) return 0.0;
    refused_until_ = time + 10.0;
    return stamps_.on_latency(latency_before_ - stamps_.latency(), settings_.max_delay);
  }
  void forget_latency() noexcept {
    trial_end_ = infinity;
    stamps_.on_latency(-stamps_.latency(), settings_.max_delay);
  }
  /// Starts or restarts at a pose. The estimate is that of the time `since`.
  Verdict start(double time, double since, double lag, const Filter& filter) noexcept {
    Verdict verdict{Action::restart, EkfStatus::started};
    if (filter.started()) verdict.status = EkfStatus::restarted;
    // After a long series of gated poses on a smooth path, the velocity or the biases are wrong.
    const bool is_wrong = gates_[0].smooth() >= settings_.max_rejections;
    if (is_wrong) forget_latency();
    verdict.known = {counts_.used > 0, filter.started() && !is_wrong, time - since};
    stamps_.on_used(lag);
    used_since_start_ = wrong_starts_ = 0;
    return use(time, verdict);
  }

  /// If two estimates in a row do not last for full_restart_time, marker frame or clock are wrong.
  Verdict start_over(double time, double lag, Verdict verdict) noexcept {
    if (last_pose_ - full_restart_ < settings_.full_restart_time) {
      verdict.known.marker_frame = false;
      verdict.clock_changed = stamps_.swap_clocks(lag, settings_.max_delay);
    }
    full_restart_ = time;
    return verdict;
  }

  /// Decides which side is wrong if a pose is above the gate: the IMU if the poses continue each
  /// other. `drop`: the poses, or not known yet.
  [[nodiscard]] Action which_is_wrong(double time, const PoseComparison<Scalar>& c, double offset,
                                      const Filter& filter) const noexcept {
    constexpr double shortest = 0.045;  // a jump of the poses shows within this time [s]
    const double noise = settings_.pose_noise.orientation;
    const double distance = distance_of(c), turn = turn_of(c);
    // Poses that are late err along the path, as those beside a wrong accelerometer do.
    const bool may_be_late = std::isfinite(offset) && !filter.filter().is_wider();
    // A pose alone convicts again, and must be no outlier.
    const bool again = filter.filter().is_wider() && used_since_start_ >= enough;
    const int gated = gates_[0].gated();
    if ((has_just_started() && wrong_starts_ < most_starts && gated < settings_.max_rejections) ||
        filter.filter().is_widest() || !gates_[0].is_confirmed() ||
        !continuity_.positions_continue() || is_noise(c, again ? 6.0 : few_stddevs) ||
        !(distance <= close))
      return Action::drop;
    const bool often = surprised_ > 0.15;
    if (!again && !often &&
        (gated < (may_be_late ? many : some) || !(time - last_pose_ >= shortest)))
      return Action::drop;
    return turn / noise > distance / c.noise ? Action::widen_gyro : Action::widen_accelerometer;
  }

  /// True if the orientation of a pose above the gate has stepped, and its position has not.
  [[nodiscard]] bool has_turned(const MeasurementInnovation<Scalar, 6>& in) const noexcept {
    if (!turn_.is_open() && !(continuity_.turned() && used_since_start_ >= 2 * enough))
      return false;
    const Vector3<Scalar> residual = in.residual.template head<3>();
    const detail::Cholesky factor(Matrix3<Scalar>(in.covariance.template topLeftCorner<3, 3>()));
    return factor.is_definite && residual.dot(factor.solve(residual)) <= Scalar(gate_of(3));
  }

  static double distance_of(const PoseComparison<Scalar>& c) noexcept {
    return static_cast<double>((c.measured.position - c.predicted.position).norm());
  }
  static double turn_of(const PoseComparison<Scalar>& c) noexcept {
    return static_cast<double>(c.measured.orientation.angularDistance(c.predicted.orientation));
  }
  [[nodiscard]] bool is_noise(const PoseComparison<Scalar>& c, double most) const noexcept {
    return continuity_.is_noise(distance_of(c), turn_of(c), most);
  }
  /// Counts a pose that was compared. An IMU whose error swings contradicts the poses for less time
  /// at once than an outlier of the poses may last, but again and again.
  void surprise(bool surprising) noexcept {
    constexpr double memory = 50.0;  // poses
    surprised_ += ((surprising ? 1.0 : 0.0) - surprised_) / memory;
  }

  PoseComparison<Scalar> compare(const MarkerPose<Scalar>& pose,
                                 const Filter& filter) const noexcept {
    const InertialState<Scalar>& x = filter.filter().state();
    const MarkerPose<Scalar> here{x.position + x.orientation * x.marker_position,
                                  x.orientation * x.marker_orientation};
    const auto distance =
        (pose.position - here.position).norm() + pose.orientation.angularDistance(here.orientation);
    const double jitter = static_cast<double>(x.velocity.norm()) * stamps_.stddev(),
                 noise = std::hypot(settings_.pose_noise.position, jitter);
    return {pose, here, static_cast<double>(distance), noise, velocity_stddev(filter)};
  }
  template <typename Linear>
  static PoseComparison<Scalar> compare(int part, const Linear& at, const Filter& filter) noexcept {
    using std::sqrt;
    const bool is_place = part == InertialIndex::position;
    const InertialState<Scalar>& x = filter.filter().state();
    const MarkerPose<Scalar> here{is_place ? x.position : x.velocity};
    const Vector3<Scalar> off = displacement<Scalar>(part, at);
    MarkerPose<Scalar> there{here.position + off};
    if constexpr (Linear::rows == 6)
      there.orientation = quaternion_exp(Vector3<Scalar>(
          x.orientation *
          (at.jacobian.template block<3, 3>(3, InertialIndex::orientation).transpose() *
           at.residual.template tail<3>())));
    const auto noise = sqrt(at.noise.diagonal().template head<3>().maxCoeff());
    // Error by tilt and bias [m/s^2]: the filter restarts at velocities only after a motion.
    constexpr double acceleration = 0.3;
    return {there, here, static_cast<double>(off.norm()), static_cast<double>(noise),
            is_place ? velocity_stddev(filter) : acceleration};
  }

  /// Latency of a gated pose [s], infinite unless it explains the innovation and motion shows it.
  [[nodiscard]] double latency_of(const MeasurementInnovation<Scalar, 6>& in) const noexcept {
    constexpr double stddev = 0.003;  // [s]
    const Eigen::Matrix<Scalar, 6, 1> weighted = detail::Cholesky(in.covariance).solve(in.by_time);
    const auto score = static_cast<double>(weighted.dot(in.residual)),
               information = static_cast<double>(weighted.dot(in.by_time));
    const bool is_explained =
        information > 1.0 / (stddev * stddev) &&
        static_cast<double>(in.distance) - score * score / information <= settings_.gate;
    return is_explained ? -score / information : infinity;
  }

  EkfSettings settings_;
  EkfCounts counts_;
  RepetitionDetector<Scalar> repetitions_;
  StampMonitor stamps_;
  PoseContinuity<Scalar> continuity_;  ///< of on_pose()
  HeadingNoise heading_;
  FixWitness<Scalar> fixes_;
  bool heading_known_ = true;                 ///< since start()
  OrientationStep<Scalar> turn_;              ///< of on_pose()
  std::array<GateMonitor<Scalar>, 4> gates_;  ///< of on_pose(), positions, velocities, poses
  std::array<double, static_cast<std::size_t>(measurement_kinds)> last_used_;
  EstimateTrust faults_;                       ///< what happened to poses and positions
  double received_ = 0.0;                      ///< stamp of the last pose that arrived
  double compared_ = never;                    ///< time of the last pose compared
  double last_pose_ = 0.0;                     ///< time of the last pose used
  double full_restart_ = never;                ///< time of the last restart after full_restart_time
  double late_time_ = 0.0, late_since_ = 0.0;  ///< of the last and the first late IMU sample
  int late_samples_ = 0;                       ///< consecutive
  double restarted_ = never, doubtful_until_ = never;  ///< last restart, see EstimateTrust
  /// Share of the last poses above the gate that continue each other and are not late.
  double surprised_ = 0.0;
  double nis_per_row_ = 1.0, mean_nis_ = 1.0;  ///< of the last one, of those that were used
  /// Of the latency: end of its trial, time before the next one, what is taken back, largest NIS.
  double trial_end_ = infinity, refused_until_ = never, latency_before_ = 0.0, nis_before_ = 0.0;
  int used_since_start_ = 0;  ///< poses
  int wrong_starts_ = 0;      ///< consecutive
  Scalar nis_ = Scalar(0);
};

}  // namespace tilt_ropter::detail
