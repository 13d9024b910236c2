#include <tilt_ropter/tilt_ropter.hpp>

const int* minor_version_of_the_other_unit();

/// Both units link, and what is `inline` in the headers is one object in the program.
int main() {
  return minor_version_of_the_other_unit() == &tilt_ropter::version_minor ? 0 : 1;
}
