#include "mcap.hpp"

#include <tilt_ropter/version.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <exception>
#include <set>
#include <stdexcept>
#include <utility>

namespace examples {
namespace {

/// The fields of each message, as in the .msg files of common_interfaces without their remarks.
const std::map<std::string, std::string>& definitions() {
  static const std::map<std::string, std::string> known = {
      {"builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"},
      {"std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"},
      {"std_msgs/Float64", "float64 data\n"},
      {"std_msgs/String", "string data\n"},
      {"geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"},
      {"geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"},
      {"geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"},
      {"geometry_msgs/Pose",
       "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"},
      {"geometry_msgs/PoseStamped", "std_msgs/Header header\ngeometry_msgs/Pose pose\n"},
      {"geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance\n"},
      {"geometry_msgs/Twist", "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"},
      {"geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist twist\nfloat64[36] covariance\n"},
      {"geometry_msgs/Transform",
       "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"},
      {"geometry_msgs/TransformStamped",
       "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"},
      {"geometry_msgs/Wrench", "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"},
      {"geometry_msgs/WrenchStamped", "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n"},
      {"nav_msgs/Odometry",
       "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
       "geometry_msgs/TwistWithCovariance twist\n"},
      {"sensor_msgs/Imu",
       "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
       "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
       "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
       "float64[9] linear_acceleration_covariance\n"},
      {"sensor_msgs/JointState",
       "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
       "float64[] effort\n"},
      {"tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms\n"}};
  return known;
}

/// nav_msgs/Odometry for nav_msgs/msg/Odometry.
std::string short_name(std::string type) {
  const std::size_t middle = type.find("/msg/");
  return middle == std::string::npos ? type : type.erase(middle, 4);
}

const std::string& definition(const std::string& name) {
  const auto found = definitions().find(name);
  if (found == definitions().end()) throw std::invalid_argument("unknown message " + name);
  return found->second;
}

/// Adds the messages within `name`, each once.
void add_parts(const std::string& name, std::set<std::string>& done, std::string& text) {
  const std::string& fields = definition(name);
  for (std::size_t line = 0; line < fields.size(); line = fields.find('\n', line) + 1) {
    const std::string part = fields.substr(line, fields.find_first_of(" [", line) - line);
    if (part.find('/') == std::string::npos || !done.insert(part).second) continue;
    text += std::string(80, '=') + "\nMSG: " + part + '\n' + definition(part);
    add_parts(part, done, text);
  }
}

/// CRC-32 as of zlib; `check` is that of the bytes before.
std::uint32_t crc32(const std::string& bytes, std::uint32_t check = 0) {
  static const std::array<std::uint32_t, 256> table = [] {
    std::array<std::uint32_t, 256> made{};
    for (std::uint32_t i = 0; i < 256; ++i) {
      made[i] = i;
      for (int bit = 0; bit < 8; ++bit)
        made[i] = (made[i] >> 1) ^ ((made[i] & 1) != 0 ? 0xEDB88320U : 0U);
    }
    return made;
  }();
  check = ~check;
  for (const char c : bytes)
    check = table[(check ^ static_cast<unsigned char>(c)) & 0xFFU] ^ (check >> 8);
  return ~check;
}

/// The fields of a record: little-endian without gaps.
class Fields {
 public:
  template <typename Number>
  Fields& add(Number value) {
    static_assert(std::is_unsigned_v<Number>);
    for (std::size_t i = 0; i < sizeof value; ++i)
      bytes_ += static_cast<char>(static_cast<std::uint64_t>(value) >> (8 * i) & 0xFFU);
    return *this;
  }
  Fields& add(const std::string& text) {
    add(static_cast<std::uint32_t>(text.size()));
    bytes_ += text;
    return *this;
  }
  Fields& add_bytes(const std::string& text) {
    bytes_ += text;
    return *this;
  }
  [[nodiscard]] const std::string& bytes() const { return bytes_; }

