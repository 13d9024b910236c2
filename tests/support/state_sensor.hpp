#pragma once

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <optional>

namespace test_support {

using tilt_ropter::BodyStated;
using tilt_ropter::quaternion_exp;
using tilt_ropter::require_non_negative;

/// Sensor of the whole body state. It replaces sensors and estimator in tests of a controller.
struct StateSensorParameters {
  double rate = 1000.0;                  ///< measurements per second [Hz]
  double delay = 0.0;                    ///< from measurement to output [s]
  double position_noise = 1.0e-3;        ///< standard deviation per axis, world frame [m]
  double velocity_noise = 1.0e-2;        ///< standard deviation per axis, world frame [m/s]
  double orientation_noise = 3.0e-3;     ///< standard deviation per axis, body frame [rad]
  double angular_velocity_noise = 1e-2;  ///< standard deviation per axis, body frame [rad/s]
};

inline void validate(const StateSensorParameters& p) {
  tilt_ropter::detail::require_timing("StateSensorParameters", p.rate, p.delay);
  require_non_negative("StateSensorParameters.position_noise [m]", p.position_noise);
  require_non_negative("StateSensorParameters.velocity_noise [m/s]", p.velocity_noise);
  require_non_negative("StateSensorParameters.orientation_noise [rad]", p.orientation_noise);
  require_non_negative("StateSensorParameters.angular_velocity_noise [rad/s]",
                       p.angular_velocity_noise);
}

struct StateMeasurement {
  double time = 0.0;  ///< at which it was taken [s]
  BodyStated body;
};

/// Simulated sensor of the body state with white noise, a rate and a delay.
class StateSensor : public tilt_ropter::detail::Sensor<StateSensorParameters, StateMeasurement> {
 public:
  using Sensor::Sensor;

  [[nodiscard]] std::optional<Measurement> sample(double time, const BodyStated& truth) noexcept {
    if (is_finite(truth) && due(time)) {
      const StateSensorParameters& p = parameters_;
      Measurement m;
      m.time = time;
      m.body.position = truth.position + noise_.draw<3>(p.position_noise);
      m.body.velocity = truth.velocity + noise_.draw<3>(p.velocity_noise);
      m.body.orientation =
          (truth.orientation * quaternion_exp(noise_.draw<3>(p.orientation_noise))).normalized();
      m.body.angular_velocity = truth.angular_velocity + noise_.draw<3>(p.angular_velocity_noise);
      push(time, m);
    }
    return pop(time);
  }
};

}  // namespace test_support
