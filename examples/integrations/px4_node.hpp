#pragma once

#include "../support/flight_controller.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_choice.hpp"
#include "flight_plan.hpp"
#include "parameters.hpp"
#include "px4_messages.hpp"
#include "telemetry.hpp"

#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iostream>
#include <optional>
#include <utility>
#include <vector>

namespace loops {

inline constexpr const char* px4_help =
    R"(PX4 offboard node: wrench observer, NMPC and allocation at 100 Hz, from PX4's own estimate to
its motors and servos.

Subscribes to  fmu/out/vehicle_odometry, fmu/out/sensor_combined, fmu/out/vehicle_status_v4,
               fmu/out/vehicle_control_mode, fmu/out/battery_status_v1 (for voltage_compensation)
               hover_point   geometry_msgs/PoseStamped, where to hover (ENU); ends a mission
               pause, land   std_msgs/Bool, true: the motion ends, and the vehicle hovers or lands;
                             pause false: it goes on
               trajectory    trajectory_msgs/MultiDOFJointTrajectory, the set points of a planner;
                             ends a mission. One of a single point is valid for 0.5 s
               fmu/in/trajectory_setpoint   a set point with a position in NED, the same
Publishes      fmu/in/offboard_control_mode, fmu/in/actuator_motors, fmu/in/actuator_servos_v1,
               fmu/in/vehicle_thrust_setpoint
               /tf, odometry, path, markers, /diagnostics: the flight, for rviz2 or Foxglove

Parameters (--ros-args -p NAME:=VALUE): vehicle, the path of its JSON file, with 2 to 8 rotors;
level, wrench or actuator, without it wrench if the rotors give every wrench; mission, the path of a
JSON file, or hybrid, air, ground, rolling, excite, inspect; trajectory, the path of a CSV file;
without these two, hover_x, hover_y, hover_z [m], hover_yaw [rad]; origin_height [m] of PX4's
origin, which is where its estimator started, above the ground; thrust_model_factor, 0 if PX4's
THR_MDL_FAC is set for the motors; voltage_compensation, true if the motors are driven by duty cycle
(most are; those of simulations are not): their outputs rise while the battery's voltage falls,
which needs battery_nominal_v in the vehicle file and PX4's battery_status; motor_channels (1,2,...)
of the rotors, servo_channels (1,2,...) of those that tilt, servo_trims in [-1, 1] and
reversed_servos (such as 2,4); max_silence [s], telemetry_rate [Hz], status_line (false: none),
use_sim_time (true: the time is that of /clock), solver (automatic, nlopt, structured). From a file:
--ros-args --params-file FILE.yaml. Topics: --ros-args -r TOPIC:=OTHER_TOPIC. Namespace and name: -r
__ns:=/NAMESPACE -r __node:=NAME. DDS domain: the environment variable ROS_DOMAIN_ID.

Place the vehicle level and disarmed: the observer is calibrated until the vehicle is armed. Then arm
and switch to offboard mode, on the ground or in the air. The vehicle flies with at most 1 m/s to
the hover point or to where the mission begins. A mission waits while the pilot flies, goes on from
there, and begins anew after disarming. PX4 and the computer must share one clock (UXRCE_DDS_SYNCT).
While the odometry is older than max_silence, by its stamp or its arrival, the node sends no
OffboardControlMode, so that PX4 leaves offboard mode, and follows its last plan, for 0.3 s. Then it
publishes nothing. Nor does it 1.2 s after PX4 last said who flies. An accelerometer that clips, or
differs from the odometry by 3 m/s^2, is replaced by the odometry. Where PX4 resets its position or
heading, the hover point or the mission moves along. When an actuator fails it lands, and does not
take off again.)";

/// The control loop for messages of PX4, which estimates the state; this loop estimates the
/// external wrench. PX4 does not report the rotor speeds, so speeds and angles come from the
/// actuator model. Not thread-safe.
template <int Rotors>
class Px4Node {
 public:
  static constexpr double longest_silence = 1.0;  ///< of the parameter max_silence [s]
  static constexpr double longest_hold = 0.3;     ///< without a state; then nothing is sent [s]
  /// Since PX4 last said who flies, which it does at 2 Hz and when it changes [s].
  static constexpr double longest_untold = 1.2;

