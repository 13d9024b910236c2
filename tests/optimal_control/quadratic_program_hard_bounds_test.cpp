// Hard bounds that can be satisfied, but only at a penalty above the one that the solver tries
// first.

#include "support/random.hpp"
#include "support/random_program.hpp"

#include <tilt_ropter/optimal_control/multiple_shooting.hpp>

#include <gtest/gtest.h>

#include <limits>

namespace tilt_ropter::optimal_control {
namespace quadratic_program_hard_bounds_test {

using test_support::Feasibility;
using test_support::Random;

constexpr double infinity = std::numeric_limits<double>::infinity();

// The upper bounds of a random program; with sign -1 as lower bounds of the negative constraints.
class OneSided : public test_support::RandomProgram<4, 2, 6> {
  using Base = test_support::RandomProgram<4, 2, 6>;

 public:
  OneSided(const Base& base, double sign) : Base(base), sign_(sign) {}

  [[nodiscard]] RowVector constraint_values(int k, const State& x, const Input& u) const {
    return sign_ * Base::constraint_values(k, x, u);
  }
  void constraint_derivatives(int k, const State& x, const Input& u, D::ConstraintsX& C,
                              D::ConstraintsU& E) const {
    Base::constraint_derivatives(k, x, u, C, E);
    C *= sign_;
    E *= sign_;
  }
  [[nodiscard]] RowVector lower(int k) const {
    return sign_ > 0.0 ? RowVector(RowVector::Constant(-infinity)) : RowVector(-Base::upper(k));
  }
  [[nodiscard]] RowVector upper(int k) const {
    return sign_ > 0.0 ? Base::upper(k) : RowVector(RowVector::Constant(infinity));
  }

 private:
  double sign_;
};

// In each of these programs the first penalty relaxes a bound.
TEST(QuadraticProgramHardBounds, AreNotRelaxedAtTheFirstPriceOnEitherSide) {
  for (const double sign : {1.0, -1.0}) {
    int relaxed = 0;
    for (const unsigned seed : {42U, 58U, 90U, 100U, 144U, 148U, 158U, 188U, 200U, 210U}) {
      Random random(seed);
      const test_support::RandomProgram<4, 2, 6> base(random, 20, Feasibility::tight, infinity);
      SolverSettings settings;
      settings.program.method = ProgramMethod::structured;
      MultipleShooting<OneSided> solver(OneSided(base, sign), settings);
      solver.reset(base.start());
      ASSERT_EQ(solver.prepare(), PrepareStatus::prepared);
      const SolveReport& report = solver.feedback(base.start());
      relaxed += report.relaxed_hard_constraints > 0;
      EXPECT_EQ(report.status == SolveStatus::infeasible, report.relaxed_hard_constraints > 0);
    }
    EXPECT_LE(relaxed, 1) << (sign > 0.0 ? "upper bounds" : "lower bounds");
  }
}

}  // namespace quadratic_program_hard_bounds_test
}  // namespace tilt_ropter::optimal_control
