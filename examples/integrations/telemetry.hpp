#pragma once

#include "../support/flight_controller.hpp"
#include "heard.hpp"
#include "messages.hpp"
#include "node.hpp"
#include "tick_timer.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/model/contact.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <iostream>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

/// What a node shows of its flight: transform, odometry, path, markers and diagnostics for rviz2 or
/// Foxglove.
namespace loops {

enum class Level : std::uint8_t { ok = 0, warning = 1, error = 2 };  // of diagnostic_msgs

/// A number for each of up to 8 rotors.
using Numbers = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, 8, 1>;

/// The state of a node at a tick.
struct Snapshot {
  std::int64_t time = 0;  ///< [ns]
  tilt_ropter::BodyStated body;
  tilt_ropter::ReferencePoint reference;
  Numbers rotor_speed, tilt_angle;  ///< [rad/s], [rad]
  tilt_ropter::ContactEstimate contact;
  tilt_ropter::ActuatorFailure failure;
  Level level = Level::ok;
  const char* mode = "";      ///< what the node does
  const char* estimate = "";  ///< how good the estimated state is
  const char* activity = "";  ///< of the reference, such as the phase of a mission
  bool planned = false;       ///< the last command comes from a plan for its measurement
  TickCounts counts;
  bool located = true;  ///< false: the body is not known yet
  std::array<Heard, 5> heard;
  const char* waits_for = "";  ///< what the node needs to fly; "" if nothing

  /// What an operator looks at, in one line.
  [[nodiscard]] std::string line() const {
    std::string text = mode;
    if (located) text += std::string(", ") + activity + ", estimate " + estimate;
    for (const Heard& topic : heard)
      if (*topic.topic() != 0) text += "; " + topic.text();
    if (failure.kind != tilt_ropter::FailureKind::none) text += "; " + examples::describe(failure);
    if (counts.late > 0)
      text += "; late ticks " + std::to_string(counts.late) + " of " + std::to_string(counts.ticks);
    if (*waits_for != 0) text += std::string("; waits for ") + waits_for;
    return text;
  }
};

/// Makes the messages of a flight from snapshots. The messages refer to memory of this object and
/// stay valid until the next call of the same function.
class FlightMessages {
 public:
  /// `prefix` is in front of the names of the vehicle's frame and of its diagnostics.
  template <int Rotors>
  explicit FlightMessages(const tilt_ropter::Vehicle<Rotors>& vehicle,
                          const std::string& prefix = "")
      : base_link_(prefix + "base_link"),
        name_(prefix + "tilt_ropter: flight"),
        marker_(Rotors + other_markers),
        points_(marker_.size()) {
    for (std::size_t i = 0; i < Rotors; ++i)
      rotors_.push_back({rotor_in_body(vehicle, i), rotor_parameters(vehicle, i)});
  }

  /// The pose of base_link in map.
  [[nodiscard]] const tf2_msgs::msg::TFMessage& transform(const Snapshot& s) {
    auto& t = transforms_.front();
    t.header = header(s, map_);
    t.child_frame_id = in_message(base_link_);
    const Eigen::Vector3d& p = s.body.position;
    t.transform.translation = {p.x(), p.y(), p.z()};
    t.transform.rotation = pose(s).orientation;
    refer_to(transform_.transforms, transforms_);
    return transform_;
  }

  /// The pose of base_link in map, and its velocities in base_link.
  [[nodiscard]] const nav_msgs::msg::Odometry& odometry(const Snapshot& s) {
    const Eigen::Vector3d v = s.body.orientation.conjugate() * s.body.velocity;
    const Eigen::Vector3d& w = s.body.angular_velocity;
    odometry_.header = header(s, map_);
    odometry_.child_frame_id = in_message(base_link_);
    odometry_.pose.pose = pose(s);
    odometry_.twist.twist = {{v.x(), v.y(), v.z()}, {w.x(), w.y(), w.z()}};
    return odometry_;
  }

