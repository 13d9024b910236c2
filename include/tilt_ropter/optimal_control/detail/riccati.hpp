// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/detail/linear_algebra.hpp>
#include <tilt_ropter/math/detail/simd.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <utility>
#include <vector>

/// The linear-quadratic problem of one SQP step without inequality constraints, and its
/// factorisation by one backward Riccati pass.
///
/// With w = (dx, du) and M = [A B], the cost to go of node k is 1/2 w' H w + g' w with
///
///     H = [lxx lux'; lux luu] + M' P M,    g = (lx, lu) + M' (p + P defect),
///
/// where P and p belong to node k + 1. A Cholesky factorisation of H, whose pivots are the last
/// rows of H, eliminates du and leaves the P and p of node k (Rao, Wright & Rawlings, "Application
/// of interior-point methods to model predictive control", 1998, for the recursion; Frison &
/// Jorgensen, "Efficient implementation of the Riccati recursion", 2013, for its form as one
/// Cholesky factorisation). With the eliminated columns [Y; L], divided by the square roots of
/// their pivots,
///
///     z_k = L' du_k + Y' dx_k + y_k,    L y_k = g_u,
///
/// is the distance from the unconstrained optimal input. Completing the square turns the total cost
/// into 1/2 |z|^2 + const, with continuity eliminated.
namespace tilt_ropter::optimal_control {

/// A node of the linear-quadratic problem, stored in whole packets: vectors and columns are (dx,
/// du), padded with zeros.
template <int States, int Inputs>
struct RiccatiStage {
  static constexpr int width = States + Inputs, rows = detail::padded(width),
                       state_rows = detail::padded(States), input_rows = detail::padded(Inputs);
  using Vector = Eigen::Matrix<double, rows, 1>;

  Eigen::Matrix<double, rows, state_rows> transition =
      detail::Filled();  ///< [A B]' of the interval that starts here
  Eigen::Matrix<double, state_rows, 1> defect = detail::Filled();
  QuadraticModel<States, Inputs> cost;

  // factorise() writes the following three: the columns [Y; L] divided by the diagonal of L, in
  // order of elimination; 1 / (diagonal of L)^2; and the entry of g_u of each input at its
  // elimination.
  Eigen::Matrix<double, rows, input_rows> factor = detail::Filled();
  Eigen::Matrix<double, Inputs, 1> inverse_pivot = detail::Filled();
  Eigen::Matrix<double, Inputs, 1> eliminated = detail::Filled();
};

/// Terms that are added to the Hessian and gradient of a node before its inputs are eliminated:
/// add(k, hessian, gradient) of any callable, or nothing. The callable must outlive this object.
/// The callable's type is erased: as a template, Riccati::factorise() would be compiled for every
/// callable.
class NodeTerms {
 public:
  NodeTerms() = default;
  template <typename Add>
  NodeTerms(const Add& add)
      : add_(&add), call_([](const void* of, int k, double* hessian, double* gradient) {
          (*static_cast<const Add*>(of))(k, hessian, gradient);
        }) {}

  void operator()(int k, double* hessian, double* gradient) const {
    if (call_) call_(add_, k, hessian, gradient);
  }

 private:
  const void* add_ = nullptr;
  void (*call_)(const void*, int, double*, double*) = nullptr;
};

/// The entries of dx at the end of an interval that depend on certain entries of (dx, du) at its
/// start.
template <int States>
struct Reached {
  int count = 0;
  std::array<int, detail::size(States)> at{};
  [[nodiscard]] constexpr const int* begin() const { return at.data(); }
  [[nodiscard]] constexpr const int* end() const { return at.data() + count; }
};

/// Returns one list for each packet of `Width` entries of (dx, du), from the pattern of [A B]. The
/// entries are multiplied by `factor`: where a column starts, without a multiplication in the loop.
template <int States, int Inputs, typename Pattern, int Width>
constexpr auto reached_by(int factor = 1) {
  constexpr int width = States + Inputs;
  std::array<Reached<States>, detail::size(detail::padded(width) / Width)> lists{};
  for (int t = 0; t < detail::padded(width) / Width; ++t)
    for (int row = 0; row < States; ++row) {
      bool nonzero = false;
      for (int column = Width * t; column < Width * (t + 1) && column < width; ++column)
        nonzero = nonzero || Pattern::nonzero(row, column);
      if (!nonzero) continue;
      auto& list = lists[detail::size(t)];
      list.at[detail::size(list.count++)] = factor * row;
    }
  return lists;
}

/// The problem for a horizon with the nodes stage(0) to stage(N). Of the last node only the cost of
/// dx is used. `Pattern` defines which entries of [A B] can be non-zero: see TransitionPattern.
template <int States, int Inputs, typename Pattern = FullTransition>
class Riccati {
 public:
  using Stage = RiccatiStage<States, Inputs>;
  using Tangent = Eigen::Matrix<double, States, 1>;
  using Input = Eigen::Matrix<double, Inputs, 1>;
  using StateMatrix = Eigen::Matrix<double, States, States>;
  using InputMatrix = Eigen::Matrix<double, States, Inputs>;
  using Gain = Eigen::Matrix<double, Inputs, States>;
  static constexpr int width = Stage::width, rows = Stage::rows;
  /// (dx, du) of a node, or derivatives by it, padded with zeros.
  using Vector = typename Stage::Vector;

