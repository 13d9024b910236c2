// What each piece of a loop costs on the microcontroller, in double and in float, and by how much
// the results in float differ: two seconds on a circle, with an IMU at 1 kHz, poses and commands at
// 100 Hz.

#include "board.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/servo.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <string>

using namespace tilt_ropter;

namespace {

constexpr int steps = 2000;

/// Instructions of a piece, over many calls.
class Cost {
 public:
  template <typename Work>
  void count(const Work& work) {
    const std::uint64_t before = board::instructions();
    work();
    const std::uint64_t cost = board::instructions() - before;
    sum_ += cost;
    worst_ = std::max(worst_, cost);
    ++calls_;
  }
  void print(const std::string& name) const {
    board::print((name + "_instructions_mean").c_str(), static_cast<long long>(sum_ / calls_));
    board::print((name + "_instructions_worst").c_str(), static_cast<long long>(worst_));
  }

 private:
  std::uint64_t sum_ = 0, worst_ = 0, calls_ = 0;
};

/// Results at each command, to compare float with double.
struct Results {
  double rotor_speed[steps / 10], servo[steps / 10], force[steps / 10], position[steps / 10];
};

template <typename Scalar>
struct Pieces {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  Allocation<4, Scalar> allocation{vehicle};
  Servo<Scalar> servo{vehicle.servo};
  WrenchObserver<Scalar> observer{vehicle.body, observer_settings(20.0)};
  Ekf<Scalar> ekf;
};

template <typename Scalar>
void run(const std::string& scalar, Results& results) {
  const auto pieces = std::make_unique<Pieces<Scalar>>();
  Cost allocating, moving, observing, predicting, correcting;
  AllocationResult<4, Scalar> sent;
  ObservedWrench<Scalar> observed;
  for (int i = 0; i < steps; ++i) {
    const double t = 0.001 * i;
    const Scalar c = Scalar(std::cos(t)), s = Scalar(std::sin(t));
    InertialSample<Scalar> sample;
    sample.specific_force << -c, -s, Scalar(gravity);
    const Wrench<Scalar> applied = pieces->allocation.wrench(sent.command);
    predicting.count([&] { (void)pieces->ekf.on_imu(t, sample); });
    observing.count([&] { observed = pieces->observer.update(t, sample, applied); });
    moving.count([&] { (void)pieces->servo.update(t, sent.command.tilt_angle(0)); });
    if (i % 10 != 0) continue;
    MarkerPose<Scalar> pose;
    pose.position << c, s, Scalar(1.5);
    correcting.count([&] { (void)pieces->ekf.on_pose(t, pose); });
    Wrench<Scalar> wanted;
    wanted.force << Scalar(2) * c, s, Scalar(pieces->vehicle.body.mass * gravity);
    wanted.torque << Scalar(0), Scalar(0), Scalar(0.1) * s;
    const Wrench<Scalar> rate;
    allocating.count([&] { sent = pieces->allocation.allocate(t, wanted, rate, sent); });
    results.rotor_speed[i / 10] = double(sent.command.rotor_speed(0));
    results.servo[i / 10] = double(pieces->servo.angle());
    results.force[i / 10] = double(observed.external.force.x());
    results.position[i / 10] = double(pieces->ekf.state().position.x());
  }
  allocating.print("allocation_" + scalar);
  moving.print("servo_" + scalar);
  observing.print("observer_" + scalar);
  predicting.print("filter_imu_" + scalar);
  correcting.print("filter_pose_" + scalar);
  board::print(("filter_" + scalar + "_bytes").c_str(), sizeof pieces->ekf);
}

/// Prints the largest difference in billionths of the unit.
void print_difference(const char* name, const double* a, const double* b) {
  double largest = 0.0;
  for (int i = 0; i < steps / 10; ++i) largest = std::max(largest, std::abs(a[i] - b[i]));
  board::print(name, static_cast<long long>(1e9 * largest));
}

}  // namespace

int main() {
  // The counter must count: two instructions a round.
  const std::uint64_t before = board::instructions();
  for (unsigned i = 1000000; i > 0; --i) asm volatile("" : "+r"(i));
  board::print("rounds_1e6_instructions", static_cast<long long>(board::instructions() - before));
  const auto in_double = std::make_unique<Results>(), in_float = std::make_unique<Results>();
  run<double>("double", *in_double);
  run<float>("float", *in_float);
  print_difference("rotor_speed_float_difference_1e9_rad_per_s", in_double->rotor_speed,
                   in_float->rotor_speed);
  print_difference("servo_float_difference_1e9_rad", in_double->servo, in_float->servo);
  print_difference("observer_float_difference_1e9_n", in_double->force, in_float->force);
  print_difference("filter_float_difference_1e9_m", in_double->position, in_float->position);
  board::print("stack_bytes", static_cast<long long>(board::stack_bytes()));
}
