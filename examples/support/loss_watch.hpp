#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <array>
#include <cstdio>
#include <string>

/// When a vehicle counts as lost. Used by all programs that fly a mission.
namespace examples {

inline constexpr double lost_distance = 2.0;  ///< from the reference [m]

/// True if body z is more than 60 degrees from the vertical.
[[nodiscard]] inline bool is_tipped(const Eigen::Quaterniond& orientation) {
  return orientation.toRotationMatrix()(2, 2) < 0.5;
}

/// Remembers how and when a vehicle was lost first.
class LossWatch {
 public:
  /// Call this after each step, unless the rotors have been stopped on the ground. `distance` [m]
  /// is that from the reference, zero if the vehicle no longer has to follow it.
  /// `away` [m]: the distance from the reference in any case.
  void on_step(double time, double distance, bool tipped, double away = 0.0) {
    const bool lost = tipped || distance > lost_distance;
    if (!lost) well_ = time;
    if (tipped) tipped_for_ += time - last_;
    last_ = time;
    is_over_ = (lost && time > well_ + return_time) || tipped_for_ > return_time ||
               (away > far_away && !sentence_.empty());
    if (!sentence_.empty() || !lost) return;
    time_ = time;
    std::array<char, 100> text{};
    (void)std::snprintf(
        text.data(), text.size(), "the vehicle %s at %.2f s: %s",
        tipped ? "tipped over" : "was lost", time,
        tipped ? "more than 60 degrees from upright" : "more than 2 m from its reference");
    sentence_ = text.data();
  }

  /// Empty if the vehicle was not lost.
  [[nodiscard]] const std::string& sentence() const { return sentence_; }
  /// When it was lost first [s].
  [[nodiscard]] double time() const { return time_; }
  /// True if it does not come back: it has been lost for 2 s, was tipped over for 2 s in all, or is
  /// more than 10 m away after a loss.
  [[nodiscard]] bool is_over() const { return is_over_; }

 private:
  static constexpr double return_time = 2.0, far_away = 10.0;  // [s], [m]

  double time_ = 0.0, well_ = 0.0, last_ = 0.0, tipped_for_ = 0.0;
  bool is_over_ = false;
  std::string sentence_;
};

}  // namespace examples