  /// Allocates once for `horizon` intervals.
  explicit Riccati(int horizon) : stages_(detail::size(horizon) + 1) {}

  [[nodiscard]] int horizon() const { return static_cast<int>(stages_.size()) - 1; }
  [[nodiscard]] Stage& stage(int k) { return stages_[detail::size(k)]; }
  [[nodiscard]] const Stage& stage(int k) const { return stages_[detail::size(k)]; }

  /// Sets A and B of the interval dx_{k+1} = A dx_k + B du_k + defect. Returns false if a number is
  /// not finite.
  [[nodiscard]] bool set_transition(int k, const StateMatrix& A, const InputMatrix& B) {
    auto& transition = stage(k).transition;
    for (int i = 0; i < States; ++i) {
      for (int j = 0; j < States; ++j) transition(j, i) = A(i, j);
      for (int j = 0; j < Inputs; ++j) transition(States + j, i) = B(i, j);
    }
    return all_finite(A) && all_finite(B);
  }
  /// The same for the intervals k to k + count - 1, count <= 4, from derivatives with one lane per
  /// interval. Reads only the entries that the pattern allows.
  [[nodiscard, gnu::always_inline]] inline bool set_transitions(
      int k, int count, const Eigen::Matrix<Lanes, States, States>& A,
      const Eigen::Matrix<Lanes, States, Inputs>& B) {
    constexpr int lanes = Lanes::count;
    detail::FiniteCheck<lanes> check;
    for (int t = 0; t < rows / lanes; ++t) {
      for (const int row : reached<lanes>[detail::size(t)]) {
        Packet<lanes> square[detail::size(lanes)];
#pragma GCC unroll 4
        for (int c = 0; c < lanes; ++c) {
          const int column = lanes * t + c;
          square[c] = column < States  ? A.coeffRef(row, column).packet
                      : column < width ? B.coeffRef(row, column - States).packet
                                       : Packet<lanes>{};
          check.add(square[c]);
        }
        detail::transpose(square);
#pragma GCC unroll 4
        for (int c = 0; c < lanes; ++c)
          if (c < count)
            detail::store<lanes>(stage(k + c).transition.data() + rows * row + lanes * t,
                                 square[c]);
      }
    }
    return check.passed();
  }
  void set_defect(int k, const Tangent& defect) {
    for (int i = 0; i < States; ++i) stage(k).defect(i) = defect(i);
  }

  /// Backward pass. `damping` is added to the diagonals of all Hessians. terms(k, hessian,
  /// gradient) adds to the Hessian (`rows` x `width` numbers) and gradient (`rows` numbers) of node
  /// k. Of the columns of dx, only the lower triangle without the rows of du is used. Returns false
  /// if the remaining Hessian of the inputs of a node is not positive definite or NaN (the problem
  /// then has no unique minimum). Does not allocate.
  [[nodiscard]] bool factorise(double damping = 0.0, const NodeTerms& terms = {}) {
    const auto run = [&](auto packet) __attribute__((always_inline)) {
      return pass<packet()>(damping, terms);
    };
    if constexpr (rows % detail::wide_packet_width == 0)
      return detail::vectorised_wide(run);
    else
      return detail::vectorised(run);
  }

  /// Backward pass for other gradients, one for each node, without defects. Uses the last
  /// factorisation.
  void solve(const std::vector<Vector>& gradients) {
    detail::vectorised([&](auto packet)
                           __attribute__((always_inline)) { solve_for<packet()>(gradients); });
  }