  /// The flown path: at most `most_poses` poses, at least `spacing` apart.
  [[nodiscard]] const nav_msgs::msg::Path& path(const Snapshot& s) {
    constexpr std::size_t most_poses = 500;
    constexpr double spacing = 0.03;  // [m]
    if (poses_.empty() || (s.body.position - last_).norm() >= spacing) {
      if (poses_.size() == most_poses) poses_.erase(poses_.begin());
      poses_.push_back({header(s, map_), pose(s)});
      last_ = s.body.position;
    }
    path_.header = header(s, map_);
    refer_to(path_.poses, poses_);
    return path_;
  }

  /// Thrust of each rotor, external force and torque, reference, contact.
  [[nodiscard]] const visualization_msgs::msg::MarkerArray& markers(const Snapshot& s) {
    constexpr double per_newton = 0.05, per_newton_metre = 0.5;  // length of arrows [m]
    used_ = 0;
    for (std::size_t i = 0; i < rotors_.size(); ++i) {
      const auto k = static_cast<Eigen::Index>(i);
      const auto& [place, parameters] = rotors_[i];
      Eigen::Vector3d thrust = Eigen::Vector3d::Zero();
      if (k < s.rotor_speed.size())
        thrust = tilt_ropter::thrust_from_speed(s.rotor_speed(k), parameters) * place.linear() *
                 tilt_ropter::thrust_direction(s.tilt_angle(k));
      arrow(s, thrust_, static_cast<int>(i), place.translation(), per_newton * thrust,
            {0.1F, 0.5F, 0.9F, 1.0F});
    }
    const tilt_ropter::Wrenchd& external = s.contact.external;
    const Eigen::Vector3d centre = Eigen::Vector3d::Zero();
    arrow(s, wrench_, 0, centre, per_newton * external.force, {0.9F, 0.2F, 0.1F, 1.0F});
    arrow(s, wrench_, 1, centre, per_newton_metre * external.torque, {0.9F, 0.6F, 0.1F, 1.0F});

    auto& reference = next(s, map_, reference_, 0, sphere);
    const Eigen::Vector3d& r = s.reference.position;
    const Eigen::Quaterniond& q = s.reference.orientation;
    reference.pose = {{r.x(), r.y(), r.z()}, {q.x(), q.y(), q.z(), q.w()}};
    reference.scale = {0.08, 0.08, 0.08};
    reference.color = {0.2F, 0.8F, 0.3F, 0.8F};

    auto& ground = next(s, map_, contact_, 0, cylinder);  // a disc on the ground below the vehicle
    if (s.contact.on_ground && std::isfinite(s.contact.ground.height)) {
      const Eigen::Vector3d& p = s.body.position;
      const Eigen::Vector3d n = s.contact.ground.normal();  // upwards: turns z by up to 90 degrees
      const Eigen::Quaterniond tilt =
          Eigen::Quaterniond(1.0 + n.z(), -n.y(), n.x(), 0.0).normalized();
      ground.pose = {{p.x(), p.y(), s.contact.ground.height_at(p)},
                     {tilt.x(), tilt.y(), tilt.z(), tilt.w()}};
      ground.scale = {0.6, 0.6, 0.01};
      ground.color = {0.9F, 0.8F, 0.1F, 0.6F};
    } else {
      ground.action = remove;
    }
    refer_to(markers_.markers, marker_);
    return markers_;
  }

