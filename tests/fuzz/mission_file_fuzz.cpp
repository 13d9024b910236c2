// Reader of mission files: any bytes give a mission without jumps, or an error with the file's
// name.

#include "../../examples/support/mission_file.hpp"
#include "fuzz/input.hpp"

#include <tilt_ropter/math/detail/finite.hpp>
#include <tilt_ropter/model/vehicle.hpp>

#include <algorithm>
#include <cmath>
#include <optional>
#include <sstream>
#include <string>

using namespace tilt_ropter;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  std::string text = input.rest();
  // Most fuzzer inputs are not JSON. An input that starts with '!' changes one place of a good
  // file.
  const std::string good =
      R"({"name":"x","start":{"position_m":[0,0],"yaw_deg":0},"segments":[)"
      R"({"type":"rest","duration_s":1},{"type":"take_off","height_m":1.5},)"
      R"({"type":"way_points","points_m":[[1.5,0,1.2],[3,1.5,1.8]],"max_speed_mps":1.5},)"
      R"({"type":"go_to","position_m":[1,1,1],"yaw_deg":9},{"type":"hover","duration_s":1},)"
      R"({"type":"land","max_speed_mps":0.4},{"type":"turn"},{"type":"way_points",)"
      R"("points_m":[[0,3],[-1,2]],"end_velocity_mps":"next"},{"type":"figure_eight",)"
      R"("amplitude_m":[1.5,0.5],"direction_deg":180,"laps":1,"ends_moving":true},)"
      R"({"type":"stop","max_acceleration_mps2":1}]})";
  if (text.size() > 4 && text[0] == '!') {
    const auto byte = [&text](std::size_t i) { return static_cast<unsigned char>(text[i]); };
    const std::size_t at = (256U * byte(1) + byte(2)) % good.size();
    text =
        good.substr(0, at) + text.substr(4) + good.substr(std::min(good.size(), at + byte(3) % 32));
  }
  if (text.find("trajectory") != std::string::npos) return 0;  // reads other files
  std::istringstream in(text);
  try {
    const Mission mission =
        examples::read_mission(in, "file", undercarriage(tilt_ropter_vehicle()));
    for (int i = 0; i <= 20; ++i) {
      const ReferencePoint p = mission(mission.start_time() + mission.duration() * i / 20);
      fuzz::expect(
          all_finite(p.position) && all_finite(p.velocity) && all_finite(p.orientation.coeffs()),
          "references are finite");
      fuzz::expect(p.position.z() >= 0.1, "references are not below the ground");
    }
  } catch (const examples::MissionFileError& error) {
    fuzz::expect(std::string(error.what()).rfind("file: ", 0) == 0, "an error says where");
  }
  return 0;
}
