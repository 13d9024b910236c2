// The ROS 2 node in flight in simulated time: its messages go directly to a simulated vehicle.
// CTest: dds

#include "../../examples/integrations/ros2_node.hpp"
#include "support/program.hpp"
#include "support/ros2_vehicle.hpp"

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace loops {
namespace ros2_node_test {

using Eigen::Vector3d;
using test_support::run;

const std::pair<const std::string, std::string> simulated{"use_sim_time", "true"};

/// A vehicle and the node, on a clock that starts at a Unix time, like the clock of ROS.
struct Flight {
  explicit Flight(Parameters parameters)
      : node(tilt_ropter::tilt_ropter_vehicle(), {}, parameters) {}

  void fly(double seconds) {
    for (int i = 0; i < std::lround(1000.0 * seconds); ++i) {
      if (sensing) vehicle.sense(node);
      ASSERT_TRUE(vehicle.step());
      if (std::lround(1000.0 * vehicle.plant.time()) % 10 == 0)
        if (const auto* command = node.tick(vehicle.now())) vehicle.on_command(*command);
    }
  }

  test_support::Ros2Vehicle vehicle{1700000000LL * 1000000000LL};
  Ros2Node<4> node;
  bool sensing = true;
};

TEST(Ros2Node, HoversAtThePointOfItsParameters) {
  Flight flight({simulated,
                 {"hover_x", "0.5"},
                 {"hover_y", "-0.3"},
                 {"hover_z", "1.2"},
                 {"hover_yaw", "0.4"}});
  flight.fly(6.0);
  for (int i = 0; i < 20; ++i) {
    flight.fly(0.1);
    const auto& body = flight.vehicle.plant.body();
    EXPECT_LT((body.position - Vector3d(0.5, -0.3, 1.2)).norm(), 0.02);
    EXPECT_NEAR(tilt_ropter::yaw_of(body.orientation), 0.4, 0.02);
  }
  EXPECT_GE(flight.vehicle.commands, 790);  // from the first pose on, at 100 Hz
  EXPECT_NEAR(flight.vehicle.command_stamp, 1700000008.0, 1e-6);
}

constexpr const char* short_mission = R"({"name": "short", "start": {"position_m": [0, 0]},
  "segments": [{"type": "rest", "duration_s": 0.2}, {"type": "take_off", "height_m": 0.6},
    {"type": "figure_eight", "amplitude_m": [0.5, 0.2, 0.1], "laps": 1, "max_speed_mps": 1},
    {"type": "land"}]})";

// It stands elsewhere, or flies already. In the eight the IMU is silent for a moment.
TEST(Ros2Node, FliesAMissionFromWhereItIsAndGoesOnAfterSilence) {
  const test_support::Directory directory("ros2_node_mission");
  const std::string file = directory.write("mission.json", short_mission);
  for (const double height : {0.0, 1.0}) {
    SCOPED_TRACE(height);
    Flight flight({simulated, {"mission", file}});
    auto& plant = flight.vehicle.plant;
    tilt_ropter::PlantState<4> state = plant.state();
    state.body.position += Vector3d(0.8, -0.6, height);
    state.body.orientation = tilt_ropter::quaternion_from_yaw(1.0);
    if (height > 0.0) {
      const std::vector<double> hover(4, std::sqrt(1.03 * 1.5 * 9.81 / 4 / 1.4e-6)), level(4);
      actuator_msgs::msg::Actuators m{};
      refer_to(m.velocity, hover);
      refer_to(m.position, level);
      flight.vehicle.on_command(m);
      state.actuators.rotor_speed.setConstant(hover[0]);
    }
    plant.reset(state);
    double level = 1.0, step = 0.0;
    int silent = 0;
    std::string activity;
    Vector3d last = state.body.position;
    while (activity != "mission is over" && plant.time() < 40.0) {
      flight.fly(0.01);
      const Snapshot s = flight.node.snapshot(flight.vehicle.now());
      activity = s.activity;
      flight.sensing = activity != "air" || ++silent < 150 || silent > 165;
      ASSERT_FALSE(silent > 0 && activity == "take_off") << "it begins anew";
      level = std::min(level, (plant.body().orientation * Vector3d::UnitZ()).z());
      if (flight.node.started()) step = std::max(step, (s.reference.position - last).norm());
      last = flight.node.started() ? s.reference.position : plant.body().position;
    }
    EXPECT_GT(silent, 200);
    EXPECT_EQ(activity, "mission is over");
    EXPECT_LT((plant.body().position - Vector3d(0.0, 0.0, 0.11)).norm(), 0.03);
    EXPECT_GT(level, std::cos(0.15));
    EXPECT_LT(step, 0.05);
  }
}

