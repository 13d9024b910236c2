#pragma once

#include <algorithm>

namespace test_support {

/// Cost and largest violations of a trajectory, computed only with the plain functions of the
/// problem.
struct Audit {
  double cost = 0.0, defect = 0.0, violation = 0.0;
};

template <typename Solver>
Audit audit(const Solver& solver) {
  const auto& problem = solver.problem();
  Audit a;
  for (int k = 0; k <= problem.horizon(); ++k) {
    const auto& x = solver.state(k);
    const auto& u = solver.input(k);
    a.cost += problem.cost(k, x, u);
    const auto rows = problem.constraint_values(k, x, u);
    a.violation = std::max(a.violation, (rows - problem.upper(k)).maxCoeff());
    a.violation = std::max(a.violation, (problem.lower(k) - rows).maxCoeff());
    if (k < problem.horizon())
      a.defect = std::max(
          a.defect,
          problem.difference(problem.step(k, x, u), solver.state(k + 1)).cwiseAbs().maxCoeff());
  }
  return a;
}

}  // namespace test_support
