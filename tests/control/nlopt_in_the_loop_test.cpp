// NLopt solves the quadratic program of every tick that has 1 to n active constraints: counted
// where NLopt is called.
// CTest: alone flight optimised

#include "../../examples/support/stress_flight.hpp"
#include "support/control_loop.hpp"
#include "support/full_run.hpp"

#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/planning/mission.hpp>

#include <gtest/gtest.h>

#include <dlfcn.h>
#include <nlopt.h>

#include <algorithm>
#include <cstdint>
#include <vector>

namespace {

int calls = 0;
bool moved = false;  // a call changed a multiplier

}  // namespace

// Stands before the function of the shared library.
extern "C" nlopt_result nlopt_optimize(nlopt_opt optimizer, double* x, double* value) {
  using Function = nlopt_result (*)(nlopt_opt, double*, double*);
  static const auto real = reinterpret_cast<Function>(dlsym(RTLD_NEXT, "nlopt_optimize"));
  const std::vector<double> before(x, x + nlopt_get_dimension(optimizer));
  const nlopt_result result = real(optimizer, x, value);
  ++calls;
  moved = moved || !std::equal(before.begin(), before.end(), x);
  return result;
}

namespace tilt_ropter {
namespace {

using optimal_control::ProgramSolver;

/// Counts ticks by what NLopt did in them.
class Ticks {
 public:
  explicit Ticks(const NmpcSettings& settings)
      : most_(settings.solver.program.max_dual_constraints) {}

  template <typename Tick>
  void run(const Tick& tick) {
    calls = 0;
    moved = false;
    const NmpcResult& result = tick();
    const optimal_control::SolveReport& report = result.report;
    EXPECT_EQ(report.evaluations > 0, calls > 0);
    if (!has_plan(result.status)) return;
    if (report.active_constraints == 0) {  // and none was in the last tick, or NLopt found out
      EXPECT_EQ(report.solved_by, calls > 0 ? ProgramSolver::nlopt : ProgramSolver::riccati);
      return;
    }
    if (report.active_constraints > most_ || result.status != NmpcStatus::solved) return;
    ++few_;
    called_ += calls > 0;
    moved_ += moved;
    by_nlopt_ += report.solved_by == ProgramSolver::nlopt;
    polishing_.push_back(report.polishing_steps);
  }

  void expect_nlopt_solves(int least_ticks) {
    RecordProperty("ticks", few_);
    EXPECT_GE(few_, least_ticks);
    EXPECT_EQ(called_, few_);
    EXPECT_EQ(by_nlopt_, few_);
    EXPECT_GE(moved_, 0.95 * few_);
    ASSERT_FALSE(polishing_.empty());
    std::nth_element(polishing_.begin(), polishing_.begin() + few_ / 2, polishing_.end());
    EXPECT_LE(polishing_[static_cast<std::size_t>(few_ / 2)], 1);
  }

 private:
  static void RecordProperty(const char* name, int value) {
    testing::Test::RecordProperty(name, value);
  }
  int most_, few_ = 0, called_ = 0, moved_ = 0, by_nlopt_ = 0;
  std::vector<int> polishing_;
};

TEST(NloptInTheLoop, SolvesInTheMissionWithThePapersSettings) {
  const NmpcSettings settings = paper_nmpc_settings();
  test_support::ControlLoop<Plant<4>> loop(1, settings);
  const Mission mission = hybrid_mission(tilt_ropter_vehicle());
  const auto reference = [&](double t) { return mission(t); };
  Ticks ticks(settings);
  loop.start(0.0, Eigen::Vector3d::Zero(), 0.0);
  const double end = test_support::full_run() ? mission.duration() : 25.0;
  while (loop.plant().time() < end)
    ticks.run([&]() -> const NmpcResult& { return loop.tick(reference); });
  ticks.expect_nlopt_solves(50);
}

TEST(NloptInTheLoop, SolvesInStepsOfThreeMetres) {
  const NmpcSettings settings;
  test_support::ControlLoop<Plant<4>> loop(1, settings);
  Ticks ticks(settings);
  loop.start(2.0, Eigen::Vector3d::Zero(), 0.0);
  const auto reference = [&](double t) {
    ReferencePoint point;
    point.position << (static_cast<int>(t / 3.0) % 2 == 0 ? 0.0 : 3.0), 0.0, 2.0;
    return point;
  };
  for (int i = 0; i < 1200; ++i)
    ticks.run([&]() -> const NmpcResult& {
      const double now = loop.plant().time();
      return loop.tick([&](double) { return reference(now); });
    });
  ticks.expect_nlopt_solves(300);
}

TEST(NloptInTheLoop, SolvesAfterLargeDisturbances) {
  const NmpcSettings settings;
  Ticks ticks(settings);
  // In flight 29, the other methods reach the limit of passes before few constraints are left.
  const std::uint64_t first = test_support::full_run() ? 0 : 26, end = first == 0 ? 40 : 30;
  for (std::uint64_t flight = first; flight < end; ++flight) {
    const examples::StressStart start =
        examples::stress_start(examples::Scenario::random, 1.0, 20.0, 3, flight);
    test_support::ControlLoop<Plant<4>> loop(1, settings);
    loop.start(20.0, start.body.velocity, 0.0);
    loop.put(start.body);
    for (int i = 0; i < 400; ++i)
      ticks.run([&]() -> const NmpcResult& {
        return loop.tick([&](double) { return start.reference; });
      });
  }
  ticks.expect_nlopt_solves(100);
}

}  // namespace
}  // namespace tilt_ropter
