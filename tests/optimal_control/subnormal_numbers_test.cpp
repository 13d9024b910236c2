// After no flight does a buffer of the solver contain a subnormal number: arithmetic with these
// takes many times as long on most processors, so an iteration would take longer for no reason.
// CTest: alone optimised

#include "benchmark/scenarios.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>

#if defined(__GLIBC__) && defined(__SSE2__) && !defined(__SANITIZE_ADDRESS__) && \
    !defined(__SANITIZE_THREAD__)
#if !defined(__has_feature)
#define TILT_ROPTER_TEST_RECORDS_HEAP
#elif !__has_feature(address_sanitizer) && !__has_feature(thread_sanitizer) && \
    !__has_feature(memory_sanitizer)
#define TILT_ROPTER_TEST_RECORDS_HEAP
#endif
#endif

namespace {

using benchmarks::Scenario;
using benchmarks::Solver;
using tilt_ropter::Stated;
using tilt_ropter::WheeledFlightProblem;

struct Block {
  const unsigned char* begin;
  std::size_t size;
};
std::array<Block, 4096> blocks;  // memory that was allocated while `records` was true
std::size_t block_count = 0;
bool records = false;

[[maybe_unused]] void* recorded(void* memory, std::size_t size) {
  if (!records || memory == nullptr || block_count == blocks.size()) return memory;
  blocks[block_count++] = {static_cast<unsigned char*>(std::memset(memory, 0, size)), size};
  return memory;
}

// Blocks also contain flags, indices and addresses. The largest numbers with exponent zero look
// like none of them: addresses have 48 bits, flags and states are bytes from -2 to 2, an index is
// small and has an index or padding beside it.
bool is_subnormal(std::uint64_t word) {
  word &= ~(std::uint64_t{1} << 63);
  if (word < std::uint64_t{1} << 48 || word >= std::uint64_t{1} << 52) return false;
  if ((word & 0xFFFF'FFFF) < 0x10000) return false;
  std::array<signed char, 8> bytes{};
  std::memcpy(bytes.data(), &word, 8);
  return std::any_of(bytes.begin(), bytes.end(), [](int byte) { return byte < -2 || byte > 2; });
}

[[maybe_unused]] int subnormal_numbers() {
  int count = 0;
  for (std::size_t b = 0; b < block_count; ++b)
    for (std::size_t i = 0; i + 8 <= blocks[b].size; i += 8) {
      std::uint64_t word = 0;
      std::memcpy(&word, blocks[b].begin + i, 8);
      count += is_subnormal(word);
    }
  return count;
}

/// Solver whose buffers are recorded.
struct RecordedSolver {
  explicit RecordedSolver(const WheeledFlightProblem<0>& problem)
      : records_((block_count = 0, records = true)), solver(problem, settings()) {
    records = false;
  }
  static tilt_ropter::optimal_control::SolverSettings settings() {
    tilt_ropter::optimal_control::SolverSettings s;
    s.update_multipliers = false;
    return s;
  }
  bool records_;
  Solver solver;
};

/// Returns the number of subnormal numbers in the buffers, summed over all ticks. `ticks` of 20 ms.
template <typename Control>
int fly(const Scenario& scenario, int ticks, const Control& control) {
  RecordedSolver recorded(scenario.problem);
  Solver& solver = recorded.solver;
  const tilt_ropter::RigidBodyd plant(test_support::benchmark_body());
  Stated x = scenario.start;
  solver.reset(x);
  int count = 0;
  for (int tick = 0; tick < ticks; ++tick) {
    scenario.set_reference(solver.problem(), 0.02 * tick);
    control(solver, x);
    EXPECT_TRUE(has_plan(solver.report().status));
    count += subnormal_numbers();
    for (int i = 0; i < 4; ++i) x = plant.step(x, solver.input(0), scenario.plant_wrench, 0.02 / 4);
    solver.shift(0.2);
  }
  return count;
}

[[maybe_unused]] void iterate(Solver& solver, const Stated& x) {
  (void)solver.prepare();
  (void)solver.feedback(x);
}
[[maybe_unused]] void converge(Solver& solver, const Stated& x) {
  (void)solver.solve(x);
}

TEST(SubnormalNumbers, ScanFindsThemAmongFlagsIndicesAndAddresses) {
  const auto words = [](double number) {
    std::uint64_t word = 0;
    std::memcpy(&word, &number, 8);
    return word;
  };
  EXPECT_TRUE(is_subnormal(words(1.234e-308)));
  EXPECT_TRUE(is_subnormal(words(-1.234e-308)));
  EXPECT_FALSE(is_subnormal(words(2.3e-308)));
  EXPECT_FALSE(is_subnormal(words(0.0)));
  EXPECT_FALSE(is_subnormal(0x0001'0100'0001'0101));
  EXPECT_FALSE(is_subnormal(0x0001'FFFF'0200'FE01));
  EXPECT_FALSE(is_subnormal(0x0000'7FFF'FFFF'1234));
  EXPECT_FALSE(is_subnormal(0x0003'5A5A'0000'0017));
}

#ifdef TILT_ROPTER_TEST_RECORDS_HEAP

TEST(SubnormalNumbers, NoneInFlightsOfTheBenchmark) {
  EXPECT_EQ(fly(benchmarks::air(), 500, iterate), 0);
  EXPECT_EQ(fly(benchmarks::ground(), 500, converge), 0);
  EXPECT_GT(block_count, 50U);
}

TEST(SubnormalNumbers, NoneAfterStep) {
  RecordedSolver recorded(test_support::step_problem());
  Solver& solver = recorded.solver;
  solver.reset(test_support::step_start());
  converge(solver, test_support::step_start());
  EXPECT_EQ(subnormal_numbers(), 0);
}

// Without noise, all deviations from the plan decay until they are zero.
TEST(SubnormalNumbers, NoneInThreeMinutesOfHoverWithoutNoise) {
  Scenario hover = benchmarks::air(20, tilt_ropter::NmpcBounds{});
  hover.set_reference = [](WheeledFlightProblem<0>& problem, double) {
    for (int k = 0; k <= problem.horizon(); ++k)
      problem.node(k).wrench_reference.force = test_support::benchmark_hover_force();
  };
  hover.start = {};
  hover.start.body.position << 0.3, 0.2, 0.1;
  hover.start.wrench.force = test_support::benchmark_hover_force();
  hover.plant_wrench = {};
  EXPECT_EQ(fly(hover, 9000, iterate), 0);
}

#endif

}  // namespace

#ifdef TILT_ROPTER_TEST_RECORDS_HEAP
extern "C" {
// NOLINTBEGIN(bugprone-reserved-identifier): the names that glibc gives its own functions.
void* __libc_malloc(std::size_t size);
void* __libc_memalign(std::size_t alignment, std::size_t size);
// NOLINTEND(bugprone-reserved-identifier)

void* malloc(std::size_t size) noexcept {
  return recorded(__libc_malloc(size), size);
}
void* aligned_alloc(std::size_t alignment, std::size_t size) noexcept {
  return recorded(__libc_memalign(alignment, size), size);
}
}
#endif
