#pragma once

#include "actuator_instances.hpp"
#include "body_by_poses.hpp"
#include "imu_clock.hpp"
#include "late_state.hpp"
#include "nmpc_by_nlopt.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/consistency.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <cmath>
#include <functional>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>

/// The onboard control loop, composed of parts of the library as in the control diagram of the
/// paper: IMU and motion capture -> EKF -> state; servo model and rotor speeds -> applied wrench ->
/// observer -> external wrench; both -> contact estimate -> NMPC -> allocation. At the actuator
/// level the NMPC gives rotor speeds and tilt angles without allocation.
namespace examples {

/// The reference at a time. A callable that holds its mission by reference does not allocate.
using Reference = std::function<tilt_ropter::ReferencePoint(double)>;

/// Where the external wrench comes from. All but `modelled` exist to show what the parts are worth.
enum class ExternalWrench {
  modelled,   ///< observer, from measured rotor speeds and modelled tilt angles
  commanded,  ///< observer, from the commanded rotor speeds and tilt angles
  unused,     ///< none reaches the controller; the observer serves to detect the ground only
};

/// What the controller does, by the trust in the estimate and the state of the actuators.
enum class FlightMode {
  mission,    ///< follows the reference
  hold,       ///< the estimate is degraded, or the flight began in the air: holds the position
  returning,  ///< flies a smooth way back to the reference
  landing,    ///< position or attitude is lost, or it held for too long: sinks by IMU and wrench
  stopped,    ///< landed like this: rotors off, unless the vehicle falls
  emergency   ///< an actuator has failed: brakes, hovers for 2 s, sinks until the ground carries;
              ///< on the ground the rotors stop
};

[[nodiscard]] constexpr const char* to_string(FlightMode mode) noexcept {
  constexpr const char* names[] = {"mission", "hold",    "returning",
                                   "landing", "stopped", "emergency"};
  return names[static_cast<int>(mode)];
}

/// What has failed, in words: "rotor 3 gives 0 % of its thrust".
[[nodiscard]] std::string describe(const tilt_ropter::ActuatorFailure& failure);

/// The state by another estimator, such as that of an autopilot.
struct GivenState {
  tilt_ropter::BodyStated body;
  double time = 0.0;  ///< of the state; it may arrive late [s]
};

/// For 2 to 8 rotors; compiled once, in flight_controller.cpp. With 2, 3, 5 and 7 rotors there is
/// no wrench level, see has_wrench_level.
template <int Rotors>
class FlightController {
 public:
  /// Speed of a landing without position [m/s]: near the ground, and where the ground is far.
  static constexpr double sink_speed = 0.4, fastest_sink = 0.8;
  static constexpr double longest_hold = 10.0;  ///< then the vehicle lands [s]
  static constexpr double good_for = 1.0;       ///< then the vehicle returns from a hold [s]
  /// Of rotors that stood by a kill switch, when they do not match the model [s].
  static constexpr double run_up = 0.2;

  /// Controls at the wrench level, with `solved_by_nlopt_alone` much slower than in real time.
  /// Throws std::invalid_argument if the vehicle does not give every wrench or has less than 4
  /// rotors.
  FlightController(
      const tilt_ropter::Vehicle<Rotors>& vehicle, const tilt_ropter::NmpcSettings& settings,
      const tilt_ropter::EkfSettings& estimation,
      const tilt_ropter::WrenchObserverSettings& observer = tilt_ropter::observer_settings(20.0),
      const tilt_ropter::AllocationSettings& allocation = {},
      ExternalWrench external = ExternalWrench::modelled, bool solved_by_nlopt_alone = false);

  /// Controls at the actuator level. The vehicle need not give every wrench.
  FlightController(
      const tilt_ropter::Vehicle<Rotors>& vehicle,
      const tilt_ropter::ActuatorNmpcSettings& settings, const tilt_ropter::EkfSettings& estimation,
      const tilt_ropter::WrenchObserverSettings& observer = tilt_ropter::observer_settings(20.0),
      ExternalWrench external = ExternalWrench::modelled);

  /// For a vehicle that starts in the air: sets the command until the first state.
  void start_with(const tilt_ropter::ActuatorState<Rotors>& command);

  /// Returns rotor speeds and tilt angles for an upward `force` [N] and zero torque.
  [[nodiscard]] tilt_ropter::ActuatorState<Rotors> lift(double force) const;

  /// The wrench of rotor speeds and tilt angles (body frame).
  [[nodiscard]] tilt_ropter::Wrenchd wrench_of(
      const tilt_ropter::ActuatorState<Rotors>& actuators) const;

