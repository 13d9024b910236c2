#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <map>
#include <string>
#include <type_traits>
#include <vector>

/// MCAP files (mcap.dev/spec) with messages of ROS 2, for Foxglove, PlotJuggler and `ros2 bag`.
namespace examples {

/// A message of ROS 2 as CDR, little-endian: numbers are aligned to their size, counted from the
/// end of the four bytes that say so; a string and a sequence begin with their length.
class Cdr {
 public:
  template <typename Number>
  Cdr& add(Number value) {
    static_assert(std::is_arithmetic_v<Number>);
    bytes_.resize(4 + (bytes_.size() - 4 + sizeof value - 1) / sizeof value * sizeof value, '\0');
    append(&value, sizeof value);
    return *this;
  }
  /// The elements of a vector or of an array of fixed size.
  template <typename Vector>
  Cdr& add_all(const Vector& values) {
    for (std::size_t i = 0; i < static_cast<std::size_t>(values.size()); ++i) add(values.data()[i]);
    return *this;
  }
  template <typename Vector>
  Cdr& add_sequence(const Vector& values) {
    return add(static_cast<std::uint32_t>(values.size())).add_all(values);
  }
  Cdr& add(const std::string& text) {
    add(static_cast<std::uint32_t>(text.size() + 1));
    append(text.c_str(), text.size() + 1);
    return *this;
  }

  [[nodiscard]] const std::string& bytes() const { return bytes_; }

 private:
  void append(const void* data, std::size_t size) {
    bytes_.append(static_cast<const char*>(data), size);  // of a little-endian processor
  }

  std::string bytes_{"\0\1\0\0", 4};
};

/// The definition of a message of ROS 2 such as "nav_msgs/msg/Odometry" with those of all messages
/// in it, as in a schema "ros2msg". Throws std::invalid_argument for a message it does not know.
[[nodiscard]] std::string ros2_definition(const std::string& type);

/// Writes an MCAP file without compression: chunks of 1 MB with index, check sums, statistics.
class McapWriter {
 public:
  /// Throws std::runtime_error if the file cannot be written.
  explicit McapWriter(const std::string& path);
  ~McapWriter();
  McapWriter(const McapWriter&) = delete;
  McapWriter& operator=(const McapWriter&) = delete;

  /// Returns the number of a new channel. Call this before the first write().
  std::uint16_t add_channel(const std::string& topic, const std::string& type);
  /// Throws std::runtime_error if the disk is full. `time` [ns], not negative.
  void write(std::uint16_t channel, std::uint64_t time, const Cdr& message);
  /// Writes the index. The destructor calls this, too, but does not throw.
  void close();

 private:
  struct Channel {
    std::string record;
    std::uint32_t sequence = 0;
    std::vector<std::uint64_t> index;  ///< time and offset of each message in this chunk
  };

  void put(const std::string& bytes);
  void end_chunk();

  std::string path_;
  std::ofstream file_;
  std::uint64_t size_ = 0;
  std::uint32_t check_ = 0;                       ///< CRC of all bytes so far
  std::map<std::string, std::uint16_t> schemas_;  ///< by type
  std::string schema_records_, chunk_, chunk_indexes_;
  std::vector<Channel> channels_;
  std::uint64_t first_ = 0, last_ = 0, chunk_first_ = 0, chunk_last_ = 0;  ///< times [ns]
  std::uint64_t messages_ = 0;
  std::uint32_t chunks_ = 0;
};

}  // namespace examples
