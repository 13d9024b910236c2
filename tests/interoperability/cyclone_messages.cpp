// Every message of the nodes goes from Cyclone DDS to Fast DDS and back, field by field equal.

#include "../../examples/integrations/messages.hpp"
#include "../support/background.hpp"
#include "../support/check_table.hpp"
#include "../support/dds_on_loopback.hpp"
#include "pattern.hpp"

#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <cstddef>
#include <memory>
#include <string>
#include <thread>
#include <vector>

namespace interoperability {

#include <fields_c.inc>

namespace {

/// One topic in each direction.
class Exchange {
 public:
  virtual ~Exchange() = default;
  virtual void publish() = 0;
  virtual void take() = 0;

  int received = 0, fields_seen = 0, mismatches = 0;  // fields: of all messages received
};

template <typename Message>
class ExchangeOf : public Exchange {
 public:
  ExchangeOf(const dds::Participant& participant, int number)
      : number_(number),
        publisher_(participant, "cyclone_" + std::to_string(number)),
        subscriber_(participant, "fast_dds_" + std::to_string(number)) {}

  void publish() override {
    Message message{};
    Visitor<Purpose::fill> visitor(from_cyclone(number_));
    visitor(message);
    publisher_.publish(message);
  }
  void take() override {
    subscriber_.take([this](Message message) {
      Visitor<Purpose::check> visitor(from_fast_dds(number_));
      visitor(message);
      ++received;
      fields_seen += visitor.fields_seen;
      mismatches += visitor.mismatches;
    });
  }

 private:
  int number_;
  dds::Publisher<Message> publisher_;
  dds::Subscriber<Message> subscriber_;
};

TEST(Interoperability, EveryFieldPassesBetweenCycloneAndFastDds) {
  const std::uint32_t domain = test_support::dds_on_loopback();
  const dds::Participant participant(domain);
  std::vector<std::string> names;
  std::vector<std::unique_ptr<Exchange>> all;
#define TOPIC(PACKAGE, MODULE, NAME, WIRE_NAME)                                   \
  names.emplace_back(#MODULE #NAME);                                              \
  all.push_back(std::make_unique<ExchangeOf<PACKAGE##_msg_##MODULE##_##NAME##_>>( \
      participant, static_cast<int>(all.size())));
#include "topics.inc"
#undef TOPIC

  const test_support::Directory directory("interoperability");
  test_support::Background other(FAST_DDS_MESSAGES_PROGRAM, std::to_string(domain),
                                 directory.file("fast_dds"));
  std::atomic<bool> ended{false};
  std::thread line([&] {
    while (!ended) {
      for (const auto& exchange : all) {
        exchange->publish();
        exchange->take();
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
  });
  const auto outcome = other.wait();
  ended = true;
  line.join();
  EXPECT_EQ(outcome.exit_code, 0) << outcome.output;
  int sent = 0, returned = 0;
  for (std::size_t i = 0; i < all.size(); ++i) {
    EXPECT_GT(all[i]->received, 0) << names[i];
    EXPECT_GT(all[i]->fields_seen, 0) << names[i];
    EXPECT_EQ(all[i]->mismatches, 0) << names[i];
    EXPECT_EQ(outcome[names[i] + "_mismatches"], 0) << names[i];
    EXPECT_GT(outcome[names[i] + "_fields"], 0) << names[i];
    sent += static_cast<int>(outcome[names[i] + "_fields"]);
    returned += all[i]->fields_seen;
  }
  test_support::check_at_least(29, "fields compared in Fast DDS", sent, 500.0);
  test_support::check_at_least(29, "fields compared in Cyclone DDS", returned, 500.0);
}

}  // namespace
}  // namespace interoperability