  /// Speeds reported by the motor controllers [rad/s]. Without them the modelled speeds are used.
  void on_rotor_speeds(const Eigen::Matrix<double, Rotors, 1>& speeds) {
    rotor_speeds_ = speeds;
    measures_speeds_ = true;
  }

  /// Measured battery voltage [V]. Allocation, actuator model and NMPC then respect the top rotor
  /// speeds at this voltage. voltage_ratio() says which voltages are ignored.
  void on_voltage(double voltage);

  /// A sample of the IMU, at any rate, in the clock of the ticks. If the clock of the IMU is set,
  /// the samples count as if it had not been.
  void on_imu(double stamp, const tilt_ropter::InertialSampled& sample);

  /// A pose from motion capture, taken at `time` [s]; it may arrive late.
  void on_pose(double time, const tilt_ropter::MarkerPosed& pose);

  /// Any other measurement of Ekf::on_measurement, taken at `time` [s].
  template <typename Measurement>
  void on_measurement(double time, const Measurement& measurement) {
    ekf_.on_measurement(time, measurement);
  }

  /// Starts the estimate at a known state, for sensors without attitude.
  void start_estimate(const tilt_ropter::BodyStated& body,
                      const tilt_ropter::StartStddev& stddev = {}) {
    ekf_.start(body, stddev);
  }

  // ---- For an autopilot that estimates the state: in place of on_imu() to start_estimate()

  /// The last state, before each prepare(). Without one, which is for a few ticks only, the last
  /// plan goes on.
  void on_state(double time, const std::optional<GivenState>& given);

  /// A sample of the IMU, in the clock of the states, and what was applied to the body then: what
  /// applied_at() says where this controller flies.
  void on_imu(double time, const tilt_ropter::InertialSampled& sample,
              const tilt_ropter::Wrenchd& applied);

  /// The wrench of the actuators, which have followed the commands (body frame).
  [[nodiscard]] tilt_ropter::Wrenchd applied_at(double time);

  /// The rotors do not turn, whatever is commanded: a kill switch. What the vehicle feels counts
  /// again when they have had the time to run up.
  void on_kill(double time);

  /// Somebody else flies from now on, or nobody. With a failed actuator this controller flies again
  /// only if it takes over in the air.
  void let_go();

  /// Another controller has flown until now. The ground is known; `flies` is above it.
  void take_over(double time, const tilt_ropter::GroundPlane& ground, bool flies);

  /// The frame of positions and headings has moved: `step` [m], `turn` [rad]. `ground` is now here.
  void move_frame(const Eigen::Vector3d& step, double turn, const tilt_ropter::GroundPlane& ground);

  /// The vehicle stands, disarmed, from now on. See WrenchObserver.
  void begin_calibration() { observer_.begin_calibration(); }
  /// It has stood as `body` says, and the ground has carried its weight.
  tilt_ropter::CalibrationStatus end_calibration(const tilt_ropter::BodyStated& body);

  /// For a tick in which prepare() is not called, such as while the IMU is silent: the stamps of
  /// the IMU are judged by the time of the ticks.
  void on_tick(double time) { imu_clock_.on_tick(time); }

  /// Call this before the last measurements of a tick arrive. The reference is not followed in
  /// every FlightMode.
  void prepare(double time, const Reference& reference);

  /// Call this after them. Returns the rotor speeds and tilt angles to command. Before the first
  /// state the command does not change. If the state is lost later, the last plan continues as in
  /// Nmpc::hold.
  const tilt_ropter::ActuatorState<Rotors>& control(double time);