  /// Forward sweep from the dx in w[0]. Computes the inputs du with the coordinates z, and the dx
  /// that they lead to. `z` has Inputs numbers for each node; null means zero: the optimal inputs.
  void sweep(std::vector<Vector>& w, const double* z = nullptr) const {
    run({z}, w);
  }
  /// Forward sweep with inputs that follow dx by the gains alone, without feed-forward.
  void sweep_plan(std::vector<Vector>& w) const {
    run({nullptr, false}, w);
  }
  /// Forward sweep with the unchanged inputs du in w.
  void roll_out(std::vector<Vector>& w) const {
    run({nullptr, true, true, w.size()}, w);
  }
  /// The same as sweep() without defects, for a change of a step.
  void sweep_change(std::vector<Vector>& w) const {
    run({nullptr, true, false}, w);
  }
  /// The same as sweep_plan() without defects, for a deviation from a step. Nodes before `first`
  /// keep their inputs in w.
  void sweep_deviation(std::vector<Vector>& w, std::size_t first = 0) const {
    run({nullptr, false, false, first}, w);
  }
  /// Forward sweep in which choose(k, w) may change the optimal input of each node in w = (dx, du).
  template <typename Choose>
  void sweep_with(std::vector<Vector>& w, const Choose& choose) const {
    for (int k = 0; k < horizon(); ++k) {
      const auto i = detail::size(k);
      run({nullptr, true, true, 0, i, i + 1, false}, w);
      choose(k, w[i]);
      run({nullptr, true, true, i + 1, i, i + 1}, w);
    }
  }

  /// Returns the symmetric P of node 0, after factorise(): the Hessian of the cost of the whole
  /// horizon.
  [[nodiscard]] StateMatrix initial_cost() const {
    StateMatrix P;
    for (int j = 0; j < States; ++j)
      for (int i = 0; i < States; ++i) P(i, j) = cost_to_go_(i, j);
    return P;
  }

  /// Returns the optimal input of node k for dx = 0.
  [[nodiscard]] Input feedforward(int k) const {
    const Stage& s = stage(k);
    Input du;
    for (int j = Inputs - 1; j >= 0; --j) {
      du(j) = -s.inverse_pivot(j) * s.eliminated(j);
      for (int i = j + 1; i < Inputs; ++i) du(j) -= s.factor(States + i, j) * du(i);
    }
    return du;
  }
  /// Returns the gain d du / d dx of the optimal input of node k.
  [[nodiscard]] Gain gain(int k) const {
    const Stage& s = stage(k);
    Gain gain;
    for (int j = Inputs - 1; j >= 0; --j)
      for (int n = 0; n < States; ++n) {
        gain(j, n) = -s.factor(n, j);
        for (int i = j + 1; i < Inputs; ++i) gain(j, n) -= s.factor(States + i, j) * gain(i, n);
      }
    return gain;
  }

 private:
  template <int Width>
  using Packet = detail::Packet<Width>;
  static constexpr int state_rows = Stage::state_rows, input_rows = Stage::input_rows;
  template <int Width>
  static constexpr int state_packets = (States + Width - 1) / Width;
  // In a function template, every instance of the function would evaluate these lists.
  template <int Width, int Factor = 1>
  static constexpr auto reached = reached_by<States, Inputs, Pattern, Width>(Factor);

  template <int Width>
  [[gnu::always_inline]] inline bool pass(double damping, const NodeTerms& terms) {
    const Stage& last = stages_.back();
    std::copy_n(last.cost.hessian.data(), rows * width, hessian_.data());
    std::copy_n(last.cost.gradient.data(), rows, gradient_.data());
    for (int i = 0; i < States; ++i) hessian_(i, i) += damping;
    terms(horizon(), hessian_.data(), gradient_.data());
    for (int j = 0; j < States; ++j)
      std::copy_n(hessian_.data() + rows * j, States, cost_to_go_.data() + rows * j);
    mirror<detail::packet_width>();
    for (int k = horizon() - 1; k >= 0; --k) {
      Stage& s = stage(k);
      multiply<Width>(s);
      add_gradient<Width>(s);
      add_hessian<Width>(s, std::make_integer_sequence<int, width>{});
      if (damping > 0.0)
        for (int i = 0; i < width; ++i) hessian_(i, i) += damping;
      terms(k, hessian_.data(), gradient_.data());
      if (!eliminate<Width>(s)) return false;
      add_remainder<Width>(s, std::make_integer_sequence<int, state_packets<Width>>{});
      mirror<detail::packet_width>();
    }
    return true;
  }

