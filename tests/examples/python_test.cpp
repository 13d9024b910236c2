// The module of Python and its example, run as a user does.
// CTest: flight python

#include "support/program.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <string>

namespace python_test {

using test_support::Outcome;

Outcome python(const std::string& arguments) {
  return test_support::run("env", "PYTHONPATH='" PYTHON_MODULE_DIR "' '" PYTHON_PROGRAM "' " +
                                      arguments);  // set by CMake
}

class Python : public testing::Test {
 protected:
  [[nodiscard]] Outcome script(const std::string& text) const {
    const std::string start =
        "import numpy as np, tilt_ropter as tr\n"
        "vehicle = tr.Vehicle()\nallocation = tr.Allocation(vehicle)\n"
        "observer = tr.WrenchObserver(vehicle)\nnmpc = tr.Nmpc(vehicle)\n"
        "plant = tr.Plant(vehicle)\n"
        "def tick(reference, state=None):\n"
        "  o = observer.update(plant.time, plant.angular_velocity, plant.specific_force,\n"
        "                      np.zeros(6))\n"
        "  return nmpc.step(plant.time, state or plant.state, reference, o)\n";
    return python("'" + directory.write("script.py", start + text) + "'");
  }

  test_support::Directory directory{"python"};
};

const std::string example = "'" MISSIONS_DIR "/../python/fly_eight.py' ";

TEST_F(Python, FliesTheFigureEight) {
  const Outcome flown = python(example + "--seconds 8 --wind 2");
  ASSERT_EQ(flown.exit_code, 0) << flown.output;
  EXPECT_LT(flown["rmse_m"], 0.02);
  EXPECT_LT(flown["error_max_m"], 0.06);
  EXPECT_TRUE(flown.says("external_force_n: [") && flown.says(" 2.")) << flown.output;
  EXPECT_NE(python(example + "--seconds 1 --wind 0").figures,
            python(example + "--seconds 1").figures);
}

TEST_F(Python, ExampleTakesAVehicleFileAndHasHelp) {
  const Outcome other =
      python(example + "--seconds 1 --vehicle '" VEHICLES_DIR "/tilting_x_quadrotor.json'");
  EXPECT_EQ(other.exit_code, 0) << other.output;
  EXPECT_NE(python(example + "--seconds 1")["rmse_m"], other["rmse_m"]);
  const Outcome missing = python(example + "--vehicle nowhere.json");
  EXPECT_EQ(missing.exit_code, 1);
  EXPECT_TRUE(missing.says("nowhere.json")) << missing.output;
  const Outcome help = python(example + "--help");
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_TRUE(help.says("--vehicle") && help.says("--seconds") && help.says("--wind"));
}

TEST_F(Python, AReferenceThatRaisesEndsTheFlightWithItsErrorNotTheProcess) {
  const Outcome run = script(
      "def bad(time):\n  raise KeyError('no way point')\n"
      "def good(time):\n  return tr.Reference(position=[0.0, 0.0, 1.0])\n"
      "for reference in bad, lambda time: None, lambda time: 1.0:\n"
      "  try:\n    tick(reference)\n    print('nothing')\n"
      "  except Exception as error:\n    print('caught:', type(error).__name__, error)\n"
      "print('after:', tick(good).has_plan)\n");
  EXPECT_EQ(run.exit_code, 0) << run.output;
  EXPECT_TRUE(run.says("caught: KeyError 'no way point'")) << run.output;
  EXPECT_FALSE(run.says("nothing")) << run.output;
  EXPECT_EQ(run.figures.at("after"), "True");
}

TEST_F(Python, RefusesWhatTheLibraryRefuses) {
  const Outcome run = script(
      "good = lambda time: tr.Reference(position=[0.0, 0.0, 1.0])\n"
      "lost = tr.State()\nlost.position = [np.nan, 0.0, 0.0]\n"
      "print('lost:', tick(good, lost).has_plan)\n"
      "for call in (lambda: tr.Nmpc(vehicle, time_limit=-1.0), lambda: plant.step(tr.Actuators(), "
      "np.nan),\n"
      "             lambda: allocation.allocate(np.zeros(5)), lambda: "
      "tr.Vehicle('/proc/nowhere')):\n"
      "  try:\n    call()\n    print('nothing')\n"
      "  except (ValueError, TypeError, RuntimeError) as error:\n    print('refused')\n");
  EXPECT_EQ(run.exit_code, 0) << run.output;
  EXPECT_EQ(run.figures.at("lost"), "False");
  EXPECT_FALSE(run.says("nothing")) << run.output;
}

TEST_F(Python, AllocatesAsInCpp) {
  const Outcome run = script(
      "sent = allocation.allocate(np.array([1.0, 2.0, 15.0, 0.1, 0.2, 0.3]))\n"
      "print('speed:', float(sent.command.rotor_speed[2]))\n"
      "print('angle:', float(sent.command.tilt_angle[1]))\n"
      "print('status:', sent.status)\n"
      "print('back:', float(np.abs(allocation.wrench(sent.command) - sent.achieved).max()))\n"
      "q = tr.Reference(position=np.zeros(3))\nq.orientation = [2.0, 0.0, 0.0, 2.0]\n"
      "print('yaw:', q.orientation[3])\n");
  EXPECT_EQ(run.exit_code, 0) << run.output;
  using namespace tilt_ropter;
  const auto sent = Allocation<4>(tilt_ropter_vehicle())
                        .allocate({{1.0, 2.0, 15.0}, {0.1, 0.2, 0.3}}, ActuatorState<4>{});
  EXPECT_NEAR(run["speed"], sent.command.rotor_speed(2), 1e-9);
  EXPECT_NEAR(run["angle"], sent.command.tilt_angle(1), 1e-12);
  EXPECT_EQ(run.figures.at("status"), to_string(sent.status));
  EXPECT_LT(run["back"], 1e-9);
  EXPECT_NEAR(run["yaw"], 0.70711, 1e-5);
}

}  // namespace python_test
