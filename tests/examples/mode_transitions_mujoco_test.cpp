// CTest: flight mujoco long

#include "../../examples/mujoco/plant.hpp"
#include "support/mode_transitions.hpp"

#include <gtest/gtest.h>

namespace examples {

static void place(MujocoPlant<4>& plant, const tilt_ropter::BodyStated& body,
                  const tilt_ropter::ActuatorState<4>& actuators) {
  plant.reset(body, actuators);
}

namespace mode_transitions_mujoco_test {

TEST(ModeTransitionsMujoco, LandsAndTakesOffWithOneModeChangeAndNoBounce) {
  test_support::land_and_take_off<MujocoPlant<4>>("MuJoCo", 10);
}

}  // namespace mode_transitions_mujoco_test
}  // namespace examples
