// Flies the plant on the host. The loop runs on the desk, or on the emulated microcontroller: then
// DIRECTORY has the pipes to_board and from_board, and flight_controller is at their other ends.

#include "control_loop.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <memory>
#include <string>
#include <vector>

using namespace microcontroller;

namespace {

struct NotCounted {
  static std::uint64_t instructions() { return 0; }
};

/// The board, at the other ends of two pipes.
class Board {
 public:
  explicit Board(const std::string& directory)
      : to_(std::fopen((directory + "/to_board").c_str(), "wb")),
        from_(std::fopen((directory + "/from_board").c_str(), "rb")) {}
  Board(const Board&) = delete;
  Board& operator=(const Board&) = delete;
  ~Board() {
    for (std::FILE* file : {to_, from_})
      if (file != nullptr) std::fclose(file);
  }

  template <typename Message>
  [[nodiscard]] bool send(const Message& message) const {
    return to_ != nullptr && std::fwrite(&message, sizeof message, 1, to_) == 1 &&
           std::fflush(to_) == 0;
  }
  template <typename Message>
  [[nodiscard]] bool receive(Message& message) const {
    return from_ != nullptr && std::fread(&message, sizeof message, 1, from_) == 1;
  }

 private:
  std::FILE *to_, *from_;
};

/// Sensors of the flight, as in own_loop.cpp.
class Sensors {
 public:
  [[nodiscard]] Sensed sample(const Plant<4>& robot) {
    Sensed sensed;
    sensed.time = robot.time();
    sensed.imu_stamp = sensed.pose_stamp = std::numeric_limits<double>::quiet_NaN();
    if (const auto m =
            imu_.sample(robot.time(), robot.body().angular_velocity, robot.specific_force())) {
      sensed.imu_stamp = m->time;
      std::copy_n(m->angular_velocity.data(), 3, sensed.imu);
      std::copy_n(m->specific_force.data(), 3, sensed.imu + 3);
    }
    if (const auto m = poses_.sample(robot.time(), robot.body())) {
      sensed.pose_stamp = m->time;
      std::copy_n(m->position.data(), 3, sensed.position);
      const Eigen::Quaterniond& q = m->orientation;
      const double entries[] = {q.w(), q.x(), q.y(), q.z()};
      std::copy_n(entries, 4, sensed.orientation);
    }
    std::copy_n(robot.actuators().rotor_speed.data(), 4, sensed.rotor_speed);
    return sensed;
  }

 private:
  ImuSensor imu_{{}, 1};
  PoseSensor poses_{{}, 2};
};

/// Prints mean and largest value.
void print(const char* name, const std::vector<double>& values) {
  double sum = 0.0, worst = 0.0;
  for (const double value : values) {
    sum += value;
    worst = std::max(worst, value);
  }
  const double count = static_cast<double>(std::max<std::size_t>(1, values.size()));
  std::printf("%s_instructions_mean: %.0f\n%s_instructions_worst: %.0f\n", name, sum / count, name,
              worst);
}

/// Flies, with answers by `ask(sensed, answer)`. Returns false if it gave none.
template <typename Ask>
bool fly(const Setup& setup, const Ask& ask) {
  const Course course(static_cast<Flight>(static_cast<int>(setup.flight)));
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation<4> allocation(vehicle);
  const Wrenchd weight{{0.0, 0.0, vehicle.body.mass * gravity}, {0.0, 0.0, 0.0}};
  const Wrenchd wind{{0.5, 1.0, 0.0}, {0.0, 0.0, 0.0}};
  Plant<4> robot(vehicle);
  BodyStated start;
  start.position = course(0.0).position;
  ActuatorState<4> command = allocation.allocate(weight, {}).command;
  robot.reset(start, command);
  Sensors sensors;
  std::vector<double> filter, observer, controller, allocating;
  double squares = 0.0;
  int steps = 0, ticks = 0, solved = 0;
  for (; robot.time() < course.duration(); ++steps) {
    Answer answer;
    if (!ask(sensors.sample(robot), answer)) return false;
    filter.push_back(answer.filter);
    observer.push_back(answer.observer);
    if (answer.ticked > 0.0) {
      controller.push_back(answer.controller);
      allocating.push_back(answer.allocation);
      ++ticks;
      solved += answer.solved > 0.0;
    }
    std::copy_n(answer.rotor_speed, 4, command.rotor_speed.data());
    std::copy_n(answer.tilt_angle, 4, command.tilt_angle.data());
    robot.step(command, wind, 0.001);
    squares += (robot.body().position - course(robot.time()).position).squaredNorm();
  }
  std::printf("rmse_m: %.6f\nticks: %d\nunsolved_ticks: %d\n", std::sqrt(squares / steps), ticks,
              ticks - solved);
  if (filter.front() + observer.back() > 0.0) {  // the board counts
    print("filter", filter);
    print("observer", observer);
    print("controller", controller);
    print("allocation", allocating);
  }
  return true;
}

int use(int status) {
  std::puts(
      "usage: fly FLIGHT INTERVALS [DIRECTORY [LIMIT]]\n\n"
      "Flies hover, figure_eight or step (of 5 m) in a side wind of 1.1 N, with a horizon of\n"
      "INTERVALS of 0.1 s. The loop runs here, or, with DIRECTORY, at the other ends of the pipes\n"
      "to_board and from_board in it. The solver then ends a tick after LIMIT instructions, with\n"
      "its best plan so far. Prints the error and, of the board, the instructions of each piece,\n"
      "heap and stack.");
  return status;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc == 2 && std::string(argv[1]) == "--help") return use(0);
  const std::string flights[] = {"hover", "figure_eight", "step"};
  Setup setup;
  const auto* flight = std::find(flights, flights + 3, argc > 1 ? argv[1] : "");
  setup.flight = static_cast<double>(flight - flights);
  setup.intervals = argc > 2 ? std::atoi(argv[2]) : 0;
  setup.limit = argc > 4 ? std::atof(argv[4]) : 0.0;
  if (argc < 3 || argc > 5 || setup.limit < 0.0 || flight == flights + 3 || setup.intervals < 1.0)
    return use(2);
  if (argc == 3) {
    const auto loop = std::make_unique<ControlLoop<NotCounted>>(setup);
    const auto here = [&](const Sensed& sensed, Answer& answer) {
      answer = loop->update(sensed);
      return true;
    };
    return fly(setup, here) ? 0 : 1;
  }
  const Board board(argv[3]);
  const auto there = [&](const Sensed& sensed, Answer& answer) {
    return board.send(sensed) && board.receive(answer);
  };
  Sensed over;
  over.time = -1.0;
  Totals totals;
  if (!board.send(setup) || !fly(setup, there) || !board.send(over) || !board.receive(totals)) {
    std::fputs("no answer from the board\n", stderr);
    return 1;
  }
  std::printf(
      "heap_bytes: %.0f\nobjects_bytes: %.0f\nheap_calls_in_flight: %.0f\nstack_bytes: %.0f\n",
      totals.heap_bytes, totals.objects_bytes, totals.heap_calls_in_flight, totals.stack_bytes);
  return 0;
}
