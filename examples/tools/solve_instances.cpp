// Solves instances of the benchmark's optimal-control problem from a CSV file, each with a cold
// start, and writes the results. Use it to compare this solver with another solver or an earlier
// version.
//
// Input: a header line, then one instance per line (see support/instances.hpp):
//   id                       any text without a comma
//   bounds                   paper or wide
//   Fe_x Fe_y Fe_z           external force that the controller knows, body frame [N]
//   Me_x Me_y Me_z           external torque that the controller knows, body frame [N m]
//   F_x ... M_z              initial state: force [N] and torque [N m] of the rotors, body frame,
//   p_x ... v_z              position [m] and velocity [m/s], world frame,
//   q_w q_x q_y q_z          orientation, body to world; normalised when read,
//   w_x w_y w_z              angular velocity, body frame [rad/s]
//   ref_p_x ... ref_q_z      reference, constant over the horizon: position, velocity, orientation
// Output: a header line, then one line for each valid instance:
//   id, status               converged, iteration_limit, time_limit, stalled, failed or rejected
//   cost                     of the plan
//   u0_1 ... u0_6            its first input: dF [N/s], then dM [N m/s]
//   iterations, kkt          iterations and KKT residual that the solver reports
//   max_violation            largest violation of the bounds, recomputed without the solver
//   max_defect               largest continuity defect, recomputed without the solver
//   median_us                median wall time of a solve [us]
// On standard error: a summary with the number of converged instances, the difference between the
// report of the solver and the recomputation, and the number of plans worse than the initial guess.

#include "../support/instances.hpp"
#include "../support/statistics.hpp"

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <unistd.h>
#include <CLI/CLI.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <exception>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <map>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

using namespace tilt_ropter;

namespace {

using Clock = std::chrono::steady_clock;
using Solver = optimal_control::MultipleShooting<WheeledFlightProblem<0>>;

struct Options {
  std::string input, output;
  double tolerance = 1e-6;
  int repeat = 1, max_iterations = optimal_control::SolverSettings{}.max_iterations;
  int generate = 0;
  std::uint64_t seed = 1;
  bool histogram = false;
};

constexpr const char* help_footer = R"(
Input columns (the header line is required):
  id,bounds(paper|wide), external wrench Fe_x..Fe_z [N], Me_x..Me_z [N m] (body frame),
  initial state F_x..F_z [N], M_x..M_z [N m] (body frame), p_x..p_z [m], v_x..v_z [m/s] (world),
  q_w,q_x,q_y,q_z (body to world), w_x..w_z [rad/s] (body), and the constant reference
  ref_p_x..ref_p_z, ref_v_x..ref_v_z, ref_q_w,ref_q_x,ref_q_y,ref_q_z. In full:
)";

constexpr const char* help_footer_end = R"(
Output columns:
  id,status,cost,u0_1..u0_6 (dF [N/s], dM [N m/s]),iterations,kkt,max_violation,max_defect,median_us

On standard error: a summary. It has the largest differences of violation and defect between the
solver's report and a recomputation without the solver. It also names the plans whose merit, cost +
1e4 (1-norm of defects + 1-norm of violations), is higher than that of their initial guess.

Exit code: 0 all lines are valid, 1 some lines are invalid (see standard error; the other lines are
solved), 2 a file could not be read or written, above 100 wrong options.)";

constexpr double mass = 1.5;  // [kg]

WheeledFlightProblem<0> benchmark_problem(examples::InstanceBounds bounds) {
  RigidBodyParameters body;
  body.mass = mass;
  body.inertia = Eigen::Vector3d(0.0137, 0.0143, 0.0246).asDiagonal();
  WheeledFlightSettings settings;  // N and wide bounds of the benchmark are the defaults
  settings.weights.position << 60.0, 60.0, 80.0;
  settings.weights.velocity << 6.0, 6.0, 8.0;
  settings.weights.angular_velocity.setConstant(0.6);
  if (bounds == examples::InstanceBounds::paper) settings.bounds = paper_bounds();
  return WheeledFlightProblem<0>(body, settings);
}

/// Largest of the added numbers; NaN if one of them is NaN.
struct Largest {
  double value = 0.0;
  void add(double x) {
    if (!std::isnan(value) && !(x <= value)) value = x;
  }
};

