#pragma once

#include "statistics.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <iomanip>
#include <limits>
#include <ostream>
#include <vector>

/// The performance figures of a flown mission, next to the figures of the paper.
namespace examples {

/// Returns the function that prints a figure as a line "key: value".
inline auto figure_printer(std::ostream& out) {
  return [&out](const char* key, double value, int digits) {
    out << key << ": " << std::fixed << std::setprecision(digits);
    if (std::isinf(value))
      out << "never\n";
    else
      out << value << '\n';
  };
}

/// Errors of a position: their RMSE, the RMSE of each axis, and the largest error [m].
class TrackingError {
 public:
  void add(const Eigen::Vector3d& error) {
    distance_.add_square(error.squaredNorm());
    for (std::size_t i = 0; i < 3; ++i) axes_[i].add(error(static_cast<Eigen::Index>(i)));
    max_ = std::max(max_, error.norm());
  }
  [[nodiscard]] long count() const { return distance_.count(); }
  [[nodiscard]] double value() const { return distance_.value(); }
  [[nodiscard]] double axis(std::size_t i) const { return axes_.at(i).value(); }
  [[nodiscard]] double max() const { return max_; }

 private:
  Rmse distance_;
  std::array<Rmse, 3> axes_;
  double max_ = 0.0;
};

/// Largest height at the end of a take-off or a hover [m].
[[nodiscard]] inline double flight_height(const tilt_ropter::Mission& mission) {
  double height = 0.0;
  for (const tilt_ropter::MissionSegment& segment : mission.segments())
    if (segment.phase == tilt_ropter::MissionPhase::hover ||
        segment.phase == tilt_ropter::MissionPhase::take_off)
      height = std::max(height, segment(segment.end_time()).position.z());
  return height;
}

class MissionFigures {
 public:
  /// `of_the_paper`: the vehicle is the one of the paper, and its figures are printed next to ours.
  explicit MissionFigures(double flight_height, bool of_the_paper = true)
      : flight_height_(flight_height), of_the_paper_(of_the_paper) {}

  /// Call this after each step of the plant, of 1 ms. The errors count from the first step on, also
  /// if the flight starts off its reference. Arguments: phase, position and reference of the CoM
  /// [m], its vertical speed [m/s], power [W], and whether a wheel touches the ground.
  void on_plant(tilt_ropter::MissionPhase phase, const Eigen::Vector3d& position,
                const Eigen::Vector3d& reference, double vertical_speed, double power,
                bool touching) {
    using tilt_ropter::MissionPhase;
    const Eigen::Vector3d error = position - reference;
    const double distance = error.norm();
    all_.add(error);
    if (phase != MissionPhase::rest && phase != MissionPhase::hover) moving_.add(error);
    on_error(distance);
    if (phase == MissionPhase::air) {
      air_.add(error);
      air_power_.add(power);
    }
    if (phase == MissionPhase::ground) {
      ground_.add(error);
      ground_power_.add(power);
    }
    if (phase == MissionPhase::take_off || phase == MissionPhase::hover)
      takeoff_overshoot_ = std::max(takeoff_overshoot_, position.z() - flight_height_);
    if (phase == MissionPhase::take_off) takeoff_error_ = std::max(takeoff_error_, distance);
    if (phase == MissionPhase::landing) landing_error_ = std::max(landing_error_, distance);
    if (touching && !was_touching_) touchdown_speed_ = std::max(touchdown_speed_, -vertical_speed);
    was_touching_ = touching;
  }

  /// Compares the estimated external force with the true one, both in the body frame [N].
  void on_external_force(tilt_ropter::MissionPhase phase, const Eigen::Vector3d& estimated,
                         const Eigen::Vector3d& truth) {
    if (phase == tilt_ropter::MissionPhase::air) force_error_.add((estimated - truth).norm());
  }

