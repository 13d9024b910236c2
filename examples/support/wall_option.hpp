#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <CLI/CLI.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <iomanip>
#include <limits>
#include <optional>
#include <ostream>

/// A wall in a mission, of which the controller knows nothing.
namespace examples {

struct WallOptions {
  std::optional<double> x;                                 // no value: no wall [m]
  double angle = 0.0, friction = 0.5, stiffness = 1e4;     // [deg], -, [N/m]
  double until = std::numeric_limits<double>::infinity();  // [s]

  /// The surface on which the mission pushes, which the controller knows.
  std::optional<tilt_ropter::Surface> pushed;

  /// The wall at `time` [s].
  [[nodiscard]] std::optional<tilt_ropter::Wall> at(double time) const {
    if (pushed)
      return tilt_ropter::Wall{pushed->point, pushed->normal, friction, stiffness,
                               0.0,           pushed->tool};
    if (!x || time >= until) return std::nullopt;
    const double azimuth = angle * tilt_ropter::pi / 180.0;
    tilt_ropter::Wall wall;
    wall.point.x() = *x;
    wall.normal << -std::cos(azimuth), -std::sin(azimuth), 0.0;
    wall.friction = friction;
    wall.stiffness = stiffness;
    return wall;
  }
};

inline void add_wall(CLI::App& app, WallOptions& wall) {
  auto* x = app.add_option("--wall", wall.x,
                           "a wall that the controller does not know, at this x of the world; the "
                           "vehicle is on its side of small x [m]")
                ->check(CLI::Range(-100.0, 100.0));
  app.add_option("--wall-angle", wall.angle, "angle of the wall about z [deg]")
      ->check(CLI::Range(-180.0, 180.0))
      ->needs(x)
      ->capture_default_str();
  app.add_option("--wall-friction", wall.friction,
                 "friction coefficient of this wall, or of the surface on which the mission pushes")
      ->check(CLI::Range(0.0, 2.0))
      ->capture_default_str();
  app.add_option("--wall-stiffness", wall.stiffness, "stiffness of the same [N/m]")
      ->check(CLI::Range(100.0, 1e5))
      ->capture_default_str();
  app.add_option("--wall-until", wall.until, "time at which the wall goes away [s]")->needs(x);
}

/// Figures of a flight against a wall. A touch lasts until 0.5 s have passed without force.
class WallFigures {
 public:
  /// Call this after each step of the plant, of 1 ms. `wall`: as it is now; `force`: its normal
  /// force [N]; `blocked`: whether the controller says that it is blocked.
  void on_step(double time, const std::optional<tilt_ropter::Wall>& wall, double force,
               const tilt_ropter::BodyStated& body, double wanted_height, bool blocked) {
    sum_ += force - forces_[steps_ % forces_.size()];
    forces_[steps_++ % forces_.size()] = force;
    mean_ = std::max(mean_, sum_ / static_cast<double>(forces_.size()));
    largest_ = std::max(largest_, force);
    ever_blocked_ = ever_blocked_ || blocked;
    if (!wall && blocked) freed_at_ = time;
    if (!wall) return;
    if (force > 0.0) last_touch_ = time;
    const double silent = time - last_touch_;
    if (silent > 0.5) touch_ = never;
    if (silent == 0.0) touch_ = std::min(touch_, time);
    const bool rests = silent < 0.1 && std::abs(wall->normal.dot(body.velocity)) < 0.05;
    rest_ = rests && !blocked ? std::min(rest_, time) : never;
    unnoticed_ = std::max(unnoticed_, time - rest_);
    if (time - touch_ < 1.0) return;
    const Eigen::Vector3d up = body.orientation * Eigen::Vector3d::UnitZ();
    height_error_ = std::max(height_error_, std::abs(body.position.z() - wanted_height));
    lean_ = std::max(lean_, std::acos(std::clamp(up.z(), -1.0, 1.0)));
  }

  /// `until`: the time at which the wall went away.
  void print(std::ostream& out, double until) const {
    out << std::fixed << std::setprecision(3) << "blocked_after_s: ";
    if (ever_blocked_)
      out << unnoticed_;
    else
      out << "never";
    if (std::isfinite(until)) out << "\nfree_after_s: " << std::max(0.0, freed_at_ - until);
    out << std::setprecision(2) << "\nwall_force_max_n: " << mean_
        << "\nwall_impact_n: " << largest_ << std::setprecision(4)
        << "\nheight_error_max_m: " << height_error_ << std::setprecision(2)
        << "\nwall_lean_max_deg: " << lean_ * 180.0 / tilt_ropter::pi << '\n';
  }

 private:
  static constexpr double never = std::numeric_limits<double>::infinity();
  std::array<double, 100> forces_{};  // of the last 0.1 s [N]
  std::size_t steps_ = 0;
  double sum_ = 0.0, mean_ = 0.0, largest_ = 0.0;  // of the force [N]
  double last_touch_ = -never, touch_ = never;     // of all, the first of this touch [s]
  double rest_ = never, unnoticed_ = 0.0;          // on the wall without being blocked [s]
  double freed_at_ = 0.0, height_error_ = 0.0, lean_ = 0.0;  // [s], later than 1 s [m], [rad]
  bool ever_blocked_ = false;
};

}  // namespace examples
