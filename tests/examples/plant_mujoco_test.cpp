// Compares the MuJoCo model of the vehicle with the parameters of the vehicle and with our plant.
// CTest: mujoco

#include "../../examples/mujoco/plant.hpp"
#include "support/program.hpp"

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <stdexcept>

namespace plant_mujoco_test {

using namespace tilt_ropter;
using examples::MujocoParameters;
using examples::MujocoPlant;

// Mass matrix of the six degrees of freedom of the base, about the origin of the body frame, with
// fixed arms and free wheels. Linear part in world axes, angular part in body axes.
Eigen::Matrix<double, 6, 6> mass_matrix(const MujocoPlant<4>& plant) {
  const mjModel& model = plant.model();
  Eigen::MatrixXd m(model.nv, model.nv);
  mj_fullM(&model, m.data(), plant.data().qM);
  Eigen::Matrix<double, 6, 6> base = m.topLeftCorner<6, 6>();
  for (const char* name : {"wheel1", "wheel2"}) {
    const int wheel = model.jnt_dofadr[mj_name2id(&model, mjOBJ_JOINT, name)];
    base -= m.block<6, 1>(0, wheel) * m.block<1, 6>(wheel, 0) / m(wheel, wheel);
  }
  return base;
}

ActuatorState<4> hover(const Vehicle<4>& vehicle) {
  ActuatorState<4> state;
  for (std::size_t i = 0; i < 4; ++i)
    state.rotor_speed(static_cast<Eigen::Index>(i)) =
        speed_from_thrust(vehicle.body.mass * gravity / 4.0, rotor_parameters(vehicle, i));
  return state;
}

Vehicle<4> unlike_rotors() {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.battery.nominal_voltage = 22.2;
  vehicle.rotors[0].parameters = {1.1e-6, 0.016, 0.3, 9.0, 0.05, 8e-4};
  vehicle.rotors[3].parameters = {2.0e-6, 0.012, 0.0, 14.0, 0.02, -5e-4};
  return vehicle;
}

BodyStated high() {
  BodyStated body;
  body.position << 0.0, 0.0, 5.0;
  return body;
}

// Parameters without the effects that our plant lacks: arms and wheels have almost no mass.
MujocoParameters light_arms() {
  MujocoParameters p;
  p.arm_mass = 1e-4;
  p.arm_inertia.setConstant(1e-8);
  p.wheel_mass = 1e-3;
  return p;
}

TEST(MujocoModel, HasMassAndInertiaOfTheVehicleAtZeroTilt) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.body.mass = 1.62;
  vehicle.body.inertia << 0.0154, 4e-4, -7e-4, 4e-4, 0.0161, 3e-4, -7e-4, 3e-4, 0.0275;
  MujocoParameters p;
  p.arm_height = 0.02;
  MujocoPlant plant(vehicle, p);
  Eigen::Matrix<double, 6, 6> expected = Eigen::Matrix<double, 6, 6>::Zero();
  expected.topLeftCorner<3, 3>() = vehicle.body.mass * Eigen::Matrix3d::Identity();
  expected.bottomRightCorner<3, 3>() = vehicle.body.inertia;
  EXPECT_LT((mass_matrix(plant) - expected).cwiseAbs().maxCoeff(), 1e-9);

  p.payload = 0.2;
  MujocoPlant laden(vehicle, p);
  expected(0, 0) += p.payload;
  EXPECT_NEAR(mass_matrix(laden)(0, 0), expected(0, 0), 1e-9);
  EXPECT_NEAR(mass_matrix(laden)(0, 4), p.payload * p.payload_position.z(), 1e-9);
}

TEST(MujocoModel, CentreOfMassMovesWithArmTilt) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const MujocoParameters p;
  MujocoPlant plant(vehicle, p);
  ActuatorState<4> tilted;
  tilted.tilt_angle << 0.5, 0.0, 0.0, 0.0;  // the right arm: its thrust tilts to -x
  plant.reset(high(), tilted);
  const Eigen::Map<const Eigen::Vector3d> centre(plant.data().subtree_com + 3);  // of the base
  const double fraction = p.arm_mass * p.arm_height / vehicle.body.mass;
  EXPECT_NEAR(centre.x(), -fraction * std::sin(0.5), 1e-12);
  EXPECT_NEAR(centre.z(), 5.0 - fraction * (1.0 - std::cos(0.5)), 1e-12);
}

