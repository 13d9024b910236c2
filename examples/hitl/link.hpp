#pragma once

#include "../support/statistics.hpp"
#include "message.hpp"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <deque>
#include <iomanip>
#include <map>
#include <optional>
#include <ostream>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace hitl {

using Clock = std::chrono::steady_clock;

[[nodiscard]] inline std::uint64_t nanoseconds_now() {
  return static_cast<std::uint64_t>(
      std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now().time_since_epoch())
          .count());
}

/// Parses ADDRESS:PORT, where ADDRESS is an IPv4 address in digits. Throws std::runtime_error for
/// other text.
[[nodiscard]] inline sockaddr_in parse_address(const std::string& text) {
  const auto colon = text.find(':');
  sockaddr_in address{};
  address.sin_family = AF_INET;
  const std::string digits = text.substr(colon == std::string::npos ? text.size() : colon + 1);
  int port = 0;
  std::from_chars(digits.data(), digits.data() + digits.size(), port);
  if (port < 1 || port > 65535 || std::to_string(port) != digits ||
      inet_pton(AF_INET, text.substr(0, colon).c_str(), &address.sin_addr) != 1)
    throw std::runtime_error("'" + text + "' is not ADDRESS:PORT, such as 127.0.0.1:24001");
  address.sin_port = htons(static_cast<std::uint16_t>(port));
  return address;
}

/// Model of a bad line for sent messages, to test its effects.
struct BadLine {
  double loss = 0.0;            ///< fraction of the messages that are lost
  double spike_fraction = 0.0;  ///< fraction of the messages that are late by `spike`
  double spike = 0.02;          ///< delay of a late message [s]
};

/// Counts of the messages of one type from one sender.
struct ArrivalCounts {
  long received = 0;
  long lost = 0;      ///< gaps in the sequence that no later message filled
  long late = 0;      ///< overtaken by a newer message, or a copy: dropped
  long sessions = 0;  ///< number of starts of the sender
};

/// A UDP socket that exchanges messages with known peers. Other datagrams are counted and dropped.
class Link {
 public:
  /// Listens at the address `own`. Throws std::runtime_error if this fails.
  Link(const std::string& own, const std::vector<std::string>& peers, const BadLine& line)
      : socket_(socket(AF_INET, SOCK_DGRAM, 0)), line_(line), random_(std::random_device{}()) {
    if (socket_ < 0) throw std::runtime_error("no socket: " + std::string(std::strerror(errno)));
    const sockaddr_in address = parse_address(own);
    for (const std::string& peer : peers) peers_.push_back(parse_address(peer));
    if (bind(socket_, reinterpret_cast<const sockaddr*>(&address), sizeof address) != 0 ||
        fcntl(socket_, F_SETFL, O_NONBLOCK) != 0) {
      const std::string reason = std::strerror(errno);
      close(socket_);
      throw std::runtime_error("cannot listen at " + own + ": " + reason);
    }
    session_ = static_cast<std::uint32_t>(random_());
  }
  ~Link() { close(socket_); }
  Link(const Link&) = delete;
  Link& operator=(const Link&) = delete;

  /// Sends `m` to the peer with this index. A peer that does not listen is not an error.
  void send(std::size_t peer, Message m) {
    m.session = session_;
    m.sequence = ++sequences_[{peer, m.type}];
    const auto chance = [this](double fraction) {
      return std::uniform_real_distribution<double>(0.0, 1.0)(random_) < fraction;
    };
    if (chance(line_.loss)) return;
    const Datagram d = encode(m);
    if (chance(line_.spike_fraction))
      held_back_.push_back({Clock::now() + std::chrono::duration_cast<Clock::duration>(
                                               std::chrono::duration<double>(line_.spike)),
                            peer, d});
    else
      put(peer, d);
  }

  /// Waits until a message can be received, at most until `until`.
  void wait(Clock::time_point until) {
    release();
    const auto rest =
        std::chrono::duration_cast<std::chrono::milliseconds>(until - Clock::now()).count();
    pollfd poller{socket_, POLLIN, 0};
    poll(&poller, 1, static_cast<int>(std::max<std::int64_t>(0, rest)));
  }

