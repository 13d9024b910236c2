#pragma once

#include "actuator_instances.hpp"
#include "program_audit.hpp"
#include "solver_choice.hpp"
#include "vehicle_spread.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <ctime>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

/// Flights that start with a large disturbance: they show which disturbances a controller recovers
/// from and the processor time of its ticks.
namespace examples {

enum class Scenario { step, yaw, knocked, thrown, inverted, random };

[[nodiscard]] inline const std::map<std::string, Scenario>& scenarios() {
  static const std::map<std::string, Scenario> all{
      {"step", Scenario::step},         {"yaw", Scenario::yaw},
      {"knocked", Scenario::knocked},   {"thrown", Scenario::thrown},
      {"inverted", Scenario::inverted}, {"random", Scenario::random}};
  return all;
}

/// Returns the size of a scenario in the checks of the controller. Units: step m, yaw and inverted
/// degrees, knocked rad/s, thrown m/s; random is a factor.
[[nodiscard]] inline double usual_size(Scenario scenario) {
  switch (scenario) {
    case Scenario::step:
      return 20.0;
    case Scenario::yaw:
    case Scenario::inverted:
      return 180.0;
    case Scenario::knocked:
      return std::sqrt(116.0);  // (8, 6, 4) rad/s
    case Scenario::thrown:
      return 6.0;
    case Scenario::random:
      break;
  }
  return 1.0;
}
/// Returns the height at which the vehicle hovers before the disturbance [m]. It is high enough for
/// a physically possible recovery.
[[nodiscard]] inline double usual_height(Scenario scenario) {
  return scenario == Scenario::random ? 20.0 : 10.0;
}

/// Start of a flight: the reference, and the state into which the vehicle is put.
struct StressStart {
  tilt_ropter::ReferencePoint reference;
  tilt_ropter::BodyStated body;
};

/// Returns the start of flight `index`. Flight 0 has the simplest direction (forward, left, about
/// (8, 6, 4)). The other flights have random directions; a step has a random horizontal direction.
[[nodiscard]] inline StressStart stress_start(Scenario scenario, double size, double height,
                                              std::uint64_t seed, std::uint64_t index) {
  using tilt_ropter::quaternion_exp;
  constexpr double degree = tilt_ropter::pi / 180.0;
  RandomStream random(seed, index);
  const auto direction = [&random]() -> Eigen::Vector3d {
    for (;;) {
      const Eigen::Vector3d v = random.uniform_vector(-1.0, 1.0);
      if (v.norm() > 0.1 && v.norm() <= 1.0) return v.normalized();
    }
  };
  const Eigen::Vector3d any = direction();
  const bool plain = index == 0;
  StressStart start;
  start.reference.position << 0.0, 0.0, height;
  start.body.position = start.reference.position;
  switch (scenario) {
    case Scenario::step: {
      const double heading = plain ? 0.0 : random.uniform(-tilt_ropter::pi, tilt_ropter::pi);
      start.reference.position += size * Eigen::Vector3d(std::cos(heading), std::sin(heading), 0.0);
      break;
    }
    case Scenario::yaw:
      start.reference.orientation =
          tilt_ropter::quaternion_from_yaw((plain || any.x() > 0.0 ? size : -size) * degree);
      break;
    case Scenario::knocked:
      start.body.angular_velocity =
          size * (plain ? Eigen::Vector3d(8.0, 6.0, 4.0).normalized() : any);
      break;
    case Scenario::thrown:
      start.body.velocity = size * (plain ? Eigen::Vector3d(1.0, 0.0, 0.0) : any);
      start.body.angular_velocity =
          size * 5.0 / 6.0 * (plain ? Eigen::Vector3d(0.0, 1.0, 0.0) : direction());
      break;
    case Scenario::inverted: {
      const double heading = plain ? 0.0 : random.uniform(-tilt_ropter::pi, tilt_ropter::pi);
      start.body.orientation = quaternion_exp(
          size * degree * Eigen::Vector3d(std::cos(heading), std::sin(heading), 0.0));
      break;
    }
    case Scenario::random:
      start.body.position += size * random.uniform(0.0, 5.0) * any;
      start.body.velocity = size * random.uniform(0.0, 5.0) * direction();
      start.body.orientation = quaternion_exp(std::min(size, 1.0) * tilt_ropter::pi *
                                              random.uniform(0.0, 1.0) * direction());
      start.body.angular_velocity = size * random.uniform(0.0, 8.0) * direction();
      break;
  }
  return start;
}

/// Deviation of a vehicle from the reference at one time.
struct StressSample {
  double time = 0.0;  ///< since the disturbance [s]
  /// Distance, angle and speed relative to the reference [m, rad, m/s].
  double distance = 0.0, angle = 0.0, speed = 0.0;
  double height = 0.0;  ///< height of the CoM [m]
};

struct StressRecord {
  bool recovered = false;
  /// Time after which the vehicle stayed within 0.1 m, 0.1 rad, 0.2 m/s [s].
  double recovery_time = 0.0;
  double lowest = 0.0;             ///< lowest height [m]
  double worst_bound_ratio = 0.0;  ///< largest ratio of a command or rate to its bound
  double worst_solved = 0.0;       ///< largest recomputed residual of a tick with the status solved
  /// Number of ticks with the status solved and a residual above the limit.
  int unsolved_called_solved = 0;
  SolverTicks solver;                 ///< of ticks after the disturbance
  int approximate = 0, failures = 0;  ///< numbers of approximate and failed ticks
  /// Most Riccati passes, rounds of NLopt and gradient evaluations by NLopt in a tick.
  int most_passes = 0, most_rounds = 0, most_evaluations = 0;
  /// Processor time of ticks before and after the disturbance [us].
  std::vector<double> hover_us, tick_us;
  std::vector<StressSample> samples;  ///< ten samples per second
  [[nodiscard]] double worst_us() const {
    return tick_us.empty() ? 0.0 : *std::max_element(tick_us.begin(), tick_us.end());
  }
};

[[nodiscard]] inline double thread_microseconds() {
  std::timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return 1e6 * static_cast<double>(now.tv_sec) + 1e-3 * static_cast<double>(now.tv_nsec);
}

/// Returns the largest |x| / bound, where the bound is the lower or the upper one.
[[nodiscard]] inline double bound_ratio(const Eigen::Vector3d& x, const Eigen::Vector3d& lower,
                                        const Eigen::Vector3d& upper) {
  double largest = 0.0;
  for (int i = 0; i < 3; ++i) {
    if (x(i) > 0.0) largest = std::max(largest, x(i) / upper(i));
    if (x(i) < 0.0) largest = std::max(largest, lower(i) < 0.0 ? x(i) / lower(i) : 1e9);
    if (!std::isfinite(x(i))) largest = 1e9;
  }
  return largest;
}

/// The wrench level in a stress flight: Nmpc and Allocation.
template <int Rotors>
class WrenchLevel {
 public:
  using Problem = typename tilt_ropter::Nmpc<Rotors>::Problem;

