#pragma once

#include "svg.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

/// The eight frames of a vehicle as a drawing (paper, Sec. Frame Definition), from its parameters.
namespace examples::paper {

namespace detail {

/// A parallel projection: the camera looks from azimuth and elevation [rad] at the origin.
class Camera {
 public:
  Camera(double azimuth, double elevation, double scale, Eigen::Vector2d centre)
      : right_(-std::sin(azimuth), std::cos(azimuth), 0.0),
        up_(-std::sin(elevation) * std::cos(azimuth), -std::sin(elevation) * std::sin(azimuth),
            std::cos(elevation)),
        scale_(scale),
        centre_(std::move(centre)) {}

  [[nodiscard]] Eigen::Vector2d operator()(const Eigen::Vector3d& point) const {
    return centre_ + scale_ * Eigen::Vector2d(right_.dot(point), -up_.dot(point));
  }

 private:
  Eigen::Vector3d right_, up_;
  double scale_;
  Eigen::Vector2d centre_;
};

/// Points of a circle in the plane of the axes `u` and `v`, from one angle to another [rad].
inline std::vector<Eigen::Vector2d> arc(const Camera& camera, const Eigen::Vector3d& centre,
                                        const Eigen::Vector3d& u, const Eigen::Vector3d& v,
                                        double radius, double from = 0.0,
                                        double to = 2.0 * tilt_ropter::pi) {
  std::vector<Eigen::Vector2d> points;
  constexpr int pieces = 48;
  for (int i = 0; i <= pieces; ++i) {
    const double angle = from + (to - from) * i / pieces;
    points.push_back(camera(centre + radius * (std::cos(angle) * u + std::sin(angle) * v)));
  }
  return points;
}

inline void draw_axes(Svg& svg, const Camera& camera, const Eigen::Isometry3d& frame,
                      const std::string& name, double length,
                      const std::vector<std::string>& axes = {"x", "y", "z"},
                      const Eigen::Vector2d& label = {-14.0, -8.0}) {
  const std::vector<std::string> colours{"#D55E00", "#009E73", "#0072B2"};
  const Eigen::Vector2d origin = camera(frame.translation());
  for (int i = 0; i < 3; ++i) {
    const auto k = static_cast<std::size_t>(i);
    const Eigen::Vector3d end = frame.translation() + length * frame.linear().col(i);
    const Eigen::Vector2d tip = camera(end);
    Style style;
    style.stroke = colours[k];
    style.width = 2.2;
    if ((tip - origin).norm() > 10.0) svg.arrow({origin, tip}, style);
    const Eigen::Vector2d out = (tip - origin).norm() > 1.0
                                    ? Eigen::Vector2d((tip - origin).normalized())
                                    : Eigen::Vector2d(1.0, 0.0);
    const bool beside = axes[k].size() > 1 && std::abs(out.x()) > 0.5;
    svg.text(tip + 10.0 * out + Eigen::Vector2d(0.0, 4.0), axes[k], 12.0,
             beside ? "start" : "middle", colours[k]);
  }
  svg.text(origin + label, name, 15.0, "middle", "#222222", "font-weight=\"bold\"");
}

}  // namespace detail

/// Returns the drawing.
template <int Rotors>
[[nodiscard]] std::string draw_frames(const tilt_ropter::Vehicle<Rotors>& vehicle) {
  using namespace tilt_ropter;
  using Eigen::Vector3d;
  const double width = 1000.0, height = 640.0;
  double reach = 0.05;  // of the vehicle [m]
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i)
    reach = std::max(
        reach, vehicle.rotors[i].position.norm() + rotor_parameters(vehicle, i).propeller_radius);
  if (vehicle.wheels) reach = std::max(reach, vehicle.wheels->half_track + 0.06);
  const double degree = pi / 180.0;
  const detail::Camera camera(-58.0 * degree, 30.0 * degree, 0.40 * width / reach / 1.25,
                              {0.53 * width, 0.42 * height});
  Svg svg(static_cast<int>(width), static_cast<int>(height), "Coordinate frames of the vehicle");