TEST(MujocoModel, GroundRisesInTheSlopeDirection) {
  MujocoParameters p;
  p.slope = 0.1;
  p.slope_direction = 2.0;
  const Eigen::Vector3d normal = ground_orientation(p) * Eigen::Vector3d::UnitZ();
  const Eigen::Vector3d uphill(std::cos(2.0) * std::cos(0.1), std::sin(2.0) * std::cos(0.1),
                               std::sin(0.1));
  EXPECT_NEAR(normal.dot(uphill), 0.0, 1e-12);
  EXPECT_GT(normal.z(), 0.99);

  MujocoPlant plant(tilt_ropter_vehicle(), p);  // stands on the slope
  EXPECT_NEAR(normal.dot(plant.body().position), tilt_ropter_vehicle().wheels->radius, 1e-12);
  ASSERT_TRUE(plant.step({}, {}, 0.3));
  EXPECT_GT(plant.normal_forces().head<2>().minCoeff(), 1.0);
  EXPECT_LT(plant.body().velocity.dot(uphill), -0.01);  // rolls or slides downhill
}

TEST(MujocoModel, RejectsInvalidParameters) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  MujocoParameters p;
  p.arm_mass = 0.5;  // four arms weigh more than the vehicle
  EXPECT_THROW(MujocoPlant(vehicle, p), std::invalid_argument);
  p = {};
  p.time_step = 0.0;
  EXPECT_THROW(MujocoPlant(vehicle, p), std::invalid_argument);
  p = {};
  p.contact_impedance = 1.0;
  EXPECT_THROW(MujocoPlant(vehicle, p), std::invalid_argument);
}

TEST(MujocoPlant, ServosFollowCommandsAfterTheirDeadTime) {
  Vehicle<4> late = tilt_ropter_vehicle();
  late.servo.dead_time = 0.05;
  MujocoPlant plant(late);
  ServoParameters later = late.servo;
  later.dead_time = 0.10;
  plant.set_servo(3, later);
  plant.reset(high(), hover(late));
  ActuatorState<4> tilted = hover(late);
  tilted.tilt_angle << 0.0, 0.0, 0.5, 0.5;
  Eigen::Vector4d moved = Eigen::Vector4d::Zero();  // time of first motion [s]
  for (int i = 0; i < 200; ++i) {
    ASSERT_TRUE(plant.step(tilted, {}, 1e-3));
    for (Eigen::Index k = 2; k < 4; ++k)
      if (moved(k) == 0.0 && plant.actuators().tilt_angle(k) > 0.005) moved(k) = plant.time();
  }
  EXPECT_NEAR(moved(2), 0.05, 0.004);
  EXPECT_NEAR(moved(3), 0.10, 0.004);
  EXPECT_NEAR(moved(3) - moved(2), 0.05, 0.0021);
}

TEST(MujocoPlant, HoversWithHoverThrust) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  MujocoPlant plant(vehicle);
  plant.reset(high(), hover(vehicle));
  for (int i = 0; i < 500; ++i) ASSERT_TRUE(plant.step(hover(vehicle), {}, 1e-3));
  EXPECT_LT((plant.body().position - high().position).norm(), 1e-4);
  EXPECT_LT((plant.specific_force() - Eigen::Vector3d(0.0, 0.0, gravity)).norm(), 1e-3);
  EXPECT_LT(plant.external_wrench().force.norm(), 1e-12);
}

TEST(MujocoPlant, WheelsCarryTheWeightAtRest) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  MujocoPlant plant(vehicle);
  for (int i = 0; i < 1000; ++i) ASSERT_TRUE(plant.step({}, {}, 1e-3));
  const double weight = vehicle.body.mass * gravity;
  EXPECT_NEAR(plant.body().position.z(), vehicle.wheels->radius, 1e-3);
  EXPECT_NEAR(plant.normal_forces()(0), 0.5 * weight, 1e-3);
  EXPECT_NEAR(plant.normal_forces()(1), 0.5 * weight, 1e-3);
  EXPECT_NEAR(plant.external_wrench().force.z(), weight, 1e-3);
  EXPECT_LT(plant.external_wrench().torque.norm(), 1e-3);
}

