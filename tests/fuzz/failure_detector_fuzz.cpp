// The detector of failed actuators with any samples, speeds and time stamps.

#include <tilt_ropter/actuation/failure_detector.hpp>

#include "fuzz/input.hpp"

#include <cmath>
#include <optional>

using namespace tilt_ropter;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  if (input.coin())
    input.vary_all(vehicle.body.mass, vehicle.body.inertia, vehicle.rotor.max_thrust,
                   vehicle.rotors[1].position, vehicle.rotors[2].tilts,
                   vehicle.rotors[3].effectiveness);
  std::optional<FailureDetector<4>> detector;
  if (!fuzz::accepted([&] { detector.emplace(vehicle); })) return 0;
  double time = 0.0;
  ActuatorState<4> measured;
  measured.rotor_speed.setConstant(1600.0);
  InertialSampled sample{Eigen::Vector3d::Zero(), {0.0, 0.0, gravity}};
  Eigen::Vector4d modelled = measured.rotor_speed;
  for (int tick = 0; tick < 300 && !input.empty(); ++tick) {
    time += 0.01;
    const Eigen::Index i = input.integer(0, 3);
    switch (input.integer(0, 7)) {  // what is not changed stays, so that a change can last
      case 0:
        sample.specific_force = input.vector(20.0);
        break;
      case 1:
        sample.angular_velocity = input.vector(5.0);
        break;
      case 2:
        measured.rotor_speed(i) = input.number(3000.0);
        break;
      case 3:
        measured.tilt_angle(i) = input.number(pi);
        break;
      case 4:
        modelled(i) = input.number(3000.0);
        break;
      case 5:
        time = input.number(10.0);
        break;
      default:
        break;
    }
    const ActuatorFailure before = detector->failure();
    const ActuatorFailure& found =
        detector->update(time, sample, measured, modelled, input.integer(0, 15) != 0);
    if (!std::isfinite(time)) time = 0.0;
    if (found.kind == FailureKind::none) continue;
    fuzz::expect(before.kind == FailureKind::none || before.time == found.time,
                 "the first failure stays");
    fuzz::expect(found.rotor < 4 && std::abs(found.angle) <= pi && std::isfinite(found.time),
                 "the failure names a rotor, an angle and a time");
    fuzz::expect(found.effectiveness >= 0.0 && found.effectiveness <= 1.0,
                 "the thrust that is left is a fraction");
    fuzz::expect(fuzz::accepted([&] { validate(with_failure(vehicle, found)); }),
                 "the vehicle that remains is valid");
    if (input.coin()) detector->reset();
  }
  return 0;
}