  /// What a tick() asks to publish.
  struct Output {
    std::optional<px4_msgs::msg::OffboardControlMode> mode;
    std::optional<Px4Controls> actuators;  ///< for px4_controls()
    std::optional<px4_msgs::msg::VehicleThrustSetpoint> thrust;
    std::uint64_t now = 0, sample = 0;  ///< [us]
  };

  /// For the `vehicle` of `file`. Throws std::invalid_argument for parameters out of range,
  /// examples::VehicleFileError if the level cannot control it.
  Px4Node(const tilt_ropter::Vehicle<Rotors>& vehicle, const examples::VehicleFile& file,
          Parameters& parameters)
      : vehicle_(vehicle),
        wiring_(px4_wiring(vehicle_, parameters)),
        scaling_(vehicle_, wiring_.outputs),
        controller_(at_level<examples::FlightController<Rotors>>(vehicle_, file, parameters,
                                                                 tilt_ropter::EkfSettings{})),
        reference_(parameters, file),
        origin_height_(parameters.number(
            "origin_height",
            undercarriage(vehicle_).value_or(tilt_ropter::Undercarriage{0.0}).height, -100.0,
            100.0)),
        compensates_voltage_(parameters.choice("voltage_compensation", false)),
        max_silence_(parameters.number("max_silence", 0.1, 0.02, longest_silence)) {}

  void on_odometry(const px4_msgs::msg::VehicleOdometry& m) {
    heard_[0].on_message(seconds(m.timestamp_sample));
    const auto body = body_state(m, origin_height_);
    if (!body) return;
    const bool goes_on = agrees(*body, seconds(m.timestamp_sample));
    if (!body_ || silent_) {
      if (!goes_on) return;
    } else {
      const double dt = seconds(m.timestamp_sample) - seconds(sample_);
      const Eigen::Vector3d jump =
          body->position - body_->position - std::clamp(dt, 0.0, 0.5) * body_->velocity;
      if (m.reset_counter != resets_)
        follow_reset(
            jump, tilt_ropter::yaw_of(body->orientation) - tilt_ropter::yaw_of(body_->orientation));
      else if (!(jump.norm() < farthest_jump))
        return;  // of another sender, or lost
      else if (dt > 2e-3 && dt < 0.05) {
        const Eigen::Vector3d acceleration = (body->velocity - body_->velocity) / dt;
        felt_ = body->orientation.conjugate() *
                (acceleration + Eigen::Vector3d(0.0, 0.0, tilt_ropter::gravity));
        felt_at_ = seconds(m.timestamp_sample);
      }
    }
    resets_ = m.reset_counter;
    body_ = body;
    sample_ = m.timestamp_sample;
    is_new_ = true;
  }

  void on_sensors(const px4_msgs::msg::SensorCombined& m) {
    heard_[1].on_message(seconds(m.timestamp));
    if (pilot_ == Pilot::somebody_else) return;  // the state of the actuators is unknown
    const double time = seconds(m.timestamp);
    Eigen::Vector3d specific_force = tilt_ropter::flu_from_frd(vector(m.accelerometer_m_s2));
    const bool clips = m.accelerometer_clipping != 0,
               is_felt =
                   pilot_ == Pilot::this_node && std::abs(time - felt_at_) < max_silence_ + 0.05;
    if (clips || (is_felt && !((specific_force - felt_).norm() < contradiction))) shaken_ = time;
    // Vibration, and what clips, is not in the motion. Without odometry, what was felt last counts.
    if (std::abs(time - shaken_) < (is_felt ? 1e-6 : 1.0)) {
      if (pilot_ != Pilot::this_node || !(std::abs(time - felt_at_) < 1.0)) return;
      specific_force = felt_;
    }
    // Disarmed motors do not turn, not even slowly.
    tilt_ropter::Wrenchd applied;
    if (pilot_ == Pilot::this_node) applied = controller_.applied_at(time);
    const double weight = vehicle_.body.mass * tilt_ropter::gravity;
    if (pilot_ == Pilot::this_node && specific_force.norm() < free_fall &&
        (controller_.is_killed(time) || applied.force.norm() > 0.5 * weight)) {
      // The rotors do not turn as commanded: a kill switch. PX4's messages do not name it.
      controller_.on_kill(time);
      killed_ = time;
    }
    // On the ground it feels its weight, whatever is commanded, and would leap when they turn
    // again. In the air it feels as much where it pushes on a wall. Without a fall before, it may
    // be as heavy, or its rotors as weak.
    load_ += 0.1 * (specific_force.norm() - load_);
    const double excess = time - killed_ < longest_kill ? 0.3 * weight : 0.5 * weight;
    const bool feels_no_thrust = stands() && std::abs(load_ - tilt_ropter::gravity) < 1.5 &&
                                 controller_.wrench_of(controller_.command()).force.norm() >
                                     vehicle_.body.mass * load_ + excess;
    if (!feels_no_thrust) thrust_felt_ = time;
    if (!stays_down_ && time - thrust_felt_ > 0.3) {
      std::cerr << "px4_node: stays on the ground: what it commands does not lift it. A kill "
                   "switch, or a motor that does not turn?\n";
      stays_down_ = true;
    }
    controller_.on_imu(time, {tilt_ropter::flu_from_frd(vector(m.gyro_rad)), specific_force},
                       applied);
  }