TEST(Ros2Node, SendsNothingBeforeFirstPoseOrWithoutImu) {
  Flight flight({simulated});
  flight.sensing = false;
  flight.fly(0.5);
  EXPECT_EQ(flight.vehicle.commands, 0);
  flight.sensing = true;
  flight.fly(0.5);
  EXPECT_GE(flight.vehicle.commands, 45);
  flight.sensing = false;
  flight.fly(0.15);
  const int before = flight.vehicle.commands;
  flight.fly(0.2);
  EXPECT_EQ(flight.vehicle.commands, before);
  EXPECT_NEAR(before, 58, 3);  // commands continued for 0.1 s
  EXPECT_EQ(flight.node.snapshot(0).level, Level::error);
  flight.sensing = true;
  flight.fly(0.1);
  EXPECT_GE(flight.vehicle.commands, before + 8);
}

/// Passes the samples of the IMU on, turned or in another unit.
struct Liar {
  Ros2Node<4>& node;
  Eigen::Matrix3d rate, force;
  void on_imu(sensor_msgs::msg::Imu m) {
    auto& w = m.angular_velocity;
    auto& f = m.linear_acceleration;
    const Vector3d turned = rate * Vector3d(w.x, w.y, w.z), felt = force * Vector3d(f.x, f.y, f.z);
    w = {turned.x(), turned.y(), turned.z()};
    f = {felt.x(), felt.y(), felt.z()};
    node.on_imu(m);
  }
  void on_pose(const geometry_msgs::msg::PoseStamped& m) { node.on_pose(m); }
  void on_rotor_speeds(const sensor_msgs::msg::JointState& m) { node.on_rotor_speeds(m); }
};

TEST(Ros2Node, DoesNotTakeOffWithAWrongImu) {
  const Eigen::Matrix3d same = Eigen::Matrix3d::Identity(),
                        frd = Vector3d(1.0, -1.0, -1.0).asDiagonal();
  Eigen::Matrix3d exchanged;
  exchanged << 0, 0, 1, 1, 0, 0, 0, 1, 0;
  for (const auto& [rate, force] : {std::pair{same, Eigen::Matrix3d(same / 9.81)},
                                    {same, Eigen::Matrix3d(-same)},
                                    {frd, frd},
                                    {same, frd},
                                    {exchanged, exchanged},
                                    {same, Eigen::Matrix3d(0.0 * same)}}) {
    Flight flight({simulated, {"hover_z", "1.2"}});
    Liar liar{flight.node, rate, force};
    double highest = 0.0;
    for (int i = 0; i < 10000; ++i) {
      flight.vehicle.sense(liar);
      ASSERT_TRUE(flight.vehicle.step());
      if (i % 10 == 0)
        if (const auto* command = flight.node.tick(flight.vehicle.now()))
          flight.vehicle.on_command(*command);
      highest = std::max(highest, flight.vehicle.plant.body().position.z());
    }
    EXPECT_LT(highest, 0.12) << force;
    EXPECT_STREQ(flight.node.snapshot(0).mode, "refuses to fly");
    EXPECT_EQ(flight.node.snapshot(0).level, Level::error);
  }
}

