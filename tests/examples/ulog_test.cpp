// The reader of PX4's logs, and the programs that read them, with logs of an independent writer.

#include "support/flights.hpp"
#include "support/program.hpp"
#include "support/ulog_writer.hpp"

#include "../../examples/support/csv.hpp"
#include "../../examples/support/ulog.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <fstream>
#include <random>
#include <string>
#include <vector>

namespace ulog_test {

using examples::CsvTable;
using examples::Ulog;
using test_support::Outcome;
using test_support::Packed;
using test_support::run;
using test_support::UlogWriter;

class UlogFile : public testing::Test {
 protected:
  std::string write(const std::string& bytes, const std::string& name = "log.ulg") const {
    std::ofstream(directory.file(name), std::ios::binary) << bytes;
    return directory.file(name);
  }
  /// The error of a reader of these bytes.
  [[nodiscard]] std::string refusal(const std::string& bytes) const {
    const std::string path = write(bytes);
    try {
      const Ulog log(path);
    } catch (const tilt_ropter::InputFileError& error) {
      return std::string(error.what()).substr(path.size() - std::string("log.ulg").size());
    }
    return "none";
  }

  test_support::Directory directory{"ulog"};
};

constexpr const char* all_types =
    "all:uint64_t timestamp;int8_t a;uint8_t b;int16_t c;uint16_t d;int32_t e;uint32_t f;"
    "int64_t g;uint64_t h;float i;double j;bool k;char l;inner[2] m;uint8_t[3] _padding0;";

Packed all_values(std::uint64_t time) {
  return Packed()
      .add(time)
      .add(std::int8_t{-1})
      .add(std::uint8_t{200})
      .add(std::int16_t{-300})
      .add(std::uint16_t{60000})
      .add(std::int32_t{-70000})
      .add(std::uint32_t{4000000000U})
      .add(std::int64_t{-5000000000})
      .add(std::uint64_t{6000000000})
      .add(1.5F)
      .add(-2.25)
      .add(std::uint8_t{1})
      .add('x')
      .add(10.0F)
      .add(std::int8_t{-11})
      .add(20.0F)
      .add(std::int8_t{-21});
}

/// Every kind of message, two instances of a topic, and data that was appended.
UlogWriter sample_log() {
  UlogWriter log;
  log.message('I', Packed().add(std::uint8_t{13}).add("char[3] sys_px4").bytes());
  log.message('M', std::string(1, '\0') + Packed().add(std::uint8_t{9}).add("char[2] x").bytes());
  log.format("inner:float x;int8_t y;");
  log.format(all_types);
  log.message('P', Packed().add(std::uint8_t{13}).add("float THR_MDL").add(0.3F).bytes());
  log.message('Q', std::string(1, '\1') + Packed().add(std::uint8_t{7}).add("float A").bytes());
  const std::uint16_t first = log.subscribe("all"), second = log.subscribe("all", 1);
  log.data(first, all_values(100));
  log.message('S', "\x2F\x73\x13\x20\x25\x0C\xBB\x12");
  log.message('O', Packed().add(std::uint16_t{20}).bytes());
  log.message('L', "6........hello");
  log.message('C', "6..........hello");
  log.message('z', "a type of the future");
  log.data(second, all_values(150));
  log.data(first, all_values(200));
  log.message('R', Packed().add(second).bytes());
  log.cut_off_and_append();
  log.data(first, all_values(300));
  return log;
}

TEST_F(UlogFile, ReadsEveryTypeNestedFormatsInstancesAndAppendedData) {
  const Ulog log(write(sample_log().bytes()));
  ASSERT_EQ(log.notes().size(), 1u);  // where the first part ends
  EXPECT_NE(log.notes()[0].find("cut off, 2 of its 48 bytes are there"), std::string::npos);
  EXPECT_TRUE(log.has("all") && log.has("all:1") && !log.has("all:2") && !log.has("inner"));
  EXPECT_TRUE(log.has("all", "m[1].y") && !log.has("all", "m[2].y"));
  const CsvTable table = log.table("all", {"timestamp", "a", "b", "c", "d", "e", "f", "g", "h", "i",
                                           "j", "k", "l", "m[0].x", "m[0].y", "m[1].x", "m[1].y"});
  const std::vector<double> expected = {100, -1,    200, -300, 60000, -70000, 4e9, -5e9, 6e9,
                                        1.5, -2.25, 1,   'x',  10,    -11,    20,  -21};
  ASSERT_EQ(table.rows(), 3u);
  for (std::size_t i = 0; i < expected.size(); ++i)
    EXPECT_EQ(table.columns[i][0], expected[i]) << table.names[i];
  EXPECT_EQ(table.columns[0][1], 200.0);
  EXPECT_EQ(table.columns[0][2], 300.0);  // appended
  EXPECT_EQ(log.table("all:1", {"timestamp"}).columns[0], std::vector<double>{150.0});
  EXPECT_THROW((void)log.table("none", {"a"}), tilt_ropter::InputFileError);
  EXPECT_THROW((void)log.table("all", {"n"}), tilt_ropter::InputFileError);
  EXPECT_TRUE(examples::is_ulog(write(sample_log().bytes(), "log.bin")));
  EXPECT_FALSE(examples::is_ulog(write("time_s,a\n", "log.csv")));
}

TEST_F(UlogFile, ErrorsNameByteAndWhatIsExpected) {
  const std::string good = sample_log().bytes();
  EXPECT_EQ(refusal("time_s,a\n"),
            "log.ulg: byte 0: not the start of a ULog file, expected is 'ULog' 01 12 35");
  EXPECT_EQ(refusal(good.substr(0, 12)), "log.ulg: byte 12: the file ends within its header");
  const std::size_t start = UlogWriter().bytes().size();  // 59
  const auto after = [](const std::string& type_and_content) {
    UlogWriter log;
    log.format("t:uint64_t timestamp;float x;");
    log.message(type_and_content[0], type_and_content.substr(1));
    return log.bytes();
  };
  const std::string at = "log.ulg: byte " + std::to_string(start + 3 + 29);
  EXPECT_EQ(refusal(after("D\7")), at + ": data of 1 bytes, expected are at least 2");
  EXPECT_EQ(refusal(after(std::string("D\7\0", 3))),
            at + ": data of message 7, to which nothing subscribed before");
  EXPECT_EQ(refusal(after("A\1")), at + ": a subscription of 1 bytes, expected are at least 4");
  const std::string inside = "log.ulg: byte " + std::to_string(start + 3 + 29 + 3);
  EXPECT_EQ(refusal(after(std::string("A\0\0\0u", 5))),
            inside + ": 'u' has no format before this, or is within itself");
  EXPECT_EQ(refusal(after("Fx")), inside + ": the format 'x', expected is NAME:TYPE FIELD;...");
  EXPECT_EQ(refusal(after("Fx:float;")), "log.ulg: byte " + std::to_string(start + 37) +
                                             ": the field 'float', expected is TYPE FIELD");
  EXPECT_EQ(refusal(after("\1x")), "log.ulg: byte " + std::to_string(start + 3 + 29 + 2) +
                                       ": a message of type 1, expected is a letter");
  UlogWriter within_itself;
  within_itself.format("t:uint64_t timestamp;t x;");
  (void)within_itself.subscribe("t");
  EXPECT_NE(refusal(within_itself.bytes()).find("is within itself"), std::string::npos);
  UlogWriter empty;  // as many times as its messages are said to be there
  empty.format("e:");
  for (const char* text : {"f:e[9999] a;", "g:f[9999] a;", "t:uint64_t timestamp;g[9999] a;"})
    empty.format(text);
  (void)empty.subscribe("t");
  EXPECT_NE(refusal(empty.bytes()).find("the format of 'e' has no fields"), std::string::npos);
  UlogWriter short_data;
  short_data.format("t:uint64_t timestamp;float x;");
  short_data.data(short_data.subscribe("t"), Packed().add(std::uint64_t{1}));
  EXPECT_NE(refusal(short_data.bytes()).find("8 bytes of t, its format has 12"), std::string::npos);
  std::string flags = good;
  flags[16 + 3 + 9] = 4;
  EXPECT_EQ(refusal(flags),
            "log.ulg: byte 28: an incompatible flag that is not known, expected is data appended "
            "(1)");
  flags = good;
  flags[16 + 3 + 16 + 4] = 1;
  EXPECT_NE(refusal(flags).find("log.ulg: byte 35: data appended at byte"), std::string::npos);
}

TEST_F(UlogFile, ReadsALogThatEndsAnywhere) {
  const std::string good = sample_log().bytes();
  const std::size_t last = good.size() - 20;  // within the appended message
  const Ulog cut(write(good.substr(0, last)));
  EXPECT_EQ(cut.table("all", {"timestamp"}).rows(), 2u);
  ASSERT_EQ(cut.notes().size(), 2u);
  EXPECT_NE(cut.notes()[1].find("the last message is cut off"), std::string::npos);
  for (std::size_t size = 0; size < good.size(); ++size) {
    const std::string error = refusal(good.substr(0, size));
    EXPECT_TRUE(error == "none" || error.find("log.ulg: byte ") == 0) << size << ": " << error;
  }
}

// What is garbled is read as something else or refused; it never ends the program.
TEST_F(UlogFile, SurvivesGarbledLogs) {
  const std::string good = sample_log().bytes();
  std::mt19937 random(1);
  int refused = 0;
  for (int run = 0; run < 2000; ++run) {
    std::string bad = good;
    for (unsigned flips = 1 + random() % 8; flips > 0; --flips)
      bad[8 + random() % (bad.size() - 8)] = static_cast<char>(random());
    const std::string error = refusal(bad);
    if (error != "none") ++refused;
    EXPECT_TRUE(error == "none" || error.find("log.ulg: byte ") == 0) << error;
  }
  EXPECT_GT(refused, 500);
  EXPECT_LT(refused, 2000);
}

/// 20 s of a flight; poses with a marker frame that is the body frame. With `simulated`, also PX4's
/// ground truth, whose timestamp_sample is not set.
UlogWriter flown(const std::string& pose_topic, bool simulated = false) {
  const test_support::Flight flight(3, Eigen::Quaterniond::Identity(), Eigen::Vector3d::Zero(),
                                    Eigen::Quaterniond::Identity());
  const double period = 0.005;
  test_support::NoisyImu imu(flight, {2e-4, 2e-3, 2e-5, 3e-4}, period, 4,
                             Eigen::Vector3d(0.01, -0.02, 0.02), Eigen::Vector3d(0.1, -0.1, 0.2));
  UlogWriter log;
  for (const char* format : test_support::px4_formats) log.format(format);
  const std::string odometry = test_support::px4_formats[1];
  log.format(pose_topic + odometry.substr(odometry.find(':')));
  const std::uint16_t sensors = log.subscribe("sensor_combined"), poses = log.subscribe(pose_topic),
                      truth = log.subscribe("vehicle_odometry");
  std::uint16_t position = 0, attitude = 0;
  if (simulated) {
    log.format(
        "vehicle_local_position_groundtruth:uint64_t timestamp;uint64_t timestamp_sample;float x;"
        "float y;float z;float vx;float vy;float vz;");
    log.format("vehicle_attitude_groundtruth:uint64_t timestamp;float[4] q;");
    position = log.subscribe("vehicle_local_position_groundtruth");
    attitude = log.subscribe("vehicle_attitude_groundtruth");
  }
  for (int i = 0; i < 4000; ++i) {
    const double t = period * i;
    const auto sample = imu(t);
    const auto x = flight.state(t);
    log.data(sensors, test_support::sensor_combined(10.0 + t, sample.angular_velocity,
                                                    sample.specific_force));
    const Packed m =
        test_support::vehicle_odometry(10.0 + t, x.position, x.orientation, x.velocity);
    if (i % 2 == 0) log.data(poses, m);
    log.data(truth, m);
    if (!simulated || i % 2 != 0) continue;
    const std::string& parts = m.bytes();  // stamps, position, q, velocity
    const std::uint64_t now = test_support::microseconds(10.0 + t);
    log.data(attitude, Packed().add(now).add(parts.substr(28, 16)));
    if (i % 20 == 0)
      log.data(position, Packed()
                             .add(now)
                             .add(std::uint64_t{0})
                             .add(parts.substr(16, 12))
                             .add(parts.substr(44, 12)));
  }
  return log;
}

TEST_F(UlogFile, ReplayFlightReadsIt) {
  const std::string bytes = flown("vehicle_visual_odometry").bytes();
  const std::string log = "'" + write(bytes) + "' --no-pictures --position-noise 0.001 " +
                          "--orientation-noise 0.003 --output '" + directory.file("out") + "' ";
  const Outcome found = run(REPLAY_FLIGHT_PROGRAM, log + "--truth-topic vehicle_odometry");
  ASSERT_EQ(found.exit_code, 0) << found.output;
  EXPECT_TRUE(found.says("poses are those of vehicle_visual_odometry")) << found.output;
  EXPECT_EQ(found["samples"], 4000);
  EXPECT_EQ(found["poses"], 2000);
  EXPECT_EQ(found["restarts"], 0);
  EXPECT_LT(found["position_rmse_m"], 0.002);
  EXPECT_LT(found["attitude_rmse_deg"], 0.2);
  EXPECT_LT(found["velocity_rmse_mps"], 0.01);
  const Outcome own = run(REPLAY_FLIGHT_PROGRAM, log + "--pose-topic vehicle_odometry");
  EXPECT_EQ(own["poses"], 4000) << own.output;
  EXPECT_TRUE(own.says("PX4's own estimate"));
  const Outcome none = run(REPLAY_FLIGHT_PROGRAM, log + "--pose-topic vehicle_nothing");
  EXPECT_EQ(none.exit_code, 2);
  EXPECT_TRUE(none.says("log.ulg: no data of vehicle_nothing, the log has sensor_combined"))
      << none.output;
  (void)write(flown("vehicle_mocap_odometry", true).bytes());
  const Outcome simulated = run(REPLAY_FLIGHT_PROGRAM, log);
  EXPECT_TRUE(simulated.says("the truth is vehicle_local_position_groundtruth"));
  EXPECT_TRUE(simulated.says("poses are those of vehicle_mocap_odometry")) << simulated.output;
  EXPECT_LT(simulated["position_rmse_m"], 0.01);  // interpolated between samples at 10 Hz
  EXPECT_LT(simulated["attitude_rmse_deg"], 1.0);
  const Outcome pair =
      run(REPLAY_FLIGHT_PROGRAM, log + "--pose-topic vehicle_local_position_groundtruth");
  EXPECT_EQ(pair["poses"], 199) << pair.output;
  (void)write(bytes.substr(0, bytes.size() / 2));
  const Outcome cut = run(REPLAY_FLIGHT_PROGRAM, log);
  EXPECT_EQ(cut.exit_code, 0) << cut.output;
  EXPECT_TRUE(cut.says("the last message is cut off")) << cut.output;
  (void)write("ULog");
  EXPECT_EQ(run(REPLAY_FLIGHT_PROGRAM, log).exit_code, 2);
  EXPECT_GT(run(REPLAY_FLIGHT_PROGRAM, "a.csv").exit_code, 100);
  EXPECT_GT(run(REPLAY_FLIGHT_PROGRAM, "a.csv b.csv --truth-topic x").exit_code, 100);
  EXPECT_GT(run(REPLAY_FLIGHT_PROGRAM, "a.ulg b.csv --pose-topic x").exit_code, 100);
}

// The same figures as from the CSV file; the angle is float there.
TEST_F(UlogFile, IdentifyServoReadsIt) {
  const std::string csv = directory.file("servo.csv");
  ASSERT_EQ(run(IDENTIFY_SERVO_PROGRAM, "--generate '" + csv + "'").exit_code, 0);
  const CsvTable table = examples::read_csv(csv);
  UlogWriter log;
  log.format("debug_array:uint64_t timestamp;uint16_t id;char[10] name;float[4] data;");
  log.format(test_support::px4_formats[3]);
  const std::uint16_t angles = log.subscribe("debug_array", 2),
                      commands = log.subscribe("actuator_servos");
  for (std::size_t i = 0; i < table.rows(); ++i) {
    const std::uint64_t time = test_support::microseconds(table["time_s"][i]) + 1000000;
    const auto u = static_cast<float>(table["command_rad"][i]);
    const auto y = static_cast<float>(table["angle_rad"][i]);
    Packed command;
    command.add(time).add(time).add(0.0F).add(u);
    for (int more = 0; more < 6; ++more) command.add(0.0F);
    log.data(commands, command);
    Packed angle;
    angle.add(time).add(std::uint16_t{1}).add("encoders..").add(0.0F).add(0.0F).add(u).add(y);
    log.data(angles, angle);
  }
  const std::string common = " --no-pictures --output '" + directory.file("out") + "' ";
  const std::string ulg = "'" + write(log.bytes()) + "'" + common;
  const Outcome from_csv = run(IDENTIFY_SERVO_PROGRAM, "'" + csv + "'" + common);
  for (const char* options :
       {"--topic debug_array:2 --command 'data[2]' --angle 'data[3]'",
        "--topic debug_array:2 --angle 'data[3]' --command-topic actuator_servos --command "
        "'control[1]' --time timestamp"}) {
    const Outcome found = run(IDENTIFY_SERVO_PROGRAM, ulg + options);
    ASSERT_EQ(found.exit_code, 0) << found.output;
    EXPECT_EQ(found["samples"], from_csv["samples"]);
    for (const char* key : {"time_constant_s", "dead_time_s", "gain", "offset_rad"})
      EXPECT_NEAR(found[key], from_csv[key], 2e-5) << key;
  }
  const Outcome unknown = run(IDENTIFY_SERVO_PROGRAM, ulg + "--topic debug_array:2");
  EXPECT_EQ(unknown.exit_code, 2);
  EXPECT_TRUE(unknown.says("debug_array:2 has no field angle_rad, it has timestamp, id, name[0]"))
      << unknown.output;
  EXPECT_TRUE(run(IDENTIFY_SERVO_PROGRAM, ulg).says("a ULog needs --topic"));
  EXPECT_EQ(run(IDENTIFY_SERVO_PROGRAM, "'" + csv + "' --topic x" + common).exit_code, 2);
}

}  // namespace ulog_test
