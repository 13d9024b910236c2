// What explains the residual of the IMU, with any settings, samples, speeds and time stamps: the
// wrench observer and the detector of failed actuators.

#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>

#include "fuzz/input.hpp"

#include <cmath>
#include <optional>

using namespace tilt_ropter;

namespace {

void observe(fuzz::Input& input) {
  RigidBodyParameters body = tilt_ropter_vehicle().body;
  WrenchObserverSettings s;
  s.force_limit.setConstant(20.0);
  s.torque_limit.setConstant(2.0);
  if (input.coin())
    input.vary_all(body.mass, body.inertia, s.force_bandwidth, s.torque_bandwidth,
                   s.force_dead_band, s.torque_dead_band, s.force_limit, s.torque_limit, s.max_gap);
  std::optional<WrenchObserverd> observer;
  if (!fuzz::accepted([&] { observer.emplace(body, s); })) return;
  double time = 0.0;
  for (int tick = 0; tick < 300 && !input.empty(); ++tick) {
    time += 0.01;
    switch (input.integer(0, 9)) {
      case 0:
        observer->reset();
        break;
      case 1:
        observer->set_offset(input.wrench(10.0, 1.0));
        break;
      case 2:
        observer->begin_calibration();
        break;
      case 3:
        (void)observer->end_calibration(input.wrench(10.0, 1.0));
        break;
      case 4:
        time = input.number(10.0);
        [[fallthrough]];
      default: {
        const Eigen::Vector3d force = input.vector(20.0), rate = input.vector(5.0);
        const Wrenchd applied = input.wrench(20.0, 2.0);
        const Wrenchd before = observer->filtered();
        const ObserverStatus status = observer->update(time, {rate, force}, applied).status;
        fuzz::expect(
            status == ObserverStatus::updated || (observer->filtered().force == before.force &&
                                                  observer->filtered().torque == before.torque),
            "a sample that is not used changes nothing");
        fuzz::expect(status == ObserverStatus::rejected ||
                         (std::isfinite(time) && all_finite(force) && is_finite(applied)),
                     "what is not finite is rejected");
      }
    }
    if (!std::isfinite(time)) time = 0.0;
    fuzz::expect(is_finite(observer->filtered()) && is_finite(observer->offset()) &&
                     is_finite(observer->external()),
                 "estimates are finite");
    fuzz::expect((observer->external().force.array().abs() <= s.force_limit.array()).all() &&
                     (observer->external().torque.array().abs() <= s.torque_limit.array()).all(),
                 "the estimate is within its limits");
    (void)observer->trust(input.number(1.0));
  }
}

void detect(fuzz::Input& input) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  if (input.coin())
    input.vary_all(vehicle.body.mass, vehicle.body.inertia, vehicle.rotor.max_thrust,
                   vehicle.rotors[1].position, vehicle.rotors[2].tilts,
                   vehicle.rotors[3].effectiveness);
  std::optional<FailureDetector<4>> detector;
  if (!fuzz::accepted([&] { detector.emplace(vehicle); })) return;
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
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  input.coin() ? observe(input) : detect(input);
  return 0;
}
