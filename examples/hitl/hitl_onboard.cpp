// Hardware in the loop, the companion computer: state estimator, wrench observer and NMPC. It
// receives sensor data from the simulator and actuator commands from the flight controller. It
// sends the commanded wrench to the flight controller, or at the actuator level rotor speeds and
// tilt angles.

#include "../support/control_level.hpp"
#include "../support/flight_controller.hpp"
#include "../support/mission_sensors.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_check.hpp"
#include "link.hpp"
#include "options.hpp"

#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <CLI/CLI.hpp>

#include <chrono>
#include <cmath>
#include <deque>
#include <exception>
#include <iostream>
#include <limits>
#include <memory>
#include <string>
#include <variant>
#include <vector>

using namespace tilt_ropter;

namespace {

constexpr double tick = 0.01;  // period of the controller [s]

/// The control loop of one flight of the hybrid mission: that of the nodes and of hybrid_mission.
template <int Rotors>
class Onboard {
 public:
  template <typename Settings>
  Onboard(const Vehicle<Rotors>& vehicle, const Settings& settings)
      : controller_(vehicle, settings, examples::MissionSensors<Rotors>::estimation()),
        mission_(hybrid_mission(vehicle)) {}

  void on_pose(const hitl::Pose& m) { controller_.on_pose(m.time, m.pose); }
  void on_rotor_speeds(const hitl::RotorSpeeds<Rotors>& m) { controller_.on_rotor_speeds(m.speed); }
  void on_inertial(const hitl::Inertial& m) { controller_.on_imu(m.time, m.sample); }

  /// Plans at `time` of the simulation. False before the state is known.
  bool control(double time) {
    if (!controller_.started()) return false;
    controller_.prepare(time, [this](double t) { return mission_(t - hitl::head_start); });
    command_ = controller_.control(time);
    const NmpcResult& result = controller_.result();
    if (!has_plan(result.status)) ++failures_;
    solver_.add(result.status, result.report);
    return true;
  }

  /// False at the actuator level, and where the rotors stop after a landing without a state.
  [[nodiscard]] bool commands_a_wrench() const {
    return controller_.at_wrench_level() && controller_.mode() != examples::FlightMode::stopped;
  }
  /// Of the last control().
  [[nodiscard]] hitl::WrenchCommand wrench(double time) const {
    const NmpcResult& result = controller_.result();
    return {time, result.wrench, result.rate, controller_.contact().estimate().on_ground};
  }
  [[nodiscard]] hitl::ActuatorCommand<Rotors> command(double time) const {
    return {time, command_};
  }

  [[nodiscard]] long failures() const { return failures_; }
  [[nodiscard]] const examples::SolverTicks& solver() const { return solver_; }

 private:
  examples::FlightController<Rotors> controller_;
  Mission mission_;
  ActuatorState<Rotors> command_;
  long failures_ = 0;
  examples::SolverTicks solver_;
};

/// Counts how often a sender became silent, and says so.
class Silences {
 public:
  explicit Silences(const char* sender) : sender_(sender) {}
  template <typename Message, int Rotors>
  void watch(const hitl::Inbox<Message, Rotors>& inbox) {
    if (inbox.silent() && !silent_) {
      ++count_;
      std::cerr << "hitl_onboard: " << sender_
                << (inbox.sender_lives() ? " is silent\n" : " is gone\n");
    }
    silent_ = inbox.silent();
  }
  [[nodiscard]] long count() const { return count_; }

