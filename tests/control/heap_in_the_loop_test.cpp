// After construction and a few ticks no function of the control loop touches the heap, and what
// NLopt takes there stays within what DualSolver's documentation says.

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include "support/allocation_counter.hpp"
#include "support/benchmark_problem.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/quadrotor.hpp"
#include "support/random.hpp"
#include "support/simulated_time.hpp"
#include "support/states.hpp"
#include "support/vehicles.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <set>
#include <sstream>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace {

using test_support::heap_use;
using test_support::HeapUse;
using test_support::HeapUser;
using test_support::nlopt_calls;
using test_support::Random;

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr int warm_up = 5;

// The bounds in DualSolver's documentation: of one call of nlopt_optimize, of the first call with a
// number of rows besides, and of the calls in one solve.
constexpr long call_allocations = 2;
constexpr long call_bytes(long rows) {
  return 256 * (rows + 1);
}
constexpr long creation_allocations = 3;
constexpr long creation_bytes(long rows) {
  return 32 * rows + 512;
}
constexpr long solve_calls = 20;

int ticks() {
  return test_support::quick_or_full(1000, 10000);
}

// Calls functions of the loop and notes which of them use the heap after the warm-up, NLopt's use
// left out.
class LoopWatch {
 public:
  void next_tick() { ++tick_; }

  template <typename Call>
  decltype(auto) operator()(const char* function, const Call& call) {
    const Look look(*this, function);
    return call();
  }

  // That have used the heap.
  [[nodiscard]] double functions() const {
    return static_cast<double>(std::count_if(
        notes_.begin(), notes_.end(), [](const Note& note) { return note.function != nullptr; }));
  }

  // Empty if there was nothing to note.
  [[nodiscard]] std::string notes() const {
    std::ostringstream text;
    for (const Note& note : notes_)
      if (note.function != nullptr)
        text << note.function << ": " << note.use.allocations << " allocations (" << note.use.bytes
             << " bytes), " << note.use.releases << " releases, first in tick " << note.tick
             << "\n";
    return text.str();
  }

 private:
  struct Note {
    const char* function = nullptr;
    HeapUse use;
    int tick = 0;
  };

  class Look {
   public:
    Look(LoopWatch& watch, const char* function)
        : watch_(watch), function_(function), before_(heap_use(HeapUser::other)) {}
    ~Look() { watch_.note(function_, heap_use(HeapUser::other) - before_); }
    Look(const Look&) = delete;
    Look& operator=(const Look&) = delete;

   private:
    LoopWatch& watch_;
    const char* function_;
    HeapUse before_;
  };

  void note(const char* function, const HeapUse& use) {
    if (use.none() || tick_ <= warm_up) return;
    for (Note& note : notes_) {
      if (note.function == nullptr) note = {function, {}, tick_};
      if (note.function != function) continue;
      note.use = note.use + use;
      return;
    }
  }

  int tick_ = 0;
  std::array<Note, 30> notes_;
};

class HeapInTheLoop : public testing::Test {
 protected:
  void SetUp() override {
    if (!test_support::heap_can_be_counted)
      GTEST_SKIP() << "a sanitizer or another C library has the heap: it cannot be counted";
    nlopt_calls = {};
  }
  void TearDown() override {
    EXPECT_EQ(watch.notes(), "");
    if (test_support::heap_can_be_counted)
      test_support::check_at_most(1, "functions of the loop that use the heap", watch.functions(),
                                  0);
  }

  LoopWatch watch;
};

void expect_nlopt_within_documented_bounds() {
  EXPECT_EQ(nlopt_calls.sum.allocations, nlopt_calls.sum.releases);  // nothing stays
  for (std::size_t rows = 1; rows < nlopt_calls.largest.size(); ++rows) {
    const HeapUse& use = nlopt_calls.largest[rows];
    EXPECT_LE(use.allocations, call_allocations) << rows << " rows";
    EXPECT_LE(use.bytes, call_bytes(static_cast<long>(rows))) << rows << " rows";
  }
}

