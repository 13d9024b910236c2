// Hardware in the loop: messages, link, and a flight of the three programs over loopback.

#include "../../examples/hitl/link.hpp"
#include "../../examples/hitl/message.hpp"
#include "support/background.hpp"
#include "support/full_run.hpp"
#include "support/program.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <vector>

namespace {

using hitl::Datagram;
using hitl::Message;
using hitl::MessageType;
using std::chrono::milliseconds;
using test_support::Background;

Message sample(MessageType type, std::uint32_t sequence = 0) {
  Message m;
  m.type = type;
  m.session = 0xdeadbeefU;
  m.sequence = sequence;
  m.time = 12.345;
  m.stamp = 0x0123456789abcdefULL;
  for (std::size_t i = 0; i < *hitl::value_count(type); ++i)
    m.values[i] = -1.5 * static_cast<double>(i) + 1e-300;
  return m;
}

constexpr MessageType types[] = {MessageType::inertial, MessageType::pose, MessageType::wrench,
                                 MessageType::actuators, MessageType::end};

TEST(HitlMessage, DecodingRestoresTheEncodedMessage) {
  for (const MessageType type : types) {
    const Message sent = sample(type, 77);
    const Datagram d = hitl::encode(sent);
    EXPECT_EQ(d.size, 36 + 8 * *hitl::value_count(type));
    const auto got = hitl::decode(d.bytes.data(), d.size);
    ASSERT_TRUE(got.has_value());
    EXPECT_EQ(got->type, sent.type);
    EXPECT_EQ(got->session, sent.session);
    EXPECT_EQ(got->sequence, sent.sequence);
    EXPECT_EQ(got->time, sent.time);
    EXPECT_EQ(got->stamp, sent.stamp);
    EXPECT_EQ(got->values, sent.values);
  }
}

TEST(HitlMessage, ByteLayoutMatchesTheDocumentation) {
  Message m = sample(MessageType::end, 0x01020304U);
  m.time = 1.0;  // 0x3ff0000000000000
  const Datagram d = hitl::encode(m);
  const std::vector<int> head = {'T', 'R', 'H', 'L', 1, 5, 36, 0, 0xef, 0xbe, 0xad, 0xde,
                                 4,   3,   2,   1,   0, 0, 0,  0, 0,    0,    0xf0, 0x3f};
  for (std::size_t i = 0; i < head.size(); ++i) EXPECT_EQ(d.bytes[i], head[i]) << i;
  EXPECT_EQ(d.bytes[24], 0xef);
  EXPECT_EQ(d.bytes[31], 0x01);
  // The standard check value of CRC-32.
  const std::string digits = "123456789";
  EXPECT_EQ(hitl::detail::checksum(reinterpret_cast<const std::uint8_t*>(digits.data()), 9),
            0xcbf43926U);
}

TEST(HitlMessage, RejectsEveryFlippedBitAndEveryWrongSize) {
  for (const MessageType type : types) {
    const Datagram good = hitl::encode(sample(type));
    for (std::size_t bit = 0; bit < 8 * good.size; ++bit) {
      Datagram bad = good;
      bad.bytes[bit / 8] = static_cast<std::uint8_t>(bad.bytes[bit / 8] ^ (1U << (bit % 8)));
      EXPECT_FALSE(hitl::decode(bad.bytes.data(), bad.size).has_value()) << bit;
    }
    for (std::size_t size = 0; size < good.bytes.size(); ++size)
      EXPECT_EQ(hitl::decode(good.bytes.data(), size).has_value(), size == good.size);
  }
}

TEST(HitlMessage, RejectsNonFiniteNumbers) {
  for (const double bad :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    Message m = sample(MessageType::wrench);
    m.values[11] = bad;
    Datagram d = hitl::encode(m);
    EXPECT_FALSE(hitl::decode(d.bytes.data(), d.size).has_value());
    m = sample(MessageType::end);
    m.time = bad;
    d = hitl::encode(m);
    EXPECT_FALSE(hitl::decode(d.bytes.data(), d.size).has_value());
  }
}

TEST(HitlMessage, RejectsRandomBytes) {
  std::mt19937 random(3);
  std::vector<std::uint8_t> bytes(200);
  for (int i = 0; i < 100000; ++i) {
    for (auto& byte : bytes) byte = static_cast<std::uint8_t>(random());
    EXPECT_FALSE(hitl::decode(bytes.data(), random() % 200).has_value());
  }
}

// ---- Link. The ports depend on the process id, so that test processes can run at the same time.

std::string address(int offset) {
  return "127.0.0.1:" + std::to_string(25000 + 7 * (getpid() % 4000) + offset);
}

std::vector<Message> all(hitl::Link& link) {
  std::vector<Message> messages;
  link.wait(hitl::Clock::now() + milliseconds(100));
  while (const auto m = link.receive()) messages.push_back(*m);
  return messages;
}

TEST(HitlLink, CountsSessionsReceivedAndLostMessages) {
  hitl::Link b(address(1), {address(0)}, {});
  {
    hitl::Link a(address(0), {address(1)}, {});
    for (int i = 0; i < 10; ++i) a.send(0, sample(MessageType::pose));
    EXPECT_EQ(all(b).size(), 10u);
  }
  hitl::Link lossy(address(0), {address(1)}, {0.3, 0.0, 0.0});
  for (int i = 0; i < 300; ++i) lossy.send(0, sample(MessageType::pose));
  const auto got = all(b).size();
  EXPECT_NEAR(static_cast<double>(got), 210.0, 40.0);
  const hitl::ArrivalCounts counts = b.counts(MessageType::pose);
  EXPECT_EQ(counts.sessions, 2);  // the sender was restarted
  EXPECT_EQ(counts.received, static_cast<long>(10 + got));
  EXPECT_NEAR(static_cast<double>(counts.lost), 300.0 - static_cast<double>(got), 10.0);
  EXPECT_EQ(counts.late, 0);
}

TEST(HitlLink, DropsDelayedMessagesThatNewerOnesOvertook) {
  hitl::Link b(address(1), {address(0)}, {});
  hitl::Link a(address(0), {address(1)}, {0.0, 0.5, 0.05});
  for (int i = 0; i < 100; ++i) a.send(0, sample(MessageType::pose));
  const std::size_t at_once = all(b).size();
  EXPECT_LT(at_once, 80u);
  std::this_thread::sleep_for(milliseconds(80));
  a.wait(hitl::Clock::now());  // sends what was held back
  all(b);
  const hitl::ArrivalCounts counts = b.counts(MessageType::pose);
  EXPECT_GT(counts.late, 20);
  EXPECT_EQ(counts.received + counts.late + counts.lost, 100);
  EXPECT_LE(counts.lost, 0);
}

TEST(HitlLink, CountsAndDropsForeignDatagrams) {
  hitl::Link b(address(1), {address(0)}, {});
  hitl::Link stranger(address(2), {address(1)}, {});
  stranger.send(0, sample(MessageType::pose));
  EXPECT_TRUE(all(b).empty());
  EXPECT_EQ(b.foreign(), 1);
  // Datagrams from the address of a peer that are not messages.
  const sockaddr_in own = hitl::parse_address(address(0)), to = hitl::parse_address(address(1));
  const int raw = socket(AF_INET, SOCK_DGRAM, 0);
  ASSERT_EQ(bind(raw, reinterpret_cast<const sockaddr*>(&own), sizeof own), 0);
  const std::string text(1000, 'x');
  for (const std::size_t size : {0U, 1U, 36U, 1000U})
    sendto(raw, text.data(), size, 0, reinterpret_cast<const sockaddr*>(&to), sizeof to);
  close(raw);
  EXPECT_TRUE(all(b).empty());
  EXPECT_EQ(b.foreign(), 5);
}

TEST(HitlLink, RejectsInvalidAndTakenAddresses) {
  for (const char* bad :
       {"", "127.0.0.1", "127.0.0.1:", "127.0.0.1:0", "127.0.0.1:70000", "localhost:24001",
        "1.2.3:24001", "127.0.0.1:24001x", "127.0.0.1: 24001", "127.0.0.1:+24001"})
    EXPECT_THROW((void)hitl::parse_address(bad), std::runtime_error) << bad;
  hitl::Link taken(address(3), {}, {});
  EXPECT_THROW(hitl::Link(address(3), {}, {}), std::runtime_error);
}

// ---- Flights

class HitlFlight : public testing::Test {
 protected:
  [[nodiscard]] std::string common(const std::string& more) const {
    return "--simulator " + address(4) + " --onboard " + address(5) + " --flight-controller " +
           address(6) + ' ' + more;
  }
  [[nodiscard]] std::string report(const std::string& name) const { return directory_.file(name); }