  // product_ = M' P.
  template <int Width>
  [[gnu::always_inline]] inline void multiply(const Stage& s) {
    constexpr int most = 9;  // number of columns whose sums fit into the registers
    for (int t = 0; t < rows / Width; ++t) {
      for (int column = 0; column + most <= States; column += most)
        multiply_packet<Width, most>(s, t, column);
      if constexpr (States % most > 0)
        multiply_packet<Width, States % most>(s, t, States - States % most);
    }
  }
  template <int Width, int Columns>
  [[gnu::always_inline]] inline void multiply_packet(const Stage& s, int t, int first) {
    const double *transition = s.transition.data() + Width * t, *rest = cost_to_go_.data() + first;
    Packet<Width> sum[detail::size(Columns)] = {};
    for (const int column : reached<Width, rows>[detail::size(t)]) {
      Packet<Width> m;
      detail::load<Width>(transition + column, m);
      const double* p = rest + column;
#pragma GCC unroll 16
      for (int j = 0; j < Columns; ++j) sum[j] += m * p[j];
    }
#pragma GCC unroll 16
    for (int j = 0; j < Columns; ++j)
      detail::store<Width>(product_.data() + rows * (first + j) + Width * t, sum[j]);
  }

  // Sets gradient_ to g. Before, its first entries are p.
  template <int Width>
  [[gnu::always_inline]] inline void add_gradient(const Stage& s) {
    constexpr int packets = rows / Width;
    Packet<Width> sum[detail::size(packets)];
    detail::load<Width>(s.cost.gradient.data(), sum);
    for (int k = 0; k < States; ++k) {
      detail::add_product<Width>(sum, s.transition.data() + rows * k, gradient_(k));
      detail::add_product<Width>(sum, product_.data() + rows * k, s.defect(k));
    }
    detail::store<Width>(gradient_.data(), sum);
  }

  // Sets hessian_ to H: columns of dx from the diagonal down, complete columns of du.
  template <int Width, int... j>
  [[gnu::always_inline]] inline void add_hessian(const Stage& s, std::integer_sequence<int, j...>) {
    (add_column<Width, j>(s), ...);
  }
  template <int Width, int j>
  [[gnu::always_inline]] inline void add_column(const Stage& s) {
    constexpr int first = j < States ? j / Width : 0,
                  last = j < States ? state_packets<Width> : rows / Width;
    constexpr const auto& list = reached<1, rows>[detail::size(j)];
    const double *transition = s.transition.data() + j, *product = product_.data() + Width * first;
    const double* cost = s.cost.hessian.data() + rows * j;
    double* column = hessian_.data() + rows * j;
    Packet<Width> sum[detail::size(last - first)];
    detail::load<Width>(cost + Width * first, sum);
    if constexpr (Width > detail::packet_width) {  // without a loop: narrow packets gain nothing
#pragma GCC unroll 32
      for (int i = 0; i < list.count; ++i)
        detail::add_product<Width>(sum, product + list.at[detail::size(i)],
                                   transition[list.at[detail::size(i)]]);
    } else {
      for (const int k : list) detail::add_product<Width>(sum, product + k, transition[k]);
    }
    detail::store<Width>(column + Width * first, sum);
  }

  // Cholesky factorisation of the last rows and columns, which also eliminates du from the
  // gradient. Returns false if a pivot is not positive.
  template <int Width>
  [[gnu::always_inline]] inline bool eliminate(Stage& s) {
    constexpr int packets = rows / Width;
    bool positive = true;
    Packet<Width> g[detail::size(packets)];
    detail::load<Width>(gradient_.data(), g);
    for (int j = 0; j < Inputs; ++j) {
      double* column = hessian_.data() + rows * (States + j);
      Packet<Width> c[detail::size(packets)];
      detail::load<Width>(column, c);
      for (int i = 0; i < j; ++i) {
        const double factor = -s.factor(States + j, i);
        const double* before = hessian_.data() + rows * (States + i);
        detail::add_product<Width>(c, before, factor);
      }
      detail::store<Width>(column, c);
      const double pivot = column[States + j], inverse = 1.0 / pivot;
      positive = positive && pivot > 0.0;
      s.inverse_pivot(j) = inverse;
      s.eliminated(j) = gradient_(States + j);
#pragma GCC unroll 16
      for (int t = 0; t < packets; ++t) {
        c[t] *= inverse;
        detail::store<Width>(s.factor.data() + rows * j + Width * t, c[t]);
        g[t] -= c[t] * s.eliminated(j);
        detail::store<Width>(gradient_.data() + Width * t, g[t]);
      }
    }
    return positive;
  }