  /// For any version of VehicleStatus.
  template <typename Status>
  void on_status(const Status& m) {
    heard_[2].on_message(seconds(m.timestamp));
    const bool armed = m.arming_state == arming_state_armed,
               wants_offboard = m.nav_state_user_intention == nav_state_offboard;
    has_failed_ = armed && wants_offboard && (has_failed_ || m.nav_state != nav_state_offboard);
    on_pilot(m.timestamp, armed, m.nav_state == nav_state_offboard);
  }
  /// When who flies changes, this comes up to 0.2 s before VehicleStatus.
  void on_control_mode(const px4_msgs::msg::VehicleControlMode& m) {
    heard_[3].on_message(seconds(m.timestamp));
    on_pilot(m.timestamp, m.flag_armed, m.flag_control_offboard_enabled);
  }
  /// For any version of BatteryStatus. PX4 sends it at 1 Hz.
  template <typename Battery>
  void on_battery(const Battery& m) {
    const auto voltage = static_cast<double>(m.voltage_v);
    if (!m.connected || !voltage_ratio(vehicle_.battery, voltage)) return;
    if (!heard_[4].ever()) {
      heard_[4] = Heard("battery");
      voltage_ = voltage;
    }
    heard_[4].on_message(seconds(m.timestamp));
    told_voltage_ = voltage;
  }
  /// Whether PX4 hears what it must obey. Without, the node asks for no offboard mode.
  void on_listeners(bool all) { is_heard_ = all; }
  /// Where to hover from now on.
  void on_hover_point(const geometry_msgs::msg::PoseStamped& m) {
    if (!reference_.fly_to(m.pose, time_))
      std::cerr << "px4_node: hover_point is ignored: no pose, too far away, or below the ground\n";
  }

  /// `true`: the motion ends within a second. `false`: it goes on, also after a landing.
  void on_pause(const std_msgs::msg::Bool& m) {
    if (m.data)
      reference_.pause(time_);
    else
      reference_.resume(time_);
  }
  /// `true`: the motion ends, and the vehicle lands where it is.
  void on_land(const std_msgs::msg::Bool& m) {
    if (m.data) reference_.land(time_);
  }

  /// Set points of another program, which end a mission.
  void on_trajectory(const trajectory_msgs::msg::MultiDOFJointTrajectory& m) {
    follow("trajectory", set_points(m));
  }
  /// The same in the words of PX4, with a position.
  void on_set_point(const px4_msgs::msg::TrajectorySetpoint& m) {
    const double yaw = tilt_ropter::yaw_of(reference_(time_).orientation);
    follow("trajectory_setpoint", set_points(m, origin_height_, yaw));
  }

