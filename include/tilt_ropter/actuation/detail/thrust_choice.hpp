// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/detail/allocation_settings.hpp>
#include <tilt_ropter/actuation/detail/thrust_limits.hpp>
#include <tilt_ropter/actuation/detail/thrust_search.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

/// Choice of thrusts if the minimum-norm thrusts are not usable.
namespace tilt_ropter::detail {

/// Thrusts [N] and how they were chosen.
template <int Rotors>
struct ChosenThrusts {
  AllocationStatus status = AllocationStatus::ok;
  Eigen::Matrix<double, 2 * Rotors, 1> thrusts;
  /// Arms whose thrust points beyond the end of the range and that wait at this end.
  std::array<bool, static_cast<std::size_t>(Rotors)> at_end{};
};

/// Steps 2 to 4 of Allocation: null space, end of the range, priorities. Only the constructor
/// allocates. Nothing throws.
template <int Rotors>
class ThrustChoice {
  using Search = ThrustSearch<Rotors>;
  using Request = typename Search::Request;
  using Answer = typename Search::Answer;
  using Parts = typename Search::Parts;

 public:
  using Limits = ThrustLimits<Rotors, double>;
  using Thrusts = typename Search::Thrusts;
  using Angles = Eigen::Matrix<double, Rotors, 1>;
  using Chosen = ChosenThrusts<Rotors>;

  ThrustChoice(const Vehicle<Rotors>& vehicle, const AllocationSettings& settings,
               const AllocationMatrix<Rotors>& allocation)
      : limits_(vehicle),
        search_(limits_, null_space(allocation)),
        pseudoinverse_(allocation.pseudoinverse),
        priorities_(settings.priorities),
        margin_(settings.range_end_margin),
        negligible_(2e-8 * largest_max_thrust(vehicle)) {
    double lever = 0.0;
    for (std::size_t i = 0; i < Rotors; ++i) {
      const RotorParameters& rotor = rotor_parameters(vehicle, i);
      lever += vehicle.rotors[i].position.norm() + rotor.torque_ratio;
      has_min_thrust_ = has_min_thrust_ || rotor.min_thrust > 0.0;
    }
    max_force_ = 2.0 * Rotors * largest_max_thrust(vehicle);
    max_torque_ = 2.0 * lever * largest_max_thrust(vehicle);
  }

  /// Same as ThrustLimits::set_max_thrust().
  void set_max_thrust(std::size_t i, double max_thrust) noexcept {
    limits_.set_max_thrust(i, max_thrust);
    search_.set_max_thrust(i, max_thrust);
  }

  /// Shortens a force or torque [N, N m] that is far out of reach. The shortened vector is still
  /// out of reach. This does not change the result and prevents overflow.
  template <typename Vector>
  [[nodiscard]] Vector shortened_force(const Vector& v) const noexcept {
    return shortened(v, max_force_);
  }
  template <typename Vector>
  [[nodiscard]] Vector shortened_torque(const Vector& v) const noexcept {
    return shortened(v, max_torque_);
  }