  // Sets cost_to_go_ from the diagonal down: the rest of hessian_ after the elimination.
  template <int Width, int... t>
  [[gnu::always_inline]] inline void add_remainder(const Stage& s,
                                                   std::integer_sequence<int, t...>) {
    (add_remainder_columns<Width, t>(s), ...);
  }
  template <int Width, int First>
  [[gnu::always_inline]] inline void add_remainder_columns(const Stage& s) {
    constexpr int count = state_packets<Width> - First;
    for (int j = Width * First; j < Width * (First + 1) && j < States; ++j) {
      Packet<Width> sum[detail::size(count)];
      detail::load<Width>(hessian_.data() + rows * j + Width * First, sum);
      for (int i = 0; i < Inputs; ++i) {
        const double factor = -s.factor(j, i);
        const double* column = hessian_.data() + rows * (States + i) + Width * First;
        detail::add_product<Width>(sum, column, factor);
      }
      detail::store<Width>(cost_to_go_.data() + rows * j + Width * First, sum);
    }
  }

  // Copies the lower triangle of cost_to_go_ to its upper triangle.
  template <int Width>
  [[gnu::always_inline]] inline void mirror() {
    for (int j = 0; j < States; j += Width) {
      for (int i = j; i < States; i += Width) {
        Packet<Width> square[detail::size(Width)];
#pragma GCC unroll 4
        for (int c = 0; c < Width; ++c)
          if (j + c < States)
            detail::load<Width>(cost_to_go_.data() + rows * (j + c) + i, square[c]);
          else
            square[c] = Packet<Width>{};
        detail::transpose(square);
#pragma GCC unroll 4
        for (int c = 0; c < Width; ++c) {
          if (i + c >= States) continue;
          double* column = cost_to_go_.data() + rows * (i + c) + j;
          if (i > j) {
            detail::store<Width>(column, square[c]);
          } else {
#pragma GCC unroll 4
            for (int r = 0; r < c; ++r) column[r] = square[c][r];
          }
        }
      }
    }
  }

  template <int Width>
  [[gnu::always_inline]] inline void solve_for(const std::vector<Vector>& gradients) {
    constexpr int packets = rows / Width;
    gradient_ = gradients.back();
    for (int k = horizon() - 1; k >= 0; --k) {
      Stage& s = stage(k);
      const Vector& own = gradients[detail::size(k)];
      Packet<Width> g[detail::size(packets)];
      detail::load<Width>(own.data(), g);
      for (int i = 0; i < States; ++i)
        detail::add_product<Width>(g, s.transition.data() + rows * i, gradient_(i));
      double by_input[detail::size(rows)];
      detail::store<Width>(by_input, g);
      for (int j = 0; j < Inputs; ++j) {
        double sum = by_input[States + j];
        for (int i = 0; i < j; ++i) sum -= s.factor(States + j, i) * s.eliminated(i);
        s.eliminated(j) = sum;
        detail::add_product<Width>(g, s.factor.data() + rows * j, -sum);
      }
      detail::store<Width>(gradient_.data(), g);
    }
  }

