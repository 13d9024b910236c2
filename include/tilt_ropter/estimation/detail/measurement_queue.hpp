// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <array>
#include <cstddef>
#include <new>
#include <type_traits>

/// Queue of measurements of different types, sorted by time, without heap.
namespace tilt_ropter::detail {

/// Holds any copyable measurement of at most `capacity` bytes, and calls a function of its type.
/// `Receiver` has a member template `apply(time, measurement)`.
template <typename Receiver>
class StoredMeasurement {
 public:
  static constexpr std::size_t capacity = 512;

  StoredMeasurement() noexcept = default;
  StoredMeasurement(const StoredMeasurement& other) noexcept { *this = other; }
  StoredMeasurement& operator=(const StoredMeasurement& other) noexcept {
    if (this == &other) return *this;
    time = other.time;
    operations_ = other.operations_;
    if (operations_ != nullptr) operations_->copy(bytes_.data(), other.bytes_.data());
    return *this;
  }
  ~StoredMeasurement() = default;

  template <typename Measurement>
  void set(double at, const Measurement& measurement) noexcept {
    static_assert(sizeof(Measurement) <= capacity && alignof(Measurement) <= alignment,
                  "the measurement is too large to wait");
    static_assert(std::is_trivially_destructible_v<Measurement>,
                  "a measurement is plain data: numbers and vectors of fixed size");
    time = at;
    new (bytes_.data()) Measurement(measurement);
    operations_ = &operations_of<Measurement>;
  }

  void apply(Receiver& receiver) const noexcept {
    if (operations_ != nullptr) operations_->apply(receiver, time, bytes_.data());
  }

  double time = 0.0;

 private:
  static constexpr std::size_t alignment = 64;

  struct Operations {
    void (*copy)(void*, const void*) noexcept;
    void (*apply)(Receiver&, double, const void*) noexcept;
  };

  template <typename Measurement>
  static void copy(void* to, const void* from) noexcept {
    new (to) Measurement(*static_cast<const Measurement*>(from));
  }
  template <typename Measurement>
  static void pass(Receiver& receiver, double at, const void* measurement) noexcept {
    receiver.apply(at, *static_cast<const Measurement*>(measurement));
  }
  template <typename Measurement>
  static constexpr Operations operations_of = {&copy<Measurement>, &pass<Measurement>};

  alignas(alignment) std::array<unsigned char, capacity> bytes_ = {};
  const Operations* operations_ = nullptr;
};

/// At most `Size` measurements in the order of their times. Measurements of equal time keep the
/// order in which they came.
template <typename Receiver, std::size_t Size>
class MeasurementQueue {
 public:
  using Entry = StoredMeasurement<Receiver>;

  template <typename Measurement>
  [[nodiscard]] bool push(double time, const Measurement& measurement) noexcept {
    if (count_ == Size) return false;
    std::size_t place = count_++;
    for (; place > 0 && entries_[place - 1].time > time; --place)
      entries_[place] = entries_[place - 1];
    entries_[place].set(time, measurement);
    return true;
  }

  [[nodiscard]] bool has_until(double time) const noexcept {
    return count_ > 0 && entries_[0].time <= time;
  }

  /// Removes and returns the first measurement. The queue must not be empty.
  [[nodiscard]] Entry pop() noexcept {
    const Entry first = entries_[0];
    --count_;
    for (std::size_t i = 0; i < count_; ++i) entries_[i] = entries_[i + 1];
    return first;
  }

  void clear() noexcept { count_ = 0; }

 private:
  std::array<Entry, Size> entries_;
  std::size_t count_ = 0;
};

}  // namespace tilt_ropter::detail
