// Parameters of a vehicle: rejected, or valid for allocation, power, servos and rotors.

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include "fuzz/input.hpp"

#include <cmath>
#include <optional>

using namespace tilt_ropter;

namespace {

Vehicle<4> any_vehicle(fuzz::Input& input) {
  Vehicle<4> v = tilt_ropter_vehicle();
  input.vary_all(v.body.mass, v.body.inertia, v.rotor.thrust_coefficient, v.rotor.torque_ratio,
                 v.rotor.min_thrust, v.rotor.max_thrust, v.rotor.time_constant,
                 v.servo.time_constant, v.servo.max_rate, v.servo.min_angle, v.servo.max_angle,
                 v.servo.dead_time, v.wheels->radius, v.wheels->half_track, v.power.electronics,
                 v.power.hover);
  input.vary_all(v.rotor.linear_thrust_coefficient, v.battery.nominal_voltage);
  input.vary_all(v.power.servo_hold, v.power.servo_move, v.battery.capacity, v.battery.full_voltage,
                 v.battery.empty_voltage, v.battery.resistance);
  for (RotorGeometry& rotor : v.rotors) {
    input.vary_all(rotor.position, rotor.orientation, rotor.tilts, rotor.effectiveness);
    if (input.coin()) rotor.orientation = input.orientation().toRotationMatrix();
    if (input.integer(0, 7) == 0) rotor.spin = Spin::clockwise;
  }
  return v;
}

void expect_good_allocation(const Vehicle<4>& vehicle, const Allocation<4>& allocation,
                            const Wrenchd& wanted) {
  const auto result = allocation.allocate(0.0, wanted, wanted, {});
  fuzz::expect(all_finite(result.command.rotor_speed) && all_finite(result.command.tilt_angle),
               "commands are finite");
  fuzz::expect(is_finite(result.achieved) && is_finite(result.lost), "wrenches are finite");
  for (int i = 0; i < 4; ++i) {
    const double angle = result.command.tilt_angle(i), speed = result.command.rotor_speed(i);
    fuzz::expect(!vehicle.rotors[static_cast<std::size_t>(i)].tilts ||
                     (angle >= vehicle.servo.min_angle && angle <= vehicle.servo.max_angle),
                 "angles are within the servo's range");
    fuzz::expect(thrust_from_speed(speed, vehicle.rotor) <= vehicle.rotor.max_thrust * (1.0 + 1e-9),
                 "thrusts are within limits");
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  const Vehicle<4> vehicle = any_vehicle(input);
  if (!fuzz::accepted([&] { validate(vehicle); })) return 0;

  std::optional<PowerModel> power;
  if (fuzz::accepted([&] { power.emplace(vehicle); }))
    fuzz::expect(std::isfinite(power->power(Eigen::Vector4d::Constant(1000.0))), "power is finite");
  std::optional<Battery> battery;
  if (fuzz::accepted([&] { battery.emplace(vehicle.battery); })) {
    for (const double wanted : {0.0, vehicle.power.hover, 1e12}) {
      (void)battery->update(1e3 * wanted, wanted);
      const BatteryLoad load = battery->load(wanted);
      fuzz::expect(std::isfinite(load.current) && std::isfinite(load.voltage), "load is finite");
      fuzz::expect(battery->state_of_charge() >= 0.0 && battery->state_of_charge() <= 1.0,
                   "the state of charge is in [0, 1]");
      fuzz::expect(!std::isnan(battery->endurance(wanted)), "endurance is a number");
    }
  }
  Servod servo(vehicle.servo);
  servo.update(0.0, 0.1);
  const double angle = servo.update(0.01, 0.1);
  fuzz::expect(angle >= vehicle.servo.min_angle && angle <= vehicle.servo.max_angle,
               "the servo is in its range");
  Rotord rotor(vehicle.rotor);
  rotor.update(0.0, 1000.0);
  fuzz::expect(std::isfinite(rotor.update(0.01, 1000.0)), "the rotor's speed is finite");

  std::optional<Allocation<4>> allocation;
  if (!fuzz::accepted([&] { allocation.emplace(vehicle); })) return 0;
  expect_good_allocation(vehicle, *allocation,
                         {{0.0, 0.0, vehicle.body.mass * gravity}, Eigen::Vector3d::Zero()});
  expect_good_allocation(vehicle, *allocation, {});
  expect_good_allocation(vehicle, *allocation, {{3.0, -2.0, 15.0}, {0.3, -0.2, 0.1}});
  return 0;
}