/// Flies with the speeds of the rotors as `change` makes them.
template <typename Change>
double error_with_speeds(const Change& change) {
  Flight flight({simulated, {"hover_z", "0.6"}});
  struct Changed {
    Ros2Node<4>& node;
    const Change& change;
    void on_imu(const sensor_msgs::msg::Imu& m) { node.on_imu(m); }
    void on_pose(const geometry_msgs::msg::PoseStamped& m) { node.on_pose(m); }
    void on_rotor_speeds(const sensor_msgs::msg::JointState& m) {
      std::vector<std::string> names;
      std::vector<double> speeds(m.velocity._buffer, m.velocity._buffer + 4);
      change(names, speeds);
      std::vector<char*> pointers(names.size());
      for (std::size_t i = 0; i < names.size(); ++i) pointers[i] = names[i].data();
      sensor_msgs::msg::JointState other{};
      refer_to(other.name, pointers);
      refer_to(other.velocity, speeds);
      node.on_rotor_speeds(other);
    }
  } changed{flight.node, change};
  for (int i = 0; i < 8000; ++i) {
    flight.vehicle.sense(changed);
    EXPECT_TRUE(flight.vehicle.step());
    if (i % 10 == 0)
      if (const auto* command = flight.node.tick(flight.vehicle.now()))
        flight.vehicle.on_command(*command);
  }
  return (flight.vehicle.plant.body().position - Vector3d(0.0, 0.0, 0.6)).norm();
}

TEST(Ros2Node, RotorSpeedsAreMatchedByNameAndIgnoredIfTheyAreNone) {
  using Names = std::vector<std::string>;
  using Speeds = std::vector<double>;
  EXPECT_LT(error_with_speeds([](Names& names, Speeds& speeds) {
              names = {"rotor_3", "wheel", "rotor_1", "rotor_4", "rotor_2"};
              speeds = {speeds[2], 12.0, speeds[0], speeds[3], speeds[1]};
            }),
            0.02);
  for (const double factor : {60.0 / (2.0 * 3.14159), 7.0, 0.0, std::nan("")})
    EXPECT_LT(error_with_speeds([factor](Names&, Speeds& speeds) {
                for (double& speed : speeds) speed *= factor;
              }),
              0.05)
        << factor;
  EXPECT_LT(error_with_speeds([](Names&, Speeds& speeds) { speeds.resize(8, 3.0); }), 0.05);
  EXPECT_LT(error_with_speeds([](Names& names, Speeds&) { names = {"a", "b", "c", "d"}; }), 0.05);
}

/// Disturbs a flight with `spoilt` messages among the good ones, and expects finite commands
/// throughout and hover afterwards.
template <typename Spoil>
void expect_to_survive(const std::string& what, const Spoil& spoilt) {
  SCOPED_TRACE(what);
  Flight flight({simulated, {"hover_z", "0.6"}});
  flight.fly(3.0);
  for (int i = 0; i < 30; ++i) {
    spoilt(flight);
    flight.fly(0.01);
    ASSERT_TRUE(tilt_ropter::all_finite(flight.vehicle.command().rotor_speed));
    ASSERT_TRUE(tilt_ropter::all_finite(flight.vehicle.command().tilt_angle));
  }
  flight.fly(4.0);
  EXPECT_LT((flight.vehicle.plant.body().position - Vector3d(0.0, 0.0, 0.6)).norm(), 0.03);
}

TEST(Ros2Node, SurvivesMessagesThatAreNotNumbersOrAreHuge) {
  for (const double bad : {std::numeric_limits<double>::quiet_NaN(),
                           -std::numeric_limits<double>::infinity(), 1e300}) {
    const std::string value = std::to_string(bad);
    const auto header = [](const Flight& flight) {
      return std_msgs::msg::Header{stamp(flight.vehicle.now()), nullptr};
    };
    expect_to_survive("angular velocity " + value, [&](Flight& flight) {
      sensor_msgs::msg::Imu m{};
      m.header = header(flight);
      m.angular_velocity.y = bad;
      flight.node.on_imu(m);
    });
    expect_to_survive("acceleration " + value, [&](Flight& flight) {
      sensor_msgs::msg::Imu m{};
      m.header = header(flight);
      m.linear_acceleration = {bad, bad, bad};
      flight.node.on_imu(m);
    });
    expect_to_survive("position " + value, [&](Flight& flight) {
      flight.node.on_pose({header(flight), {{0.0, bad, 0.6}, {0.0, 0.0, 0.0, 1.0}}});
    });
    expect_to_survive("orientation " + value, [&](Flight& flight) {
      flight.node.on_pose({header(flight), {{0.0, 0.0, 0.6}, {0.0, 0.0, bad, 1.0}}});
    });
    expect_to_survive("rotor speed " + value, [&](Flight& flight) {
      const std::vector<double> speeds = {1000.0, bad, 1000.0, 1000.0};
      sensor_msgs::msg::JointState m{};
      refer_to(m.velocity, speeds);
      flight.node.on_rotor_speeds(m);
    });
  }
}

