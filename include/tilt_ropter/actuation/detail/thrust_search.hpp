// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/actuation/detail/allocation_settings.hpp>
#include <tilt_ropter/actuation/detail/thrust_limits.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

/// Search for thrusts within limits if the minimum-norm thrusts are not within limits.
namespace tilt_ropter::detail {

/// Searches T = sum_g fraction_g G_g + N y within limits. N is the null space of the allocation
/// matrix. G_g are the minimum-norm thrusts of one group of the wrench.
///
/// The program of ThrustProgram has the variables z = (y, fractions, tau). Its thrusts are
/// T = sum_g fraction_g G_g + N y + tau (T_c - ...). With tau = 1 they are T_c, the centers of all
/// regions. Every search therefore starts strictly inside, and tau is driven to zero first.
///
/// The set of a range between half a turn and a whole turn is not convex. The search then starts
/// from convex hulls. It splits the hull that the answer violates most into two half turns (branch
/// and bound). At most `max_nodes` programs are solved. Nothing throws or allocates.
template <int Rotors>
class ThrustSearch {
 public:
  static constexpr int components = 2 * Rotors;
  static constexpr int directions = components - 6;
  static constexpr int max_nodes = 512, max_splits = 40;
  using Thrusts = Eigen::Matrix<double, components, 1>;
  using Directions = Eigen::Matrix<double, components, directions>;
  using Groups = Eigen::Matrix<double, components, wrench_group_count>;
  using Fractions = std::array<double, size(wrench_group_count)>;
  using Parts = std::array<AnglePart, size(Rotors)>;
  using Angles = std::array<double, size(Rotors)>;
  using Limits = ThrustLimits<Rotors, double>;

  /// Amount by which thrusts may exceed their limits, in units of max_thrust. A wrench at the very
  /// edge of reach then still leaves room for the interior-point method. Callers clamp the thrusts.
  static constexpr double edge = 5e-9, widening = 1e-8;
  /// Largest value of Answer::missing at which `edge` may help.
  static constexpr double near_edge = 1e-2;

  /// Input of a search.
  struct Request {
    Groups groups;        ///< G_g [N]; the first group has priority
    Angles floor_angles;  ///< tilt angles along which min_thrust is enforced [rad]
    Angles near;          ///< angles that the answer should be near [rad]
    bool floors;          ///< true: enforce the min_thrust of tilting rotors
  };

  struct Answer {
    Thrusts thrusts;       ///< [N]
    Fractions fractions;   ///< fraction of each group
    double missing = 1.0;  ///< after reach() failed: remaining tau, from 1 (start) to 0 (reached)
  };

  /// `null_space` has orthonormal columns; unused columns are zero.
  ThrustSearch(const Limits& limits, const Directions& null_space)
      : limits_(limits), null_space_(null_space) {
    for (int i = 0; i < Rotors; ++i) {
      const double most = limits_.max_thrust(i);
      used_[size(i)] = most > 0.0;
      unit_ = std::max(unit_, most);
    }
  }

  /// Same as ThrustLimits::set_max_thrust().
  void set_max_thrust(std::size_t i, double max_thrust) noexcept {
    limits_.set_max_thrust(i, max_thrust);
  }

  /// Finds thrusts for all groups in full, with the least change |y|, within `parts`. With
  /// `at_edge` the limits are wider by `edge`. Returns true if it finds thrusts.
  [[nodiscard]] bool reach(const Request& request, const Parts& parts, bool at_edge,
                           Answer& answer) const noexcept {
    answer.fractions.fill(1.0);
    answer.missing = 1.0;
    // Depth-first search: one node waits for each rotor that was split.
    std::array<Parts, size(Rotors) + 2> waiting;
    std::size_t count = 0;
    waiting[count++] = parts;
    for (int node = 0; node < max_nodes && count > 0; ++node) {
      Parts now = waiting[--count];
      if (!reach_convex(request, now, at_edge, answer)) continue;
      const int worst = farthest_out(now, answer.thrusts);
      if (worst < 0) return true;
      split(now, worst, request.near[size(worst)], &waiting[count]);
      count += 2;
    }
    return false;
  }

