#pragma once

#include "support/guessed_problems.hpp"

#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

// The header of Debian asks for this where <cstddef> is present.
#ifndef HAVE_CSTDDEF
#define HAVE_CSTDDEF
#endif
#include <coin/IpIpoptApplication.hpp>
#include <coin/IpTNLP.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>

/// IPOPT as an independent solver of the problems of guessed_problems.hpp.
namespace test_support {

/// Direct multiple shooting as a sparse nonlinear program. Variables: the inputs and end states of
/// all intervals, in order. Rows: the defects and constraints of each interval, then the end.
template <typename User>
class IpoptProgram : public Ipopt::TNLP {
 public:
  IpoptProgram(const User& user, const PlanOf<User>& guess)
      : user_(user), problem_(user), plan_(guess) {}

  [[nodiscard]] const PlanOf<User>& plan() const { return plan_; }

  bool get_nlp_info(int& variables, int& rows, int& nonzeros, int& hessian,
                    IndexStyleEnum& style) override {
    variables = n * per_interval;
    rows = n * rows_per_interval + ends;
    nonzeros = n * rows_per_interval * (nx + per_interval) + ends * nx;
    hessian = 0;
    style = C_STYLE;
    return true;
  }
  bool get_bounds_info(int variables, double* lower, double* upper, int /*rows*/, double* row_lower,
                       double* row_upper) override {
    std::fill_n(lower, variables, -2e19);
    std::fill_n(upper, variables, 2e19);
    int row = 0;
    for (int k = 0; k < n; ++k) {
      for (int i = 0; i < nx; ++i, ++row) row_lower[row] = row_upper[row] = 0.0;
      for (int i = 0; i < nc; ++i, ++row) {
        row_lower[row] = std::max(user_.lower(k)(i), -2e19);
        row_upper[row] = std::min(user_.upper(k)(i), 2e19);
      }
    }
    for (int i = 0; i < ends; ++i, ++row) row_lower[row] = row_upper[row] = 0.0;
    return true;
  }
  bool get_starting_point(int /*variables*/, bool /*init_x*/, double* z, bool /*init_z*/,
                          double* /*z_lower*/, double* /*z_upper*/, int /*rows*/, bool /*init*/,
                          double* /*multipliers*/) override {
    for (int k = 0; k < n; ++k) {
      const auto at = static_cast<std::size_t>(k);
      for (int i = 0; i < nu; ++i) *z++ = plan_.inputs[at](i);
      for (int i = 0; i < nx; ++i) *z++ = plan_.states[at + 1](i);
    }
    return true;
  }
  bool eval_f(int /*variables*/, const double* z, bool /*is_new*/, double& value) override {
    take(z);
    value = value_of(user_, plan_).cost;
    return std::isfinite(value);
  }
  bool eval_grad_f(int /*variables*/, const double* z, bool /*is_new*/, double* gradient) override {
    take(z);
    Model model;
    for (int k = 0; k <= n; ++k) {
      const auto at = static_cast<std::size_t>(k);
      problem_.cost_model(k, plan_.states[at], plan_.inputs[at], model);
      for (int i = 0; k > 0 && i < nx; ++i)
        gradient[(k - 1) * per_interval + nu + i] = model.gradient(i);
      for (int i = 0; k < n && i < nu; ++i) gradient[k * per_interval + i] = model.gradient(nx + i);
    }
    return true;
  }
  bool eval_g(int /*variables*/, const double* z, bool /*is_new*/, int /*rows*/,
              double* value) override {
    take(z);
    for (int k = 0; k < n; ++k) {
      const auto at = static_cast<std::size_t>(k);
      const auto &x = plan_.states[at], &next = plan_.states[at + 1];
      const auto& u = plan_.inputs[at];
      const auto end = problem_.step(k, x, u);
      for (int i = 0; i < nx; ++i) *value++ = end(i) - next(i);
      const auto c = problem_.constraint_values(k, x, u);
      for (int i = 0; i < nc; ++i) *value++ = c(i);
    }
    const auto c = user_.template terminal_constraint_values<double>(plan_.states.back());
    for (int i = 0; i < ends; ++i) *value++ = c(i);
    return true;
  }
  bool eval_jac_g(int /*variables*/, const double* z, bool /*is_new*/, int /*rows*/,
                  int /*nonzeros*/, int* row, int* column, double* value) override {
    if (value != nullptr) take(z);
    typename D::A A;
    typename D::B B;
    typename D::ConstraintsX C;
    typename D::ConstraintsU E;
    for (int k = 0; k < n; ++k) {
      const auto at = static_cast<std::size_t>(k);
      if (value != nullptr) {
        A.setZero();
        B.setZero();
        C.setZero();
        E.setZero();
        (void)problem_.step(k, plan_.states[at], plan_.inputs[at], A, B);
        problem_.constraint_derivatives(k, plan_.states[at], plan_.inputs[at], C, E);
      }
      for (int i = 0; i < rows_per_interval; ++i)
        for (int j = 0; j < nx + per_interval; ++j) {  // state before, inputs, state after
          if (value == nullptr) {
            *row++ = k * rows_per_interval + i;
            // The start is given: its columns stand for those of the first state, with zeros.
            *column++ = k == 0 && j < nx ? nu + j : (k - 1) * per_interval + nu + j;
            continue;
          }
          const bool defect = i < nx;
          const int c = i - nx;
          double entry = 0.0;
          if (j < nx)
            entry = k == 0 ? 0.0 : defect ? A(i, j) : C(c, j);
          else if (j < nx + nu)
            entry = defect ? B(i, j - nx) : E(c, j - nx);
          else if (defect && j - nx - nu == i)
            entry = -1.0;
          *value++ = entry;
        }
    }
    if constexpr (ends > 0) {
      Eigen::Matrix<double, ends, nx> end = Eigen::Matrix<double, ends, nx>::Zero();
      if (value != nullptr) problem_.terminal_constraint_derivatives(plan_.states.back(), end);
      for (int i = 0; i < ends; ++i)
        for (int j = 0; j < nx; ++j) {
          if (value == nullptr) {
            *row++ = n * rows_per_interval + i;
            *column++ = (n - 1) * per_interval + nu + j;
          } else {
            *value++ = end(i, j);
          }
        }
    }
    return true;
  }
  void finalize_solution(Ipopt::SolverReturn /*status*/, int /*variables*/, const double* z,
                         const double* /*z_lower*/, const double* /*z_upper*/, int /*rows*/,
                         const double* /*values*/, const double* /*multipliers*/, double /*value*/,
                         const Ipopt::IpoptData* /*data*/,
                         Ipopt::IpoptCalculatedQuantities* /*quantities*/) override {
    take(z);
  }

