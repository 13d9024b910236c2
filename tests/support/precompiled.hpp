#pragma once

#include <tilt_ropter/compiled_actuator_level.hpp>
#include <tilt_ropter/identification/clock_calibration.hpp>
#include <tilt_ropter/identification/log_calibration.hpp>
#include <tilt_ropter/identification/servo_identification.hpp>
#include <tilt_ropter/identification/vehicle_identification.hpp>
#include <tilt_ropter/tilt_ropter.hpp>

#if __has_include(<CLI/CLI.hpp>)
#include <CLI/CLI.hpp>
#endif
#include <gtest/gtest.h>

#include <filesystem>
#include <iostream>
#include <sstream>

/// Headers that tests and programs precompile together (see TILT_ROPTER_BUILD_QUICKLY), and
/// template instances that many of them use. With TILT_ROPTER_COMPILES_ONCE, CMake generates one
/// source for the instances of each macro. `prefix` is `extern` for a declaration.
#define TILT_ROPTER_ACTUATION_TEST_INSTANCES(prefix)                                  \
  prefix template struct AllocationMatrix<4>;                                         \
  prefix template class ActuatorModel<4>;                                             \
  prefix template class FailureDetector<4>;                                           \
  prefix template class Plant<4>;                                                     \
  prefix template class Plant<6>;                                                     \
  prefix template class RotorSpeedSensor<4>;                                          \
  prefix template class detail::ThrustChoice<4>;                                      \
  prefix template class detail::ThrustLimits<4, double>;                              \
  prefix template class detail::ThrustSearch<4>;                                      \
  prefix template void validate<4>(const Vehicle<4>&);                                \
  prefix template double PowerModel::power(const Eigen::MatrixBase<Eigen::Vector4d>&, \
                                           const Eigen::MatrixBase<Eigen::Vector4d>&) \
      const noexcept;                                                                 \
  prefix template Wrenchd Allocation<4>::wrench(const ActuatorState<4>&) const noexcept;

#define TILT_ROPTER_ESTIMATION_TEST_INSTANCES(prefix)                                              \
  prefix template class ErrorStateFilter<double>;                                                  \
  prefix template class WrenchObserver<double>;                                                    \
  prefix template ClockCalibration calibrate_clock(const std::vector<Timed<InertialSampled>>&,     \
                                                   const std::vector<Timed<MarkerPosed>>&,         \
                                                   const ClockCalibrationSettings&);               \
  prefix template LogCalibration calibrate_log(const std::vector<Timed<InertialSampled>>&,         \
                                               const std::vector<Timed<MarkerPosed>>&,             \
                                               const LogCalibrationSettings&);                     \
  prefix template VehicleIdentification<4> identify_vehicle(                                       \
      const VehicleLog<4>&, const Vehicle<4>&, const VehicleIdentificationSettings&);              \
  prefix template EkfStatus Ekf<double>::on_measurement(                                           \
      double, const BodyVelocityMeasurement<double>&) noexcept;                                    \
  prefix template EkfStatus Ekf<double>::on_measurement(double,                                    \
                                                        const FlowMeasurement<double>&) noexcept;  \
  prefix template EkfStatus Ekf<double>::on_measurement(                                           \
      double, const HeadingMeasurement<double>&) noexcept;                                         \
  prefix template EkfStatus Ekf<double>::on_measurement(                                           \
      double, const HeightMeasurement<double>&) noexcept;                                          \
  prefix template EkfStatus Ekf<double>::on_measurement(                                           \
      double, const NoSlipMeasurement<double>&) noexcept;                                          \
  prefix template EkfStatus Ekf<double>::on_measurement(double,                                    \
                                                        const PoseMeasurement<double>&) noexcept;  \
  prefix template EkfStatus Ekf<double>::on_measurement(                                           \
      double, const PositionMeasurement<double>&) noexcept;                                        \
  prefix template EkfStatus Ekf<double>::on_measurement(double,                                    \
                                                        const RangeMeasurement<double>&) noexcept; \
  prefix template EkfStatus Ekf<double>::on_measurement(                                           \
      double, const WheelHeightMeasurement<double>&) noexcept;                                     \
  prefix template EkfStatus Ekf<double>::on_measurement(                                           \
      double, const WheelSpeedMeasurement<double>&) noexcept;                                      \
  prefix template EkfStatus Ekf<double>::on_measurement(                                           \
      double, const WorldVelocityMeasurement<double>&) noexcept;

#define TILT_ROPTER_SOLVER_TEST_INSTANCES(prefix)                                   \
  prefix template class optimal_control::MultipleShooting<WheeledFlightProblem<0>>; \
  prefix template class optimal_control::MultipleShooting<WheeledFlightProblem<4>>;

#ifdef TILT_ROPTER_COMPILES_ONCE
namespace tilt_ropter {
TILT_ROPTER_ACTUATION_TEST_INSTANCES(extern)
TILT_ROPTER_ESTIMATION_TEST_INSTANCES(extern)
TILT_ROPTER_SOLVER_TEST_INSTANCES(extern)
}  // namespace tilt_ropter
#endif