  /// Finds thrusts for the largest fraction in [0, 1] of the first group, then of the second group
  /// with the first fixed, and so on. Meanwhile the fractions of later groups are free in [0, 1].
  /// Finally minimises |y|. Fractions may be below the largest value by `back_off`. They may also
  /// be lower if the set is not convex and `max_splits` programs do not decide.
  void prioritise(const Request& request, const Parts& parts, Answer& answer) const noexcept {
    std::array<Parts, size(Rotors) + max_splits> waiting;
    std::size_t count = 0;
    waiting[count++] = parts;
    bool found = false;
    for (int node = 0; count > 0 && (node < max_splits || !found); ++node) {
      Parts now = waiting[--count];
      Answer candidate;
      prioritise_convex(request, now, candidate);
      if (found && !is_better(candidate.fractions, answer.fractions, 1e-3)) continue;
      const int worst = farthest_out(now, candidate.thrusts);
      if (worst < 0) {
        answer = candidate;
        found = true;
        continue;
      }
      const double angle =
          std::atan2(candidate.thrusts(2 * worst), candidate.thrusts(2 * worst + 1));
      split(now, worst, limits_.nearest_angle(angle, request.near[size(worst)]), &waiting[count]);
      count += 2;
    }
  }

  /// Returns true if the first fraction that differs by more than `margin` is larger in `a`.
  [[nodiscard]] static bool is_better(const Fractions& a, const Fractions& b,
                                      double margin) noexcept {
    for (std::size_t g = 0; g < a.size(); ++g)
      if (std::abs(a[g] - b[g]) > margin) return a[g] > b[g];
    return false;
  }

 private:
  static constexpr int fraction = directions, tau = directions + wrench_group_count;
  static constexpr int variables = tau + 1;
  using Program = ThrustProgram<Rotors, variables, wrench_group_count + 1>;
  using Vector = typename Program::Vector;
  static constexpr double tolerance = 1e-10, back_off = 1e-6;

  /// Replaces the whole range of a rotor by its two parts. The one nearest to `angle` is searched
  /// first, so it goes on top of the stack.
  void split(const Parts& parts, int rotor, double angle, Parts* stack) const noexcept {
    const AnglePart first = limits_.nearest_part(angle);
    stack[0] = stack[1] = parts;
    stack[0][size(rotor)] = first == AnglePart::upper ? AnglePart::lower : AnglePart::upper;
    stack[1][size(rotor)] = first;
  }

  /// Rotor whose thrust is farthest out of its range, of those whose hull was searched, or -1.
  [[nodiscard]] int farthest_out(const Parts& parts, const Thrusts& thrusts) const noexcept {
    if (limits_.convex()) return -1;
    int worst = -1;
    double most = 0.0;
    for (int i = 0; i < Rotors; ++i) {
      if (!limits_.tilts(i) || parts[size(i)] != AnglePart::whole) continue;
      const double out = limits_.out_of_range(thrusts.template segment<2>(2 * i));
      if (out > most) {
        most = out;
        worst = i;
      }
    }
    return worst;
  }

  /// Sets up the program and its start `z`: y = 0, all fractions `initial` and tau = 1.
  void start(const Request& request, const Parts& parts, double initial, double wider,
             Program& program, Vector& z) const noexcept {
    program.base.setZero();
    program.columns.setZero();
    program.used = used_;
    for (int i = 0; i < Rotors; ++i) {
      const auto rotor = size(i);
      if (!used_[rotor]) continue;
      program.regions[rotor] =
          limits_.region(i, parts[rotor], request.floors, request.floor_angles[rotor], wider);
      const double most = limits_.max_thrust(i);
      for (int row = 2 * i; row < 2 * i + 2; ++row) {
        for (int j = 0; j < directions; ++j)
          program.columns(row, j) = null_space_(row, j) * (unit_ / most);
        double sum = 0.0;
        for (int g = 0; g < wrench_group_count; ++g) {
          program.columns(row, fraction + g) = request.groups(row, g) / most;
          sum += initial * program.columns(row, fraction + g);
        }
        program.columns(row, tau) = program.regions[rotor].center(row - 2 * i) - sum;
      }
    }
    z.setZero();
    for (int j = 0; j < variables; ++j) program.release(j);
    for (int g = 0; g < wrench_group_count; ++g) {
      z(fraction + g) = initial;
      program.lower[size(g)] = 0.0;
      program.upper[size(g)] = 1.0;
    }
    z(tau) = 1.0;
    program.lower.back() = -1.0;
    program.upper.back() = 2.0;
  }

