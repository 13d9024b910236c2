// Reader of vehicle files: any bytes give a vehicle that the library accepts, or an error with the
// file's name.

#include "../../examples/support/vehicle_choice.hpp"
#include "fuzz/input.hpp"

#include <sstream>
#include <variant>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  std::string text = input.rest();
  // Most fuzzer inputs are not JSON. An input that starts with '!' changes one place of a good
  // file.
  const std::string good =
      R"({"name":"x","body":{"mass_kg":1,"inertia_kg_m2":[0.01,0.01,0.01]},"rotor":)"
      R"({"thrust_coefficient_n_s2_per_rad2":1e-6,"torque_ratio_m":0.01,"min_thrust_n":0,)"
      R"("linear_thrust_coefficient_n_s_per_rad":1e-4,"max_thrust_n":9,"time_constant_s":0.03},"servo":{"time_constant_s":0.1,)"
      R"("max_rate_radps":8,"min_angle_deg":-180,"max_angle_deg":180,"dead_time_s":0},"rotors":[)"
      R"({"azimuth_deg":0,"length_m":0.2,"max_thrust_n":8,"spin":"clockwise","tilts":true},)"
      R"({"azimuth_deg":90,"length_m":0.2,"spin":"counter_clockwise","tilts":true},)"
      R"({"azimuth_deg":180,"length_m":0.2,"spin":"clockwise","tilts":true},)"
      R"({"position_m":[0,-0.2,0],"thrust_axis":[0,0,1],"arm_axis":[0,-1,0],)"
      R"("spin":"counter_clockwise","tilts":true}],"wheels":null,"battery_nominal_v":20,)"
      R"("battery_capacity_ah":5,"battery_full_v":25,"battery_empty_v":20,)"
      R"("battery_resistance_ohm":0.01,"power":{"electronics_w":20,"hover_w":300,)"
      R"("servo_hold_w":0.5,"servo_move_j_per_rad":0.3}})";
  if (text.size() > 3 && text[0] == '!') {
    const std::size_t at = 4 * static_cast<unsigned char>(text[1]) % good.size();
    text = good.substr(0, at) + text.substr(3) +
           good.substr(std::min(good.size(), at + static_cast<unsigned char>(text[2]) % 32));
  }
  std::istringstream in(text);
  try {
    const examples::VehicleFile file = examples::read_vehicle(in, "file");
    std::visit([](const auto& vehicle) { validate(vehicle); }, file.vehicle);
    validate(file.settings());
  } catch (const examples::VehicleFileError& error) {
    fuzz::expect(std::string(error.what()).rfind("file: ", 0) == 0, "an error says where");
  }
  return 0;
}
