#pragma once

#include <tilt_ropter/compiled.hpp>
#include <tilt_ropter/optimal_control/single_shooting.hpp>

/// The controller of the wrench level, with NLopt alone as the solver; compiled once, in
/// nmpc_by_nlopt.cpp.
namespace examples {

template <int Rotors>
using NmpcByNlopt = tilt_ropter::Nmpc<Rotors, tilt_ropter::optimal_control::SingleShooting>;

}  // namespace examples

extern template class tilt_ropter::Nmpc<4, tilt_ropter::optimal_control::SingleShooting>;
extern template class tilt_ropter::Nmpc<6, tilt_ropter::optimal_control::SingleShooting>;
extern template class tilt_ropter::Nmpc<8, tilt_ropter::optimal_control::SingleShooting>;
