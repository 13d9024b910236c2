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

  static constexpr double good_use = 0.8, good_contradictions = 0.1;

  [[nodiscard]] bool is_poor() const { return !(used > 0.5) || contradicted > 0.25; }
  [[nodiscard]] bool is_good() const {
    return used > good_use && contradicted < good_contradictions;
  }
};

/// How far run_filter() goes.
enum class Replay { whole, while_it_can_be_good };

/// Runs the filter through the logs in the order of the stamps. Calls `on_sample(filter, i)` after
/// IMU sample i while it runs. `until` may end it as soon as the reception cannot be good any more.
template <typename OnSample>
tilt_ropter::Ekfd run_filter(const RecordedFlight& flight, const tilt_ropter::EkfSettings& settings,
                             Reception& reception, OnSample&& on_sample,
                             Replay until = Replay::whole) {
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
  const auto number_due = [&](const auto& log) {
    return std::count_if(log.begin(), log.end(),
                         [&](const auto& one) { return one.time + offset <= imu.back().time; });
  };
  const auto all = static_cast<double>(
      imu.empty() ? 0 : number_due(flight.marker.poses) + number_due(flight.marker.positions));
  constexpr double not_yet_used = 20.0;
  const double most_unused = (1.0 - Reception::good_use) * all + not_yet_used,
               most_contradicted = Reception::good_contradictions * static_cast<double>(imu.size());
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
    const double unused = static_cast<double>(reception.poses - used - filter.counts().used);
    if (until == Replay::while_it_can_be_good &&
        (unused > most_unused || static_cast<double>(contradicted) > most_contradicted))
      break;
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
  std::string text;
  std::function<void(Sample&)> correct;
  bool turns = false;  ///< it concerns rotations
  bool rare = false;   ///< it is tried alone
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
  std::vector<ImuSuspicion> all = {
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
  for (const auto& [unit, factor] :
       std::vector<std::pair<const char*, double>>{{"mm/s^2", 1e-3}, {"ft/s^2", 0.3048}})
    all.push_back({std::string("the accelerometer is in ") + unit + " instead of m/s^2",
                   [f = factor](Sample& s) { s.specific_force *= f; }, false, true});
  for (const auto& [unit, factor] : std::vector<std::pair<const char*, double>>{
           {"mrad/s", 1e-3}, {"revolutions per second", 360.0 * degree}, {"rpm", 6.0 * degree}})
    all.push_back({std::string("the gyroscope is in ") + unit + " instead of rad/s",
                   [f = factor](Sample& s) { s.angular_velocity *= f; }, true, true});
  constexpr const char* axes = "xyz";
  for (const bool gyro : {false, true}) {
    const auto part = [gyro](Sample& s) -> Eigen::Vector3d& {
      return gyro ? s.angular_velocity : s.specific_force;
    };
    const std::string sensor = gyro ? " of the gyroscope" : " of the accelerometer";
    for (int i = 0; i < 3; ++i) {
      all.push_back({std::string("the ") + axes[i] + " axis" + sensor + " has the reversed sign",
                     [part, i](Sample& s) { part(s)(i) *= -1.0; }, gyro, true});
      const int k = (i + 1) % 3;
      all.push_back(
          {std::string("the ") + axes[i] + " and " + axes[k] + " axes" + sensor + " are exchanged",
           [part, i, k](Sample& s) { std::swap(part(s)(i), part(s)(k)); }, gyro, true});
    }
  }
  // The rotations that turn the axes into each other, other than forward, right, down.
  for (int x = 0; x < 6; ++x)
    for (int y = 0; y < 6; ++y) {
      const auto axis = [](int n) {
        return Eigen::Vector3d((n < 3 ? 1.0 : -1.0) * Eigen::Vector3d::Unit(n % 3));
      };
      if (x % 3 == y % 3 || (x == 0 && (y == 1 || y == 4))) continue;
      Eigen::Matrix3d turn;  // IMU -> body
      turn << axis(x), axis(y), axis(x).cross(axis(y));
      const auto name = [](int n) { return std::string(n < 3 ? "" : "-") + axes[n % 3]; };
      all.push_back({"the IMU is turned: its x and y axes are " + name(x) + " and " + name(y) +
                         " of the body",
                     [turn](Sample& s) {
                       s.angular_velocity = (turn * s.angular_velocity).eval();
                       s.specific_force = (turn * s.specific_force).eval();
                     },
                     true, true});
    }
  return all;
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
  std::vector<PoseSuspicion> all = {
      {"", [](Pose&) {}},
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
  for (const auto& [unit, factor] : std::vector<std::pair<const char*, double>>{
           {"km", 1e3}, {"feet", 0.3048}, {"inches", 0.0254}})
    all.push_back({std::string("the positions are in ") + unit + " instead of m",
                   [f = factor](Pose& p) { p.position *= f; }, false, true});
  all.push_back({"the quaternions are w x y z instead of x y z w",
                 [](Pose& p) {
                   const Eigen::Quaterniond& q = p.orientation;
                   p.orientation = Eigen::Quaterniond(q.x(), q.y(), q.z(), q.w());
                 },
                 true, true});
  all.push_back({"y of the world points down",
                 turn_world(Eigen::Quaterniond(half, -half, 0.0, 0.0)), false, true});
  all.push_back({"x of the world points up", turn_world(Eigen::Quaterniond(half, 0.0, -half, 0.0)),
                 false, true});
  constexpr const char* axes = "xyz";
  for (int i = 0; i < 3; ++i) {
    const int k = (i + 1) % 3;
    const std::string both = std::string(1, axes[i]) + " and " + axes[k];
    if (i < 2)
      all.push_back({std::string("the ") + axes[i] + " positions have the reversed sign",
                     [i](Pose& p) { p.position(i) *= -1.0; }, false, true});
    all.push_back({"the " + both + " positions are exchanged",
                   [i, k](Pose& p) { std::swap(p.position(i), p.position(k)); }, false, true});
    all.push_back(
        {std::string("q") + axes[i] + " and q" + axes[k] + " are exchanged",
         [i, k](Pose& p) { std::swap(p.orientation.coeffs()(i), p.orientation.coeffs()(k)); }, true,
         true});
    if (i == 1) continue;  // above
    all.push_back({std::string("the world is left-handed: its ") + axes[i] + " is reversed",
                   [i](Pose& p) {
                     p.position(i) *= -1.0;
                     for (int other = 0; other < 3; ++other)
                       if (other != i) p.orientation.coeffs()(other) *= -1.0;
                   },
                   true, true});
  }
  return all;
}

/// How far the stamps of the poses have to be shifted so that they overlap with those of the IMU
/// [s].
inline double shift_to_overlap(const InertialLog& imu, const PoseLog& poses) {
  const bool overlap = poses.front().time < imu.back().time && poses.back().time > imu.front().time;
  return overlap ? 0.0 : imu.front().time - poses.front().time;
}

}  // namespace detail

/// 20 poses per second of a log that has more: enough to find a clock, in a fraction of the time.
inline PoseLog few_poses(const PoseLog& poses) {
  PoseLog few;
  for (const auto& pose : poses)
    if (few.empty() || pose.time > few.back().time + 0.045) few.push_back(pose);
  return few;
}

/// calibrate_clock() also for logs that do not overlap and, if `far`, for offsets of up to 5 s.
inline tilt_ropter::ClockCalibration find_clock(const InertialLog& imu, PoseLog poses, bool far) {
  using namespace tilt_ropter;
  double shift = detail::shift_to_overlap(imu, poses);
  for (auto& pose : poses) pose.time += shift;
  ClockCalibration found = calibrate_clock(imu, poses);
  if (far && found.status != ClockCalibrationStatus::calibrated) {
    ClockCalibrationSettings settings;
    settings.max_offset = 5.0;
    const ClockCalibration coarse = calibrate_clock(imu, few_poses(poses), settings);
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
  while (!flight.imu.empty() && flight.imu.back().time > flight.imu.front().time + 60.0)
    flight.imu.pop_back();
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
        clocks[key] =
            find_clock(other.imu, few_poses(other.marker.poses), key.first + key.second == 0);
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
    (void)run_filter(
        other, with, reception, [](const Ekfd&, std::size_t) {}, Replay::while_it_can_be_good);
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
  // The first of these sets in which something fits: one common fault, one rare fault, or one of
  // the IMU and one of the poses, each without and with another clock and marker frame.
  for (const char* set : {"common", "rare", "both"})
    for (const bool calibrated : {false, true}) {
      for (std::size_t i = 0; i < imus.size(); ++i)
        for (std::size_t k = 0; k < poses.size(); ++k) {
          const bool both = i > 0 && k > 0, rare = imus[i].rare || poses[k].rare;
          if (both && rare) continue;
          const std::string is_in = both ? "both" : rare ? "rare" : "common";
          if (is_in == set && (i + k > 0 || calibrated)) attempt(i, k, calibrated);
        }
      if (!found_reasons.empty()) return best();
    }
  // Clocks that rotations do not show. The filter itself finds the rest of the offset.
  for (int step = 1; step <= 10; ++step)
    for (const double shift : {0.15 * step, -0.15 * step}) {
      EkfSettings with = settings;
      with.clock_offset += shift;
      Reception reception;
      const Ekfd filter = run_filter(
          corrected(0, 0), with, reception, [](const Ekfd&, std::size_t) {},
          Replay::while_it_can_be_good);
      if (!reception.is_good()) continue;
      char shown[120];
      (void)std::snprintf(shown, sizeof shown,
                          "the clock of the poses is off by %.2f s (--clock-offset)",
                          shift - filter.trust(filter.time()).latency);
      return shown;
    }
  return "";
}

}  // namespace examples
