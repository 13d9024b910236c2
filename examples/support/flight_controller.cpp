#include "flight_controller.hpp"

#include <tilt_ropter/estimation/ekf.hpp>

#include <algorithm>
#include <cmath>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>

namespace examples {

using namespace tilt_ropter;

std::string describe(const ActuatorFailure& failure) {
  std::ostringstream text;
  text.precision(2);
  switch (failure.kind) {
    case FailureKind::none:
      return "nothing has failed";
    case FailureKind::rotor:
      text << "rotor " << failure.rotor + 1 << " gives " << 100.0 * failure.effectiveness
           << " % of its thrust";
      break;
    case FailureKind::servo:
      text << "the servo of rotor " << failure.rotor + 1;
      if (failure.limp)
        text << " does not hold its angle";
      else
        text << " is stuck at " << failure.angle * 180.0 / pi << " deg";
      break;
    case FailureKind::slow_servos:
      text << "the servos are slow: " << failure.time_constant << " s";
      break;
  }
  return text.str();
}

// What both levels have.
template <int Rotors>
FlightController<Rotors>::FlightController(const Vehicle<Rotors>& vehicle,
                                           const EkfSettings& estimation,
                                           const WrenchObserverSettings& observer,
                                           ExternalWrench external,
                                           const ActuatorNmpcSettings& after_failure)
    : body_(vehicle),
      actuators_(vehicle),
      ekf_(estimation),
      observer_(vehicle.body, observer),
      by_poses_(vehicle.body),
      clock_offset_(estimation.clock_offset),
      contact_(vehicle),
      external_(external),
      late_(vehicle.body),
      vehicle_(vehicle),
      detector_(vehicle),
      after_failure_(after_failure) {
  allow_passes_after_failure();
}

template <int Rotors>
FlightController<Rotors>::FlightController(const Vehicle<Rotors>& vehicle,
                                           const NmpcSettings& settings,
                                           const EkfSettings& estimation,
                                           const WrenchObserverSettings& observer,
                                           const AllocationSettings& allocation,
                                           ExternalWrench external, bool solved_by_nlopt_alone)
    : FlightController(vehicle, estimation, observer, external, actuator_nmpc_settings(vehicle)) {
  after_failure_.time_limit = settings.time_limit;
  after_failure_.ground = settings.ground;
  if (!has_wrench_level<Rotors>)
    throw std::invalid_argument("FlightController: the wrench level needs 4 rotors or more");
  if constexpr (has_wrench_level<Rotors>) {
    allocation_.emplace(vehicle, allocation);
    if (solved_by_nlopt_alone)
      nmpc_by_nlopt_.emplace(vehicle, settings);
    else
      nmpc_.emplace(vehicle, settings);
  }
}

template <int Rotors>
FlightController<Rotors>::FlightController(const Vehicle<Rotors>& vehicle,
                                           const ActuatorNmpcSettings& settings,
                                           const EkfSettings& estimation,
                                           const WrenchObserverSettings& observer,
                                           ExternalWrench external)
    : FlightController(vehicle, estimation, observer, external, settings) {
  actuator_nmpc_.emplace(vehicle, settings);
}

// A vehicle that has begun to tumble is saved by plans that are solved: with 6 passes, 2 of 143
// failures at the wrench level ended upside down. With 12 these two land.
template <int Rotors>
void FlightController<Rotors>::allow_passes_after_failure() {
  int& passes = after_failure_.solver.program.max_passes;
  passes = std::max(passes, 12);
}

template <int Rotors>
void FlightController<Rotors>::start_with(const ActuatorState<Rotors>& command) {
  sent_.command = command;
  rotor_speeds_ = command.rotor_speed;
  actuators_.reset(command);
}

template <int Rotors>
ActuatorState<Rotors> FlightController<Rotors>::lift(double force) const {
  Wrenchd wrench;
  wrench.force.z() = force;
  if constexpr (has_wrench_level<Rotors>)
    if (allocation_) return allocation_->allocate(wrench, {}).command;
  return actuator_nmpc_->command_for(wrench);
}

template <int Rotors>
Wrenchd FlightController<Rotors>::wrench_of(const ActuatorState<Rotors>& actuators) const {
  if constexpr (has_wrench_level<Rotors>)
    if (allocation_) return allocation_->wrench(actuators);
  return body_.wrench(actuators);
}

template <int Rotors>
void FlightController<Rotors>::on_voltage(double voltage) {
  if (actuators_.set_voltage(voltage)) voltage_ = voltage;
  set_voltage(std::min(voltage, actuators_.usable_voltage()));
}

template <int Rotors>
void FlightController<Rotors>::set_voltage(double voltage) {
  if (actuator_nmpc_) (void)actuator_nmpc_->set_voltage(voltage);
  if constexpr (has_wrench_level<Rotors>)
    if (allocation_) (void)allocation_->set_voltage(voltage);
  at_wrench_level([voltage](auto& nmpc) { (void)nmpc.set_voltage(voltage); });
}

template <int Rotors>
void FlightController<Rotors>::on_imu(double stamp, const InertialSampled& sample) {
  const double time = imu_clock_.on_sample(stamp);
  applied_ = measures_speeds_ ? actuators_.update(time, sent_.command, rotor_speeds_)
                              : actuators_.update(time, sent_.command);
  ekf_.on_imu(time, sample);
  const InertialSampled corrected = ekf_.corrected(sample);
  if (!started_) {
    // With the bias, which explains a wrong unit away.
    const Eigen::Vector3d force =
        corrected.specific_force + ekf_.filter().state().accelerometer_bias;
    constexpr int most = 50;  // samples
    felt_samples_ = std::min(felt_samples_ + 1, most);
    felt_ += (force - felt_) / felt_samples_;
  }
  const bool as_modelled = external_ != ExternalWrench::commanded;
  const Wrenchd applied = wrench_of(as_modelled ? applied_ : sent_.command);
  by_poses_.predict(time, applied);
  by_poses_.compare(corrected, applied, airborne_);
  const bool is_convicted =
      ekf_.filter().is_much_wider() && (by_poses_flies_ || by_poses_.contradicts_imu());
  // The prediction of actuators that are convicted themselves is no witness of a vibration.
  const bool vibrates = failure_.kind == FailureKind::none && by_poses_.imu_vibrates();
  by_poses_flies_ = by_poses_.is_valid() && (is_convicted || vibrates);
  observe(time, corrected, applied);
  watch_actuators(time, corrected);
}

template <int Rotors>
void FlightController<Rotors>::watch_actuators(double time, const InertialSampled& sample) {
  // Ground can only push. What pulls the vehicle down is a rotor that does not lift.
  const bool pulled = is_located() && (state().orientation * observer_.external().force).z() <
                                          -0.35 * vehicle_.body.mass * gravity / Rotors;
  const ActuatorState<Rotors>& modelled = actuators_.state();
  detector_.update(
      time, sample,
      measures_speeds_ ? ActuatorState<Rotors>{rotor_speeds_, modelled.tilt_angle} : modelled,
      modelled.rotor_speed, (airborne_ && !flies_by_poses()) || pulled, time < touched_until_);
}

template <int Rotors>
void FlightController<Rotors>::on_state(double time, const std::optional<GivenState>& given) {
  // Of now: at 1.5 m/s a state that is 60 ms old costs 60 mm.
  late_.on_wrench(time, wrench_of(actuators_.update(time, sent_.command)));
  is_given_now_ = given.has_value();
  if (given) given_ = late_.at(time, given->body, given->time, observer_.external());
}

template <int Rotors>
void FlightController<Rotors>::on_imu(double time, const InertialSampled& sample,
                                      const Wrenchd& applied) {
  if (is_killed(time)) return;
  observed_ = observer_.update(time, sample, applied);
  watch_actuators(time, sample);
}

template <int Rotors>
Wrenchd FlightController<Rotors>::applied_at(double time) {
  if (time < late_.last_time()) return late_.applied(time);
  applied_ = actuators_.update(time, sent_.command);
  return wrench_of(applied_);
}

template <int Rotors>
void FlightController<Rotors>::on_kill(double time) {
  actuators_.reset({Eigen::Matrix<double, Rotors, 1>::Zero(), sent_.command.tilt_angle});
  killed_at_ = time;
}

template <int Rotors>
void FlightController<Rotors>::let_go() {
  sent_ = {};
  late_ = LateState(vehicle_.body);
  airborne_ = is_given_now_ = false;
  mode_ = has_lost_actuator() ? FlightMode::stopped : FlightMode::mission;
}

// What the observer and the contact estimate knew is old.
template <int Rotors>
void FlightController<Rotors>::forget_flight(double time, const GroundPlane& ground) {
  actuators_.reset(sent_.command, time);
  observer_.reset();
  observed_ = observer_.observed();
  contact_ = ContactEstimator(vehicle_, ground);
}

template <int Rotors>
void FlightController<Rotors>::take_over(double time, const GroundPlane& ground, bool flies) {
  if (flies) sent_.command = lift(vehicle_.body.mass * gravity);
  forget_flight(time, ground);
  if (has_lost_actuator() && flies) begin(FlightMode::emergency, time);
}

template <int Rotors>
void FlightController<Rotors>::move_frame(const Eigen::Vector3d& step, double turn,
                                          const GroundPlane& ground) {
  contact_ = ContactEstimator(vehicle_, ground);
  held_.position += step;
  held_.orientation = quaternion_from_yaw(turn) * held_.orientation;
  sink_to_ += step.z();
  after_failure_.ground.planned_height += step.z();
  const auto raise = [&step](auto& nmpc) {
    auto settings = nmpc.settings();
    settings.ground.planned_height += step.z();
    nmpc.set_settings(settings);
  };
  if (actuator_nmpc_) raise(*actuator_nmpc_);
  at_wrench_level(raise);
}

template <int Rotors>
CalibrationStatus FlightController<Rotors>::end_calibration(const BodyStated& body) {
  Wrenchd ground;
  ground.force.z() = vehicle_.body.mass * gravity;
  return observer_.end_calibration(wrench_in_body(ground, body.orientation));
}

// The wrench by the observer, or by the poses alone. The sums go on when one follows the other.
template <int Rotors>
void FlightController<Rotors>::observe(double time, const InertialSampled& sample,
                                       const Wrenchd& applied) {
  const ObservedWrenchd before = observer_.observed(), last = observed_;
  observed_ = observer_.update(time, sample, applied);
  if (flies_by_poses()) {
    observed_ = unfiltered_wrench(last, time, by_poses_.external());
    return;
  }
  observed_.external_sum.force += last.external_sum.force - before.external_sum.force;
  observed_.external_sum.torque += last.external_sum.torque - before.external_sum.torque;
  observed_.raw_sum.force += last.raw_sum.force - before.raw_sum.force;
  observed_.raw_sum.torque += last.raw_sum.torque - before.raw_sum.torque;
  observed_.duration += last.duration - before.duration;
}

template <int Rotors>
void FlightController<Rotors>::on_pose(double time, const MarkerPosed& pose) {
  const EkfStatus status = ekf_.on_pose(time, pose);
  if (status > EkfStatus::waiting && status != EkfStatus::gated) return;
  const InertialState<double>& x = ekf_.filter().state();
  const Eigen::Quaterniond orientation = pose.orientation * x.marker_orientation.conjugate();
  const Eigen::Vector3d from_body = x.marker_position + ekf_.imu_position();
  by_poses_.correct(time + clock_offset_ + ekf_.clock_step() - pose_latency_,
                    pose.position - orientation * from_body, orientation.normalized());
}

// Constructs the controller for the vehicle that remains. This allocates, once, and takes less than
// a tick.
template <int Rotors>
void FlightController<Rotors>::go_on_without(const ActuatorFailure& failure, double time) {
  failure_ = failure;
  const Vehicle<Rotors> remaining = with_failure(vehicle_, failure);
  const ActuatorState<Rotors> now{rotor_speeds_, actuators_.state().tilt_angle};
  body_ = ActuatedBody<Rotors>(remaining);
  const Eigen::Matrix<double, Rotors, 1> ratio = actuators_.speed_ratio();
  actuators_ = ActuatorModel<Rotors>(remaining);
  actuators_.set_speed_ratio(ratio);
  usable_voltage_ = 0.0;  // the new controller does not know it yet
  actuators_.reset(now, time);
  actuator_nmpc_.emplace(remaining, after_failure_);
  // What the observer has estimated since the failure is the failure. Without it the vehicle would
  // seem to be carried.
  observer_.reset();
  observed_ = observer_.observed();
  const ContactEstimate& last = contact_.estimate();
  contact_ = ContactEstimator(remaining, last.on_ground ? GroundPlane() : last.ground);
  if constexpr (has_wrench_level<Rotors>) {
    allocation_.reset();
    nmpc_.reset();
    nmpc_by_nlopt_.reset();
  }
}

// Changes the speed at which the vehicle settles on the expected ground. Where the height is not
// known, a vehicle that settles slowly may hover above the true ground.
template <int Rotors>
void FlightController<Rotors>::settle_at(double speed) {
  const auto set = [speed](auto& controller) {
    auto settings = controller.settings();
    if (settings.ground.settling_speed == 0.0) return;  // it follows the reference as it is
    settings.ground.settling_speed = speed;
    controller.set_settings(settings);
  };
  if (actuator_nmpc_) set(*actuator_nmpc_);
  at_wrench_level(set);
}

template <int Rotors>
void FlightController<Rotors>::begin(FlightMode mode, double time) {
  if (mode == FlightMode::landing)
    settle_at(sink_speed);
  else if (mode_ == FlightMode::landing)
    settle_at(after_failure_.ground.settling_speed);
  mode_ = mode;
  mode_since_ = bad_until_ = time;
  const BodyStated body = state();
  held_ = {};
  held_.position = body.position;
  held_.velocity = body.velocity;
  held_.orientation = quaternion_from_yaw(yaw_of(body.orientation));
  sunk_ = sink_ = 0.0;
  sink_to_ = contact_.estimate().ground.height_at(body.position);
}

// Another controller has flown until now. What turns is not known: about hover is the best guess.
template <int Rotors>
void FlightController<Rotors>::start_in_the_air(double time) {
  sent_ = {};
  sent_.command = lift(vehicle_.body.mass * gravity);
  forget_flight(time, {});
  contact_.update(time, state(), observed_);
  starts_in_air_ = true;
  begin(FlightMode::hold, time);
}

// The polynomial's largest speed and acceleration stay below these values.
template <int Rotors>
void FlightController<Rotors>::return_to(const ReferencePoint& point, double time) {
  constexpr double fastest = 1.5, turning = 0.5, hardest = 1.0;  // [m/s], [rad/s], [m/s^2]
  const ReferencePoint now = stand_in(time);
  way_ = now.position - point.position;
  turn_ = std::remainder(yaw_of(now.orientation) - yaw_of(point.orientation), 2.0 * pi);
  const double far = way_.norm();
  way_time_ = std::max({1.0, 1.875 * far / fastest, std::sqrt(5.774 * far / hardest),
                        1.875 * std::abs(turn_) / turning});
  starts_in_air_ = false;
  mode_ = FlightMode::returning;
  mode_since_ = time;
}

// In the air the vehicle returns to its reference. On wheels it may not reach it, and a body that
// has to turn round may turn over: it backs off, to take off freely, and waits for the reference.
template <int Rotors>
void FlightController<Rotors>::rejoin(const Obstacle& obstacle, const ReferencePoint& point,
                                      double time) {
  if (meets(point)) return;
  waits_ = contact_.estimate().on_ground;
  begin(FlightMode::hold, time);
  constexpr double back = 0.15;  // [m]
  if (waits_)
    held_.position -= back * obstacle.direction;
  else
    return_to(point, time);
}

template <int Rotors>
bool FlightController<Rotors>::meets(const ReferencePoint& point) const {
  constexpr double near = 0.2, about = 0.5;  // [m], [rad]
  const BodyStated body = state();
  return (body.position - point.position).norm() < near &&
         body.orientation.angularDistance(point.orientation) < about;
}

// Waits on the ground until the reference comes past or takes off.
template <int Rotors>
void FlightController<Rotors>::wait_for(const ReferencePoint& point, double time) {
  constexpr double flies = 0.05;  // [m]
  if (meets(point)) {
    mode_ = FlightMode::mission;
    waits_ = false;
  } else if (point.position.z() > held_.position.z() + flies) {
    return_to(point, time);
    waits_ = false;
  }
  if (waits_) mode_since_ = bad_until_ = time;
}

// The reference plus an offset that fades with a polynomial of fifth order.
template <int Rotors>
ReferencePoint FlightController<Rotors>::on_way_back(ReferencePoint point, double time) const {
  const double u = std::clamp((time - mode_since_) / way_time_, 0.0, 1.0), rest = 1.0 - u;
  const double left = rest * rest * rest * (1.0 + 3.0 * u + 6.0 * u * u);
  const double rate = -30.0 * u * u * rest * rest / way_time_;
  const double change = -60.0 * u * rest * (1.0 - 2.0 * u) / (way_time_ * way_time_);
  point.position += left * way_;
  point.velocity += rate * way_;
  point.acceleration += change * way_;
  point.orientation = quaternion_from_yaw(left * turn_) * point.orientation;
  point.angular_velocity += point.orientation.conjugate() * Eigen::Vector3d(0.0, 0.0, rate * turn_);
  return point;
}

template <int Rotors>
void FlightController<Rotors>::choose_mode(double time, const Reference& reference) {
  if (clock_was_set_back(time, time_)) {
    mode_since_ += time - time_;
    bad_until_ += time - time_;
  }
  const double passed = time - time_;
  time_ = time;
  const bool was_unconfirmed = trust_.unconfirmed;
  trust_ = trust_at(time);
  const bool imu_works = !trust_.imu_silent && !trust_.imu_stopped;
  // The poses alone are good enough.
  const bool by_poses = flies_by_poses();
  trust_.imu_contradicted |= by_poses;
  if (by_poses && trust_.state == EstimateState::good) trust_.state = EstimateState::degraded;
  if (!trust_.imu_contradicted) pose_latency_ = trust_.latency;  // a wrong IMU shows none
  const bool lost = !by_poses && (trust_.state == EstimateState::position_lost ||
                                  (trust_.state == EstimateState::lost && imu_works));
  const bool is_good = trust_.state == EstimateState::good && !trust_.unconfirmed;
  // One restart alone, as after a step of a clock, and poses noisier than believed are no reason to
  // leave the mission.
  const bool is_doubtful =
      !by_poses && trust_.state == EstimateState::degraded &&
      (trust_.position_error || trust_.velocity_error || trust_.implausible_bias);
  doubtful_for_ = is_doubtful ? doubtful_for_ + std::clamp(passed, 0.0, 0.1) : 0.0;
  constexpr double in_doubt = 0.15;  // a tick of doubt is none [s]
  const FailureKind found = detector_.failure().kind;
  const bool failed = found != FailureKind::none;
  if (found == FailureKind::slow_servos) {
    go_on_without(detector_.failure(), time);
    vehicle_ = with_failure(vehicle_, failure_);
    detector_ = FailureDetector<Rotors>(vehicle_);
  } else if (failed && mode_ != FlightMode::stopped &&
             (!has_lost_actuator() || detector_.failure().limp != failure_.limp ||
              detector_.failure().effectiveness != failure_.effectiveness)) {
    const bool is_first = !has_lost_actuator();
    go_on_without(detector_.failure(), time);
    if (is_first) begin(FlightMode::emergency, time);
  }
  if (!is_good) bad_until_ = time;
  if (mode_ != FlightMode::hold) waits_ = false;
  if (waits_ && is_good) wait_for(reference(time), time);
  const bool follows = mode_ == FlightMode::mission || mode_ == FlightMode::returning;
  const bool doubts = (doubtful_for_ > in_doubt && follows) ||
                      (trust_.unconfirmed && !was_unconfirmed && !contact_.estimate().on_ground);
  // The first velocity in the air is a guess: it holds where it is when it knows better.
  const bool guesses = mode_ == FlightMode::hold && starts_in_air_ &&
                       vertical_stddev(InertialIndex::velocity) > 0.03;
  switch (mode_) {
    case FlightMode::mission:
    case FlightMode::returning:
    case FlightMode::hold:
      // Who holds for long does not know where.
      if (lost || (mode_ == FlightMode::hold && time - mode_since_ > longest_hold))
        begin(FlightMode::landing, time);
      else if (doubts || guesses)
        begin(FlightMode::hold, time);
      else if (mode_ == FlightMode::hold && time - bad_until_ > good_for)
        return_to(reference(time), time);
      else if (mode_ == FlightMode::returning && time - mode_since_ > way_time_)
        mode_ = FlightMode::mission;
      break;
    case FlightMode::emergency:
    case FlightMode::landing: {
      if (mode_ == FlightMode::landing) sink(passed);
      constexpr double settled = 0.3;  // on the ground for this time [s]
      const bool falls = mode_ == FlightMode::emergency && std::abs(state().velocity.z()) > 0.5;
      if (contact_.standing_for() > settled && !falls)
        mode_ = FlightMode::stopped;
      else if (mode_ == FlightMode::emergency && lost)
        begin(FlightMode::landing, time);
      else if (mode_ == FlightMode::landing && is_good && failed)
        begin(FlightMode::emergency, time);
      break;
    }
    case FlightMode::stopped:
      // What was ground is not: a vehicle that stands, or is carried by hand, has its weight.
      if (contact_.load_by_motion() < 0.5 * vehicle_.body.mass * gravity &&
          state().velocity.z() < -0.3)
        begin(failed ? FlightMode::emergency : FlightMode::landing, time);
      break;
  }
}

// A state by another estimator is as good as that says, and there is none where it is not.
template <int Rotors>
EstimateTrust FlightController<Rotors>::trust_at(double time) const {
  if (!given_) return ekf_.trust(time);
  EstimateTrust given;
  given.state = EstimateState::good;
  given.imu_silent = !is_given_now_;
  return given;
}

template <int Rotors>
double FlightController<Rotors>::vertical_stddev(int of) const {
  if (given_) return 0.0;
  return std::sqrt(std::max(0.0, ekf_.filter().covariance()(of + 2, of + 2)));
}

template <int Rotors>
bool FlightController<Rotors>::is_off_the_ground() const {
  const double enough =
      0.05 + 3.0 * vertical_stddev(InertialIndex::position);  // under the wheels [m]
  const std::optional<Undercarriage> stands = undercarriage(vehicle_);
  const Eigen::Vector3d position = state().position;
  const ContactEstimate& contact = contact_.estimate();
  return !contact.on_ground &&
         (!stands || position.z() - stands->height - contact.ground.height_at(position) > enough);
}

// Time constant at which the speed decays, so that the vehicle brakes without leaning [s].
constexpr double braking = 1.0;

// Fast where the ground is certainly far, because without position the errors grow with time. Fast
// again below the expected ground, because then the estimate is wrong, perhaps the speed as well.
template <int Rotors>
void FlightController<Rotors>::sink(double duration) {
  constexpr double margin = 0.5, reach = 1.0;  // [m]
  const std::optional<Undercarriage> stands = undercarriage(vehicle_);
  const double height = state().position.z() - (stands ? stands->height : 0.0) - sink_to_;
  const double off =
      std::isfinite(height)
          ? std::max(height - margin - vertical_stddev(InertialIndex::position), -height - margin)
          : 0.0;
  const double wanted =
      sink_speed + (fastest_sink - sink_speed) * std::clamp(off / reach, 0.0, 1.0);
  constexpr double acceleration = 0.5;  // [m/s^2]
  const double step = std::clamp(duration, 0.0, 0.1);
  sink_ += std::clamp(wanted - sink_, -acceleration * step, acceleration * step);
  sunk_ += sink_ * step;
  // The estimated position may step by metres, for example when a range finder shows that the
  // vehicle leans. The vehicle does not follow it.
  const double braked = braking * (1.0 - std::exp(-std::max(0.0, time_ - mode_since_) / braking));
  held_.position.head<2>() =
      state().position.template head<2>() - braked * held_.velocity.head<2>();
}

template <int Rotors>
ReferencePoint FlightController<Rotors>::stand_in(double time) const {
  const double passed = std::max(0.0, time - mode_since_);
  const double decay = std::exp(-passed / braking);
  ReferencePoint point = held_;
  point.position += held_.velocity * (braking * (1.0 - decay));
  point.velocity = held_.velocity * decay;
  point.acceleration = -held_.velocity * (decay / braking);
  if (mode_ == FlightMode::landing) {
    point.position.z() -= sunk_ + sink_ * (time - time_);
    point.velocity.z() -= sink_;
  }
  constexpr double hover = 2.0, slowly = 0.3;  // after a failure [s], [m/s]
  if (mode_ == FlightMode::emergency && passed > hover) {
    point.position.z() -= slowly * (passed - hover);
    point.velocity.z() -= slowly;
  }
  return point;
}

template <int Rotors>
CalibrationStatus FlightController<Rotors>::imu_check() const {
  if (airborne_ || felt_samples_ == 0) return CalibrationStatus::calibrated;
  const Eigen::Vector3d up(0.0, 0.0, gravity);
  return check_specific_force(felt_, Eigen::Vector3d(state().orientation.conjugate() * up));
}

template <int Rotors>
void FlightController<Rotors>::prepare(double time, const Reference& reference) {
  on_tick(time);
  if (is_located() && !is_killed(time)) {
    const bool follows = mode_ == FlightMode::mission || mode_ == FlightMode::returning;
    ReferencePoint now = follows ? reference(time) : stand_in(time);
    if (mode_ == FlightMode::returning) now = on_way_back(now, time);
    const std::optional<Obstacle> last = contact_.estimate().blocked;
    contact_.update(time, state(), observed_, now);
    const bool is_blocked = contact_.estimate().blocked.has_value();
    // On the ground no wind is as strong. Along a wall, wheels may slide without being stopped.
    const bool is_pushed =
        contact_.estimate().on_ground &&
        contact_.estimate().rolling.force.norm() > 0.25 * vehicle_.body.mass * gravity;
    const bool pushes = contact_.estimate().touches_for > 0.0;
    if (is_blocked || is_pushed || pushes) touched_until_ = time + 1.0;
    if (follows && last && !is_blocked) rejoin(*last, reference(time), time);
  }
  if (!given_ || is_given_now_) airborne_ = is_located() && is_off_the_ground();
  if (!started_ && !given_ && airborne_ && sent_.command.rotor_speed.isZero())
    start_in_the_air(time);
  choose_mode(time, reference);
  const Reference other = [this](double t) { return stand_in(t); };
  const Reference back = [this, &reference](double t) { return on_way_back(reference(t), t); };
  ContactEstimate contact = contact_.estimate();
  if (external_ == ExternalWrench::unused)
    contact.disturbance = contact.rolling = contact.external = {};
  const Reference& followed = mode_ == FlightMode::mission     ? reference
                              : mode_ == FlightMode::returning ? back
                                                               : other;
  // control() reports the status
  if (actuator_nmpc_) (void)actuator_nmpc_->prepare(time, followed, contact);
  at_wrench_level([&](auto& nmpc) { (void)nmpc.prepare(time, followed, contact); });
}

template <int Rotors>
const ActuatorState<Rotors>& FlightController<Rotors>::control(double time) {
  started_ = started();
  if (!started_) return sent_.command;
  const bool measured = is_located() && !trust_at(time).imu_silent;
  if (actuator_nmpc_) control_actuators(time, measured);
  if constexpr (has_wrench_level<Rotors>)
    at_wrench_level([&](auto& nmpc) {
      result_ = measured ? nmpc.feedback(time, take_state()) : nmpc.hold(time);
      sent_ = allocation_->allocate(time, result_.wrench, result_.rate, sent_);
    });
  if (mode_ == FlightMode::stopped) sent_.command.rotor_speed.setZero();
  actuators_.update(time, sent_.command);  // the command acts from now on
  limit_speeds();
  compare_sources();
  return actuators_.to_send(sent_.command);
}

// Plans and allocation then respect the top speed of the slowest rotor.
template <int Rotors>
void FlightController<Rotors>::limit_speeds() {
  const double usable = actuators_.usable_voltage();
  if (std::abs(usable - usable_voltage_) < 0.005 * usable) return;
  usable_voltage_ = usable;
  set_voltage(usable);
}

template <int Rotors>
void FlightController<Rotors>::compare_sources() {
  using Speeds = Eigen::Matrix<double, Rotors, 1>;
  const double weight = vehicle_.body.mass * gravity,
               ratio = voltage_ratio(vehicle_.battery, voltage_).value_or(1.0);
  Speeds top;
  for (int i = 0; i < Rotors; ++i) {
    const RotorParameters& rotor = rotor_parameters(vehicle_, static_cast<std::size_t>(i));
    top(i) = speed_from_thrust(max_thrust_at(rotor, ratio), rotor);
  }
  const Speeds& modelled = actuators_.state().rotor_speed;
  const Speeds& measured = measures_speeds_ ? rotor_speeds_ : modelled;
  const auto means = means_between(observed_at_tick_, observed_);
  observed_at_tick_ = observed_;
  const std::optional<Undercarriage> stands = undercarriage(vehicle_);
  consistency_.rotor_speed = rotor_speed_residual<Rotors>(measured, modelled);
  if (means) consistency_.wrench = wrench_residual(means->raw.force, weight, !airborne_);
  if (!given_) consistency_.pose = pose_residual(ekf_.nis());
  consistency_.load =
      load_residual(contact_.estimate(), state(), weight, stands ? stands->height : 0.0);
  consistency_.battery = battery_residual<Rotors>(measured, top);
}

template <int Rotors>
void FlightController<Rotors>::control_actuators(double time, bool measured) {
  // The speeds are modelled, too: the inverse of a lag would amplify the noise of the sensors.
  const ActuatorNmpcResult<Rotors>& result =
      measured
          ? actuator_nmpc_->feedback(time, take_state(), actuators_.update(time, sent_.command))
          : actuator_nmpc_->hold(time);
  sent_.command = result.command;
  result_.status = result.status;
  result_.wrench = result.wrench;
  result_.on_ground = result.on_ground;
  result_.report = result.report;
}

template <int Rotors>
double FlightController<Rotors>::planned_tilt_rate() const {
  if constexpr (has_wrench_level<Rotors>)
    if (allocation_)
      return allocation_->rates(result_.wrench, result_.rate).tilt_rate.cwiseAbs().maxCoeff();
  return actuator_nmpc_->result().tilt_rate.cwiseAbs().maxCoeff();
}

template class FlightController<2>;
template class FlightController<3>;
template class FlightController<4>;
template class FlightController<5>;
template class FlightController<6>;
template class FlightController<7>;
template class FlightController<8>;

}  // namespace examples
