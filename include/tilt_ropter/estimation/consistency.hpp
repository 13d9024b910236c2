// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>

/// Residuals between sources that know the same quantity: a residual far above its expected spread
/// shows that one of the two is wrong, whichever of them an estimator follows.
namespace tilt_ropter {

/// Difference of two sources.
struct Residual {
  double value = 0.0;   ///< measured minus expected, in the unit of its function
  double spread = 1.0;  ///< expected standard deviation in normal flight, > 0, in the same unit

  /// Value over spread. Zero if the value is not finite: then there is nothing to compare.
  [[nodiscard]] double ratio() const noexcept { return std::isfinite(value) ? value / spread : 0; }
};

/// What the sources of a loop predict of each other, see the functions below.
struct Consistency {
  Residual rotor_speed;  ///< measured against commanded rotor speed [rad/s]
  Residual wrench;       ///< felt against modelled force, in the air [N]
  Residual pose;         ///< poses against IMU [-]
  Residual load;         ///< load against height and vertical speed [N]
  Residual battery;      ///< rotor speed against battery voltage [rad/s]
};

/// The rotor whose `measured` speed differs most from its `modelled` speed under the command
/// [rad/s]. The spread allows for the sensor's noise and for the lag of the motors in transients.
template <int Rotors>
[[nodiscard]] Residual rotor_speed_residual(
    const Eigen::Matrix<double, Rotors, 1>& measured,
    const Eigen::Matrix<double, Rotors, 1>& modelled) noexcept {
  constexpr double noise = 10.0, fraction = 0.02;  // [rad/s], of the modelled speed
  Residual largest;
  for (int i = 0; i < Rotors; ++i) {
    const Residual one{measured(i) - modelled(i), noise + fraction * std::abs(modelled(i))};
    if (std::abs(one.ratio()) > std::abs(largest.ratio())) largest = one;
  }
  return largest;
}

/// Size of the unfiltered external `force` (ObservedWrench::raw or its mean over a tick, [N])
/// in the air. The spread is the force of a light wind, or of 5 % error of mass or thrust.
[[nodiscard]] inline Residual wrench_residual(const Eigen::Vector3d& force, double weight,
                                              bool on_ground) noexcept {
  return {on_ground ? 0.0 : force.norm(), 0.05 * weight};
}

/// For the NIS of a pose, see Ekf::nis(): chi-square of `rows` degrees of freedom.
[[nodiscard]] inline Residual pose_residual(double nis, int rows = 6) noexcept {
  return {nis - rows, std::sqrt(2.0 * rows)};
}

/// The load that height and vertical speed exclude: the upward external force [N] in the air, with
/// the lowest points of the undercarriage more than 5 cm above the estimated ground, or while they
/// move from it or into it at more than 0.5 m/s. `standing` is the height of the CoM above these
/// points [m]. The spread is the load of a gust or of a wrong mass.
[[nodiscard]] inline Residual load_residual(const ContactEstimate& contact, const BodyStated& body,
                                            double weight, double standing) noexcept {
  const GroundPlane& ground = contact.ground;
  const double clearance = body.position.z() - standing - ground.height_at(body.position),
               rising = body.velocity.z() - ground.rise(body.velocity);
  const bool is_excluded = (!contact.on_ground && clearance > 0.05) || std::abs(rising) > 0.5;
  return {is_excluded ? (body.orientation * contact.external.force).z() : 0.0, 0.1 * weight};
}

/// How far `measured` rotor speeds exceed the top speeds [rad/s] that the measured voltage of the
/// battery allows; zero below them. The spread is 2 % of the top speed.
template <int Rotors>
[[nodiscard]] Residual battery_residual(const Eigen::Matrix<double, Rotors, 1>& measured,
                                        const Eigen::Matrix<double, Rotors, 1>& top) noexcept {
  Residual largest;
  for (int i = 0; i < Rotors; ++i) {
    const Residual one{std::max(0.0, measured(i) - top(i)), 0.02 * top(i)};
    if (one.ratio() > largest.ratio()) largest = one;
  }
  return largest;
}

}  // namespace tilt_ropter