 private:
  std::string bytes_;
};

enum class Kind : std::uint8_t {
  header = 1,
  footer = 2,
  schema = 3,
  channel = 4,
  message = 5,
  chunk = 6,
  message_index = 7,
  chunk_index = 8,
  statistics = 11,
  summary_offset = 14,
  data_end = 15
};

std::string record(Kind kind, const std::string& content) {
  return Fields()
      .add(static_cast<std::uint8_t>(kind))
      .add(std::uint64_t{content.size()})
      .add_bytes(content)
      .bytes();
}

const std::string magic("\x89MCAP0\r\n");
constexpr std::size_t chunk_size = 1 << 20;

}  // namespace

std::string ros2_definition(const std::string& type) {
  const std::string name = short_name(type);
  std::set<std::string> done{name};
  std::string text = definition(name);
  add_parts(name, done, text);
  return text;
}

McapWriter::McapWriter(const std::string& path) : path_(path), file_(path, std::ios::binary) {
  using namespace tilt_ropter;
  const std::string library = "tilt_ropter " + std::to_string(version_major) + '.' +
                              std::to_string(version_minor) + '.' + std::to_string(version_patch);
  put(magic + record(Kind::header, Fields().add(std::string("ros2")).add(library).bytes()));
}

McapWriter::~McapWriter() {
  try {
    close();
  } catch (const std::exception&) {  // told by write(), or by nobody
  }
}

void McapWriter::put(const std::string& bytes) {
  file_.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  if (!file_) throw std::runtime_error("cannot write " + path_);
  check_ = crc32(bytes, check_);
  size_ += bytes.size();
}

std::uint16_t McapWriter::add_channel(const std::string& topic, const std::string& type) {
  const auto [schema, is_new] =
      schemas_.emplace(type, static_cast<std::uint16_t>(schemas_.size() + 1));
  if (is_new) {
    const std::string text = record(Kind::schema, Fields()
                                                      .add(schema->second)
                                                      .add(type)
                                                      .add(std::string("ros2msg"))
                                                      .add(ros2_definition(type))
                                                      .bytes());
    put(text);
    schema_records_ += text;
  }
  const auto number = static_cast<std::uint16_t>(channels_.size());
  const std::string metadata =
      Fields().add(std::string("offered_qos_profiles")).add(std::string()).bytes();
  channels_.push_back({record(Kind::channel, Fields()
                                                 .add(number)
                                                 .add(schema->second)
                                                 .add(topic)
                                                 .add(std::string("cdr"))
                                                 .add(metadata)
                                                 .bytes()),
                       0,
                       {}});
  put(channels_.back().record);
  return number;
}

void McapWriter::write(std::uint16_t channel, std::uint64_t time, const Cdr& message) {
  Channel& to = channels_.at(channel);
  if (messages_ == 0) first_ = last_ = time;
  if (chunk_.empty()) chunk_first_ = chunk_last_ = time;
  first_ = std::min(first_, time);
  last_ = std::max(last_, time);
  chunk_first_ = std::min(chunk_first_, time);
  chunk_last_ = std::max(chunk_last_, time);
  to.index.insert(to.index.end(), {time, std::uint64_t{chunk_.size()}});
  chunk_ += record(Kind::message, Fields()
                                      .add(channel)
                                      .add(to.sequence++)
                                      .add(time)
                                      .add(time)
                                      .add_bytes(message.bytes())
                                      .bytes());
  ++messages_;
  if (chunk_.size() >= chunk_size) end_chunk();
}

void McapWriter::end_chunk() {
  if (chunk_.empty()) return;
  const std::uint64_t start = size_, bytes = chunk_.size();
  put(record(Kind::chunk, Fields()
                              .add(chunk_first_)
                              .add(chunk_last_)
                              .add(bytes)
                              .add(crc32(chunk_))
                              .add(std::string())  // no compression
                              .add(bytes)
                              .add_bytes(chunk_)
                              .bytes()));
  const std::uint64_t end = size_;
  chunk_.clear();
  ++chunks_;
  Fields offsets;
  for (std::size_t i = 0; i < channels_.size(); ++i) {
    std::vector<std::uint64_t>& index = channels_[i].index;
    if (index.empty()) continue;
    const auto number = static_cast<std::uint16_t>(i);
    Fields entries;
    for (const std::uint64_t part : index) entries.add(part);
    index.clear();
    offsets.add(number).add(size_);
    put(record(Kind::message_index, Fields().add(number).add(entries.bytes()).bytes()));
  }
  chunk_indexes_ += record(Kind::chunk_index, Fields()
                                                  .add(chunk_first_)
                                                  .add(chunk_last_)
                                                  .add(start)
                                                  .add(end - start)
                                                  .add(offsets.bytes())
                                                  .add(size_ - end)
                                                  .add(std::string())
                                                  .add(bytes)
                                                  .add(bytes)
                                                  .bytes());
}

void McapWriter::close() {
  if (!file_.is_open() || !file_) return;
  end_chunk();
  put(record(Kind::data_end, Fields().add(check_).bytes()));
  const std::uint64_t summary = size_;
  check_ = 0;
  std::string offsets, channels;
  Fields counts;
  for (std::size_t i = 0; i < channels_.size(); ++i) {
    channels += channels_[i].record;
    counts.add(static_cast<std::uint16_t>(i)).add(std::uint64_t{channels_[i].sequence});
  }
  const std::string statistics =
      record(Kind::statistics, Fields()
                                   .add(messages_)
                                   .add(static_cast<std::uint16_t>(schemas_.size()))
                                   .add(static_cast<std::uint32_t>(channels_.size()))
                                   .add(std::uint32_t{0})  // attachments
                                   .add(std::uint32_t{0})  // metadata
                                   .add(chunks_)
                                   .add(first_)
                                   .add(last_)
                                   .add(counts.bytes())
                                   .bytes());
  const std::array<std::pair<Kind, const std::string*>, 4> groups = {
      {{Kind::schema, &schema_records_},
       {Kind::channel, &channels},
       {Kind::chunk_index, &chunk_indexes_},
       {Kind::statistics, &statistics}}};
  for (const auto& [kind, group] : groups) {
    if (group->empty()) continue;
    offsets += record(Kind::summary_offset, Fields()
                                                .add(static_cast<std::uint8_t>(kind))
                                                .add(size_)
                                                .add(std::uint64_t{group->size()})
                                                .bytes());
    put(*group);
  }
  const std::uint64_t summary_offsets = size_;
  put(offsets);
  const std::string footer = Fields()
                                 .add(static_cast<std::uint8_t>(Kind::footer))
                                 .add(std::uint64_t{20})
                                 .add(summary)
                                 .add(summary_offsets)
                                 .bytes();
  put(footer);
  put(Fields().add(check_).bytes() + magic);
  file_.close();
  if (!file_) throw std::runtime_error("cannot write " + path_);
}

}  // namespace examples
