#pragma once

#include "../support/solver_choice.hpp"
#include "../support/vehicle_choice.hpp"
#include "hover_point.hpp"
#include "parameters.hpp"
#include "px4_messages.hpp"
#include "telemetry.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <cmath>
#include <cstdint>
#include <iostream>
#include <optional>

namespace loops {

inline constexpr const char* px4_help =
    R"(PX4 offboard node: wrench observer, NMPC and allocation at 100 Hz, from PX4's own estimate to
its motors and servos.

Subscribes to  /fmu/out/vehicle_odometry, /fmu/out/sensor_combined, /fmu/out/vehicle_status_v4
Publishes      /fmu/in/offboard_control_mode, /fmu/in/actuator_motors, /fmu/in/actuator_servos_v1
               /tf, path, markers, /diagnostics: the flight, for rviz2 or Foxglove

Parameters (--ros-args -p NAME:=VALUE): vehicle, the path of its JSON file; origin_height [m] of
PX4's origin, which is where its estimator started, above the ground; thrust_model_factor, 0 if
PX4's THR_MDL_FAC is set for the motors; hover_x, hover_y, hover_z [m], hover_yaw [rad]; max_silence
[s], telemetry_rate [Hz], use_sim_time (true: the time is that of /clock), solver
(automatic, nlopt, structured). Topics: --ros-args -r
TOPIC:=OTHER_TOPIC. DDS domain: the environment variable ROS_DOMAIN_ID.

Place the vehicle level and disarmed: the observer is calibrated until the vehicle is armed. Then arm
and switch to offboard mode. PX4 and the computer must share one clock (UXRCE_DDS_SYNCT). Without
odometry for max_silence the node follows its last plan; after ten times this time it publishes
nothing, and PX4 leaves offboard mode.)";

/// The control loop for messages of PX4, which estimates the state; this loop estimates the
/// external wrench. PX4 does not report the rotor speeds, so speeds and angles come from the
/// actuator model. Not thread-safe.
class Px4Node {
 public:
  static constexpr double max_clock_difference = 5.0;  ///< without a message on stderr [s]

  /// What a tick() asks to publish.
  struct Output {
    std::optional<px4_msgs::msg::OffboardControlMode> mode;
    /// For ActuatorMotors and ActuatorServos, as px4_controls() makes them.
    std::optional<tilt_ropter::ActuatorOutputs<4>> actuators;
    std::uint64_t now = 0, sample = 0;  ///< [us]
  };

  /// Throws std::invalid_argument for parameters out of range, examples::VehicleFileError.
  explicit Px4Node(Parameters& parameters)
      : file_(examples::vehicle_or_default(parameters.text("vehicle"))),
        vehicle_(examples::quadrotor(file_)),
        scaling_(vehicle_, {parameters.number("thrust_model_factor", 0.0), {}}),
        allocation_(vehicle_),
        actuators_(vehicle_),
        observer_(vehicle_.body),
        contact_(vehicle_),
        nmpc_(vehicle_, controller_settings(file_, parameters)),
        reference_(parameters),
        origin_height_(parameters.number(
            "origin_height",
            undercarriage(vehicle_).value_or(tilt_ropter::Undercarriage{0.0}).height)),
        max_silence_(parameters.number("max_silence", 0.1)) {}

  void on_odometry(const px4_msgs::msg::VehicleOdometry& m) {
    const auto body = body_state(m, origin_height_);
    if (!body) return;
    body_ = body;
    sample_ = m.timestamp_sample;
  }

  void on_sensors(const px4_msgs::msg::SensorCombined& m) {
    if (pilot_ == Pilot::somebody_else) return;  // the state of the actuators is unknown
    const double time = seconds(m.timestamp);
    observed_ = observer_.update(time,
                                 {tilt_ropter::flu_from_frd(vector(m.gyro_rad)),
                                  tilt_ropter::flu_from_frd(vector(m.accelerometer_m_s2))},
                                 allocation_.wrench(actuators_.update(time, sent_.command)));
  }

  /// For any version of VehicleStatus.
  template <typename Status>
  void on_status(const Status& m) {
    const Pilot before = pilot_;
    const bool armed = m.arming_state == arming_state_armed;
    const bool offboard = m.nav_state == nav_state_offboard;
    pilot_ = !armed ? Pilot::nobody : offboard ? Pilot::this_node : Pilot::somebody_else;
    if (pilot_ == before) return;
    if (pilot_ != Pilot::this_node) sent_ = {};
    if (pilot_ == Pilot::this_node && before == Pilot::somebody_else && body_) take_over();
    if (pilot_ == Pilot::nobody) {
      observer_.begin_calibration();
      wrong_imu_ = false;
    }
    if (before == Pilot::nobody && body_) {
      // The vehicle stands on the ground, which carries its weight.
      tilt_ropter::Wrenchd ground;
      ground.force.z() = vehicle_.body.mass * tilt_ropter::gravity;
      const auto status =
          observer_.end_calibration(tilt_ropter::wrench_in_body(ground, body_->orientation));
      wrong_imu_ = contradicts_weight(status);
      if (status != tilt_ropter::CalibrationStatus::calibrated)
        std::cerr << (wrong_imu_
                          ? "px4_node: does not fly, the accelerometer contradicts the weight: "
                          : "px4_node: the observer is not calibrated: ")
                  << to_string(status) << '\n';
    }
  }