  WrenchLevel(const tilt_ropter::Vehicle<Rotors>& vehicle,
              const tilt_ropter::NmpcSettings& settings)
      : allocation_(vehicle), nmpc_(vehicle, settings) {
    tilt_ropter::Wrenchd hover;
    hover.force.z() = vehicle.body.mass * tilt_ropter::gravity;
    sent_ = allocation_.allocate(hover, tilt_ropter::ActuatorState<Rotors>{});
  }

  [[nodiscard]] const tilt_ropter::ActuatorState<Rotors>& command() const { return sent_.command; }
  [[nodiscard]] tilt_ropter::Wrenchd wrench(
      const tilt_ropter::ActuatorState<Rotors>& actuators) const {
    return allocation_.wrench(actuators);
  }
  void prepare(double time, const tilt_ropter::ReferencePoint& reference,
               const tilt_ropter::Wrenchd& external) {
    (void)nmpc_.prepare(
        time, [&](double) { return reference; }, tilt_ropter::in_the_air(external));
  }
  const tilt_ropter::NmpcResult& feedback(double time, const tilt_ropter::BodyStated& body,
                                          const tilt_ropter::ActuatorState<Rotors>&) {
    return nmpc_.feedback(time, body);
  }
  /// Sets the command that follows from the result.
  void command_result(double time) {
    const tilt_ropter::NmpcResult& result = nmpc_.result();
    sent_ = allocation_.allocate(time, result.wrench, result.rate, sent_);
  }
  [[nodiscard]] double largest_bound_ratio() const {
    const tilt_ropter::NmpcResult& result = nmpc_.result();
    const tilt_ropter::NmpcBounds& bounds = nmpc_.settings().problem.bounds;
    return std::max({bound_ratio(result.wrench.force, bounds.force_min, bounds.force_max),
                     bound_ratio(result.wrench.torque, bounds.torque_min, bounds.torque_max),
                     bound_ratio(result.rate.force, -bounds.force_rate, bounds.force_rate),
                     bound_ratio(result.rate.torque, -bounds.torque_rate, bounds.torque_rate)});
  }
  [[nodiscard]] const auto& solver() const { return nmpc_.solver(); }

