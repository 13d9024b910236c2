// SPDX-License-Identifier: BSD-3-Clause
#pragma once

// Below this standard the compiler ends at the missing file, not after a thousand lines.
#if (defined(_MSVC_LANG) ? _MSVC_LANG : __cplusplus) < 201703L
#error "tilt_ropter needs C++17: -std=c++17, or target_compile_features(... cxx_std_17)"
#include <tilt_ropter_needs_a_newer_standard>
#endif
