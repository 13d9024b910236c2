#include "precompiled.hpp"

namespace tilt_ropter {

TILT_ROPTER_TEST_INSTANCES()

}  // namespace tilt_ropter
