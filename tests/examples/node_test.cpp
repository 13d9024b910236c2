// What all nodes share: the arguments of ROS 2, ticks, telemetry.
// CTest: dds

#include "../../examples/integrations/node.hpp"
#include "../../examples/integrations/telemetry.hpp"
#include "support/dds_on_loopback.hpp"
#include "support/program.hpp"
#include "support/wait_until.hpp"

#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <chrono>
#include <cstdint>
#include <fstream>
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace loops {
namespace node_test {

using Times = std::vector<std::int64_t>;

constexpr std::int64_t ms = 1000000;

/// The times [ms] at which ticks of 10 ms begin if the clock is read at `readings` [ms].
Times ticks_of(TickTimer& timer, const Times& readings) {
  Times begun;
  for (const std::int64_t now : readings) {
    if (!timer.begins(now * ms)) continue;
    begun.push_back(now);
    timer.ended(now * ms);
  }
  return begun;
}

TEST(TickTimer, RunsEveryTickOfAClockWithUnevenSteps) {
  for (const std::int64_t first : {8, 12}) {
    TickTimer timer(10 * ms, true);
    Times readings{1000};
    for (int i = 0; i < 100; ++i)
      readings.push_back(readings.back() + (i % 2 == 0 ? first : 20 - first));
    EXPECT_EQ(ticks_of(timer, readings), readings);
    EXPECT_EQ(timer.counts().late, 0);
    EXPECT_EQ(timer.counts().ticks, 101);
  }
}

TEST(TickTimer, RunsNoTickTwiceAtOneTime) {
  for (const bool in_steps : {false, true}) {
    TickTimer timer(10 * ms, in_steps);
    EXPECT_EQ(ticks_of(timer, {0, 0, 10, 10, 10, 30, 30, 30, 40, 40}), (Times{0, 10, 30, 40}));
    EXPECT_EQ(timer.counts().late, 1);  // that of 20 ms
  }
}

TEST(TickTimer, LeavesOutTicksThatCannotBeginInTime) {
  TickTimer timer(10 * ms, false);
  EXPECT_EQ(ticks_of(timer, {100, 109, 110, 135, 136, 139, 140, 159, 160}),
            (Times{100, 110, 135, 140, 159, 160}));
  EXPECT_EQ(timer.counts().late, 1);  // that of 120 ms
  EXPECT_NEAR(timer.counts().worst, 0.015, 1e-9);
  // A tick that takes 25 ms is late, and so is the next one, which is left out.
  ASSERT_TRUE(timer.begins(170 * ms));
  timer.ended(195 * ms);
  EXPECT_EQ(ticks_of(timer, {195, 200, 210}), (Times{195, 200, 210}));
  EXPECT_EQ(timer.counts().late, 3);
  EXPECT_NEAR(timer.counts().worst, 0.025, 1e-9);
}

TEST(TickTimer, ReadsFineStepsToTheNextOneAndCoarseOnesAsTheyAre) {
  TickTimer fine(10 * ms, true), coarse(10 * ms, true);
  Times readings;
  for (int i = 0; i < 35; ++i) readings.push_back(i);
  EXPECT_EQ(ticks_of(fine, readings), (Times{0, 10, 20, 30}));
  EXPECT_EQ(ticks_of(coarse, {0, 100, 200}), (Times{0, 100, 200}));
  EXPECT_EQ(coarse.counts().late, 18);
}

TEST(TickTimer, BeginsAnewWithAClockThatBeginsAnew) {
  TickTimer timer(10 * ms, true);
  EXPECT_EQ(ticks_of(timer, {5000, 5010, 7, 17, 27}), (Times{5000, 5010, 7, 17, 27}));
  EXPECT_EQ(timer.counts().late, 0);
}

using Words = std::vector<std::string>;

TEST(Parameters, AreTakenOutOfTheArguments) {
  Words arguments = {"--a", "--ros-args", "-p",  "x:=2.5",     "-r", "imu:=/other",
                     "--",  "b",          "--c", "--ros-args", "-p", "y:=text"};
  Parameters parameters = Parameters::from(arguments);
  EXPECT_EQ(arguments, (Words{"--a", "b", "--c"}));
  EXPECT_EQ(parameters.number("x", 1.0, 0.0, 3.0), 2.5);
  EXPECT_EQ(parameters.number("z", 1.0, 0.0, 3.0), 1.0);
  EXPECT_THROW(parameters.refuse_unknown(), std::invalid_argument);
  EXPECT_EQ(parameters.text("y"), "text");
  EXPECT_EQ(parameters.topic("pose"), "/pose");
  EXPECT_THROW(parameters.refuse_unknown(), std::invalid_argument);
  EXPECT_EQ(parameters.topic("imu"), "/other");
  EXPECT_NO_THROW(parameters.refuse_unknown());
  for (const std::initializer_list<std::string> bad :
       {std::initializer_list<std::string>{"--ros-args", "-p"},
        {"--ros-args", "-p", "x=1"},
        {"--ros-args", "-p", ":=1"},
        {"--ros-args", "--log-level", "loud"},
        {"--ros-args", "-r", "__ns:=relative"},
        {"--ros-args", "-r", "__ns:=/ends/"},
        {"--ros-args", "--params-file", "nowhere.yaml"},
        {"--ros-args", "--enclave", "/x"}}) {
    Words words = bad;
    EXPECT_THROW(Parameters::from(words), std::invalid_argument);
  }
}

// The words that `ros2 launch` passes.
TEST(Parameters, PutTopicsIntoTheNamespace) {
  Words words = {"--ros-args", "--log-level", "WARN", "--ros-args", "-r", "__node:=pilot",
                 "-r",         "__ns:=/a/b",  "-r",   "imu:=imu_2", "-r", "pose:=/mocap",
                 "-r",         "~/x:=y",      "-r",   "other:c:=d", "-p", "sim:=True",
                 "-p",         "pilot:k:=1",  "-p",   "other:l:=2"};
  Parameters parameters = Parameters::from(words, "px4_node");
  EXPECT_EQ(parameters.full_name(), "/a/b/pilot");
  EXPECT_EQ(parameters.prefix(), "a/b/");
  EXPECT_EQ(parameters.topic("path"), "/a/b/path");
  EXPECT_EQ(parameters.topic("/tf"), "/tf");
  EXPECT_EQ(parameters.topic("imu"), "/a/b/imu_2");
  EXPECT_EQ(parameters.topic("pose"), "/mocap");
  EXPECT_EQ(parameters.topic("~/x"), "/a/b/y");
  EXPECT_EQ(parameters.topic("c"), "/a/b/c");  // of another node
  EXPECT_TRUE(parameters.choice("sim", false));
  EXPECT_EQ(parameters.number("k", 0.0, 0.0, 1.0), 1.0);
  EXPECT_EQ(parameters.number("l", 0.0, 0.0, 1.0), 0.0);
  EXPECT_NO_THROW(parameters.refuse_unknown());
}

class YamlParameters : public testing::Test {
 protected:
  [[nodiscard]] std::map<std::string, std::string> read(const std::string& text,
                                                        const std::string& node = "/ns/pilot") {
    std::ofstream(file_) << text;
    return yaml_parameters(file_, node);
  }
  /// The message of the error, without the path of the file.
  [[nodiscard]] std::string error(const std::string& text) {
    try {
      (void)read(text);
    } catch (const std::invalid_argument& e) {
      return std::string(e.what()).substr(file_.size());
    }
    return "none";
  }
  test_support::Directory directory_{"yaml_parameters"};
  std::string file_ = directory_.file("p.yaml");
};

TEST_F(YamlParameters, AreThoseOfTheNode) {
  const std::string text = R"(---
# as launch_ros writes them
/**:
  ros__parameters:
    hover_z: 2.5   # [m]
    use_sim_time: true
ns:
  pilot:
    ros__parameters:
      vehicle: "my # vehicle.json"
      rotor_joints:
      - a
      - 'b'
      limits:
        speed: 3
      joints: [c, d]
other:
  ros__parameters:
    hover_z: 9
)";
  using Map = std::map<std::string, std::string>;
  EXPECT_EQ(read(text), (Map{{"hover_z", "2.5"},
                             {"use_sim_time", "true"},
                             {"vehicle", "my # vehicle.json"},
                             {"rotor_joints", "a,b"},
                             {"limits.speed", "3"},
                             {"joints", "c,d"}}));
  EXPECT_EQ(read(text, "/other"), (Map{{"hover_z", "9"}, {"use_sim_time", "true"}}));
  for (const char* name : {"/ns/pilot", "ns/pilot", "/*/pilot", "/**/pilot", "/ns/**"})
    EXPECT_EQ(read(std::string(name) + ":\n  ros__parameters:\n    a: 1\n").size(), 1U) << name;
  for (const char* name : {"pilot", "/*", "/ns", "/ns/pilot/x", "/x/**"})
    EXPECT_EQ(read(std::string(name) + ":\n  ros__parameters:\n    a: 1\n").size(), 0U) << name;
}

TEST_F(YamlParameters, AreRefusedWithTheirLine) {
  const std::string begin = "/**:\n  ros__parameters:\n";
  EXPECT_EQ(error("a: 1\n"), ", line 1: a value must be below NODE: and ros__parameters:");
  EXPECT_EQ(error(""), ", line 1: a value must be below NODE: and ros__parameters:");
  for (const char* bad :
       {"    a: b: c\n", "    a: [[1]]\n", "    a: [1\n", "    a:\n", "    a: 1\n   b: 2\n"}) {
    const std::string e = error(begin + bad);
    EXPECT_TRUE(e.rfind(", line 3: ", 0) == 0 || e.rfind(", line 4: ", 0) == 0) << bad << e;
  }
}

TEST_F(YamlParameters, ComeInTheOrderOfTheArguments) {
  std::ofstream(file_) << "pilot:\n  ros__parameters:\n    a: 1\n    b: 1\n";
  Words words = {"--ros-args", "-p",   "a:=0", "--params-file", file_,
                 "-p",         "b:=2", "-r",   "__node:=pilot"};
  Parameters parameters = Parameters::from(words);
  EXPECT_EQ(parameters.text("a"), "1");
  EXPECT_EQ(parameters.text("b"), "2");
}

TEST(RosDomain, HasPorts) {
  setenv("ROS_DOMAIN_ID", "230", 1);
  EXPECT_EQ(ros_domain(), 230U);
  for (const char* bad : {"231", "232", "-1", "x"}) {
    setenv("ROS_DOMAIN_ID", bad, 1);
    EXPECT_THROW((void)ros_domain(), std::runtime_error) << bad;
  }
}

// The telemetry of a simulation that runs at any speed.
TEST(Telemetry, FollowsTheClockOfTheSnapshots) {
  dds::Participant participant(test_support::dds_on_loopback());
  Parameters parameters{{"telemetry_rate", "20"}};
  Node node(parameters);
  dds::Subscriber<nav_msgs::msg::Odometry> odometry(participant, "odometry");
  dds::Subscriber<diagnostic_msgs::msg::DiagnosticArray> diagnostics(participant, "/diagnostics");
  Telemetry telemetry(node, tilt_ropter::tilt_ropter_vehicle());
  ASSERT_TRUE(test_support::wait_until(
      [&] { return odometry.publishers() == 1 && diagnostics.publishers() == 1; }));
  Snapshot snapshot;
  snapshot.body.orientation = {0.0, 0.0, 0.0, 1.0};  // looks back
  snapshot.body.velocity << 1.0, 2.0, 3.0;
  Times stamps, seconds;
  const auto take = [&] {
    odometry.take([&](const nav_msgs::msg::Odometry& m) {
      stamps.push_back(nanoseconds(m.header.stamp) / ms);
      EXPECT_STREQ(m.child_frame_id, "base_link");
      EXPECT_NEAR(m.twist.twist.linear.x, -1.0, 1e-12);
      EXPECT_NEAR(m.twist.twist.linear.y, -2.0, 1e-12);
    });
    diagnostics.take([&](const diagnostic_msgs::msg::DiagnosticArray& m) {
      seconds.push_back(nanoseconds(m.header.stamp) / ms);
    });
  };
  // The subscribers know the telemetry, but it may not know them yet: what it sends then is lost.
  std::int64_t start = -1000;
  ASSERT_TRUE(test_support::wait_until([&] {
    snapshot.time = (start += 1000) * ms;
    telemetry.offer(snapshot);
    return take(), !stamps.empty() && !seconds.empty();
  }));
  ASSERT_TRUE(test_support::wait_until([&] {
    telemetry.offer(snapshot);
    return take(), stamps.back() == start && seconds.back() == start;
  }));
  stamps = seconds = {start};
  Times wanted = {start};
  for (std::int64_t time = start + 10; time <= start + 1200; time += 10) {
    snapshot.time = time * ms;
    telemetry.offer(snapshot);
    if ((time - start) % 50 != 0) continue;
    wanted.push_back(time);
    ASSERT_TRUE(test_support::wait_until([&] {
      telemetry.offer(snapshot);  // its thread may have had the lock
      return take(), stamps.size() >= wanted.size();
    }));
  }
  // Time stands still: nothing more is sent.
  for (int i = 0; i < 12; ++i) {
    telemetry.offer(snapshot);
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
  ASSERT_TRUE(test_support::wait_until([&] { return take(), seconds.size() >= 2; }));
  EXPECT_EQ(stamps, wanted);
  EXPECT_EQ(seconds, (Times{start, start + 1000}));
}

TEST(Heard, CountsRateAndAge) {
  Heard imu("imu");
  imu.on_tick(100.0);
  EXPECT_EQ(imu.text(), "imu: nothing");
  for (int i = 1; i <= 1500; ++i) {
    if (i % 5 == 0) imu.on_message(100.0 + 0.001 * i - 0.007);
    if (i % 10 == 0) imu.on_tick(100.0 + 0.001 * i);
  }
  EXPECT_NEAR(imu.rate(), 200.0, 1.0);
  EXPECT_NEAR(imu.age(), 0.007, 1e-9);
  EXPECT_EQ(imu.text(), "imu 200 Hz 7 ms");
  for (int i = 151; i <= 400; ++i) imu.on_tick(100.0 + 0.01 * i);
  EXPECT_EQ(imu.text(), "imu 0 Hz 2507 ms");
}

TEST(Snapshot, IsALineForTheOperator) {
  Snapshot s;
  s.mode = "offboard";
  s.activity = "air";
  s.estimate = "of PX4";
  s.heard[0] = Heard("odometry");
  s.heard[0].on_message(0.997);
  s.heard[0].on_tick(1.0);
  EXPECT_EQ(s.line(), "offboard, air, estimate of PX4; odometry 0 Hz 3 ms");
  s.counts.late = 2;
  s.counts.ticks = 300;
  s.waits_for = "arming";
  s.located = false;
  EXPECT_EQ(s.line(), "offboard; odometry 0 Hz 3 ms; late ticks 2 of 300; waits for arming");
  s.failure.kind = tilt_ropter::FailureKind::rotor;
  s.failure.rotor = 1;
  s.failure.effectiveness = 0.3;
  EXPECT_NE(s.line().find("; rotor 2 gives 30 % of its thrust; late"), std::string::npos)
      << s.line();
  FlightMessages messages(tilt_ropter::tilt_ropter_vehicle());
  const auto& values = messages.diagnostics(s).status._buffer[0].values;
  EXPECT_STREQ(values._buffer[9].key, "waits_for");
  EXPECT_STREQ(values._buffer[10].key, "odometry_hz");
  EXPECT_STREQ(values._buffer[11].key, "odometry_age_ms");
  EXPECT_STREQ(values._buffer[11].value, "3.0");
  EXPECT_STREQ(values._buffer[12].key, "actuators");
  EXPECT_STREQ(values._buffer[12].value, "rotor 2 gives 30 % of its thrust");
}

TEST(FlightMessages, HaveTheNamespaceInTheFrameOfTheVehicle) {
  FlightMessages messages(tilt_ropter::tilt_ropter_vehicle(), "a/");
  EXPECT_STREQ(messages.transform({}).transforms._buffer[0].child_frame_id, "a/base_link");
  EXPECT_STREQ(messages.odometry({}).header.frame_id, "map");
  EXPECT_STREQ(messages.diagnostics({}).status._buffer[0].name, "a/tilt_ropter: flight");
}

}  // namespace node_test
}  // namespace loops
