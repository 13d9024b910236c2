#include <tilt_ropter/control/detail/ground_contact.hpp>
#include <tilt_ropter/control/detail/reference_wrench.hpp>
#include <tilt_ropter/control/detail/wheeled_flight_problem.hpp>
#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <optional>

namespace tilt_ropter {
namespace ground_contact_test {

const Undercarriage wheels{0.11, true, true, true};
const RigidBodyParameters body{2.0, Eigen::Matrix3d::Identity()};
const Eigen::Matrix3d along_level_ground = Eigen::Vector3d(1, 1, 0).asDiagonal();
const Eigen::Matrix3d about_y_and_z = Eigen::Vector3d(0, 1, 1).asDiagonal();

GroundContact axle_with(const GroundContactSettings& settings = {}) {
  return {body, wheels, settings};
}

ReferencePoint at_height(double height, double rising = 0.0) {
  ReferencePoint point;
  point.position.z() = height;
  point.velocity.z() = rising;
  return point;
}

ContactEstimate standing_at(double ground) {
  ContactEstimate contact;
  contact.on_ground = contact.ground_known = true;
  contact.ground.height = ground;
  contact.disturbance.force << 0.1, 0.2, -0.3;
  contact.rolling = {Eigen::Vector3d(0.3, -0.2, 0.0), Eigen::Vector3d(0.0, 0.2, 0.3)};
  return contact;
}

BodyStated measured_at(double height) {
  BodyStated state;
  state.position.z() = height;
  return state;
}

WheeledFlightNode node_of(const ContactEstimate& contact, const ReferencePoint& point,
                          double height = 0.11, double ahead = 0.0,
                          const GroundContactSettings& settings = {}) {
  WheeledFlightNode node;
  axle_with(settings).apply(contact, measured_at(height), ahead, point, point, node);
  return node;
}

TEST(GroundContact, ReferenceAtOrBelowGroundCountsAsOnGround) {
  const GroundContact axle = axle_with();
  for (const double ground : {-0.5, 0.0, 0.5}) {
    const ContactEstimate contact = standing_at(ground);
    for (const double above : {-5.0, -0.05, 0.0, 0.01})
      EXPECT_TRUE(axle.is_ground_reference(contact, Eigen::Vector3d::Zero(),
                                           at_height(ground + 0.11 + above)))
          << above;
    EXPECT_FALSE(axle.is_ground_reference(contact, Eigen::Vector3d::Zero(),
                                          at_height(ground + 0.11 + 0.04)));
    // A reference that takes off or lands is in the air for its whole path.
    EXPECT_FALSE(
        axle.is_ground_reference(contact, Eigen::Vector3d::Zero(), at_height(ground + 0.112, 0.1)));
    EXPECT_TRUE(axle.is_ground_reference(contact, Eigen::Vector3d::Zero(),
                                         at_height(ground + 0.112, -0.01)));
  }
  EXPECT_FALSE(
      axle.is_ground_reference(in_the_air({}), Eigen::Vector3d::Zero(), at_height(-100.0)));
}

TEST(GroundContact, OnSlopeTheLocalGroundHeightCounts) {
  ContactEstimate contact = standing_at(0.0);
  contact.ground.slope << 0.1, 0.0;
  ReferencePoint point = at_height(0.11);
  point.position.x() = 2.0;  // 20 cm below the ground
  EXPECT_TRUE(axle_with().is_ground_reference(contact, Eigen::Vector3d::Zero(), point));
  point.velocity.x() = 1.0;
  const WheeledFlightNode node = node_of(contact, point);
  EXPECT_DOUBLE_EQ(node.reference.position.z(), 0.31);
  EXPECT_DOUBLE_EQ(node.reference.velocity.z(), 0.1);
  // Where the ground falls away, the height of the ground under the vehicle counts.
  point.position.x() = -2.0;
  EXPECT_TRUE(axle_with().is_ground_reference(contact, Eigen::Vector3d::Zero(), point));
  point.position.z() += 0.05;
  EXPECT_FALSE(axle_with().is_ground_reference(contact, Eigen::Vector3d::Zero(), point));
}

TEST(GroundContact, DrivesOnGroundThatIsLowerThanPlanned) {
  GroundContactSettings settings;
  settings.planned_height = 0.0;
  ContactEstimate contact = standing_at(-0.5);
  EXPECT_TRUE(
      axle_with(settings).is_ground_reference(contact, Eigen::Vector3d::Zero(), at_height(0.11)));
  EXPECT_FALSE(axle_with().is_ground_reference(contact, Eigen::Vector3d::Zero(), at_height(0.11)));
  EXPECT_DOUBLE_EQ(node_of(contact, at_height(0.11), -0.39, 0.0, settings).reference.position.z(),
                   -0.39);
  contact.planned_height = 0.0;  // the contact estimate says the same
  EXPECT_TRUE(axle_with().is_ground_reference(contact, Eigen::Vector3d::Zero(), at_height(0.11)));
}

TEST(GroundContact, HoldsVerticalAndRollAndGivesForcesAlongTheGround) {
  const ContactEstimate contact = standing_at(0.0);
  ReferencePoint curve = at_height(0.11);
  curve.acceleration.y() = 1.5;
  const WheeledFlightNode ground = node_of(contact, curve), air = node_of(contact, at_height(0.5));
  EXPECT_TRUE(ground.on_ground);
  EXPECT_EQ(ground.freedom.linear, along_level_ground);
  EXPECT_EQ(ground.freedom.angular, about_y_and_z);
  EXPECT_EQ(ground.external.force, Eigen::Vector3d(0.3, 3.0, 0.0));  // lateral: from the wheels
  EXPECT_EQ(ground.external.torque, contact.rolling.torque);
  EXPECT_FALSE(air.on_ground);
  EXPECT_EQ(air.freedom.linear, Eigen::Matrix3d::Identity());
  EXPECT_EQ(air.external.force, contact.disturbance.force);
}

// The observer already sees the inertia of the wheels at the present acceleration.
TEST(GroundContact, PredictsTheInertiaOfTheRollingWheels) {
  const ContactEstimate contact = standing_at(0.0);
  Undercarriage axle{0.11};
  axle.rolling_mass = 0.07;
  axle.turning_inertia = 0.004;
  ReferencePoint now = at_height(0.11), later = at_height(0.11);
  const Eigen::Quaterniond heading(Eigen::AngleAxisd(0.7, Eigen::Vector3d::UnitZ()));
  now.orientation = later.orientation = heading;
  now.acceleration = heading * Eigen::Vector3d(0.5, 0.2, 0.0);
  later.acceleration = heading * Eigen::Vector3d(-1.0, 0.3, 0.0);
  now.angular_acceleration.z() = 0.4;
  later.angular_acceleration.z() = -0.6;
  WheeledFlightNode node;
  GroundContact(body, axle).apply(contact, measured_at(0.11), 0.5, now, later, node);
  EXPECT_NEAR(node.external.force.x(), contact.rolling.force.x() + 0.07 * 1.5, 1e-12);
  EXPECT_NEAR(node.external.torque.z(), contact.rolling.torque.z() + 0.004 * 1.0, 1e-12);
  GroundContact(body, axle).apply(contact, measured_at(0.11), 0.0, now, now, node);
  EXPECT_NEAR(node.external.force.x(), contact.rolling.force.x(), 1e-12);
}

TEST(GroundContact, HoldsTheMotionsThatTheUndercarriagePrevents) {
  const ContactEstimate contact = standing_at(0.0);
  const auto node_on = [&](const std::optional<Undercarriage>& undercarriage) {
    WheeledFlightNode node;
    GroundContact(body, undercarriage)
        .apply(contact, measured_at(0.11), 0.0, at_height(0.11), at_height(0.11), node);
    return node;
  };
  const auto released_on = [&](const std::optional<Undercarriage>& undercarriage) {
    Wrenchd wrench{Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d(4.0, 5.0, 6.0)};
    GroundContact(body, undercarriage).release(wrench);
    return wrench;
  };
  const auto stopped_on = [&](const std::optional<Undercarriage>& undercarriage) {
    BodyStated state = measured_at(0.11);
    state.velocity.setConstant(0.1);
    state.angular_velocity.setConstant(0.2);
    return GroundContact(body, undercarriage).stopped(node_on(undercarriage), state);
  };
  const Undercarriage four_wheels{0.11, true, false, false}, legs{0.11, false, false, false};
  EXPECT_EQ(node_on(four_wheels).freedom.linear, along_level_ground);
  EXPECT_EQ(node_on(four_wheels).freedom.angular, Eigen::Matrix3d::Zero());
  EXPECT_EQ(node_on(legs).freedom.linear, Eigen::Matrix3d::Zero());
  EXPECT_EQ(node_on(legs).freedom.angular, Eigen::Matrix3d::Zero());
  EXPECT_EQ(released_on(wheels).force, Eigen::Vector3d(1, 0, 3));
  EXPECT_EQ(released_on(wheels).torque, Eigen::Vector3d(0, 5, 6));
  EXPECT_EQ(released_on(four_wheels).torque, Eigen::Vector3d::Zero());
  EXPECT_EQ(released_on(legs).force, Eigen::Vector3d(0, 0, 3));
  EXPECT_EQ(released_on(legs).torque, Eigen::Vector3d::Zero());
  EXPECT_EQ(stopped_on(wheels).angular_velocity, Eigen::Vector3d(0, 0.2, 0.2));
  EXPECT_EQ(stopped_on(four_wheels).angular_velocity, Eigen::Vector3d::Zero());
  EXPECT_EQ(stopped_on(four_wheels).velocity, Eigen::Vector3d::Constant(0.1));
  EXPECT_EQ(stopped_on(legs).velocity, Eigen::Vector3d::Zero());

  // Without an undercarriage no node is on the ground.
  const WheeledFlightNode air = node_on(std::nullopt);
  EXPECT_FALSE(air.on_ground);
  EXPECT_EQ(air.freedom.linear, Eigen::Matrix3d::Identity());
  EXPECT_EQ(air.external.force, contact.disturbance.force);
  EXPECT_EQ(released_on(std::nullopt).force, Eigen::Vector3d(1, 2, 3));
  EXPECT_EQ(stopped_on(std::nullopt).angular_velocity, Eigen::Vector3d::Constant(0.2));
}

// A pitched body on one axle turns about the axle and the ground's normal. The ground takes every
// torque about the third direction, and no other.
TEST(GroundContact, HoldsThePitchedBodyAboutTheDirectionInWhichItRolls) {
  RigidBodyParameters uneven = body;
  uneven.inertia << 0.03, 0.002, 0.004, 0.002, 0.02, -0.001, 0.004, -0.001, 0.04;
  const GroundContact contact(uneven, wheels);
  for (const double pitch : {-0.4, 0.0, 0.2}) {
    WheeledFlightNode node;
    const ReferencePoint point = at_height(0.11);
    contact.apply(standing_at(0.0), measured_at(0.11), 0.0, point, point, node);
    const Eigen::Quaterniond pitched(Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()));
    contact.hold_rotation(pitched, node);
    const Eigen::Vector3d rolls = pitched.conjugate() * Eigen::Vector3d::UnitX(),
                          normal = pitched.conjugate() * Eigen::Vector3d::UnitZ(),
                          axle = Eigen::Vector3d::UnitY();
    const Eigen::Matrix3d& free = node.freedom.angular;
    EXPECT_LT((node.roll_axis - rolls).norm(), 1e-12);
    EXPECT_LT((rolls.transpose() * free).norm(), 1e-12);
    EXPECT_LT((free * normal - normal).norm() + (free * axle - axle).norm(), 1e-12);
    EXPECT_LT((free * uneven.inertia.inverse() * rolls).norm(), 1e-12);
    BodyStated state = measured_at(0.11);
    state.angular_velocity = 0.7 * normal - 0.2 * axle + 0.1 * rolls;
    state = contact.stopped(node, state);
    EXPECT_LT((state.angular_velocity - 0.7 * normal + 0.2 * axle).norm(), 1e-12);
    EXPECT_NEAR(node.roll_axis.dot(state.angular_velocity), 0.0, 1e-12);
  }
}

// The rotors can push forward only if they also push upward, because the servos reach 60 degrees.
// Half of the tangent of this angle is the largest ratio.
TEST(GroundContact, ThrustOnTheGroundKeepsTiltAnglesWithinTheRangeOfTheServos) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  const GroundContactSettings settings;
  const double unlimited =
      ReferenceWrench<4>(vehicle, settings).ground_thrust({{0.8, 0.0, 0.0}, {0.0, 0.0, 0.02}});
  EXPECT_LT(unlimited, 1.2);
  vehicle.servo.min_angle = -pi / 3.0;
  vehicle.servo.max_angle = 0.5 * pi;
  const ReferenceWrench<4> needed(vehicle, settings);
  const AllocationMatrix<4> allocation(vehicle);
  for (const double force : {-1.5, -0.1, 0.0, 0.8}) {
    Wrenchd wrench{{force, 0.0, 0.0}, {0.0, 0.0, 0.02}};
    wrench.force.z() = needed.ground_thrust(wrench);
    EXPECT_LE(wrench.force.z(), 0.5 * 1.5 * gravity);
    Eigen::Matrix<double, 6, 1> both;
    both << wrench.force, wrench.torque;
    const Eigen::Matrix<double, 8, 1> thrusts = allocation.pseudoinverse * both;
    for (int i = 0; i < 4; ++i)
      EXPECT_LE(std::abs(thrusts(2 * i)), 0.5 * std::tan(pi / 3.0) * thrusts(2 * i + 1) + 1e-9);
  }
}

