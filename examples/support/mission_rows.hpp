#pragma once

#include "battery_figures.hpp"
#include "flight_controller.hpp"
#include "flight_mcap.hpp"
#include "mission_log.hpp"

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/consistency.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <Eigen/Geometry>

#include <array>
#include <filesystem>
#include <optional>
#include <string>
#include <utility>
#include <vector>

/// The logs of a mission.
namespace examples {

/// The residuals of `consistency`, value over spread, by the names of the log's columns.
[[nodiscard]] inline std::array<std::pair<const char*, double>, 5> named_residuals(
    const tilt_ropter::Consistency& consistency) {
  return {{{"residual_rotor_speed", consistency.rotor_speed.ratio()},
           {"residual_wrench", consistency.wrench.ratio()},
           {"residual_pose", consistency.pose.ratio()},
           {"residual_load", consistency.load.ratio()},
           {"residual_battery", consistency.battery.ratio()}}};
}

namespace detail {

inline std::vector<std::string> mission_columns(int rotor_count, bool battery = false) {
  std::vector<std::string> names = {"time_s", "phase", "on_ground"};
  const auto add = [&names](const std::string& name, const std::vector<std::string>& parts) {
    for (const std::string& part : parts) names.push_back(name + "_" + part);
  };
  const std::vector<std::string> axes = {"x", "y", "z"};
  std::vector<std::string> rotors;
  for (int i = 1; i <= rotor_count; ++i) rotors.push_back(std::to_string(i));
  add("position_m", axes);
  add("reference_m", axes);
  add("velocity_mps", axes);
  add("orientation", {"w", "x", "y", "z"});
  add("angular_velocity_radps", axes);
  add("command_force_n", axes);
  add("command_torque_nm", axes);
  add("estimated_force_n", axes);
  add("estimated_torque_nm", axes);
  add("external_force_n", axes);
  add("external_torque_nm", axes);
  add("tilt_command_rad", rotors);
  add("tilt_model_rad", rotors);
  add("tilt_true_rad", rotors);
  add("rotor_speed_radps", rotors);
  for (const char* name : {"power_w", "active_rows", "kkt"}) names.emplace_back(name);
  add("reference_orientation", {"w", "x", "y", "z"});
  for (const char* name :
       {"status", "filter_running", "filter_age_s", "observer_trust", "allocation_status",
        "ground_height_m", "ground_force_n", "estimate_state", "flight_mode", "position_stddev_m",
        "solved_by", "nlopt_evaluations", "polishing_steps"})
    names.emplace_back(name);
  for (const auto& residual : named_residuals({})) names.emplace_back(residual.first);
  for (const char* name : {"blocked", "blocked_x", "blocked_y", "wall_force_n", "push_force_n"})
    names.emplace_back(name);
  if (battery) names.insert(names.end(), {"voltage_v", "current_a"});
  return names;
}

template <typename Plant, int Rotors>
void log_row(MissionLog& log, const tilt_ropter::Mission& mission, const Plant& plant,
             const FlightController<Rotors>& controller, double power,
             const BatteryFigures* battery = nullptr) {
  const double time = plant.time();
  const tilt_ropter::BodyStated& body = plant.body();
  const tilt_ropter::NmpcResult& result = controller.result();
  const Eigen::Quaterniond& q = body.orientation;
  log.add(time).add(static_cast<int>(mission.phase(time))).add(result.on_ground);
  log.add_all(body.position).add_all(mission(time).position).add_all(body.velocity);
  log.add(q.w()).add(q.x()).add(q.y()).add(q.z()).add_all(body.angular_velocity);
  log.add_all(result.wrench.force).add_all(result.wrench.torque);
  log.add_all(controller.external().force).add_all(controller.external().torque);
  log.add_all(plant.external_wrench().force).add_all(plant.external_wrench().torque);
  log.add_all(controller.command().tilt_angle).add_all(controller.applied().tilt_angle);
  log.add_all(plant.actuators().tilt_angle).add_all(plant.actuators().rotor_speed);
  log.add(power).add(result.report.active_constraints).add(result.report.kkt);
  const Eigen::Quaterniond reference = mission(time).orientation;
  log.add(reference.w()).add(reference.x()).add(reference.y()).add(reference.z());
  const tilt_ropter::ContactEstimate& contact = controller.contact().estimate();
  log.add(static_cast<int>(result.status)).add(controller.ekf().running());
  log.add(time - controller.ekf().filter_time());
  log.add(static_cast<int>(controller.observer().trust(time)));
  log.add(static_cast<int>(controller.allocated().status));
  log.add(contact.ground.height_at(body.position)).add(contact.ground_reaction.force.norm());
  log.add(static_cast<int>(controller.trust().state)).add(static_cast<int>(controller.mode()));
  log.add(controller.trust().position_stddev);
  log.add(static_cast<int>(result.report.solved_by)).add(result.report.evaluations);
  log.add(result.report.polishing_steps);
  for (const auto& residual : named_residuals(controller.consistency())) log.add(residual.second);
  const tilt_ropter::Obstacle obstacle =
      contact.blocked.value_or(tilt_ropter::Obstacle{Eigen::Vector3d::Zero(), 0.0});
  log.add(contact.blocked.has_value()).add_all(obstacle.direction.head<2>().eval());
  const std::optional<tilt_ropter::SurfacePush> push = mission(time).push;
  log.add(plant.wall_force()).add(push ? push->force : 0.0);
  if (battery != nullptr && battery->known())
    log.add(battery->load().voltage).add(battery->load().current);
  log.end_row();
}

template <typename Plant, int Rotors>
FlightSample flight_sample(const tilt_ropter::Mission& mission, const Plant& plant,
                           const FlightController<Rotors>& controller, double power) {
  const double time = plant.time();
  const tilt_ropter::ReferencePoint point = mission(time);
  const tilt_ropter::NmpcResult& result = controller.result();
  FlightSample s;
  s.time = time;
  s.estimate = controller.ekf().state();
  s.truth = plant.body();
  s.reference.position = point.position;
  s.reference.orientation = point.orientation;
  s.command = result.wrench;
  s.external = controller.external();
  s.true_external = plant.external_wrench();
  s.tilt_command = controller.command().tilt_angle;
  s.tilt = plant.actuators().tilt_angle;
  s.speed_command = controller.command().rotor_speed;
  s.speed = plant.actuators().rotor_speed;
  s.power = power;
  s.phase = to_string(mission.phase(time));
  s.mode = to_string(controller.mode());
  return s;
}

}  // namespace detail

/// The logs of a flight in `directory`, which it creates: hybrid_mission.csv, and solve_times.csv
/// beside it, because the same seed gives exactly the same log, but not the same times on the
/// clock. `mcap`: the path of an MCAP file, or empty. All throw std::runtime_error if a file cannot
/// be written.
template <int Rotors>
class MissionLogs {
 public:
  MissionLogs(const std::string& directory, bool battery, const std::string& mcap)
      : log_(in(directory, "hybrid_mission.csv"), detail::mission_columns(Rotors, battery)),
        times_(in(directory, "solve_times.csv"), {"time_s", "prepare_us", "feedback_us"}) {
    if (!mcap.empty()) mcap_.emplace(mcap, Rotors);
  }

  /// Call this after each tick of the controller.
  template <typename Plant>
  void add(const tilt_ropter::Mission& mission, const Plant& plant,
           const FlightController<Rotors>& controller, double power,
           const BatteryFigures& battery) {
    detail::log_row(log_, mission, plant, controller, power, &battery);
    const tilt_ropter::optimal_control::SolveReport& report = controller.result().report;
    times_.add(plant.time()).add(report.prepare_us).add(report.feedback_us).end_row();
    if (mcap_) mcap_->on_tick(detail::flight_sample(mission, plant, controller, power));
  }
  /// The MCAP file, or nullptr.
  [[nodiscard]] FlightMcap* mcap() { return mcap_ ? &*mcap_ : nullptr; }
  /// Call this at the end of the flight.
  void close() {
    if (mcap_) mcap_->close();
  }

 private:
  static std::string in(const std::string& directory, const std::string& name) {
    std::filesystem::create_directories(directory);
    return directory + '/' + name;
  }

  MissionLog log_, times_;
  std::optional<FlightMcap> mcap_;
};

}  // namespace examples