  /// Call this after each step of the plant on the ground. Arguments: torque of a wheel's bearing
  /// on the servo of its arm [N m], and torque / angle by which the servo gives way [N m/rad].
  void on_bearings(double torque, double stiffness) {
    bearing_torque_ = std::max(bearing_torque_, torque);
    bearing_tilt_ = std::max(bearing_tilt_, torque / stiffness);
  }

  /// Call this after each tick of the controller.
  void on_control(bool solved, double total_us, double feedback_us) {
    if (!solved) ++failures_;
    total_us_.push_back(total_us);
    feedback_us_.push_back(feedback_us);
  }

  /// Call this after each tick of the controller, `tick` [s] after the last one. Arguments:
  /// commanded and true tilt angles [rad], and the largest tilt rate of the commanded wrench
  /// [rad/s]. The demand on a servo is its initial speed towards the command, (command - true
  /// angle) / time constant. It does not include the rate limit of the servo.
  template <int Rotors>
  void on_servos(const Eigen::Matrix<double, Rotors, 1>& command,
                 const Eigen::Matrix<double, Rotors, 1>& angle, double planned,
                 const tilt_ropter::ServoParameters& servo, double tick) {
    const double demanded = (command - angle).cwiseAbs().maxCoeff() / servo.time_constant;
    demanded_max_ = std::max(demanded_max_, demanded);
    planned_max_ = std::max(planned_max_, planned);
    if (last_command_.size() != command.size()) last_command_.setZero(command.size());
    slope_max_ = std::max(slope_max_, (command - last_command_).cwiseAbs().maxCoeff() / tick);
    last_command_ = command;
    servo_speed_ = servo.max_rate;
    if (demanded > servo.max_rate) ++exceeded_;
  }

  /// Calls line(key, value, digits) for each figure from the plant, next to the figures of the
  /// paper. The value is infinite for a flight that never caught up with its reference.
  template <typename Line>
  void for_flight(const Line& line) const {
    const auto paper = [&](const char* key, double value, int digits) {
      if (of_the_paper_) line(key, value, digits);
    };
    const bool both = air_.count() > 0 && ground_.count() > 0;  // a flight can end early
    if (air_.count() > 0) line("air_rmse_m", air_.value(), 4);
    paper("paper_air_rmse_m", 0.052, 4);
    if (ground_.count() > 0) line("ground_rmse_m", ground_.value(), 4);
    paper("paper_ground_rmse_m", 0.145, 4);
    line("mission_rmse_m", all_.value(), 4);
    paper("paper_mission_rmse_m", 0.125, 4);
    if (all_.count() > 0) line("start_error_m", start_error_, 4);
    line("caught_up_s",
         caught_up_ < 0 ? std::numeric_limits<double>::infinity()
                        : step_ * static_cast<double>(caught_up_),
         2);
    if (caught_up_ >= 0) line("caught_up_rmse_m", after_.value(), 4);
    if (air_.count() > 0) line("flight_power_w", air_power_.value(), 2);
    paper("paper_flight_power_w", 653.64, 2);
    if (ground_.count() > 0) line("ground_power_w", ground_power_.value(), 2);
    paper("paper_ground_power_w", 47.38, 2);
    if (both)
      line("power_saved_percent", 100.0 * (1.0 - ground_power_.value() / air_power_.value()), 2);
    paper("paper_power_saved_percent", 92.8, 2);
    line("touchdown_speed_mps", touchdown_speed_, 3);
    line("takeoff_overshoot_m", takeoff_overshoot_, 4);
    line("takeoff_error_m", takeoff_error_, 4);
    line("landing_error_m", landing_error_, 4);
    if (bearing_torque_ > 0.0) line("bearing_torque_nm", bearing_torque_, 5);
    if (bearing_torque_ > 0.0) line("bearing_tilt_deg", bearing_tilt_ * 180.0 / tilt_ropter::pi, 3);
  }

