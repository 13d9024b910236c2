#pragma once

#include <Eigen/Core>
#include <Eigen/Eigenvalues>

#include <cmath>
#include <sstream>
#include <stdexcept>
#include <string>
#include <type_traits>

/// Checks of parameters at construction. Each throws std::invalid_argument with a sentence that
/// names the field, its value and what is allowed; none is called in a control loop.
namespace tilt_ropter {

/// Throws "`field` = `value`: must be `allowed`" unless `ok`. `value` is anything that can be
/// printed; vectors and matrices are printed in one line.
template <typename Value>
void require(bool ok, const std::string& field, const Value& value, const std::string& allowed) {
  if (ok) return;
  std::ostringstream message;
  message.precision(9);
  message << field << " = ";
  if constexpr (std::is_base_of_v<Eigen::EigenBase<Value>, Value>)
    message << value.format(Eigen::IOFormat(9, Eigen::DontAlignCols, ", ",
                                            value.cols() == 1 ? ", " : "; ", "", "", "(", ")"));
  else
    message << value;
  message << ": must be " << allowed;
  throw std::invalid_argument(message.str());
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
  require(value.allFinite(), field, value.derived(), "finite in every entry");
}

template <typename Derived>
void require_non_negative(const std::string& field, const Eigen::MatrixBase<Derived>& value) {
  require(value.allFinite() && (value.array() >= 0.0).all(), field, value.derived(),
          "finite and >= 0 in every entry");
}

template <typename Derived>
void require_positive(const std::string& field, const Eigen::MatrixBase<Derived>& value) {
  require(value.allFinite() && (value.array() > 0.0).all(), field, value.derived(),
          "finite and > 0 in every entry");
}

/// lower <= upper entry by entry; infinite entries are allowed, NaN is not.
template <typename Lower, typename Upper>
void require_ordered(const std::string& field, const Eigen::MatrixBase<Lower>& lower,
                     const Eigen::MatrixBase<Upper>& upper) {
  require((lower.array() <= upper.array()).all(), field + " lower bound", lower.derived(),
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
