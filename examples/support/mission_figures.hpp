#pragma once

#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <iomanip>
#include <ostream>
#include <vector>

/// The figures by which a flown mission is judged, beside those of the paper.
namespace examples {

class MissionFigures {
 public:
  /// `of_the_paper`: the vehicle is that of the paper, whose figures are printed beside.
  explicit MissionFigures(double flight_height, bool of_the_paper = true)
      : flight_height_(flight_height), of_the_paper_(of_the_paper) {}

  /// One step of the plant: phase, where the CoM is and should be [m], its vertical speed [m/s],
  /// power [W], and whether a wheel touches the ground.
  void on_plant(tilt_ropter::MissionPhase phase, const Eigen::Vector3d& position,
                const Eigen::Vector3d& reference, double vertical_speed, double power,
                bool touching) {
    using tilt_ropter::MissionPhase;
    const double square = (position - reference).squaredNorm();
    all_.add(square, power);
    if (phase == MissionPhase::air) air_.add(square, power);
    if (phase == MissionPhase::ground) ground_.add(square, power);
    if (phase == MissionPhase::take_off || phase == MissionPhase::hover)
      takeoff_overshoot_ = std::max(takeoff_overshoot_, position.z() - flight_height_);
    if (phase == MissionPhase::take_off)
      takeoff_error_ = std::max(takeoff_error_, std::sqrt(square));
    if (touching && !was_touching_) touchdown_speed_ = std::max(touchdown_speed_, -vertical_speed);
    was_touching_ = touching;
  }

  /// What the observer says and what acts on the vehicle, force in the body frame [N].
  void on_external_force(tilt_ropter::MissionPhase phase, const Eigen::Vector3d& estimated,
                         const Eigen::Vector3d& truth) {
    if (phase == tilt_ropter::MissionPhase::air)
      force_error_.add((estimated - truth).squaredNorm(), 0.0);
  }

  /// One tick of the controller.
  void on_control(bool solved, double total_us, double feedback_us) {
    if (!solved) ++failures_;
    total_us_.push_back(total_us);
    feedback_us_.push_back(feedback_us);
  }

  /// One tick of the controller, `tick` [s] after the last: tilt angles commanded and true [rad]
  /// and the greatest tilt rate of the wrench that is commanded [rad/s]. What a servo is asked for
  /// is the speed at which it has to start towards its command, (command - true angle) / time
  /// constant, before its own limit cuts it.
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

  /// What the plant tells, beside the paper's figures.
  void print_flight(std::ostream& out) const {
    const auto line = [&out](const char* key, double value, int digits) {
      print_line(out, key, value, digits);
    };
    const auto paper = [&](const char* key, double value, int digits) {
      if (of_the_paper_) line(key, value, digits);
    };
    const bool both = air_.count > 0 && ground_.count > 0;  // a flight can be cut short
    if (air_.count > 0) line("air_rmse_m", air_.rmse(), 4);
    paper("paper_air_rmse_m", 0.052, 4);
    if (ground_.count > 0) line("ground_rmse_m", ground_.rmse(), 4);
    paper("paper_ground_rmse_m", 0.145, 4);
    line("mission_rmse_m", all_.rmse(), 4);
    paper("paper_mission_rmse_m", 0.125, 4);
    if (air_.count > 0) line("flight_power_w", air_.power(), 2);
    paper("paper_flight_power_w", 653.64, 2);
    if (ground_.count > 0) line("ground_power_w", ground_.power(), 2);
    paper("paper_ground_power_w", 47.38, 2);
    if (both) line("power_saved_percent", 100.0 * (1.0 - ground_.power() / air_.power()), 2);
    paper("paper_power_saved_percent", 92.8, 2);
    line("touchdown_speed_mps", touchdown_speed_, 3);
    line("takeoff_overshoot_m", takeoff_overshoot_, 4);
    line("takeoff_error_m", takeoff_error_, 4);
  }

  void print(std::ostream& out, int contact_mode_changes) {
    print_flight(out);
    const auto line = [&out](const char* key, double value, int digits) {
      print_line(out, key, value, digits);
    };
    line("contact_mode_changes", contact_mode_changes, 0);
    if (force_error_.count > 0) line("external_force_error_n", force_error_.rmse(), 3);
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

 private:
  static void print_line(std::ostream& out, const char* key, double value, int digits) {
    out << key << ": " << std::fixed << std::setprecision(digits) << value << '\n';
  }

  struct Means {
    double squares = 0.0, powers = 0.0;
    long count = 0;
    void add(double square, double power_now) {
      squares += square;
      powers += power_now;
      ++count;
    }
    [[nodiscard]] double rmse() const { return std::sqrt(squares / static_cast<double>(count)); }
    [[nodiscard]] double power() const { return powers / static_cast<double>(count); }
  };

  static double percentile(std::vector<double>& values, double share) {
    if (values.empty()) return 0.0;
    const auto index = static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
    std::nth_element(values.begin(), values.begin() + index, values.end());
    return values[static_cast<std::size_t>(index)];
  }

  double flight_height_;
  bool of_the_paper_;
  Means all_, air_, ground_, force_error_;
  double touchdown_speed_ = 0.0, takeoff_overshoot_ = 0.0, takeoff_error_ = 0.0;
  double servo_speed_ = 0.0, demanded_max_ = 0.0, planned_max_ = 0.0, slope_max_ = 0.0;
  Eigen::VectorXd last_command_;
  bool was_touching_ = true;
  int failures_ = 0, exceeded_ = 0;
  std::vector<double> total_us_, feedback_us_;
};

}  // namespace examples
