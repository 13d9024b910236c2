// Replays a recorded flight through the state estimator. Reads IMU and motion capture from CSV
// files or a ULog of PX4, calibrates clocks and marker frame on request, and compares the estimate
// with the ground truth if it is given.

#include "../support/mission_log.hpp"
#include "../support/pictures.hpp"
#include "../support/progress.hpp"
#include "../support/px4_log.hpp"
#include "../support/replay.hpp"
#include "../support/statistics.hpp"
#include "../support/ulog.hpp"

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/identification/clock_calibration.hpp>
#include <tilt_ropter/identification/log_calibration.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <CLI/CLI.hpp>
#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/SVD>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <iomanip>
#include <iostream>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

using namespace tilt_ropter;

namespace {

using examples::Reception;
using examples::RecordedFlight;
using States = examples::StateLog;

struct Options {
  std::string imu, poses, truth, output = "results";
  std::string pose_topic, truth_topic;  // of a ULog; empty: what is there
  std::vector<double> marker_rotation = {1.0, 0.0, 0.0, 0.0}, marker_lever = {0.0, 0.0, 0.0};
  std::vector<double> gyro_bias = {0.0, 0.0, 0.0}, accelerometer_bias = {0.0, 0.0, 0.0};
  bool calibrate = false, calibrate_clock = false, estimate_marker_pose = false;
  bool no_pictures = false;
  double judge_from = 3.0, gravity_deviation = 0.0;
  EkfSettings filter;
};

// ---- Flight

std::vector<std::string> columns(bool with_errors) {
  std::vector<std::string> names = {"time_s"};
  const auto add = [&names](const std::string& name, const std::vector<std::string>& parts) {
    for (const std::string& part : parts) names.push_back(name + "_" + part);
  };
  const std::vector<std::string> axes = {"x", "y", "z"};
  add("position_m", axes);
  add("velocity_mps", axes);
  add("orientation", {"w", "x", "y", "z"});
  add("angular_velocity_radps", axes);
  add("gyro_bias_radps", axes);
  add("accelerometer_bias_mps2", axes);
  add("marker_position_m", axes);
  add("marker_orientation", {"w", "x", "y", "z"});
  for (const char* part :
       {"position_m", "velocity_mps", "orientation_rad", "gyro_bias_radps",
        "accelerometer_bias_mps2", "marker_orientation_rad", "marker_position_m"})
    add(std::string("deviation_") + part, axes);
  names.emplace_back("nis");
  if (with_errors)
    for (const char* part : {"position_m", "velocity_mps", "orientation_rad"})
      add(std::string("error_") + part, axes);
  return names;
}

/// Start index of each part of error().
struct ErrorIndex {
  static constexpr int position = 0, velocity = 3, attitude = 6;
};

/// Returns the errors of position, velocity and orientation: the tangent vector from `estimate` to
/// `truth`.
Eigen::Matrix<double, 9, 1> error(const BodyStated& truth, const BodyStated& estimate) {
  Eigen::Matrix<double, 9, 1> e;
  e << truth.position - estimate.position, truth.velocity - estimate.velocity,
      quaternion_log(Eigen::Quaterniond(estimate.orientation.conjugate() * truth.orientation));
  return e;
}

/// The ground truth, interpolated between samples. at() returns nullptr outside the samples and
/// between samples that are more than 0.11 s apart (PX4 logs the truth of its simulation at 10 Hz).
class Truth {
 public:
  explicit Truth(States states) : states_(std::move(states)) {}

  [[nodiscard]] bool empty() const { return states_.empty(); }