 private:
  tilt_ropter::Allocation<Rotors> allocation_;
  tilt_ropter::Nmpc<Rotors> nmpc_;
  tilt_ropter::AllocationResult<Rotors> sent_;
};

/// The actuator level in a stress flight: ActuatorNmpc.
template <int Rotors>
class ActuatorLevel {
 public:
  using Problem = typename tilt_ropter::ActuatorNmpc<Rotors>::Problem;

  ActuatorLevel(const tilt_ropter::Vehicle<Rotors>& vehicle,
                const tilt_ropter::ActuatorNmpcSettings& settings)
      : body_(vehicle), nmpc_(vehicle, settings), command_(nmpc_.result().command) {}

  [[nodiscard]] const tilt_ropter::ActuatorState<Rotors>& command() const { return command_; }
  [[nodiscard]] tilt_ropter::Wrenchd wrench(
      const tilt_ropter::ActuatorState<Rotors>& actuators) const {
    return body_.wrench(actuators);
  }
  void prepare(double time, const tilt_ropter::ReferencePoint& reference,
               const tilt_ropter::Wrenchd& external) {
    (void)nmpc_.prepare(
        time, [&](double) { return reference; }, tilt_ropter::in_the_air(external));
  }
  const tilt_ropter::ActuatorNmpcResult<Rotors>& feedback(
      double time, const tilt_ropter::BodyStated& body,
      const tilt_ropter::ActuatorState<Rotors>& actuators) {
    return nmpc_.feedback(time, body, actuators);
  }
  void command_result(double) { command_ = nmpc_.result().command; }
  [[nodiscard]] double largest_bound_ratio() const {
    const auto& limits = nmpc_.solver().problem().limits();
    const auto& result = nmpc_.result();
    double largest = 0.0;
    for (int i = 0; i < Rotors; ++i) {
      const double thrust = body_.thrust(i, result.command.rotor_speed(i));
      largest = std::max({largest, thrust / limits.max_thrust(i),
                          std::abs(result.thrust_rate(i)) / limits.thrust_rate(i),
                          std::abs(result.tilt_rate(i)) / limits.tilt_rate(i)});
    }
    return largest;
  }
  [[nodiscard]] const auto& solver() const { return nmpc_.solver(); }

