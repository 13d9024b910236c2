// The wrench observer with any samples, time stamps and calibrations.

#include <tilt_ropter/estimation/wrench_observer.hpp>

#include "fuzz/input.hpp"

#include <cmath>
#include <optional>

using namespace tilt_ropter;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  RigidBodyParameters body = tilt_ropter_vehicle().body;
  WrenchObserverSettings s;
  s.force_limit.setConstant(20.0);
  s.torque_limit.setConstant(2.0);
  if (input.coin())
    input.vary_all(body.mass, body.inertia, s.force_bandwidth, s.torque_bandwidth,
                   s.force_dead_band, s.torque_dead_band, s.force_limit, s.torque_limit, s.max_gap);
  std::optional<WrenchObserverd> observer;
  if (!fuzz::accepted([&] { observer.emplace(body, s); })) return 0;
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
  return 0;
}