  /// One period of the controller at the time `now` [ns].
  [[nodiscard]] Output tick(std::int64_t now) {
    Output out;
    out.now = static_cast<std::uint64_t>(now / 1000);
    out.sample = sample_;
    const double time = time_ = seconds(out.now), age = time - seconds(sample_);
    for (Heard& topic : heard_) topic.on_tick(time);
    if (told_voltage_ > 0.0) {
      // In steps of a second the thrust would leap, by twice as many per cent as the voltage.
      voltage_ += 0.01 * (told_voltage_ - voltage_);
      controller_.on_voltage(voltage_);
      if (compensates_voltage_) (void)scaling_.set_voltage(voltage_);
    }
    if (std::exchange(is_new_, false)) {
      arrived_ = time;
      arrived_age_ = age;
    }
    if (std::exchange(is_told_, false)) told_ = time;
    if (untold()) decide(Pilot::somebody_else);
    const bool is_known = std::max(std::abs(age), std::abs(arrived_age_)) <= max_silence_ &&
                          time - arrived_ <= max_silence_;
    if (is_known) known_ = time;
    const bool holds = flying_ && time >= known_ && time - known_ <= longest_hold;
    silent_ = untold() || (!is_known && !holds);
    if (body_ && !is_known && !warned_ && time - arrived_ <= max_silence_) {
      std::cerr << "px4_node: odometry arrives but is " << age
                << " s old by its stamps, max_silence is " << max_silence_
                << " s; if the clocks differ, see UXRCE_DDS_SYNCT\n";
      warned_ = true;
    }
    const bool goes_on = flying_ && !silent_ && pilot_ == Pilot::this_node;
    if (flying_ && !goes_on) reference_.stop(time);
    if (pilot_ == Pilot::nobody) reference_.restart();
    flying_ = goes_on;
    if (!body_ || silent_ || wrong_imu_ || lacks_voltage()) return out;
    if (is_known && (is_heard_ || flying_)) {
      // PX4 accepts offboard control only with this message, and leaves it some time after the
      // last one.
      out.mode = px4_msgs::msg::OffboardControlMode{};
      out.mode->timestamp = out.now;
      out.mode->direct_actuator = true;
    }
    if (pilot_ != Pilot::this_node) return out;
    if (std::exchange(takes_over_, false))
      controller_.take_over(time, ground(), clearance() > in_the_air);
    if (stays_down_) {
      flying_ = false;
      controller_.let_go();
    } else {
      std::optional<examples::GivenState> given;
      if (is_known) given = {*body_, seconds(sample_)};
      controller_.on_state(time, given);
      if (!flying_) reference_.start(controller_.state(), time);
      controller_.prepare(time, [this](double t) { return reference_(t); });
      (void)controller_.control(time);
      planned_ = has_plan(controller_.result().status);
      solver_.add(controller_.result().status, controller_.result().report);
      flying_ = true;
    }
    const bool rests = stays_down_ || controller_.mode() == examples::FlightMode::stopped;
    if (const auto outputs = scaling_.outputs(controller_.command()))
      out.actuators = wiring_.controls(*outputs);
    out.thrust = px4_thrust(rests ? Eigen::Vector3d::Zero() : controller_.result().wrench.force,
                            largest_force(), out.now, out.sample);
    return out;
  }

  /// What the last tick() did, except the counts.
  [[nodiscard]] Snapshot snapshot(std::int64_t now) const {
    using examples::FlightMode;
    const bool flies_mission = controller_.mode() == FlightMode::mission,
               is_broken = controller_.mode() == FlightMode::stopped,
               is_failing = is_broken || controller_.mode() == FlightMode::emergency;
    Snapshot s;
    s.time = now;
    s.located = body_.has_value();
    if (body_) s.body = *body_;
    s.heard = heard_;
    s.waits_for = !body_            ? "vehicle_odometry"
                  : untold()        ? "vehicle_status or vehicle_control_mode"
                  : wrong_imu_      ? "disarming, to calibrate again"
                  : silent_         ? "vehicle_odometry"
                  : stays_down_     ? "disarming or another mode"
                  : is_broken       ? "a repair; start the node again then"
                  : lacks_voltage() ? "battery_status, for voltage_compensation"
                  : !is_heard_      ? "PX4 to hear motors and servos: --px4-message-version?"
                  : pilot_ == Pilot::nobody        ? "arming"
                  : pilot_ == Pilot::somebody_else ? "offboard mode"
                                                   : "";
    s.reference = reference_(time_);
    s.failure = controller_.failure();
    s.activity = reference_.activity(time_);
    s.rotor_speed = controller_.command().rotor_speed;
    s.tilt_angle = controller_.command().tilt_angle;
    s.contact = controller_.contact().estimate();
    s.estimate = silent_ ? "silent" : "of PX4";
    s.planned = planned_ && pilot_ == Pilot::this_node;
    s.mode = !body_                           ? "not located"
             : untold()                       ? "not told who flies"
             : wrong_imu_                     ? "refuses to fly"
             : stays_down_                    ? "stays on the ground"
             : pilot_ == Pilot::nobody        ? "disarmed"
             : pilot_ == Pilot::somebody_else ? "flown by PX4"
             : flies_mission                  ? "offboard"
                                              : examples::to_string(controller_.mode());
    s.level = silent_ || wrong_imu_ || is_failing                          ? Level::error
              : pilot_ == Pilot::this_node && !(planned_ && flies_mission) ? Level::warning
                                                                           : Level::ok;
    return s;
  }

