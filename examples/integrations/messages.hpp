#pragma once

#include "dds.hpp"

#include <actuator_msgs.h>
#include <diagnostic_msgs.h>
#include <geometry_msgs.h>
#include <nav_msgs.h>
#include <px4_msgs.h>
#include <rosgraph_msgs.h>
#include <sensor_msgs.h>
#include <std_msgs.h>
#include <tf2_msgs.h>
#include <tilt_ropter_msgs.h>
#include <trajectory_msgs.h>
#include <visualization_msgs.h>

#include <cstdint>
#include <string>
#include <type_traits>
#include <vector>

// The messages that idlc made of idl/, under their names in ROS 2.
namespace builtin_interfaces::msg {
using Time = builtin_interfaces_msg_dds__Time_;
}
namespace std_msgs::msg {
using Bool = std_msgs_msg_dds__Bool_;
using Header = std_msgs_msg_dds__Header_;
using ColorRGBA = std_msgs_msg_dds__ColorRGBA_;
}  // namespace std_msgs::msg
namespace rosgraph_msgs::msg {
using Clock = rosgraph_msgs_msg_dds__Clock_;
}
namespace geometry_msgs::msg {
using Point = geometry_msgs_msg_dds__Point_;
using Pose = geometry_msgs_msg_dds__Pose_;
using PoseStamped = geometry_msgs_msg_dds__PoseStamped_;
using Transform = geometry_msgs_msg_dds__Transform_;
using TransformStamped = geometry_msgs_msg_dds__TransformStamped_;
using Twist = geometry_msgs_msg_dds__Twist_;
using Vector3 = geometry_msgs_msg_dds__Vector3_;
using Wrench = geometry_msgs_msg_dds__Wrench_;
using WrenchStamped = geometry_msgs_msg_dds__WrenchStamped_;
}  // namespace geometry_msgs::msg
namespace sensor_msgs::msg {
using Imu = sensor_msgs_msg_dds__Imu_;
using JointState = sensor_msgs_msg_dds__JointState_;
}  // namespace sensor_msgs::msg
namespace actuator_msgs::msg {
using Actuators = actuator_msgs_msg_dds__Actuators_;
}
namespace tilt_ropter_msgs::msg {
using WrenchCommand = tilt_ropter_msgs_msg_dds__WrenchCommand_;
}
namespace nav_msgs::msg {
using Odometry = nav_msgs_msg_dds__Odometry_;
using Path = nav_msgs_msg_dds__Path_;
}  // namespace nav_msgs::msg
namespace tf2_msgs::msg {
using TFMessage = tf2_msgs_msg_dds__TFMessage_;
}
namespace trajectory_msgs::msg {
using MultiDOFJointTrajectory = trajectory_msgs_msg_dds__MultiDOFJointTrajectory_;
using MultiDOFJointTrajectoryPoint = trajectory_msgs_msg_dds__MultiDOFJointTrajectoryPoint_;
}  // namespace trajectory_msgs::msg
namespace visualization_msgs::msg {
using Marker = visualization_msgs_msg_dds__Marker_;
using MarkerArray = visualization_msgs_msg_dds__MarkerArray_;
}  // namespace visualization_msgs::msg
namespace diagnostic_msgs::msg {
using DiagnosticArray = diagnostic_msgs_msg_dds__DiagnosticArray_;
using DiagnosticStatus = diagnostic_msgs_msg_dds__DiagnosticStatus_;
using KeyValue = diagnostic_msgs_msg_dds__KeyValue_;
}  // namespace diagnostic_msgs::msg
namespace px4_msgs::msg {
using ActuatorMotors = px4_msgs_msg_dds__ActuatorMotors_;
using ActuatorServos = px4_msgs_msg_dds__ActuatorServos_;
using ActuatorServosV0 = px4_msgs_msg_older_ActuatorServosV0_;
using OffboardControlMode = px4_msgs_msg_dds__OffboardControlMode_;
using SensorCombined = px4_msgs_msg_dds__SensorCombined_;
using TrajectorySetpoint = px4_msgs_msg_dds__TrajectorySetpoint_;
using VehicleControlMode = px4_msgs_msg_dds__VehicleControlMode_;
using VehicleOdometry = px4_msgs_msg_dds__VehicleOdometry_;
using VehicleStatus = px4_msgs_msg_dds__VehicleStatus_;
using VehicleStatusV0 = px4_msgs_msg_older_VehicleStatusV0_;
using VehicleStatusV1 = px4_msgs_msg_older_VehicleStatusV1_;
using VehicleStatusV2 = px4_msgs_msg_older_VehicleStatusV2_;
using VehicleStatusV3 = px4_msgs_msg_older_VehicleStatusV3_;
using VehicleThrustSetpoint = px4_msgs_msg_dds__VehicleThrustSetpoint_;
}  // namespace px4_msgs::msg

