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
  void on_step(double time, double distance, bool tipped) {
    if (!sentence_.empty()) return;
    if (!tipped && !(distance > lost_distance)) return;
    std::array<char, 100> text{};
    (void)std::snprintf(
        text.data(), text.size(), "the vehicle %s at %.2f s: %s",
        tipped ? "tipped over" : "was lost", time,
        tipped ? "more than 60 degrees from upright" : "more than 2 m from its reference");
    sentence_ = text.data();
  }

  /// Empty if the vehicle was not lost.
  [[nodiscard]] const std::string& sentence() const { return sentence_; }

 private:
  std::string sentence_;
};

}  // namespace examples
