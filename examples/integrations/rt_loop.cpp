// A real-time loop: hovers at a fixed rate with real-time scheduling and reports the latencies.

#include "../support/control_level.hpp"
#include "../support/level_nmpc.hpp"
#include "../support/run_program.hpp"
#include "../support/solver_choice.hpp"
#include "../support/vehicle_check.hpp"
#include "latencies.hpp"
#include "real_time.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cmath>
#include <csignal>
#include <cstddef>
#include <cstdint>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <stdexcept>
#include <string>
#include <variant>

using namespace tilt_ropter;

namespace {

struct Options {
  double rate = 100.0, seconds = 10.0;
  int priority = 80, processor = -1;
  std::string vehicle, level, csv, solver = "automatic";
};

volatile std::sig_atomic_t interrupted = 0;

void write_csv(const std::string& path, const loops::Latencies& wake_up,
               const loops::Latencies& computing) {
  std::ofstream file(path);
  file << "wake_up_us,computing_us\n" << std::fixed << std::setprecision(3);
  for (std::size_t i = 0; i < wake_up.values().size(); ++i)
    file << wake_up.values()[i] << ',' << computing.values()[i] << '\n';
  file.close();
  if (!file) throw std::runtime_error("cannot write " + path);
}

template <int Rotors>
void run(const Options& options, const examples::VehicleFile& file,
         const Vehicle<Rotors>& vehicle) {
  ActuatorModel<Rotors> actuators(vehicle);
  WrenchObserverd observer(vehicle.body);
  ContactEstimator contact(vehicle);
  auto nmpc = examples::at_level(options.level, file, vehicle, [&](auto settings) {
    examples::set_solver(options.solver, settings.solver);
    return examples::LevelNmpc<Rotors>(vehicle, settings);
  });
  examples::SolverTicks solver;
  Plant<Rotors> robot(vehicle);  // your robot goes here
  const auto reference = [](double) {
    ReferencePoint point;
    point.position << 0.0, 0.0, 1.5;
    return point;
  };
  const std::int64_t period = std::llround(1e9 / options.rate);
  const std::int64_t periods = std::llround(options.seconds * options.rate);
  const double dt = 1e-9 * static_cast<double>(period);
  loops::Latencies wake_up(static_cast<std::size_t>(periods)),
      computing(static_cast<std::size_t>(periods));
  // NLopt allocates memory in the first ticks; later ticks should cause no page faults.
  constexpr std::size_t first_ticks = 10;
  std::int64_t skipped = 0, missed = 0, faults = 0;
  ActuatorState<Rotors> command;
  if (!undercarriage(vehicle)) {  // no undercarriage: starts in the air
    nmpc.start_with_lift(vehicle.body.mass * gravity);
    command = nmpc.command();
    BodyStated hovering;
    hovering.position = reference(0.0).position;
    robot.reset(hovering, command);
    actuators.reset(command, 0.0);
  }
  loops::ask_for_real_time(options.priority, options.processor, std::cout);

  const std::int64_t start = loops::now_ns() + period;
  for (std::int64_t k = 0; k < periods;) {
    const std::int64_t due = start + k * period;
    while (!loops::sleep_until(due) && interrupted == 0) continue;
    if (interrupted != 0) break;
    const std::int64_t woken = loops::now_ns();

    const double time = robot.time();
    const ActuatorState<Rotors> applied =
        actuators.update(time, command, robot.actuators().rotor_speed);
    const ObservedWrenchd& observed =
        observer.update(time, robot.inertial_sample(), nmpc.wrench_of(applied));
    nmpc.prepare(time, reference, contact.update(time, robot.body(), observed));
    command = nmpc.control(time, robot.body(), applied);
    solver.add(nmpc.status(), nmpc.report());
    actuators.update(time, command);  // the command acts from now on

    const std::int64_t done = loops::now_ns();
    if (wake_up.values().size() == first_ticks) faults = loops::page_faults();
    wake_up.add(1e-3 * static_cast<double>(woken - due));
    computing.add(1e-3 * static_cast<double>(done - woken));
    // The rest of the period is for the simulated robot. A tick is skipped if its whole period has
    // passed; the robot then continues with the last command.
    const std::int64_t next = std::min(periods, std::max(k + 1, (done - start) / period));
    if (done > due + period) ++missed;
    skipped += next - (k + 1);
    missed += next - (k + 1);
    for (; k < next; ++k)
      if (!robot.step(actuators.to_send(command), {}, dt))
        throw std::runtime_error("the plant rejected a step");
  }

  const std::int64_t page_faults_at_end = loops::page_faults();
  std::cout << "ticks: " << wake_up.values().size() << "\nskipped_ticks: " << skipped
            << "\nmissed_deadlines: " << missed << '\n';
  if (wake_up.values().size() > first_ticks)
    std::cout << "page_faults_after_tick_" << first_ticks << ": " << page_faults_at_end - faults
              << '\n';
  solver.print(std::cout);
  wake_up.print(std::cout, "wake_up");
  computing.print(std::cout, "computing");
  print_histograms(std::cout, "wake_up", wake_up, "computing", computing);
  std::cout << std::setprecision(4)
            << "position_error_m: " << (robot.body().position - reference(0.0).position).norm()
            << '\n';
  if (!options.csv.empty()) write_csv(options.csv, wake_up, computing);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Hovers with a simulated vehicle at a fixed rate in real time: SCHED_FIFO, locked memory,\n"
      "absolute deadlines. Prints wake-up latencies and computing times. Real-time requests may\n"
      "need permissions (CAP_SYS_NICE, CAP_IPC_LOCK, or the limits rtprio and memlock). If the "
      "system\n"
      "refuses a request, the program prints this and continues."};
  Options options;
  app.add_option("--vehicle", options.vehicle,
                 "JSON file of the vehicle (2 to 8 rotors); default: the Tilt-Ropter");
  examples::add_level(app, options.level);
  examples::add_solver_in_real_time(app, options.solver);
  app.add_option("--rate", options.rate, "rate of the controller [Hz]")
      ->check(CLI::Range(20.0, 1000.0))
      ->capture_default_str();
  app.add_option("--seconds", options.seconds, "duration [s]")
      ->check(CLI::Range(0.1, 3600.0))
      ->capture_default_str();
  app.add_option("--priority", options.priority,
                 "priority of SCHED_FIFO; 0: no real-time scheduling")
      ->check(CLI::Range(0, 99))
      ->capture_default_str();
  app.add_option("--processor", options.processor, "processor to run on, from 0; default: any")
      ->check(CLI::Range(0, 1023));
  app.add_option("--csv", options.csv,
                 "output file with wake-up latency and computing time of each tick");
  return examples::run_program(app, "rt_loop", argc, argv, [&options] {
    for (const int number : {SIGINT, SIGTERM}) std::signal(number, [](int) { interrupted = 1; });
    const examples::VehicleFile file = examples::vehicle_to_fly(options.vehicle);
    std::visit([&](const auto& vehicle) { run(options, file, vehicle); }, file.vehicle);
    return 0;
  });
}
