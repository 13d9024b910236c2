// Hardware in the loop: the bad line and silence.
// CTest: real_time dds

#include "../../examples/hitl/link.hpp"
#include "../../examples/hitl/message.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/wait_until.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <chrono>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <thread>
#include <vector>

namespace hitl_inbox_test {

using Eigen::Vector3d;
using Eigen::Vector4d;
using std::chrono::milliseconds;
using test_support::wait_until;

using Wrench = tilt_ropter_msgs::msg::WrenchCommand;
using WrenchInbox = hitl::Inbox<Wrench>;

class HitlInbox : public testing::Test {
 protected:
  /// A sender as a program of its own would be.
  struct Sender {
    explicit Sender(std::uint32_t domain)
        : participant(domain),
          publisher(participant, hitl::wrench_command_topic.name,
                    hitl::wrench_command_topic.offered()) {}
    void send(int count, double force = 1.0) {
      for (int i = 0; i < count; ++i) {
        command.time += 0.01;
        command.wrench.force.x() = force;
        publisher.publish(encoder.encode(command));
      }
    }
    dds::Participant participant;
    dds::Publisher<Wrench> publisher;
    hitl::Encoder encoder;
    hitl::WrenchCommand command;
  };

  [[nodiscard]] hitl::Topic topic() const {
    hitl::Topic deep = hitl::wrench_command_topic;
    deep.depth = 1000;
    return deep;
  }
  /// Waits until `sender` and `inbox` know each other.
  static bool connected(const Sender& sender, const WrenchInbox& inbox) {
    return wait_until([&] { return sender.publisher.subscribers() > 0 && inbox.sender_lives(); });
  }
  /// Takes until `done`. Returns the times of the messages.
  template <typename Done>
  static std::vector<double> take_until(WrenchInbox& inbox, const Done& done) {
    std::vector<double> times;
    EXPECT_TRUE(wait_until([&] {
      inbox.take(hitl::Clock::now(),
                 [&](const hitl::WrenchCommand& c) { times.push_back(c.time); });
      return done();
    }));
    return times;
  }
  /// Takes until this number of messages has come in any way.
  static std::vector<double> take(WrenchInbox& inbox, long arrivals) {
    return take_until(inbox, [&] {
      const hitl::ArrivalCounts c = inbox.counts();
      return c.received + c.lost + c.late + c.rejected >= arrivals;
    });
  }
  static bool becomes_silent(WrenchInbox& inbox) {
    take_until(inbox, [&] { return inbox.silent(); });
    return inbox.silent();
  }
  static bool is_heard_again(WrenchInbox& inbox) {
    take_until(inbox, [&] { return !inbox.silent(); });
    return !inbox.silent();
  }

