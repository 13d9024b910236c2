// Hardware in the loop, the flight controller: computes rotor speeds and tilt angles at 500 Hz from
// the wrench that hitl_onboard commands, or sends those that it commands. It also receives the
// gyroscope and holds the attitude if nothing arrives.

#include "../support/control_level.hpp"
#include "../support/level_nmpc.hpp"
#include "link.hpp"
#include "options.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <chrono>
#include <exception>
#include <iostream>
#include <optional>
#include <string>
#include <thread>
#include <variant>

using namespace tilt_ropter;

namespace {

constexpr double period = 0.002;       // period of the actuator commands [s]
constexpr double descend_after = 2.0;  // time without a wrench until the force fades [s]

/// Wrench while no wrench arrives. The force is the low-pass filtered force of the wrenches so far,
/// whose mean carries the vehicle. The torque holds the attitude of the last wrench with the
/// gyroscope only, with a bandwidth of 6 rad/s and strong damping. After 2 s the force fades, so
/// that the vehicle descends.
class SafeWrench {
 public:
  explicit SafeWrench(const Eigen::Matrix3d& inertia) : inertia_(inertia) {}

  void on_gyro(double time, const Eigen::Vector3d& rate) {
    const double dt = std::clamp(time - time_, 0.0, 0.1);
    turned_ = (turned_ * quaternion_exp(dt * rate)).normalized();
    rate_ = rate;
    time_ = time;
  }

  /// Call for every wrench that is followed: filters its force and takes the attitude as reference.
  void follow(const Wrenchd& wrench) {
    force_ += 0.05 * (wrench.force - force_);
    turned_.setIdentity();
  }

  [[nodiscard]] Wrenchd wrench(double silent_for) const {
    constexpr double bandwidth = 6.0;
    const Eigen::Vector3d turn = turned_.conjugate() * quaternion_log(turned_);
    Wrenchd safe;
    safe.force = force_ * std::clamp(1.0 - 0.05 * (silent_for - descend_after), 0.0, 1.0);
    safe.torque = -inertia_ * (bandwidth * bandwidth * turn + 1.8 * bandwidth * rate_);
    return safe;
  }