/// Cost, defects and violations of a plan, computed only with the functions of the problem.
struct Audit {
  double cost = 0.0;
  Largest defect, violation;
  double norm = 0.0;  // sum of the 1-norms of defects and violations

  Audit(const Solver& solver, const Stated& start) {
    const WheeledFlightProblem<0>& problem = solver.problem();
    const auto add_defect = [this](const StateTangentd& gap) {
      for (Eigen::Index i = 0; i < gap.size(); ++i) defect.add(std::abs(gap(i)));
      norm += gap.lpNorm<1>();
    };
    add_defect(problem.difference(solver.state(0), start));
    for (int k = 0; k <= problem.horizon(); ++k) {
      const Stated& x = solver.state(k);
      const auto& u = solver.input(k);
      cost += problem.cost(k, x, u);
      if (k < problem.horizon())
        add_defect(problem.difference(problem.step(k, x, u), solver.state(k + 1)));
      const auto rows = problem.constraint_values(k, x, u);
      for (Eigen::Index i = 0; i < rows.size(); ++i) {
        const double over = rows(i) - problem.upper(k)(i), under = problem.lower(k)(i) - rows(i);
        violation.add(over);
        violation.add(under);
        norm += std::max({0.0, over, under});
      }
    }
  }

  [[nodiscard]] double merit() const { return cost + 1e4 * norm; }
};

/// Statistics of all instances.
class Summary {
 public:
  void add(const std::string& id, const optimal_control::SolveReport& report, const Audit& audit,
           const Audit& guess, double time_us) {
    ++statuses_[to_string(report.status)];
    if (report.status == optimal_control::SolveStatus::converged) ++histogram_[report.iterations];
    iterations_.push_back(report.iterations);
    times_us_.push_back(time_us);
    if (report.status != optimal_control::SolveStatus::failed) {  // a failed report has no numbers
      violation_.add(std::abs(report.max_violation - audit.violation.value));
      defect_.add(std::abs(report.max_defect - audit.defect.value));
    }
    if (std::isfinite(guess.merit()) && !(audit.merit() <= guess.merit())) worse_.push_back(id);
  }

  void print(std::ostream& out) const {
    const std::size_t total = iterations_.size();
    const auto found = statuses_.find("converged");
    const int converged = found == statuses_.end() ? 0 : found->second;
    out << "instances: " << total << '\n';
    if (total == 0) return;
    out << "converged: " << converged << " (" << std::fixed << std::setprecision(2)
        << 100.0 * converged / static_cast<double>(total) << " %)\n";
    for (const auto& [status, count] : statuses_)
      if (status != "converged") out << status << ": " << count << '\n';
    print_quantiles(out, "iterations", iterations_);
    print_quantiles(out, "time [us]", times_us_);
    out << std::defaultfloat << std::setprecision(3)
        << "violation, report against recomputation: " << violation_.value << '\n'
        << "defect, report against recomputation: " << defect_.value << '\n'
        << "worse than the guess: " << worse_.size() << '\n';
    for (const std::string& id : worse_) out << "  " << id << '\n';
  }

  void print_histogram(std::ostream& out) const {
    int most = 1;
    for (const auto& [iterations, count] : histogram_) most = std::max(most, count);
    out << "iterations  instances that converged\n";
    for (const auto& [iterations, count] : histogram_) {
      const auto length = static_cast<std::size_t>((60L * count + most - 1) / most);
      out << std::setw(10) << iterations << std::setw(8) << count << "  "
          << std::string(length, '#') << '\n';
    }
  }

 private:
  static void print_quantiles(std::ostream& out, const char* name,
                              const std::vector<double>& values) {
    out << std::fixed << std::setprecision(0) << name << ": median "
        << examples::percentile(values, 0.5) << ", 90 % " << examples::percentile(values, 0.9)
        << ", 99 % " << examples::percentile(values, 0.99) << ", most "
        << examples::percentile(values, 1.0) << '\n';
  }

  std::map<std::string, int> statuses_;
  std::map<int, int> histogram_;
  std::vector<double> iterations_, times_us_;
  Largest violation_, defect_;
  std::vector<std::string> worse_;
};

class Batch {
 public:
  explicit Batch(const Options& options)
      : repeat_(options.repeat),
        paper_(benchmark_problem(examples::InstanceBounds::paper), settings(options)),
        wide_(benchmark_problem(examples::InstanceBounds::wide), settings(options)) {}

