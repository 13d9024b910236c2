// Runs the program mission_mujoco as a user does, and compares the MuJoCo model of the vehicle with
// the parameters of the vehicle and with our plant.

#include "../../examples/mujoco/plant.hpp"
#include "support/check_table.hpp"
#include "support/full_run.hpp"
#include "support/program.hpp"

#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <filesystem>
#include <string>
#include <vector>

namespace {

namespace fs = std::filesystem;
using namespace tilt_ropter;
using examples::MujocoParameters;
using examples::MujocoPlant;

struct Flight : test_support::Outcome {
  int films = 0;
};

Flight run(const std::string& arguments) {
  const test_support::Directory directory("mission_mujoco");
  Flight result{
      test_support::run(MISSION_MUJOCO_PROGRAM,  // set by CMake
                        "--no-pictures --output '" + directory.file("") + "' " + arguments),
      0};
  for (const char* name : {"mission.mp4", "mission.gif", "air.png", "ground.png"})
    if (fs::exists(directory.file(name)) && fs::file_size(directory.file(name)) > 20000)
      ++result.films;
  return result;
}

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

/// The flight without options, which has seed 1.
const Flight& plain_flight() {
  static const Flight flight = run("");
  return flight;
}

// Flies one seed; five in a full run.
TEST(MissionMujoco, TracksWithHybridMissionSettings) {
  const int seeds = test_support::quick_or_full(1, 5);
  for (int seed = 1; seed <= seeds; ++seed) {
    const Flight flight = seed == 1 ? plain_flight() : run("--seed " + std::to_string(seed));
    ASSERT_EQ(flight.exit_code, 0) << flight.output;
    EXPECT_LE(flight["air_rmse_m"], 0.003) << flight.output;
    EXPECT_LE(flight["ground_rmse_m"], 0.006) << flight.output;
    EXPECT_LE(flight["mission_rmse_m"], 0.008) << flight.output;
    EXPECT_GE(flight["power_saved_percent"], 94.4) << flight.output;
    EXPECT_EQ(flight["solver_failures"], 0) << flight.output;
    EXPECT_EQ(flight["tipped_over"], 0) << flight.output;
    EXPECT_LT(flight["lean_max_deg"], 10.0) << flight.output;
    EXPECT_EQ(flight["contact_mode_changes"], 4) << flight.output;
    EXPECT_LE(flight["touchdown_speed_mps"], 0.3) << flight.output;
  }
}

// The battery gives power, voltage and current as in our plant.
TEST(MissionMujoco, FliesAMissionFromAFile) {
  Flight flight = run("--mission-file '" MISSIONS_DIR "/tour.json'");
  ASSERT_EQ(flight.exit_code, 0) << flight.output;
  EXPECT_LE(flight["air_rmse_m"], 0.005) << flight.output;
  EXPECT_LE(flight["ground_rmse_m"], 0.010) << flight.output;
  EXPECT_EQ(flight["contact_mode_changes"], 4) << flight.output;
  EXPECT_EQ(flight["solver_failures"], 0) << flight.output;
  EXPECT_GT(flight["endurance_ground_min"], 10.0 * flight["endurance_air_min"]);
  EXPECT_GT(flight["min_voltage_V"], 15.0);
  EXPECT_GT(flight["max_current_A"], 653.64 / 16.8);
  EXPECT_EQ(run("--mission-file nowhere.json").exit_code, 2);
}

// Flies six rotors that tilt and seven that do not; every vehicle file in a full run.
TEST(MissionMujoco, FliesVehiclesOfAnyNumberOfRotors) {
  std::vector<std::string> names = {"hexacopter", "hexacopter_with_pusher"};
  if (test_support::full_run()) {
    names.clear();
    for (const auto& entry : fs::directory_iterator(VEHICLES_DIR))
      if (entry.path().extension() == ".json") names.push_back(entry.path().stem().string());
    EXPECT_GE(names.size(), 11u);
  }
  for (const std::string& name : names) {
    Flight flight = run("--vehicle '" VEHICLES_DIR "/" + name + ".json'");
    ASSERT_EQ(flight.exit_code, 0) << name << '\n' << flight.output;
    EXPECT_LE(flight["air_rmse_m"], 0.010) << name;
    EXPECT_LE(flight["mission_rmse_m"], 0.020) << name;
    EXPECT_LE(flight["touchdown_speed_mps"], 0.2) << name;
    EXPECT_EQ(flight["solver_failures"], 0) << name;
    EXPECT_EQ(flight["tipped_over"], 0) << name;
  }
  const Flight refused = run("--slow-servo 5");
  EXPECT_NE(refused.exit_code, 0);
  EXPECT_TRUE(refused.says("--slow-servo = 5")) << refused.output;
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

// Tries one option; all in a full run.
TEST(MissionMujoco, EveryOptionTakesEffect) {
  std::vector<const char*> options = {"--wind 1.5"};
  if (test_support::full_run())
    for (const char* more :
         {"--friction 0.2", "--payload 0.1", "--step 0.01", "--step 0.02", "--slow-servo 3"})
      options.push_back(more);
  const Flight& plain = plain_flight();
  for (const char* option : options) {
    Flight flight = run(option);
    EXPECT_EQ(flight.exit_code, 0) << option << '\n' << flight.output;
    EXPECT_EQ(flight["solver_failures"], 0) << option;
    EXPECT_EQ(flight["tipped_over"], 0) << option;
    EXPECT_NE(flight["mission_rmse_m"], plain["mission_rmse_m"]) << option;
    EXPECT_EQ(flight["contact_mode_changes"], 4) << option;
    EXPECT_LT(flight["mission_rmse_m"], 0.10) << option;  // 67 mm in wind
  }
  EXPECT_NE(run("--slope 99").exit_code, 0);
}

// One of ground, height, mass, thrust and tyre scrub at a time differs from what the controller
// assumes.
TEST(MissionMujoco, LandsDrivesAndTakesOffWithWrongGroundOrVehicle) {
  std::vector<std::string> cases = {"--ground-height -0.5", "--height-drift 0.1",
                                    "--mass-error 0.15", "--slope 7"};
  if (test_support::full_run())
    for (const char* more : {"--ground-height 0.5", "--ground-height 0.1", "--ground-height -0.1",
                             "--height-offset 0.1", "--height-offset -0.1", "--height-drift -0.1",
                             "--mass-error 0.2", "--mass-error -0.2", "--thrust-error -0.15",
                             "--tyre-scrub 2", "--slope 5", "--slope -8 --slope-direction 60"})
      cases.emplace_back(more);
  for (const std::string& arguments : cases) {
    Flight flight = run(arguments);
    ASSERT_EQ(flight.exit_code, 0) << arguments << '\n' << flight.output;
    EXPECT_EQ(flight["contact_mode_changes"], 4) << arguments;
    EXPECT_EQ(flight["solver_failures"], 0) << arguments;
    test_support::check_at_most(24, "MuJoCo: touch-down [m/s]", flight["touchdown_speed_mps"], 0.2);
    test_support::check_at_most(24, "MuJoCo: RMSE on the ground [m]", flight["ground_rmse_m"],
                                0.03);
    test_support::check_at_least(24, "MuJoCo: power saved [%]", flight["power_saved_percent"],
                                 90.0);
  }
}

TEST(MissionMujoco, RecordsFilmIfRenderingIsAvailable) {
  if (!test_support::full_run()) GTEST_SKIP() << "takes a minute: --full";
  const Flight flight = run("--film");
  EXPECT_EQ(flight.exit_code, 0);
  if (flight.output.find("no film: ") != std::string::npos)
    GTEST_SKIP() << flight.output.substr(flight.output.find("no film: "), 80);
  EXPECT_EQ(flight.films, 4);
}

}  // namespace
