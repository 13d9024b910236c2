// Addresses of the programs that use UDP: any text is four numbers and a port, or it is rejected.

#include "../../examples/hitl/link.hpp"
#include "fuzz/input.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  const std::string text = (input.coin() ? "127.0.0.1:" : "") + input.rest();
  if (text.find('\0') != std::string::npos) return 0;  // arguments contain no null character
  try {
    const sockaddr_in address = hitl::parse_address(text);
    std::array<char, INET_ADDRSTRLEN> shown{};
    fuzz::expect(inet_ntop(AF_INET, &address.sin_addr, shown.data(), shown.size()) != nullptr,
                 "the address can be printed");
    const std::string again =
        std::string(shown.data()) + ':' + std::to_string(ntohs(address.sin_port));
    fuzz::expect(address.sin_family == AF_INET && again == text,
                 "nothing but the address is taken");
  } catch (const std::runtime_error&) {
  }
  return 0;
}
