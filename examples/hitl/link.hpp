#pragma once

#include "../integrations/node.hpp"
#include "../support/statistics.hpp"
#include "message.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <deque>
#include <iomanip>
#include <optional>
#include <ostream>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace hitl {

using Clock = std::chrono::steady_clock;

/// How messages are received: a model of a bad line, to test its effects, and lock step.
struct Line {
  double loss = 0.0;            ///< fraction of the messages that are lost
  double spike_fraction = 0.0;  ///< fraction of the messages that are late by `spike`
  double spike = 0.02;          ///< delay of a late message [s]
  /// Longest time that the simulation waits for a command [s]. The only clock is then the time of
  /// the simulation. 0: real time.
  double lock_step = 0.0;
};

/// Returns the time [s] of a clock that begins at zero, as a time of Clock.
[[nodiscard]] inline Clock::time_point time_point(double time) {
  return Clock::time_point(
      std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(time)));
}

/// Counts of the messages of one topic.
struct ArrivalCounts {
  long received = 0;
  long lost = 0;      ///< by the bad line, by the stamps or, without a period, as DDS knows
  long late = 0;      ///< overtaken by a newer message: dropped
  long sessions = 0;  ///< number of starts of the sender
  long rejected = 0;  ///< contents that decode() refuses
};

/// Receives the messages of one topic, and says when their sender is silent. `Rotors` of messages
/// about rotors is their number.
template <typename Message, int Rotors = 0>
class Inbox {
 public:
  using Content = typename decltype(content_of<Rotors>(std::declval<const Message&>()))::value_type;

  /// Throws dds::Error.
  Inbox(const dds::Participant& participant, const Topic& topic, const Line& line)
      : subscriber_(participant, topic.name, topic.requested(line.lock_step > 0.0)),
        deadline_(topic.deadline),
        period_(topic.period),
        line_(line),
        random_(std::random_device{}()) {}

  /// Calls action(content) for every message that has arrived. Messages come in the order in which
  /// they were sent; overtaken messages are dropped. Call this often: it also detects silence.
  /// `now` is the time of the simulation in lock step, otherwise that of Clock.
  template <typename Action>
  void take(Clock::time_point now, Action&& action) {
    // DDS watches the deadline while a sender lives. It does not know what the bad line takes away.
    const bool unwatched =
        line_.lock_step > 0.0 || subscriber_.alive_publishers() == 0 || line_.loss > 0.0;
    if (now < arrived_) held_back_.clear();  // the simulation has begun again
    if (subscriber_.missed_deadline() || (unwatched && now - arrived_ > deadline_)) silent_ = true;
    for (; !held_back_.empty() && held_back_.front().due <= now; held_back_.pop_front())
      deliver(held_back_.front(), now, action);
    subscriber_.take([&](const Message& message, const dds_sample_info_t& info) {
      const std::optional<Content> content = content_of<Rotors>(message);
      if (content) count_gap(content->time, info.publication_handle);
      if (!content) {
        ++counts_.rejected;
      } else if (chance(line_.loss)) {
        ++counts_.lost;
      } else {
        const Arrival arrival{now + std::chrono::duration_cast<Clock::duration>(
                                        std::chrono::duration<double>(line_.spike)),
                              info.publication_handle, info.source_timestamp, *content};
        if (chance(line_.spike_fraction))
          held_back_.push_back(arrival);
        else
          deliver(arrival, now, action);
      }
    });
  }

  /// True before the first message, and after the topic's deadline has passed without a message.
  [[nodiscard]] bool silent() const { return silent_; }
  /// Whether a sender lives, as far as DDS knows.
  [[nodiscard]] bool sender_lives() const { return subscriber_.alive_publishers() > 0; }
  [[nodiscard]] const dds::Subscriber<Message>& subscriber() const { return subscriber_; }

  /// Number of starts of the sender. During take(), that of the message is counted.
  [[nodiscard]] long sessions() const { return counts_.sessions; }
  [[nodiscard]] ArrivalCounts counts() const {
    ArrivalCounts counts = counts_;
    if (!(period_ > 0.0)) counts.lost += subscriber_.lost();
    return counts;
  }
  /// Prints "NAME_received: ..." and so on.
  void print(std::ostream& out, const std::string& name) const {
    const ArrivalCounts c = counts();
    out << name << "_received: " << c.received << '\n'
        << name << "_lost: " << c.lost << '\n'
        << name << "_late: " << c.late << '\n'
        << name << "_sessions: " << c.sessions << '\n';
  }

