#pragma once

#include "dds.hpp"
#include "messages.hpp"
#include "parameters.hpp"
#include "real_time.hpp"

#include <algorithm>
#include <csignal>
#include <cstdint>
#include <cstdlib>
#include <ctime>
#include <functional>
#include <iomanip>
#include <memory>
#include <ostream>
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
/// std::runtime_error if it is not between 0 and 232.
[[nodiscard]] inline std::uint32_t ros_domain() {
  const char* text = std::getenv("ROS_DOMAIN_ID");
  if (text == nullptr || *text == '\0') return 0;
  char* end = nullptr;
  const long domain = std::strtol(text, &end, 10);
  if (*end != '\0' || domain < 0 || domain > 232)
    throw std::runtime_error("ROS_DOMAIN_ID = " + std::string(text) + ": must be 0 to 232");
  return static_cast<std::uint32_t>(domain);
}

/// How punctual the ticks of a node were.
struct TickCounts {
  long ticks = 0;      ///< that were run
  long late = 0;       ///< ended after the next one was due, or were left out
  double worst = 0.0;  ///< longest time from when a tick was due until its end [s]

  void print(std::ostream& out) const {
    out << "ticks: " << ticks << "\nlate_ticks: " << late << "\nworst_tick_ms: " << std::fixed
        << std::setprecision(2) << 1e3 * worst << '\n';
  }
};

/// One thread that hands messages to callbacks and calls a tick at a fixed rate, until SIGINT or
/// SIGTERM. Messages that have arrived come before the tick that is due. With the parameter
/// `use_sim_time` the time is that of the topic /clock, which may run at any speed.
class Node {
 public:
  /// Throws dds::Error, std::runtime_error as ros_domain(), std::invalid_argument for a wrong
  /// parameter.
  explicit Node(Parameters& parameters)
      : parameters_(parameters), participant_(ros_domain()), waiting_(participant_) {
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
    receivers_.push_back([subscriber, action] { subscriber->take(action); });
  }
  template <typename Message>
  [[nodiscard]] dds::Publisher<Message> publisher(const std::string& topic,
                                                  const dds::Quality& quality) {
    return {participant_, parameters_.topic(topic), quality};
  }

  /// Calls tick(time) every `period` [ns], with the time [ns] of the clock of ROS 2. A tick that
  /// could not begin before the next one was due is left out.
  template <typename Tick>
  void spin(std::int64_t period, const Tick& tick) {
    for (std::int64_t due = steady_time() + period; stopped_ == 0;) {
      waiting_.wait(use_clock_ ? period : due - now_ns());
      for (const auto& receive : receivers_) receive();
      // The simulation has begun, or begun again.
      if (use_clock_ && (!clock_known_ || simulated_ < due - 2 * period)) due = simulated_;
      clock_known_ = simulated_ > 0;
      if (steady_time() < due || (use_clock_ && !clock_known_)) continue;
      tick(use_clock_ ? simulated_ : system_time_ns());
      const std::int64_t passed = steady_time() - due;
      ++counts_.ticks;
      counts_.late += static_cast<long>(passed / period);
      counts_.worst = std::max(counts_.worst, 1e-9 * static_cast<double>(passed));
      due += period * std::max<std::int64_t>(1, passed / period);
      if (use_clock_ && due <= simulated_) due += period;  // the same time twice is no tick
    }
  }

  [[nodiscard]] const TickCounts& counts() const { return counts_; }
  [[nodiscard]] Parameters& parameters() { return parameters_; }

 private:
  /// A clock that nobody sets [ns].
  [[nodiscard]] std::int64_t steady_time() const { return use_clock_ ? simulated_ : now_ns(); }

  inline static volatile std::sig_atomic_t stopped_ = 0;
  Parameters& parameters_;
  dds::Participant participant_;
  dds::WaitSet waiting_;
  std::vector<std::function<void()>> receivers_;
  TickCounts counts_;
  bool use_clock_ = false, clock_known_ = false;
  std::int64_t simulated_ = 0;  // last message on /clock [ns]
};

}  // namespace loops
