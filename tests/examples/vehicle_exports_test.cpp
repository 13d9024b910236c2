// Vehicle files as PX4's parameters and as URDF.

#include "../../examples/support/px4_geometry.hpp"
#include "../../examples/support/vehicle_choice.hpp"
#include "support/program.hpp"

#include <tilt_ropter/actuation/detail/actuated_body.hpp>
#include <tilt_ropter/actuation/rotor.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <filesystem>
#include <map>
#include <sstream>
#include <string>
#include <tuple>
#include <variant>

namespace vehicle_exports_test {

using Eigen::Vector3d;
using test_support::run;

std::string file_of(const std::string& vehicle) {
  return std::string(VEHICLES_DIR) + '/' + vehicle + ".json";
}

/// What px4_parameters prints.
std::map<std::string, double> printed(const std::string& vehicle) {
  const auto told = run(PX4_PARAMETERS_PROGRAM, "'" + file_of(vehicle) + "'");
  EXPECT_EQ(told.exit_code, 0) << told.output;
  std::map<std::string, double> values;
  std::istringstream lines(told.output);
  for (std::string line; std::getline(lines, line);) {
    if (line.rfind("warning: ", 0) == 0) continue;
    std::istringstream words(line);
    std::string param, set, name;
    double value = 0.0;
    EXPECT_TRUE(words >> param >> set >> name >> value) << line;
    EXPECT_EQ(param + ' ' + set, "param set");
    EXPECT_LE(name.size(), 16U);  // as PX4's names are
    EXPECT_EQ(values.count(name), 0U) << name;
    values[name] = value;
  }
  return values;
}

/// Force and torque (FLU) of rotor i with a thrust of one and its servo at `angle` [rad], by the
/// definitions in PX4's description of its parameters.
Eigen::Matrix<double, 6, 1> wrench_in_px4(const std::map<std::string, double>& px4, int i,
                                          double angle) {
  const auto of = [&](const std::string& name) {
    return px4.at("CA_ROTOR" + std::to_string(i) + "_" + name);
  };
  const Vector3d position(of("PX"), of("PY"), of("PZ"));
  Vector3d axis(of("AX"), of("AY"), of("AZ"));
  if (of("TILT") > 0.0) {
    const double towards =
        px4.at("CA_SV_TL" + std::to_string(std::lround(of("TILT")) - 1) + "_TD") * M_PI / 180.0;
    const Vector3d level(std::cos(towards), std::sin(towards), 0.0);  // 0: front, 90: right
    axis = std::cos(angle) * axis + std::sin(angle) * level;
  }
  Eigen::Matrix<double, 6, 1> wrench;  // positive KM: counter-clockwise, which turns to the right
  wrench << axis, position.cross(axis) - of("KM") * axis;
  const Vector3d flu(1.0, -1.0, -1.0);
  wrench.head<3>() = wrench.head<3>().cwiseProduct(flu);
  wrench.tail<3>() = wrench.tail<3>().cwiseProduct(flu);
  return wrench;
}

TEST(Px4Parameters, GiveTheWrenchesOfTheModel) {
  for (const std::string name : {"tilt_ropter", "tilting_x_quadrotor", "tricopter"}) {
    const auto px4 = printed(name);
    std::visit(
        [&](const auto& vehicle) {
          constexpr int rotors = std::tuple_size_v<decltype(vehicle.rotors)>;
          EXPECT_EQ(px4.at("CA_ROTOR_COUNT"), rotors);
          EXPECT_EQ(px4.at("CA_AIRFRAME"), 8.0);
          const tilt_ropter::ActuatedBody<rotors> body(vehicle);
          for (int i = 0; i < rotors; ++i)
            for (const double angle : {0.0, 0.4, -0.9}) {
              const auto k = static_cast<std::size_t>(i);
              if (!vehicle.rotors[k].tilts && angle != 0.0) continue;
              tilt_ropter::ActuatorState<rotors> one;  // newton
              one.rotor_speed(i) =
                  tilt_ropter::speed_from_thrust(1.0, rotor_parameters(vehicle, k));
              one.tilt_angle(i) = angle;
              const tilt_ropter::Wrenchd wrench = body.wrench(one);
              Eigen::Matrix<double, 6, 1> ours;
              ours << wrench.force, wrench.torque;
              EXPECT_LT((wrench_in_px4(px4, i, angle) - ours).norm(), 0.01)
                  << name << " rotor " << i << " angle " << angle;
            }
        },
        examples::read_vehicle(file_of(name)).vehicle);
  }
}

TEST(Px4Parameters, SayWhatPx4DoesNotKnow) {
  const auto warned = [](const std::string& vehicle) {
    return run(PX4_PARAMETERS_PROGRAM, "'" + file_of(vehicle) + "'");
  };
  EXPECT_TRUE(warned("hexacopter").says("PX4 knows 4 tilt servos, this vehicle has 6"));
  EXPECT_TRUE(warned("tilt_ropter").says("farther than PX4's 90 deg"));
  EXPECT_FALSE(warned("quadrotor").says("warning"));
  EXPECT_TRUE(warned("hexacopter").says("12 outputs"));
  const auto hexacopter = printed("hexacopter"), quadrotor = printed("quadrotor");
  EXPECT_EQ(hexacopter.at("CA_AIRFRAME"), 0.0);
  EXPECT_EQ(hexacopter.at("CA_SV_TL_COUNT"), 0.0);
  EXPECT_EQ(quadrotor.at("CA_AIRFRAME"), 0.0);
  EXPECT_EQ(quadrotor.at("PWM_MAIN_FUNC4"), 104.0);
  EXPECT_EQ(quadrotor.count("PWM_MAIN_FUNC5"), 0U);
  const auto tilt_ropter = printed("tilt_ropter");
  EXPECT_EQ(tilt_ropter.at("PWM_MAIN_FUNC5"), 201.0);
  EXPECT_NEAR(tilt_ropter.at("MPC_THR_HOVER"), 1.5 * 9.81 / 48.0, 1e-3);
  // The pusher carries nothing.
  EXPECT_NEAR(printed("quadrotor_with_pusher").at("MPC_THR_HOVER"), 1.5 * 9.81 / 44.0, 1e-3);
  EXPECT_EQ(run(PX4_PARAMETERS_PROGRAM, "nowhere.json").exit_code, 2);
}

// Which axes need the tilt servos.
TEST(Px4Parameters, LetServosTurnWhereUprightRotorsDoNot) {
  tilt_ropter::Vehicle<2> beside;  // a bicopter with rotors left and right
  beside.rotors[0] = tilt_ropter::rotor_on_arm(M_PI / 2, 0.2, tilt_ropter::Spin::clockwise);
  beside.rotors[1] =
      tilt_ropter::rotor_on_arm(-M_PI / 2, 0.2, tilt_ropter::Spin::counter_clockwise);
  beside.servo.min_angle = -M_PI / 4;
  beside.servo.max_angle = M_PI / 4;
  const auto value = [](const examples::Px4Parameters& p, const std::string& name) {
    for (const auto& [known, v] : p.values)
      if (known == name) return v;
    return std::nan("");
  };
  const auto p = examples::px4_parameters(beside);
  EXPECT_EQ(value(p, "CA_SV_TL0_CT"), 3.0);  // yaw and pitch
  EXPECT_NEAR(value(p, "CA_SV_TL0_MAXA"), 45.0, 1e-9);
  EXPECT_EQ(value(p, "CA_SV_TL0_TD"), 0.0);    // the left rotor leans to the front
  EXPECT_EQ(value(p, "CA_SV_TL1_TD"), 180.0);  // the right one to the back
  EXPECT_TRUE(p.warnings.empty());
  tilt_ropter::Vehicle<4> cross = tilt_ropter::tilt_ropter_vehicle();
  cross.servo = beside.servo;
  EXPECT_EQ(value(examples::px4_parameters(cross), "CA_SV_TL0_CT"), 0.0);
}

TEST(VehicleUrdf, IsReadByUrdfdom) {
  if (std::system("command -v check_urdf > /dev/null 2>&1") != 0)
    GTEST_SKIP() << "check_urdf is not installed (Debian: liburdfdom-tools)";
  const test_support::Directory directory("urdf");
  for (const auto& entry : std::filesystem::directory_iterator(VEHICLES_DIR)) {
    if (entry.path().extension() != ".json") continue;
    const std::string urdf = directory.file("vehicle.urdf");
    const auto told = run(
        "sh", "-c \"" VEHICLE_URDF_PROGRAM " '" + entry.path().string() + "' > '" + urdf + "'\"");
    EXPECT_EQ(told.exit_code, 0) << entry.path();
    const auto checked = run("check_urdf", "'" + urdf + "'");
    EXPECT_EQ(checked.exit_code, 0) << checked.output;
    EXPECT_TRUE(checked.says("root Link: base_link")) << checked.output;
    std::visit(
        [&, path = entry.path()](const auto& vehicle) {
          const auto text = test_support::read_file(urdf);
          std::size_t revolute = 0;
          for (std::size_t at = 0; (at = text.find("\"revolute\"", at)) != std::string::npos; ++at)
            ++revolute;
          EXPECT_EQ(revolute, static_cast<std::size_t>(servo_count(vehicle))) << path;
          EXPECT_TRUE(checked.says("propeller_" + std::to_string(vehicle.rotors.size())));
        },
        examples::read_vehicle(entry.path()).vehicle);
  }
}

}  // namespace vehicle_exports_test
