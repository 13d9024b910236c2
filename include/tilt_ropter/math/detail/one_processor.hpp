// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/standard.hpp>

#include <Eigen/Core>

#include <cstdio>
#include <cstdlib>

/// All files of one program must be compiled for the same processor (-march). Eigen aligns its
/// matrices to the widest registers of that processor. Files for different processors lay out the
/// library's types differently, so data that they exchange is corrupt. This header detects such a
/// program at its start, prints a message and aborts the program.
namespace tilt_ropter::detail {

/// Returns true if `alignment` [bytes] equals the alignment of the first call. Otherwise prints a
/// message to stderr and aborts the program.
inline bool aligned_alike(int alignment) {
  static const int first = alignment;
  if (alignment == first) return true;
  std::fprintf(stderr,
               "tilt_ropter: in one file of this program Eigen aligns by %d bytes, in another by "
               "%d. Compile all of them for the same processor, by one -march.\n",
               first, alignment);
  std::abort();
}

/// Runs the check once for each file that includes this header, at the start of the program.
[[maybe_unused]] static const bool one_processor = aligned_alike(EIGEN_MAX_STATIC_ALIGN_BYTES);

}  // namespace tilt_ropter::detail
