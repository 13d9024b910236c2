// Every limit of the trajectories' settings and arguments, by the name in the message.

#include <tilt_ropter/planning/excitation.hpp>
#include <tilt_ropter/planning/figure_eight.hpp>
#include <tilt_ropter/planning/minimum_snap.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/sampled_path.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include "support/refusals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <cmath>
#include <string>
#include <vector>

namespace tilt_ropter {
namespace planning_settings_test {

using namespace test_support;

const Range times = in_range(-1e10, 1e10);
const Waypoint here{{0.0, 0.0, 1.0}, 0.0};

template <typename Motion>
void expect_start_time_checked(const Motion& motion) {
  expect_range("start_time [s]", times, true,
               [&](double time) { Motion(motion).set_start_time(time); });
}

TEST(PlanningSettings, ExcitationNamesEachField) {
  using S = ExcitationSettings;
  S valid;
  valid.duration = 10.0;
  const Fields<S> check{valid};
  check(
      "ExcitationSettings.center.position [m]", [](S& s, double v) { s.center.position.y() = v; },
      any_finite());
  check(
      "ExcitationSettings.center.yaw [rad]", [](S& s, double v) { s.center.yaw = v; },
      any_finite());
  check("ExcitationSettings.duration [s]", &S::duration,
        {{1e10}, {below(1e-3), above(1e10), not_a_number}});
  check.refuse("ExcitationSettings.ramp [s]", [](S& s) { s.duration = 1e-3; });
  check("ExcitationSettings.ramp [s]", &S::ramp, in_range(1e-3, 5.0));
  check("ExcitationSettings.acceleration [m/s^2]", &S::acceleration, not_negative());
  check("ExcitationSettings.angular_acceleration [rad/s^2]", &S::angular_acceleration,
        not_negative());
  check("ExcitationSettings.max_angle [rad]", &S::max_angle, in_range(1e-6, 0.3));
  valid.max_angle = 0.5;
  expect_refused("ExcitationSettings.max_angle [rad]", [&] { Excitation{valid}; });
  expect_start_time_checked(Excitation());
}

TEST(PlanningSettings, FigureEightNamesEachField) {
  using S = FigureEightSettings;
  S valid;
  valid.amplitude << 1.0, 0.5, 0.0;
  const Fields<S> check{valid};
  check("FigureEightSettings.center [m]", &S::center, any_finite());
  check(
      "FigureEightSettings.amplitude.x [m]",
      [](S& s, double v) { s.amplitude.x() = s.amplitude.y() = v; }, in_range(0.01, 1e4));
  check(
      "FigureEightSettings.amplitude.y [m]", [](S& s, double v) { s.amplitude.y() = v; },
      in_range(0.05, 2.0));
  check(
      "FigureEightSettings.amplitude.z [m]", [](S& s, double v) { s.amplitude.z() = v; },
      in_range(-1e4, 1e4));
  check("FigureEightSettings.direction [rad]", &S::direction, any_finite());
  check("FigureEightSettings.laps", &S::laps, at_least(1));
  S laps = valid;
  laps.laps = 4;
  Fields<S>{laps}("FigureEightSettings.ramp_laps", &S::ramp_laps, in_range(0.05, 1.0));
  laps.laps = 1;
  Fields<S>{laps}("FigureEightSettings.ramp_laps", &S::ramp_laps, in_range(0.05, 0.5));
  check("FigureEightSettings.max_speed [m/s]", &S::max_speed, positive());
  check("FigureEightSettings.max_acceleration [m/s^2]", &S::max_acceleration, positive());
  check("FigureEightSettings.yaw [rad]", &S::yaw, any_finite());
  check("FigureEightSettings.max_yaw_rate [rad/s]", &S::max_yaw_rate, positive());
  laps.laps = 0;
  expect_refused("FigureEightSettings.laps", [&] { FigureEight{laps}; });
  expect_start_time_checked(FigureEight());

  valid.max_speed = 1.0;
  valid.max_acceleration = 1e300;
  const double at_1 = FigureEight(valid).duration();
  expect_range("FigureEight's duration within its limits [s]",
               {{1.001e-3, 0.999e10}, {0.999e-3, 1.001e10}}, false, [&](double duration) {
                 valid.max_speed = at_1 / duration;
                 FigureEight{valid};
               });
}

TEST(PlanningSettings, TransitionNamesEachField) {
  using S = TransitionSettings;
  const Fields<S> check;
  check(
      "TransitionSettings.from.position [m]", [](S& s, double v) { s.from.position.x() = v; },
      any_finite());
  check(
      "TransitionSettings.from.yaw [rad]", [](S& s, double v) { s.from.yaw = v; }, any_finite());
  check(
      "TransitionSettings.to.position [m]", [](S& s, double v) { s.to.position.z() = v; },
      any_finite());
  check(
      "TransitionSettings.to.yaw [rad]", [](S& s, double v) { s.to.yaw = v; }, any_finite());
  check("TransitionSettings.duration [s]", &S::duration, in_range(0.0, 1e10));
  check("TransitionSettings.max_speed [m/s]", &S::max_speed, positive());
  check("TransitionSettings.max_acceleration [m/s^2]", &S::max_acceleration, positive());
  check("TransitionSettings.max_yaw_rate [rad/s]", &S::max_yaw_rate, positive());
  check("TransitionSettings.max_yaw_acceleration [rad/s^2]", &S::max_yaw_acceleration, positive());
  Fields<Waypoint>{}("Waypoint.position [m]", &Waypoint::position, any_finite());
  Fields<Waypoint>{}("Waypoint.yaw [rad]", &Waypoint::yaw, any_finite());

  S moves;
  moves.max_yaw_rate = 0.0;
  expect_refused("TransitionSettings.max_yaw_rate [rad/s]", [&] { Transition{moves}; });
  moves = {};
  moves.to.position.x() = 1.0;
  const double shortest = Transition(moves).duration();
  expect_range("TransitionSettings.duration [s]",
               {{0.0, shortest * (1.0 - 5e-10), 1e10}, {shortest * (1.0 - 2e-9), 0.1}}, false,
               [moves](double duration) mutable {
                 moves.duration = duration;
                 Transition{moves};
               });
  expect_range("Transition's shortest duration within its limits [s]",
               {{below(1e10)}, {above(1e10), 1e300}}, false, [&](double duration) {
                 moves.max_speed = 35.0 / 16.0 / duration;  // the peak is 35/16 of the mean
                 Transition{moves};
               });
  expect_start_time_checked(Transition());
}

TEST(PlanningSettings, TakeOffAndLandingNameTheirArguments) {
  const auto up = [](const Waypoint& from, double height) { (void)take_off(from, height); };
  const auto down = [](const Waypoint& from, double height) { (void)landing(from, height); };
  expect_range("take_off height [m]", {{above(1.0)}, {1.0, 0.5, not_a_number, infinite}}, true,
               [&](double height) { up(here, height); });
  expect_range("landing height [m]", {{below(1.0)}, {1.0, 1.5, not_a_number, -infinite}}, true,
               [&](double height) { down(here, height); });
  const Waypoint nowhere{{0.0, not_a_number, 1.0}, 0.0}, turned{here.position, infinite};
  expect_refused("take_off from.position [m]", [&] { up(nowhere, 2.0); });
  expect_refused("take_off from.yaw [rad]", [&] { up(turned, 2.0); });
  expect_refused("landing from.position [m]", [&] { down(nowhere, 0.5); });
  expect_refused("landing from.yaw [rad]", [&] { down(turned, 0.5); });
}

TEST(PlanningSettings, MinimumSnapNamesEachField) {
  using S = MinimumSnapSettings;
  S valid;
  valid.points = {{0.5, 0.0, 0.0}, {2.0, 0.0, 1.0}, {4.0, 1.0, 1.0}};
  const Fields<S> check{valid};
  check("MinimumSnapSettings.points.size()",
        [](S& s, double v) {
          s.points.clear();
          for (int i = 0; i < v; ++i) s.points.push_back({1.0 * i, 0.0, 0.0});
        },
        {{2.0, 100.0}, {0.0, 1.0, 101.0}});
  for (std::size_t i = 0; i < 3; ++i)
    expect_refused("MinimumSnapSettings.points[" + std::to_string(i) + "] [m]", [&] {
      S s = valid;
      s.points[i].z() = not_a_number;
      validate(s);
    });
  const char* distance = "MinimumSnapSettings.points[1] distance from the point before it [m]";
  check(distance,
        [](S& s, double v) {
          s.points = {{0.0, 0.0, 0.0}, {0.0, v, 0.0}};
        },
        {{0.01, 1e4}, {0.0, below(0.01), above(1e4)}});
  const auto set_stay = [](S& s, double v) {
    s.points = {{0.0, 0.0, 0.0}, {0.0, v, 0.0}};
    s.duration = 1.0;
  };
  check(distance, set_stay, {{0.0, 1e4}, {above(1e4)}});
  check.refuse(distance, [](S& s) {
    s.points[1] = s.points[0];
    s.duration = 1.0;
  });
  check("MinimumSnapSettings.max_speed [m/s]", &S::max_speed, positive());
  check("MinimumSnapSettings.max_acceleration [m/s^2]", &S::max_acceleration, positive());
  check("MinimumSnapSettings.yaw [rad]", &S::yaw, any_finite());
  check("MinimumSnapSettings.max_yaw_rate [rad/s]", &S::max_yaw_rate, positive());
  check("MinimumSnapSettings.duration [s]", &S::duration, in_range(0.0, 1e10));
  const auto check_end = [](const std::string& name, Eigen::Vector3d S::*field) {
    S s;
    s.points = {{0.0, 0.0, 0.0}, {2.0, 0.0, 1.0}};
    s.max_speed = 2.0;  // the acceleration has another limit
    s.max_acceleration = 3.0;
    const double limit = name.find("velocity") != std::string::npos ? 2.0 : 3.0;
    const auto set = [&](double value) {
      s.*field << 0.0, value, 0.0;
      validate(s);
    };
    expect_range(name, {{limit, -limit}, {not_a_number, infinite}}, false, set);
    expect_range(name + " norm", {{}, {above(limit), -above(limit)}}, false, set);
  };
  check_end("MinimumSnapSettings.start_velocity [m/s]", &S::start_velocity);
  check_end("MinimumSnapSettings.end_velocity [m/s]", &S::end_velocity);
  check_end("MinimumSnapSettings.start_acceleration [m/s^2]", &S::start_acceleration);
  check_end("MinimumSnapSettings.end_acceleration [m/s^2]", &S::end_acceleration);
}

TEST(PlanningSettings, MinimumSnapRefusesLimitsThatNoPathKeeps) {
  MinimumSnapSettings s;
  s.points = {{0.0, 0.0, 1.0}, {0.0, 0.0, 2.0}};
  expect_refused("MinimumSnapSettings.max_speed [m/s]", [s]() mutable {
    s.max_speed = 0.0;
    MinimumSnap{s};
  });
  expect_start_time_checked(MinimumSnap(s));
  const double shortest = MinimumSnap(s).duration();
  expect_range("MinimumSnapSettings.duration [s]", {{0.0, shortest}, {0.98 * shortest}}, false,
               [s](double duration) mutable {
                 s.duration = duration;
                 MinimumSnap{s};
               });
  expect_refused("MinimumSnapSettings' limits", [s]() mutable {  // straight up is no heading
    s.heading = HeadingMode::along_velocity;
    MinimumSnap{s};
  });
  s.max_speed = 1.0;
  s.max_acceleration = 1e30;
  const double at_1 = MinimumSnap(s).duration();
  expect_range("MinimumSnap's duration within its limits [s]",
               {{1.02e-3, 0.98e10}, {0.98e-3, 1.02e10}}, false, [&](double duration) {
                 s.max_speed = at_1 / duration;
                 MinimumSnap{s};
               });
}

TEST(PlanningSettings, StopNamesItsArguments) {
  const auto call = [](const ReferencePoint& from) { (void)stop(from, 1.0); };
  ReferencePoint from;
  from.position.x() = not_a_number;
  expect_refused("stop: position [m]", [&] { call(from); });
  from = {};
  from.velocity.z() = infinite;
  expect_refused("stop: velocity [m/s]", [&] { call(from); });
  expect_range("stop: max_acceleration [m/s^2]", {{1.0}, {0.0, -1.0, not_a_number, infinite}}, true,
               [](double limit) { (void)stop({}, limit); });
  from = {};
  expect_range("stop: acceleration [m/s^2]", {{0.99}, {1.0, 2.0, not_a_number}}, true,
               [&](double acceleration) {
                 from.acceleration.y() = acceleration;
                 call(from);
               });
}

TEST(PlanningSettings, SampledPathNamesTheSample) {
  const std::vector<PathSample> valid{{0.0, here.position, 0.0}, {1.0, here.position, 0.0}};
  using Set = void (*)(std::vector<PathSample>&, double);
  const auto check = [&](const std::string& name, Set set, const Range& range) {
    expect_range("SampledPath.samples" + name, range, false, [&](double value) {
      std::vector<PathSample> samples = valid;
      set(samples, value);
      SampledPath{samples};
    });
  };
  check(".size()", [](auto& s, double v) { s.resize(static_cast<std::size_t>(v)); },
        {{2.0}, {0.0, 1.0}});
  check("[0].time [s]", [](auto& s, double v) { s[0].time = v; }, {{-1e10}, {below(-1e10)}});
  check("[1].time [s]", [](auto& s, double v) { s[1].time = v; },
        {{1e-6, 1e10}, {below(1e-6), 0.0, -1.0, above(1e10), not_a_number}});
  check(
      "[1].position [m]", [](auto& s, double v) { s[1].position.y() = v; }, any_finite());
  check(
      "[1].yaw [rad]", [](auto& s, double v) { s[1].yaw = v; }, any_finite());
  const SampledPath path(valid);
  expect_start_time_checked(path);
  expect_range("SampledPath::part from [s]", in_range(0.0, 1.0), true,
               [&](double from) { (void)path.part(from, 1.0); });
  expect_range("SampledPath::part until [s]", in_range(0.5, 1.0), true,
               [&](double until) { (void)path.part(0.5, until); });
}

TEST(PlanningSettings, HoldAndMissionNameTheirArguments) {
  expect_range("Hold.duration [s]", in_range(1e-3, 1e10), true, [](double duration) {
    Hold{here, duration};
  });
  expect_range("Hold.place.position [m]", any_finite(), false, [](double v) {
    Hold{{{0.0, v, 0.0}, 0.0}, 1.0};
  });
  expect_range("Hold.place.yaw [rad]", any_finite(), true, [](double v) {
    Hold{{here.position, v}, 1.0};
  });
  const Hold rest(here, 1.0);
  expect_start_time_checked(rest);
  expect_refused(
      "Mission.segments.size()", [] { Mission{std::vector<MissionSegment>{}}; }, "0:");
  expect_accepted([&] { Mission{{{MissionPhase::air, rest}}}; });
  const std::string name = "Mission.segments[1] (air) ";
  const Range joins{{0.9e-6}, {1.1e-6, 0.1}};
  expect_range(name + "distance from the end of the segment before it [m]", joins, false,
               [&](double gap) {
                 const Hold next({{0.0, gap, 1.0}, 0.0}, 1.0);
                 Mission{{{MissionPhase::hover, rest}, {MissionPhase::air, next}}};
               });
  expect_range(name + "turn from the end of the segment before it [rad]", joins, false,
               [&](double angle) {
                 const Hold next({here.position, angle}, 1.0);
                 Mission{{{MissionPhase::hover, rest}, {MissionPhase::air, next}}};
               });
  MinimumSnapSettings moving;
  moving.points = {here.position, {2.0, 0.0, 1.0}};
  expect_range(name + "change of velocity from the segment before it [m/s]", joins, false,
               [&](double jump) {
                 moving.start_velocity.x() = jump;
                 const MinimumSnap next(moving);
                 Mission{{{MissionPhase::hover, rest}, {MissionPhase::air, next}}};
               });
}

TEST(PlanningSettings, HybridMissionNamesEachField) {
  using S = HybridMissionSettings;
  const Fields<S> check;
  check(
      "HybridMissionSettings.origin [m]", [](S& s, double v) { s.origin.x() = v; }, any_finite());
  check("HybridMissionSettings.yaw [rad]", &S::yaw, any_finite());
  check("HybridMissionSettings.direction [rad]", &S::direction, any_finite());
  check("HybridMissionSettings.flight_height [m]", &S::flight_height, any_finite());
  check("HybridMissionSettings.rest_time [s]", &S::rest_time, in_range(1e-3, 1e10));
  check("HybridMissionSettings.hover_time [s]", &S::hover_time, in_range(1e-3, 1e10));
  check("HybridMissionSettings.laps", &S::laps, at_least(1));
  check("HybridMissionSettings.max_speed [m/s]", &S::max_speed, positive());
  check("HybridMissionSettings.max_acceleration [m/s^2]", &S::max_acceleration, positive());
  check("HybridMissionSettings.max_yaw_rate [rad/s]", &S::max_yaw_rate, positive());
  check("HybridMissionSettings.start_time [s]", &S::start_time, times);

  const Undercarriage stands{0.5, false, false, false};
  expect_refused(
      "Undercarriage.height [m]",
      [] {
        (void)hybrid_mission(Undercarriage{0.0, false, false, false});
      },
      "0:");
  S s;
  s.air_amplitude.z() = 0.0;
  expect_range("HybridMissionSettings.flight_height [m]", {{0.501}, {0.5, 0.4}}, true,
               [&](double height) {
                 s.flight_height = height;
                 (void)hybrid_mission(stands, s);
               });
  s.flight_height = 1.5;
  expect_range("HybridMissionSettings.air_amplitude.z [m]",
               {{below(1.0), above(-1.0)}, {1.0, -1.0, 2.0, not_a_number}}, true,
               [&](double amplitude) {
                 s.air_amplitude.z() = amplitude;
                 (void)hybrid_mission(stands, s);
               });
  s = {};
  s.ground_amplitude.y() = 9.0;
  expect_refused(
      "FigureEightSettings.amplitude.y [m]", [&] { (void)hybrid_mission(Undercarriage{}, s); },
      "9:");
}

}  // namespace planning_settings_test
}  // namespace tilt_ropter