// A vehicle on a slope is rotated with the ground. Its axle and its path lie in the ground plane.
// Seen from above, its heading equals the heading of the reference.
TEST(GroundContact, AlignsReferenceAttitudeWithSlope) {
  ContactEstimate contact = standing_at(0.0);
  contact.ground.slope << 0.1, -0.2;
  const Eigen::Vector3d normal = Eigen::Vector3d(-0.1, 0.2, 1.0).normalized();
  for (const double yaw : {0.0, 0.5, 2.0, pi}) {
    ReferencePoint point = at_height(0.11);
    point.orientation = quaternion_from_yaw(yaw);
    point.acceleration << 0.3, 0.4, 0.0;
    const WheeledFlightNode node = node_of(contact, point);
    const Eigen::Quaterniond& q = node.reference.orientation;
    EXPECT_LT((q * Eigen::Vector3d::UnitZ() - normal).norm(), 1e-12);
    const Eigen::Vector3d ahead = q * Eigen::Vector3d::UnitX();
    EXPECT_NEAR(std::atan2(std::sin(yaw - std::atan2(ahead.y(), ahead.x())),
                           std::cos(yaw - std::atan2(ahead.y(), ahead.x()))),
                0.0, 1e-12);
    EXPECT_LT((node.freedom.linear * normal).norm(), 1e-12);
    // The wheels give the force that prevents sliding downhill. With this force the model has the
    // same lateral acceleration as the reference.
    Stated start;
    start.body = node.reference;
    start.wrench = {};
    const Stated end = RigidBodyd(body).step(start, Eigen::Matrix<double, 6, 1>::Zero(),
                                             node.external, 0.01, node.freedom);
    Eigen::Vector3d wanted = point.acceleration;
    wanted.z() = contact.ground.slope.dot(wanted.head<2>());
    const Eigen::Vector3d gained = (end.body.velocity - start.body.velocity) / 0.01;
    EXPECT_NEAR((q.conjugate() * (gained - wanted)).y(), 0.0, 1e-3);
  }
}