// Compilers may leave out memory whose address nobody sees.
const void* volatile seen = nullptr;

TEST_F(HeapInTheLoop, WhatTheLoopAllocatesIsCounted) {
  for (int i = 0; i <= warm_up; ++i) watch.next_tick();
  LoopWatch deliberate = watch;
  const std::vector<double> vector =
      deliberate("vector", [] { return std::vector<double>(static_cast<std::size_t>(ticks())); });
  seen = vector.data();
  Eigen::VectorXd eigen(3);
  seen = eigen.data();
  deliberate("Eigen", [&] { eigen = Eigen::VectorXd::Random(5); });
  seen = eigen.data();
  std::vector<double> small(3);
  seen = small.data();
  deliberate("release", [&] { std::vector<double>().swap(small); });
  const std::string bytes = std::to_string(8 * ticks());
  EXPECT_NE(deliberate.notes().find("vector: 1 allocations (" + bytes + " bytes), 0 releases"),
            std::string::npos)
      << deliberate.notes();
  // Where malloc aligns less than the processor's vectors like, Eigen takes what aligning needs.
  const int aligning = EIGEN_MALLOC_ALREADY_ALIGNED ? 0 : EIGEN_DEFAULT_ALIGN_BYTES;
  EXPECT_NE(deliberate.notes().find("Eigen: 1 allocations (" + std::to_string(40 + aligning) +
                                    " bytes), 1 releases"),
            std::string::npos)
      << deliberate.notes();
  EXPECT_NE(deliberate.notes().find("release: 0 allocations (0 bytes), 1 releases"),
            std::string::npos)
      << deliberate.notes();
}

double allocating_objective(unsigned, const double* x, double*, void*) {
  const std::vector<double> memory(7, x[0]);
  seen = memory.data();
  return memory.back();
}

TEST_F(HeapInTheLoop, NloptsUseIsToldFromThatOfTheFunctionsItCallsBack) {
  double x = 1.0, value = 0.0;
  const HeapUse nlopt = heap_use(HeapUser::nlopt), other = heap_use(HeapUser::other);
  nlopt_opt optimizer = nlopt_create(NLOPT_LN_NELDERMEAD, 1U);
  nlopt_set_min_objective(optimizer, allocating_objective, nullptr);
  nlopt_set_maxeval(optimizer, 3);
  nlopt_optimize(optimizer, &x, &value);
  nlopt_destroy(optimizer);
  const HeapUse by_nlopt = heap_use(HeapUser::nlopt) - nlopt;
  const HeapUse by_objective = heap_use(HeapUser::other) - other;
  EXPECT_GT(by_nlopt.allocations, 0);
  EXPECT_EQ(by_nlopt.allocations, by_nlopt.releases);
  EXPECT_EQ(by_objective.allocations, 3);
  EXPECT_EQ(by_objective.bytes, 3 * 7 * 8);
}

TEST_F(HeapInTheLoop, NloptTakesWhatIsDocumentedForEveryNumberOfRows) {
  constexpr int capacity = 150;
  Random random(81);
  DualSolver solver(capacity);
  const Eigen::MatrixXd G = Eigen::MatrixXd::NullaryExpr(capacity, capacity + 3,
                                                         [&random] { return random.normal(1.0); });
  const Eigen::MatrixXd H = G * G.transpose();
  const Eigen::VectorXd rho = Eigen::VectorXd::Constant(capacity, 0.1);
  const Eigen::VectorXd b = Eigen::VectorXd::NullaryExpr(
      capacity, [&random] { return std::sqrt(1.0 * capacity) * random.normal(1.0); });
  Eigen::VectorXd lambda = Eigen::VectorXd::Zero(capacity);
  for (int i = 0; i <= warm_up; ++i) watch.next_tick();
  for (int rows = 1; rows <= capacity; ++rows) {
    const HeapUse before = heap_use(HeapUser::nlopt), sum_before = nlopt_calls.sum;
    const long count_before = nlopt_calls.count;
    auto multipliers = lambda.head(rows);
    EXPECT_TRUE(watch("DualSolver::solve", [&] {
      return solver.solve(H.topLeftCorner(rows, rows), b.head(rows), rho.head(rows), multipliers);
    }));
    const HeapUse created = heap_use(HeapUser::nlopt) - before - (nlopt_calls.sum - sum_before);
    EXPECT_GT(created.allocations, 0) << rows << " rows";
    EXPECT_LE(created.allocations, creation_allocations) << rows << " rows";
    EXPECT_LE(created.bytes, creation_bytes(rows)) << rows << " rows";
    EXPECT_GT(nlopt_calls.largest[static_cast<std::size_t>(rows)].bytes, 8 * rows);
    EXPECT_LE(nlopt_calls.count - count_before, solve_calls) << rows << " rows";
  }
  expect_nlopt_within_documented_bounds();
}

