#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <variant>
#include <vector>

/// Replacement for ROS 2's rclcpp if ROS 2 is not installed, with the names and signatures that
/// these nodes use. Messages are delivered immediately in this process. Time advances only with
/// stand_in::advance().
namespace rclcpp {

class Duration {
 public:
  static Duration from_seconds(double seconds) {
    return Duration(static_cast<std::int64_t>(1e9 * seconds));
  }
  [[nodiscard]] std::int64_t nanoseconds() const { return nanoseconds_; }

 private:
  explicit Duration(std::int64_t nanoseconds) : nanoseconds_(nanoseconds) {}
  std::int64_t nanoseconds_;
};

class Time {
 public:
  explicit Time(std::int64_t nanoseconds) : nanoseconds_(nanoseconds) {}
  [[nodiscard]] std::int64_t nanoseconds() const { return nanoseconds_; }
  [[nodiscard]] double seconds() const { return 1e-9 * static_cast<double>(nanoseconds_); }

 private:
  std::int64_t nanoseconds_;
};

class Clock {
 public:
  using SharedPtr = std::shared_ptr<Clock>;
};

class QoS {
 public:
  QoS(std::size_t depth) : depth_(depth) {}  // implicit, as in the original rclcpp
  [[nodiscard]] std::size_t depth() const { return depth_; }

 private:
  std::size_t depth_;
};

class SensorDataQoS : public QoS {
 public:
  SensorDataQoS() : QoS(5) {}
};

class Parameter {
 public:
  Parameter(std::string name, double value) : name_(std::move(name)), value_(value) {}
  Parameter(std::string name, std::string value)
      : name_(std::move(name)), value_(std::move(value)) {}
  [[nodiscard]] const std::string& get_name() const { return name_; }
  [[nodiscard]] double as_double() const { return std::get<double>(value_); }
  [[nodiscard]] std::string as_string() const { return std::get<std::string>(value_); }

 private:
  std::string name_;
  std::variant<double, std::string> value_;
};

class NodeOptions {
 public:
  NodeOptions& parameter_overrides(const std::vector<Parameter>& parameters) {
    parameters_ = parameters;
    return *this;
  }
  [[nodiscard]] const std::vector<Parameter>& parameter_overrides() const { return parameters_; }

 private:
  std::vector<Parameter> parameters_;
};

template <typename Message>
class Subscription {
 public:
  using SharedPtr = std::shared_ptr<Subscription>;
  std::function<void(const Message&)> callback;
};

class TimerBase {
 public:
  using SharedPtr = std::shared_ptr<TimerBase>;
  std::int64_t period = 0, due = 0;  ///< [ns]
  std::function<void()> callback;
};

namespace stand_in {

template <typename Message>
inline std::multimap<std::string, std::weak_ptr<Subscription<Message>>> subscriptions;
inline std::vector<std::weak_ptr<TimerBase>> timers;
inline std::int64_t now = 0;  ///< [ns]

/// Advances the time and calls the timers that are due.
inline void advance(std::int64_t nanoseconds) {
  now += nanoseconds;
  for (std::size_t i = 0; i < timers.size(); ++i)
    if (const auto timer = timers[i].lock())
      for (; timer->due <= now; timer->due += timer->period) timer->callback();
}

}  // namespace stand_in

template <typename Message>
class Publisher {
 public:
  using SharedPtr = std::shared_ptr<Publisher>;
  explicit Publisher(std::string topic) : topic_(std::move(topic)) {}

  void publish(const Message& message) {
    const auto [begin, end] = stand_in::subscriptions<Message>.equal_range(topic_);
    for (auto i = begin; i != end; ++i)
      if (const auto subscription = i->second.lock()) subscription->callback(message);
  }

 private:
  std::string topic_;
};

class Node {
 public:
  explicit Node(std::string name, NodeOptions options = {})
      : name_(std::move(name)), options_(std::move(options)) {}
  virtual ~Node() = default;
  Node(const Node&) = delete;
  Node& operator=(const Node&) = delete;

  double declare_parameter(const std::string& name, double value) {
    for (const Parameter& parameter : options_.parameter_overrides())
      if (parameter.get_name() == name) return parameter.as_double();
    return value;
  }
  std::string declare_parameter(const std::string& name, const std::string& value) {
    for (const Parameter& parameter : options_.parameter_overrides())
      if (parameter.get_name() == name) return parameter.as_string();
    return value;
  }

  template <typename Message>
  typename Publisher<Message>::SharedPtr create_publisher(const std::string& topic, const QoS&) {
    return std::make_shared<Publisher<Message>>(topic);
  }

  template <typename Message, typename Callback>
  typename Subscription<Message>::SharedPtr create_subscription(const std::string& topic,
                                                                const QoS&, Callback callback) {
    auto subscription = std::make_shared<Subscription<Message>>();
    subscription->callback = std::move(callback);
    stand_in::subscriptions<Message>.emplace(topic, subscription);
    return subscription;
  }

  [[nodiscard]] Clock::SharedPtr get_clock() const { return std::make_shared<Clock>(); }
  [[nodiscard]] Time now() const { return Time(stand_in::now); }
  [[nodiscard]] const std::string& get_logger() const { return name_; }

 private:
  std::string name_;
  NodeOptions options_;
};

template <typename Callback>
TimerBase::SharedPtr create_timer(Node*, const Clock::SharedPtr&, Duration period,
                                  Callback callback) {
  auto timer = std::make_shared<TimerBase>();
  timer->period = period.nanoseconds();
  timer->due = stand_in::now + period.nanoseconds();
  timer->callback = std::move(callback);
  stand_in::timers.push_back(timer);
  return timer;
}

inline void init(int, const char* const*) {}
inline void spin(const std::shared_ptr<Node>&) {}  // no other process sends messages
inline void shutdown() {}

/// The original function removes the arguments between --ros-args and --. Here there is nothing to
/// remove.
inline std::vector<std::string> remove_ros_arguments(int argc, const char* const* argv) {
  return {argv, argv + argc};
}

}  // namespace rclcpp

#define RCLCPP_INFO(logger, ...)                                                       \
  (std::fprintf(stderr, "[%s] ", (logger).c_str()), std::fprintf(stderr, __VA_ARGS__), \
   std::fputc('\n', stderr))
#define RCLCPP_WARN RCLCPP_INFO
