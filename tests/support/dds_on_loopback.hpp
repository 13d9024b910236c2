#pragma once

#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>

namespace test_support {

/// Returns a DDS domain that no other test uses. The name of a local socket reserves it, until this
/// process and those that it has started have ended.
inline std::uint32_t own_dds_domain() {
  static const std::uint32_t own = [] {
    for (std::uint32_t i = 0;; ++i) {
      // Higher domains have ports that Linux gives to any program.
      const std::uint32_t domain = 1U + (static_cast<std::uint32_t>(getpid()) + i) % 100U;
      sockaddr_un name{};
      name.sun_family = AF_UNIX;  // a name that begins with zero is not in the file system
      std::snprintf(name.sun_path + 1, sizeof name.sun_path - 1, "tilt_ropter_dds_%u", domain);
      const int handle = socket(AF_UNIX, SOCK_DGRAM, 0);
      if (bind(handle, reinterpret_cast<const sockaddr*>(&name), sizeof name) == 0 || i == 100)
        return domain;
      close(handle);
    }
  }();
  return own;
}

/// Restricts Cyclone DDS, in this process and in those that it starts, to the loopback interface
/// without multicast, and to a DDS domain of its own, so that test processes can run at the same
/// time. Call it before the first participant. Returns the domain.
inline std::uint32_t dds_on_loopback() {
  const std::uint32_t domain = own_dds_domain();
  setenv("ROS_DOMAIN_ID", std::to_string(domain).c_str(), 1);
  setenv("CYCLONEDDS_URI",
         "<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface name='lo' "
         "multicast='false'/></Interfaces><AllowMulticast>false</AllowMulticast></General>"
         "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>9"
         "</MaxAutoParticipantIndex><Peers><Peer Address='127.0.0.1'/></Peers></Discovery>"
         "</Domain></CycloneDDS>",
         1);
  return domain;
}

}  // namespace test_support
