#pragma once

#include <tilt_ropter/tilt_ropter.hpp>

#include <cmath>
#include <cstdint>
#include <optional>

/// The loop of examples/getting_started/own_loop.cpp between sensors and actuators, the same source
/// on the desk and on the microcontroller; and the messages between the flight and the loop. These
/// hold only doubles, which both processors store in the same way.
namespace microcontroller {

using namespace tilt_ropter;

enum class Flight { hover, figure_eight, step };

/// The first message to the board.
struct Setup {
  double flight = 0.0;     ///< Flight
  double intervals = 0.0;  ///< of the controller's horizon
  double limit = 0.0;      ///< of instructions of a tick, by the solver's clock; 0: none
};

/// What the sensors give in a millisecond. A stamp that is NaN: no measurement.
struct Sensed {
  double time = 0.0;  ///< [s]; negative: the flight is over
  double imu_stamp = 0.0, imu[6] = {};
  double pose_stamp = 0.0, position[3] = {}, orientation[4] = {};  ///< x, y, z; w, x, y, z
  double rotor_speed[4] = {};                                      ///< measured [rad/s]
};

/// Answer to Sensed: the command, and instructions of each piece in this millisecond.
struct Answer {
  double rotor_speed[4] = {}, tilt_angle[4] = {};
  double filter = 0.0, observer = 0.0, controller = 0.0, allocation = 0.0;
  double ticked = 0.0, solved = 0.0;  ///< 1: the controller ran; and it has solved
};

/// Answer to the end of the flight.
struct Totals {
  double heap_bytes = 0.0, heap_calls_in_flight = 0.0, stack_bytes = 0.0;
  double objects_bytes = 0.0;  ///< of heap_bytes: the loop itself, with filter and observer
};

/// Reference of a flight at 1.5 m.
class Course {
 public:
  explicit Course(Flight flight) : flight_(flight), eight_(eight_settings()) {}
  [[nodiscard]] double duration() const {
    return flight_ == Flight::figure_eight ? eight_.duration()
           : flight_ == Flight::hover      ? 10.0
                                           : 6.0;
  }
  [[nodiscard]] ReferencePoint operator()(double time) const {
    if (flight_ == Flight::figure_eight) return eight_(time);
    ReferencePoint point;
    point.position << (flight_ == Flight::step && time >= 1.0 ? 5.0 : 0.0), 0.0, 1.5;
    return point;
  }

 private:
  static FigureEightSettings eight_settings() {
    FigureEightSettings settings;
    settings.center.z() = 1.5;
    return settings;
  }
  Flight flight_;
  FigureEight eight_;
};

/// `Counter::instructions()` counts what a piece costs.
template <typename Counter>
class ControlLoop {
 public:
  explicit ControlLoop(const Setup& setup)
      : course_(static_cast<Flight>(static_cast<int>(setup.flight))),
        vehicle_(tilt_ropter_vehicle()),
        allocation_(vehicle_),
        actuators_(vehicle_),
        observer_(vehicle_.body, observer_settings(20.0)),
        contact_(vehicle_),
        nmpc_(vehicle_, settings(vehicle_, setup)) {}

  [[nodiscard]] Answer update(const Sensed& sensed) {
    Answer answer;
    if (std::isfinite(sensed.imu_stamp)) {
      InertialSampled sample;
      for (int i = 0; i < 3; ++i) {
        sample.angular_velocity(i) = sensed.imu[i];
        sample.specific_force(i) = sensed.imu[3 + i];
      }
      answer.filter += counted([&] { ekf_.on_imu(sensed.imu_stamp, sample); });
      answer.observer += counted([&] {
        const Eigen::Map<const Eigen::Vector4d> speeds(sensed.rotor_speed);
        const ActuatorState<4>& applied = actuators_.update(sensed.time, sent_.command, speeds);
        observed_ =
            observer_.update(sensed.imu_stamp, ekf_.corrected(sample), allocation_.wrench(applied));
      });
    }
    if (std::isfinite(sensed.pose_stamp)) {
      MarkerPosed pose;
      pose.position << sensed.position[0], sensed.position[1], sensed.position[2];
      pose.orientation = Eigen::Quaterniond(sensed.orientation[0], sensed.orientation[1],
                                            sensed.orientation[2], sensed.orientation[3]);
      answer.filter += counted([&] { ekf_.on_pose(sensed.pose_stamp, pose); });
    }
    if (count_++ % 10 == 0 && ekf_.running()) tick(sensed.time, answer);
    const ActuatorState<4>& command = actuators_.to_send(sent_.command);
    for (int i = 0; i < 4; ++i) {
      answer.rotor_speed[i] = command.rotor_speed(i);
      answer.tilt_angle[i] = command.tilt_angle(i);
    }
    return answer;
  }

 private:
  static NmpcSettings settings(const Vehicle<4>& vehicle, const Setup& setup) {
    NmpcSettings settings = nmpc_settings(vehicle);
    settings.problem.intervals = static_cast<int>(setup.intervals);
    // The flight waits for each answer. The board's clock counts a nanosecond an instruction.
    settings.time_limit = setup.limit > 0.0 ? 1e-9 * setup.limit : HUGE_VAL;
    return settings;
  }

  template <typename Work>
  static double counted(const Work& work) {
    const std::uint64_t before = Counter::instructions();
    work();
    return static_cast<double>(Counter::instructions() - before);
  }

  void tick(double time, Answer& answer) {
    const BodyStated state = ekf_.take_state();
    const ContactEstimate& ground = contact_.update(time, state, observed_);
    answer.controller = counted([&] {
      (void)nmpc_.prepare(time, course_, ground);
      (void)nmpc_.feedback(time, state);
    });
    const NmpcResult& result = nmpc_.result();
    answer.allocation =
        counted([&] { sent_ = allocation_.allocate(time, result.wrench, result.rate, sent_); });
    actuators_.update(time, sent_.command);
    answer.ticked = 1.0;
    answer.solved = result.status == NmpcStatus::solved ? 1.0 : 0.0;
  }

  Course course_;
  Vehicle<4> vehicle_;
  Allocation<4> allocation_;
  ActuatorModel<4> actuators_;
  Ekfd ekf_;
  WrenchObserverd observer_;
  ContactEstimator contact_;
  Nmpc<4> nmpc_;
  AllocationResult<4> sent_;
  ObservedWrenchd observed_;
  int count_ = 0;
};

}  // namespace microcontroller
