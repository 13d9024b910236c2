// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <Eigen/Core>

#include <cstdio>
#include <cstdlib>

/// Files of one program that are compiled for different processors (-march) do not meet: Eigen
/// aligns its matrices by the widest registers of the processor, so such files lay out our types in
/// two ways, and what one of them hands the other is garbage. The program ends as it starts and
/// says so.
namespace tilt_ropter::detail {

/// True. Ends the program, with a message, where the caller's file aligns differently from the file
/// that asked first. [bytes]
inline bool aligned_alike(int alignment) {
  static const int first = alignment;
  if (alignment == first) return true;
  std::fprintf(stderr,
               "tilt_ropter: in one file of this program Eigen aligns by %d bytes, in another by "
               "%d. Compile all of them for the same processor, by one -march.\n",
               first, alignment);
  std::abort();
}

/// Each file asks.
[[maybe_unused]] static const bool one_processor = aligned_alike(EIGEN_MAX_STATIC_ALIGN_BYTES);

}  // namespace tilt_ropter::detail