  /// Chooses thrusts for `wanted`. The minimum-norm thrusts `least` violate a limit or turn an arm
  /// over. `last` are the last angles [rad], in range. An arm whose thrust is below `faint` [N]
  /// never turns over.
  [[nodiscard]] Chosen choose(const Wrench<double>& wanted, const Thrusts& least,
                              const Angles& last, double faint) const noexcept {
    Request request;
    for (std::size_t g = 0; g < wrench_group_count; ++g)
      request.groups.col(static_cast<Eigen::Index>(g)) = group_thrusts(priorities_[g], wanted);
    Parts all, near;
    all.fill(AnglePart::whole);
    bool near_end = false;
    for (int i = 0; i < Rotors; ++i) {
      const auto rotor = static_cast<std::size_t>(i);
      request.near[rotor] = last(i);
      near[rotor] = limits_.tilts(i) ? limits_.part_of_end(last(i)) : AnglePart::whole;
      near_end = near_end || near[rotor] != AnglePart::whole;
    }

    Chosen chosen;
    Answer answer;
    chosen.status = AllocationStatus::null_space_used;
    if (reach(request, near, least, answer)) {
      chosen.thrusts = answer.thrusts;
      return chosen;
    }
    const bool within = contains(least, last);
    if (within || (near_end && reach(request, all, least, answer))) {
      if (within) {
        chosen.status = AllocationStatus::ok;
        answer.thrusts = least;
      }
      turn_over(request, near, last, least, answer.thrusts, faint, chosen);
      return chosen;
    }

    chosen.status = AllocationStatus::limited;
    if (answer.missing < Search::near_edge && reach(request, all, least, answer, true)) {
      chosen.thrusts = answer.thrusts;
      if (all_wait(answer.thrusts, last, faint, chosen.at_end))
        chosen.status = AllocationStatus::range_end_held;
      else
        chosen.at_end.fill(false);
      return chosen;
    }
    request.floors = false;
    search_.prioritise(request, near, answer);
    chosen.thrusts = answer.thrusts;
    if (!near_end) return chosen;
    Answer free;
    search_.prioritise(request, all, free);
    if (!Search::is_better(free.fractions, answer.fractions, 1e-6)) return chosen;
    std::array<bool, static_cast<std::size_t>(Rotors)> waiting{};
    const bool waits = all_wait(free.thrusts, last, faint, waiting);
    if (waits) chosen.at_end = waiting;
    if (waits || Search::is_better(free.fractions, answer.fractions, margin_))
      chosen.thrusts = free.thrusts;
    return chosen;
  }

  /// Angle [rad] by which `thrust` of rotor i points beyond the end of its range, if `last` is near
  /// this end. Returns zero within the range, for an arm farther from the end, and for a negligible
  /// loss.
  [[nodiscard]] double beyond_end(int i, const Eigen::Vector2d& thrust,
                                  double last) const noexcept {
    if (!limits_.tilts(i) || limits_.part_of_end(last) == AnglePart::whole) return 0.0;
    const double angle = Limits::unwrapped_angle(std::atan2(thrust.x(), thrust.y()), last);
    const double beyond = limits_.beyond_range(angle);
    return thrust.norm() * std::min(beyond, 1.0) > negligible_ ? beyond : 0.0;
  }

  /// Loss [N] of a rotor's thrust that rounding and the tolerance of the method may cause.
  [[nodiscard]] double negligible() const noexcept { return negligible_; }

 private:
  [[nodiscard]] static typename Search::Directions null_space(
      const AllocationMatrix<Rotors>& allocation) {
    typename Search::Directions directions = Search::Directions::Zero();
    for (Eigen::Index j = 0; j < allocation.null_space.cols(); ++j)
      directions.col(j) = allocation.null_space.col(j);
    return directions;
  }

  template <typename Vector>
  [[nodiscard]] static Vector shortened(const Vector& v, double limit) noexcept {
    const auto size = v.stableNorm();
    using Number = typename Vector::Scalar;
    return size > Number(limit) ? Vector(v / size * Number(limit)) : v;
  }

  [[nodiscard]] Thrusts group_thrusts(WrenchGroup group,
                                      const Wrench<double>& wanted) const noexcept {
    Vector3<double> force = Vector3<double>::Zero(), torque = Vector3<double>::Zero();
    if (group == WrenchGroup::level) torque.template head<2>() = wanted.torque.template head<2>();
    if (group == WrenchGroup::lift) force.z() = wanted.force.z();
    if (group == WrenchGroup::sideways) force.template head<2>() = wanted.force.template head<2>();
    if (group == WrenchGroup::yaw) torque.z() = wanted.torque.z();
    return pseudoinverse_.template leftCols<3>() * shortened_force(force) +
           pseudoinverse_.template rightCols<3>() * shortened_torque(torque);
  }

  /// Angle in range, nearest to `last`, along which the thrust of rotor i points [rad].
  [[nodiscard]] double angle_of(const Thrusts& thrusts, int i, double last) const noexcept {
    return limits_.nearest_angle(std::atan2(thrusts(2 * i), thrusts(2 * i + 1)), last);
  }

