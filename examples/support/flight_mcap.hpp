#pragma once

#include "mcap.hpp"

#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/state.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

namespace examples {

/// What FlightMcap writes of a tick. A simulator does not know what the controller estimates.
struct FlightSample {
  double time = 0.0;  ///< [s]
  tilt_ropter::BodyStated truth, reference;
  tilt_ropter::Wrenchd true_external;
  std::optional<tilt_ropter::BodyStated> estimate;
  std::optional<tilt_ropter::Wrenchd> command, external;
  Eigen::VectorXd tilt_command, tilt, speed_command, speed;  ///< [rad], [rad/s]
  double power = 0.0;                                        ///< [W]
  std::string phase, mode;
};

/// The log of a flight as MCAP: frames `map` (ENU) and `base_link`, names of topics and messages
/// as those of the nodes in integrations/. The time is that of the flight.
class FlightMcap {
 public:
  /// Throws std::runtime_error if the file cannot be written; so do the other functions.
  FlightMcap(const std::string& path, int rotors);

  void on_imu(double time, const tilt_ropter::InertialSampled& sample);
  void on_pose(double time, const tilt_ropter::MarkerPosed& pose);
  void on_tick(const FlightSample& sample);
  void close() { writer_.close(); }

 private:
  [[nodiscard]] Cdr header(const char* frame) const;
  void write(std::uint16_t channel, const Cdr& message);
  void odometry(std::uint16_t channel, const tilt_ropter::BodyStated& body);
  void pose(std::uint16_t channel, const Eigen::Vector3d& position, const Eigen::Quaterniond& q);
  void wrench(std::uint16_t channel, const tilt_ropter::Wrenchd& wrench);
  void joints(std::uint16_t channel, const std::vector<std::string>& names,
              const Eigen::VectorXd& values, bool are_speeds);
  void text(std::uint16_t channel, const std::string& now, std::string& last);

  McapWriter writer_;
  std::uint64_t now_ = 0;  ///< [ns]
  std::uint16_t tf_, estimate_, truth_, reference_, pose_, imu_, command_, external_,
      true_external_, tilt_, tilt_command_, speed_, speed_command_, power_, phase_, mode_;
  std::vector<std::string> arms_, rotors_;  ///< names of joints
  std::string last_phase_, last_mode_;
};

}  // namespace examples
