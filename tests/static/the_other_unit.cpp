#include <tilt_ropter/tilt_ropter.hpp>

const int* minor_version_of_the_other_unit() {
  return &tilt_ropter::version_minor;
}