  /// True after the first state with a known velocity.
  [[nodiscard]] bool started() const {
    return started_ || given_ ||
           (ekf_.running() && !contradicts_weight(imu_check()) &&
            ekf_.trust(ekf_.time()).state != tilt_ropter::EstimateState::starting);
  }
  /// What the accelerometer said of the weight before the start, while the vehicle stood. The
  /// controller does not start on the ground while it contradicts the weight.
  [[nodiscard]] tilt_ropter::CalibrationStatus imu_check() const;
  [[nodiscard]] FlightMode mode() const { return mode_; }
  /// The failed actuator that was found in flight, if any. The controller then goes on at the
  /// actuator level with the vehicle that remains, and lands, except with slow servos.
  [[nodiscard]] const tilt_ropter::ActuatorFailure& failure() const { return failure_; }
  /// Trust in the estimate at the last prepare().
  [[nodiscard]] const tilt_ropter::EstimateTrust& trust() const { return trust_; }
  /// What the vehicle should do. control() returns it corrected for slow rotors.
  [[nodiscard]] const tilt_ropter::ActuatorState<Rotors>& command() const { return sent_.command; }
  /// See ActuatorModel::speed_ratio().
  [[nodiscard]] const Eigen::Matrix<double, Rotors, 1>& speed_ratio() const {
    return actuators_.speed_ratio();
  }
  /// Measured speeds and modelled tilt angles.
  [[nodiscard]] const tilt_ropter::ActuatorState<Rotors>& applied() const { return applied_; }
  [[nodiscard]] const tilt_ropter::NmpcResult& result() const { return result_; }
  /// Largest planned tilt rate, over all arms [rad/s].
  [[nodiscard]] double planned_tilt_rate() const;
  /// True while the rotors stand by a kill switch or run up after it.
  [[nodiscard]] bool is_killed(double time) const { return std::abs(time - killed_at_) < run_up; }
  /// Where the vehicle is and how it moves.
  [[nodiscard]] tilt_ropter::BodyStated state() const {
    return given_ ? *given_ : by_poses_flies_ ? by_poses_.body() : ekf_.state();
  }
  [[nodiscard]] const tilt_ropter::Wrenchd& external() const { return observer_.external(); }
  [[nodiscard]] const tilt_ropter::Ekfd& ekf() const { return ekf_; }
  [[nodiscard]] const tilt_ropter::WrenchObserverd& observer() const { return observer_; }
  [[nodiscard]] const tilt_ropter::AllocationResult<Rotors>& allocated() const { return sent_; }
  [[nodiscard]] const tilt_ropter::ContactEstimator& contact() const { return contact_; }
  /// What the sources of the last tick said of each other.
  [[nodiscard]] const tilt_ropter::Consistency& consistency() const { return consistency_; }
  /// The controller at the wrench level; there is none at the actuator level or by NLopt alone.
  [[nodiscard]] const tilt_ropter::Nmpc<Rotors>& nmpc() const { return *nmpc_; }
  [[nodiscard]] bool at_wrench_level() const { return !actuator_nmpc_; }

 private:
  FlightController(const tilt_ropter::Vehicle<Rotors>& vehicle,
                   const tilt_ropter::EkfSettings& estimation,
                   const tilt_ropter::WrenchObserverSettings& observer, ExternalWrench external,
                   const tilt_ropter::ActuatorNmpcSettings& after_failure);
  void control_actuators(double time, bool measured);

  // Calls action(nmpc) for the controller of the wrench level, if it is the one that controls.
  template <typename Action>
  void at_wrench_level(const Action& action) {
    if constexpr (has_wrench_level<Rotors>) {
      if (nmpc_) action(*nmpc_);
      if (nmpc_by_nlopt_) action(*nmpc_by_nlopt_);
    }
  }

  // Stands in where there is no wrench level.
  struct Nothing {
    Nothing() = default;
    template <typename... Arguments>
    explicit Nothing(std::in_place_t, const Arguments&...) {}
    [[noreturn]] const tilt_ropter::Nmpc<Rotors>& operator*() const {
      throw std::logic_error("FlightController: there is no wrench level");
    }
  };

  // At the wrench level the allocation and one of the next two, at the actuator level the last.
  std::conditional_t<has_wrench_level<Rotors>, std::optional<tilt_ropter::Allocation<Rotors>>,
                     Nothing>
      allocation_;
  std::conditional_t<has_wrench_level<Rotors>, std::optional<tilt_ropter::Nmpc<Rotors>>, Nothing>
      nmpc_;
  std::conditional_t<has_wrench_level<Rotors>, std::optional<NmpcByNlopt<Rotors>>, Nothing>
      nmpc_by_nlopt_;
  std::optional<tilt_ropter::ActuatorNmpc<Rotors>> actuator_nmpc_;
  tilt_ropter::ActuatedBody<Rotors> body_;
  tilt_ropter::ActuatorModel<Rotors> actuators_;
  ImuClock imu_clock_;
  tilt_ropter::Ekfd ekf_;
  tilt_ropter::WrenchObserverd observer_;
  tilt_ropter::ObservedWrenchd observed_;
  BodyByPoses by_poses_;
  double pose_latency_ = 0.0;  ///< of its poses [s]
  double clock_offset_;        ///< of the poses [s]
  tilt_ropter::ContactEstimator contact_;
  ExternalWrench external_;
  tilt_ropter::NmpcResult result_;
  tilt_ropter::AllocationResult<Rotors> sent_;
  tilt_ropter::ActuatorState<Rotors> applied_;
  Eigen::Matrix<double, Rotors, 1> rotor_speeds_ = Eigen::Matrix<double, Rotors, 1>::Zero();
  LateState late_;
  std::optional<tilt_ropter::BodyStated> given_;  ///< by on_state(), of now or the last
  bool is_given_now_ = false;
  double killed_at_ = -1e9;  ///< [s]
  bool started_ = false, measures_speeds_ = false;
  Eigen::Vector3d felt_ = Eigen::Vector3d::Zero();  ///< mean specific force before the start
  int felt_samples_ = 0;
  tilt_ropter::Consistency consistency_;
  tilt_ropter::ObservedWrenchd observed_at_tick_;
  double voltage_ = 0.0;         ///< measured [V]
  double usable_voltage_ = 0.0;  ///< that limits the speeds, because of slow rotors [V]; 0: none

