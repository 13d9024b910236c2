#pragma once

#include <dds/dds.h>

#include <array>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>

/// Owners for what Cyclone DDS hands out. A message is a struct that idlc generated; messages.hpp
/// says which topic types there are.
namespace dds {

class Error : public std::runtime_error {
 public:
  Error(const std::string& what, dds_return_t code)
      : std::runtime_error(what + ": " + dds_strretcode(code)) {}
};

/// The description of a message for Cyclone; messages.hpp specialises it for each message.
template <typename Message>
const dds_topic_descriptor_t& descriptor();
/// Its hash in ROS 2, or "" if it has none; the same.
template <typename Message>
const char* type_hash();

/// Qualities of service. Topics keep the last `depth` messages. A subscriber
/// hears publishers that offer at least what it requests.
struct Quality {
  bool reliable = true;
  int depth = 10;
  std::int64_t deadline = DDS_INFINITY;  ///< longest time between messages [ns]
  std::int64_t lease = DDS_INFINITY;     ///< a publisher that is silent on the wire is dead [ns]
  bool ignore_own = false;  ///< of a subscriber: hear no publisher of the same participant
  bool latched = false;     ///< a subscriber that comes later also gets them (transient local)
};
inline constexpr Quality default_quality{true, 10};  ///< of ROS 2
inline constexpr Quality sensor_data{false, 5};      ///< of ROS 2, for sensors

/// The DDS topic on which ROS 2 says what belongs to which node.
inline constexpr char graph_topic[] = "ros_discovery_info";

/// Returns the DDS topic of a ROS 2 topic. A relative name becomes one in the root name space.
[[nodiscard]] inline std::string topic_name(const std::string& ros_topic) {
  if (ros_topic == graph_topic) return ros_topic;
  return (ros_topic.rfind('/', 0) == 0 ? "rt" : "rt/") + ros_topic;
}

/// Owns an entity of Cyclone.
class Entity {
 public:
  /// Throws Error if `handle` is a return code for an error.
  Entity(dds_entity_t handle, const std::string& what) : handle_(handle) {
    if (handle < 0) throw Error("cannot create " + what, handle);
  }
  ~Entity() {
    if (handle_ > 0) dds_delete(handle_);
  }
  Entity(Entity&& other) noexcept : handle_(std::exchange(other.handle_, 0)) {}
  Entity& operator=(Entity&& other) noexcept {
    std::swap(handle_, other.handle_);
    return *this;
  }
  [[nodiscard]] dds_entity_t get() const { return handle_; }

 private:
  dds_entity_t handle_;
};

/// Member of a DDS domain. It must live longer than its publishers and subscribers.
class Participant {
 public:
  /// Throws Error, for example if CYCLONEDDS_URI names a network interface that does not exist.
  explicit Participant(std::uint32_t domain)
      : entity_(create(domain), "a participant in DDS domain " + std::to_string(domain)) {}
  [[nodiscard]] dds_entity_t get() const { return entity_.get(); }

 private:
  // ROS 2 takes a participant for its own if it says to which enclave it belongs.
  static dds_entity_t create(std::uint32_t domain) {
    static constexpr char enclave[] = "enclave=/;";
    dds_qos_t* qos = dds_create_qos();
    dds_qset_userdata(qos, enclave, sizeof enclave - 1);
    const dds_entity_t participant = dds_create_participant(domain, qos, nullptr);
    dds_delete_qos(qos);
    return participant;
  }

  Entity entity_;
};

namespace detail {

class QualityHandle {
 public:
  QualityHandle(const Quality& quality, const std::string& hash) : qos_(dds_create_qos()) {
    // A full queue never makes the writer wait: then the message is lost for slow readers.
    dds_qset_reliability(
        qos_, quality.reliable ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT, 0);
    dds_qset_history(qos_, DDS_HISTORY_KEEP_LAST, quality.depth);
    dds_qset_durability(qos_,
                        quality.latched ? DDS_DURABILITY_TRANSIENT_LOCAL : DDS_DURABILITY_VOLATILE);
    dds_qset_deadline(qos_, quality.deadline);
    dds_qset_liveliness(qos_, DDS_LIVELINESS_AUTOMATIC, quality.lease);
    dds_qset_ignorelocal(qos_,
                         quality.ignore_own ? DDS_IGNORELOCAL_PARTICIPANT : DDS_IGNORELOCAL_NONE);
    if (hash.empty()) return;
    const std::string told = "typehash=RIHS01_" + hash + ';';  // ROS 2 warns where it is missing
    dds_qset_userdata(qos_, told.data(), told.size());
  }
  ~QualityHandle() { dds_delete_qos(qos_); }
  QualityHandle(const QualityHandle&) = delete;
  QualityHandle& operator=(const QualityHandle&) = delete;
  [[nodiscard]] const dds_qos_t* get() const { return qos_; }

 private:
  dds_qos_t* qos_;
};

template <typename Message>
Entity topic(const Participant& participant, const std::string& name) {
  return {
      dds_create_topic(participant.get(), &descriptor<Message>(), name.c_str(), nullptr, nullptr),
      "topic " + name};
}

}  // namespace detail

template <typename Message>
class Publisher {
 public:
  using message_type = Message;