  // Options of a forward sweep. They are chosen at run time; as template parameters, each
  // combination would be compiled separately.
  struct Sweep {
    const double* z = nullptr;  // coordinates of the inputs; null: zero
    bool feedforward = true;    // false: inputs follow dx by the gains alone
    bool defects = true;        // false: without defects
    std::size_t first = 0;  // first node whose input is computed; earlier nodes keep the input in w
    std::size_t begin = 0, end = detail::size(-1);  // nodes of the sweep
    bool move = true;                               // false: only the inputs are computed
  };
  void run(const Sweep& how, std::vector<Vector>& w) const {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      const std::size_t end = std::min(how.end, stages_.size() - 1);
      for (std::size_t k = how.begin; k < end; ++k) {
        const Stage& s = stages_[k];
        if (k >= how.first)
          set_input<packet()>(s, how.z ? how.z + Inputs * static_cast<int>(k) : nullptr,
                              how.feedforward, w[k]);
        if (how.move) advance<packet()>(s, w[k], how.defects, w[k + 1]);
      }
    });
  }
  // Computes du of w = (dx, du).
  template <int Width>
  [[gnu::always_inline]] static inline void set_input(const Stage& s, const double* z,
                                                      bool feedforward, Vector& w) {
    double turned[detail::size(input_rows)];  // Y' dx, divided by the diagonal of L
    for (int i = States; i < state_rows; ++i) w(i) = 0.0;
    for (int j = 0; j < input_rows; j += Width)
      multiply_transposed<Width, state_rows>(s.factor.data() + rows * j, w.data(), turned + j);
    double* du = w.data() + States;
    for (int j = Inputs - 1; j >= 0; --j) {
      double sum = -turned[j];
      if (feedforward) sum -= s.inverse_pivot(j) * s.eliminated(j);
      if (z) sum += std::sqrt(s.inverse_pivot(j)) * z[j];
      for (int i = Inputs - 1; i > j; --i) sum -= s.factor(States + i, j) * du[i];
      du[j] = sum;
    }
  }
  // Computes dx of `next`.
  template <int Width>
  [[gnu::always_inline]] static inline void advance(const Stage& s, const Vector& w, bool defects,
                                                    Vector& next) {
    double dx[detail::size(state_rows)];
    for (int k = 0; k < state_rows; k += Width)
      multiply_transposed<Width, rows>(s.transition.data() + rows * k, w.data(), dx + k);
    for (int k = 0; k < States; ++k) next(k) = defects ? dx[k] + s.defect(k) : dx[k];
  }
  // Products of Width columns, which are `rows` numbers apart, with the first `Count` numbers of w.
  template <int Width, int Count>
  [[gnu::always_inline]] static inline void multiply_transposed(const double* columns,
                                                                const double* w, double* result) {
    Packet<Width> sums[detail::size(Width)] = {};
#pragma GCC unroll 32
    for (int i = 0; i < Count; i += Width) {
      Packet<Width> factor;
      detail::load<Width>(w + i, factor);
#pragma GCC unroll 4
      for (int c = 0; c < Width; ++c) {
        Packet<Width> column;
        detail::load<Width>(columns + rows * c + i, column);
        sums[c] += column * factor;
      }
    }
    detail::transpose(sums);
#pragma GCC unroll 4
    for (int c = 1; c < Width; ++c) sums[0] += sums[c];
    detail::store<Width>(result, sums[0]);
  }

  std::vector<Stage> stages_;
  // P of the node that the pass has reached; M' P and H of the current node; (p, remainder of g_u).
  Eigen::Matrix<double, rows, States> cost_to_go_ = detail::Filled();
  Eigen::Matrix<double, rows, States> product_ = detail::Filled();
  Eigen::Matrix<double, rows, width> hessian_ = detail::Filled();
  Vector gradient_ = detail::Filled();
};

/// Adjoint propagation of the derivatives of many linear functions of the trajectory at once, from
/// node to node. It uses the factorisation of Riccati, and its results are derivatives by Riccati's
/// coordinates z. DualMethod uses it for the gradients of its constraints.
template <int States, int Inputs, typename Pattern = FullTransition>
class AdjointBatch {
 public:
  using Stage = RiccatiStage<States, Inputs>;
  /// One function per row: its derivative by dx_k, then by du_k. The number of rows must be a
  /// multiple of detail::packet_width.
  using Gradients = Eigen::Matrix<double, Eigen::Dynamic, States + Inputs>;

