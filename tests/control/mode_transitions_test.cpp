// CTest: flight

#include "support/mode_transitions.hpp"

#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

namespace mode_transitions_test {

TEST(ModeTransitions, LandsAndTakesOffWithOneModeChangeEachAndNoBounce) {
  test_support::land_and_take_off<tilt_ropter::Plant<4>>("our plant", 20);
}

}  // namespace mode_transitions_test
