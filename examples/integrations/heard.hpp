#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <string>

namespace loops {

/// What arrives on one topic: how often, and how old. Does not allocate.
class Heard {
 public:
  Heard() = default;
  explicit Heard(const char* topic) : topic_(topic) {}

  /// A message with this stamp [s].
  void on_message(double stamp) {
    ++count_;
    stamp_ = stamp;
  }
  /// Counts the messages of each second, in the clock of the stamps [s].
  void on_tick(double time) {
    time_ = time;
    const double passed = time - since_;
    if (passed >= 0.0 && passed < 1.0) return;
    rate_ = passed > 0.0 && passed < 1.5 ? static_cast<double>(count_) / passed : 0.0;
    since_ = time;
    count_ = 0;
  }

  [[nodiscard]] const char* topic() const { return topic_; }
  [[nodiscard]] double rate() const { return rate_; }          ///< in the last second [Hz]
  [[nodiscard]] double age() const { return time_ - stamp_; }  ///< of the newest message [s]
  [[nodiscard]] bool ever() const { return stamp_ > -1e300; }

  /// Such as "imu 100 Hz 3 ms", or "imu: nothing".
  [[nodiscard]] std::string text() const {
    std::array<char, 96> buffer{};
    if (!ever())
      std::snprintf(buffer.data(), buffer.size(), "%s: nothing", topic_);
    else
      std::snprintf(buffer.data(), buffer.size(), "%s %.0f Hz %.0f ms", topic_, rate_, 1e3 * age());
    return buffer.data();
  }

 private:
  const char* topic_ = "";
  long count_ = 0;
  double stamp_ = -1e308, since_ = -1e308, time_ = 0.0, rate_ = 0.0;
};

}  // namespace loops
