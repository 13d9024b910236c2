// Largest stack use of the functions of the loop. It matters for threads with a small stack, and
// for threads that must touch their stack before the loop starts.

#include "support/sanitizer.hpp"
#include "support/simulated_time.hpp"

#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>

#include <gtest/gtest.h>
#include <pthread.h>

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <memory>

namespace tilt_ropter {
namespace stack_in_the_loop_test {

struct Free {
  void operator()(void* memory) const { std::free(memory); }
};

void* call(void* function) {
  (*static_cast<const std::function<void()>*>(function))();
  return nullptr;
}

/// Returns the stack use of a call [bytes]. The call runs in a thread whose stack is filled with a
/// known byte first.
std::size_t stack_of(const std::function<void()>& function) {
  constexpr std::size_t size = 1 << 21;
  constexpr unsigned char paint = 0xA5;
  const std::unique_ptr<unsigned char, Free> memory(
      static_cast<unsigned char*>(std::aligned_alloc(4096, size)));
  std::fill_n(memory.get(), size, paint);
  pthread_attr_t attributes;
  pthread_attr_init(&attributes);
  EXPECT_EQ(pthread_attr_setstack(&attributes, memory.get(), size), 0);
  pthread_t thread{};
  EXPECT_EQ(
      pthread_create(&thread, &attributes, call, const_cast<std::function<void()>*>(&function)), 0);
  EXPECT_EQ(pthread_join(thread, nullptr), 0);
  pthread_attr_destroy(&attributes);
  const unsigned char* deepest =
      std::find_if(memory.get(), memory.get() + size, [](unsigned char b) { return b != paint; });
  return static_cast<std::size_t>(memory.get() + size - deepest);
}

TEST(StackInTheLoop, StaysWithinDocumentedLimit) {
  if (test_support::under_address_sanitizer()) GTEST_SKIP() << "sanitizers make frames larger";
  const std::size_t thread_itself = stack_of([] {});
  const auto most = [&](const std::function<void()>& function) {
    return static_cast<double>(stack_of(function) - thread_itself) / 1024.0;
  };
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const Allocation<4> allocation(vehicle);
  ActuatorModel<4> actuators(vehicle);
  WrenchObserverd observer(vehicle.body);
  Ekfd ekf;
  double controller = 0.0;
  for (const auto method :
       {optimal_control::ProgramMethod::automatic, optimal_control::ProgramMethod::nlopt,
        optimal_control::ProgramMethod::structured}) {
    NmpcSettings settings = test_support::in_simulated_time();
    settings.solver.program.method = method;
    settings.problem.bounds.force_rate.setConstant(3.0);  // many active constraints
    Nmpc<4> nmpc(vehicle, settings);
    for (int tick = 0; tick < 20; ++tick) {
      BodyStated state;
      state.position << 0.3 * tick, 0.0, tick < 10 ? 1.0 : 0.05;
      controller = std::max(controller, most([&] {
                              const double time = 0.01 * tick;
                              ContactEstimate contact;
                              contact.on_ground = tick >= 10;
                              (void)nmpc.prepare(
                                  time, [](double) { return ReferencePoint(); }, contact);
                              (void)nmpc.feedback(time, state);
                              (void)nmpc.between_ticks(time + 0.001, state);
                            }));
    }
  }
  const double allocating = most([&] {
    Wrenchd wanted;
    wanted.force << 10.0, 5.0, 300.0;  // beyond the actuator limits
    (void)allocation.allocate(0.0, wanted, {}, {});
  });
  const double estimating = most([&] {
    for (int i = 0; i < 100; ++i) {
      ekf.on_imu(0.005 * i, {Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.0, 9.81)});
      if (i % 10 == 5) ekf.on_pose(0.005 * i, {});
      (void)observer.update(0.005 * i, {Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.0, 9.81)},
                            {});
      (void)actuators.update(0.005 * i, {});
    }
  });
  std::printf("stack: controller %.1f KB, allocation %.1f KB, estimation %.1f KB\n", controller,
              allocating, estimating);
#if defined(__OPTIMIZE__)
  const double limit = 64.0;
#else
  const double limit = 256.0;
#endif
  EXPECT_LE(controller, limit);
  EXPECT_LE(allocating, limit);
  EXPECT_LE(estimating, limit);
}

}  // namespace stack_in_the_loop_test
}  // namespace tilt_ropter