  /// Returns the next message, if there is one. Messages of one type and sender arrive in the order
  /// in which they were sent; overtaken messages are dropped.
  std::optional<Message> receive() {
    release();
    // One byte longer than any message, so that a longer datagram is detected.
    std::array<std::uint8_t, sizeof(Datagram::bytes) + 1> bytes{};
    for (;;) {
      sockaddr_in from{};
      socklen_t length = sizeof from;
      const ssize_t size = recvfrom(socket_, bytes.data(), bytes.size(), 0,
                                    reinterpret_cast<sockaddr*>(&from), &length);
      if (size < 0) {
        if (errno == ECONNREFUSED || errno == EINTR) continue;  // a peer that does not listen
        return std::nullopt;
      }
      const auto known = std::find_if(peers_.begin(), peers_.end(), [&from](const sockaddr_in& p) {
        return p.sin_port == from.sin_port && p.sin_addr.s_addr == from.sin_addr.s_addr;
      });
      const auto m = known == peers_.end() ? std::nullopt
                                           : decode(bytes.data(), static_cast<std::size_t>(size));
      if (!m) {
        ++foreign_;
        continue;
      }
      if (in_order(static_cast<std::size_t>(known - peers_.begin()), *m)) return m;
    }
  }

  [[nodiscard]] long foreign() const { return foreign_; }

  /// Sums the counts over all senders of this type.
  [[nodiscard]] ArrivalCounts counts(MessageType type) const {
    ArrivalCounts sum;
    for (const auto& [key, arrival] : arrivals_) {
      if (key.second != type) continue;
      sum.received += arrival.counts.received;
      sum.lost += arrival.counts.lost;
      sum.late += arrival.counts.late;
      sum.sessions += arrival.counts.sessions;
    }
    return sum;
  }

  /// Prints "NAME_received: ..." and so on.
  void print(std::ostream& out, const std::string& name, MessageType type) const {
    const ArrivalCounts c = counts(type);
    out << name << "_received: " << c.received << '\n'
        << name << "_lost: " << c.lost << '\n'
        << name << "_late: " << c.late << '\n'
        << name << "_sessions: " << c.sessions << '\n';
  }

 private:
  struct HeldBack {
    Clock::time_point due;
    std::size_t peer;
    Datagram datagram;
  };
  struct Arrival {
    std::uint32_t session = 0, last_session = 0, sequence = 0;
    ArrivalCounts counts;
  };

  bool in_order(std::size_t peer, const Message& m) {
    Arrival& a = arrivals_[{peer, m.type}];
    // Sent before the restart of the sender.
    if (a.counts.sessions > 1 && m.session == a.last_session) {
      ++a.counts.late;
      return false;
    }
    if (a.counts.sessions == 0 || m.session != a.session) {
      a.last_session = a.session;
      a.session = m.session;
      a.sequence = m.sequence;
      ++a.counts.sessions;
      ++a.counts.received;
      return true;
    }
    // Differences modulo 2^32, because a counter may overflow.
    const auto ahead = static_cast<std::int32_t>(m.sequence - a.sequence);
    if (ahead <= 0) {
      ++a.counts.late;
      if (ahead < 0 && a.counts.lost > 0) --a.counts.lost;
      return false;
    }
    a.counts.lost += ahead - 1;
    ++a.counts.received;
    a.sequence = m.sequence;
    return true;
  }

  void put(std::size_t peer, const Datagram& d) {
    const sockaddr_in& to = peers_[peer];
    // A datagram that cannot be sent is lost, as on any line.
    (void)!sendto(socket_, d.bytes.data(), d.size, 0, reinterpret_cast<const sockaddr*>(&to),
                  sizeof to);
  }

  void release() {
    while (!held_back_.empty() && held_back_.front().due <= Clock::now()) {
      put(held_back_.front().peer, held_back_.front().datagram);
      held_back_.pop_front();
    }
  }

  int socket_;
  BadLine line_;
  std::mt19937 random_;
  std::uint32_t session_ = 0;
  std::vector<sockaddr_in> peers_;
  std::map<std::pair<std::size_t, MessageType>, std::uint32_t> sequences_;
  std::map<std::pair<std::size_t, MessageType>, Arrival> arrivals_;
  std::deque<HeldBack> held_back_;
  long foreign_ = 0;
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
