// fast_dds_messages DOMAIN: exchanges every message with a program of the other vendor. Prints how
// many messages of each topic it received, how many fields they had, and how many fields differed
// from what the other program sends. Ends half a second after every message has arrived; exit code
// 1 if that takes more than 30 s.

#include "pattern.hpp"

#include <actuator_msgsPubSubTypes.h>
#include <diagnostic_msgsPubSubTypes.h>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>
#include <geometry_msgsPubSubTypes.h>
#include <nav_msgsPubSubTypes.h>
#include <px4_msgsPubSubTypes.h>
#include <rmw_dds_commonPubSubTypes.h>
#include <rosgraph_msgsPubSubTypes.h>
#include <sensor_msgsPubSubTypes.h>
#include <std_msgsPubSubTypes.h>
#include <tf2_msgsPubSubTypes.h>
#include <tilt_ropter_msgsPubSubTypes.h>
#include <trajectory_msgsPubSubTypes.h>
#include <visualization_msgsPubSubTypes.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <exception>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace interoperability {

#include <fields_cpp.inc>

namespace {

using namespace eprosima::fastdds::dds;

template <typename T>
T* made(T* entity, const std::string& what) {
  if (entity == nullptr) throw std::runtime_error("cannot make " + what);
  return entity;
}

/// Speaks UDP over the loopback interface only.
DomainParticipant* make_participant(std::uint32_t domain) {
  DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
  auto transport = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  transport->interfaceWhiteList.emplace_back("127.0.0.1");
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(transport);
  eprosima::fastrtps::rtps::Locator_t peer;
  eprosima::fastrtps::rtps::IPLocator::setIPv4(peer, "127.0.0.1");
  qos.wire_protocol().builtin.initialPeersList.push_back(peer);
  return made(DomainParticipantFactory::get_instance()->create_participant(domain, qos),
              "a participant");
}

/// One topic in each direction.
class Exchange {
 public:
  virtual ~Exchange() = default;
  virtual void publish() = 0;
  virtual void take() = 0;

  int received = 0, fields_seen = 0, mismatches = 0;  // fields: of all messages received
};

template <typename Type>
class ExchangeOf : public Exchange {
 public:
  ExchangeOf(DomainParticipant* participant, int number, const std::string& type_name)
      : number_(number) {
    const TypeSupport type(new Type());
    participant->register_type(type, type_name);
    const auto topic = [&](const std::string& direction) {
      return made(participant->create_topic("rt/" + direction + "_" + std::to_string(number),
                                            type_name, TOPIC_QOS_DEFAULT),
                  "a topic of " + type_name);
    };
    DataWriterQos to_write = DATAWRITER_QOS_DEFAULT;
    to_write.reliability().kind = RELIABLE_RELIABILITY_QOS;
    to_write.durability().kind = VOLATILE_DURABILITY_QOS;
    to_write.history().depth = 10;
    DataReaderQos to_read = DATAREADER_QOS_DEFAULT;
    to_read.reliability().kind = RELIABLE_RELIABILITY_QOS;
    to_read.history().depth = 10;
    Publisher* publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    Subscriber* subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    writer_ = made(made(publisher, "a publisher")->create_datawriter(topic("fast_dds"), to_write),
                   "a writer of " + type_name);
    reader_ = made(made(subscriber, "a subscriber")->create_datareader(topic("cyclone"), to_read),
                   "a reader of " + type_name);
  }

  void publish() override {
    typename Type::type message;
    Visitor<Purpose::fill> visitor(from_fast_dds(number_));
    visitor(message);
    writer_->write(&message);
  }
  void take() override {
    typename Type::type message;
    SampleInfo info;
    while (reader_->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
      if (!info.valid_data) continue;
      Visitor<Purpose::check> visitor(from_cyclone(number_));
      visitor(message);
      ++received;
      fields_seen += visitor.fields_seen;
      mismatches += visitor.mismatches;
    }
  }

 private:
  int number_;
  DataWriter* writer_;
  DataReader* reader_;
};

void run(std::uint32_t domain) {
  // A participant has one type of a name; the older versions share the name of the current one.
  DomainParticipant* current = make_participant(domain);
  std::vector<std::string> names;
  std::vector<std::unique_ptr<Exchange>> all;
#define TOPIC(PACKAGE, MODULE, NAME, WIRE_NAME)                                        \
  names.emplace_back(#MODULE #NAME);                                                   \
  all.push_back(std::make_unique<ExchangeOf<PACKAGE::msg::MODULE::NAME##_PubSubType>>( \
      std::string(#MODULE) == "dds_" ? current : make_participant(domain),             \
      static_cast<int>(all.size()), #PACKAGE "::msg::dds_::" #WIRE_NAME "_"));
#include "topics.inc"
#undef TOPIC

  constexpr int rounds = 6000, rounds_after_all = 10;
  const std::chrono::milliseconds pause(50);
  int after_all = 0;
  for (int round = 0; round < rounds && after_all < rounds_after_all; ++round) {
    bool complete = true;
    for (const auto& exchange : all) {
      exchange->publish();
      exchange->take();
      complete = complete && exchange->received > 0;
    }
    if (complete) ++after_all;
    std::this_thread::sleep_for(pause);
  }
  for (std::size_t i = 0; i < all.size(); ++i)
    std::cout << names[i] << "_received: " << all[i]->received << '\n'
              << names[i] << "_fields: " << all[i]->fields_seen << '\n'
              << names[i] << "_mismatches: " << all[i]->mismatches << '\n';
  if (after_all < rounds_after_all) throw std::runtime_error("not every message has arrived");
}

}  // namespace
}  // namespace interoperability

int main(int argc, char** argv) {
  try {
    interoperability::run(argc > 1 ? static_cast<std::uint32_t>(std::atoi(argv[1])) : 0U);
    return 0;
  } catch (const std::exception& error) {
    std::cerr << "fast_dds_messages: " << error.what() << '\n';
    return 1;
  }
}
