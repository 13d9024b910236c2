#pragma once

#include "px4_vehicle.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace test_support {

/// PX4 around a Px4Vehicle, as its public sources describe it: what it sends and how often, when it
/// arms, when it enters and leaves offboard mode, its land detector, and a pilot who may take over
/// and kill. Everything that the node sends is judged.
class Px4Autopilot {
 public:
  /// COM_OF_LOSS_T: how old the last OffboardControlMode may be in offboard mode [s].
  static constexpr double offboard_loss = 0.5;
  /// Of odometry and node: it sees an age that differs by so much [s].
  static constexpr double period = 0.012;

  explicit Px4Autopilot(std::int64_t start) : vehicle(start) {}

  // The hands of the pilot, at any time.
  bool wants_offboard = false;  ///< mode switch: otherwise the position mode of PX4
  bool kills = false;           ///< kill switch: the motors stand still, the vehicle stays armed
  bool tells = true;            ///< who flies
  /// Where the position mode hovers; it starts where it is entered.
  Eigen::Vector3d stick = Eigen::Vector3d::Zero();

  /// Returns false if PX4 refuses: without an estimate, or in offboard mode without its signal.
  [[nodiscard]] bool arm() {
    armed_ = vehicle.estimating && (!wants_offboard || has_signal());
    flown_ = false;
    landed_since_ = time();
    return armed_;
  }

  void disarm() { armed_ = false; }

  [[nodiscard]] bool armed() const { return armed_; }
  [[nodiscard]] bool is_offboard() const { return armed_ && offboard_; }
  [[nodiscard]] double time() const { return vehicle.plant.time(); }
  [[nodiscard]] bool disarmed_by_land_detector() const { return disarmed_by_land_detector_; }

  /// Sends the messages of this millisecond to `node` if `connected`.
  template <typename Node>
  void sense(Node& node, bool connected) {
    decide();
    if (!connected) return;
    const double now = time();
    if (vehicle.estimating && vehicle.deviation < 1.0 &&
        std::abs(vehicle.stamps_late + vehicle.delay - vehicle.clock_step) <= 0.1 + period &&
        tick() % 10 == 8)
      located_ = now;
    vehicle.sense(node);
    if (!tells) return;
    const bool changed = armed_ != told_armed_ || offboard_ != told_offboard_;
    // Both are published at 2 Hz and when they change; DDS lets at most 50 and 5 a second through.
    if (now - mode_sent_ >= (changed ? 0.02 : 0.5)) {
      px4_msgs::msg::VehicleControlMode m{};
      m.timestamp = stamp();
      m.flag_armed = armed_;
      m.flag_control_offboard_enabled = offboard_;
      node.on_control_mode(m);
      mode_sent_ = now;
      tell();
    }
    const bool status_changed = armed_ != status_armed_ || offboard_ != status_offboard_;
    if (now - status_sent_ >= (status_changed ? 0.2 : 0.5)) {
      auto m = vehicle.status(armed_, offboard_);
      if (wants_offboard) m.nav_state_user_intention = loops::nav_state_offboard;
      node.on_status(m);
      status_sent_ = now;
      status_armed_ = armed_;
      status_offboard_ = offboard_;
      tell();
    }
  }

  /// What the node wants to send, which arrives if `connected`.
  template <typename Output>
  void take(const Output& out, bool connected) {
    using namespace px4_msgs::msg;
    if ((out.mode || out.actuators) && time() - located_ > 0.5) ++blind;
    if (out.actuators && !(told_armed_ && told_offboard_)) ++unasked;
    if (!connected) return;
    if (out.mode) {
      vehicle.on_mode(*out.mode);
      signal_ = time();
    }
    if (out.thrust) thrust_ = -double(out.thrust->xyz[2]);
    if (!out.actuators) return;
    vehicle.on_motors(
        loops::px4_controls<ActuatorMotors>(out.actuators->motor, out.now, out.sample));
    vehicle.on_servos(
        loops::px4_controls<ActuatorServos>(out.actuators->servo, out.now, out.sample));
  }

  /// One millisecond.
  [[nodiscard]] bool step() {
    if (tick() % 4 == 0) fly_position_mode();
    vehicle.obey(is_offboard() && !kills);
    if (!armed_ || kills) vehicle.by_another.rotor_speed.setZero();
    detect_landing();
    return vehicle.step();
  }

  Px4Vehicle vehicle;
  int blind = 0;    ///< messages 0.5 s after the node last knew where it is
  int unasked = 0;  ///< commands after it was told that somebody else flies

 private:
  [[nodiscard]] long tick() const { return std::lround(1000.0 * time()); }
  [[nodiscard]] std::uint64_t stamp() const {
    return static_cast<std::uint64_t>(vehicle.now() / 1000);
  }
  void tell() {
    told_armed_ = armed_;
    told_offboard_ = offboard_;
  }

  // Its documentation asks for a stream of a second; real PX4 returned after one message.
  [[nodiscard]] bool has_signal() const { return time() - signal_ <= offboard_loss; }

  void decide() {
    const bool before = offboard_;
    offboard_ = wants_offboard && has_signal();  // otherwise COM_OBL_RC_ACT
    if (before && !offboard_) stick = vehicle.plant.body().position;
  }

  // A cascade that shares nothing with the node but the allocation.
  void fly_position_mode() {
    using namespace tilt_ropter;
    const BodyStated& body = vehicle.plant.body();
    const double mass = 1.03 * 1.5, yaw = yaw_of(body.orientation);
    Eigen::Vector3d a = 2.0 * (stick - body.position) - 2.5 * body.velocity;
    if (a.norm() > 3.0) a *= 3.0 / a.norm();
    Wrenchd w;
    w.force = mass * (body.orientation.conjugate() * (a + Eigen::Vector3d(0.0, 0.0, gravity)));
    const Eigen::Quaterniond lean = quaternion_from_yaw(yaw).conjugate() * body.orientation;
    const Eigen::Vector3d error = 2.0 * lean.vec() * (lean.w() < 0.0 ? -1.0 : 1.0);
    w.torque = tilt_ropter_vehicle().body.inertia * (-60.0 * error - 14.0 * body.angular_velocity);
    vehicle.by_another = allocation_.allocate(w, {}).command;
  }

  // Without a thrust set point and without motion the vehicle has landed, and is disarmed soon.
  void detect_landing() {
    const bool moves = vehicle.plant.body().velocity.norm() > 0.3;
    const bool pushes = (is_offboard() ? thrust_ : 0.3) > 0.1;
    if (pushes && vehicle.plant.body().position.z() > 0.3) flown_ = true;
    if (!armed_ || moves || pushes) landed_since_ = time();
    if (armed_ && time() - landed_since_ > (flown_ ? 2.0 : 10.0)) {
      armed_ = false;
      disarmed_by_land_detector_ = true;
    }
  }

  tilt_ropter::Allocation<4> allocation_{heavy_vehicle()};
  double signal_ = -1e9;  // when OffboardControlMode arrived last [s]
  bool armed_ = false, offboard_ = false, flown_ = false, disarmed_by_land_detector_ = false;
  bool told_armed_ = false, told_offboard_ = false, status_armed_ = false, status_offboard_ = false;
  double mode_sent_ = -1.0, status_sent_ = -1.0, located_ = -1.0, landed_since_ = 0.0;
  double thrust_ = 0.0;
};

}  // namespace test_support