  [[nodiscard]] static std::string header() {
    std::string line = "id,status,cost";
    for (int i = 1; i <= 6; ++i) line += ",u0_" + std::to_string(i);
    return line + ",iterations,kkt,max_violation,max_defect,median_us";
  }

  /// Solves an instance. Returns the output line without line end.
  [[nodiscard]] std::string solve(const examples::Instance& instance) {
    using examples::to_csv;
    Solver& solver = instance.bounds == examples::InstanceBounds::paper ? paper_ : wide_;
    for (int k = 0; k <= solver.horizon(); ++k) {
      WheeledFlightNode& node = solver.problem().node(k);
      node.reference = instance.reference;
      node.wrench_reference.force << 0.0, 0.0, mass * gravity;
      node.external = instance.external;
    }
    if (!warm_) run(solver, instance.start);  // loads memory pages, outside the measured times
    warm_ = true;
    solver.reset(instance.start);
    const Audit guess(solver, instance.start);
    std::vector<double> times_us;
    times_us.reserve(static_cast<std::size_t>(repeat_));
    for (int i = 0; i < repeat_; ++i) times_us.push_back(run(solver, instance.start));
    const double median_us = std::round(10.0 * examples::percentile(times_us, 0.5)) / 10.0;
    const optimal_control::SolveReport& report = solver.report();
    const Audit audit(solver, instance.start);
    summary_.add(instance.id, report, audit, guess, median_us);

    std::string line = instance.id + ',' + to_string(report.status) + ',' + to_csv(audit.cost);
    for (Eigen::Index i = 0; i < 6; ++i) line += ',' + to_csv(solver.input(0)(i));
    line += ',' + std::to_string(report.iterations) + ',' + to_csv(report.kkt);
    line += ',' + to_csv(audit.violation.value) + ',' + to_csv(audit.defect.value);
    return line + ',' + to_csv(median_us);
  }

  [[nodiscard]] const Summary& summary() const { return summary_; }

 private:
  static optimal_control::SolverSettings settings(const Options& options) {
    optimal_control::SolverSettings s;
    s.tolerance = options.tolerance;
    s.max_iterations = options.max_iterations;
    s.max_time = 60.0;  // [s], never reached: results do not depend on the speed
    return s;
  }

  /// Wall time of a cold solve [us].
  static double run(Solver& solver, const Stated& start) {
    const auto begin = Clock::now();
    solver.reset(start);
    (void)solver.solve(start);
    return std::chrono::duration<double, std::micro>(Clock::now() - begin).count();
  }

  int repeat_;
  bool warm_ = false;
  Solver paper_, wide_;
  Summary summary_;
};

/// Generates random instances with wide bounds and the reference (0, 0, 1.5) m at rest. Deviations
/// are uniform in balls of 2 m, 2 m/s and 3 rad/s; the rotation is up to 150 degrees about any
/// axis.
class Generator {
 public:
  explicit Generator(std::uint64_t seed) : engine_(seed) {}

  examples::Instance operator()(int number) {
    examples::Instance instance;
    instance.id = std::to_string(number);
    instance.reference.position << 0.0, 0.0, 1.5;
    Stated& x = instance.start;
    x.wrench.force << 0.0, 0.0, mass * gravity;
    x.body.position = instance.reference.position + in_ball(2.0);
    x.body.velocity = in_ball(2.0);
    const Eigen::Vector3d axis = in_ball(1.0).normalized();
    x.body.orientation = quaternion_exp(uniform(0.0, 150.0 * pi / 180.0) * axis);
    x.body.angular_velocity = in_ball(3.0);
    return instance;
  }

 private:
  double uniform(double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(engine_);
  }
  Eigen::Vector3d in_ball(double radius) {
    for (;;) {
      const double x = uniform(-1.0, 1.0), y = uniform(-1.0, 1.0), z = uniform(-1.0, 1.0);
      const Eigen::Vector3d point(x, y, z);
      if (point.squaredNorm() <= 1.0 && point.squaredNorm() > 1e-6) return radius * point;
    }
  }

  std::mt19937_64 engine_;
};

