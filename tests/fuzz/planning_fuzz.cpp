// References from any settings: rejected, or finite at all times.

#include <tilt_ropter/planning/mission.hpp>

#include "fuzz/input.hpp"

#include <cmath>
#include <optional>

using namespace tilt_ropter;

namespace {

template <typename Reference>
void expect_finite(const Reference& reference) {
  const double start = reference.start_time(), duration = reference.end_time() - start;
  fuzz::expect(duration > 0.0 && std::isfinite(duration), "it lasts for some time");
  for (const double fraction : {-1.0, 0.0, 1e-9, 0.1, 0.37, 0.5, 0.77, 0.999, 1.0, 2.0}) {
    const ReferencePoint p = reference(start + fraction * duration);
    fuzz::expect(all_finite(p.position) && all_finite(p.velocity) && all_finite(p.acceleration) &&
                     all_finite(p.angular_velocity) && all_finite(p.angular_acceleration) &&
                     std::abs(p.orientation.norm() - 1.0) < 1e-9,
                 "the reference is finite");
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  const int kind = input.integer(0, 2);
  if (kind == 0) {
    FigureEightSettings p;
    if (input.coin()) p.heading = HeadingMode::along_velocity;
    input.vary_all(p.center, p.amplitude, p.direction, p.laps, p.ramp_laps, p.max_speed,
                   p.max_acceleration, p.yaw, p.max_yaw_rate);
    std::optional<FigureEight> eight;
    if (fuzz::accepted([&] { eight.emplace(p); })) expect_finite(*eight);
  } else if (kind == 1) {
    TransitionSettings p;
    p.to.position << 1.0, 2.0, 3.0;
    input.vary_all(p.from.position, p.from.yaw, p.to.position, p.to.yaw, p.duration, p.max_speed,
                   p.max_acceleration, p.max_yaw_rate, p.max_yaw_acceleration);
    std::optional<Transition> transition;
    if (fuzz::accepted([&] { transition.emplace(p); })) expect_finite(*transition);
  } else {
    HybridMissionSettings p;
    Undercarriage stand;
    input.vary_all(p.origin, p.yaw, p.direction, stand.height, p.flight_height, p.rest_time,
                   p.hover_time, p.air_amplitude, p.ground_amplitude, p.laps, p.max_speed,
                   p.max_acceleration, p.max_yaw_rate, p.start_time);
    std::optional<Mission> mission;
    if (fuzz::accepted([&] { mission.emplace(hybrid_mission(stand, p)); })) expect_finite(*mission);
  }
  return 0;
}