 private:
  const char* sender_;
  bool silent_ = true;
  long count_ = 0;
};

template <int Rotors>
void run(const hitl::Line& line, const std::string& level, const std::string& solver,
         const examples::VehicleFile& file, const Vehicle<Rotors>& vehicle) {
  const auto start = [&] {
    return examples::at_level(level, file, vehicle, [&](auto settings) {
      if (line.lock_step > 0.0) settings.time_limit = std::numeric_limits<double>::infinity();
      examples::set_solver(solver, settings.solver);
      return std::make_unique<Onboard<Rotors>>(vehicle, settings);
    });
  };
  auto onboard = start();
  examples::SolverTicks of_missions_before;
  const dds::Participant participant(loops::ros_domain());
  // Published at both levels, so that one program of this kind finds the other.
  hitl::Rival<tilt_ropter_msgs::msg::WrenchCommand> rival(participant, hitl::wrench_command_topic);
  hitl::Inbox<sensor_msgs::msg::Imu> imu(participant, hitl::imu_topic, line);
  hitl::Inbox<sensor_msgs::msg::JointState, Rotors> speeds(participant, hitl::rotor_speeds_topic,
                                                           line);
  hitl::Inbox<geometry_msgs::msg::PoseStamped> poses(participant, hitl::pose_topic, line);
  hitl::Inbox<actuator_msgs::msg::Actuators, Rotors> echo(participant, hitl::actuators_topic, line);
  hitl::FlightOver flight_over(participant);
  dds::WaitSet waiting(participant);
  waiting.add(imu.subscriber());
  dds::Publisher<tilt_ropter_msgs::msg::WrenchCommand> wrenches(
      participant, hitl::wrench_command_topic.name, hitl::wrench_command_topic.offered());
  dds::Publisher<actuator_msgs::msg::Actuators> commands(
      participant, hitl::actuator_command_topic.name, hitl::actuator_command_topic.offered());
  dds::Publisher<geometry_msgs::msg::WrenchStamped> shown(participant, hitl::shown_wrench_topic);
  hitl::Encoder encoder;
  hitl::Times durations;
  std::vector<hitl::Inertial> samples;                 // new
  hitl::Clock::time_point simulated;                   // time of the newest sample
  std::deque<hitl::RotorSpeeds<Rotors>> rotor_speeds;  // not older than the newest sample
  Silences simulator("hitl_simulator"), flight_controller("hitl_flight_controller");
  double next = 0.0;
  long ticks = 0, misses = 0, failures = 0, missions = 0;
  std::cerr << "hitl_onboard: waiting for the simulator\n";
  for (bool over = false; !over && hitl::interrupted == 0;) {
    waiting.wait(100 * hitl::millisecond);
    const auto woken = hitl::Clock::now();
    auto now = line.lock_step > 0.0 ? simulated : woken;
    rival.check(woken);
    bool new_vehicle = false;
    samples.clear();
    imu.take(now, [&](const hitl::Inertial& m) {
      if (imu.sessions() != missions) {  // a new vehicle, a new mission
        missions = imu.sessions();
        new_vehicle = true;
        samples.clear();
      }
      samples.push_back(m);
    });
    if (!samples.empty()) simulated = hitl::time_point(samples.back().time);
    if (line.lock_step > 0.0) now = simulated;
    if (new_vehicle) {
      of_missions_before.add(onboard->solver());
      onboard = start();
      next = std::ceil(samples.front().time / tick) * tick;
      rotor_speeds.clear();
    }
    echo.take(now, [](const hitl::ActuatorCommand<Rotors>&) {});
    speeds.take(now, [&](const hitl::RotorSpeeds<Rotors>& m) { rotor_speeds.push_back(m); });
    for (const hitl::Inertial& m : samples) {
      for (; !rotor_speeds.empty() && rotor_speeds.front().time <= m.time; rotor_speeds.pop_front())
        onboard->on_rotor_speeds(rotor_speeds.front());
      onboard->on_inertial(m);
    }
    while (rotor_speeds.size() > 1000) rotor_speeds.pop_front();  // the IMU is silent
    poses.take(now, [&](const hitl::Pose& m) { onboard->on_pose(m); });
    over = flight_over.reported() && missions > 0;
    simulator.watch(imu);
    flight_controller.watch(echo);
    if (samples.empty() || samples.back().time < next - 1e-6) continue;
    // A skipped tick and a tick longer than a period are missed deadlines.
    const double time = samples.back().time;
    const long behind = std::lround(std::floor((time - next) / tick + 1e-6));
    misses += behind;
    next += tick * static_cast<double>(behind + 1);
    const long failed_before = onboard->failures();
    const bool controlled = onboard->control(time);
    failures += onboard->failures() - failed_before;
    if (!controlled) continue;
    if (onboard->commands_a_wrench())
      wrenches.publish(encoder.encode(onboard->wrench(time)));
    else
      commands.publish(encoder.encode(onboard->command(time)));
    const std::chrono::duration<double, std::micro> taken = hitl::Clock::now() - woken;
    durations.add(taken.count());
    ++ticks;
    if (taken.count() > 1e6 * tick) ++misses;
    shown.publish(encoder.shown(onboard->wrench(time)));
  }
  of_missions_before.add(onboard->solver());
  of_missions_before.print(std::cout);
  durations.print(std::cout, "onboard_tick");
  std::cout << "onboard_ticks: " << ticks << "\nonboard_deadline_misses: " << misses
            << "\nonboard_solver_failures: " << failures << "\nonboard_missions: " << missions
            << "\nsimulator_silences: " << simulator.count()
            << "\nflight_controller_silences: " << flight_controller.count() << '\n';
  imu.print(std::cout, "inertial");
  poses.print(std::cout, "pose");
  echo.print(std::cout, "actuators_echo");
  std::cout << "onboard_foreign_datagrams: "
            << imu.counts().rejected + speeds.counts().rejected + poses.counts().rejected +
                   echo.counts().rejected
            << '\n';
}

constexpr const char* footer = R"(
It uses the clock of the simulator: a tick is due when an inertial message with its time arrives.
Without messages from the simulator it waits and sends nothing to the flight controller. If the
simulator restarts, it starts a new mission. If restarted in flight, it holds the position from the
first pose on and flies back to the mission, which goes on at the simulator's time. It holds its
position or lands if the estimate becomes bad. It ends when the simulator reports the end of the
flight. The DDS domain is that of ROS 2: the environment variable ROS_DOMAIN_ID.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Hardware in the loop: state estimator, wrench observer and NMPC at 100 Hz."};
  hitl::Line line;
  std::string path, level, solver = "automatic";
  hitl::add_options(app, line, path);
  examples::add_level(app, level);
  examples::add_solver_in_real_time(app, solver);
  app.footer(footer);
  return hitl::run_program(app, "hitl_onboard", argc, argv, [&] {
    const examples::VehicleFile file = examples::vehicle_to_fly(path);
    const std::string choice = examples::level_choice(level, file);
    if (!choice.empty()) std::cerr << choice << '\n';
    std::visit([&](const auto& vehicle) { run(line, level, solver, file, vehicle); }, file.vehicle);
    return 0;
  });
}