TEST(Ros2Node, SurvivesStampsOfOtherTimes) {
  for (const builtin_interfaces::msg::Time time :
       {builtin_interfaces::msg::Time{0, 0}, builtin_interfaces::msg::Time{-1, 4000000000U},
        builtin_interfaces::msg::Time{1700001000, 0},
        builtin_interfaces::msg::Time{2147483647, 0}}) {
    const std::string seconds = std::to_string(time.sec);
    expect_to_survive("IMU of " + seconds, [&](Flight& flight) {
      sensor_msgs::msg::Imu m{};
      m.header.stamp = time;
      m.linear_acceleration.z = 9.81;
      flight.node.on_imu(m);
    });
    expect_to_survive("pose of " + seconds, [&](Flight& flight) {
      flight.node.on_pose({{time, nullptr}, {{0.0, 0.0, 0.6}, {0.0, 0.0, 0.0, 1.0}}});
    });
  }
}

TEST(Ros2Node, ShowsItsFlight) {
  Flight flight({simulated, {"hover_z", "0.6"}});
  flight.fly(3.0);
  const Snapshot s = flight.node.snapshot(flight.vehicle.now());
  EXPECT_EQ(s.level, Level::ok);
  EXPECT_STREQ(s.mode, "mission");
  FlightMessages messages(flight.node.vehicle());
  const auto& tf = messages.transform(s);
  ASSERT_EQ(tf.transforms._length, 1U);
  EXPECT_STREQ(tf.transforms._buffer[0].child_frame_id, "base_link");
  EXPECT_NEAR(tf.transforms._buffer[0].transform.translation.z, 0.6, 0.02);

  // In hover the thrust arrows, in newton, carry the weight against the wind.
  const auto& array = messages.markers(s);
  Vector3d thrust = Vector3d::Zero();
  for (std::uint32_t i = 0; i < array.markers._length; ++i) {
    const auto& m = array.markers._buffer[i];
    if (std::string(m.ns) == "thrust") {
      ASSERT_EQ(m.points._length, 2U);
      const auto &a = m.points._buffer[0], &b = m.points._buffer[1];
      thrust += Vector3d(b.x - a.x, b.y - a.y, b.z - a.z) / 0.05;
    } else if (std::string(m.ns) == "contact") {
      EXPECT_EQ(m.action, 2);  // deleted in the air
    } else if (std::string(m.ns) == "reference") {
      EXPECT_EQ(m.pose.position.z, 0.6);
    }
  }
  EXPECT_LT((thrust - Vector3d(-0.3, -0.6, 1.03 * 1.5 * 9.81)).norm(), 0.3);

  Snapshot moved = s;
  (void)messages.path(s);
  for (int i = 0; i < 600; ++i) {
    moved.body.position.x() += 0.05;
    (void)messages.path(moved);
  }
  EXPECT_EQ(messages.path(moved).poses._length, 500U);
  EXPECT_EQ(messages.path(moved).poses._buffer[499].pose.position.x, moved.body.position.x());

  const auto& status = messages.diagnostics(s).status._buffer[0];
  EXPECT_EQ(status.level, 0);
  EXPECT_STREQ(status.message, "mission, estimate good");
  EXPECT_STREQ(status.values._buffer[0].value, "mission");
  EXPECT_STREQ(status.values._buffer[8].key, "activity");
  EXPECT_STREQ(status.values._buffer[8].value, "hover point");
}