 private:
  tilt_ropter::ActuatedBody<Rotors> body_;
  tilt_ropter::ActuatorNmpc<Rotors> nmpc_;
  tilt_ropter::ActuatorState<Rotors> command_;
};

/// Hovers for two seconds, is then put into the state of `start`, and flies on for `duration` [s].
/// Runs controller, observer and allocation at the period of `settings`, with true states. `Level`
/// is WrenchLevel or ActuatorLevel.
template <template <int> class Level, int Rotors, typename Settings>
[[nodiscard]] StressRecord fly_stress(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                      const Settings& settings, const StressStart& start,
                                      double duration) {
  using namespace tilt_ropter;
  constexpr double plant_step = 5e-4, settle = 2.0, not_yet = -1.0;
  const int steps = std::max(1, static_cast<int>(std::lround(settings.period / plant_step)));
  const double dt = settings.period / steps;
  ReferencePoint reference = start.reference;
  reference.position = start.body.position;
  reference.orientation = Eigen::Quaterniond::Identity();
  Plant<Rotors> plant(vehicle);
  Level<Rotors> control(vehicle, settings);
  ActuatorModel<Rotors> actuators(vehicle);
  WrenchObserverd observer(vehicle.body);
  ProgramAudit<typename Level<Rotors>::Problem> audit;

  BodyStated hovering;
  hovering.position = reference.position;
  plant.reset(hovering, control.command());
  actuators.reset(control.command(), 0.0);

  StressRecord record;
  record.lowest = reference.position.z();
  record.recovery_time = not_yet;
  const long before = std::lround(settle / settings.period),
             ticks = before + std::lround(duration / settings.period);
  const long sample_every = std::max(1L, std::lround(0.1 / settings.period));
  bool touched = false, sound = true;
  for (long i = 0; i < ticks && sound && !touched; ++i) {
    if (i == before) {
      PlantState<Rotors> x = plant.state();
      const Eigen::Vector3d moved = x.body.position - reference.position;
      x.body = start.body;
      x.body.position += moved;
      plant.reset(x);
      reference = start.reference;
    }
    const double time = static_cast<double>(i) * settings.period;
    const ActuatorState<Rotors> modelled = actuators.update(time, control.command());
    (void)observer.update(time, plant.inertial_sample(),
                          control.wrench({plant.actuators().rotor_speed, modelled.tilt_angle}));
    if (i == before) observer.reset();  // the vehicle has been moved
    const double began = thread_microseconds();
    control.prepare(time, reference, observer.external());
    const double prepared = thread_microseconds();
    audit.before(control.solver());
    const double measured = thread_microseconds();
    const auto& result = control.feedback(time, plant.body(), modelled);
    (i < before ? record.hover_us : record.tick_us)
        .push_back(thread_microseconds() - measured + prepared - began);
    if (result.status == NmpcStatus::solved) {
      const double residual = audit.after(control.solver());
      record.worst_solved = std::max(record.worst_solved, residual);
      // Factor 2: the units of the solver differ slightly from those of the audit.
      if (!(residual <= 2.0 * settings.solver.program.tolerance)) ++record.unsolved_called_solved;
    } else if (result.status == NmpcStatus::approximate) {
      ++record.approximate;
    } else {
      ++record.failures;
    }
    if (i >= before) record.solver.add(result.status, result.report);
    record.most_passes = std::max(record.most_passes, result.report.passes);
    record.most_rounds = std::max(record.most_rounds, result.report.rounds);
    record.most_evaluations = std::max(record.most_evaluations, result.report.evaluations);
    record.worst_bound_ratio = std::max(record.worst_bound_ratio, control.largest_bound_ratio());
    control.command_result(time);
    actuators.update(time, control.command());
    for (int j = 0; j < steps && sound; ++j) {
      sound = plant.step(control.command(), {}, dt);
      touched = touched || plant.normal_forces().sum() > 0.0;
    }
    if (i < before) continue;
    StressSample s;
    s.time = static_cast<double>(i + 1 - before) * settings.period;
    s.distance = (plant.body().position - reference.position).norm();
    s.angle = plant.body().orientation.angularDistance(reference.orientation);
    s.speed = plant.body().velocity.norm();
    s.height = plant.body().position.z();
    record.lowest = std::min(record.lowest, s.height);
    const bool there = s.distance < 0.1 && s.angle < 0.1 && s.speed < 0.2;
    if (!there) record.recovery_time = not_yet;
    if (there && record.recovery_time == not_yet) record.recovery_time = s.time;
    if ((i + 1 - before) % sample_every == 0) record.samples.push_back(s);
  }
  record.recovered = sound && !touched && record.recovery_time != not_yet;
  return record;
}

/// At the wrench level.
template <int Rotors>
[[nodiscard]] StressRecord fly_stress(const tilt_ropter::Vehicle<Rotors>& vehicle,
                                      const tilt_ropter::NmpcSettings& settings,
                                      const StressStart& start, double duration) {
  return fly_stress<WrenchLevel>(vehicle, settings, start, duration);
}

}  // namespace examples
