// DDS Security with the certificates of examples/integrations/security.sh, over DDS on the loopback
// interface: a stranger without a certificate, or with one of another authority, hears nothing and
// commands nothing.
// CTest: dds

#include "../../examples/integrations/messages.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/program.hpp"
#include "support/wait_until.hpp"

#include <gtest/gtest.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <deque>
#include <exception>
#include <filesystem>
#include <fstream>
#include <set>
#include <sstream>
#include <string>
#include <thread>

namespace dds_security_test {

using geometry_msgs::msg::PoseStamped;
using test_support::Directory;
using Names = std::set<std::string>;

/// One side of a line: the vehicle publishes measurements and hears commands, the other side does
/// the reverse. It is a process of its own, because security is a setting of a process.
class Talker {
 public:
  /// `settings` is a file for CYCLONEDDS_URI, or empty. It ends when the file "end" exists.
  Talker(const Directory& directory, const std::string& name, const std::string& settings,
         std::uint32_t domain, bool vehicle)
      : heard_(directory.file(name + ".heard")), said_(directory.file(name + ".said")) {
    pid_ = fork();
    if (pid_ != 0) return;
    prctl(PR_SET_PDEATHSIG, SIGKILL);  // it does not outlive a test that crashes
    int code = 1;
    try {
      if (std::freopen(said_.c_str(), "w", stderr) != nullptr)  // Cyclone reports strangers
        talk(name, settings, domain, vehicle, directory.file("end"));
      code = 0;
    } catch (const std::exception& error) {
      std::fprintf(stderr, "%s\n", error.what());
    }
    std::fflush(stderr);
    _exit(code);
  }
  Talker(const Talker&) = delete;
  Talker& operator=(const Talker&) = delete;
  ~Talker() { end(); }

  /// Names of those whose messages have arrived until now.
  [[nodiscard]] Names heard() const {
    std::istringstream lines(test_support::read_file(heard_));
    Names names;
    for (std::string line; std::getline(lines, line);) names.insert(line);
    return names;
  }
  [[nodiscard]] std::string said() const { return test_support::read_file(said_); }
  /// Waits for the end of the process. Returns its exit code.
  int end() {
    if (pid_ <= 0) return -1;
    int status = 0;
    waitpid(pid_, &status, 0);
    pid_ = -1;
    return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
  }

 private:
  void talk(const std::string& name, const std::string& settings, std::uint32_t domain,
            bool vehicle, const std::string& end) const {
    if (!settings.empty()) {
      const std::string uri = std::string(std::getenv("CYCLONEDDS_URI")) + ",file://" + settings;
      setenv("CYCLONEDDS_URI", uri.c_str(), 1);
    }
    const dds::Participant participant(domain);
    dds::Publisher<PoseStamped> publisher(participant, vehicle ? "measurement" : "command");
    dds::Subscriber<PoseStamped> subscriber(participant, vehicle ? "command" : "measurement");
    std::string sender = name;
    PoseStamped message{};
    message.header.frame_id = sender.data();
    Names names;
    std::ofstream out(heard_);
    while (!std::filesystem::exists(end)) {
      publisher.publish(message);
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
      subscriber.take([&](const PoseStamped& m) {
        if (names.insert(m.header.frame_id).second) out << m.header.frame_id << '\n' << std::flush;
      });
    }
  }

  std::string heard_, said_;
  pid_t pid_ = -1;
};

TEST(DdsSecurity, StrangersHearAndCommandNothing) {
  if (test_support::run("openssl", "version").exit_code != 0) GTEST_SKIP() << "openssl is missing";
  const std::uint32_t domain = test_support::dds_on_loopback();
  const Directory directory("dds_security");
  const auto make = [&](const std::string& authority, const std::string& name) {
    return test_support::run("bash",
                             "'" SECURITY_SCRIPT "' '" + directory.file(authority) + "' " + name);
  };
  for (const char* authority : {"ours", "other"})
    for (const char* name : {"vehicle", "node"}) {  // the node joins an existing authority
      const auto made = make(authority, name);
      ASSERT_EQ(made.exit_code, 0) << made.output;
      if (made.says("no plugins")) GTEST_SKIP() << made.output;
    }
  EXPECT_EQ(make("ours", "node").exit_code, 1) << "replaced a participant";
  const auto settings = [&](const std::string& folder) {
    return directory.file(folder + "/cyclonedds.xml");
  };

  // Three pairs in one domain. That the strangers hear each other shows that they could hear.
  struct Side {
    std::string name, settings, partner;
    bool vehicle;
  };
  const Side sides[] = {{"our_vehicle", settings("ours/vehicle"), "our_node", true},
                        {"our_node", settings("ours/node"), "our_vehicle", false},
                        {"other_vehicle", settings("other/vehicle"), "other_node", true},
                        {"other_node", settings("other/node"), "other_vehicle", false},
                        {"plain_vehicle", "", "plain_node", true},
                        {"plain_node", "", "plain_vehicle", false}};
  std::deque<Talker> talkers;
  for (const Side& side : sides)
    talkers.emplace_back(directory, side.name, side.settings, domain, side.vehicle);
  const auto all_hear = [&] {
    for (const Talker& talker : talkers)
      if (talker.heard().empty()) return false;
    return true;
  };
  EXPECT_TRUE(test_support::wait_until([&] {
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
    return all_hear();
  }));
  std::this_thread::sleep_for(std::chrono::seconds(1));  // for what must not arrive
  directory.write("end", "");
  for (std::size_t i = 0; i < talkers.size(); ++i) {
    EXPECT_EQ(talkers[i].end(), 0) << sides[i].name << ": " << talkers[i].said();
    EXPECT_EQ(talkers[i].heard(), Names{sides[i].partner})
        << sides[i].name << ": " << talkers[i].said();
  }
}

}  // namespace dds_security_test