TEST(GroundContact, ReferenceAttitudeIsRelativeToTheGround) {
  const GroundPlane ground{0.0, {0.1, -0.2}};
  ReferencePoint level, pitched;
  level.orientation = quaternion_from_yaw(0.7);
  const Eigen::Quaterniond pitch(Eigen::AngleAxisd(0.2, Eigen::Vector3d::UnitY()));
  pitched.orientation = level.orientation * pitch;
  const GroundContact axle = axle_with();
  EXPECT_LT((axle.on_ground(ground, level).orientation * pitch)
                .angularDistance(axle.on_ground(ground, pitched).orientation),
            1e-12);
  ReferencePoint nose_up;
  nose_up.orientation = Eigen::AngleAxisd(-0.5 * pi, Eigen::Vector3d::UnitY());
  EXPECT_TRUE(axle.on_ground(ground, nose_up).orientation.isApprox(nose_up.orientation));
  EXPECT_TRUE(GroundContact(body, std::nullopt)
                  .on_ground(ground, level)
                  .orientation.isApprox(level.orientation));
}

TEST(GroundContact, DescendsSlowlyUntilTheGroundIsMet) {
  ContactEstimate contact;  // ground assumed at height zero, vehicle in the air
  const double speed = GroundContactSettings{}.settling_speed;
  // At or below the expected height of contact: continue downward.
  for (const double height : {0.11, 0.0}) {
    const WheeledFlightNode node = node_of(contact, at_height(0.11), height, 0.5);
    EXPECT_FALSE(node.on_ground);
    EXPECT_DOUBLE_EQ(node.reference.position.z(), height - 0.5 * speed);
    EXPECT_DOUBLE_EQ(node.reference.velocity.z(), -speed);
  }
  // From above: fast at first, and never slower than settling_speed.
  double last = 1.11;
  for (double ahead = 0.1; ahead <= 2.0; ahead += 0.1) {
    const WheeledFlightNode node = node_of(contact, at_height(0.0), 1.11, ahead);
    EXPECT_LT(node.reference.position.z(), last - 0.099 * speed);
    last = node.reference.position.z();
  }
  EXPECT_LT(last, 0.11);
  EXPECT_EQ(node_of(contact, at_height(0.5), 1.0).reference.position.z(), 0.5);
}