  const std::uint32_t domain_ = test_support::dds_on_loopback();
  dds::Participant participant_{domain_};
};

TEST_F(HitlInbox, CountsSessionsReceivedAndLostMessages) {
  WrenchInbox clean(participant_, topic(), {}), lossy(participant_, topic(), {0.3, 0.0, 0.0});
  {
    Sender first(domain_);
    ASSERT_TRUE(connected(first, clean) && connected(first, lossy));
    first.send(10);
    EXPECT_EQ(take(clean, 10).size(), 10U);
    take(lossy, 10);
  }
  Sender second(domain_);
  ASSERT_TRUE(wait_until([&] { return second.publisher.subscribers() == 2; }));
  ASSERT_TRUE(connected(second, clean) && connected(second, lossy));
  second.send(300);
  EXPECT_EQ(take(clean, 310).size(), 300U);
  const auto got = static_cast<double>(take(lossy, 310).size());
  EXPECT_NEAR(got, 210.0, 40.0);
  EXPECT_EQ(clean.counts().sessions, 2);  // the sender was restarted
  EXPECT_EQ(clean.counts().received, 310);
  EXPECT_EQ(clean.counts().lost + clean.counts().late + clean.counts().rejected, 0);
  EXPECT_EQ(lossy.counts().sessions, 2);
  EXPECT_EQ(lossy.counts().received + lossy.counts().lost, 310);
  EXPECT_NEAR(static_cast<double>(lossy.counts().lost), 93.0, 45.0);
  EXPECT_EQ(lossy.counts().late, 0);
}

// Best-effort readers are not told of messages that never arrive.
TEST_F(HitlInbox, CountsLossesByTheStamps) {
  hitl::Topic regular = topic();
  regular.period = 0.01;
  WrenchInbox inbox(participant_, regular, {}), irregular(participant_, topic(), {});
  const auto arrive = [&](Sender& sender, int count) {
    const long before = inbox.counts().received;
    sender.send(count);
    take_until(inbox, [&] { return inbox.counts().received == before + count; });
  };
  {
    Sender sender(domain_);
    ASSERT_TRUE(connected(sender, inbox) && connected(sender, irregular));
    arrive(sender, 10);
    sender.command.time += 0.03;  // three are lost
    arrive(sender, 10);
    EXPECT_EQ(inbox.counts().lost, 3);
    sender.command.time -= 0.1;  // the simulation has begun again
    arrive(sender, 10);
    EXPECT_EQ(inbox.counts().lost, 3);
  }
  Sender second(domain_);
  second.command.time = 77.0;
  ASSERT_TRUE(connected(second, inbox));
  arrive(second, 10);
  EXPECT_EQ(inbox.counts().lost, 3);
  take(irregular, 40);
  EXPECT_EQ(irregular.counts().lost, 0);
}

TEST_F(HitlInbox, DropsDelayedMessagesThatNewerOnesOvertook) {
  WrenchInbox some(participant_, topic(), {0.0, 0.5, 0.05}),
      all(participant_, topic(), {0.0, 1.0, 0.05});
  Sender sender(domain_);
  ASSERT_TRUE(connected(sender, some) && connected(sender, all));
  sender.send(100);
  const auto sent = hitl::Clock::now();
  std::this_thread::sleep_for(milliseconds(10));
  all.take(sent, [](const hitl::WrenchCommand&) { FAIL() << "nothing is in time"; });
  const auto delayed = take(all, 100), times = take(some, 100);
  EXPECT_TRUE(std::is_sorted(times.begin(), times.end()));
  EXPECT_LT(times.size(), 80U);
  const hitl::ArrivalCounts counts = some.counts();
  EXPECT_GT(counts.late, 20);
  EXPECT_EQ(counts.received + counts.late, 100);
  EXPECT_EQ(counts.lost, 0);
  EXPECT_EQ(delayed.size(), 100U);  // none overtook another
}

TEST_F(HitlInbox, CountsAndDropsUnusableMessages) {
  WrenchInbox inbox(participant_, topic(), {});
  Sender sender(domain_);
  ASSERT_TRUE(connected(sender, inbox));
  sender.send(1);
  sender.send(3, std::numeric_limits<double>::quiet_NaN());
  sender.send(1);
  EXPECT_EQ(take(inbox, 5).size(), 2U);
  EXPECT_EQ(inbox.counts().rejected, 3);
}

TEST_F(HitlInbox, SaysWhenTheSenderIsSilent) {
  WrenchInbox inbox(participant_, topic(), {}), deaf(participant_, topic(), {1.0, 0.0, 0.0});
  EXPECT_FALSE(inbox.sender_lives());
  std::optional<Sender> sender(std::in_place, domain_);
  ASSERT_TRUE(connected(*sender, inbox) && connected(*sender, deaf));
  EXPECT_TRUE(inbox.silent());  // nothing came yet
  sender->send(1);
  EXPECT_TRUE(is_heard_again(inbox));
  take(deaf, 1);
  EXPECT_TRUE(deaf.silent());  // DDS hears the sender, but the line takes all away
  EXPECT_TRUE(becomes_silent(inbox));
  EXPECT_TRUE(inbox.sender_lives());
  sender->send(1);
  EXPECT_TRUE(is_heard_again(inbox));
  sender.reset();  // the sender ends: DDS no longer watches its deadline
  EXPECT_TRUE(becomes_silent(inbox));
  EXPECT_FALSE(inbox.sender_lives());
}

// A second sender that comes and goes: the first one, which never stopped, is heard again.
TEST_F(HitlInbox, HearsTheFormerSenderWhenTheNewerOneIsGone) {
  WrenchInbox inbox(participant_, topic(), {0.0, 0.0, 0.0, 1.0});
  Sender first(domain_), second(domain_);
  ASSERT_TRUE(connected(first, inbox));
  ASSERT_TRUE(wait_until([&] { return second.publisher.subscribers() > 0; }));
  const auto take_at = [&](double time, long arrivals) {
    return wait_until([&] {
      inbox.take(hitl::time_point(time), [](const hitl::WrenchCommand&) {});
      return inbox.counts().received + inbox.counts().late >= arrivals;
    });
  };
  first.send(1);
  EXPECT_TRUE(take_at(1.0, 1));
  second.send(1);
  EXPECT_TRUE(take_at(1.01, 2));
  first.send(1);
  EXPECT_TRUE(take_at(1.02, 3));
  EXPECT_EQ(inbox.counts().late, 1);  // the newer one counts
  first.send(1);
  EXPECT_TRUE(take_at(1.07, 4));  // the deadline is 50 ms
  EXPECT_EQ(inbox.counts().late, 1);
  EXPECT_EQ(inbox.counts().sessions, 3);
}

TEST_F(HitlInbox, InLockStepSilenceIsATimeOfTheSimulation) {
  WrenchInbox inbox(participant_, topic(), {0.0, 0.0, 0.0, 1.0});
  Sender sender(domain_);
  ASSERT_TRUE(connected(sender, inbox));
  const auto silent_at = [&](double time) {
    inbox.take(hitl::time_point(time), [](const hitl::WrenchCommand&) {});
    return inbox.silent();
  };
  EXPECT_TRUE(silent_at(1.0));
  sender.send(1);
  EXPECT_TRUE(wait_until([&] { return !silent_at(1.0); }));
  std::this_thread::sleep_for(milliseconds(100));  // the deadline is 50 ms
  EXPECT_FALSE(silent_at(1.049));
  EXPECT_TRUE(silent_at(1.051));
}

TEST_F(HitlInbox, RejectsADomainThatDoesNotExist) {
  setenv("ROS_DOMAIN_ID", "233", 1);
  EXPECT_THROW((void)loops::ros_domain(), std::runtime_error);
}

}  // namespace hitl_inbox_test
