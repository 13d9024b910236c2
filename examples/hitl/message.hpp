#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>

/// Messages between the three programs of the hardware-in-the-loop simulation. One UDP datagram is
/// one message with a size fixed by its type. Integers and IEEE 754 doubles have the least
/// significant byte first:
///
///     bytes   field
///     0-3     "TRHL"
///     4       version, 1
///     5       type
///     6-7     size of the datagram
///     8-11    session: random number from the start of the sender, to detect a restart
///     12-15   sequence: counts the sender's messages of this type from 1
///     16-23   time of the simulated clock that belongs to the content [s]
///     24-31   stamp: the simulator's clock when it sent the sample that led to this message [ns]
///     32-35   CRC-32 (IEEE 802.3) of all other bytes
///     36-     doubles, as many as the type defines
namespace hitl {

enum class MessageType : std::uint8_t {
  inertial = 1,   ///< angular velocity (3), specific force (3), rotor speeds (4); body frame
  pose = 2,       ///< position (3), orientation w, x, y, z; of the body in the world
  wrench = 3,     ///< force (3), torque (3) and their rates (6); body frame
  actuators = 4,  ///< rotor speeds (4), tilt angles (4)
  end = 5         ///< the flight is over
};

constexpr std::size_t max_values = 12;
constexpr std::size_t header_size = 36;

/// Returns the number of doubles in a message of this type; no value for an unknown type.
constexpr std::optional<std::size_t> value_count(MessageType type) {
  switch (type) {
    case MessageType::inertial:
      return 10;
    case MessageType::pose:
      return 7;
    case MessageType::wrench:
      return 12;
    case MessageType::actuators:
      return 8;
    case MessageType::end:
      return 0;
  }
  return std::nullopt;
}

struct Message {
  MessageType type = MessageType::end;
  std::uint32_t session = 0, sequence = 0;
  double time = 0.0;
  std::uint64_t stamp = 0;
  std::array<double, max_values> values{};  ///< only the first value_count(type) values are used
};

struct Datagram {
  std::array<std::uint8_t, header_size + 8 * max_values> bytes{};
  std::size_t size = 0;
};

namespace detail {

template <typename Integer>
void put(std::uint8_t* to, Integer value) {
  for (std::size_t i = 0; i < sizeof value; ++i)
    to[i] = static_cast<std::uint8_t>(static_cast<std::uint64_t>(value) >> (8 * i));
}

template <typename Integer>
Integer get(const std::uint8_t* from) {
  std::uint64_t value = 0;
  for (std::size_t i = 0; i < sizeof(Integer); ++i)
    value |= static_cast<std::uint64_t>(from[i]) << (8 * i);
  return static_cast<Integer>(value);
}

inline void put_double(std::uint8_t* to, double value) {
  std::uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof bits);
  put(to, bits);
}

inline double get_double(const std::uint8_t* from) {
  const auto bits = get<std::uint64_t>(from);
  double value = 0.0;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

/// Returns the CRC-32 of the datagram without the field that contains it.
inline std::uint32_t checksum(const std::uint8_t* bytes, std::size_t size) {
  std::uint32_t crc = 0xffffffffU;
  for (std::size_t i = 0; i < size; ++i) {
    if (i >= 32 && i < header_size) continue;
    crc ^= bytes[i];
    for (int bit = 0; bit < 8; ++bit) crc = (crc >> 1U) ^ ((crc & 1U) != 0U ? 0xedb88320U : 0U);
  }
  return ~crc;
}

constexpr std::array<std::uint8_t, 5> greeting = {'T', 'R', 'H', 'L', 1};

}  // namespace detail

[[nodiscard]] inline Datagram encode(const Message& m) {
  using namespace detail;
  Datagram d;
  const std::size_t count = value_count(m.type).value_or(0);
  d.size = header_size + 8 * count;
  std::uint8_t* const bytes = d.bytes.data();
  std::memcpy(bytes, greeting.data(), greeting.size());
  put(bytes + 5, static_cast<std::uint8_t>(m.type));
  put(bytes + 6, static_cast<std::uint16_t>(d.size));
  put(bytes + 8, m.session);
  put(bytes + 12, m.sequence);
  put_double(bytes + 16, m.time);
  put(bytes + 24, m.stamp);
  for (std::size_t i = 0; i < count; ++i) put_double(bytes + header_size + 8 * i, m.values[i]);
  put(bytes + 32, checksum(bytes, d.size));
  return d;
}

/// Decodes a datagram. Returns nothing for an invalid datagram: another protocol or version,
/// truncated, damaged, or with a number that is not finite.
[[nodiscard]] inline std::optional<Message> decode(const std::uint8_t* bytes, std::size_t size) {
  using namespace detail;
  if (size < header_size || std::memcmp(bytes, greeting.data(), greeting.size()) != 0)
    return std::nullopt;
  Message m;
  m.type = static_cast<MessageType>(bytes[5]);
  const auto count = value_count(m.type);
  if (!count || size != header_size + 8 * *count || get<std::uint16_t>(bytes + 6) != size ||
      get<std::uint32_t>(bytes + 32) != checksum(bytes, size))
    return std::nullopt;
  m.session = get<std::uint32_t>(bytes + 8);
  m.sequence = get<std::uint32_t>(bytes + 12);
  m.time = get_double(bytes + 16);
  m.stamp = get<std::uint64_t>(bytes + 24);
  bool finite = std::isfinite(m.time);
  for (std::size_t i = 0; i < *count; ++i) {
    m.values[i] = get_double(bytes + header_size + 8 * i);
    finite = finite && std::isfinite(m.values[i]);
  }
  if (!finite) return std::nullopt;
  return m;
}

}  // namespace hitl
