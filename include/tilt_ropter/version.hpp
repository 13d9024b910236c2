// SPDX-License-Identifier: BSD-3-Clause
#pragma once

/// The library's version; CMake reads it from here, so it stands in one place.
namespace tilt_ropter {

inline constexpr int version_major = 0;
inline constexpr int version_minor = 1;
inline constexpr int version_patch = 0;

}  // namespace tilt_ropter
