// Datagrams: every message that decode() accepts is finite and encodes to the same bytes.

#include "../../examples/hitl/message.hpp"
#include "fuzz/input.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

void try_to_decode(const std::vector<std::uint8_t>& bytes) {
  const auto message = hitl::decode(bytes.data(), bytes.size());
  if (!message) return;
  fuzz::expect(std::isfinite(message->time), "the time is finite");
  const hitl::Datagram again = hitl::encode(*message);
  fuzz::expect(
      again.size == bytes.size() && std::equal(bytes.begin(), bytes.end(), again.bytes.begin()),
      "what was decoded encodes to the same bytes");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  std::vector<std::uint8_t> datagram(bytes, bytes + size);
  try_to_decode(datagram);
  if (size < hitl::header_size) return 0;
  // Second try with the correct greeting, size and checksum, which a fuzzer cannot guess.
  std::copy(hitl::detail::greeting.begin(), hitl::detail::greeting.end(), datagram.begin());
  const auto count = hitl::value_count(static_cast<hitl::MessageType>(datagram[5]));
  if (count && datagram[31] < 0xf0) datagram.resize(hitl::header_size + 8 * *count);
  hitl::detail::put(datagram.data() + 6, static_cast<std::uint16_t>(datagram.size()));
  hitl::detail::put(datagram.data() + 32, hitl::detail::checksum(datagram.data(), datagram.size()));
  try_to_decode(datagram);
  return 0;
}
