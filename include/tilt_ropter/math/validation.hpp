#pragma once

#include <Eigen/Core>
#include <Eigen/Eigenvalues>

#include <cmath>
#include <sstream>
#include <stdexcept>
#include <string>

/// Checks of parameters at construction. Each throws std::invalid_argument with a sentence that
/// names the field, its value and what is allowed; none is called in a control loop.
namespace tilt_ropter {

/// Throws "`field` = `value`: must be `allowed`" unless `ok`.
template <typename Value>
void require(bool ok, const std::string& field, const Value& value, const std::string& allowed) {
  if (ok) return;
  std::ostringstream message;
  message.precision(9);
  message << field << " = " << value << ": must be " << allowed;
  throw std::invalid_argument(message.str());
}

/// The same for a vector or matrix, printed in one line.
template <typename Derived>
void require(bool ok, const std::string& field, const Eigen::MatrixBase<Derived>& value,
             const std::string& allowed) {
  if (ok) return;
  const Eigen::IOFormat one_line(9, Eigen::DontAlignCols, ", ", "; ", "", "", "(", ")");
  std::ostringstream message;
  message << value.format(one_line);
  require(false, field, message.str(), allowed);
}

inline void require_finite(const std::string& field, double value) {
  require(std::isfinite(value), field, value, "finite");
}

inline void require_positive(const std::string& field, double value) {
  require(std::isfinite(value) && value > 0.0, field, value, "finite and > 0");
}

inline void require_non_negative(const std::string& field, double value) {
  require(std::isfinite(value) && value >= 0.0, field, value, "finite and >= 0");
}

template <typename Derived>
void require_finite(const std::string& field, const Eigen::MatrixBase<Derived>& value) {
  require(value.allFinite(), field, value, "finite in every entry");
}

template <typename Derived>
void require_non_negative(const std::string& field, const Eigen::MatrixBase<Derived>& value) {
  require(value.allFinite() && (value.array() >= 0.0).all(), field, value,
          "finite and >= 0 in every entry");
}

template <typename Derived>
void require_positive(const std::string& field, const Eigen::MatrixBase<Derived>& value) {
  require(value.allFinite() && (value.array() > 0.0).all(), field, value,
          "finite and > 0 in every entry");
}

/// lower <= upper entry by entry; infinite entries are allowed, NaN is not.
template <typename Lower, typename Upper>
void require_ordered(const std::string& field, const Eigen::MatrixBase<Lower>& lower,
                     const Eigen::MatrixBase<Upper>& upper) {
  require((lower.array() <= upper.array()).all(), field + " lower bound", lower,
          "<= the upper bound in every entry");
}

/// An inertia that some rigid body has: symmetric, positive, and no principal moment larger than
/// the sum of the two others.
inline void require_inertia(const std::string& field, const Eigen::Matrix3d& inertia) {
  require_finite(field, inertia);
  require(
      (inertia - inertia.transpose()).cwiseAbs().maxCoeff() <= 1e-9 * inertia.cwiseAbs().maxCoeff(),
      field, inertia, "symmetric");
  const Eigen::Vector3d moments =
      Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(inertia, Eigen::EigenvaluesOnly).eigenvalues();
  require(moments(0) > 0.0 && moments(2) <= (moments(0) + moments(1)) * (1.0 + 1e-9), field,
          inertia,
          "positive definite with principal moments that obey the triangle inequality [kg m^2]");
}

}  // namespace tilt_ropter