  /// One period of the controller at the time `now` [ns].
  [[nodiscard]] Output tick(std::int64_t now) {
    Output out;
    out.now = static_cast<std::uint64_t>(now / 1000);
    out.sample = sample_;
    const double time = seconds(out.now), silence = time - seconds(sample_);
    silent_ = !(std::abs(silence) <= 10.0 * max_silence_);
    if (body_ && !warned_ && std::abs(silence) > max_clock_difference) {
      std::cerr << "px4_node: the odometry is " << silence
                << " s old; if it still arrives, the clocks differ: see UXRCE_DDS_SYNCT\n";
      warned_ = true;
    }
    if (!body_ || silent_ || wrong_imu_) return out;
    // PX4 requires this message for some time before it accepts offboard control.
    out.mode = px4_msgs::msg::OffboardControlMode{};
    out.mode->timestamp = out.now;
    out.mode->direct_actuator = true;
    if (pilot_ != Pilot::this_node) return out;

    if (silence <= max_silence_) contact_.update(time, *body_, observed_);
    (void)nmpc_.prepare(time, reference_, contact_.estimate());
    const tilt_ropter::NmpcResult& result =
        silence <= max_silence_ ? nmpc_.feedback(time, *body_) : nmpc_.hold(time);
    planned_ = has_plan(result.status);
    solver_.add(result.status, result.report);
    sent_ = allocation_.allocate(time, result.wrench, result.rate, sent_);
    actuators_.update(time, sent_.command);  // takes effect now
    out.actuators = scaling_.outputs(sent_.command);
    return out;
  }

  /// What the last tick() did, except the counts. Nothing before the first odometry.
  [[nodiscard]] std::optional<Snapshot> snapshot(std::int64_t now) const {
    if (!body_) return std::nullopt;
    Snapshot s;
    s.time = now;
    s.body = *body_;
    s.reference = reference_.point;
    s.actuators = sent_.command;
    s.contact = contact_.estimate();
    s.estimate = silent_ ? "silent" : "of PX4";
    s.planned = planned_ && pilot_ == Pilot::this_node;
    s.mode = wrong_imu_                   ? "refuses to fly"
             : pilot_ == Pilot::this_node ? "offboard"
             : pilot_ == Pilot::nobody    ? "disarmed"
                                          : "flown by PX4";
    s.level = silent_ || wrong_imu_                     ? Level::error
              : pilot_ == Pilot::this_node && !planned_ ? Level::warning
                                                        : Level::ok;
    return s;
  }

  [[nodiscard]] const tilt_ropter::Wrenchd& external() const { return observer_.external(); }
  [[nodiscard]] const examples::SolverTicks& solver() const { return solver_; }
  [[nodiscard]] const tilt_ropter::Vehicle<4>& vehicle() const { return vehicle_; }

 private:
  enum class Pilot { somebody_else, nobody, this_node };

  // Another controller has flown: what turns is not known, and what the observer knew is old. In
  // the air, about hover is the best guess.
  void take_over() {
    using namespace tilt_ropter;
    const ContactEstimate& last = contact_.estimate();
    const GroundPlane ground = last.ground_known ? last.ground : GroundPlane{};
    observer_.reset();
    observed_ = observer_.observed();
    contact_ = ContactEstimator(vehicle_, ground);
    constexpr double in_the_air = 0.3;  // under the vehicle [m]
    const double standing = undercarriage(vehicle_).value_or(Undercarriage{0.0}).height;
    Wrenchd hover;
    hover.force.z() = vehicle_.body.mass * gravity;
    if (body_->position.z() - standing - ground.height_at(body_->position) > in_the_air)
      sent_ = allocation_.allocate(hover, {});
    actuators_.reset(sent_.command);
  }

  examples::VehicleFile file_;
  tilt_ropter::Vehicle<4> vehicle_;
  tilt_ropter::OutputScaling<4> scaling_;
  tilt_ropter::Allocation<4> allocation_;
  tilt_ropter::ActuatorModel<4> actuators_;
  tilt_ropter::WrenchObserverd observer_;
  tilt_ropter::ObservedWrenchd observed_;
  tilt_ropter::ContactEstimator contact_;
  tilt_ropter::Nmpc<4> nmpc_;
  examples::SolverTicks solver_;
  HoverPoint reference_;
  double origin_height_, max_silence_;
  std::optional<tilt_ropter::BodyStated> body_;  // last known state
  std::uint64_t sample_ = 0;                     // time of this state [us]
  tilt_ropter::AllocationResult<4> sent_;
  Pilot pilot_ = Pilot::somebody_else;
  bool silent_ = false, planned_ = false, warned_ = false, wrong_imu_ = false;
};

}  // namespace loops
