// Hardware in the loop: contents of messages.
// CTest: dds

#include "../../examples/hitl/message.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cstdint>
#include <limits>

namespace hitl_message_test {

using Eigen::Vector3d;
using Eigen::Vector4d;

const hitl::WrenchCommand sample_wrench{
    12.345, {{1.0, -2.0, 3.0}, {4.0, 5.0, -6.0}}, {{7.0, 8.0, 9.0}, {10.0, -11.0, 1e-300}}, true};
const hitl::ActuatorCommand<4> sample_actuators{
    3.001, {Vector4d(900.0, 901.5, 902.25, 903.0), Vector4d(-0.1, 0.2, -0.3, 0.4)}};
const hitl::Inertial sample_inertial{0.001, {Vector3d(0.1, 0.2, -0.3), Vector3d(4.0, -5.0, 9.81)}};
const hitl::RotorSpeeds<4> sample_speeds{1e4, Vector4d(1.0, 2.0, 3.0, 4.0)};
const hitl::Pose sample_pose{7.01, {Vector3d(1.0, 2.0, 3.0), {0.5, -0.5, 0.5, 0.5}}};

TEST(HitlMessage, DecodingRestoresTheEncodedContents) {
  hitl::Encoder encoder;
  const auto wrench = hitl::decode(encoder.encode(sample_wrench));
  ASSERT_TRUE(wrench.has_value());
  EXPECT_DOUBLE_EQ(wrench->time, sample_wrench.time);
  EXPECT_EQ(wrench->wrench.force, sample_wrench.wrench.force);
  EXPECT_EQ(wrench->wrench.torque, sample_wrench.wrench.torque);
  EXPECT_EQ(wrench->rate.force, sample_wrench.rate.force);
  EXPECT_EQ(wrench->rate.torque, sample_wrench.rate.torque);
  EXPECT_TRUE(wrench->on_ground);
  const auto actuators = hitl::decode<4>(encoder.encode(sample_actuators));
  ASSERT_TRUE(actuators.has_value());
  EXPECT_DOUBLE_EQ(actuators->time, sample_actuators.time);
  EXPECT_EQ(actuators->command.rotor_speed, sample_actuators.command.rotor_speed);
  EXPECT_EQ(actuators->command.tilt_angle, sample_actuators.command.tilt_angle);
  const auto inertial = hitl::decode(encoder.encode(sample_inertial));
  ASSERT_TRUE(inertial.has_value());
  EXPECT_DOUBLE_EQ(inertial->time, sample_inertial.time);
  EXPECT_EQ(inertial->sample.angular_velocity, sample_inertial.sample.angular_velocity);
  EXPECT_EQ(inertial->sample.specific_force, sample_inertial.sample.specific_force);
  const auto speeds = hitl::decode<4>(encoder.encode(sample_speeds));
  ASSERT_TRUE(speeds.has_value());
  EXPECT_DOUBLE_EQ(speeds->time, sample_speeds.time);
  EXPECT_EQ(speeds->speed, sample_speeds.speed);
  const auto pose = hitl::decode(encoder.encode(sample_pose));
  ASSERT_TRUE(pose.has_value());
  EXPECT_DOUBLE_EQ(pose->time, sample_pose.time);
  EXPECT_EQ(pose->pose.position, sample_pose.pose.position);
  EXPECT_EQ(pose->pose.orientation.coeffs(), sample_pose.pose.orientation.coeffs());
}

TEST(HitlMessage, NamesFramesAndRotorsForOtherListeners) {
  hitl::Encoder encoder;
  const auto& speeds = encoder.encode(sample_speeds);
  EXPECT_STREQ(speeds.header.frame_id, "base_link");
  ASSERT_EQ(speeds.name._length, 4U);
  EXPECT_STREQ(speeds.name._buffer[3], "rotor_4");
  EXPECT_STREQ(encoder.encode(sample_pose).header.frame_id, "map");
  EXPECT_EQ(encoder.encode(sample_inertial).orientation_covariance[0], -1.0);  // not measured
  EXPECT_EQ(encoder.shown(sample_wrench).wrench.torque.z, -6.0);
}

TEST(HitlMessage, RejectsNonFiniteNumbers) {
  hitl::Encoder encoder;
  for (const double bad :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    hitl::WrenchCommand wrench = sample_wrench;
    wrench.rate.torque.z() = bad;
    EXPECT_FALSE(hitl::decode(encoder.encode(wrench)).has_value());
    wrench = sample_wrench;
    wrench.wrench.force.x() = bad;
    EXPECT_FALSE(hitl::decode(encoder.encode(wrench)).has_value());
    hitl::ActuatorCommand<4> actuators = sample_actuators;
    actuators.command.rotor_speed(0) = bad;
    EXPECT_FALSE(hitl::decode<4>(encoder.encode(actuators)).has_value());
    actuators = sample_actuators;
    actuators.command.tilt_angle(3) = bad;
    EXPECT_FALSE(hitl::decode<4>(encoder.encode(actuators)).has_value());
    hitl::Inertial inertial = sample_inertial;
    inertial.sample.specific_force.y() = bad;
    EXPECT_FALSE(hitl::decode(encoder.encode(inertial)).has_value());
    inertial = sample_inertial;
    inertial.sample.angular_velocity.y() = bad;
    EXPECT_FALSE(hitl::decode(encoder.encode(inertial)).has_value());
    hitl::RotorSpeeds<4> speeds = sample_speeds;
    speeds.speed(2) = bad;
    EXPECT_FALSE(hitl::decode<4>(encoder.encode(speeds)).has_value());
    hitl::Pose pose = sample_pose;
    pose.pose.position.z() = bad;
    EXPECT_FALSE(hitl::decode(encoder.encode(pose)).has_value());
    pose = sample_pose;
    pose.pose.orientation.w() = bad;
    EXPECT_FALSE(hitl::decode(encoder.encode(pose)).has_value());
  }
}

TEST(HitlMessage, RejectsOtherNumbersOfRotors) {
  hitl::Encoder encoder;
  for (const std::uint32_t count : {0U, 3U, 5U}) {
    auto speeds = encoder.encode(sample_speeds);
    speeds.velocity._length = count;
    EXPECT_FALSE(hitl::decode<4>(speeds).has_value());
    auto actuators = encoder.encode(sample_actuators);
    actuators.velocity._length = count;
    EXPECT_FALSE(hitl::decode<4>(actuators).has_value());
    actuators = encoder.encode(sample_actuators);
    actuators.position._length = count;
    EXPECT_FALSE(hitl::decode<4>(actuators).has_value());
  }
  EXPECT_FALSE(hitl::decode<3>(encoder.encode(sample_speeds)).has_value());
  EXPECT_FALSE(hitl::decode<8>(encoder.encode(sample_actuators)).has_value());
}

TEST(HitlMessage, HoldsUpToEightRotors) {
  hitl::Encoder encoder;
  hitl::RotorSpeeds<8> eight;
  eight.speed << 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0;
  const auto& message = encoder.encode(eight);
  ASSERT_EQ(message.name._length, 8U);
  EXPECT_STREQ(message.name._buffer[7], "rotor_8");
  EXPECT_EQ(hitl::decode<8>(message)->speed, eight.speed);
  hitl::ActuatorCommand<2> two;
  two.command.tilt_angle << 0.1, -0.2;
  EXPECT_EQ(hitl::decode<2>(encoder.encode(two))->command.tilt_angle, two.command.tilt_angle);
}

}  // namespace hitl_message_test