  /// Adjoint step through the interval of node k, whose stage is `s`. Computes the derivatives by
  /// (dx_k, du_k) from the derivatives by dx_{k+1}, for the first `count` rows. Does not allocate.
  static void step_back(const Stage& s, const Gradients& after, Gradients& before,
                        Eigen::Index count) {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      constexpr int Width = packet();
      static constexpr auto lists = reached_by<States, Inputs, Pattern, 1>();
      for (int j = 0; j < width; ++j) {
        const auto& list = lists[detail::size(j)];
        Eigen::Index i = 0;
        for (; i + 4 * Width <= count + Width - 1; i += 4 * Width)
          step_back_column<Width, 4>(s, list, after, i, before, j);
        for (; i < count; i += Width) step_back_column<Width, 1>(s, list, after, i, before, j);
      }
    });
  }

  /// Transforms derivatives by (dx_k, du_k) into derivatives by (dx_k, z_k), for the first `count`
  /// rows. factorise() must have eliminated the inputs of this node. Does not allocate.
  static void to_coordinates(const Stage& s, Gradients& batch, Eigen::Index count) {
    detail::vectorised([&](auto packet) __attribute__((always_inline)) {
      constexpr int Width = packet();
      const Eigen::Index stride = batch.rows();
      for (Eigen::Index first = 0; first < count; first += Width) {
        double* row = batch.data() + first;
        for (int j = 0; j < Inputs; ++j) {
          Packet<Width> by_input;
          detail::load<Width>(row + stride * (States + j), by_input);
          for (int i = 0; i < j; ++i)
            detail::add_product<Width>(by_input, row + stride * (States + i),
                                       -s.factor(States + j, i));
          detail::store<Width>(row + stride * (States + j), by_input);
          for (int i = 0; i < States; ++i) {
            Packet<Width> by_state;
            detail::load<Width>(row + stride * i, by_state);
            by_state -= by_input * s.factor(i, j);
            detail::store<Width>(row + stride * i, by_state);
          }
        }
        for (int j = 0; j < Inputs; ++j) {
          Packet<Width> by_input;
          detail::load<Width>(row + stride * (States + j), by_input);
          by_input *= std::sqrt(s.inverse_pivot(j));
          detail::store<Width>(row + stride * (States + j), by_input);
        }
      }
    });
  }

 private:
  template <int Width>
  using Packet = detail::Packet<Width>;
  using List = Reached<States>;
  static constexpr int width = States + Inputs;

  template <int Width, int Packets>
  [[gnu::always_inline]] static inline void step_back_column(const Stage& s, const List& list,
                                                             const Gradients& after,
                                                             Eigen::Index row, Gradients& before,
                                                             int column) {
    Packet<Width> sum[detail::size(Packets)] = {};
    for (const int k : list) {
      const double factor = s.transition(column, k);
      const double* from = after.data() + after.rows() * k + row;
      detail::add_product<Width>(sum, from, factor);
    }
    detail::store<Width>(before.data() + before.rows() * column + row, sum);
  }
};

/// Returns P of an infinite horizon with the same interval and cost at every node: the stabilising
/// solution of the discrete algebraic Riccati equation
///
///     P = lxx + A' P A - (A' P B + lux') (luu + B' P B)^-1 (B' P A + lux).
///
/// The function repeats passes of Riccati from the identity until no entry P_ij changes by more
/// than 1e-12 sqrt(P_ii P_jj) in a pass. Returns nothing if `max_passes` passes are not enough or a
/// pass fails. P does not exist if a motion that does not decay has no cost or cannot be stopped.
/// Allocates. For an NMPC, a pass takes about a microsecond. The number of passes is the number of
/// intervals in which the slowest motion decays by 1e-6, because the cost is the square of the
/// motion.
template <int States, int Inputs, typename Pattern = FullTransition>
[[nodiscard]] std::optional<Eigen::Matrix<double, States, States>> solve_dare(
    const Eigen::Matrix<double, States, States>& A, const Eigen::Matrix<double, States, Inputs>& B,
    const QuadraticModel<States, Inputs>& cost, int max_passes = 20000) {
  Riccati<States, Inputs, Pattern> pass(1);
  auto& end = pass.stage(1).cost;
  if (!pass.set_transition(0, A, B)) return std::nullopt;
  pass.stage(0).cost = cost;
  Eigen::Matrix<double, States, States> P = detail::Filled();
  for (int i = 0; i < States; ++i) P(i, i) = 1.0;
  for (int i = 0; i < max_passes; ++i) {
    for (int c = 0; c < States; ++c)
      for (int r = 0; r < States; ++r) end.hessian(r, c) = P(r, c);
    if (!pass.factorise()) return std::nullopt;
    const auto last = P;
    P = pass.initial_cost();
    bool moved = false;
    for (int c = 0; c < States; ++c)
      for (int r = 0; r < States; ++r)
        moved |= !(std::abs(P(r, c) - last(r, c)) <= 1e-12 * std::sqrt(P(r, r) * P(c, c)));
    if (!moved) return P;
  }
  return std::nullopt;
}

}  // namespace tilt_ropter::optimal_control