// The most that one tick made of NLopt.
struct NloptInTicks {
  template <typename Tick>
  void operator()(const Tick& tick) {
    const HeapUse before = heap_use(HeapUser::nlopt);
    const long calls_before = nlopt_calls.count;
    tick();
    calls = std::max(calls, nlopt_calls.count - calls_before);
    bytes = std::max(bytes, (heap_use(HeapUser::nlopt) - before).bytes);
  }
  long calls = 0, bytes = 0;
};

TEST_F(HeapInTheLoop, RealTimeIterationsWhoseActiveRowsChange) {
  using Solver = MultipleShooting<WheeledFlightProblem<>>;
  SolverSettings settings;
  settings.program.max_dual_rows = 40;  // left to NLopt
  Solver solver(test_support::air_problem(), settings);
  State<> x = test_support::air_start();
  solver.reset(x);
  NloptInTicks warm, cold;
  std::set<int> active_rows;
  bool good = true;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    test_support::set_air_reference(solver.problem(), 0.02 * i);
    const bool reset = i % 50 == 49;
    if (reset) {
      watch("reset", [&] { solver.reset(x); });
      for (int k = 0; k <= solver.horizon(); ++k)
        watch("set_guess", [&] { solver.set_guess(k, x, Eigen::Matrix<double, 6, 1>::Zero()); });
    }
    (reset || i == 0 ? cold : warm)([&] {
      good = watch("prepare", [&] { return solver.prepare() == PrepareStatus::prepared; }) && good;
      good =
          watch("feedback", [&] { return solver.feedback(x).status; }) == SolveStatus::iterated &&
          good;
    });
    active_rows.insert(solver.report().active_rows);
    x = test_support::air_plant(x, solver.input(0));
  }
  EXPECT_TRUE(good);
  EXPECT_GT(active_rows.size(), 10U);
  EXPECT_GT(warm.calls, 0);
  // Measured: 3 calls and 18 kB; after a cold start 20 and 158 kB.
  EXPECT_LE(warm.calls, 6);
  EXPECT_LE(warm.bytes, 40000);
  EXPECT_LE(cold.calls, 60);
  EXPECT_LE(cold.bytes, 500000);
  expect_nlopt_within_documented_bounds();
}

// Eigen takes the blocks of large products from the heap.
TEST_F(HeapInTheLoop, AlmostAsManyActiveRowsAsThereIsRoomFor) {
  for (const int intervals : {20, 60}) {
    WheeledFlightSettings settings;
    settings.intervals = intervals;
    settings.bounds.force_rate.setConstant(0.5);
    settings.bounds.torque_rate.setConstant(0.05);
    MultipleShooting<WheeledFlightProblem<>> solver(
        WheeledFlightProblem(test_support::benchmark_body(), settings));
    for (int k = 0; k <= solver.horizon(); ++k)
      solver.problem().node(k).wrench_reference.force = test_support::benchmark_hover_force();
    Random random(82);
    int most = 0;
    for (int i = 0; i < 30; ++i) {
      watch.next_tick();
      State<> x = test_support::step_start();
      x.body.position += random.vector(3.0);
      x.body.velocity += random.vector(3.0);
      if (i % 5 == 0) watch("reset", [&] { solver.reset(x); });
      watch("prepare", [&] { return solver.prepare(); });
      watch("feedback", [&] { return solver.feedback(x).status; });
      most = std::max(most, solver.report().active_rows);
    }
    EXPECT_GT(most, 100) << intervals << " intervals";
  }
  expect_nlopt_within_documented_bounds();
}