  [[nodiscard]] bool contains(const Thrusts& thrusts, const Angles& last) const noexcept {
    for (int i = 0; i < Rotors; ++i) {
      const Eigen::Vector2d thrust = thrusts.template segment<2>(2 * i);
      if (!limits_.contains(i, thrust)) return false;
      if (!has_min_thrust_ || !limits_.tilts(i)) continue;
      const Eigen::Vector2d unit = Limits::direction(angle_of(thrusts, i, last(i)));
      if (thrust.dot(unit) < limits_.min_thrust(i) - limits_.tolerance()) return false;
    }
    return true;
  }

  /// Searches thrusts for the whole wrench. First applies the min_thrust of tilting rotors along
  /// the directions of the minimum-norm thrusts. If that fails, applies min_thrust along the
  /// directions of thrusts that were found without min_thrust. Returns true if it finds thrusts.
  [[nodiscard]] bool reach(Request& request, const Parts& parts, const Thrusts& least,
                           Answer& answer, bool at_edge = false) const noexcept {
    request.floors = has_min_thrust_;
    if (!has_min_thrust_) return search_.reach(request, parts, at_edge, answer);
    Thrusts along = least;
    for (int attempt = 0; attempt < 3; ++attempt) {
      for (int i = 0; i < Rotors; ++i) {
        const auto rotor = static_cast<std::size_t>(i);
        request.floor_angles[rotor] = angle_of(along, i, request.near[rotor]);
      }
      request.floors = true;
      if (search_.reach(request, parts, at_edge, answer)) return true;
      if (attempt > 0) continue;
      request.floors = false;
      if (!search_.reach(request, parts, at_edge, answer)) return false;
      along = answer.thrusts;
    }
    return false;
  }

  /// Marks the arms whose thrust points beyond the end of the range. Returns true if there are such
  /// arms and each of them may wait. An arm may wait if it is less than the margin beyond the end,
  /// or if its thrust is below `faint`.
  [[nodiscard]] bool all_wait(
      const Thrusts& thrusts, const Angles& last, double faint,
      std::array<bool, static_cast<std::size_t>(Rotors)>& beyond_range) const noexcept {
    bool any = false, all = true;
    for (int i = 0; i < Rotors; ++i) {
      const Eigen::Vector2d thrust = thrusts.template segment<2>(2 * i);
      const double beyond = beyond_end(i, thrust, last(i));
      beyond_range[static_cast<std::size_t>(i)] = beyond > 0.0;
      any = any || beyond > 0.0;
      all = all && (beyond < margin_ || thrust.norm() < faint);
    }
    return any && all;
  }

  /// Handles `thrusts` that give the wrench but turn arms over. If all these arms may wait, they
  /// wait at the end. Otherwise the smallest number of arms that gives the wrench turns over,
  /// starting with the arm farthest beyond the end.
  void turn_over(Request& request, Parts parts, const Angles& last, const Thrusts& least,
                 const Thrusts& thrusts, double faint, Chosen& chosen) const noexcept {
    chosen.thrusts = thrusts;
    std::array<bool, static_cast<std::size_t>(Rotors)> beyond{};
    if (all_wait(thrusts, last, faint, beyond)) {
      chosen.at_end = beyond;
      chosen.status = AllocationStatus::range_end_held;
      return;
    }
    for (auto left = std::count(beyond.begin(), beyond.end(), true); left > 1; --left) {
      int farthest = 0;
      double most = -1.0;
      for (int i = 0; i < Rotors; ++i) {
        const double by = beyond_end(i, thrusts.template segment<2>(2 * i), last(i));
        if (!beyond[static_cast<std::size_t>(i)] || by <= most) continue;
        most = by;
        farthest = i;
      }
      beyond[static_cast<std::size_t>(farthest)] = false;
      parts[static_cast<std::size_t>(farthest)] = AnglePart::whole;
      Answer answer;
      if (!reach(request, parts, least, answer)) continue;
      chosen.thrusts = answer.thrusts;
      chosen.status = AllocationStatus::null_space_used;
      return;
    }
  }

  Limits limits_;
  Search search_;
  Eigen::Matrix<double, 2 * Rotors, 6> pseudoinverse_;
  std::array<WrenchGroup, wrench_group_count> priorities_;
  double margin_, negligible_;
  bool has_min_thrust_ = false;
  double max_force_, max_torque_;
};

}  // namespace tilt_ropter::detail