  [[nodiscard]] const tilt_ropter::Wrenchd& external() const { return controller_.external(); }
  [[nodiscard]] const examples::SolverTicks& solver() const { return solver_; }
  [[nodiscard]] const tilt_ropter::Vehicle<Rotors>& vehicle() const { return vehicle_; }

 private:
  enum class Pilot { somebody_else, nobody, this_node };

  // Whether the odometry after a silence has agreed with itself for long enough. It may be that of
  // another sender: two that alternate do not agree, and one that is not near where the vehicle was
  // has to for a second.
  [[nodiscard]] bool agrees(const tilt_ropter::BodyStated& body, double stamp) {
    const double passed = stamp - tried_at_;
    if (!(passed > 0.0 && passed < 0.3 && (body.position - tried_).norm() < farthest_jump))
      agrees_from_ = stamp;
    tried_ = body.position;
    tried_at_ = stamp;
    const double agreed = stamp - agrees_from_;
    if (!body_) return agreed > 0.035;
    const bool is_near =
        (body.position - body_->position).norm() < 0.3 + 0.5 * (stamp - seconds(sample_));
    return agreed > (is_near ? 0.2 : 1.0);
  }

  void follow(const char* topic, std::vector<SetPoint> points) {
    if (!reference_.follow(std::move(points), time_))
      std::cerr << "px4_node: " << topic
                << " is ignored: no set points, too far away, or below the ground\n";
  }

  // Thrusts would be wrong by as much as the battery is full.
  [[nodiscard]] bool lacks_voltage() const {
    return compensates_voltage_ && vehicle_.battery.nominal_voltage > 0.0 && !heard_[4].ever();
  }
  [[nodiscard]] bool untold() const { return !(std::abs(time_ - told_) <= longest_untold); }

  // `stamp` [us]: the two topics that say it are not of one speed. What PX4 said before does not
  // count, unless its clock has gone back.
  void on_pilot(std::uint64_t stamp, bool armed, bool offboard) {
    constexpr std::uint64_t most = 20000;
    if (stamp < told_stamp_ && told_stamp_ - stamp < most) return;
    told_stamp_ = stamp;
    is_told_ = true;
    decide(!armed ? Pilot::nobody : offboard ? Pilot::this_node : Pilot::somebody_else);
  }

  void decide(Pilot pilot) {
    const Pilot before = std::exchange(pilot_, pilot);
    if (pilot_ == before) return;
    // PX4 returns to offboard mode by itself after a failsafe, in which it may have landed.
    stays_down_ = pilot_ == Pilot::this_node && has_failed_ && stands();
    thrust_felt_ = time_;
    if (pilot_ != Pilot::this_node) {
      controller_.let_go();
    }
    takes_over_ = pilot_ == Pilot::this_node && before == Pilot::somebody_else;
    if (pilot_ == Pilot::nobody) {
      controller_.begin_calibration();
      wrong_imu_ = false;
    }
    if (before == Pilot::nobody && body_) {
      const auto status = controller_.end_calibration(*body_);
      wrong_imu_ = contradicts_weight(status);
      if (status != tilt_ropter::CalibrationStatus::calibrated)
        std::cerr << (wrong_imu_
                          ? "px4_node: does not fly, the accelerometer contradicts the weight: "
                          : "px4_node: the observer is not calibrated: ")
                  << to_string(status) << '\n';
    }
  }

  // Largest difference between accelerometer and odometry [m/s^2]; then the odometry counts.
  static constexpr double contradiction = 3.0;
  static constexpr double free_fall = 3.0;      // largest specific force [m/s^2]
  static constexpr double in_the_air = 0.3;     // under the vehicle [m]
  static constexpr double longest_kill = 10.0;  // PX4 disarms 5 s after its kill switch [s]
  // Without a reset of PX4's estimator, no vehicle is elsewhere by so much [m].
  static constexpr double farthest_jump = 0.5;

