#pragma once

#include "dds.hpp"
#include "graph.hpp"
#include "messages.hpp"
#include "parameters.hpp"
#include "real_time.hpp"
#include "tick_timer.hpp"

#include <csignal>
#include <cstdint>
#include <cstdlib>
#include <ctime>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace loops {

/// Returns the time of the system clock [ns], which is the clock of ROS 2.
[[nodiscard]] inline std::int64_t system_time_ns() {
  timespec t{};
  clock_gettime(CLOCK_REALTIME, &t);
  return std::int64_t{t.tv_sec} * 1000000000 + t.tv_nsec;
}

/// Returns the DDS domain of ROS 2: the environment variable ROS_DOMAIN_ID, or 0. Throws
/// std::runtime_error if it is not between 0 and 230: the ports of 231 and 232 do not exist.
[[nodiscard]] inline std::uint32_t ros_domain() {
  const char* text = std::getenv("ROS_DOMAIN_ID");
  if (text == nullptr || *text == '\0') return 0;
  char* end = nullptr;
  const long domain = std::strtol(text, &end, 10);
  if (*end != '\0' || domain < 0 || domain > 230)
    throw std::runtime_error("ROS_DOMAIN_ID = " + std::string(text) + ": must be 0 to 230");
  return static_cast<std::uint32_t>(domain);
}

/// One thread that hands messages to callbacks and calls a tick at a fixed rate, until SIGINT or
/// SIGTERM. Messages that have arrived come before the tick that is due. With the parameter
/// `use_sim_time` the time is that of the topic /clock, which may run at any speed.
class Node {
 public:
  /// Throws dds::Error, std::runtime_error as ros_domain(), std::invalid_argument for a wrong
  /// parameter.
  explicit Node(Parameters& parameters)
      : parameters_(parameters),
        participant_(ros_domain()),
        graph_(participant_, parameters.name_space(), parameters.node()),
        waiting_(participant_) {
    stopped_ = 0;
    for (const int number : {SIGINT, SIGTERM}) std::signal(number, [](int) { stopped_ = 1; });
    if (parameters.choice("use_sim_time", false))
      subscribe<rosgraph_msgs::msg::Clock>(
          "/clock", {false, 1},
          [this](const rosgraph_msgs::msg::Clock& m) { simulated_ = nanoseconds(m.clock); });
    use_clock_ = !receivers_.empty();
  }

  template <typename Message, typename Action>
  void subscribe(const std::string& topic, const dds::Quality& quality, Action action) {
    const auto subscriber =
        std::make_shared<dds::Subscriber<Message>>(participant_, parameters_.topic(topic), quality);
    waiting_.add(*subscriber);
    graph_.add_reader(subscriber->reader());
    receivers_.push_back([subscriber, action] { subscriber->take(action); });
  }
  template <typename Message>
  [[nodiscard]] dds::Publisher<Message> publisher(const std::string& topic,
                                                  const dds::Quality& quality) {
    dds::Publisher<Message> publisher(participant_, parameters_.topic(topic), quality);
    graph_.add_writer(publisher.writer());
    return publisher;
  }

  /// Calls tick(time) every `period` [ns], with the time [ns] of the clock of ROS 2, as TickTimer
  /// says.
  template <typename Tick>
  void spin(std::int64_t period, const Tick& tick) {
    graph_.publish();
    timer_ = TickTimer(period, use_clock_);
    while (stopped_ == 0) {
      waiting_.wait(use_clock_ ? period : timer_.due() - now_ns());
      for (const auto& receive : receivers_) receive();
      if (use_clock_ && simulated_ <= 0) continue;  // the simulation has not begun
      if (!timer_.begins(steady_time())) continue;
      tick(use_clock_ ? simulated_ : system_time_ns());
      timer_.ended(steady_time());
    }
  }

  [[nodiscard]] const TickCounts& counts() const { return timer_.counts(); }
  [[nodiscard]] Parameters& parameters() { return parameters_; }

 private:
  /// A clock that nobody sets [ns].
  [[nodiscard]] std::int64_t steady_time() const { return use_clock_ ? simulated_ : now_ns(); }

  inline static volatile std::sig_atomic_t stopped_ = 0;
  Parameters& parameters_;
  dds::Participant participant_;
  Graph graph_;
  dds::WaitSet waiting_;
  std::vector<std::function<void()>> receivers_;
  TickTimer timer_{1, false};
  bool use_clock_ = false;
  std::int64_t simulated_ = 0;  // last message on /clock [ns]
};

}  // namespace loops
