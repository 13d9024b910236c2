#pragma once

#include "mission_choice.hpp"
#include "mission_figures.hpp"
#include "solver_choice.hpp"
#include "vehicle_choice.hpp"
#include "vehicle_spread.hpp"

#include <tilt_ropter/actuation/failure_detector.hpp>

#include <cstdint>
#include <string>
#include <vector>

/// The hybrid mission flown by one vehicle of a Monte Carlo run, and the result of the flight.
namespace examples {

/// Result of a flight; all values but the first are divergences.
enum class Verdict {
  ok,
  not_finite,  ///< the plant failed: a number was not finite
  lost,        ///< more than 2 m from the reference
  tipped,      ///< tilted by more than 60 degrees
  grounded     ///< contact where it should fly, or ended more than 5 cm above the ground
};

[[nodiscard]] constexpr const char* to_string(Verdict verdict) noexcept {
  switch (verdict) {
    case Verdict::ok:
      return "ok";
    case Verdict::not_finite:
      return "not_finite";
    case Verdict::lost:
      return "lost";
    case Verdict::tipped:
      return "tipped";
    case Verdict::grounded:
      return "grounded";
  }
  return "unknown";
}

/// Errors refer to the point that the controller assumes to be the CoM.
struct FlightRecord {
  Verdict verdict = Verdict::ok;
  double time = 0.0, duration = 0.0;  ///< flight time, and that of the whole mission [s]
  double air_rmse = 0.0, ground_rmse = 0.0, mission_rmse = 0.0;  ///< [m]
  double max_error = 0.0;                                        ///< [m]
  double flight_power = 0.0, ground_power = 0.0;                 ///< mean power [W]
  double touchdown_speed = 0.0;  ///< largest of all touchdowns [m/s]
  int mode_changes = 0, solver_failures = 0;
  SolverTicks solver;
  tilt_ropter::ActuatorFailure failure;  ///< that the controller found
  /// 1 if it found one; none fails, but servos may be slow.
  int false_alarms = 0;
  MissionFigures figures{0.0};  ///< to the end of the flight
};

/// What flies, if it is not the hybrid mission with a vehicle from the whole spread.
struct SpreadChoice {
  MissionChoice mission;
  double start_off = 0.0;                ///< see MissionOptions [m]
  std::vector<std::string> as_in_paper;  ///< see paper_switches()
  double fraction = 1.0;                 ///< of the ranges of VehicleDraw, see narrowed()
  std::string mcap;                      ///< MCAP file beside the logs, or empty
};

/// A vehicle and its flight.
struct SpreadFlight {
  VehicleDraw draw;
  FlightRecord record;
};

/// Draws vehicle `index` of `seed` and flies the mission of `choice` with it, or the part of the
/// hybrid mission that it can do, while the controller assumes the vehicle of `file`. `level`:
/// "wrench" or "actuator", see level_for(). `solver`: see add_solver_in_real_time(). With a
/// `log_directory`, writes the logs of hybrid_mission there. The same arguments give exactly the
/// same result, with and without logs, in any thread. Compiled only once, in spread_flight.cpp,
/// because with fused multiply-add (-march=native) two copies can differ by rounding errors. Throws
/// std::runtime_error if a log cannot be written.
[[nodiscard]] SpreadFlight fly_spread(const VehicleFile& file, const std::string& level,
                                      const std::string& solver, std::uint64_t seed,
                                      std::uint64_t index, const std::string& log_directory = "",
                                      const SpreadChoice& choice = {});

}  // namespace examples