// The indicator function delta of the paper: only heights count, of the reference and of the
// vehicle.
TEST(GroundContact, ContactByHeightNeedsBothHeights) {
  GroundContactSettings settings;
  settings.contact_by_height = true;
  settings.planned_height = 0.0;
  ContactEstimate carried = standing_at(-0.5), in_flight = in_the_air({});
  for (const ContactEstimate& contact : {carried, in_flight}) {
    const auto on_ground = [&](double reference, double height) {
      return node_of(contact, at_height(reference), height, 0.0, settings).on_ground;
    };
    EXPECT_TRUE(on_ground(0.11, 0.11));
    EXPECT_TRUE(on_ground(0.114, 0.106));
    EXPECT_FALSE(on_ground(0.116, 0.11));
    EXPECT_FALSE(on_ground(0.11, 0.116));
    EXPECT_FALSE(on_ground(0.104, 0.11));
    EXPECT_FALSE(on_ground(0.11, 0.104));
  }
}

TEST(GroundContact, ExternalWrenchModelMovesFreelyUnderTheWholeWrench) {
  GroundContactSettings settings;
  settings.model = GroundModel::external_wrench;
  ContactEstimate contact = standing_at(0.0);
  contact.external = {Eigen::Vector3d(1.0, 2.0, 14.0), Eigen::Vector3d(0.1, 0.2, 0.3)};
  for (const double height : {0.11, 0.5}) {
    const WheeledFlightNode node = node_of(contact, at_height(height), height, 0.0, settings);
    EXPECT_EQ(node.on_ground, height == 0.11);
    EXPECT_EQ(node.external.force, contact.external.force);
    EXPECT_EQ(node.external.torque, contact.external.torque);
    EXPECT_EQ(node.freedom.linear, Eigen::Matrix3d::Identity());
    EXPECT_EQ(node.freedom.angular, Eigen::Matrix3d::Identity());
  }
  BodyStated rolling = measured_at(0.11);
  rolling.angular_velocity.x() = 0.3;
  const WheeledFlightNode standing = node_of(contact, at_height(0.11), 0.11, 0.0, settings);
  EXPECT_EQ(axle_with(settings).stopped(standing, rolling).angular_velocity.x(), 0.3);
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Wrenchd needed =
      ReferenceWrench<4>(vehicle, settings)(at_height(0.11), contact.external, true);
  EXPECT_NEAR(needed.force.z(), vehicle.body.mass * gravity - 14.0, 1e-12);
  EXPECT_NEAR(needed.force.y(), -2.0, 1e-12);
}