  /// The same, and the figures of the controller.
  template <typename Line>
  void for_all(int contact_mode_changes, const Line& line) const {
    for_flight(line);
    line("contact_mode_changes", contact_mode_changes, 0);
    if (force_error_.count() > 0) line("external_force_error_n", force_error_.value(), 3);
    line("servo_speed_radps", servo_speed_, 2);
    line("tilt_rate_max_radps", demanded_max_, 2);
    line("tilt_rate_exceeded_share",
         static_cast<double>(exceeded_) / static_cast<double>(total_us_.size()), 5);
    line("planned_tilt_rate_max_radps", planned_max_, 2);
    line("tilt_command_slope_max_radps", slope_max_, 2);
    line("nmpc_median_us", percentile(total_us_, 0.5), 1);
    line("nmpc_p99_us", percentile(total_us_, 0.99), 1);
    line("nmpc_max_us", percentile(total_us_, 1.0), 1);
    line("nmpc_feedback_median_us", percentile(feedback_us_, 0.5), 1);
    line("solver_failures", failures_, 0);
  }

  /// Prints what for_flight() and for_all() give.
  void print_flight(std::ostream& out) const { for_flight(figure_printer(out)); }
  void print(std::ostream& out, int contact_mode_changes) const {
    for_all(contact_mode_changes, figure_printer(out));
  }

  /// Over the whole flight, in the figure eights, and wherever the reference moves.
  [[nodiscard]] const TrackingError& all() const { return all_; }
  [[nodiscard]] const TrackingError& air() const { return air_; }
  [[nodiscard]] const TrackingError& ground() const { return ground_; }
  [[nodiscard]] const TrackingError& moving() const { return moving_; }
  /// Mean power in the figure eights [W].
  [[nodiscard]] const Mean& air_power() const { return air_power_; }
  [[nodiscard]] const Mean& ground_power() const { return ground_power_; }
  [[nodiscard]] double touchdown_speed() const { return touchdown_speed_; }  ///< [m/s]
  /// Largest tilt rate of the commanded wrench, and largest demand on a servo [rad/s].
  [[nodiscard]] double planned_tilt_rate() const { return planned_max_; }
  [[nodiscard]] double servo_demand() const { return demanded_max_; }
  [[nodiscard]] int failures() const { return failures_; }  ///< ticks without a plan

 private:
  /// The flight has caught up with its reference when the error stays below 5 cm for 0.5 s.
  void on_error(double error) {
    constexpr double small = 0.05;
    constexpr long stay = 500;
    const long step = all_.count() - 1;
    if (step == 0) start_error_ = error;
    if (caught_up_ < 0) {
      if (error >= small) {
        small_since_ = -1;
        after_ = {};
      } else if (small_since_ < 0) {
        small_since_ = step;
      }
      if (small_since_ >= 0 && step - small_since_ >= stay) caught_up_ = small_since_;
    }
    if (small_since_ >= 0) after_.add(error);
  }

  double flight_height_;
  bool of_the_paper_;
  static constexpr double step_ = 1e-3;  // of the plant [s]
  TrackingError all_, air_, ground_, moving_;
  Rmse force_error_;
  Rmse after_;                              // from small_since_ on
  double start_error_ = 0.0;                // [m]
  long small_since_ = -1, caught_up_ = -1;  // steps
  Mean air_power_, ground_power_;
  double touchdown_speed_ = 0.0, takeoff_overshoot_ = 0.0, takeoff_error_ = 0.0,
         landing_error_ = 0.0, bearing_torque_ = 0.0, bearing_tilt_ = 0.0;
  double servo_speed_ = 0.0, demanded_max_ = 0.0, planned_max_ = 0.0, slope_max_ = 0.0;
  Eigen::VectorXd last_command_;
  bool was_touching_ = true;
  int failures_ = 0, exceeded_ = 0;
  std::vector<double> total_us_, feedback_us_;
};

}  // namespace examples