 private:
  Eigen::Matrix3d inertia_;
  Eigen::Vector3d force_ = Eigen::Vector3d::Zero(), rate_ = Eigen::Vector3d::Zero();
  Eigen::Quaterniond turned_ = Eigen::Quaterniond::Identity();
  double time_ = 0.0;
};

/// What hitl_onboard asked for last.
template <int Rotors>
struct Asked {
  double time = 0.0;
  Wrenchd wrench, rate;
  std::optional<ActuatorState<Rotors>> command;  // at the actuator level
};

template <int Rotors>
void run(const hitl::Line& line, const examples::VehicleFile& file,
         const Vehicle<Rotors>& vehicle) {
  auto level = examples::at_level("", file, vehicle, [&](const auto& settings) {
    return examples::LevelNmpc<Rotors>(vehicle, settings);
  });
  const bool lock_step = line.lock_step > 0.0;
  const dds::Participant participant(loops::ros_domain());
  hitl::Rival<actuator_msgs::msg::Actuators> rival(participant, hitl::actuators_topic);
  hitl::Inbox<sensor_msgs::msg::Imu> imu(participant, hitl::imu_topic, line);
  hitl::Inbox<tilt_ropter_msgs::msg::WrenchCommand> wrenches(participant,
                                                             hitl::wrench_command_topic, line);
  hitl::Inbox<actuator_msgs::msg::Actuators, Rotors> commands(participant,
                                                              hitl::actuator_command_topic, line);
  hitl::FlightOver flight_over(participant);
  dds::WaitSet waiting(participant);
  waiting.add(wrenches.subscriber());
  waiting.add(commands.subscriber());
  dds::Publisher<actuator_msgs::msg::Actuators> actuators(participant, hitl::actuators_topic.name,
                                                          hitl::actuators_topic.offered());
  hitl::Encoder encoder;
  SafeWrench safe(vehicle.body.inertia);
  hitl::Times lateness;
  ActuatorState<Rotors> sent;
  std::optional<Asked<Rotors>> asked;
  auto asked_at = hitl::Clock::now();
  long cycles = 0, misses = 0, silences = 0, vehicles = 0;
  bool silent = false;
  std::cerr << "hitl_flight_controller: waiting for hitl_onboard\n";
  hitl::Clock::time_point start, now;
  if (!lock_step) start = hitl::Clock::now();
  bool over = false;
  for (long i = 0; !over && hitl::interrupted == 0; ++i) {
    if (lock_step) {
      waiting.wait(2 * hitl::millisecond);
    } else {
      const auto due = start + i * std::chrono::milliseconds(2);
      std::this_thread::sleep_until(due);
      now = hitl::Clock::now();
      const std::chrono::duration<double, std::micro> late = now - due;
      lateness.add(late.count());
      if (late.count() > 1e6 * period) ++misses;
    }
    rival.check(hitl::Clock::now());
    imu.take(now, [&](const hitl::Inertial& m) {
      if (lock_step) now = hitl::time_point(m.time);
      if (imu.sessions() != vehicles) {  // simulator restarted: a new vehicle on the ground
        vehicles = imu.sessions();
        asked.reset();
        sent = {};
        level.forget();
        safe = SafeWrench(vehicle.body.inertia);
      }
      safe.on_gyro(m.time, m.sample.angular_velocity);
    });
    bool fresh = false;
    const auto ask = [&](const Asked<Rotors>& newer) {
      fresh = true;
      asked = newer;
      asked_at = now;
    };
    wrenches.take(now, [&](const hitl::WrenchCommand& m) {
      ask({m.time, m.wrench, m.rate, std::nullopt});
    });
    commands.take(now, [&](const hitl::ActuatorCommand<Rotors>& m) {
      ask({m.time, level.wrench_of(m.command), {}, m.command});
    });
    over = flight_over.reported() && asked.has_value();
    if (!asked) continue;

    const double age = std::chrono::duration<double>(now - asked_at).count();
    const bool was_silent = silent;
    silent = wrenches.silent() && commands.silent();
    if (silent && !was_silent) {
      ++silences;
      std::cerr << "hitl_flight_controller: hitl_onboard is "
                << (wrenches.sender_lives() ? "silent\n" : "gone\n");
    }
    const auto send = [&] {
      actuators.publish(encoder.encode(hitl::ActuatorCommand<Rotors>{asked->time, sent}));
    };
    if (lock_step && !fresh && !silent) {  // again, for a bad line
      send();
      continue;
    }
    const double time = std::chrono::duration<double>(now - start).count();
    if (silent) {
      sent = level.give(time, safe.wrench(age), {});
    } else {
      const Wrenchd& rate = asked->rate;
      const double ahead = std::min(age, 0.01);  // the rate is valid for one tick
      const Wrenchd wrench{asked->wrench.force + ahead * rate.force,
                           asked->wrench.torque + ahead * rate.torque};
      safe.follow(wrench);
      sent = asked->command ? *asked->command : level.give(time, wrench, rate);
    }
    send();
    ++cycles;
  }
  lateness.print(std::cout, "flight_controller_lateness");
  std::cout << "flight_controller_cycles: " << cycles
            << "\nflight_controller_deadline_misses: " << misses
            << "\nwrench_silences: " << silences << '\n';
  wrenches.print(std::cout, "wrench");
  commands.print(std::cout, "actuator_command");
  std::cout << "flight_controller_foreign_datagrams: "
            << wrenches.counts().rejected + commands.counts().rejected + imu.counts().rejected
            << '\n';
}

constexpr const char* footer = R"(
Between two wrenches it extrapolates the last wrench with its rate, for at most 10 ms. At the
actuator level hitl_onboard commands rotor speeds and tilt angles, which it sends on. After 50 ms
without a command it keeps the mean force and holds the attitude with the gyroscope. After 2 s the
force fades by 5 % per second. If restarted in flight, it sends nothing until a command arrives, and
the simulator holds the last one. It ends when the simulator reports the end of the flight.
With --lock-step its clock is the time of the IMU, and it computes one command for each wrench.
The DDS domain is that of ROS 2: the environment variable ROS_DOMAIN_ID.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Hardware in the loop: allocation and actuator commands at 500 Hz."};
  hitl::Line line;
  std::string path;
  hitl::add_options(app, line, path);
  app.footer(footer);
  return hitl::run_program(app, "hitl_flight_controller", argc, argv, [&] {
    const examples::VehicleFile file = examples::vehicle_or_default(path);
    std::visit([&](const auto& vehicle) { run(line, file, vehicle); }, file.vehicle);
    return 0;
  });
}
