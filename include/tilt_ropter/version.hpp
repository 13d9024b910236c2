// SPDX-License-Identifier: BSD-3-Clause
#pragma once

/// Version of the library. CMake reads it from this header, so it is defined in one place.
namespace tilt_ropter {

inline constexpr int version_major = 0;
inline constexpr int version_minor = 2;
inline constexpr int version_patch = 0;

}  // namespace tilt_ropter
