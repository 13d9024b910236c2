#pragma once

#include "../../examples/integrations/px4_node.hpp"
#include "px4_autopilot.hpp"

#include <tilt_ropter/math/rotation.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <functional>
#include <optional>
#include <string>
#include <utility>

namespace test_support {

/// A vehicle with PX4, a node, a line between them and a pilot.
struct Px4Flight {
  explicit Px4Flight(std::string mission_file = "", std::string of_control = "")
      : mission(std::move(mission_file)), level(std::move(of_control)) {
    px4.vehicle.voltage = tilt_ropter::tilt_ropter_vehicle().battery.nominal_voltage;
    start_node();
  }

  void start_node() {
    parameters = loops::Parameters{
        {"use_sim_time", "true"}, {"origin_height", "0.07"}, {"thrust_model_factor", "0.3"},
        {"hover_x", "0.3"},       {"hover_y", "0.6"},        {"hover_z", "1.5"},
        {"mission", mission},     {"level", level},          {"voltage_compensation", "true"}};
    node.emplace(tilt_ropter::tilt_ropter_vehicle(), examples::VehicleFile{}, parameters);
  }

  void fly(double seconds) {
    if (meanwhile) {
      const auto event = std::exchange(meanwhile, nullptr);
      fly(0.5 * seconds);
      event();
      return fly(0.5 * seconds);
    }
    for (int i = 0; i < std::lround(1000.0 * seconds); ++i) {
      px4.sense(*node, heard);
      ASSERT_TRUE(px4.step());
      judge();
      if (std::lround(1000.0 * px4.time()) % 10 != 0) continue;
      const auto out = node->tick(px4.vehicle.now());
      px4.take(out, hears);
      if (const auto shown = node->snapshot(0); out.actuators && px4.time() - killed_ > 3.0)
        sag = std::max(sag, shown.reference.position.z() - body().position.z() -
                                px4.vehicle.position_error().z());
    }
  }

  /// Take-off to the hover point, with the pilot's hands.
  void take_off() {
    fly(1.5);
    px4.wants_offboard = true;
    ASSERT_TRUE(px4.arm());
    fly(4.5);
    ASSERT_LT((body().position - Eigen::Vector3d(0.3, 0.6, 1.5)).norm(), 0.05);
  }

  /// What the pilot did not cause: from 3 s after the kill switch, or after arming, on.
  void judge() {
    if (px4.kills || !px4.armed()) killed_ = px4.time();
    if (px4.time() - killed_ < 3.0) return;
    const Eigen::Vector3d up = body().orientation * Eigen::Vector3d::UnitZ();
    tilt = std::max(tilt, std::acos(std::clamp(up.z(), -1.0, 1.0)) * 180.0 / tilt_ropter::pi);
    fastest_fall = std::max(fastest_fall, -body().velocity.z());
  }

  [[nodiscard]] const tilt_ropter::BodyStated& body() const { return px4.vehicle.plant.body(); }

  std::string mission, level;
  Px4Autopilot px4{5000000000LL};
  loops::Parameters parameters;
  std::optional<loops::Px4Node<4>> node;
  std::function<void()> meanwhile;  ///< happens in the middle of the next fly()
  bool heard = true, hears = true;  ///< the two directions of the line
  double heading_error = 0.0;       ///< of PX4's estimate [rad]
  double tilt = 0.0;                ///< largest [deg]
  double sag = 0.0;                 ///< below the node's own reference [m]
  double fastest_fall = 0.0;        ///< [m/s]

 private:
  double killed_ = 0.0;
};

}  // namespace test_support
