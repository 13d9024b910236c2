// A node in the graph of ROS 2: what it says of itself is what DDS discovers of it.
// CTest: dds

#include "../../examples/integrations/graph.hpp"
#include "../../examples/integrations/node.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/wait_until.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <csignal>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <map>
#include <set>
#include <string>
#include <vector>

namespace loops {
namespace graph_test {

using Guid = std::array<std::uint8_t, 16>;

/// As ROS 2 prints them (`ros2 topic info -v`).
const std::map<std::string, std::string> hashes{
    {"rt/lab/imu", "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"},
    {"rt/lab/odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"},
    {"rt/lab/path", "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b"}};

std::string hash_of(const dds_builtintopic_endpoint_t& endpoint) {
  void* bytes = nullptr;
  std::size_t size = 0;
  if (!dds_qget_userdata(endpoint.qos, &bytes, &size) || bytes == nullptr) return "none";
  const std::string text(static_cast<const char*>(bytes), size), head = "typehash=RIHS01_";
  dds_free(bytes);
  const bool is_hash = text.rfind(head, 0) == 0 && text.back() == ';';
  return is_hash ? text.substr(head.size(), text.size() - head.size() - 1) : text;
}

template <typename Bytes>
Guid guid(const Bytes& bytes) {
  Guid result;
  std::copy_n(bytes, result.size(), result.begin());
  return result;
}

/// The readers or writers of a participant on ROS 2's topics, as the discovery of DDS finds them.
/// Each must tell the hash of its type.
std::set<Guid> discovered(const dds::Participant& participant, dds_entity_t builtin_topic,
                          const Guid& owner) {
  const dds::Entity reader(dds_create_reader(participant.get(), builtin_topic, nullptr, nullptr),
                           "a reader of discovery");
  std::array<void*, 64> samples{};
  std::array<dds_sample_info_t, 64> info{};
  const int count = dds_take(reader.get(), samples.data(), info.data(), 64, 64);
  std::set<Guid> result;
  for (int i = 0; i < count; ++i) {
    const auto& found =
        *static_cast<const dds_builtintopic_endpoint_t*>(samples[static_cast<std::size_t>(i)]);
    if (guid(found.participant_key.v) == owner && std::string(found.topic_name) != dds::graph_topic)
      result.insert(guid(found.key.v));
  }
  dds_return_loan(reader.get(), samples.data(), count);
  return result;
}

/// A node says which readers and writers it has, to a reader that comes later.
template <typename Message>
void expect_own_entities() {
  const dds::Participant participant(test_support::dds_on_loopback());
  std::vector<std::string> arguments = {"--ros-args", "-r", "__node:=pilot", "-r", "__ns:=/lab"};
  Parameters parameters = Parameters::from(arguments);
  Node node(parameters);
  node.subscribe<sensor_msgs::msg::Imu>("imu", dds::sensor_data,
                                        [](const sensor_msgs::msg::Imu&) {});
  const auto odometry = node.publisher<nav_msgs::msg::Odometry>("odometry", {});
  const auto path = node.publisher<nav_msgs::msg::Path>("path", {});
  node.spin(1000000, [](std::int64_t) { std::raise(SIGTERM); });

  dds::Quality latched;
  latched.latched = true;
  dds::Subscriber<Message> graph(participant, dds::graph_topic, latched);
  int messages = 0;
  Guid owner{};
  std::set<Guid> readers, writers;
  const auto all = [](const auto& sequence) {
    std::set<Guid> result;
    for (std::uint32_t i = 0; i < sequence._length; ++i)
      result.insert(guid(sequence._buffer[i].data));
    return result;
  };
  ASSERT_TRUE(test_support::wait_until([&] {
    return graph.take([&](const Message& m) {
      ++messages;
      ASSERT_EQ(m.node_entities_info_seq._length, 1U);
      const auto& told = m.node_entities_info_seq._buffer[0];
      EXPECT_STREQ(told.node_namespace, "/lab");
      EXPECT_STREQ(told.node_name, "pilot");
      owner = guid(m.gid.data);
      readers = all(told.reader_gid_seq);
      writers = all(told.writer_gid_seq);
    }) > 0;
  }));
  EXPECT_EQ(messages, 1);
  EXPECT_EQ(readers.size(), 1U);
  EXPECT_EQ(writers.size(), 2U);
  EXPECT_TRUE(test_support::wait_until([&] {
    return readers == discovered(participant, DDS_BUILTIN_TOPIC_DCPSSUBSCRIPTION, owner) &&
           writers == discovered(participant, DDS_BUILTIN_TOPIC_DCPSPUBLICATION, owner);
  }));
}

TEST(Graph, NamesTheReadersAndWritersOfANode) {
  unsetenv("ROS_DISTRO");
  expect_own_entities<rmw_dds_common::msg::ParticipantEntitiesInfo>();
}

TEST(Graph, HasTheLongIdentifiersOfHumble) {
  setenv("ROS_DISTRO", "humble", 1);
  expect_own_entities<rmw_dds_common::msg::ParticipantEntitiesInfoHumble>();
}

}  // namespace graph_test
}  // namespace loops
