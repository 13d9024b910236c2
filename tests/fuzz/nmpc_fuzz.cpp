// The controller in one long loop: any measurements, references and estimates, then good inputs.

#include <tilt_ropter/control/nmpc.hpp>

#include "fuzz/input.hpp"

#include <cmath>

using namespace tilt_ropter;

namespace {

// A short horizon, and the default time limit of half a period.
NmpcSettings settings() {
  NmpcSettings s;
  s.problem.intervals = 5;
  return s;
}

void expect_within_bounds(const NmpcResult& result, const NmpcBounds& b) {
  fuzz::expect(is_finite(result.wrench) && is_finite(result.rate), "the command is finite");
  const Eigen::Vector3d &force = result.wrench.force, &torque = result.wrench.torque;
  fuzz::expect((force.array() >= b.force_min.array() && force.array() <= b.force_max.array()).all(),
               "the force is within its bounds");
  fuzz::expect(
      (torque.array() >= b.torque_min.array() && torque.array() <= b.torque_max.array()).all(),
      "the torque is within its bounds");
}

ReferencePoint hover() {
  ReferencePoint point;
  point.position.z() = 1.5;
  return point;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  static Nmpc<4> nmpc(tilt_ropter_vehicle(), settings());
  static double time = 0.0;
  fuzz::Input input(bytes, size);
  for (int tick = 0; tick < 8 && !input.empty(); ++tick) {
    time += 0.01;
    ReferencePoint point = hover();
    if (input.coin()) {
      point.position = input.vector(2.0);
      point.velocity = input.vector(2.0);
      point.acceleration = input.vector(2.0);
      point.orientation = input.orientation();
      point.angular_velocity = input.vector(2.0);
      point.angular_acceleration = input.vector(2.0);
    }
    ContactEstimate contact;
    contact.on_ground = input.coin();
    contact.ground.height = input.number(1.0);
    contact.ground.slope = input.vector(1.0).head<2>();
    if (input.coin()) contact.disturbance = input.wrench(3.0, 0.3);
    if (input.coin()) contact.rolling = input.wrench(3.0, 0.3);
    BodyStated measured;
    measured.position = input.vector(2.0);
    measured.velocity = input.vector(2.0);
    measured.orientation = input.orientation();
    measured.angular_velocity = input.vector(3.0);
    const double stamp = input.integer(0, 15) == 0 ? input.number(1.0) : time;
    if (input.integer(0, 15) != 0)
      (void)nmpc.prepare(
          stamp, [&](double) { return point; }, contact);
    const NmpcResult& result = nmpc.feedback(stamp, measured);
    expect_within_bounds(result, nmpc.settings().problem.bounds);
    fuzz::expect(!has_plan(result.status) || (std::isfinite(stamp) && is_finite(measured)),
                 "no plan is made from what is not finite");
  }
  // After any earlier inputs, a few good measurements must give a plan again.
  BodyStated level;
  level.position.z() = 1.5;
  NmpcStatus status = NmpcStatus::no_plan;
  for (int tick = 0; tick < 5; ++tick) {
    time += 0.01;
    (void)nmpc.prepare(
        time, [](double) { return hover(); }, in_the_air({}));
    const NmpcResult& result = nmpc.feedback(time, level);
    expect_within_bounds(result, nmpc.settings().problem.bounds);
    status = result.status;
  }
  fuzz::expect(has_plan(status), "good measurements are planned from");
  return 0;
}
