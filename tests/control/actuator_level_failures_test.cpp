// CTest: flight

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/planning/minimum_snap.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include "support/actuator_loop.hpp"
#include "support/full_run.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <optional>
#include <string>
#include <vector>

// An actuator fails at 4 m, in hover or in the figure eight, and the vehicle lands by control at
// the level of thrusts and tilt angles. Each flight prints one line.

namespace tilt_ropter {
namespace actuator_level_failures_test {

constexpr double degree = pi / 180.0;

enum class Knowledge { told, found };

struct Flight {
  ActuatorFailure failure;
  bool in_the_eight = false;
  Knowledge knowledge = Knowledge::told;
  unsigned seed = 1;

  [[nodiscard]] std::string name() const {
    const std::string rotor = std::to_string(failure.rotor + 1);
    return std::string(in_the_eight ? "eight, " : "hover, ") +
           (failure.kind == FailureKind::rotor
                ? "rotor " + rotor + " lost"
                : "servo " + rotor + " stuck at " +
                      std::to_string(std::lround(failure.angle / degree)) + " deg") +
           ", seed " + std::to_string(seed);
  }
};

struct Landing {
  bool touched = false, planned = true, alarmed_before = false;
  double speed = 0.0, tilt = 0.0;  // of the body just before the first touch [m/s, rad]
  double largest_tilt = 0.0, largest_error = 0.0;  // after the failure, in the air [rad, m]
  double delay = 0.0;                              // until the controller knows it [s]
  ActuatorFailure known;                           // what it then knows
};

double tilt_of(const BodyStated& body) {
  return std::acos(std::clamp((body.orientation * Eigen::Vector3d::UnitZ()).z(), -1.0, 1.0));
}

/// Brakes from `from` at `time`, hovers for 2 s, and lands.
class EmergencyLanding {
 public:
  EmergencyLanding(double time, const ReferencePoint& from, double standing)
      : start_(time), brake_(stop(from, std::max(2.0, 1.1 * from.acceleration.norm()))) {
    const ReferencePoint rest = brake_(brake_.duration());
    landing_ = landing({rest.position, yaw_of(rest.orientation)}, standing);
    landing_.set_start_time(start_ + brake_.duration() + 2.0);
  }
  [[nodiscard]] ReferencePoint operator()(double time) const {
    return time < landing_.start_time() ? brake_(time - start_) : landing_(time);
  }
  [[nodiscard]] double end_time() const { return landing_.end_time(); }

 private:
  double start_;
  MinimumSnap brake_;
  Transition landing_;
};

Landing fly(const Flight& flight) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  test_support::ActuatorLoop<4> loop(vehicle, vehicle, flight.seed);
  HybridMissionSettings settings;
  settings.flight_height = 4.0;
  settings.hover_time = 1.0;
  const Mission eight = hybrid_mission(std::nullopt, settings);
  const auto planned = [&](double time) { return eight(flight.in_the_eight ? time : 0.0); };
  loop.start({0.0, 0.0, 4.0});
  // At different places of the eight.
  const double fails_at = flight.in_the_eight ? 2.0 + 0.37 * (flight.seed % 13) : 1.5;
  loop.run(fails_at, planned);