  [[nodiscard]] const BodyStated* at(double time) {
    const auto after =
        std::upper_bound(states_.begin(), states_.end(), time,
                         [](double t, const Timed<BodyStated>& s) { return t < s.time; });
    if (after == states_.begin() || after == states_.end()) return nullptr;
    const Timed<BodyStated>&a = *(after - 1), &b = *after;
    if (b.time - a.time > 0.11) return nullptr;
    const double fraction = (time - a.time) / (b.time - a.time);
    const auto blend = [fraction](const Eigen::Vector3d& from, const Eigen::Vector3d& to) {
      return Eigen::Vector3d(from + fraction * (to - from));
    };
    now_.position = blend(a.value.position, b.value.position);
    now_.velocity = blend(a.value.velocity, b.value.velocity);
    now_.orientation = a.value.orientation.slerp(fraction, b.value.orientation);
    return &now_;
  }

 private:
  States states_;
  BodyStated now_;
};

struct Errors {
  examples::Rmse position, velocity, attitude;  // [m], [m/s], [rad]
};

Errors judge(const States& estimate, Truth& truth, double from, double shift) {
  Errors r;
  for (const Timed<BodyStated>& s : estimate) {
    if (s.time < from) continue;
    const BodyStated* t = truth.at(s.time + shift);
    if (t == nullptr) continue;
    const Eigen::Matrix<double, 9, 1> e = error(*t, s.value);
    r.position.add_square(e.segment<3>(ErrorIndex::position).squaredNorm());
    r.velocity.add_square(e.segment<3>(ErrorIndex::velocity).squaredNorm());
    r.attitude.add_square(e.segment<3>(ErrorIndex::attitude).squaredNorm());
  }
  return r;
}

/// Returns the time shift of the truth for which the positions fit best [s]; positive: truth read
/// later.
double best_shift(const States& estimate, Truth& truth, double from) {
  double best = 0.0;
  for (double step = 4e-3; step > 4e-5; step /= 4.0) {
    const double middle = best;
    double lowest = std::numeric_limits<double>::infinity();
    for (int i = -8; i <= 8; ++i) {
      const double position = judge(estimate, truth, from, middle + i * step).position.value();
      if (position < lowest) {
        lowest = position;
        best = middle + i * step;
      }
    }
  }
  return best;
}

void log_row(examples::MissionLog& log, const Ekfd& filter, Truth& truth) {
  const BodyStated body = filter.state();
  const InertialStated& x = filter.filter().state();
  const auto add_rotation = [&log](const Eigen::Quaterniond& q) {
    log.add(q.w()).add(q.x()).add(q.y()).add(q.z());
  };
  log.add(filter.time()).add_all(body.position).add_all(body.velocity);
  add_rotation(body.orientation);
  log.add_all(body.angular_velocity).add_all(x.gyro_bias).add_all(x.accelerometer_bias);
  log.add_all(x.marker_position);
  add_rotation(x.marker_orientation);
  log.add_all(filter.filter().covariance().diagonal().cwiseMax(0.0).cwiseSqrt().eval());
  log.add(filter.nis());
  if (!truth.empty()) {
    const BodyStated* t = truth.at(filter.time());
    constexpr double unknown = std::numeric_limits<double>::quiet_NaN();
    log.add_all(t != nullptr ? error(*t, body)
                             : Eigen::Matrix<double, 9, 1>::Constant(unknown).eval());
  }
  log.end_row();
}

/// Runs the filter through the logs. Writes the estimate to `log` and `estimate` if they are not
/// null.
Ekfd fly(const RecordedFlight& flight, const EkfSettings& settings, const std::string& doing,
         Truth& truth, examples::MissionLog* log, States* estimate, Reception& reception) {
  examples::Progress progress;
  Ekfd filter =
      examples::run_filter(flight, settings, reception, [&](const Ekfd& at, std::size_t i) {
        if (i % 500 == 0)
          progress.show(static_cast<double>(i) / static_cast<double>(flight.imu.size()), doing);
        if (estimate != nullptr) estimate->push_back({at.time(), at.state()});
        if (log != nullptr) log_row(*log, at, truth);
      });
  progress.finish();
  return filter;
}

// ---- Options and report

Eigen::Quaterniond marker_rotation(const std::vector<double>& numbers) {
  if (numbers.size() == 4) {
    const Eigen::Quaterniond q(numbers[0], numbers[1], numbers[2], numbers[3]);
    if (std::abs(q.norm() - 1.0) > 0.01)
      throw std::runtime_error("--marker-rotation: the length of the quaternion is not 1");
    return q.normalized();
  }
  const Eigen::Matrix3d m =
      Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(numbers.data());
  if ((m * m.transpose() - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff() > 0.01 ||
      m.determinant() < 0.0)
    throw std::runtime_error("--marker-rotation: the matrix is not a rotation matrix");
  return Eigen::Quaterniond(m).normalized();
}

void print(const char* key, double value, int digits) {
  std::cout << key << ": " << std::fixed << std::setprecision(digits) << value << '\n';
}

template <typename Vector>
std::string numbers(const Vector& values) {
  std::ostringstream text;
  for (Eigen::Index i = 0; i < values.size(); ++i) text << (i > 0 ? " " : "") << values(i);
  return text.str();
}

const char* meaning(ClockCalibrationStatus status) {
  switch (status) {
    case ClockCalibrationStatus::bad_data:
      return "a number is not finite, a quaternion is not unit, or stamps do not increase";
    case ClockCalibrationStatus::too_short:
      return "fewer than 100 rotations to compare";
    case ClockCalibrationStatus::out_of_range:
      return "no offset within half a second fits";
    case ClockCalibrationStatus::uncertain:
      return "too little rotation, or rotation about one axis only, or rotations of IMU and poses "
             "that do not agree";
    case ClockCalibrationStatus::ambiguous:
      return "the motion repeats itself, so several fit";
    default:
      return to_string(status);
  }
}

const char* meaning(LogCalibrationStatus status) {
  switch (status) {
    case LogCalibrationStatus::bad_data:
      return meaning(ClockCalibrationStatus::bad_data);
    case LogCalibrationStatus::imu_gap:
      return "the IMU pauses for more than 50 ms";
    case LogCalibrationStatus::not_converged:
      return "the least squares do not converge";
    default:
      return to_string(status);
  }
}

/// Throws std::runtime_error that says what failed and the likely reason.
[[noreturn]] void fail(const RecordedFlight& flight, const EkfSettings& settings,
                       const std::string& what) {
  std::cerr << "replay_flight: looks for the likely reason, up to half a minute\n";
  const std::string reason = examples::likely_reason(flight, settings);
  throw std::runtime_error(what + (reason.empty() ? "; no unit, order, axes or clock was found "
                                                    "with which the logs agree"
                                                  : "; likely reason: " + reason));
}

/// Calibrates from the whole log, prints the result, and sets it in `settings`.
void calibrate(const Options& options, const RecordedFlight& flight, EkfSettings& settings) {
  LogCalibrationSettings how;
  how.imu_noise = settings.imu_noise;
  how.pose_noise = settings.pose_noise;
  how.gravity_stddev = options.gravity_deviation;
  LogCalibration found = calibrate_log(flight.imu, flight.marker.poses, how);
  if (found.status == LogCalibrationStatus::no_clock) {  // the clocks may be further apart
    const ClockCalibration clock = examples::find_clock(flight.imu, flight.marker.poses, true);
    examples::PoseLog shifted = flight.marker.poses;
    for (auto& pose : shifted) pose.time += clock.offset;
    if (clock.status == ClockCalibrationStatus::calibrated) {
      found = calibrate_log(flight.imu, shifted, how);
      found.clock_offset += clock.offset;
    }
  }
  if (found.status != LogCalibrationStatus::calibrated) {
    std::string why = meaning(found.status);
    if (found.status == LogCalibrationStatus::no_clock)
      why = std::string("the clock offset is not found: ") + meaning(found.clock);
    if (found.status == LogCalibrationStatus::uncertain)
      why = "the motion does not show " + found.uncertain +
            ": the log needs more rotation about all axes";
    fail(flight, settings, "the log cannot be calibrated: " + why);
  }
  settings.clock_offset = found.clock_offset;
  settings.marker_orientation = found.marker_orientation;
  settings.marker_position = found.marker_position;
  settings.gyro_bias = found.gyro_bias;
  settings.accelerometer_bias = found.accelerometer_bias;
  const Eigen::Quaterniond& q = found.marker_orientation;
  const auto line = [](const char* key, const auto& values) {
    std::cout << key << ": " << numbers(values) << '\n';
  };
  print("clock_offset_95_s", found.clock_offset_95, 6);
  line("marker_position_95_m", found.marker_position_95);
  line("marker_orientation_95_rad", found.marker_orientation_95);
  line("gyro_bias_radps", found.gyro_bias);
  line("gyro_bias_95_radps", found.gyro_bias_95);
  line("accelerometer_bias_mps2", found.accelerometer_bias);
  line("accelerometer_bias_95_mps2", found.accelerometer_bias_95);
  if (options.gravity_deviation > 0.0) {
    line("gravity_tilt_rad", found.gravity_tilt);
    line("gravity_tilt_95_rad", found.gravity_tilt_95);
  }
  print("calibration_position_residual_m", found.position_residual, 6);
  print("calibration_orientation_residual_rad", found.orientation_residual, 6);
  print("calibration_error_scale", found.error_scale, 2);
  std::cout << "calibration_outliers: " << found.outliers
            << "\nreplay with it:" << std::setprecision(6)
            << " --clock-offset=" << found.clock_offset << " --marker-rotation "
            << numbers(Eigen::Vector4d(q.w(), q.x(), q.y(), q.z())) << " --marker-lever "
            << numbers(found.marker_position) << " --gyro-bias " << numbers(found.gyro_bias)
            << " --accelerometer-bias " << numbers(found.accelerometer_bias) << '\n';
}

/// Says where a log pauses for longer than a second and ten of its intervals, or ends early.
template <typename Log>
void warn_of_pause(const Log& log, const char* name, double until) {
  double longest = until - log.back().time, start = log.back().time;
  for (std::size_t i = 1; i < log.size(); ++i) {
    const double pause = log[i].time - log[i - 1].time;
    if (pause <= longest) continue;
    longest = pause;
    start = log[i - 1].time;
  }
  const double interval = (log.back().time - log.front().time) / static_cast<double>(log.size());
  if (longest > std::max(1.0, 10.0 * interval))
    std::cerr << "replay_flight: no " << name << " for " << std::setprecision(3) << longest
              << " s from " << start << " s on: is the log whole?\n";
}

void print_errors(const Options& options, const examples::InertialLog& imu, const States& estimate,
                  Truth& truth, bool trusted) {
  const double from = imu.front().time + options.judge_from;
  const Errors plain = judge(estimate, truth, from, 0.0);
  if (plain.position.count() == 0) {
    std::cerr << "replay_flight: the truth has no samples at the times of the estimate\n";
    return;
  }
  print("position_rmse_m", plain.position.value(), 5);
  print("attitude_rmse_deg", plain.attitude.value() * 180.0 / pi, 3);
  print("velocity_rmse_mps", plain.velocity.value(), 5);
  const double shift = best_shift(estimate, truth, from);
  const Errors shifted = judge(estimate, truth, from, shift);
  print("truth_shift_s", shift, 5);
  print("shifted_position_rmse_m", shifted.position.value(), 5);
  print("shifted_attitude_rmse_deg", shifted.attitude.value() * 180.0 / pi, 3);
  print("shifted_velocity_rmse_mps", shifted.velocity.value(), 5);
  if (!trusted) return;
  if (shifted.position.value() > 0.5 || shifted.velocity.value() > 0.5 ||
      shifted.attitude.value() > 0.35)
    std::cerr << "replay_flight: the truth is far from the estimate: unit, order of the "
                 "quaternion, frame (velocities in the world, z up) or clock of the truth?\n";
}

/// A flight from CSV files, a ULog, or IMU and truth from a ULog and poses from a CSV file.
struct Logs {
  RecordedFlight flight;
  States truth;
  double origin = 0.0;  // see FlightLogs
};

/// Prints what was assumed.
Logs read_logs(const Options& options) {
  Logs read;
  examples::FlightLogs tables;
  std::vector<std::string> notes;
  if (examples::is_ulog(options.imu)) {
    const examples::Ulog log(options.imu);
    const std::string poses =
        options.pose_topic.empty() ? examples::px4_pose_topic(log) : options.pose_topic;
    notes = log.notes();
    read.flight.imu = examples::px4_imu(log);
    if (options.poses.empty()) {
      read.flight.marker = examples::px4_poses(log, poses);
      if (read.flight.marker.poses.size() < 2)
        throw InputFileError(options.imu + ": fewer than two poses of " + poses);
      const bool estimated = poses == "vehicle_odometry" || poses == "vehicle_local_position";
      notes.push_back(options.imu + ": poses are those of " + poses +
                      (estimated ? ", PX4's own estimate" : ""));
    }
    std::string truth = options.truth_topic;
    if (truth.empty() && log.has("vehicle_local_position_groundtruth"))
      truth = "vehicle_local_position_groundtruth";
    if (!truth.empty()) read.truth = examples::px4_states(log, truth);
    if (!options.truth_topic.empty() && read.truth.size() < 2)
      throw InputFileError(options.imu + ": fewer than two states of " + truth);
    if (!read.truth.empty()) notes.push_back(options.imu + ": the truth is " + truth);
  } else {
    read.flight.imu = tables.imu(options.imu);
  }
  if (!options.poses.empty()) read.flight.marker = tables.poses(options.poses);
  if (!options.truth.empty()) read.truth = tables.truth(options.truth);
  read.origin = tables.origin();
  for (const std::vector<std::string>& list : {tables.notes(), notes})
    for (const std::string& note : list) std::cerr << note << '\n';
  return read;
}

void replay(const Options& options) {
  const Logs read = read_logs(options);
  const RecordedFlight& flight = read.flight;
  Truth truth(read.truth);
  const examples::InertialLog& imu = flight.imu;
  const examples::PoseLog& poses = flight.marker.poses;

  EkfSettings settings = options.filter;
  const Eigen::Quaterniond given = marker_rotation(options.marker_rotation);
  settings.marker_orientation = given;
  settings.marker_position << options.marker_lever[0], options.marker_lever[1],
      options.marker_lever[2];
  const Eigen::Vector3d given_lever = settings.marker_position;
  settings.gyro_bias = Eigen::Map<const Eigen::Vector3d>(options.gyro_bias.data());
  settings.accelerometer_bias =
      Eigen::Map<const Eigen::Vector3d>(options.accelerometer_bias.data());

  if (options.calibrate) calibrate(options, flight, settings);
  if (options.calibrate_clock || options.estimate_marker_pose) {
    const ClockCalibration found = examples::find_clock(imu, poses, true);
    const bool ok = found.status == ClockCalibrationStatus::calibrated;
    if (options.calibrate_clock) {
      if (!ok)
        fail(flight, settings,
             std::string("the clocks cannot be calibrated: ") + meaning(found.status));
      settings.clock_offset = found.offset;
      print("clock_offset_deviation_s", found.stddev, 5);
    }
    // The clock calibration also gives the rotation and needs no initial guess for it.
    if (options.estimate_marker_pose && ok) settings.marker_orientation = found.marker_orientation;
  }
  if (options.estimate_marker_pose) {
    // A first pass estimates the marker frame; the second pass uses it.
    settings.marker_orientation_stddev = 0.1;
    settings.marker_position_stddev = 0.3;
    Reception ignored;
    const Ekfd first =
        fly(flight, settings, "looking for the marker frame", truth, nullptr, nullptr, ignored);
    settings.marker_orientation = first.filter().state().marker_orientation;
    settings.marker_position = first.filter().state().marker_position;
    settings.marker_orientation_stddev = settings.marker_position_stddev = 0.0;
  }

  warn_of_pause(imu, "IMU sample", imu.back().time);
  if (flight.marker.positions.empty())
    warn_of_pause(poses, "pose", imu.back().time - settings.clock_offset);
  std::filesystem::create_directories(options.output);
  examples::MissionLog log(options.output + "/replay_flight.csv", columns(!truth.empty()));
  States estimate;
  Reception reception;
  const Ekfd filter =
      fly(flight, settings, "replaying the flight", truth, &log, &estimate, reception);
  if (filter.counts().used == 0)
    fail(flight, settings,
         "no pose of " + (options.poses.empty() ? options.imu : options.poses) +
             " was used during " + options.imu +
             ": see --calibrate, --calibrate-clock and --clock-offset");
  const InertialStated& x = filter.filter().state();

  if (read.origin > 0.0) print("time_origin_s", read.origin, 0);
  if (!flight.marker.positions.empty() || flight.marker.lost > 0)
    std::cout << "positions_only: " << flight.marker.positions.size()
              << "\nlost_tracking: " << flight.marker.lost << '\n';
  std::cout << "samples: " << imu.size() << "\nposes: " << poses.size()
            << "\nused: " << filter.counts().used << "\nrejected: " << filter.counts().gated
            << "\nunused: " << filter.counts().unused << "\nrestarts: " << filter.counts().restarts
            << '\n';
  print("clock_offset_s", settings.clock_offset, 5);
  const double latency = filter.trust(filter.time()).latency;
  print("pose_latency_s", latency, 5);
  if (std::abs(latency) > 0.004 && !reception.is_poor())
    std::cerr << "replay_flight: the stamps of the poses are off by " << std::setprecision(3)
              << latency << " s at the end: their clock is late or drifts (--calibrate)\n";
  print("marker_rotation_deg", given.angularDistance(x.marker_orientation) * 180.0 / pi, 3);
  print("marker_lever_m", (x.marker_position - given_lever).norm(), 5);
  std::cout << "marker_orientation_wxyz: " << std::setprecision(5) << x.marker_orientation.w()
            << ' ' << x.marker_orientation.x() << ' ' << x.marker_orientation.y() << ' '
            << x.marker_orientation.z() << "\nmarker_position_m: " << x.marker_position.transpose()
            << '\n';
  if (5 * (filter.counts().gated + filter.counts().restarts) > filter.counts().used)
    std::cerr << "replay_flight: the gate rejected many poses: are clock and marker frame right "
                 "(--calibrate)?\n";
  if (!truth.empty()) print_errors(options, imu, estimate, truth, !reception.is_poor());
  if (!reception.is_poor()) return;
  char text[120];
  (void)std::snprintf(text, sizeof text,
                      "the filter used %.0f %% of the poses and contradicted them for %.0f %% of "
                      "the time",
                      100.0 * reception.used, 100.0 * reception.contradicted);
  fail(flight, settings, text);
}

constexpr const char* footer = R"(
EuRoC and TUM files are read as they were downloaded, and tables of rostopic and spreadsheets: fields
between commas, semicolons, tabs or blanks, a header line with or without #, remarks, decimal commas.
The columns are found by their names, such as these; others are ignored:
  IMU.csv    t, wx, wy, wz (angular velocity), ax, ay, az (specific force), in the frame of the IMU
  POSE.csv   t, px, py, pz, qw, qx, qy, qz of the marker frame, with motion capture's clock
  TRUTH.csv  t, px, py, pz, qw, qx, qy, qz, vx, vy, vz of the body frame, with the IMU's clock
If no name is known, they are read in this order. Quaternions rotate from the frame to the world; z of
the world points up. Units are SI, or as the header says: [ns], [mm], [g], [deg/s]. Without a unit,
stamps are in s, ms, us or ns by their steps. The program says what it assumed. A row of POSE.csv
without an orientation is a position; one without a position says that tracking was lost.

A log of PX4 (ULog, .ulg) is read instead of IMU.csv, alone or with POSE.csv: the IMU is
sensor_combined; the poses are vehicle_mocap_odometry, vehicle_visual_odometry, vehicle_odometry, or
vehicle_local_position with vehicle_attitude, the first of them that is there, or those of
--pose-topic; the truth is that of PX4's simulation, if it is there, or of --truth-topic. A log that
ends within a message is read until there; any other fault is refused with its byte.

Files in the output directory: replay_flight.csv, the estimate at every IMU sample with standard
deviations and errors, and replay_flight.png.

--calibrate prints values with half widths of 95 % intervals (_95), residuals (RMS per axis), the
ratio of the errors that the log shows to those of the assumed noise (calibration_error_scale), and
the options that repeat the replay with these values. It refuses what the motion does not show.

Printed, among others:
  marker_rotation_deg, marker_lever_m  difference of the marker frame from the given marker frame
  rejected                             poses that the gate rejected
  unused                               poses that were late, repeated or invalid
  pose_latency_s                       by which the filter corrects the stamps of the poses at the end
  positions_only, lost_tracking        rows without orientation, and without position, if any
  time_origin_s                        start of the times, if the stamps count from 1970
With TRUTH.csv, also the RMS errors, and the same errors with the truth read truth_shift_s later. At
this shift the positions fit best; it shows whether the truth has a different clock.

If the filter refuses most poses, or its biases are absurd for a quarter of the time, the program tries
units, order, axes and clocks, and ends with the likely reason.

Exit code: 0 success, 1 failed calibration or most poses refused, 2 invalid file, above 100 wrong
options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Replays a recorded flight through the state estimator."};
  Options o;
  app.add_option("IMU.csv", o.imu, "angular velocity and specific force, or LOG.ulg of PX4")
      ->required();
  app.add_option("POSE.csv", o.poses, "poses of the marker frame; not needed with LOG.ulg");
  app.add_option("TRUTH.csv", o.truth, "ground truth, for the errors of the estimate");
  app.add_option("-o,--output", o.output, "directory for the estimate and its picture")
      ->take_last()
      ->capture_default_str();
  app.add_option("--pose-topic", o.pose_topic,
                 "topic of LOG.ulg with the poses, NAME or NAME:INSTANCE")
      ->excludes("POSE.csv");
  app.add_option("--truth-topic", o.truth_topic, "topic of LOG.ulg with the ground truth")
      ->excludes("TRUTH.csv");
  app.add_flag("--calibrate", o.calibrate,
               "estimate clock offset, marker frame and biases from the whole "
               "log by least squares, with 95 % intervals");
  app.add_flag("--calibrate-clock", o.calibrate_clock,
               "estimate the clock offset of motion capture from rotations")
      ->excludes("--calibrate");
  app.add_option("--clock-offset", o.filter.clock_offset,
                 "offset to add to the time stamps of motion capture [s]")
      ->check(CLI::Range(-1e6, 1e6))
      ->excludes("--calibrate-clock")
      ->excludes("--calibrate")
      ->capture_default_str();
  app.add_flag("--estimate-marker-pose", o.estimate_marker_pose,
               "estimate rotation and lever arm of the marker frame by a first pass of the filter")
      ->excludes("--calibrate");
  app.add_option("--marker-rotation", o.marker_rotation,
                 "rotation from marker frame to body: quaternion w x y z, or matrix row by row")
      ->expected(4, 9)
      ->check(CLI::Number)
      ->excludes("--calibrate")
      ->capture_default_str();
  app.add_option("--marker-lever", o.marker_lever,
                 "origin of the marker frame in the body frame [m]")
      ->expected(3)
      ->check(CLI::Number)
      ->excludes("--calibrate")
      ->capture_default_str();
  app.add_option("--gyro-bias", o.gyro_bias, "bias of the gyroscope at the start [rad/s]")
      ->expected(3)
      ->check(CLI::Number)
      ->excludes("--calibrate")
      ->capture_default_str();
  app.add_option("--accelerometer-bias", o.accelerometer_bias,
                 "bias of the accelerometer at the start [m/s^2]")
      ->expected(3)
      ->check(CLI::Number)
      ->excludes("--calibrate")
      ->capture_default_str();
  app.add_option("--gravity-deviation", o.gravity_deviation,
                 "with --calibrate, also estimate the direction of gravity in motion capture's "
                 "world: its standard deviation from -z [rad]")
      ->needs("--calibrate")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str();
  const auto positive = CLI::PositiveNumber;
  const auto add = [&app](const char* name, double& value, const char* text) {
    return app.add_option(name, value, text)->capture_default_str();
  };
  EkfSettings& f = o.filter;
  add("--gyro-noise", f.imu_noise.gyro_density, "noise density [rad/s/sqrt(Hz)]")->check(positive);
  add("--accelerometer-noise", f.imu_noise.accelerometer_density, "noise density [m/s^2/sqrt(Hz)]")
      ->check(positive);
  add("--gyro-walk", f.imu_noise.gyro_bias_walk, "bias walk [rad/s^2/sqrt(Hz)]")->check(positive);
  add("--accelerometer-walk", f.imu_noise.accelerometer_bias_walk, "bias walk [m/s^3/sqrt(Hz)]")
      ->check(positive);
  add("--position-noise", f.pose_noise.position, "standard deviation of the position of a pose [m]")
      ->check(positive);
  add("--orientation-noise", f.pose_noise.orientation,
      "standard deviation of the orientation of a pose [rad]")
      ->check(positive);
  add("--gate", f.gate, "reject a pose if r' S^-1 r is larger than this")->check(positive);
  const auto* rejections =
      app.add_option("--max-rejections", f.max_rejections,
                     "restart the filter after this number of consecutive rejections")
          ->check(CLI::Range(1, 1000000))
          ->capture_default_str();
  const auto* restart_time =
      app.add_option("--restart-time", f.restart_time,
                     "and after this time of them [s]; with --max-rejections the default is 0")
          ->check(CLI::Range(0.0, 6.0))
          ->capture_default_str();
  add("--judge-from", o.judge_from, "compute errors from this time after the start on [s]")
      ->check(CLI::NonNegativeNumber);
  app.add_flag("--no-pictures", o.no_pictures, "write only the estimate");
  app.footer(footer);
  CLI11_PARSE(app, argc, argv);
  if (rejections->count() > 0 && restart_time->count() == 0) f.restart_time = 0.0;
  const bool topics = !o.pose_topic.empty() || !o.truth_topic.empty();
  if (topics && !examples::is_ulog(o.imu)) {
    std::cerr << "--pose-topic, --truth-topic: need LOG.ulg\n";
    return 105;
  }
  if (o.poses.empty() && !examples::is_ulog(o.imu)) {
    std::cerr << "POSE.csv is required\nRun with --help for more information.\n";
    return 106;
  }
  if (o.marker_rotation.size() != 4 && o.marker_rotation.size() != 9) {
    std::cerr << "--marker-rotation: needs 4 or 9 numbers\n";
    return 105;
  }
  try {
    replay(o);
    if (!o.no_pictures) examples::draw_pictures("tools/replay_flight.gp", o.output);
    return 0;
  } catch (const InputFileError& error) {
    std::cerr << "replay_flight: " << error.what() << '\n';
    return 2;
  } catch (const std::exception& error) {
    std::cerr << "replay_flight: " << error.what() << '\n';
    return 1;
  }
}
