// Hardware in the loop, the companion computer: state estimator, wrench observer and NMPC. It
// receives sensor data from the simulator and actuator commands from the flight controller. It
// sends the commanded wrench to the flight controller.

#include "../support/mission_sensors.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_check.hpp"
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
#include <deque>
#include <exception>
#include <iostream>
#include <memory>
#include <optional>
#include <string>
#include <vector>

using namespace tilt_ropter;

namespace {

constexpr double tick = 0.01;  // period of the controller [s]

/// The onboard control loop, from the sensors to the wrench.
class Onboard {
 public:
  Onboard(const examples::VehicleFile& file, const NmpcSettings& settings)
      : vehicle_(examples::quadrotor(file)),
        allocation_(vehicle_),
        actuators_(vehicle_),
        ekf_(examples::MissionSensors<4>::estimation()),
        observer_(vehicle_.body, observer_settings(20.0)),
        contact_(vehicle_),
        nmpc_(vehicle_, settings),
        mission_(hybrid_mission(vehicle_)) {}

  /// Stores the actuator command of the flight controller.
  void on_actuators(const ActuatorState<4>& command) { command_ = command; }
  void on_pose(const hitl::Pose& m) { ekf_.on_pose(m.time, m.pose); }
  void on_rotor_speeds(const Eigen::Vector4d& speed) { rotor_speed_ = speed; }

  void on_inertial(const hitl::Inertial& m) {
    const ActuatorState<4>& applied = actuators_.update(m.time, command_, rotor_speed_);
    ekf_.on_imu(m.time, m.sample);
    observed_ = observer_.update(m.time, ekf_.corrected(m.sample), allocation_.wrench(applied));
  }

  /// Returns the wrench at `time` of the simulation, or nothing before the state is known.
  std::optional<hitl::WrenchCommand> control(double time) {
    if (!ekf_.running()) return std::nullopt;
    const BodyStated state = ekf_.take_state();
    contact_.update(time, state, observed_);
    const auto reference = [this](double t) { return mission_(t - hitl::head_start); };
    (void)nmpc_.prepare(time, reference, contact_.estimate());
    const NmpcResult& result = nmpc_.feedback(time, state);
    if (!has_plan(result.status)) ++failures_;
    solver_.add(result.status, result.report);
    return hitl::WrenchCommand{time, result.wrench, result.rate, contact_.estimate().on_ground};
  }

  [[nodiscard]] long failures() const { return failures_; }
  [[nodiscard]] const examples::SolverTicks& solver() const { return solver_; }

 private:
  Vehicle<4> vehicle_;
  Allocation<4> allocation_;
  ActuatorModel<4> actuators_;
  Ekfd ekf_;
  WrenchObserverd observer_;
  ObservedWrenchd observed_;
  ContactEstimator contact_;
  Nmpc<4> nmpc_;
  Mission mission_;
  ActuatorState<4> command_;
  Eigen::Vector4d rotor_speed_ = Eigen::Vector4d::Zero();
  long failures_ = 0;
  examples::SolverTicks solver_;
};

/// Counts how often a sender became silent, and says so.
class Silences {
 public:
  explicit Silences(const char* sender) : sender_(sender) {}
  template <typename Message>
  void watch(const hitl::Inbox<Message>& inbox) {
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

void run(const hitl::Line& line, const std::string& vehicle, const std::string& solver) {
  const examples::VehicleFile file = examples::vehicle_to_fly(vehicle);
  NmpcSettings settings =
      line.lock_step > 0.0 ? examples::in_simulated_time(file.settings()) : file.settings();
  examples::set_solver(solver, settings.solver);
  examples::SolverTicks of_missions_before;
  const dds::Participant participant(loops::ros_domain());
  hitl::Rival<tilt_ropter_msgs::msg::WrenchCommand> rival(participant, hitl::wrench_command_topic);
  hitl::Inbox<sensor_msgs::msg::Imu> imu(participant, hitl::imu_topic, line);
  hitl::Inbox<sensor_msgs::msg::JointState> speeds(participant, hitl::rotor_speeds_topic, line);
  hitl::Inbox<geometry_msgs::msg::PoseStamped> poses(participant, hitl::pose_topic, line);
  hitl::Inbox<actuator_msgs::msg::Actuators> echo(participant, hitl::actuators_topic, line);
  hitl::FlightOver flight_over(participant);
  dds::WaitSet waiting(participant);
  waiting.add(imu.subscriber());
  dds::Publisher<tilt_ropter_msgs::msg::WrenchCommand> commands(
      participant, hitl::wrench_command_topic.name, hitl::wrench_command_topic.offered());
  dds::Publisher<geometry_msgs::msg::WrenchStamped> shown(participant, hitl::shown_wrench_topic);
  hitl::Encoder encoder;
  hitl::Times durations;
  auto onboard = std::make_unique<Onboard>(file, settings);
  std::vector<hitl::Inertial> samples;         // new
  hitl::Clock::time_point simulated;           // time of the newest sample
  std::deque<hitl::RotorSpeeds> rotor_speeds;  // not older than the newest sample
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
      onboard = std::make_unique<Onboard>(file, settings);
      next = std::ceil(samples.front().time / tick) * tick;
      rotor_speeds.clear();
    }
    echo.take(now, [&](const hitl::ActuatorCommand& m) { onboard->on_actuators(m.command); });
    speeds.take(now, [&](const hitl::RotorSpeeds& m) { rotor_speeds.push_back(m); });
    for (const hitl::Inertial& m : samples) {
      for (; !rotor_speeds.empty() && rotor_speeds.front().time <= m.time; rotor_speeds.pop_front())
        onboard->on_rotor_speeds(rotor_speeds.front().speed);
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
    const auto wrench = onboard->control(time);
    failures += onboard->failures() - failed_before;
    if (!wrench) continue;
    commands.publish(encoder.encode(*wrench));
    const std::chrono::duration<double, std::micro> taken = hitl::Clock::now() - woken;
    durations.add(taken.count());
    ++ticks;
    if (taken.count() > 1e6 * tick) ++misses;
    shown.publish(encoder.shown(*wrench));
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
simulator restarts, it starts a new mission. Without messages from the flight controller it
continues with the last known actuator command. If restarted in flight, it continues the mission at
the simulator's time, after the first pose. It ends when the simulator reports the end of the
flight. The DDS domain is that of ROS 2: the environment variable ROS_DOMAIN_ID.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Hardware in the loop: state estimator, wrench observer and NMPC at 100 Hz."};
  hitl::Line line;
  std::string vehicle, solver = "automatic";
  hitl::add_options(app, line, vehicle);
  examples::add_solver_in_real_time(app, solver);
  app.footer(footer);
  return hitl::run_program(app, "hitl_onboard", argc, argv, [&] {
    run(line, vehicle, solver);
    return 0;
  });
}