/// Shows the progress, only on a terminal and only if a run takes longer than 0.5 s.
class Progress {
 public:
  explicit Progress(std::size_t total) : total_(total) {}
  ~Progress() {
    if (shown_) std::cerr << '\r' << std::string(50, ' ') << '\r' << std::flush;
  }
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  void show(std::size_t done) {
    const auto now = Clock::now();
    if (!terminal_ || now - last_ < std::chrono::milliseconds(500)) return;
    last_ = now;
    const std::chrono::duration<double> elapsed = now - start_;
    const double left = elapsed.count() * static_cast<double>(total_ - done) /
                        static_cast<double>(std::max<std::size_t>(done, 1));
    std::cerr << '\r' << done << " of " << total_ << " solved, " << std::lround(left)
              << " s to go        " << std::flush;
    shown_ = true;
  }

 private:
  std::size_t total_;
  bool terminal_ = isatty(STDERR_FILENO) != 0, shown_ = false;
  Clock::time_point start_ = Clock::now(), last_ = start_;
};

examples::InstanceFile read(const std::string& path) {
  if (path == "-") return examples::read_instances(std::cin);
  std::ifstream in(path, std::ios::binary);
  if (!in) throw std::runtime_error("cannot read " + path);
  examples::InstanceFile file = examples::read_instances(in);
  if (in.bad()) throw std::runtime_error("cannot read " + path);
  return file;
}

int run(const Options& options) {
  examples::InstanceFile instances;
  if (options.generate == 0) {
    instances = read(options.input);
    for (const examples::InstanceError& error : instances.errors)
      std::cerr << options.input << ':' << error.line << ':' << error.column
                << ": error: " << error.message << '\n';
  }
  const std::string output_name = options.output.empty() ? "standard output" : options.output;
  std::ofstream file;
  if (!options.output.empty()) file.open(options.output, std::ios::binary);
  std::ostream& out = options.output.empty() ? std::cout : file;
  const auto check_output = [&] {
    if (!out) throw std::runtime_error("cannot write " + output_name);
  };
  check_output();

  if (options.generate > 0) {
    Generator generator(options.seed);
    out << examples::instance_header() << '\n';
    for (int i = 1; i <= options.generate; ++i) out << to_csv(generator(i)) << '\n';
  } else {
    Batch batch(options);
    out << Batch::header() << '\n';
    {
      Progress progress(instances.instances.size());
      for (std::size_t i = 0; i < instances.instances.size(); ++i) {
        progress.show(i);
        out << batch.solve(instances.instances[i]) << '\n';
        check_output();
      }
    }
    if (options.histogram) batch.summary().print_histogram(std::cerr);
    batch.summary().print(std::cerr);
  }
  out.flush();
  check_output();
  return instances.errors.empty() ? 0 : 1;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Solves instances of the benchmark's optimal-control problem, each with a cold start (all "
      "states "
      "equal to the initial state, all inputs zero), and writes one line for each."};
  Options options;
  CLI::Option* input =
      app.add_option("input", options.input, "CSV file of instances, - for standard input");
  app.add_option(
         "--generate", options.generate,
         "instead of solving, write this number of random instances with wide bounds, within 2 m, "
         "2 m/s, 150 degrees and 3 rad/s of the reference")
      ->check(CLI::Range(1, 100000000))
      ->excludes(input);
  app.add_option("-o,--output", options.output, "output file; default: standard output");
  app.add_option("--tolerance", options.tolerance, "tolerance of the KKT residual")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  app.add_option("--max-iterations", options.max_iterations,
                 "largest number of iterations of a solve")
      ->check(CLI::Range(1, 1000000))
      ->capture_default_str();
  app.add_option("--repeat", options.repeat,
                 "number of solves per instance; the median time is written")
      ->check(CLI::Range(1, 1000000))
      ->capture_default_str();
  app.add_option("--seed", options.seed, "random seed of --generate")->capture_default_str();
  app.add_flag("--histogram", options.histogram,
               "print a histogram of the iterations of converged instances to standard error");
  app.footer(help_footer + examples::instance_header() + '\n' + help_footer_end);
  CLI11_PARSE(app, argc, argv);
  if (options.input.empty() && options.generate == 0)
    return app.exit(CLI::RequiredError("input or --generate"));
  try {
    return run(options);
  } catch (const std::exception& error) {
    std::cerr << "solve_instances: " << error.what() << '\n';
    return 2;
  }
}