  // The ground, with the world frame on it.
  const auto stands = undercarriage(vehicle);
  const double ground = stands ? -stands->height : -0.12;
  Style thin;
  thin.stroke = "#DDDDDD";
  thin.width = 1.0;
  for (int i = -5; i <= 5; ++i) {
    const double at = 0.2 * i * reach * 1.3, end = reach * 1.3;
    svg.polyline({camera({at, -end, ground}), camera({at, end, ground})}, thin);
    svg.polyline({camera({-end, at, ground}), camera({end, at, ground})}, thin);
  }
  Eigen::Isometry3d world = Eigen::Isometry3d::Identity();
  world.translation() << -1.04 * reach, -1.04 * reach, ground;
  detail::draw_axes(svg, camera, world, "I", 0.45 * reach, {"x: east", "y: north", "z: up"},
                    {-16.0, 12.0});

  // Wheels, axle, base, arms, propellers.
  if (vehicle.wheels) {
    const std::size_t count = vehicle.wheels->wheel_base > 0.0 ? 4 : 2;
    Style tyre;
    tyre.stroke = "#555555";
    tyre.fill = "#BBBBBB";
    tyre.width = 4.0;
    tyre.opacity = 0.55;
    Style axle;
    axle.stroke = "#999999";
    axle.width = 3.0;
    axle.dashes = "6 4";
    for (std::size_t i = 0; i < count; ++i) {
      const Eigen::Isometry3d wheel = wheel_in_body(vehicle, i);
      svg.polyline(detail::arc(camera, wheel.translation(), wheel.linear().col(1),
                               wheel.linear().col(2), vehicle.wheels->radius),
                   tyre, true);
      if (i % 2 == 0)
        svg.polyline(
            {camera(wheel.translation()), camera(wheel_in_body(vehicle, i + 1).translation())},
            axle);
    }
  }
  Style arm;
  arm.stroke = "#444444";
  arm.width = 5.0;
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i) {
    const Eigen::Isometry3d rotor = rotor_in_body(vehicle, i);
    svg.polyline({camera(Vector3d::Zero()), camera(rotor.translation())}, arm);
  }
  Style base;
  base.fill = "#E8E8E8";
  const double half = 0.16 * reach;
  svg.polyline({camera({half, half, 0.0}), camera({-half, half, 0.0}), camera({-half, -half, 0.0}),
                camera({half, -half, 0.0})},
               base, true);
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i) {
    const Eigen::Isometry3d rotor = rotor_in_body(vehicle, i);
    const RotorParameters& parameters = rotor_parameters(vehicle, i);
    const double radius = parameters.propeller_radius;
    if (!(radius > 0.0)) continue;  // unknown
    const Vector3d u = rotor.linear().col(0), v = rotor.linear().col(1),
                   centre = rotor * Vector3d(0.0, 0.0, parameters.propeller_height);
    Style disc;
    disc.stroke = "#888888";
    disc.fill = "#DFEDF7";
    disc.opacity = 0.6;
    svg.polyline(detail::arc(camera, centre, u, v, radius), disc, true);
    const double turn = vehicle.rotors[i].spin == Spin::counter_clockwise ? 1.0 : -1.0;
    Style spin;
    spin.stroke = "#CC79A7";
    spin.width = 2.0;
    svg.arrow(detail::arc(camera, centre, u, v, 0.8 * radius, turn * 2.2, turn * 4.6), spin, 8.0);
  }

  detail::draw_axes(svg, camera, Eigen::Isometry3d::Identity(), "B", 0.5 * reach);
  for (std::size_t i = 0; i < vehicle.rotors.size(); ++i)
    detail::draw_axes(svg, camera, rotor_in_body(vehicle, i), "R" + std::to_string(i + 1),
                      0.26 * reach);
  if (vehicle.wheels)
    for (std::size_t i = 0; i < (vehicle.wheels->wheel_base > 0.0 ? 4U : 2U); ++i)
      detail::draw_axes(svg, camera, wheel_in_body(vehicle, i), "W" + std::to_string(i + 1),
                        0.26 * reach, {"x", "y", "z"}, {-4.0, 22.0});
  svg.text({20.0, height - 18.0},
           "Arms, wheels and propellers to scale. Pink: direction of rotation. At a tilt angle, a "
           "thrust turns about the x axis of its rotor frame.",
           12.0, "start", "#666666");
  return svg.str();
}

}  // namespace examples::paper
