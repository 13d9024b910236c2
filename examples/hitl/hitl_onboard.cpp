// Hardware in the loop, the companion computer: state estimator, wrench observer and NMPC. It
// receives sensor data from the simulator and actuator commands from the flight controller. It
// sends the commanded wrench to the flight controller.

#include "../support/mission_sensors.hpp"
#include "link.hpp"
#include "options.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <CLI/CLI.hpp>

#include <chrono>
#include <cmath>
#include <cstdint>
#include <exception>
#include <iostream>
#include <memory>
#include <optional>
#include <string>

using namespace tilt_ropter;

namespace {

constexpr double tick = 0.01;  // period of the controller [s]

/// The onboard control loop, from the sensors to the wrench.
class Onboard {
 public:
  explicit Onboard(const examples::VehicleFile& file)
      : vehicle_(examples::quadrotor(file)),
        allocation_(vehicle_),
        actuators_(vehicle_),
        ekf_(examples::MissionSensors<4>::estimation()),
        observer_(vehicle_.body, observer_settings(20.0)),
        contact_(vehicle_),
        nmpc_(vehicle_, file.settings()),
        mission_(hybrid_mission(vehicle_)) {}

  /// Stores the actuator command of the flight controller.
  void on_actuators(const hitl::Message& m) {
    command_.rotor_speed = Eigen::Map<const Eigen::Vector4d>(m.values.data());
    command_.tilt_angle = Eigen::Map<const Eigen::Vector4d>(m.values.data() + 4);
  }

  void on_pose(const hitl::Message& m) {
    ekf_.on_pose(m.time, {{m.values[0], m.values[1], m.values[2]},
                          {m.values[3], m.values[4], m.values[5], m.values[6]}});
  }

  void on_inertial(const hitl::Message& m) {
    const InertialSampled sample{Eigen::Map<const Eigen::Vector3d>(m.values.data()),
                                 Eigen::Map<const Eigen::Vector3d>(m.values.data() + 3)};
    const ActuatorState<4> applied{Eigen::Map<const Eigen::Vector4d>(m.values.data() + 6),
                                   actuators_.update(m.time, command_).tilt_angle};
    ekf_.on_imu(m.time, sample);
    observer_.update(m.time, ekf_.corrected(sample), allocation_.wrench(applied));
  }

  /// Returns the message with the wrench at `time`, or nothing before the state is known.
  std::optional<hitl::Message> control(double time) {
    if (!ekf_.running()) return std::nullopt;
    const BodyStated state = ekf_.take_state();
    contact_.update(time, state, observer_);
    (void)nmpc_.prepare(time, mission_, contact_.estimate());
    const NmpcResult& result = nmpc_.feedback(time, state);
    if (!has_plan(result.status)) ++failures_;
    hitl::Message m;
    m.type = hitl::MessageType::wrench;
    m.time = time;
    Eigen::Map<Eigen::Matrix<double, 12, 1>>(m.values.data()) << result.wrench.force,
        result.wrench.torque, result.rate.force, result.rate.torque;
    return m;
  }

  [[nodiscard]] long failures() const { return failures_; }

 private:
  Vehicle<4> vehicle_;
  Allocation<4> allocation_;
  ActuatorModel<4> actuators_;
  Ekfd ekf_;
  WrenchObserverd observer_;
  ContactEstimator contact_;
  Nmpc<4> nmpc_;
  Mission mission_;
  ActuatorState<4> command_;
  long failures_ = 0;
};

void run(const hitl::Addresses& addresses, const hitl::BadLine& line, const std::string& vehicle) {
  const examples::VehicleFile file = examples::vehicle_or_default(vehicle);
  hitl::Link link(addresses.onboard, {addresses.simulator, addresses.flight_controller}, line);
  hitl::Times durations;
  auto onboard = std::make_unique<Onboard>(file);
  std::uint32_t session = 0;
  double next = 0.0;
  long ticks = 0, misses = 0, failures = 0, missions = 0;
  std::cerr << "hitl_onboard: waiting for the simulator\n";
  for (bool over = false; !over && hitl::interrupted == 0;) {
    link.wait(hitl::Clock::now() + std::chrono::milliseconds(100));
    const auto woken = hitl::Clock::now();
    std::optional<hitl::Message> newest;  // newest inertial message
    while (const auto m = link.receive()) {
      switch (m->type) {
        case hitl::MessageType::inertial:
          if (missions == 0 || m->session != session) {  // a new vehicle, a new mission
            session = m->session;
            ++missions;
            onboard = std::make_unique<Onboard>(file);
            next = std::ceil(m->time / tick) * tick;
          }
          onboard->on_inertial(*m);
          newest = m;
          break;
        case hitl::MessageType::pose:
          onboard->on_pose(*m);
          break;
        case hitl::MessageType::actuators:
          onboard->on_actuators(*m);
          break;
        case hitl::MessageType::end:
          over = missions > 0;
          break;
        case hitl::MessageType::wrench:
          break;
      }
    }
    if (!newest || newest->time < next - 1e-6) continue;
    // A skipped tick and a tick longer than a period are missed deadlines.
    const long behind = std::lround(std::floor((newest->time - next) / tick + 1e-6));
    misses += behind;
    next += tick * static_cast<double>(behind + 1);
    const long failed_before = onboard->failures();
    auto wrench = onboard->control(newest->time);
    failures += onboard->failures() - failed_before;
    if (!wrench) continue;
    wrench->stamp = newest->stamp;
    link.send(1, *wrench);
    const std::chrono::duration<double, std::micro> taken = hitl::Clock::now() - woken;
    durations.add(taken.count());
    ++ticks;
    if (taken.count() > 1e6 * tick) ++misses;
  }
  durations.print(std::cout, "onboard_tick");
  std::cout << "onboard_ticks: " << ticks << "\nonboard_deadline_misses: " << misses
            << "\nonboard_solver_failures: " << failures << "\nonboard_missions: " << missions
            << '\n';
  link.print(std::cout, "inertial", hitl::MessageType::inertial);
  link.print(std::cout, "pose", hitl::MessageType::pose);
  link.print(std::cout, "actuators_echo", hitl::MessageType::actuators);
  std::cout << "onboard_foreign_datagrams: " << link.foreign() << '\n';
}

constexpr const char* footer = R"(
It uses the clock of the simulator: a tick is due when an inertial message with its time arrives.
Without messages from the simulator it waits and sends nothing to the flight controller. If the
simulator restarts, it starts a new mission. Without messages from the flight controller it
continues with the last known actuator command. If restarted in flight, it continues the mission at
the simulator's time, after the first pose. It ends when the simulator reports the end of the
flight.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Hardware in the loop: state estimator, wrench observer and NMPC at 100 Hz."};
  hitl::Addresses addresses;
  hitl::BadLine line;
  std::string vehicle;
  hitl::add_options(app, addresses, line, vehicle);
  app.footer(footer);
  return hitl::run_program(app, "hitl_onboard", argc, argv, [&] {
    run(addresses, line, vehicle);
    return 0;
  });
}
