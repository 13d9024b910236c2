#pragma once

#include <unistd.h>

#include <cstdint>
#include <cstdlib>
#include <string>

namespace test_support {

/// Restricts Cyclone DDS, in this process and in those that it starts, to the loopback interface
/// without multicast, and to a DDS domain of its own, so that test processes can run at the same
/// time. Call it before the first participant. Returns the domain.
inline std::uint32_t dds_on_loopback() {
  const auto domain = 1U + static_cast<std::uint32_t>(getpid()) % 100U;
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