  [[nodiscard]] const diagnostic_msgs::msg::DiagnosticArray& diagnostics(const Snapshot& s) {
    const auto number = [](double value, int digits) {
      char buffer[32];
      std::snprintf(buffer, sizeof buffer, "%.*f", digits, value);
      return std::string(buffer);
    };
    texts_ = {{"mode", s.mode},
              {"estimate", s.estimate},
              {"planned", s.planned ? "true" : "false"},
              {"on_ground", s.contact.on_ground ? "true" : "false"},
              {"external_force_N", number(s.contact.external.force.norm(), 2)},
              {"ticks", std::to_string(s.counts.ticks)},
              {"late_ticks", std::to_string(s.counts.late)},
              {"worst_tick_ms", number(1e3 * s.counts.worst, 2)},
              {"activity", s.activity},
              {"waits_for", s.waits_for}};
    for (const Heard& topic : s.heard) {
      if (*topic.topic() == 0) continue;
      texts_.emplace_back(topic.topic() + std::string("_hz"), number(topic.rate(), 0));
      texts_.emplace_back(topic.topic() + std::string("_age_ms"),
                          topic.ever() ? number(1e3 * topic.age(), 1) : "never");
    }
    texts_.emplace_back("actuators", examples::describe(s.failure));
    values_.clear();
    for (const auto& [key, value] : texts_) values_.push_back({in_message(key), in_message(value)});
    message_ = std::string(s.mode) + ", estimate " + s.estimate;
    auto& status = status_.front();
    status.level = static_cast<std::uint8_t>(s.level);
    status.name = in_message(name_);
    status.message = in_message(message_);
    status.hardware_id = nullptr;
    refer_to(status.values, values_);
    array_.header = header(s, map_);
    refer_to(array_.status, status_);
    return array_;
  }

 private:
  static constexpr int shaft_and_head = 0, sphere = 2, cylinder = 3;  // types of Marker
  static constexpr int add = 0, remove = 2;                           // actions of Marker
  static constexpr std::size_t other_markers = 4;                     // than thrusts

  struct Rotor {
    Eigen::Isometry3d place;  // in the body
    tilt_ropter::RotorParameters parameters;
  };

  [[nodiscard]] static std_msgs::msg::Header header(const Snapshot& s, const std::string& frame) {
    return {stamp(s.time), in_message(frame)};
  }
  [[nodiscard]] static geometry_msgs::msg::Pose pose(const Snapshot& s) {
    const Eigen::Vector3d& p = s.body.position;
    const Eigen::Quaterniond& q = s.body.orientation;
    return {{p.x(), p.y(), p.z()}, {q.x(), q.y(), q.z(), q.w()}};
  }

  visualization_msgs::msg::Marker& next(const Snapshot& s, const std::string& frame,
                                        const std::string& ns, int id, int type) {
    auto& m = marker_.at(used_++);
    m = {};
    m.header = header(s, frame);
    m.ns = in_message(ns);
    m.id = id;
    m.type = type;
    m.action = add;
    m.pose.orientation.w = 1.0;
    m.lifetime = {1, 0};  // a node that stops leaves nothing behind
    return m;
  }

  void arrow(const Snapshot& s, const std::string& ns, int id, const Eigen::Vector3d& from,
             const Eigen::Vector3d& along, const std_msgs::msg::ColorRGBA& color) {
    auto& m = next(s, base_link_, ns, id, shaft_and_head);
    auto& points = points_.at(used_ - 1);
    const Eigen::Vector3d to = from + along;
    points = {{from.x(), from.y(), from.z()}, {to.x(), to.y(), to.z()}};
    refer_to(m.points, points);
    m.scale = {0.015, 0.03, 0.03};
    m.color = color;
    if (!(along.norm() > 1e-3)) m.action = remove;
  }

