#pragma once

#include <algorithm>
#include <cstdint>
#include <iomanip>
#include <ostream>

namespace loops {

/// How punctual the ticks of a node were.
struct TickCounts {
  long ticks = 0;      ///< that were run
  long late = 0;       ///< ended after the next one was due, or were left out
  double worst = 0.0;  ///< longest time from when a tick was due until its end [s]

  void print(std::ostream& out) const {
    out << "ticks: " << ticks << "\nlate_ticks: " << late << "\nworst_tick_ms: " << std::fixed
        << std::setprecision(2) << 1e3 * worst << '\n';
  }
};

/// Says when something is due that happens once in every period of a clock. The clock is read late
/// or, as the topic /clock, jumps from message to message. What could not begin before the next one
/// was due is left out, and nothing begins twice at one time. All times are in nanoseconds.
class TickTimer {
 public:
  /// `in_steps`: the clock jumps. A tick then begins at the reading next to when it is due, which
  /// may be before.
  TickTimer(std::int64_t period, bool in_steps) : period_(period), in_steps_(in_steps) {}

  /// Returns whether a tick begins at the reading `now` of the clock. The first one begins at the
  /// first reading, and at that of a clock that has gone back by more than two periods.
  [[nodiscard]] bool begins(std::int64_t now) {
    const bool anew = !started_ || now < due_ - 2 * period_;
    if (anew) due_ = reading_ = now;
    const std::int64_t step = now - reading_;  // the next one may be as long
    started_ = true;
    reading_ = now;
    if (now < due_ && !(in_steps_ && 2 * (due_ - now) < std::min(step, period_))) return false;
    const std::int64_t left_out = std::max<std::int64_t>(0, now - due_) / period_;
    since_ = due_;
    due_ += (left_out + 1) * period_;
    ++counts_.ticks;
    counts_.late += static_cast<long>(left_out);
    return true;
  }

  /// Counts the tick that began last, which has ended at `now`.
  void ended(std::int64_t now) {
    if (now >= due_) ++counts_.late;
    counts_.worst = std::max(counts_.worst, 1e-9 * static_cast<double>(now - since_));
  }

  [[nodiscard]] std::int64_t due() const { return due_; }  ///< when the next one is due
  [[nodiscard]] const TickCounts& counts() const { return counts_; }

 private:
  std::int64_t period_;
  bool in_steps_, started_ = false;
  std::int64_t due_ = 0, since_ = 0, reading_ = 0;
  TickCounts counts_;
};

}  // namespace loops
