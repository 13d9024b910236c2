// The PX4 node rehearses with the vehicle of TILT_ROPTER_VEHICLE, or with shipped ones: take-off, a
// silence, a reset of PX4's estimate, a kill of 0.1 s, landing.
// CTest: dds flight optimised

#include "../../examples/integrations/px4_node.hpp"
#include "support/px4_vehicle.hpp"

#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <variant>
#include <vector>

namespace loops {
namespace rehearsal_test {

using Eigen::Vector3d;

template <int Rotors>
void rehearse(const tilt_ropter::Vehicle<Rotors>& vehicle, const examples::VehicleFile& file) {
  Parameters parameters{
      {"use_sim_time", "true"}, {"thrust_model_factor", "0.3"}, {"origin_height", "0.07"}};
  test_support::AnyPx4Vehicle<Rotors> flown(5000000000LL, vehicle);
  Px4Node<Rotors> node(vehicle, file, parameters);
  const auto& body = flown.plant.body();
  bool armed = false;
  double tilt = 0.0;
  float output = 0.0F;
  const auto fly = [&](double seconds) {
    for (long i = 0; i < std::lround(1000.0 * seconds); ++i) {
      const long ms = std::lround(1000.0 * flown.plant.time());
      flown.sense(node);
      ASSERT_TRUE(flown.step());
      if (ms % 500 == 0) node.on_status(flown.status(armed, armed));
      const Vector3d up = body.orientation * Vector3d::UnitZ();
      tilt = std::max(tilt, std::acos(std::clamp(up.z(), -1.0, 1.0)));
      if (ms % 10 != 0) continue;
      const auto out = node.tick(flown.now());
      if (!out.actuators) continue;
      using namespace px4_msgs::msg;
      flown.on_motors(px4_controls<ActuatorMotors>(out.actuators->motor, out.now, out.sample));
      flown.on_servos(px4_controls<ActuatorServos>(out.actuators->servo, out.now, out.sample));
      for (int k = 0; k < Rotors; ++k) output = std::max(output, flown.last_motors.control[k]);
    }
  };
  const auto off = [&] {
    return (body.position + flown.position_error() - node.snapshot(0).reference.position).norm();
  };
  fly(2.0);
  armed = true;
  fly(6.0);
  const double hover = off();
  EXPECT_LT(hover, 0.05);
  flown.estimating = false;
  fly(0.25);
  flown.estimating = true;
  fly(3.0);
  EXPECT_LT(off(), 0.05) << "after a silence";
  flown.reset_estimate({1.0, -0.5, 0.0}, 0.1);
  fly(4.0);
  EXPECT_LT(off(), 0.05) << "after a reset of PX4's estimate";
  flown.by_another.rotor_speed.setZero();
  flown.obey(false);
  fly(0.1);
  flown.obey(true);
  fly(4.0);
  EXPECT_LT(off(), 0.05) << "after a kill";
  node.on_land({true});
  fly(10.0);
  EXPECT_STREQ(node.snapshot(0).activity, "landed");
  EXPECT_LT(body.velocity.norm(), 0.05);
  EXPECT_EQ(flown.wrong_outputs, 0);
  std::printf("%s: hover %.0f mm, largest tilt %.1f deg, largest motor output %.2f\n",
              file.name.c_str(), 1e3 * hover, tilt * 180.0 / tilt_ropter::pi, double(output));
}

TEST(Rehearsal, TakesOffBearsFaultsAndLands) {
  std::vector<std::string> paths{VEHICLES_DIR "/tilt_ropter.json", VEHICLES_DIR "/quadrotor.json"};
  if (const char* of_the_user = std::getenv("TILT_ROPTER_VEHICLE")) paths = {of_the_user};
  for (const std::string& path : paths) {
    SCOPED_TRACE(path);
    const examples::VehicleFile file = examples::read_vehicle(path);
    std::visit(
        [&](auto vehicle) {
          if (!undercarriage(vehicle)) vehicle.legs.emplace();
          rehearse(vehicle, file);
        },
        file.vehicle);
  }
}

}  // namespace rehearsal_test
}  // namespace loops
