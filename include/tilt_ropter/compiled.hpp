// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/ekf.hpp>

/// Instead of the headers that it includes, where the program links to tilt_ropter::compiled: says
/// which instances are in that library, so that whoever includes this does not compile them. The
/// library is built with the flags of the project that links to it; cmake/compiled.cmake says how.
///
/// What is the same for any number of rotors is in it, too: Ekf in double precision.

/// What there is for a number of rotors; `prefix` is `extern` for a declaration.
#define TILT_ROPTER_INSTANCES(prefix, rotors)      \
  prefix template class tilt_ropter::Nmpc<rotors>; \
  prefix template class tilt_ropter::Allocation<rotors>;

TILT_ROPTER_INSTANCES(extern, 4)
TILT_ROPTER_INSTANCES(extern, 6)
TILT_ROPTER_INSTANCES(extern, 8)
extern template class tilt_ropter::Ekf<double>;