  std::vector<Rotor> rotors_;
  const std::string base_link_, name_;
  const std::string map_ = "map", thrust_ = "thrust", wrench_ = "external_wrench",
                    reference_ = "reference", contact_ = "contact";
  std::vector<geometry_msgs::msg::TransformStamped> transforms_{1};
  tf2_msgs::msg::TFMessage transform_{};
  nav_msgs::msg::Odometry odometry_{};
  std::vector<geometry_msgs::msg::PoseStamped> poses_;
  Eigen::Vector3d last_ = Eigen::Vector3d::Zero();
  nav_msgs::msg::Path path_{};
  std::vector<visualization_msgs::msg::Marker> marker_;
  std::vector<std::vector<geometry_msgs::msg::Point>> points_;  // of each marker
  std::size_t used_ = 0;
  visualization_msgs::msg::MarkerArray markers_{};
  std::vector<std::pair<std::string, std::string>> texts_;
  std::vector<diagnostic_msgs::msg::KeyValue> values_;
  std::string message_;
  std::vector<diagnostic_msgs::msg::DiagnosticStatus> status_{1};
  diagnostic_msgs::msg::DiagnosticArray array_{};
};

/// Publishes the messages of a flight from its own thread, so that the thread of the controller
/// only copies a snapshot. Transform, odometry and markers at the rate of the parameter
/// `telemetry_rate` [Hz] (0: nothing at all), path and diagnostics once a second, and then a line
/// on standard error unless the parameter `status_line` is false. The clock is that of the
/// snapshots.
class Telemetry {
 public:
  /// Throws dds::Error, and std::invalid_argument for a rate outside 0 to 100 Hz.
  template <int Rotors>
  Telemetry(Node& node, const tilt_ropter::Vehicle<Rotors>& vehicle)
      : messages_(vehicle, node.parameters().prefix()),
        rate_(node.parameters().number("telemetry_rate", 20.0, 0.0, 100.0)),
        prints_(node.parameters().choice("status_line", true)),
        transform_(node.publisher<tf2_msgs::msg::TFMessage>("/tf", {true, 100})),
        odometry_(node.publisher<nav_msgs::msg::Odometry>("odometry", dds::default_quality)),
        path_(node.publisher<nav_msgs::msg::Path>("path", dds::default_quality)),
        markers_(
            node.publisher<visualization_msgs::msg::MarkerArray>("markers", dds::default_quality)),
        diagnostics_(node.publisher<diagnostic_msgs::msg::DiagnosticArray>("/diagnostics",
                                                                           dds::default_quality)) {
    if (!(rate_ > 0.0)) return;
    due_ = TickTimer(std::llround(std::min(1e9 / rate_, 1e15)), true);
    thread_ = std::thread([this] { run(); });
  }
  ~Telemetry() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ends_ = true;
    }
    wake_.notify_all();
    if (thread_.joinable()) thread_.join();
  }
  Telemetry(const Telemetry&) = delete;
  Telemetry& operator=(const Telemetry&) = delete;

  /// For the thread of the controller: never waits and never allocates. If the other thread is
  /// copying at this moment, it keeps the last snapshot.
  void offer(const Snapshot& snapshot) {
    if (!thread_.joinable()) return;
    std::unique_lock<std::mutex> lock(mutex_, std::try_to_lock);
    if (!lock.owns_lock() || !due_.begins(snapshot.time)) return;
    latest_ = snapshot;
    fresh_ = true;
    lock.unlock();
    wake_.notify_one();
  }

 private:
  void run() {
    TickTimer second(1000000000, true);
    for (std::unique_lock<std::mutex> lock(mutex_);;) {
      wake_.wait(lock, [this] { return ends_ || fresh_; });
      if (ends_) return;
      const Snapshot s = latest_;
      fresh_ = false;
      lock.unlock();
      if (s.located) {
        transform_.publish(messages_.transform(s));
        odometry_.publish(messages_.odometry(s));
        markers_.publish(messages_.markers(s));
        (void)messages_.path(s);
      }
      if (second.begins(s.time)) {
        if (s.located) path_.publish(messages_.path(s));
        diagnostics_.publish(messages_.diagnostics(s));
        if (prints_) std::cerr << s.line() + '\n';
      }
      lock.lock();
    }
  }

  FlightMessages messages_;
  double rate_;
  bool prints_;
  TickTimer due_{1, true};
  dds::Publisher<tf2_msgs::msg::TFMessage> transform_;
  dds::Publisher<nav_msgs::msg::Odometry> odometry_;
  dds::Publisher<nav_msgs::msg::Path> path_;
  dds::Publisher<visualization_msgs::msg::MarkerArray> markers_;
  dds::Publisher<diagnostic_msgs::msg::DiagnosticArray> diagnostics_;
  std::mutex mutex_;
  std::condition_variable wake_;
  Snapshot latest_;
  bool fresh_ = false, ends_ = false;
  std::thread thread_;
};

}  // namespace loops
