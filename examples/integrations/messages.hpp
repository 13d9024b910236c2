#pragma once

#include "dds.hpp"

#include <actuator_msgs.h>
#include <diagnostic_msgs.h>
#include <geometry_msgs.h>
#include <nav_msgs.h>
#include <px4_msgs.h>
#include <rmw_dds_common.h>
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
namespace rmw_dds_common::msg {
using ParticipantEntitiesInfo = rmw_dds_common_msg_dds__ParticipantEntitiesInfo_;
using ParticipantEntitiesInfoHumble = rmw_dds_common_msg_older_ParticipantEntitiesInfo_;
}  // namespace rmw_dds_common::msg
namespace px4_msgs::msg {
using ActuatorMotors = px4_msgs_msg_dds__ActuatorMotors_;
using ActuatorServos = px4_msgs_msg_dds__ActuatorServos_;
using ActuatorServosV0 = px4_msgs_msg_older_ActuatorServosV0_;
using BatteryStatus = px4_msgs_msg_dds__BatteryStatus_;
using BatteryStatusV0 = px4_msgs_msg_older_BatteryStatusV0_;
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

// HASH is that of ROS 2 (REP 2016), as tests/static/type_hashes.py computes it from idl/.
#define TILT_ROPTER_TOPIC(TYPE, HASH)                          \
  template <>                                                  \
  inline const dds_topic_descriptor_t& descriptor<TYPE##_>() { \
    return TYPE##__desc;                                       \
  }                                                            \
  template <>                                                  \
  inline const char* type_hash<TYPE##_>() {                    \
    return HASH;                                               \
  }
#define TILT_ROPTER_OLDER_TOPIC(OLDER, CURRENT, HASH)                                        \
  template <>                                                                                \
  inline const dds_topic_descriptor_t& descriptor<OLDER##_>() {                              \
    static const dds_topic_descriptor_t d = detail::renamed(OLDER##__desc, CURRENT##__desc); \
    return d;                                                                                \
  }                                                                                          \
  template <>                                                                                \
  inline const char* type_hash<OLDER##_>() {                                                 \
    return HASH;                                                                             \
  }
TILT_ROPTER_TOPIC(rosgraph_msgs_msg_dds__Clock,
                  "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564")
TILT_ROPTER_TOPIC(std_msgs_msg_dds__Bool,
                  "feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9")
TILT_ROPTER_TOPIC(geometry_msgs_msg_dds__PoseStamped,
                  "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8")
TILT_ROPTER_TOPIC(geometry_msgs_msg_dds__WrenchStamped,
                  "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77")
TILT_ROPTER_TOPIC(sensor_msgs_msg_dds__Imu,
                  "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b")
TILT_ROPTER_TOPIC(sensor_msgs_msg_dds__JointState,
                  "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e")
TILT_ROPTER_TOPIC(actuator_msgs_msg_dds__Actuators,
                  "4fb6a0060720d2168b5abe9171c993bab6c6e9583391ffa1334a21f818c4bc31")
TILT_ROPTER_TOPIC(tilt_ropter_msgs_msg_dds__WrenchCommand,
                  "42d6a1d7994836e0384efabfc460b71fd7299e942e0695e49d1e5716f8d63073")
TILT_ROPTER_TOPIC(nav_msgs_msg_dds__Odometry,
                  "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0")
TILT_ROPTER_TOPIC(nav_msgs_msg_dds__Path,
                  "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b")
TILT_ROPTER_TOPIC(tf2_msgs_msg_dds__TFMessage,
                  "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087")
TILT_ROPTER_TOPIC(trajectory_msgs_msg_dds__MultiDOFJointTrajectory,
                  "3a18fd095292a65cfde8833c72985a30af981f3ec44494655c6267262b443a4a")
TILT_ROPTER_TOPIC(visualization_msgs_msg_dds__MarkerArray,
                  "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf")
TILT_ROPTER_TOPIC(diagnostic_msgs_msg_dds__DiagnosticArray,
                  "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e")
TILT_ROPTER_TOPIC(rmw_dds_common_msg_dds__ParticipantEntitiesInfo,
                  "48f130c42f68f6d35fb1f48b6635c7e3b25055b5e135616887ec32ea30caf418")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__ActuatorMotors,
                  "78573ab1d26b08f3f494a16476cc896af5f8dceb64f6f723b4a2533ff2fbd321")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__ActuatorServos,
                  "431f2a0cd9896b6ada972929941caa21e50d8abeeb8d8d7c8cbd94f616e46ada")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__BatteryStatus,
                  "92fd1f3af4149312736945b5a3537b61e5268fca090d27abbb3b8ba243a5df8e")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__OffboardControlMode,
                  "e87463f252f320d2f197d1feadd643b8645e5ef53a2b158dccfdf11372e00f9f")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__SensorCombined,
                  "e8bb561edb3106315085519255a844e4420677c58bb5dece8f7e3005f9e91d4c")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__TrajectorySetpoint,
                  "9a7deb0cb7db5e52b441169a284b90188c4efdf06b302d55cb1db33ca0358c1a")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__VehicleControlMode,
                  "1c4f8fd70f607d5240d76a0107a47813f50bd6e85e6755b3bf46fe40f1bb9319")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__VehicleOdometry,
                  "4295b96ad312084aa35c84bdcec65ba2f57eb4f6a293d57d52d95acbe99ff817")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__VehicleStatus,
                  "573d6f1a6c3fafbced3ec730dc37f16e96ff0596b64cc651515b31b4b3507c6f")
TILT_ROPTER_TOPIC(px4_msgs_msg_dds__VehicleThrustSetpoint,
                  "5b8b4a61e95ed82423c5fc0f84ecf29f9826a133865b9ffffa1be73977bff738")
TILT_ROPTER_OLDER_TOPIC(rmw_dds_common_msg_older_ParticipantEntitiesInfo,
                        rmw_dds_common_msg_dds__ParticipantEntitiesInfo, "")
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_ActuatorServosV0, px4_msgs_msg_dds__ActuatorServos,
                        "cdc6b628a688d3de85daa4a5a6f4b5d17264a076e477dc5968f65b8279972985")
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_BatteryStatusV0, px4_msgs_msg_dds__BatteryStatus,
                        "6e223662be66b8bc7f04a210f1c38c23206062125588a6dd74189d4975d8b28f")
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_VehicleStatusV0, px4_msgs_msg_dds__VehicleStatus,
                        "cea1c125c9ecf78934ef9829ab070231fb3cd1b7cc502abcb66740363d1426c0")
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_VehicleStatusV1, px4_msgs_msg_dds__VehicleStatus,
                        "828bddbb7d4c2aa6ad93757955f6893be1ec5d8f11885ec7715bcdd76b5226c9")
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_VehicleStatusV2, px4_msgs_msg_dds__VehicleStatus,
                        "b98c704379561e2bfa2a83902bea00bb14357240659617df3a8be1e209747e97")
TILT_ROPTER_OLDER_TOPIC(px4_msgs_msg_older_VehicleStatusV3, px4_msgs_msg_dds__VehicleStatus,
                        "c43a0008ce4677645933a621a26d7c52169cb8415161c423902b873fce745081")
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