TEST(Ros2Node, RejectsParametersOutOfRange) {
  const auto node = [](const Parameters& parameters) { Flight flight(parameters); };
  EXPECT_THROW(node({{"level", "thrust"}}), std::invalid_argument);
  EXPECT_THROW(node({{"position_noise", "-1.0"}}), std::invalid_argument);
  EXPECT_THROW(node({{"max_silence", "0.1s"}}), std::invalid_argument);
  EXPECT_THROW(node({{"max_silence", "0"}}), std::invalid_argument);
}

TEST(ControllerSettings, HaveNoTimeLimitOnASimulatedClock) {
  Parameters usual, on_simulated_clock{simulated};
  const tilt_ropter::NmpcSettings settings;
  EXPECT_EQ(as_the_node_says(settings, usual).time_limit, settings.time_limit);
  EXPECT_TRUE(std::isinf(as_the_node_says(settings, on_simulated_clock).time_limit));
}

TEST(Dds, TopicsOfRos2HaveAPrefix) {
  EXPECT_EQ(dds::topic_name("imu"), "rt/imu");
  EXPECT_EQ(dds::topic_name("/fmu/in/actuator_motors"), "rt/fmu/in/actuator_motors");
  EXPECT_STREQ(dds::descriptor<sensor_msgs::msg::Imu>().m_typename, "sensor_msgs::msg::dds_::Imu_");
  EXPECT_STREQ(dds::descriptor<px4_msgs::msg::VehicleStatusV1>().m_typename,
               "px4_msgs::msg::dds_::VehicleStatus_");
}

TEST(RunNode, PrintsHelpAndRejectsUnknownOptions) {
  for (const std::string program : {ROS2_NODE_PROGRAM, PX4_NODE_PROGRAM}) {
    const auto help = run(program, "--help");
    EXPECT_EQ(help.exit_code, 0);
    EXPECT_TRUE(help.says("hover_yaw")) << help.output;
    for (const char* bad :
         {"--nonsense", "nonsense", "--ros-args -p nonsense:=1", "--ros-args -r nonsense:=imu",
          "--ros-args --nonsense", "--ros-args -p hover_x:=far", "--ros-args -p vehicle:=nowhere",
          "--ros-args -p telemetry_rate:=-1", "--ros-args -p use_sim_time:=1"}) {
      const auto refused = run(program, bad);
      EXPECT_EQ(refused.exit_code, 2) << bad << '\n' << refused.output;
    }
  }
  const test_support::Directory directory("run_node");
  const std::string csv = directory.write("a.csv", "time_s,x_m,y_m,z_m\n0,0,0,1\n1,0,0,-1\n");
  std::string wrong = short_mission;
  wrong.replace(wrong.find("0.6"), 3, "-1 ");
  const std::string json = directory.write("a.json", wrong);
  for (const std::string program : {ROS2_NODE_PROGRAM, PX4_NODE_PROGRAM})
    for (const auto& [parameter, text] :
         {std::pair<std::string, std::string>{"mission:=nowhere.json", "cannot read nowhere.json"},
          {"mission:=" + json, "a.json: segments[1].height_m"},
          {"trajectory:=" + csv, "a.csv:3: column z_m"},
          {"mission:=air -p trajectory:=" + csv, "only one of the two"}}) {
      const auto refused = run(program, "--ros-args -p " + parameter);
      EXPECT_EQ(refused.exit_code, 2) << parameter;
      EXPECT_TRUE(refused.says(text)) << refused.output;
    }
  EXPECT_EQ(run("env", "ROS_DOMAIN_ID=231 '" ROS2_NODE_PROGRAM "'").exit_code, 1);
  EXPECT_EQ(run(PX4_NODE_PROGRAM, "--px4-message-version VehicleStatus=5").exit_code, 2);
}

}  // namespace ros2_node_test
}  // namespace loops
