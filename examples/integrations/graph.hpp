#pragma once

#include "dds.hpp"
#include "messages.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdlib>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace loops {

/// Shows a node in the graph of ROS 2, as in `ros2 node list` and `ros2 node info`: its participant
/// publishes whose its readers and writers are. Identifiers have 16 bytes, or 24 if the environment
/// variable ROS_DISTRO names ROS 2 Humble or one before.
class Graph {
 public:
  /// Throws dds::Error.
  Graph(const dds::Participant& participant, std::string name_space, std::string node)
      : participant_(participant.get()),
        name_space_(std::move(name_space)),
        node_(std::move(node)) {
    dds::Quality latched{true, 1};
    latched.latched = true;
    const char* distribution = std::getenv("ROS_DISTRO");
    const std::array<std::string, 3> old = {"humble", "galactic", "foxy"};
    if (distribution != nullptr && std::find(old.begin(), old.end(), distribution) != old.end())
      humble_.emplace(participant, dds::graph_topic, latched);
    else
      current_.emplace(participant, dds::graph_topic, latched);
  }

  void add_reader(dds_entity_t reader) { readers_.push_back(reader); }
  void add_writer(dds_entity_t writer) { writers_.push_back(writer); }

  /// Call this when all have been added.
  void publish() {
    if (humble_) publish(*humble_);
    if (current_) publish(*current_);
  }

 private:
  using Entities = std::vector<dds_entity_t>;

  template <typename Message>
  void publish(dds::Publisher<Message>& publisher) const {
    Message message{};
    using Gid = decltype(message.gid);
    using Nodes = decltype(message.node_entities_info_seq);
    std::vector<std::remove_pointer_t<decltype(Nodes::_buffer)>> nodes(1);
    const std::vector<Gid> readers = identifiers<Gid>(readers_),
                           writers = identifiers<Gid>(writers_);
    nodes[0].node_namespace = in_message(name_space_);
    nodes[0].node_name = in_message(node_);
    refer_to(nodes[0].reader_gid_seq, readers);
    refer_to(nodes[0].writer_gid_seq, writers);
    message.gid = identifiers<Gid>({participant_})[0];
    refer_to(message.node_entities_info_seq, nodes);
    publisher.publish(message);
  }

  template <typename Gid>
  static std::vector<Gid> identifiers(const Entities& entities) {
    std::vector<Gid> result(entities.size());
    for (std::size_t i = 0; i < entities.size(); ++i) {
      dds_guid_t guid{};
      dds_get_guid(entities[i], &guid);
      std::copy_n(guid.v, sizeof guid.v, result[i].data);  // the rest of a longer one is zero
    }
    return result;
  }

  dds_entity_t participant_;
  std::string name_space_, node_;
  Entities readers_, writers_;
  std::optional<dds::Publisher<rmw_dds_common::msg::ParticipantEntitiesInfo>> current_;
  std::optional<dds::Publisher<rmw_dds_common::msg::ParticipantEntitiesInfoHumble>> humble_;
};

}  // namespace loops
