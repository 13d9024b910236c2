// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/detail/thrust_limits.hpp>
#include <tilt_ropter/actuation/detail/thrust_program.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

/// Search for thrusts within limits if the minimum-norm thrusts are not within limits.
namespace tilt_ropter::detail {

/// Number of groups of wrench components that are scaled together.
inline constexpr int wrench_groups = 4;

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
  using Groups = Eigen::Matrix<double, components, wrench_groups>;
  using Fractions = std::array<double, static_cast<std::size_t>(wrench_groups)>;
  using Parts = std::array<AnglePart, static_cast<std::size_t>(Rotors)>;
  using Angles = std::array<double, static_cast<std::size_t>(Rotors)>;
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
      used_[static_cast<std::size_t>(i)] = most > 0.0;
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
    std::array<Parts, static_cast<std::size_t>(Rotors) + 2> waiting;
    std::size_t count = 0;
    waiting[count++] = parts;
    for (int node = 0; node < max_nodes && count > 0; ++node) {
      Parts now = waiting[--count];
      if (!reach_convex(request, now, at_edge, answer)) continue;
      const int worst = farthest_out(now, answer.thrusts);
      if (worst < 0) return true;
      // The part near the rotor's angle is searched first, so it goes on top of the stack.
      AnglePart& part = now[static_cast<std::size_t>(worst)];
      const AnglePart first = limits_.nearest_part(request.near[static_cast<std::size_t>(worst)]);
      part = first == AnglePart::upper ? AnglePart::lower : AnglePart::upper;
      waiting[count++] = now;
      part = first;
      waiting[count++] = now;
    }
    return false;
  }

  /// Finds thrusts for the largest fraction in [0, 1] of the first group, then of the second group
  /// with the first fixed, and so on. Meanwhile the fractions of later groups are free in [0, 1].
  /// Finally minimises |y|. Fractions may be below the largest value by `back_off`. They may also
  /// be lower if the set is not convex and `max_splits` programs do not decide.
  void prioritise(const Request& request, const Parts& parts, Answer& answer) const noexcept {
    std::array<Parts, static_cast<std::size_t>(Rotors) + max_splits> waiting;
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
      // The nearest half turn is searched first, so it goes on top of the stack.
      AnglePart& part = now[static_cast<std::size_t>(worst)];
      const double angle =
          std::atan2(candidate.thrusts(2 * worst), candidate.thrusts(2 * worst + 1));
      const double near = request.near[static_cast<std::size_t>(worst)];
      const AnglePart first = limits_.nearest_part(limits_.nearest_angle(angle, near));
      part = first == AnglePart::upper ? AnglePart::lower : AnglePart::upper;
      waiting[count++] = now;
      part = first;
      waiting[count++] = now;
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
  static constexpr int fraction = directions, tau = directions + wrench_groups;
  static constexpr int variables = tau + 1;
  using Program = ThrustProgram<Rotors, variables, wrench_groups + 1>;
  using Vector = typename Program::Vector;
  static constexpr double tolerance = 1e-10, back_off = 1e-6;

  /// Rotor whose thrust is farthest out of its range, among the rotors whose hull was searched.
  /// Returns -1 if there is none.
  [[nodiscard]] int farthest_out(const Parts& parts, const Thrusts& thrusts) const noexcept {
    if (limits_.convex()) return -1;
    int worst = -1;
    double most = 0.0;
    for (int i = 0; i < Rotors; ++i) {
      if (!limits_.tilts(i) || parts[static_cast<std::size_t>(i)] != AnglePart::whole) continue;
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
      const auto rotor = static_cast<std::size_t>(i);
      if (!used_[rotor]) continue;
      program.regions[rotor] =
          limits_.region(i, parts[rotor], request.floors, request.floor_angles[rotor], wider);
      const double most = limits_.max_thrust(i);
      for (int row = 2 * i; row < 2 * i + 2; ++row) {
        for (int j = 0; j < directions; ++j)
          program.columns(row, j) = null_space_(row, j) * (unit_ / most);
        double sum = 0.0;
        for (int g = 0; g < wrench_groups; ++g) {
          program.columns(row, fraction + g) = request.groups(row, g) / most;
          sum += initial * program.columns(row, fraction + g);
        }
        program.columns(row, tau) = program.regions[rotor].center(row - 2 * i) - sum;
      }
    }
    z.setZero();
    for (int j = 0; j < variables; ++j) program.release(j);
    for (int g = 0; g < wrench_groups; ++g) {
      z(fraction + g) = initial;
      program.lower[static_cast<std::size_t>(g)] = 0.0;
      program.upper[static_cast<std::size_t>(g)] = 1.0;
    }
    z(tau) = 1.0;
    program.lower.back() = -1.0;
    program.upper.back() = 2.0;
  }

  void read(const Program& program, const Vector& z, Thrusts& thrusts) const noexcept {
    thrusts = program.base + program.columns * z;
    for (int i = 0; i < Rotors; ++i) thrusts.template segment<2>(2 * i) *= limits_.max_thrust(i);
  }

  [[nodiscard]] bool reach_convex(const Request& request, const Parts& parts, bool at_edge,
                                  Answer& answer) const noexcept {
    // At the edge: first within limits, then within wider limits, then once more with smaller
    // steps.
    Program program;
    Vector z;
    bool reached = false;
    for (int attempt = 0; attempt < (at_edge ? 3 : 1); ++attempt) {
      start(request, parts, 1.0, attempt > 0 ? edge : 0.0, program, z);
      program.cautious = attempt > 1;
      for (int g = 0; g < wrench_groups; ++g) program.fix(fraction + g, z);
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
      for (int g = 0; g < wrench_groups; ++g) {
        if (request.groups.col(g).squaredNorm() > 0.0) continue;
        z(fraction + g) = 1.0;
        program.fix(fraction + g, z);
      }
      inside = program.push(tau, -1.0, 0.0, wider <= 0.0, 0.1 * widening, z);
    }
    program.fix(tau, z);
    for (int g = 0; g < wrench_groups; ++g) {
      const auto group = static_cast<std::size_t>(g);
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
  std::array<bool, static_cast<std::size_t>(Rotors)> used_{};
};

}  // namespace tilt_ropter::detail