TEST(GroundContact, DrivesWithLessLoadBesideItsReferenceOrTurnedFromIt) {
  ReferencePoint point = at_height(0.11);
  point.orientation = quaternion_exp(Eigen::Vector3d(0.0, 0.0, 2.5));
  const auto lifted = [&point](double ahead, double aside, double turned, double speed = 1.0) {
    BodyStated state;
    state.velocity.x() = speed;
    state.position = point.position + point.orientation * Eigen::Vector3d(ahead, aside, 0.0);
    state.orientation = point.orientation * quaternion_exp(Eigen::Vector3d(0.0, 0.0, turned));
    return axle_with().lifted(state, point);
  };
  EXPECT_NEAR(lifted(1.0, 0.015, -0.05), 0.0, 1e-12);
  EXPECT_NEAR(lifted(0.0, -0.0325, 0.0), 0.5, 1e-12);
  EXPECT_NEAR(lifted(0.0, 0.0, std::asin(0.125)), 0.75, 1e-12);
  EXPECT_EQ(lifted(0.0, 0.0, -3.0), 1.0);
  EXPECT_EQ(lifted(0.0, 0.0, -3.0, -0.1), 0.5);
  EXPECT_EQ(lifted(0.0, 0.1, -3.0, 0.0), 0.0);  // rests
  const GroundContactSettings settings;
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const ReferenceWrench<4> needed(vehicle, settings);
  for (const double share : {0.0, 0.6, 1.0})
    EXPECT_NEAR(needed(point, {}, true, share).force.z(),
                std::max(settings.down_force, 0.5 * share * vehicle.body.mass * gravity), 1e-12);
  EXPECT_NEAR(needed(point, {}, false, 1.0).force.z(), vehicle.body.mass * gravity, 1e-12);
}

TEST(GroundContact, WithoutSettlingSpeedTheReferenceStaysAsItIs) {
  GroundContactSettings settings;
  settings.settling_speed = 0.0;
  const WheeledFlightNode node = node_of({}, at_height(0.11), 0.3, 0.5, settings);
  EXPECT_EQ(node.reference.position.z(), 0.11);
  EXPECT_EQ(node.reference.velocity.z(), 0.0);
}

}  // namespace ground_contact_test
}  // namespace tilt_ropter
