#pragma once

#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <cstddef>
#include <vector>

/// The linear-quadratic problem of one SQP step without its inequalities, and its factorisation by
/// one backward Riccati pass.
///
/// With Lambda_k = L_k L_k' = R_k + B_k' P_{k+1} B_k and the coordinates
///
///     z_k = L_k' du_k + Y_k dx_k + y_k,   Y_k = L_k^-1 S_k,   y_k = L_k^-1 s_k,
///
/// (the distance from the unconstrained optimal input) completing the square turns the whole cost
/// into 1/2 |z|^2 + const, with continuity eliminated (Rao, Wright & Rawlings, "Application of
/// interior-point methods to model predictive control", 1998, for the recursion).
namespace tilt_ropter {

/// One interval of the linear-quadratic problem: dx_{k+1} = A dx_k + B du_k + defect.
template <int States, int Inputs>
struct RiccatiStage {
  Eigen::Matrix<double, States, States> A = Eigen::Matrix<double, States, States>::Identity();
  Eigen::Matrix<double, States, Inputs> B = Eigen::Matrix<double, States, Inputs>::Zero();
  Eigen::Matrix<double, States, 1> defect = Eigen::Matrix<double, States, 1>::Zero();
  QuadraticModel<States, Inputs> cost;

  // Written by factorise():
  Eigen::Matrix<double, Inputs, Inputs> L;  ///< Cholesky factor of Lambda, lower
  Eigen::Matrix<double, Inputs, States> Y;
  Eigen::Matrix<double, Inputs, 1> y;
  Eigen::Matrix<double, States, Inputs> Bz;  ///< B L^-T: derivative of dx_{k+1} by z_k
  /// [A - Bz Y, Bz]': one product gives the adjoint at node k and the derivative by z_k.
  Eigen::Matrix<double, States + Inputs, States> adjoint;
};

/// The horizon: `stages` has N + 1 entries, of the last one only the cost is used.
template <int States, int Inputs>
class Riccati {
 public:
  using Stage = RiccatiStage<States, Inputs>;
  using Tangent = Eigen::Matrix<double, States, 1>;
  using Input = Eigen::Matrix<double, Inputs, 1>;

  /// Allocates once for `horizon` intervals.
  explicit Riccati(int horizon) : stages_(static_cast<std::size_t>(horizon) + 1) {}

  [[nodiscard]] int horizon() const { return static_cast<int>(stages_.size()) - 1; }
  [[nodiscard]] Stage& stage(int k) { return stages_[static_cast<std::size_t>(k)]; }
  [[nodiscard]] const Stage& stage(int k) const { return stages_[static_cast<std::size_t>(k)]; }

  /// Backward pass. False if some Lambda is not positive definite (then the problem has no unique
  /// minimum). No allocation.
  [[nodiscard]] bool factorise() {
    P_ = stages_.back().cost.lxx;
    p_ = stages_.back().cost.lx;
    for (int k = horizon() - 1; k >= 0; --k) {
      Stage& s = stage(k);
      PB_.noalias() = P_ * s.B;
      PA_.noalias() = P_ * s.A;
      p_.noalias() += P_ * s.defect;
      Eigen::Matrix<double, Inputs, Inputs> lambda = s.cost.luu;
      lambda.noalias() += s.B.transpose() * PB_;
      const Eigen::LLT<Eigen::Matrix<double, Inputs, Inputs>> cholesky(lambda);
      if (cholesky.info() != Eigen::Success) return false;
      s.L = cholesky.matrixL();
      // One inverse of the small factor, and products in place of triangular solves.
      inverse_.setIdentity();
      s.L.template triangularView<Eigen::Lower>().solveInPlace(inverse_);
      S_ = s.cost.lux;
      S_.noalias() += PB_.transpose() * s.A;
      s.Y.noalias() = inverse_ * S_;
      Input gradient = s.cost.lu;
      gradient.noalias() += s.B.transpose() * p_;
      s.y.noalias() = inverse_ * gradient;
      s.Bz.noalias() = s.B * inverse_.transpose();
      s.adjoint.template topRows<States>() = s.A.transpose();
      s.adjoint.template topRows<States>().noalias() -= s.Y.transpose() * s.Bz.transpose();
      s.adjoint.template bottomRows<Inputs>() = s.Bz.transpose();

      P_ = s.cost.lxx;
      P_.noalias() += s.A.transpose() * PA_;
      P_.noalias() -= s.Y.transpose() * s.Y;
      PA_ = P_.transpose();
      P_ = 0.5 * (P_ + PA_);  // rounding must not grow into asymmetry along the horizon
      Tangent p = s.cost.lx;
      p.noalias() += s.A.transpose() * p_;
      p.noalias() -= s.Y.transpose() * s.y;
      p_ = p;
    }
    return true;
  }

  /// Input step at node k for the state step dx and the coordinates z.
  [[nodiscard]] Input input_step(int k, const Tangent& dx, const Input& z) const {
    const Stage& s = stage(k);
    Input du = z - s.y;
    du.noalias() -= s.Y * dx;
    s.L.transpose().template triangularView<Eigen::Upper>().solveInPlace(du);
    return du;
  }

 private:
  std::vector<Stage> stages_;
  Eigen::Matrix<double, States, States> P_, PA_;
  Eigen::Matrix<double, States, Inputs> PB_;
  Eigen::Matrix<double, Inputs, States> S_;
  Eigen::Matrix<double, Inputs, Inputs> inverse_;
  Tangent p_;
};

}  // namespace tilt_ropter
