#pragma once

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <vector>

/// What the machine gives: a backward Riccati pass of the NMPC's size, 18 states, 6 inputs and 20
/// intervals, on dense fixed-size Eigen matrices, in its textbook form and without any structure.
namespace benchmarks {

class DenseRiccati {
 public:
  static constexpr int states = 18, inputs = 6, intervals = 20;
  using StateMatrix = Eigen::Matrix<double, states, states>;
  using InputMatrix = Eigen::Matrix<double, states, inputs>;

  DenseRiccati() : stages_(intervals) {
    for (int k = 0; k < intervals; ++k) {
      Stage& s = stages_[static_cast<std::size_t>(k)];
      for (int j = 0; j < states; ++j)
        for (int i = 0; i < states; ++i)
          s.A(i, j) = (i == j ? 1.0 : 0.0) + 0.01 * ((7 * i + 3 * j + k) % 11 - 5);
      for (int j = 0; j < inputs; ++j)
        for (int i = 0; i < states; ++i) s.B(i, j) = 0.1 * ((5 * i + 2 * j + k) % 7 - 3);
    }
  }

  /// Cost to go at the start.
  const StateMatrix& pass() {
    P_.setIdentity();
    for (auto s = stages_.rbegin(); s != stages_.rend(); ++s) {
      const StateMatrix PA = P_ * s->A;
      const InputMatrix PB = P_ * s->B;
      Eigen::Matrix<double, inputs, inputs> lambda = s->B.transpose() * PB;
      lambda.diagonal().array() += 0.1;
      const Eigen::Matrix<double, inputs, states> S = PB.transpose() * s->A;
      s->K = -lambda.llt().solve(S);
      P_.noalias() = s->A.transpose() * PA;
      P_.noalias() += S.transpose() * s->K;
      P_.diagonal().array() += 1.0;
    }
    return P_;
  }

 private:
  struct Stage {
    StateMatrix A;
    InputMatrix B;
    Eigen::Matrix<double, inputs, states> K;
  };

  std::vector<Stage> stages_;
  StateMatrix P_;
};

}  // namespace benchmarks