 private:
  struct Arrival {
    Clock::time_point due;  // if it is held back
    dds_instance_handle_t sender;
    dds_time_t sent;
    Content content;
  };

  [[nodiscard]] bool chance(double fraction) {
    return fraction > 0.0 && std::uniform_real_distribution<double>(0.0, 1.0)(random_) < fraction;
  }

  // DDS does not know what never arrived at a best-effort reader.
  void count_gap(double stamp, dds_instance_handle_t sender) {
    const double before = std::exchange(last_stamp_, stamp);
    if (std::exchange(last_sender_, sender) != sender || !(period_ > 0.0)) return;
    counts_.lost += std::max(0L, std::lround((stamp - before) / period_) - 1);
  }

  template <typename Action>
  void deliver(const Arrival& a, Clock::time_point now, Action&& action) {
    // After a restart, messages of the former sender are late ones, unless the newer one is silent:
    // then a second sender has come and gone.
    const bool is_former =
        counts_.sessions > 1 && a.sender == former_ && now - arrived_ <= deadline_;
    if (counts_.sessions > 0 && a.sender == sender_ ? a.sent <= newest_ : is_former) {
      ++counts_.late;
      return;
    }
    if (counts_.sessions == 0 || a.sender != sender_) {
      former_ = sender_;
      sender_ = a.sender;
      ++counts_.sessions;
    }
    newest_ = a.sent;
    arrived_ = now;
    silent_ = false;
    ++counts_.received;
    action(a.content);
  }

  dds::Subscriber<Message> subscriber_;
  std::chrono::nanoseconds deadline_;
  double period_, last_stamp_ = 0.0;  // of what arrived last [s]
  dds_instance_handle_t last_sender_ = 0;
  Line line_;
  std::mt19937 random_;
  std::deque<Arrival> held_back_;
  dds_instance_handle_t sender_ = 0, former_ = 0;  // former: before the restart of the sender
  dds_time_t newest_ = 0;
  Clock::time_point arrived_;
  bool silent_ = true;
  ArrivalCounts counts_;
};

/// Detects at the start of a program that another one of its kind is running already.
template <typename Message>
class Rival {
 public:
  /// `topic`: a topic that only programs of this kind publish.
  Rival(const dds::Participant& participant, const Topic& topic)
      : subscriber_(std::in_place, participant, topic.name,
                    dds::Quality{false, 1, DDS_INFINITY, DDS_INFINITY, true}) {}

  /// Throws std::runtime_error if there is a rival. Looks for it in the first three seconds only,
  /// in which the vehicle waits: the program that runs already goes on.
  void check(Clock::time_point now) {
    if (now > until_) subscriber_.reset();
    if (subscriber_ && subscriber_->publishers() > 0)
      throw std::runtime_error("another program of this kind runs in DDS domain " +
                               std::to_string(loops::ros_domain()));
  }

 private:
  std::optional<dds::Subscriber<Message>> subscriber_;
  Clock::time_point until_ = Clock::now() + std::chrono::seconds(3);
};

/// The end of a flight, which hitl_simulator reports.
class FlightOver {
 public:
  explicit FlightOver(const dds::Participant& participant)
      : subscriber_(participant, flight_over_topic, {true, 1}) {}

  [[nodiscard]] bool reported() {
    bool over = false;
    subscriber_.take([&over](const std_msgs::msg::Bool& m) { over = over || m.data; });
    return over;
  }

 private:
  dds::Subscriber<std_msgs::msg::Bool> subscriber_;
};

/// Collects times of one type and prints their distribution.
class Times {
 public:
  void add(double microseconds) { values_.push_back(microseconds); }

  /// Prints "NAME_median_us: ..." and so on; jitter is the 99th percentile minus the median.
  void print(std::ostream& out, const std::string& name) const {
    const auto at = [this](double fraction) { return examples::percentile(values_, fraction); };
    out << std::fixed << std::setprecision(0) << name << "_median_us: " << at(0.5) << '\n'
        << name << "_p99_us: " << at(0.99) << '\n'
        << name << "_max_us: " << at(1.0) << '\n'
        << name << "_jitter_us: " << at(0.99) - at(0.5) << '\n';
  }

 private:
  std::vector<double> values_;
};

}  // namespace hitl
