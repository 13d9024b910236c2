// CTest: flight

#include "../../examples/support/paper_switches.hpp"

#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <string>
#include <vector>

namespace tilt_ropter {
namespace paper_switches_test {

using examples::ControllerSettings;

// The fields that the switches set, as numbers.
std::vector<double> fields(const NmpcSettings& s, const AllocationSettings& allocation) {
  const NmpcBounds& b = s.problem.bounds;
  return {static_cast<double>(s.wrench_reference),
          b.force_max.x(),
          b.force_rate.x(),
          b.torque_rate.x(),
          b.angular_velocity.x(),
          static_cast<double>(s.actuator_constraints),
          static_cast<double>(s.ground.contact_by_height),
          static_cast<double>(s.ground.model),
          s.problem.weights.ground.x(),
          s.problem.weights.ground_thrust,
          s.ground.settling_speed,
          static_cast<double>(s.solver.program.max_passes),
          s.time_limit,
          allocation.lag_compensation};
}

ControllerSettings library_settings(const std::vector<std::string>& as_in_paper) {
  ControllerSettings s{nmpc_settings(tilt_ropter_vehicle()), {}};
  examples::set_as_in_paper(as_in_paper, s);
  return s;
}

TEST(PaperSwitches, EachOneChangesSomethingThatNoOtherChanges) {
  const ControllerSettings none = library_settings({});
  const std::vector<double> before = fields(none.nmpc, none.allocation);
  std::vector<int> changed_by(before.size(), 0);
  for (const examples::PaperSwitch& one : examples::paper_switches()) {
    const ControllerSettings s = library_settings({one.name});
    const std::vector<double> after = fields(s.nmpc, s.allocation);
    EXPECT_NE(after, before) << one.name;
    for (std::size_t i = 0; i < before.size(); ++i) changed_by[i] += after[i] != before[i];
    EXPECT_NO_THROW(validate(s.nmpc)) << one.name;
    EXPECT_NO_THROW(validate(s.allocation)) << one.name;
  }
  EXPECT_EQ(changed_by, std::vector<int>(before.size(), 1));
}

TEST(PaperSwitches, AllOfThemGiveThePreset) {
  const ControllerSettings s = library_settings({"all"});
  AllocationSettings without_lead;
  without_lead.lag_compensation = 0.0;
  EXPECT_EQ(fields(s.nmpc, s.allocation), fields(paper_nmpc_settings(), without_lead));
}

}  // namespace paper_switches_test
}  // namespace tilt_ropter