TEST_F(HeapInTheLoop, SolvesFromAColdStart) {
  for (const TerminalCost terminal : {TerminalCost::weights, TerminalCost::riccati}) {
    WheeledFlightSettings settings;
    settings.terminal_cost = terminal;
    MultipleShooting<WheeledFlightProblem<>> solver(test_support::step_problem(settings));
    Random random(83);
    int converged = 0;
    for (int i = 0; i < ticks() / 10; ++i) {
      watch.next_tick();
      State<> x = test_support::step_start();
      x.body.position += random.vector(0.3);
      for (int k = 0; k <= solver.horizon(); ++k)
        solver.problem().node(k).on_ground = i % 4 == 3 && k > 15;  // with equalities
      watch("reset", [&] { solver.reset(x); });
      const SolveStatus status = watch("solve", [&] { return solver.solve(x).status; });
      if (status == SolveStatus::converged) ++converged;
    }
    EXPECT_GT(converged, ticks() / 20);
  }
  expect_nlopt_within_documented_bounds();
}

TEST_F(HeapInTheLoop, AProblemOfAnotherKind) {
  test_support::QuadrotorModel model;
  model.max_thrust = 3.0;
  MultipleShooting<test_support::Quadrotor> solver{test_support::Quadrotor(model)};
  Random random(84);
  int most = 0;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    const BodyState<> x = test_support::random_state(random).body;
    if (i % 10 == 0) watch("reset", [&] { solver.reset(x); });
    watch("prepare", [&] { return solver.prepare(); });
    watch("feedback", [&] { return solver.feedback(x).status; });
    most = std::max(most, solver.report().active_rows);
  }
  EXPECT_GT(most, 5);
  expect_nlopt_within_documented_bounds();
}