  const bool full_ = test_support::full_run();
  test_support::Directory directory_{"hitl"};
};

// A full run flies the whole mission; otherwise the flight ends after 8 s (take-off and hover).
// Test machines are busy, so that only a full run checks deadlines.
TEST_F(HitlFlight, FliesOverLoopback) {
  Background onboard(HITL_ONBOARD_PROGRAM, common(""), report("onboard"));
  Background flight(HITL_FLIGHT_CONTROLLER_PROGRAM, common(""), report("flight"));
  Background vehicle(HITL_SIMULATOR_PROGRAM, common(full_ ? "" : "--until 8"), report("vehicle"));
  const auto flown = vehicle.wait();
  const auto computed = onboard.wait(), commanded = flight.wait();
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LT(flown["final_position_error_m"], 0.03);
  EXPECT_LT(flown["takeoff_overshoot_m"], 0.05);
  EXPECT_GT(flown["round_trip_median_us"], 10.0);
  EXPECT_LT(flown["round_trip_median_us"], 10000.0);
  EXPECT_EQ(computed["onboard_missions"], 1);
  EXPECT_GT(computed["onboard_ticks"], 1000);
  EXPECT_EQ(computed["onboard_solver_failures"], 0);
  EXPECT_EQ(commanded["wrench_sessions"], 1);
  if (!full_) return;
  EXPECT_LT(computed["onboard_deadline_misses"], 1e-3 * computed["onboard_ticks"]);
  EXPECT_LE(flown["air_rmse_m"], 1.2 * 0.0030);
  EXPECT_LE(flown["ground_rmse_m"], 1.2 * 0.0083);
  EXPECT_LE(flown["mission_rmse_m"], 1.2 * 0.0098);
  EXPECT_GE(flown["power_saved_percent"], 92.8);
}

TEST_F(HitlFlight, SurvivesABadLineAndTheRestartOfEachProgram) {
  const std::string bad = common("--loss 0.05 --spike-share 0.01 --spike 0.02 ");
  const auto onboard = [&] {
    return std::make_unique<Background>(HITL_ONBOARD_PROGRAM, bad, report("onboard"));
  };
  const auto flight = [&] {
    return std::make_unique<Background>(HITL_FLIGHT_CONTROLLER_PROGRAM, bad, report("flight"));
  };
  const auto seconds = [](double s) {
    std::this_thread::sleep_for(milliseconds(static_cast<int>(1000.0 * s)));
  };
  auto computer = onboard(), controller = flight();
  {
    Background first(HITL_SIMULATOR_PROGRAM, bad + "--until 100", report("first"));
    seconds(5.0);  // taking off
    first.crash();
  }
  Background vehicle(HITL_SIMULATOR_PROGRAM, bad + (full_ ? "" : "--until 12"), report("vehicle"));
  seconds(3.0 + 7.5);  // hovering
  computer->crash();
  seconds(0.2);
  computer = onboard();
  seconds(1.5);
  controller->crash();
  seconds(0.1);
  controller = flight();
  const auto flown = vehicle.wait();
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LT(flown["final_position_error_m"], 0.1) << flown.output;
  EXPECT_EQ(flown["actuators_sessions"], 2) << flown.output;
  EXPECT_GT(flown["actuators_lost"], 0);
  EXPECT_GT(flown["actuators_late"], 0);
  const auto computed = computer->wait(), commanded = controller->wait();
  EXPECT_EQ(computed["onboard_missions"], 1) << computed.output;
  EXPECT_EQ(computed["onboard_solver_failures"], 0) << computed.output;
  EXPECT_EQ(commanded["wrench_sessions"], 1) << commanded.output;
  if (full_) {
    EXPECT_LT(flown["mission_rmse_m"], 0.05) << flown.output;
  }
}

TEST_F(HitlFlight, ReportsMissingProgramsAndTakenAddress) {
  const auto alone = test_support::run(HITL_SIMULATOR_PROGRAM, common(""));
  EXPECT_EQ(alone.exit_code, 1);
  EXPECT_TRUE(alone.says("hitl_onboard and hitl_flight_controller running?")) << alone.output;
  hitl::Link taken(address(5), {}, {});
  const auto second = test_support::run(HITL_ONBOARD_PROGRAM, common(""));
  EXPECT_EQ(second.exit_code, 1);
  EXPECT_TRUE(second.says("cannot listen at " + address(5))) << second.output;
}

TEST_F(HitlFlight, HelpAndBadArguments) {
  for (const char* program :
       {HITL_SIMULATOR_PROGRAM, HITL_ONBOARD_PROGRAM, HITL_FLIGHT_CONTROLLER_PROGRAM}) {
    const auto help = test_support::run(program, "--help");
    EXPECT_EQ(help.exit_code, 0);
    EXPECT_TRUE(help.says("--spike-share"));
    EXPECT_GT(test_support::run(program, "--loss 2").exit_code, 100);
    const auto bad = test_support::run(program,
                                       "--simulator nowhere --onboard nowhere "
                                       "--flight-controller nowhere");
    EXPECT_EQ(bad.exit_code, 1);
    EXPECT_TRUE(bad.says("'nowhere' is not ADDRESS:PORT")) << bad.output;
  }
}

}  // namespace