  Landing result;
  result.alarmed_before = loop.failure().kind != FailureKind::none;
  loop.fail(with_failure(vehicle, flight.failure));
  std::optional<EmergencyLanding> rescue;
  const auto reference = [&](double time) { return rescue ? (*rescue)(time) : planned(time); };
  for (double end = fails_at + 5.0; loop.plant().time() < end;) {
    const double time = loop.plant().time();
    const bool knows = flight.knowledge == Knowledge::told
                           ? time > fails_at + 0.1 - 1e-6
                           : loop.failure().kind != FailureKind::none;
    if (knows && !rescue) {
      result.delay = time - fails_at;
      result.known = flight.knowledge == Knowledge::told ? flight.failure : loop.failure();
      loop.tell(with_failure(vehicle, result.known));
      rescue.emplace(time, planned(time), vehicle.wheels->radius);
      end = rescue->end_time() + 1.0;
    }
    const BodyStated before = loop.plant().body();
    loop.restart_statistics();
    result.planned = has_plan(loop.tick(reference).status) && result.planned;
    if (loop.plant().normal_forces().sum() > 0.0) {
      result.touched = true;
      result.speed = before.velocity.norm();
      result.tilt = tilt_of(before);
      break;
    }
    result.largest_tilt = std::max(result.largest_tilt, tilt_of(before));
    result.largest_error = std::max(result.largest_error, loop.largest_error());
  }
  std::printf("%-42s known after %4.2f s: tilts by %3.0f deg, %4.2f m off, touches at %.2f m/s\n",
              flight.name().c_str(), result.delay, result.largest_tilt / degree,
              result.largest_error, result.speed);
  return result;
}

/// Every servo at every angle and every rotor lost, in hover and in the eight.
std::vector<Flight> all_failures(Knowledge knowledge, unsigned seeds) {
  std::vector<Flight> flights;
  for (unsigned seed = 1; seed <= seeds; ++seed)
    for (const bool in_the_eight : {false, true})
      for (std::size_t rotor = 0; rotor < 4; ++rotor) {
        for (const double angle : {0.0, 30.0, -30.0, 60.0, -60.0, 90.0, -90.0})
          flights.push_back({{FailureKind::servo, rotor, angle * degree, 1.0, 0.0},
                             in_the_eight,
                             knowledge,
                             seed});
        flights.push_back(
            {{FailureKind::rotor, rotor, 0.0, 0.0, 0.0}, in_the_eight, knowledge, seed});
      }
  return flights;
}

void expect_soft_and_level(const Flight& flight, const Landing& landing) {
  EXPECT_TRUE(landing.touched && landing.planned) << flight.name();
  EXPECT_LE(landing.speed, 0.5) << flight.name();
  EXPECT_LE(landing.tilt, 20.0 * degree) << flight.name();
}

/// The flights of a plain run: the failures after which the vehicle turns most.
std::vector<Flight> few_failures(Knowledge knowledge) {
  std::vector<Flight> flights;
  unsigned seed = 0;
  for (const Flight& flight : all_failures(knowledge, 1)) {
    const bool severe =
        flight.failure.kind == FailureKind::rotor || std::abs(flight.failure.angle) > 80.0 * degree;
    if (!severe || flight.failure.rotor != (flight.in_the_eight ? 2U : 1U)) continue;
    flights.push_back(flight);
    flights.back().seed = ++seed;
  }
  return flights;
}

// With four passes per tick instead of six, the servo of rotor 3 stuck at -90 degrees was lost in
// the eight with two of five seeds. Many constraints are then active: the angular velocity is above
// its bound.
TEST(ActuatorLevelFailures, LandsSoftAndLevelIfToldAfter100Milliseconds) {
  const auto flights =
      test_support::full_run() ? all_failures(Knowledge::told, 5) : few_failures(Knowledge::told);
  for (const Flight& flight : flights) {
    const auto remaining = with_failure(tilt_ropter_vehicle(), flight.failure);
    ASSERT_TRUE(control_authority(remaining).hovers) << flight.name();
    expect_soft_and_level(flight, fly(flight));
  }
}

// A servo that sticks upright in hover changes nothing, so nothing need be found.
TEST(ActuatorLevelFailures, FindsTheFailureItselfAndLandsSoftAndLevel) {
  const auto flights =
      test_support::full_run() ? all_failures(Knowledge::found, 5) : few_failures(Knowledge::found);
  for (const Flight& flight : flights) {
    if (flight.failure.kind == FailureKind::servo && flight.failure.angle == 0.0) continue;
    const Landing landing = fly(flight);
    expect_soft_and_level(flight, landing);
    EXPECT_FALSE(landing.alarmed_before) << flight.name();
    EXPECT_LE(landing.delay, 0.3) << flight.name();
    EXPECT_EQ(landing.known.kind, flight.failure.kind) << flight.name();
    EXPECT_EQ(landing.known.rotor, flight.failure.rotor) << flight.name();
    EXPECT_NEAR(landing.known.angle, flight.failure.angle, 5.0 * degree) << flight.name();
    EXPECT_NEAR(landing.known.effectiveness, flight.failure.effectiveness, 0.05) << flight.name();
  }
}

}  // namespace actuator_level_failures_test
}  // namespace tilt_ropter