// Two independent engines simulate the same motion. They agree if arms and wheels have negligible
// mass, and differ if the arms are heavy.
TEST(MujocoPlant, MatchesOurPlantInFlightWhenArmsAreLight) {
  Vehicle<4> vehicle = unlike_rotors();
  vehicle.wheels->inertia = 1e-6;
  const auto distance = [&vehicle](MujocoParameters p) {
    PlantParameters ours_parameters;
    ours_parameters.contact.bearing_friction = p.contact.bearing_friction = 0.0;
    Plant<4> ours(vehicle, ours_parameters);
    PlantState<4> start;
    start.body = high();
    start.body.angular_velocity << 0.4, -0.3, 0.5;
    start.actuators = hover(vehicle);
    ours.reset(start);
    MujocoPlant other(vehicle, p);
    other.reset(start.body, start.actuators);
    const Wrenchd wind{Eigen::Vector3d(0.5, -0.3, 0.2), Eigen::Vector3d(0.005, 0.01, -0.01)};
    ActuatorState<4> command = start.actuators;
    for (int i = 0; i < 500; ++i) {
      if (i == 100) command.tilt_angle << 0.6, -0.4, 0.5, -0.2;
      if (i == 250) command.rotor_speed << 1500.0, 1600.0, 1700.0, 1650.0;
      EXPECT_TRUE(ours.step(command, wind, 1e-3));
      EXPECT_TRUE(other.step(command, wind, 1e-3));
    }
    EXPECT_NEAR(other.time(), ours.time(), 1e-9);
    EXPECT_GT((ours.body().position - start.body.position).norm(), 0.1);
    EXPECT_LT((ours.actuators().rotor_speed - other.actuators().rotor_speed).norm(), 1e-3);
    EXPECT_LT((ours.actuators().tilt_angle - other.actuators().tilt_angle).norm(), 0.05);
    return (ours.body().position - other.body().position).norm();
  };
  MujocoParameters light = light_arms();
  light.servo_armature = 1e-4;
  MujocoParameters heavy;
  heavy.arm_mass = 0.1;
  heavy.arm_height = 0.03;
  const double without_arms = distance(light);
  EXPECT_LT(without_arms, 5e-4);
  EXPECT_GT(distance(heavy), 10.0 * without_arms);
}

TEST(MujocoPlant, TopSpeedsArePerRotorAndFallWithVoltage) {
  const Vehicle<4> vehicle = unlike_rotors();
  MujocoPlant plant(vehicle);
  ActuatorState<4> fastest;
  fastest.rotor_speed.setConstant(1e6);
  Eigen::Vector4d full;
  for (std::size_t i = 0; i < 4; ++i)
    full(static_cast<Eigen::Index>(i)) =
        speed_from_thrust(rotor_parameters(vehicle, i).max_thrust, rotor_parameters(vehicle, i));
  for (const double ratio : {1.0, 0.8, 1.2}) {
    ASSERT_TRUE(plant.set_voltage(22.2 * ratio));
    EXPECT_FALSE(plant.set_voltage(0.0));
    ASSERT_TRUE(plant.step(fastest, {}, 1.0));
    EXPECT_LT((plant.actuators().rotor_speed - std::min(ratio, 1.0) * full).norm(), 1.0);
  }
}

TEST(MujocoPlant, SetServoSlowsOneServo) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  MujocoPlant plant(vehicle);
  plant.reset(high(), hover(vehicle));
  ServoParameters slow = vehicle.servo;
  slow.time_constant *= 3.0;
  plant.set_servo(2, slow);
  ActuatorState<4> command = hover(vehicle);
  command.tilt_angle.setConstant(0.1);
  for (int i = 0; i < 80; ++i) ASSERT_TRUE(plant.step(command, {}, 1e-3));
  EXPECT_NEAR(plant.actuators().tilt_angle(0), 0.1 * (1.0 - std::exp(-1.0)), 0.005);
  EXPECT_NEAR(plant.actuators().tilt_angle(2), 0.1 * (1.0 - std::exp(-1.0 / 3.0)), 0.005);
}

TEST(MujocoPlant, ServosKeepTheirMaxRate) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  MujocoPlant plant(vehicle);
  plant.reset(high(), hover(vehicle));
  ActuatorState<4> command = hover(vehicle);
  command.tilt_angle.setConstant(3.0);
  for (int i = 0; i < 200; ++i) ASSERT_TRUE(plant.step(command, {}, 1e-3));
  EXPECT_NEAR(plant.actuators().tilt_angle(0), 0.2 * vehicle.servo.max_rate, 0.05);
}

