#pragma once

#include <tilt_ropter/compiled.hpp>
#include <tilt_ropter/optimal_control/single_shooting.hpp>

/// The controller of the wrench level, with NLopt alone as the solver; compiled once, in
/// nmpc_by_nlopt.cpp.
namespace examples {

template <int Rotors>
using NmpcByNlopt = tilt_ropter::Nmpc<Rotors, tilt_ropter::optimal_control::SingleShooting>;

}  // namespace examples

/// Instance for one number of rotors. `prefix` is `extern` for a declaration.
#define NMPC_BY_NLOPT_INSTANCE(prefix, rotors) \
  TILT_ROPTER_NMPC_INSTANCE(                   \
      prefix,                                  \
      tilt_ropter::detail::WrenchLevel<rotors, tilt_ropter::optimal_control::SingleShooting>)

NMPC_BY_NLOPT_INSTANCE(extern, 4)
NMPC_BY_NLOPT_INSTANCE(extern, 6)
NMPC_BY_NLOPT_INSTANCE(extern, 8)
