// Allocation and wrench observer alone, as a module of PX4 would have them beside its own filter:
// for the size of the code. With -DEMPTY nothing: the difference is what the module costs.

#include "board.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>

using namespace tilt_ropter;

#ifndef EMPTY
namespace {

struct Module {
  Allocation<4, SCALAR> allocation{tilt_ropter_vehicle()};
  WrenchObserver<SCALAR> observer{tilt_ropter_vehicle().body, observer_settings(20.0)};
};

// Of a topic, and to one. Volatile, so that the compiler keeps the work.
volatile SCALAR wanted[6], imu[6], commands[8];

}  // namespace
#endif

int main() {
#ifndef EMPTY
  static Module module;
  AllocationResult<4, SCALAR> sent;
  for (int i = 0; i < 100; ++i) {
    const double time = 0.001 * i;
    InertialSample<SCALAR> sample;
    Wrench<SCALAR> wrench, rate;
    for (int j = 0; j < 3; ++j) {
      sample.angular_velocity(j) = imu[j];
      sample.specific_force(j) = imu[3 + j];
      wrench.force(j) = wanted[j];
      wrench.torque(j) = wanted[3 + j];
    }
    const auto& observed =
        module.observer.update(time, sample, module.allocation.wrench(sent.command));
    wrench.force -= observed.external.force;
    wrench.torque -= observed.external.torque;
    sent = module.allocation.allocate(time, wrench, rate, sent);
    for (int j = 0; j < 4; ++j) {
      commands[j] = sent.command.rotor_speed(j);
      commands[4 + j] = sent.command.tilt_angle(j);
    }
  }
  board::print("objects_bytes", sizeof module);
#endif
  board::print("heap_bytes", static_cast<long long>(board::heap_bytes()));
  board::print("stack_bytes", static_cast<long long>(board::stack_bytes()));
}
