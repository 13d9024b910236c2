// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/detail/reference_wrench.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

/// Checks, before a flight, whether a reference needs more than the bounds allow.
namespace tilt_ropter {

/// The largest violation of one bound on one axis.
struct BoundViolation {
  /// "force", "torque", "angular_velocity", "force_rate", "torque_rate"; "position" [m] and
  /// "orientation" [rad] are steps, that is, changes that do not follow from velocity and angular
  /// velocity.
  const char* bound;
  int axis;         ///< 0, 1, 2: body x, y, z
  double time;      ///< time of the violation [s]
  double required;  ///< value that the reference needs, in the bound's unit
  double allowed;   ///< the violated bound
};

/// Computes the wrench, wrench rate and body rate of a reference by inverse dynamics. Compares them
/// with the bounds of `settings`, every `step` [s] from `start` to `end` [s]. `plane` is the
/// ground. On the ground the reference is moved onto `plane`, and the ground provides the forces of
/// the undercarriage. The rest must be within the bounds. At take-off and landing the change of
/// force must fit into the horizon. A step of position above 2 cm or of attitude above 0.02 rad
/// counts as a violation, because no vehicle can follow it. Returns the violations, empty if there
/// are none. Allocates. Throws std::invalid_argument if the vehicle, settings, times or the plane
/// are out of range.
template <typename Reference, int Rotors>
[[nodiscard]] std::vector<BoundViolation> check_reference(
    const Reference& reference, double start, double end, const Vehicle<Rotors>& vehicle,
    const NmpcSettings& settings, double step = 0.01, const GroundPlane& plane = {}) {
  validate(vehicle);
  validate(settings);
  require_positive("check_reference.step [s]", step);
  require(std::isfinite(start) && std::isfinite(end) && end > start, "check_reference.end [s]", end,
          "finite and > start");
  require_finite("check_reference.plane.height [m]", plane.height);
  require_finite("check_reference.plane.slope", plane.slope);

  GroundContactSettings ground_settings = settings.ground;
  ground_settings.model = GroundModel::held;  // what the ground gives needs no thrust
  const ReferenceWrench<Rotors> reference_wrench(vehicle, ground_settings);
  const GroundContact& ground = reference_wrench.ground();
  ContactEstimate contact;
  contact.ground = plane;
  const NmpcBounds& bounds = settings.problem.bounds;
  static constexpr std::array<const char*, 7> names = {
      "force",       "torque",   "angular_velocity", "force_rate",
      "torque_rate", "position", "orientation"};
  const Eigen::Vector3d largest_step = Eigen::Vector3d::Constant(0.02);  // [m], [rad]
  std::array<BoundViolation, 3 * names.size()> worst{};
  std::array<double, 3 * names.size()> excess{};
  const auto compare = [&](std::size_t bound, double time, const Eigen::Vector3d& required,
                           const Eigen::Vector3d& lower, const Eigen::Vector3d& upper) {
    for (int axis = 0; axis < 3; ++axis) {
      const double over = required(axis) - upper(axis), under = lower(axis) - required(axis);
      const std::size_t i = 3 * bound + static_cast<std::size_t>(axis);
      if (std::fmax(over, under) <= excess[i]) continue;
      excess[i] = std::fmax(over, under);
      worst[i] = {names[bound], axis, time, required(axis),
                  over > under ? upper(axis) : lower(axis)};
    }
  };

  const double horizon = settings.problem.intervals * settings.problem.interval;
  Wrenchd last;
  ReferencePoint last_point;
  bool last_on_ground = false;
  const long samples = std::lround(std::ceil((end - start) / step));
  for (long i = 0; i <= samples; ++i) {
    const double time = start + step * static_cast<double>(i);
    const ReferencePoint point = reference(time);
    const bool on_ground = ground.is_ground_reference(contact, point.position, point);
    const Eigen::Vector3d& w = point.angular_velocity;
    const Wrenchd needed =
        reference_wrench(on_ground ? ground.on_ground(plane, point) : point, {}, on_ground);
    compare(0, time, needed.force, bounds.force_min, bounds.force_max);
    compare(1, time, needed.torque, bounds.torque_min, bounds.torque_max);
    compare(2, time, w, -bounds.angular_velocity, bounds.angular_velocity);
    if (i > 0) {
      const double duration = on_ground == last_on_ground ? step : horizon;
      const Eigen::Vector3d force_rate = (needed.force - last.force) / duration,
                            torque_rate = (needed.torque - last.torque) / duration;
      compare(3, time, force_rate, -bounds.force_rate, bounds.force_rate);
      compare(4, time, torque_rate, -bounds.torque_rate, bounds.torque_rate);
      const Eigen::Vector3d moved = point.position - last_point.position -
                                    0.5 * step * (point.velocity + last_point.velocity),
                            turned = quaternion_log(Eigen::Quaterniond(
                                         last_point.orientation.conjugate() * point.orientation)) -
                                     0.5 * step * (w + last_point.angular_velocity);
      compare(5, time, moved, -largest_step, largest_step);
      compare(6, time, turned, -largest_step, largest_step);
    }
    last = needed;
    last_point = point;
    last_on_ground = on_ground;
  }

  std::vector<BoundViolation> violations;
  for (std::size_t i = 0; i < worst.size(); ++i)
    if (excess[i] > 0.0) violations.push_back(worst[i]);
  return violations;
}

/// Uses the default settings of Nmpc for this vehicle.
template <typename Reference, int Rotors>
[[nodiscard]] std::vector<BoundViolation> check_reference(const Reference& reference, double start,
                                                          double end,
                                                          const Vehicle<Rotors>& vehicle) {
  return check_reference(reference, start, end, vehicle, nmpc_settings(vehicle));
}

}  // namespace tilt_ropter