  /// Throws Error.
  Publisher(const Participant& participant, const std::string& ros_topic,
            const Quality& quality = default_quality)
      : topic_(detail::topic<Message>(participant, topic_name(ros_topic))),
        writer_(
            dds_create_writer(participant.get(), topic_.get(),
                              detail::QualityHandle(quality, type_hash<Message>()).get(), nullptr),
            "a writer of " + ros_topic) {}

  /// Sends `message`; it is copied. Returns false if the message was not sent.
  bool publish(const Message& message) { return dds_write(writer_.get(), &message) >= 0; }

  /// Number of subscribers that are known.
  [[nodiscard]] int subscribers() const {
    dds_publication_matched_status_t status{};
    dds_get_publication_matched_status(writer_.get(), &status);
    return static_cast<int>(status.current_count);
  }
  [[nodiscard]] dds_entity_t writer() const { return writer_.get(); }

 private:
  Entity topic_, writer_;
};

template <typename Message>
class Subscriber {
 public:
  /// Throws Error.
  Subscriber(const Participant& participant, const std::string& ros_topic,
             const Quality& quality = default_quality)
      : topic_(detail::topic<Message>(participant, topic_name(ros_topic))),
        reader_(
            dds_create_reader(participant.get(), topic_.get(),
                              detail::QualityHandle(quality, type_hash<Message>()).get(), nullptr),
            "a reader of " + ros_topic) {}

  /// Calls action(message) or action(message, info) for every message that has arrived, the oldest
  /// first. The message and what it points to exist during the call only. Returns the number of
  /// messages.
  template <typename Action>
  int take(Action&& action) {
    int count = 0;
    for (Loan loan(reader_.get()); loan.size > 0; loan.renew())
      for (int i = 0; i < loan.size; ++i)
        if (const auto k = static_cast<std::size_t>(i); loan.info[k].valid_data) {
          const auto& message = *static_cast<const Message*>(loan.samples[k]);
          if constexpr (std::is_invocable_v<Action, const Message&, const dds_sample_info_t&>)
            action(message, loan.info[k]);
          else
            action(message);
          ++count;
        }
    return count;
  }

  /// Number of publishers that are known.
  [[nodiscard]] int publishers() const {
    dds_subscription_matched_status_t status{};
    dds_get_subscription_matched_status(reader_.get(), &status);
    return static_cast<int>(status.current_count);
  }
  /// Number of publishers that are alive.
  [[nodiscard]] int alive_publishers() const {
    dds_liveliness_changed_status_t status{};
    dds_get_liveliness_changed_status(reader_.get(), &status);
    return static_cast<int>(status.alive_count);
  }
  /// Returns whether the deadline was missed since the last call. DDS watches it while a publisher
  /// is alive, from the first message on.
  [[nodiscard]] bool missed_deadline() {
    dds_requested_deadline_missed_status_t status{};
    dds_get_requested_deadline_missed_status(reader_.get(), &status);
    return status.total_count_change > 0;
  }
  /// Number of messages that DDS knows to be lost.
  [[nodiscard]] long lost() const {
    dds_sample_lost_status_t status{};
    dds_get_sample_lost_status(reader_.get(), &status);
    return static_cast<long>(status.total_count);
  }
  [[nodiscard]] dds_entity_t reader() const { return reader_.get(); }

 private:
  /// Samples in the memory of Cyclone; the destructor gives them back.
  struct Loan {
    static constexpr std::size_t most = 16;
    explicit Loan(dds_entity_t from) : reader(from) { take(); }
    ~Loan() { give_back(); }
    Loan(const Loan&) = delete;
    Loan& operator=(const Loan&) = delete;
    void renew() {
      give_back();
      take();
    }

    dds_entity_t reader;
    std::array<void*, most> samples{};
    std::array<dds_sample_info_t, most> info{};
    int size = 0;

   private:
    void take() {
      samples[0] = nullptr;  // Cyclone lends its memory
      size = dds_take(reader, samples.data(), info.data(), most, most);
    }
    void give_back() {
      if (size > 0) dds_return_loan(reader, samples.data(), size);
      size = 0;
    }
  };

  Entity topic_, reader_;
};

/// Waits until a message has arrived for one of several subscribers.
class WaitSet {
 public:
  explicit WaitSet(const Participant& participant)
      : entity_(dds_create_waitset(participant.get()), "a wait set") {}

  template <typename Message>
  void add(const Subscriber<Message>& subscriber) {
    dds_set_status_mask(subscriber.reader(), DDS_DATA_AVAILABLE_STATUS);
    const dds_return_t code = dds_waitset_attach(entity_.get(), subscriber.reader(), 0);
    if (code < 0) throw Error("cannot wait for a reader", code);
  }

  /// Returns after `nanoseconds` at the latest.
  void wait(std::int64_t nanoseconds) {
    if (nanoseconds > 0) dds_waitset_wait(entity_.get(), nullptr, 0, nanoseconds);
  }

 private:
  Entity entity_;
};

}  // namespace dds
