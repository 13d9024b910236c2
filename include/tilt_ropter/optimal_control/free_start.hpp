// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/simd.hpp>

#include <Eigen/Core>

#include <utility>

/// Problems whose initial state the solver chooses.
namespace tilt_ropter::optimal_control {

// A member of the user's problem may have the name of a variable below.
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wshadow"

/// A struct for AutoDiffProblem, made from another one, `User`: some states of its first node are
/// free. This also makes parameters, which are states that never change: the time of a phase, for
/// example, that the lengths of its intervals are multiples of.
///
/// `User` has, besides the members that AutoDiffProblem describes,
///
///     static constexpr std::array<int, ...> free_states;  // the indices of the free states
///
/// Intervals in front of those of `User` move the free states from the initial state that solve()
/// is given, which is then a guess of them, by one input for each. They have no cost and no
/// constraints, so cost and constraints of `User` must determine the free states. `in_front` is
/// their number: node k of `User` is node in_front + k of this problem. Its functions allocate and
/// throw where those of `User` do.
template <typename User>
struct FreeStart : User {
  template <typename S, int Size>
  using Vector = Eigen::Matrix<S, Size, 1>;

  static constexpr int free = static_cast<int>(User::free_states.size()),
                       in_front = (free + User::inputs - 1) / User::inputs;

  explicit FreeStart(User user = User()) : User(std::move(user)) {}

  [[nodiscard]] int horizon() const { return in_front + User::horizon(); }

  template <typename S>
  [[nodiscard]] Vector<S, User::states> step(int k, const Vector<S, User::states>& x,
                                             const Vector<S, User::inputs>& u) const {
    if (k >= in_front) return User::step(k - in_front, x, u);
    Vector<S, User::states> moved = x;
    for (int i = 0; i < User::inputs; ++i) {
      const int which = User::inputs * k + i;
      if (which < free) moved(User::free_states[detail::size(which)]) += u(i);
    }
    return moved;
  }

  // The members that `User` may or may not have exist here if they exist there.
  template <typename S, typename U = User>
  [[nodiscard]] Vector<S, U::residuals> residual(int k, const Vector<S, User::states>& x,
                                                 const Vector<S, User::inputs>& u) const {
    if (k >= in_front) return User::residual(k - in_front, x, u);
    return constant<S, U::residuals>(x, u);
  }
  template <typename S, typename U = User>
  [[nodiscard]] auto cost(int k, const Vector<S, User::states>& x,
                          const Vector<S, User::inputs>& u) const
      -> decltype(std::declval<const U&>().cost(k, x, u)) {
    if (k >= in_front) return User::cost(k - in_front, x, u);
    return constant<S, 1>(x, u)(0);
  }
  template <typename S, typename U = User>
  [[nodiscard]] Vector<S, U::constraints> constraint_values(
      int k, const Vector<S, User::states>& x, const Vector<S, User::inputs>& u) const {
    if (k >= in_front) return User::constraint_values(k - in_front, x, u);
    return constant<S, U::constraints>(x, u);
  }
  template <typename U = User>
  [[nodiscard]] auto lower(int k) const -> decltype(std::declval<const U&>().lower(k)) {
    if (k >= in_front) return User::lower(k - in_front);
    return decltype(std::declval<const U&>().lower(k))::Constant(-detail::infinity);
  }
  template <typename U = User>
  [[nodiscard]] auto upper(int k) const -> decltype(std::declval<const U&>().upper(k)) {
    if (k >= in_front) return User::upper(k - in_front);
    return decltype(std::declval<const U&>().upper(k))::Constant(detail::infinity);
  }
  template <typename U = User>
  [[nodiscard]] auto penalty(int k) const -> decltype(std::declval<const U&>().penalty(k)) {
    return User::penalty(k >= in_front ? k - in_front : 0);
  }
  template <typename U = User>
  [[nodiscard]] auto stiffness(int k) const -> decltype(std::declval<const U&>().stiffness(k)) {
    return User::stiffness(k >= in_front ? k - in_front : 0);
  }

 private:
  // Zeros with the derivatives of a constant, which a number alone does not have.
  template <typename S, int Size>
  static Vector<S, Size> constant(const Vector<S, User::states>& x,
                                  const Vector<S, User::inputs>& u) {
    Vector<S, Size> zeros;
    for (int i = 0; i < Size; ++i) zeros(i) = S(0.0) * (x(0) + u(0));
    return zeros;
  }
};
#pragma GCC diagnostic pop

}  // namespace tilt_ropter::optimal_control