  void read(const Program& program, const Vector& z, Thrusts& thrusts) const noexcept {
    thrusts = program.thrusts(z);
    for (int i = 0; i < components; ++i) thrusts(i) *= limits_.max_thrust(i / 2);
  }

  [[nodiscard]] bool reach_convex(const Request& request, const Parts& parts, bool at_edge,
                                  Answer& answer) const noexcept {
    // At the edge: first within limits, then within wider limits, then with smaller steps.
    Program program;
    Vector z;
    bool reached = false;
    for (int attempt = 0; attempt < (at_edge ? 3 : 1); ++attempt) {
      start(request, parts, 1.0, attempt > 0 ? edge : 0.0, program, z);
      program.cautious = attempt > 1;
      for (int g = 0; g < wrench_group_count; ++g) program.fix(fraction + g, z);
      reached = program.push(tau, -1.0, 0.0, true, tolerance, z);
      answer.missing = std::min(answer.missing, z(tau));
      if (reached || z(tau) > near_edge) break;
    }
    if (!reached) return false;
    program.fix(tau, z);
    program.shorten(1e-3 * tolerance, z);
    read(program, z, answer.thrusts);
    return true;
  }

  void prioritise_convex(const Request& request, const Parts& parts,
                         Answer& answer) const noexcept {
    Program program;
    Vector z;
    bool inside = false;
    for (const double wider : {0.0, widening}) {
      if (inside) break;
      start(request, parts, 0.5, wider, program, z);
      for (int g = 0; g < wrench_group_count; ++g) {
        if (largest(request.groups.col(g)) > 0.0) continue;
        z(fraction + g) = 1.0;
        program.fix(fraction + g, z);
      }
      inside = program.push(tau, -1.0, 0.0, wider <= 0.0, 0.1 * widening, z);
    }
    program.fix(tau, z);
    for (int g = 0; g < wrench_group_count; ++g) {
      const auto group = size(g);
      if (program.is_free(fraction + g)) {
        program.upper[group] = 2.0;
        (void)program.push(fraction + g, 1.0, 1.0, false, back_off, z);
        program.fix(fraction + g, z);
      }
      answer.fractions[group] = z(fraction + g);
    }
    program.shorten(1e-3 * tolerance, z);
    read(program, z, answer.thrusts);
  }

  Limits limits_;
  Directions null_space_;
  double unit_ = 0.0;
  std::array<bool, size(Rotors)> used_{};
};

/// Steps 2 to 4 of Allocation: null space, end of the range, priorities. Nothing throws.
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

  /// Thrusts [N] and how they were chosen.
  struct Chosen {
    AllocationStatus status = AllocationStatus::ok;
    Thrusts thrusts;
    /// Arms whose thrust points beyond the end of the range and that wait at this end.
    std::array<bool, size(Rotors)> at_end{};
  };

  ThrustChoice(const Vehicle<Rotors>& vehicle, const AllocationSettings& settings,
               const AllocationMatrix<Rotors>& allocation)
      : limits_(vehicle),
        search_(limits_, null_space(allocation)),
        pseudoinverse_(allocation.pseudoinverse),
        priorities_(settings.priorities),
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

  /// Shortens a force or torque that is far out of reach. The shortened vector is still out of
  /// reach. This does not change the result and prevents overflow.
  template <typename Scalar>
  [[nodiscard]] Wrench<Scalar> shortened(const Wrench<Scalar>& w) const noexcept {
    return {shortened(w.force, max_force_), shortened(w.torque, max_torque_)};
  }