// Everything on board and the plant with its sensors, from the ground into the air and back, over
// and over, with measurements, references and estimates that fail now and then.
TEST_F(HeapInTheLoop, TheWholeLoopInTheAirAndOnTheGround) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.servo.dead_time = 0.015;
  vehicle.battery.nominal_voltage = 20.0;
  Allocation allocation(vehicle);
  OutputScaling scaling(vehicle);
  const PowerModel power(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserver<> observer(vehicle.body);
  ContactEstimator contact(vehicle);
  NmpcSettings settings = test_support::in_simulated_time();
  settings.problem.bounds.force_rate << 3.0, 3.0, 10.0;  // rows become active on the way
  Nmpc nmpc(vehicle, settings);
  Plant<4> plant(vehicle);
  StateSensorParameters delayed;
  delayed.delay = 0.01;
  StateSensor state_sensor(delayed, 1);
  PoseSensor pose_sensor({}, 2);
  ImuSensor imu({}, 3);
  RotorSpeedSensor<4> rotor_sensor({}, 4);

  const double radius = vehicle.wheels->radius;
  FigureEightParameters eight;
  eight.center.z() = radius;
  eight.amplitude << 0.4, 0.15, 0.0;
  eight.laps = 1;
  eight.heading = HeadingMode::along_velocity;
  const FigureEight on_wheels(eight);
  const ReferencePoint start = on_wheels(0.0);
  Waypoint below, above;
  below.position = above.position = start.position;
  above.position.z() = 0.4;
  below.yaw = above.yaw = yaw_of(start.orientation);
  const Mission mission({{MissionPhase::rest, Hold(below, 0.3)},
                         {MissionPhase::take_off, take_off(below, 0.4)},
                         {MissionPhase::hover, Hold(above, 0.3)},
                         {MissionPhase::landing, landing(above, radius)},
                         {MissionPhase::rest, Hold(below, 0.3)},
                         {MissionPhase::ground, on_wheels}});
  int fault = 0;  // 1: of the measurement, 2: of the reference, 3: of the estimate
  const auto reference = [&](double time) {
    ReferencePoint point = mission(std::fmod(time, mission.end_time()));
    if (fault == 2) point.position.x() = nan;
    return point;
  };

  AllocationResult<4> sent;
  BodyState<> measured = plant.body();
  Eigen::Vector4d speeds = Eigen::Vector4d::Zero();
  NloptInTicks nlopt;
  std::set<NmpcStatus> reached;
  double energy = 0.0;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    const double time = plant.time();
    fault = i % 60 == 30 ? 1 : i % 60 == 45 ? 2 : i % 60 == 50 ? 3 : i % 400 > 370 ? 1 : 0;
    if (const auto m =
            watch("StateSensor", [&] { return state_sensor.sample(time, plant.body()); }))
      measured = m->body;
    (void)watch("PoseSensor", [&] { return pose_sensor.sample(time, plant.body()); });
    if (const auto m = watch("RotorSpeedSensor", [&] {
          return rotor_sensor.sample(time, plant.actuators().rotor_speed);
        }))
      speeds = m->rotor_speed;
    const ActuatorState<4> applied{speeds, watch("ActuatorModel", [&] {
                                     return actuators.update(time, sent.command).tilt_angle;
                                   })};
    if (auto m = watch("ImuSensor", [&] {
          return imu.sample(time, plant.body().angular_velocity, plant.specific_force());
        })) {
      if (fault == 3) m->specific_force.y() = nan;
      const Wrench<> wrench =
          watch("Allocation::wrench", [&] { return allocation.wrench(applied); });
      (void)watch("WrenchObserver", [&] { return observer.update(time, *m, wrench); });
    }
    if (i % 25 == 0) {
      settings.ground.down_force = i % 2 == 0 ? 0.75 : 1.0;
      settings.problem.weights.position.x() = i % 2 == 0 ? 60.0 : 80.0;
      watch("Nmpc::set_settings", [&] { nmpc.set_settings(settings); });
    }
    const double voltage = fault == 2 ? nan : 20.0 - 0.001 * time;
    for (const bool taken :
         {watch("Allocation::set_voltage", [&] { return allocation.set_voltage(voltage); }),
          watch("ActuatorModel::set_voltage", [&] { return actuators.set_voltage(voltage); }),
          watch("OutputScaling::set_voltage", [&] { return scaling.set_voltage(voltage); }),
          watch("Nmpc::set_voltage", [&] { return nmpc.set_voltage(voltage); }),
          watch("Plant::set_voltage", [&] { return plant.set_voltage(voltage); })})
      EXPECT_EQ(taken, fault != 2);
    nlopt([&] {
      watch("ContactEstimator", [&] { contact.update(time, measured, observer); });
      watch("Nmpc::prepare", [&] { return nmpc.prepare(time, reference, contact.estimate()); });
      BodyState<> delivered = measured;
      if (fault == 1) delivered.velocity.x() = nan;
      const NmpcResult& result = watch(
          "Nmpc::feedback", [&]() -> const NmpcResult& { return nmpc.feedback(time, delivered); });
      reached.insert(result.status);
      sent = watch("Allocation::allocate",
                   [&] { return allocation.allocate(time, result.wrench, result.rate, sent); });
    });
    watch("Plant::step", [&] { return plant.step(sent.command, {}, 0.01); });
    energy += watch("PowerModel", [&] { return power.power(plant.actuators().rotor_speed); });
  }
  EXPECT_GE(reached.size(), 4U);  // approximate in the ticks of touch-down
  EXPECT_GE(contact.mode_changes(), 2);
  EXPECT_GT(energy, 0.0);
  // Measured: 29 calls and 256 kB, both in a cold start.
  EXPECT_GT(nlopt.calls, 0);
  test_support::check_at_most(1, "NLopt: calls in a tick, at worst",
                              static_cast<double>(nlopt.calls), 60);
  test_support::check_at_most(1, "NLopt: bytes in a tick, at worst",
                              static_cast<double>(nlopt.bytes), 500000);
  expect_nlopt_within_documented_bounds();
}