  [[nodiscard]] double largest_force() const {
    double sum = 0.0;
    for (std::size_t i = 0; i < Rotors; ++i) sum += rotor_parameters(vehicle_, i).max_thrust;
    return sum;
  }

  // PX4's own controllers move their set points in the same way: the vehicle has not moved.
  void follow_reset(const Eigen::Vector3d& step, double turn) {
    using namespace tilt_ropter;
    // Before a flight the places of the mission are those of the frame of now.
    const bool may_fly = pilot_ != Pilot::nobody;
    reference_.move(may_fly ? step : Eigen::Vector3d(0.0, 0.0, step.z()), may_fly ? turn : 0.0);
    const ContactEstimate& last = controller_.contact().estimate();
    GroundPlane ground = last.ground_known ? last.ground : GroundPlane{};
    ground.height += step.z() - ground.rise(step);
    home_ += step.z();
    controller_.move_frame(step, turn, ground);
  }

  // The ground where it is. It may have been left long ago. To hold a flight for standing means a
  // fall, the opposite a take-off: the lower ground counts.
  [[nodiscard]] tilt_ropter::GroundPlane ground() const {
    const tilt_ropter::ContactEstimate& last = controller_.contact().estimate();
    if (last.ground_known && last.ground.height_at(body_->position) < home_) return last.ground;
    tilt_ropter::GroundPlane ground;
    ground.height = home_;
    return ground;
  }
  [[nodiscard]] double clearance() const {
    const double standing =
        undercarriage(vehicle_).value_or(tilt_ropter::Undercarriage{0.0}).height;
    return body_->position.z() - standing - ground().height_at(body_->position);
  }
  [[nodiscard]] bool stands() const {
    return body_ && clearance() < in_the_air && body_->velocity.norm() < 0.3;
  }

  tilt_ropter::Vehicle<Rotors> vehicle_;
  Px4Wiring<Rotors> wiring_;
  tilt_ropter::OutputScaling<Rotors> scaling_;
  examples::FlightController<Rotors> controller_;
  examples::SolverTicks solver_;
  FlightPlan reference_;
  double origin_height_;
  bool compensates_voltage_;
  double max_silence_;
  double told_voltage_ = 0.0, voltage_ = 0.0;        // newest, and smooth [V]
  std::optional<tilt_ropter::BodyStated> body_;      // last known state
  Eigen::Vector3d tried_ = Eigen::Vector3d::Zero();  // position of the newest odometry, of anybody
  double tried_at_ = -1e9, agrees_from_ = -1e9;      // its time, and when it last leapt [s]
  std::uint64_t sample_ = 0;                         // time of this state [us]
  double time_ = 0.0;                                // of the last tick [s]
  double arrived_ = -1e9, known_ = -1e9;             // last arrival, last time with a state [s]
  double arrived_age_ = 1e9;                         // by its stamp [s]
  double killed_ = -1e9;                             // when the rotors last stood in flight [s]
  double load_ = tilt_ropter::gravity;               // size of the specific force, smooth [m/s^2]
  double thrust_felt_ = -1e9;                        // last time that it was as commanded [s]
  double home_ = 0.0;                                // height of the ground at the start [m]
  double told_ = -1e9;                               // when PX4 last said who flies [s]
  std::uint64_t told_stamp_ = 0;                     // the same, by its stamp [us]
  Eigen::Vector3d felt_ = Eigen::Vector3d::Zero();   // specific force by the odometry [m/s^2]
  double felt_at_ = -1e9, shaken_ = -1e9;            // its time; when the sensor last differed [s]
  std::uint8_t resets_ = 0;                          // of PX4's estimator
  std::array<Heard, 5> heard_{Heard("odometry"), Heard("sensors"), Heard("status"),
                              Heard("control_mode")};
  Pilot pilot_ = Pilot::somebody_else;
  bool silent_ = false, planned_ = false, warned_ = false, wrong_imu_ = false, is_new_ = false,
       is_told_ = false, is_heard_ = true, flying_ = false, has_failed_ = false,
       stays_down_ = false, takes_over_ = false;
};

}  // namespace loops