  void set_voltage(double voltage);
  void limit_speeds();
  void observe(double time, const tilt_ropter::InertialSampled& sample,
               const tilt_ropter::Wrenchd& applied);
  void watch_actuators(double time, const tilt_ropter::InertialSampled& sample);
  void forget_flight(double time, const tilt_ropter::GroundPlane& ground);
  /// True if by_poses_ replaces the IMU: filter and actuators have convicted it, or it swings
  /// against poses and actuators without a failure.
  [[nodiscard]] bool flies_by_poses() const { return by_poses_flies_; }
  [[nodiscard]] bool is_located() const { return given_ ? is_given_now_ : ekf_.running(); }
  [[nodiscard]] tilt_ropter::EstimateTrust trust_at(double time) const;
  [[nodiscard]] tilt_ropter::BodyStated take_state() {
    if (given_) return *given_;
    const tilt_ropter::BodyStated taken = ekf_.take_state();
    return flies_by_poses() ? by_poses_.body() : taken;
  }
  void compare_sources();
  void choose_mode(double time, const Reference& reference);
  void start_in_the_air(double time);
  void return_to(const tilt_ropter::ReferencePoint& point, double time);
  void rejoin(const tilt_ropter::Obstacle& obstacle, const tilt_ropter::ReferencePoint& point,
              double time);
  [[nodiscard]] bool meets(const tilt_ropter::ReferencePoint& point) const;
  void wait_for(const tilt_ropter::ReferencePoint& point, double time);
  [[nodiscard]] bool has_lost_actuator() const {
    return failure_.kind == tilt_ropter::FailureKind::servo ||
           failure_.kind == tilt_ropter::FailureKind::rotor;
  }
  void go_on_without(const tilt_ropter::ActuatorFailure& failure, double time);
  void allow_passes_after_failure();
  void settle_at(double speed);
  void begin(FlightMode mode, double time);
  [[nodiscard]] double vertical_stddev(int of) const;  ///< of the estimate [m] or [m/s]
  [[nodiscard]] bool is_off_the_ground() const;
  void sink(double duration);
  [[nodiscard]] tilt_ropter::ReferencePoint stand_in(double time) const;
  [[nodiscard]] tilt_ropter::ReferencePoint on_way_back(tilt_ropter::ReferencePoint point,
                                                        double time) const;

  FlightMode mode_ = FlightMode::mission;
  tilt_ropter::EstimateTrust trust_;
  tilt_ropter::ReferencePoint held_;                        ///< of the modes hold and landing
  double sunk_ = 0.0, sink_ = 0.0, sink_to_ = 0.0;          ///< of a landing [m], [m/s], ground [m]
  double doubtful_for_ = 0.0;                               ///< [s]
  double mode_since_ = 0.0, bad_until_ = 0.0, time_ = 0.0;  ///< time_: of the last prepare()
  Eigen::Vector3d way_ = Eigen::Vector3d::Zero();           ///< from the reference to its start [m]
  double turn_ = 0.0, way_time_ = 1.0;                      ///< of the way back [rad], [s]

  tilt_ropter::Vehicle<Rotors> vehicle_;
  tilt_ropter::FailureDetector<Rotors> detector_;
  tilt_ropter::ActuatorFailure failure_;
  tilt_ropter::ActuatorNmpcSettings after_failure_;  ///< of the controller after a failure
  bool airborne_ = false, by_poses_flies_ = false, starts_in_air_ = false;
  bool waits_ = false;          ///< on wheels, for a reference that it cannot reach
  double touched_until_ = 0.0;  ///< an obstacle, whose force is no actuator's [s]
};

}  // namespace examples