// Calibrations that succeed and fail, gaps, bad samples and limits.
TEST_F(HeapInTheLoop, AnObserverThatIsCalibratedAndLimited) {
  WrenchObserverSettings settings;
  settings.force_limit.setConstant(1.0);
  WrenchObserver<> observer(tilt_ropter_vehicle().body, settings);
  Random random(85);
  std::set<ObserverStatus> reached;
  std::set<CalibrationStatus> calibrated;
  std::set<WrenchTrust> trusted;
  double time = 0.0;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    time += i % 300 == 0 ? 0.2 : 0.01;
    const bool push = i % 600 > 400;
    Eigen::Vector3d a = random.vector(0.1) + 2.0 * push * Eigen::Vector3d::UnitX();
    if (i % 70 == 0) a.y() = nan;
    trusted.insert(watch("trust", [&] { return observer.trust(time); }));
    reached.insert(watch("update", [&] {
      return observer.update(time, {Eigen::Vector3d::Zero(), a}, {});
    }));
    if (i % 150 == 20) watch("begin_calibration", [&] { observer.begin_calibration(); });
    if (i % 150 == (i < 600 ? 149 : 50))
      calibrated.insert(watch("end_calibration", [&] { return observer.end_calibration(); }));
    if (i % 600 == 599) watch("set_offset", [&] { observer.set_offset({}); });
  }
  EXPECT_GE(reached.size(), 4U);  // approximate in the ticks of touch-down
  EXPECT_GE(calibrated.size(), 3U);
  EXPECT_EQ(trusted.size(), 5U);
}

// Requests in and out of limits, of vehicles with and without a null space.
TEST_F(HeapInTheLoop, AllocationWithinAndBeyondItsLimits) {
  Vehicle<4> narrow = tilt_ropter_vehicle();
  narrow.rotor.min_thrust = 0.3;
  narrow.servo.min_angle = -1.0;
  narrow.servo.max_angle = 1.2;
  const Allocation<4> tilting(tilt_ropter_vehicle()), limited(narrow);
  const Allocation<8> fixed(test_support::omnidirectional_octocopter());
  AllocationResult<4> last, last_limited, inverted;
  AllocationResult<8> last_fixed;
  Random random(85);
  std::set<AllocationStatus> reached;
  for (int i = 0; i < ticks(); ++i) {
    watch.next_tick();
    const double time = 0.01 * i;
    const double size = std::pow(10.0, random.uniform(-3.0, 2.0));
    Wrench<> wanted{random.vector(size), random.vector(0.1 * size)};
    const Wrench<> rate{random.vector(size), random.vector(size)};
    if (i % 10 == 9) wanted.force.y() = nan;
    watch("allocate", [&] {
      last = tilting.allocate(time, wanted, rate, last);
      last_limited = limited.allocate(time, wanted, rate, last_limited);
      last_fixed = fixed.allocate(time, wanted, rate, last_fixed);
    });
    reached.insert(last.status);
    reached.insert(last_limited.status);
    // A push to and fro across the end of the range.
    const Wrench<> upside_down{{0.0, i % 20 < 10 ? 0.05 : -0.05, -8.0}, Eigen::Vector3d::Zero()};
    watch("allocate", [&] { inverted = tilting.allocate(time, upside_down, {}, inverted); });
    reached.insert(inverted.status);
  }
  EXPECT_EQ(reached.size(), 7U);
}

}  // namespace
}  // namespace tilt_ropter
