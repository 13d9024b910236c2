// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <cstddef>
#include <optional>
#include <vector>

namespace tilt_ropter::detail {

/// First-in-first-out queue of at most `capacity` values, each released at its due time. In a full
/// queue a new value replaces the newest and takes over its due time, so none waits too long.
template <typename Value>
class DelayQueue {
 public:
  explicit DelayQueue(std::size_t capacity) : entries_(capacity) {}

  void push(double due, const Value& value) noexcept {
    if (count_ < entries_.size())
      entries_[(first_ + count_++) % entries_.size()] = {due, value};
    else
      entries_[(first_ + count_ - 1) % entries_.size()].value = value;
  }

  /// Removes and returns the oldest value if it is due at `time` [s], give or take 1 ns.
  [[nodiscard]] std::optional<Value> pop(double time) noexcept {
    if (count_ == 0 || !(entries_[first_].due <= time + 1e-9)) return std::nullopt;
    const std::size_t oldest = first_;
    first_ = (first_ + 1) % entries_.size();
    --count_;
    return entries_[oldest].value;
  }

  void clear() noexcept { count_ = 0; }

 private:
  struct Entry {
    double due = 0.0;
    Value value;
  };
  std::vector<Entry> entries_;
  std::size_t first_ = 0, count_ = 0;
};

}  // namespace tilt_ropter::detail