namespace dds {

namespace detail {
/// An older version of a message has the type name of the current one on the wire.
inline dds_topic_descriptor_t renamed(dds_topic_descriptor_t older,
                                      const dds_topic_descriptor_t& current) {
  older.m_typename = current.m_typename;
  return older;
}
}  // namespace detail

#define TILT_ROPTER_TOPIC(TYPE)                                \
  template <>                                                  \
  inline const dds_topic_descriptor_t& descriptor<TYPE##_>() { \
    return TYPE##__desc;                                       \
  }
#define TILT_ROPTER_OLDER_TOPIC(OLDER, CURRENT)                                              \
  template <>                                                                                \
  inline const dds_topic_descriptor_t& descriptor<OLDER##_>() {                              \
    static const dds_topic_descriptor_t d = detail::renamed(OLDER##__desc, CURRENT##__desc); \
    return d;                                                                                \
  }
TILT_ROPTER_TOPIC(rosgraph_msgs_msg_dds__Clock)
TILT_ROPTER_TOPIC(std_msgs_msg_dds__Bool)
TILT_ROPTER_TOPIC(geometry_msgs_msg_dds__PoseStamped)
TILT_ROPTER_TOPIC(geometry_msgs_msg_dds__WrenchStamped)
TILT_ROPTER_TOPIC(sensor_msgs_msg_dds__Imu)
TILT_ROPTER_TOPIC(sensor_msgs_msg_dds__JointState)
TILT_ROPTER_TOPIC(actuator_msgs_msg_dds__Actuators)
TILT_ROPTER_TOPIC(tilt_ropter_msgs_msg_dds__WrenchCommand)
TILT_ROPTER_TOPIC(nav_msgs_msg_dds__Odometry)
TILT_ROPTER_TOPIC(nav_msgs_msg_dds__Path)
TILT_ROPTER_TOPIC(tf2_msgs_msg_dds__TFMessage)
TILT_ROPTER_TOPIC(trajectory_msgs_msg_dds__MultiDOFJointTrajectory)
TILT_ROPTER_TOPIC(visualization_msgs_msg_dds__MarkerArray)
TILT_ROPTER_TOPIC(diagnostic_msgs_msg_dds__DiagnosticArray)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__ActuatorMotors)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__ActuatorServos)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__OffboardControlMode)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__SensorCombined)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__TrajectorySetpoint)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__VehicleControlMode)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__VehicleOdometry)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__VehicleStatus)
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__VehicleThrustSetpoint)
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_ActuatorServosV0, px4_msgs_msg_dds__ActuatorServos)
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_VehicleStatusV0, px4_msgs_msg_dds__VehicleStatus)
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_VehicleStatusV1, px4_msgs_msg_dds__VehicleStatus)
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_VehicleStatusV2, px4_msgs_msg_dds__VehicleStatus)
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_VehicleStatusV3, px4_msgs_msg_dds__VehicleStatus)
#undef TILT_ROPTER_TOPIC
#undef TILT_ROPTER_OLDER_TOPIC

}  // namespace dds

namespace loops {

/// A string of a message to send. `text` must live until the message is sent.
[[nodiscard]] inline char* in_message(const std::string& text) {
  return const_cast<char*>(text.c_str());  // the writer only reads
}

/// Makes `sequence` of a message to send refer to `elements`, which must live and stay unchanged
/// until the message is sent.
template <typename Sequence, typename Element>
void refer_to(Sequence& sequence, const std::vector<Element>& elements) {
  static_assert(std::is_same_v<decltype(sequence._buffer), Element*>);
  sequence._buffer = const_cast<Element*>(elements.data());  // the writer only reads
  sequence._maximum = sequence._length = static_cast<std::uint32_t>(elements.size());
  sequence._release = false;
}

/// The time of a stamp [s].
[[nodiscard]] inline double seconds(const builtin_interfaces::msg::Time& stamp) {
  return stamp.sec + 1e-9 * stamp.nanosec;
}

/// The time of a stamp [ns].
[[nodiscard]] inline std::int64_t nanoseconds(const builtin_interfaces::msg::Time& stamp) {
  return std::int64_t{stamp.sec} * 1000000000 + stamp.nanosec;
}

/// The stamp of a time [ns].
[[nodiscard]] inline builtin_interfaces::msg::Time stamp(std::int64_t nanoseconds) {
  return {static_cast<std::int32_t>(nanoseconds / 1000000000),
          static_cast<std::uint32_t>(nanoseconds % 1000000000)};
}

}  // namespace loops
