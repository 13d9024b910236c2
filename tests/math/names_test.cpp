// Names of enumerators, as programs print them.

#include <tilt_ropter/tilt_ropter.hpp>

#include <tilt_ropter/identification/clock_calibration.hpp>
#include <tilt_ropter/identification/log_calibration.hpp>
#include <tilt_ropter/identification/servo_identification.hpp>
#include <tilt_ropter/identification/vehicle_identification.hpp>

#include <gtest/gtest.h>

#include <string>

namespace tilt_ropter {
namespace names_test {

// The name of an enumerator in the middle shows that none is missing before it, and "unknown" after
// the last one that none is missing at all.
template <typename Enum>
void expect_names(Enum middle, const char* name, Enum last, const char* last_name) {
  EXPECT_STREQ(to_string(middle), name);
  EXPECT_STREQ(to_string(last), last_name);
  EXPECT_STREQ(to_string(static_cast<Enum>(static_cast<int>(last) + 1)), "unknown");
  EXPECT_STREQ(to_string(static_cast<Enum>(-1)), "unknown");
}

TEST(Names, AreThoseOfTheEnumerators) {
  expect_names(AllocationStatus::angle_held, "angle_held", AllocationStatus::rejected, "rejected");
  expect_names(FailureKind::servo, "servo", FailureKind::slow_servos, "slow_servos");
  expect_names(EkfStatus::gated, "gated", EkfStatus::frozen, "frozen");
  expect_names(EstimateState::degraded, "degraded", EstimateState::lost, "lost");
  expect_names(ObserverStatus::gap, "gap", ObserverStatus::rejected, "rejected");
  expect_names(WrenchTrust::settling, "settling", WrenchTrust::trusted, "trusted");
  expect_names(CalibrationStatus::too_short, "too_short", CalibrationStatus::implausible,
               "implausible");
  expect_names(NmpcStatus::bad_state, "bad_state", NmpcStatus::no_plan, "no_plan");
  expect_names(MissionPhase::hover, "hover", MissionPhase::ground, "ground");
  using optimal_control::PrepareStatus;
  using optimal_control::ProgramSolver;
  using optimal_control::SolveStatus;
  expect_names(PrepareStatus::failed, "failed", PrepareStatus::rejected, "rejected");
  expect_names(ProgramSolver::active_set, "active_set", ProgramSolver::interior_point,
               "interior_point");
  expect_names(SolveStatus::iteration_limit, "iteration_limit", SolveStatus::rejected, "rejected");
  expect_names(LogCalibrationStatus::no_clock, "no_clock", LogCalibrationStatus::uncertain,
               "uncertain");
  expect_names(VehicleParameter::inertia_y, "inertia_y", VehicleParameter::arm_moment,
               "arm_moment");
}

}  // namespace names_test
}  // namespace tilt_ropter
