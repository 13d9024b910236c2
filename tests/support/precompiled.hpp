#pragma once

#include <tilt_ropter/compiled_actuator_level.hpp>
#include <tilt_ropter/tilt_ropter.hpp>

#if __has_include(<CLI/CLI.hpp>)
#include <CLI/CLI.hpp>
#endif
#include <gtest/gtest.h>

#include <filesystem>
#include <iostream>
#include <sstream>

/// Headers that tests and programs precompile together (see TILT_ROPTER_BUILD_QUICKLY), and
/// templates that many of them instantiate. With TILT_ROPTER_COMPILES_ONCE, these templates are
/// compiled here, once.
#ifdef TILT_ROPTER_COMPILES_ONCE
namespace tilt_ropter {

template struct AllocationMatrix<4>;
template class ActuatorModel<4>;
template class ErrorStateFilter<double>;
template class optimal_control::MultipleShooting<WheeledFlightProblem<0>>;
template class optimal_control::MultipleShooting<WheeledFlightProblem<4>>;
template class Plant<4>;
template class Plant<6>;
template class WrenchObserver<double>;
template class detail::ThrustChoice<4>;
template class detail::ThrustLimits<4, double>;
template class detail::ThrustSearch<4>;
template void validate<4>(const Vehicle<4>&);
template EkfStatus Ekf<double>::on_measurement(double, const FlowMeasurement<double>&) noexcept;
template EkfStatus Ekf<double>::on_measurement(double, const HeadingMeasurement<double>&) noexcept;
template EkfStatus Ekf<double>::on_measurement(double, const HeightMeasurement<double>&) noexcept;
template EkfStatus Ekf<double>::on_measurement(double, const NoSlipMeasurement<double>&) noexcept;
template EkfStatus Ekf<double>::on_measurement(double, const PoseMeasurement<double>&) noexcept;
template EkfStatus Ekf<double>::on_measurement(double, const PositionMeasurement<double>&) noexcept;
template EkfStatus Ekf<double>::on_measurement(double, const RangeMeasurement<double>&) noexcept;
template EkfStatus Ekf<double>::on_measurement(double,
                                               const WheelSpeedMeasurement<double>&) noexcept;
template EkfStatus Ekf<double>::on_measurement(double,
                                               const WorldVelocityMeasurement<double>&) noexcept;

}  // namespace tilt_ropter
#endif
