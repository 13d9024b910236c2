// Hardware in the loop, the flight controller: from the wrench that hitl_onboard asks for to rotor
// speeds and tilt angles, at 500 Hz. It has the gyroscope, too: when the wrench stays away it holds
// the attitude.

#include "hitl/link.hpp"
#include "hitl/options.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <exception>
#include <iostream>
#include <optional>
#include <string>
#include <thread>

using namespace tilt_ropter;

namespace {

constexpr double period = 0.002;       // of the actuator commands [s]
constexpr double hold = 0.05;          // an older wrench is not followed any more [s]
constexpr double descend_after = 2.0;  // without a wrench [s]

/// What is applied while no wrench comes: the force of the last one, whose long-term mean carries
/// the vehicle, and a torque that holds the attitude of that moment by the gyroscope alone, at 6
/// rad/s and well damped. After two seconds the force fades, for the vehicle to come down.
class SafeWrench {
 public:
  explicit SafeWrench(const Eigen::Matrix3d& inertia) : inertia_(inertia) {}

  void on_gyro(double time, const Eigen::Vector3d& rate) {
    const double dt = std::clamp(time - time_, 0.0, 0.1);
    turned_ = (turned_ * quaternion_exp(dt * rate)).normalized();
    rate_ = rate;
    time_ = time;
  }

  /// A wrench to follow came: from its force and the present attitude on.
  void follow(const Wrench<>& wrench) {
    force_ += 0.05 * (wrench.force - force_);
    turned_.setIdentity();
  }

  [[nodiscard]] Wrench<> wrench(double silent_for) const {
    constexpr double bandwidth = 6.0;
    const Eigen::Vector3d turn = turned_.conjugate() * quaternion_log(turned_);
    Wrench<> safe;
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

void run(const hitl::Addresses& addresses, const hitl::BadLine& line,
         const std::string& vehicle_path) {
  const Vehicle<4> vehicle = examples::quadrotor(examples::vehicle_or_default(vehicle_path));
  const Allocation<4> allocation(vehicle);
  hitl::Link link(addresses.flight_controller, {addresses.simulator, addresses.onboard}, line);
  SafeWrench safe(vehicle.body.inertia);
  hitl::Times lateness;
  AllocationResult<4> sent;
  std::optional<hitl::Message> asked;  // the last wrench
  auto asked_at = hitl::Clock::now();
  std::uint32_t vehicle_session = 0;
  long cycles = 0, misses = 0, silences = 0;
  bool silent = false;
  std::cerr << "hitl_flight_controller: waiting for a wrench\n";
  const auto start = hitl::Clock::now();
  bool over = false;
  for (long i = 0; !over && hitl::interrupted == 0; ++i) {
    const auto due = start + i * std::chrono::milliseconds(2);
    std::this_thread::sleep_until(due);
    const auto now = hitl::Clock::now();
    const std::chrono::duration<double, std::micro> late = now - due;
    lateness.add(late.count());
    if (late.count() > 1e6 * period) ++misses;

    while (const auto m = link.receive()) {
      if (m->type == hitl::MessageType::end) over = asked.has_value();
      if (m->type == hitl::MessageType::inertial) {
        if (m->session != vehicle_session) {  // a new vehicle stands on the ground
          vehicle_session = m->session;
          asked.reset();
          sent = {};
          safe = SafeWrench(vehicle.body.inertia);
        }
        safe.on_gyro(m->time, {m->values[0], m->values[1], m->values[2]});
      }
      if (m->type == hitl::MessageType::wrench) {
        asked = m;
        asked_at = now;
      }
    }
    if (!asked) continue;

    const double age = std::chrono::duration<double>(now - asked_at).count();
    const bool was_silent = silent;
    silent = age > hold;
    if (silent && !was_silent) ++silences;
    Wrench<> wrench, rate;
    if (silent) {
      wrench = safe.wrench(age);
    } else {
      const auto part = [&asked](int index) {
        return Eigen::Map<const Eigen::Vector3d>(asked->values.data() + 3 * index);
      };
      rate = {part(2), part(3)};
      const double ahead = std::min(age, 0.01);  // the wrench's rate holds for a tick
      wrench = {part(0) + ahead * rate.force, part(1) + ahead * rate.torque};
      safe.follow(wrench);
    }
    const double time = std::chrono::duration<double>(now - start).count();
    sent = allocation.allocate(time, wrench, rate, sent);
    hitl::Message m;
    m.type = hitl::MessageType::actuators;
    m.time = asked->time;
    m.stamp = asked->stamp;
    Eigen::Map<Eigen::Matrix<double, 8, 1>>(m.values.data()) << sent.command.rotor_speed,
        sent.command.tilt_angle;
    link.send(0, m);
    link.send(1, m);
    ++cycles;
  }
  lateness.print(std::cout, "flight_controller_lateness");
  std::cout << "flight_controller_cycles: " << cycles
            << "\nflight_controller_deadline_misses: " << misses
            << "\nwrench_silences: " << silences << '\n';
  link.print(std::cout, "wrench", hitl::MessageType::wrench);
  std::cout << "flight_controller_foreign_datagrams: " << link.foreign() << '\n';
}

constexpr const char* footer = R"(
Between two wrenches it follows the last one along its rate. When none came for 50 ms it keeps the
force and holds the attitude by the gyroscope; after 2 s the force fades by 5 % a second. Started
anew in flight it says nothing until a wrench comes, and the simulator holds the last command. It
ends when the simulator says that the flight is over.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Hardware in the loop: allocation and actuator commands at 500 Hz."};
  hitl::Addresses addresses;
  hitl::BadLine line;
  std::string vehicle;
  hitl::add_options(app, addresses, line, vehicle);
  app.footer(footer);
  return hitl::run_program(app, "hitl_flight_controller", argc, argv, [&] {
    run(addresses, line, vehicle);
    return 0;
  });
}
