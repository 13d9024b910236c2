// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/math/detail/standard.hpp>

#include <cstddef>

namespace tilt_ropter::detail {

/// Returns the entry of `names` for an enumerator: names are listed in the order of the
/// enumerators, which count from 0. Returns "unknown" beyond the list.
template <typename Enum, std::size_t Count>
[[nodiscard]] constexpr const char* name_in(const char* const (&names)[Count],
                                            Enum value) noexcept {
  const auto index = static_cast<std::size_t>(value);
  return index < Count ? names[index] : "unknown";
}

}  // namespace tilt_ropter::detail