  /// Chooses thrusts for `wanted`. The minimum-norm thrusts `least` violate a limit or turn an arm
  /// over. `last`: the last angles [rad], in range. Arms below `faint` [N] never turn over.
  [[nodiscard]] Chosen choose(const Wrench<double>& wanted, const Thrusts& least,
                              const Angles& last, double faint) const noexcept {
    Request request;
    for (int g = 0; g < wrench_group_count; ++g)
      request.groups.col(g) = group_thrusts(priorities_[size(g)], wanted);
    Parts all, near;
    all.fill(AnglePart::whole);
    bool near_end = false;
    for (int i = 0; i < Rotors; ++i) {
      const auto rotor = size(i);
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
    std::array<bool, size(Rotors)> waiting{};
    const bool waits = all_wait(free.thrusts, last, faint, waiting);
    if (waits) chosen.at_end = waiting;
    if (waits ||
        Search::is_better(free.fractions, answer.fractions, AllocationSettings::range_end_margin))
      chosen.thrusts = free.thrusts;
    return chosen;
  }

  /// Angle [rad] by which `thrust` of rotor i points beyond the end of its range, if `last` is near
  /// this end. Zero within the range, for an arm farther from the end, and for a negligible loss.
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
    std::copy_n(allocation.null_space.data(), allocation.null_space.size(), directions.data());
    return directions;
  }

  template <typename Scalar>
  [[nodiscard]] static Vector3<Scalar> shortened(const Vector3<Scalar>& v, double limit) noexcept {
    using std::hypot;  // of two numbers: that of three overflows in libc++ 14, as a square does
    const Scalar factor = Scalar(limit) / hypot(v.x(), hypot(v.y(), v.z()));
    return factor < Scalar(1) ? Vector3<Scalar>(v * factor) : v;
  }

  [[nodiscard]] Thrusts group_thrusts(WrenchGroup group,
                                      const Wrench<double>& wanted) const noexcept {
    Wrenchd part;
    if (group == WrenchGroup::level) part.torque.head<2>() = wanted.torque.head<2>();
    if (group == WrenchGroup::lift) part.force.z() = wanted.force.z();
    if (group == WrenchGroup::sideways) part.force.head<2>() = wanted.force.head<2>();
    if (group == WrenchGroup::yaw) part.torque.z() = wanted.torque.z();
    part = shortened(part);
    return least_thrusts(pseudoinverse_, part);
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
        const auto rotor = size(i);
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

  /// Marks the arms whose thrust points beyond the end of the range. Returns true if there are any
  /// and each may wait: it is less than the margin beyond the end, or its thrust is below `faint`.
  [[nodiscard]] bool all_wait(const Thrusts& thrusts, const Angles& last, double faint,
                              std::array<bool, size(Rotors)>& beyond_range) const noexcept {
    bool any = false, all = true;
    for (int i = 0; i < Rotors; ++i) {
      const Eigen::Vector2d thrust = thrusts.template segment<2>(2 * i);
      const double beyond = beyond_end(i, thrust, last(i));
      beyond_range[size(i)] = beyond > 0.0;
      any = any || beyond > 0.0;
      all = all && (beyond < AllocationSettings::range_end_margin || thrust.norm() < faint);
    }
    return any && all;
  }

  /// Handles `thrusts` that give the wrench but turn arms over. If all of these may wait, they do.
  /// Otherwise the smallest number that gives the wrench turns over, from the farthest on.
  void turn_over(Request& request, Parts parts, const Angles& last, const Thrusts& least,
                 const Thrusts& thrusts, double faint, Chosen& chosen) const noexcept {
    chosen.thrusts = thrusts;
    std::array<bool, size(Rotors)> beyond{};
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
        if (!beyond[size(i)] || by <= most) continue;
        most = by;
        farthest = i;
      }
      beyond[size(farthest)] = false;
      parts[size(farthest)] = AnglePart::whole;
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
  double negligible_;
  bool has_min_thrust_ = false;
  double max_force_, max_torque_;
};

}  // namespace tilt_ropter::detail
