#pragma once

#include "flight_log.hpp"

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>
#include <tilt_ropter/identification/clock_calibration.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/measurements.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

/// The state estimator on the logs of a flight, and why it refuses them.
namespace examples {

struct RecordedFlight {
  InertialLog imu;
  MarkerLog marker;
};

/// How the filter took the poses.
struct Reception {
  long poses = 0;     ///< poses and positions during the IMU's log
  double used = 0.0;  ///< fraction of them
  /// Fraction of the time at which the filter had restarted, was lost, or had implausible biases.
  double contradicted = 0.0;
  double mean_nis = 0.0;  ///< over the IMU's samples, each at most 100

  [[nodiscard]] bool is_poor() const { return !(used > 0.5) || contradicted > 0.25; }
  [[nodiscard]] bool is_good() const { return used > 0.8 && contradicted < 0.1; }
};

/// Runs the filter through the logs in the order of the stamps. Calls `on_sample(filter, i)` after
/// IMU sample i while it runs.
template <typename OnSample>
tilt_ropter::Ekfd run_filter(const RecordedFlight& flight, const tilt_ropter::EkfSettings& settings,
                             Reception& reception, OnSample&& on_sample) {
  using namespace tilt_ropter;
  Ekfd filter(settings);
  const InertialLog& imu = flight.imu;
  const double offset = settings.clock_offset;
  std::size_t pose = 0, position = 0, contradicted = 0;
  long used = 0;
  const double variance = settings.pose_noise.position * settings.pose_noise.position;
  PositionMeasurement<double> measured;
  measured.covariance = variance * Eigen::Matrix3d::Identity();
  measured.antenna = settings.marker_position;
  const auto is_due = [&](const auto& log, std::size_t next, double time) {
    return next < log.size() && log[next].time + offset <= time;
  };
  for (std::size_t i = 0; i < imu.size(); ++i) {
    filter.on_imu(imu[i].time, imu[i].value);
    const bool first = i == 0;
    for (; is_due(flight.marker.poses, pose, imu[i].time); ++pose) {
      filter.on_pose(flight.marker.poses[pose].time, flight.marker.poses[pose].value);
      if (!first) ++reception.poses;
    }
    for (; is_due(flight.marker.positions, position, imu[i].time); ++position) {
      measured.position = flight.marker.positions[position].value;
      const double time = flight.marker.positions[position].time + offset;
      if (filter.on_measurement(time, measured) == EkfStatus::updated) ++used;
      if (!first) ++reception.poses;
    }
    const EstimateTrust trust = filter.trust(imu[i].time);
    const bool starts = imu[i].time < imu.front().time + 1.0;
    if (!starts && (trust.restarted || trust.implausible_bias || trust.imu_contradicted ||
                    trust.state == EstimateState::lost || !filter.running()))
      ++contradicted;
    reception.mean_nis += (filter.running() ? std::min(filter.nis(), 100.0) : 100.0) /
                          static_cast<double>(imu.size());
    if (filter.running()) on_sample(filter, i);
  }
  used += filter.counts().used;
  reception.used =
      reception.poses > 0 ? static_cast<double>(used) / static_cast<double>(reception.poses) : 0.0;
  reception.contradicted = static_cast<double>(contradicted) / static_cast<double>(imu.size());
  return filter;
}

namespace detail {

/// What may be wrong with a log, and its correction.
template <typename Sample>
struct Suspicion {
  const char* text;
  std::function<void(Sample&)> correct;
  bool turns = false;  ///< it concerns rotations
};

using ImuSuspicion = Suspicion<tilt_ropter::InertialSampled>;
using PoseSuspicion = Suspicion<tilt_ropter::MarkerPosed>;

inline std::vector<ImuSuspicion> imu_suspicions() {
  using Sample = tilt_ropter::InertialSampled;
  const double g = tilt_ropter::gravity, degree = tilt_ropter::pi / 180.0;
  const auto exchanged = [](const Eigen::Vector3d& v) {
    return Eigen::Vector3d(v.y(), v.x(), v.z());
  };
  const auto flipped = [](const Eigen::Vector3d& v) {
    return Eigen::Vector3d(v.x(), -v.y(), -v.z());
  };
  return {
      {"", [](Sample&) {}},
      {"the accelerometer is in g instead of m/s^2", [g](Sample& s) { s.specific_force *= g; }},
      {"the accelerometer is in mg instead of m/s^2",
       [g](Sample& s) { s.specific_force *= 1e-3 * g; }},
      {"the accelerometer has the reversed sign: at rest it must show +9.81 m/s^2 upwards",
       [](Sample& s) { s.specific_force *= -1.0; }},
      {"the gyroscope is in degrees instead of rad/s",
       [degree](Sample& s) { s.angular_velocity *= degree; }, true},
      {"the gyroscope has the reversed sign", [](Sample& s) { s.angular_velocity *= -1.0; }, true},
      {"gyroscope and accelerometer are exchanged",
       [](Sample& s) { std::swap(s.angular_velocity, s.specific_force); }, true},
      {"the axes of the IMU are forward, right, down instead of forward, left, up",
       [flipped](Sample& s) {
         s.angular_velocity = flipped(s.angular_velocity);
         s.specific_force = flipped(s.specific_force);
       },
       true},
      {"the x and y axes of the IMU are exchanged",
       [exchanged](Sample& s) {
         s.angular_velocity = exchanged(s.angular_velocity);
         s.specific_force = exchanged(s.specific_force);
       },
       true}};
}

inline std::vector<PoseSuspicion> pose_suspicions() {
  using Pose = tilt_ropter::MarkerPosed;
  const auto turn_world = [](const Eigen::Quaterniond& q) {
    return [q](Pose& p) {
      p.position = q * p.position;
      p.orientation = q * p.orientation;
    };
  };
  const double half = std::sqrt(0.5);
  return {{"", [](Pose&) {}},
          {"the positions are in mm instead of m", [](Pose& p) { p.position *= 1e-3; }},
          {"the positions are in cm instead of m", [](Pose& p) { p.position *= 1e-2; }},
          {"the quaternions are x y z w instead of w x y z",
           [](Pose& p) {
             const Eigen::Quaterniond& q = p.orientation;
             p.orientation = Eigen::Quaterniond(q.z(), q.w(), q.x(), q.y());
           },
           true},
          {"the quaternions turn the world to the body instead of the body to the world",
           [](Pose& p) { p.orientation = p.orientation.conjugate(); }, true},
          {"z of the world points down (NED) instead of up (ENU)",
           turn_world(Eigen::Quaterniond(0.0, 1.0, 0.0, 0.0))},
          {"y of the world points up instead of z",
           turn_world(Eigen::Quaterniond(half, half, 0.0, 0.0))},
          {"the height has the reversed sign", [](Pose& p) { p.position.z() *= -1.0; }},
          {"the world is left-handed",
           [](Pose& p) {
             p.position.y() *= -1.0;
             p.orientation.x() *= -1.0;
             p.orientation.z() *= -1.0;
           },
           true}};
}

/// How far the stamps of the poses have to be shifted so that they overlap with those of the IMU
/// [s].
inline double shift_to_overlap(const InertialLog& imu, const PoseLog& poses) {
  const bool overlap = poses.front().time < imu.back().time && poses.back().time > imu.front().time;
  return overlap ? 0.0 : imu.front().time - poses.front().time;
}

}  // namespace detail

/// calibrate_clock() also for logs that do not overlap and, if `far`, for offsets of up to 5 s,
/// which it looks for with 20 poses per second.
inline tilt_ropter::ClockCalibration find_clock(const InertialLog& imu, PoseLog poses, bool far) {
  using namespace tilt_ropter;
  double shift = detail::shift_to_overlap(imu, poses);
  for (auto& pose : poses) pose.time += shift;
  ClockCalibration found = calibrate_clock(imu, poses);
  if (far && found.status != ClockCalibrationStatus::calibrated) {
    PoseLog few;
    for (const auto& pose : poses)
      if (few.empty() || pose.time > few.back().time + 0.045) few.push_back(pose);
    ClockCalibrationSettings settings;
    settings.max_offset = 5.0;
    const ClockCalibration coarse = calibrate_clock(imu, few, settings);
    if (coarse.status != ClockCalibrationStatus::calibrated) return found;
    for (auto& pose : poses) pose.time += coarse.offset;
    shift += coarse.offset;
    found = calibrate_clock(imu, poses);
  }
  found.offset += shift;
  return found;
}

/// Looks for the reason why the filter refused the poses of `flight`: tries units, orders, axes,
/// clock and marker frame on its first minute. Returns a sentence, empty if nothing helped.
inline std::string likely_reason(RecordedFlight flight, const tilt_ropter::EkfSettings& settings) {
  using namespace tilt_ropter;
  const auto shorten = [&flight](auto& log, double most) {
    while (!log.empty() && log.back().time > flight.imu.front().time + most) log.pop_back();
  };
  shorten(flight.imu, 60.0);
  const std::vector<detail::ImuSuspicion> imus = detail::imu_suspicions();
  const std::vector<detail::PoseSuspicion> poses = detail::pose_suspicions();
  std::map<std::pair<std::size_t, std::size_t>, ClockCalibration> clocks;
  const auto corrected = [&](std::size_t i, std::size_t k) {
    RecordedFlight other{flight.imu, {flight.marker.poses, {}, 0}};
    for (auto& sample : other.imu) imus[i].correct(sample.value);
    for (auto& pose : other.marker.poses) poses[k].correct(pose.value);
    return other;
  };
  struct Reason {
    double mean_nis;
    std::string text, also;
  };
  std::vector<Reason> found_reasons;
  const auto attempt = [&](std::size_t i, std::size_t k, bool calibrated) {
    const RecordedFlight other = corrected(i, k);
    EkfSettings with = settings;
    std::string also;
    if (calibrated) {
      const auto key = std::make_pair(imus[i].turns ? i : 0, poses[k].turns ? k : 0);
      if (clocks.count(key) == 0)
        clocks[key] = find_clock(other.imu, other.marker.poses, key.first + key.second == 0);
      const ClockCalibration& found = clocks[key];
      if (found.status != ClockCalibrationStatus::calibrated) return;
      with.clock_offset = found.offset;
      with.marker_orientation = found.marker_orientation;
      with.marker_orientation_stddev = 0.1;
      with.marker_position_stddev = 0.3;
      char shown[160];
      (void)std::snprintf(
          shown, sizeof shown,
          "the clock of the poses is off by %.3f s and their marker frame is "
          "turned by %.0f degrees (--calibrate)",
          found.offset - settings.clock_offset,
          settings.marker_orientation.angularDistance(found.marker_orientation) * 180.0 / pi);
      also = shown;
    }
    Reception reception;
    (void)run_filter(other, with, reception, [](const Ekfd&, std::size_t) {});
    if (!reception.is_good()) return;
    std::string text;
    for (const std::string& part : {std::string(imus[i].text), std::string(poses[k].text)})
      if (!part.empty()) text += (text.empty() ? "" : "; ") + part;
    found_reasons.push_back({reception.mean_nis, text, also});
  };
  const auto best = [&found_reasons] {
    std::sort(found_reasons.begin(), found_reasons.end(),
              [](const Reason& a, const Reason& b) { return a.mean_nis < b.mean_nis; });
    std::string text = found_reasons[0].text;
    for (std::size_t i = 1; i < found_reasons.size(); ++i)  // as a mirrored world and -force
      if (found_reasons[i].mean_nis < 1.01 * found_reasons[0].mean_nis && !text.empty())
        text += ", or " + found_reasons[i].text;
    const std::string& also = found_reasons[0].also;
    return text + (text.empty() || also.empty() ? "" : "; ") + also;
  };
  // The first of these sets in which something fits: one fault, or one of the IMU and one of the
  // poses, both without and with another clock and marker frame.
  for (const bool both : {false, true})
    for (const bool calibrated : {false, true}) {
      for (std::size_t i = 0; i < imus.size(); ++i)
        for (std::size_t k = 0; k < poses.size(); ++k)
          if ((i > 0 && k > 0) == both && (i + k > 0 || calibrated)) attempt(i, k, calibrated);
      if (!found_reasons.empty()) return best();
    }
  return "";
}

}  // namespace examples