 private:
  using Problem = tilt_ropter::optimal_control::AutoDiffProblem<User>;
  using D = tilt_ropter::optimal_control::ProblemDimensions<Problem>;
  static constexpr int nx = User::states, nu = User::inputs, nc = User::constraints,
                       ends = User::terminal_constraints, per_interval = nx + nu,
                       rows_per_interval = nx + nc;
  using Model = tilt_ropter::optimal_control::QuadraticModel<nx, nu>;

  void take(const double* z) {
    for (int k = 0; k < n; ++k) {
      const auto at = static_cast<std::size_t>(k);
      for (int i = 0; i < nu; ++i) plan_.inputs[at](i) = *z++;
      for (int i = 0; i < nx; ++i) plan_.states[at + 1](i) = *z++;
    }
    plan_.inputs.back().setZero();
  }

  User user_;
  Problem problem_;
  PlanOf<User> plan_;
  int n = user_.intervals;
};

template <typename User>
struct IpoptSolution {
  bool converged = false;
  PlanOf<User> plan;
};

/// Solves from this guess, with IPOPT's own quasi-Newton Hessian.
template <typename User>
[[nodiscard]] IpoptSolution<User> solve_by_ipopt(const User& user, const PlanOf<User>& guess) {
  Ipopt::SmartPtr<Ipopt::IpoptApplication> application = IpoptApplicationFactory();
  application->Options()->SetIntegerValue("print_level", 0);
  application->Options()->SetStringValue("sb", "yes");
  application->Options()->SetStringValue("hessian_approximation", "limited-memory");
  application->Options()->SetIntegerValue("max_iter", 3000);
  application->Options()->SetNumericValue("tol", 1e-8);
  IpoptSolution<User> solution;
  if (application->Initialize() != Ipopt::Solve_Succeeded) return solution;
  auto* program = new IpoptProgram<User>(user, guess);
  const Ipopt::SmartPtr<Ipopt::TNLP> owner = program;
  const Ipopt::ApplicationReturnStatus status = application->OptimizeTNLP(owner);
  solution.converged = status == Ipopt::Solve_Succeeded;
  solution.plan = program->plan();
  return solution;
}

}  // namespace test_support