TEST(MujocoPlant, MatchesOurPlantWhenRollingOut) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  Plant<4> ours(vehicle);
  MujocoPlant other(vehicle);
  Wrenchd push;
  push.force.x() = 1.5;
  for (int i = 0; i < 500; ++i) ASSERT_TRUE(ours.step({}, {}, 1e-3) && other.step({}, {}, 1e-3));
  for (int i = 0; i < 1000; ++i)
    ASSERT_TRUE(ours.step({}, push, 1e-3) && other.step({}, push, 1e-3));
  // The torque that spins up the wheels does not act on the body.
  EXPECT_GT(4e-4 * std::abs(other.wheel_speeds()(0)), 2e-3);
  EXPECT_LT(std::abs(other.external_wrench().torque.y()), 5e-4);
  for (int i = 0; i < 1000; ++i) ASSERT_TRUE(ours.step({}, {}, 1e-3) && other.step({}, {}, 1e-3));
  EXPECT_GT(ours.body().velocity.x(), 0.5);
  EXPECT_NEAR(other.body().velocity.x() / ours.body().velocity.x(), 1.0, 6e-3);
}

// The bearing drags the arm that is the wheel's axle. The servo gives way by the same angle in both
// plants.
TEST(MujocoPlant, RollingWheelsTurnTheirArmsAsInOurPlant) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  PlantParameters dragging;
  MujocoParameters p;
  p.arm_height = 0.0;  // an arm with its CoM above the hinge would lag behind the pushed body
  dragging.contact.bearing_friction = p.contact.bearing_friction = 5e-4;
  Plant<4> ours(vehicle, dragging);
  MujocoPlant other(vehicle, p);
  EXPECT_NEAR(other.servo_stiffness(), ours.servo_stiffness(), 1e-12);
  Wrenchd push;
  push.force.x() = 1.5;
  for (int i = 0; i < 600; ++i)  // then the body has pitched by less than 0.1 rad
    ASSERT_TRUE(ours.step({}, push, 1e-3) && other.step({}, push, 1e-3));
  EXPECT_GT(ours.bearing_torque(), 1e-3);
  EXPECT_NEAR(other.bearing_torque() / ours.bearing_torque(), 1.0, 0.05);
  for (const Eigen::Index arm : {0, 1}) {
    const double deflection = ours.actuators().tilt_angle(arm);
    EXPECT_GT(std::abs(deflection), 4e-4);
    EXPECT_NEAR(other.actuators().tilt_angle(arm) / deflection, 1.0, 0.1) << arm;
  }
}

TEST(MujocoPlant, RejectsInvalidSteps) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  MujocoPlant plant(vehicle);
  ActuatorState<4> bad = hover(vehicle);
  bad.tilt_angle(1) = std::nan("");
  EXPECT_FALSE(plant.step(bad, {}, 1e-3));
  EXPECT_FALSE(plant.step({}, {}, 0.0));
  EXPECT_FALSE(plant.step({}, {}, -1.0));
  Wrenchd wrench;
  wrench.force.x() = std::nan("");
  EXPECT_FALSE(plant.step({}, wrench, 1e-3));
  EXPECT_DOUBLE_EQ(plant.time(), 0.0);
  EXPECT_TRUE(plant.step({}, {}, 1e-3));
}

// Arms of the Tilt-Ropter's mass do not fit into a vehicle of 1 kg.
TEST(MujocoModel, ArmsAreLighterWhereTheyDoNotFit) {
  const MujocoParameters usual;
  EXPECT_EQ(with_fitting_arms(tilt_ropter_vehicle(), usual).arm_mass, usual.arm_mass);
  Vehicle<4> light = tilt_ropter_vehicle();
  light.body.mass = 0.5;
  light.body.inertia *= 0.3;
  EXPECT_THROW((void)base_inertia(light, usual), std::invalid_argument);
  const MujocoParameters fitting = with_fitting_arms(light, usual);
  EXPECT_LT(fitting.arm_mass, usual.arm_mass);
  EXPECT_GT(base_inertia(light, fitting).mass, 0.0);
}

}  // namespace plant_mujoco_test
