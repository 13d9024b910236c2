#include <tilt_ropter/tilt_ropter.hpp>

#include <nlopt.h>

#include <cstdio>
#include <exception>

/// A stranger's program: takes the reference vehicle, checks it, sees a wrong one refused.
int main() {
  int major = 0, minor = 0, bugfix = 0;
  nlopt_version(&major, &minor, &bugfix);
  tilt_ropter::Vehicle<4> vehicle = tilt_ropter::tilt_ropter_vehicle();
  tilt_ropter::validate(vehicle);
  std::printf("tilt_ropter %d.%d.%d with NLopt %d.%d.%d, vehicle of %.1f kg\n",
              tilt_ropter::version_major, tilt_ropter::version_minor, tilt_ropter::version_patch,
              major, minor, bugfix, vehicle.body.mass);

  vehicle.body.mass = -1.0;
  try {
    tilt_ropter::validate(vehicle);
  } catch (const std::exception& refusal) {
    std::printf("refused: %s\n", refusal.what());
    return 0;
  }
  return 1;
}
