// After construction and a few measurements the estimator does not use the heap, for any status of
// its measurements.
// CTest: alone

#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>

#include "support/allocation_counter.hpp"
#include "support/flights.hpp"
#include "support/full_run.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <memory>
#include <set>

namespace tilt_ropter {
namespace heap_in_the_estimator_test {

using test_support::Flight;
using test_support::heap_use;
using test_support::HeapUse;
using test_support::HeapUser;
using test_support::Random;

// Stores an address, so that the compiler does not remove the allocation.
const void* volatile seen = nullptr;

template <typename Call>
HeapUse use_of(const Call& call) {
  const HeapUse before = heap_use(HeapUser::other);
  call();
  return heap_use(HeapUser::other) - before;
}

template <typename Scalar>
class HeapInTheEstimator : public testing::Test {};
#ifdef TILT_ROPTER_FULL_TESTS  // ten seconds to compile
using Scalars = testing::Types<double, float>;
#else
using Scalars = testing::Types<double>;
#endif
TYPED_TEST_SUITE(HeapInTheEstimator, Scalars, );

TYPED_TEST(HeapInTheEstimator, NoFunctionOfTheLoopAllocates) {
  using Scalar = TypeParam;
  if (!test_support::heap_can_be_counted)
    GTEST_SKIP() << "a sanitizer or another C library has the heap: it cannot be counted";
  ASSERT_GT(use_of([] { seen = std::make_unique<Ekf<Scalar>>().get(); }).allocations, 1);

  const int ticks = test_support::quick_or_full(2000, 10000);
  EkfSettings settings;
  settings.marker_position_stddev = 0.01;
  settings.marker_orientation_stddev = 0.01;
  Ekf<Scalar> ekf(settings);
  const Flight flight(1);
  Random random(301);
  std::set<EkfStatus> reached;
  HeapUse use;
  double finite = 0.0;
  double jump = 0.0;
  const auto count = [&use](const auto& call) {
    EkfStatus status = EkfStatus::rejected;
    use = use + use_of([&] { status = call(); });
    return status;
  };
  for (int i = 0; i < ticks; ++i) {
    if (i % 500 == 499) jump += 0.5;  // a gap of the IMU
    const double t = 0.005 * i + jump;
    const InertialSampled sample = flight.imu(t);
    MarkerPosed pose = flight.pose(t);
    if (i % 400 > 340) pose.position.x() += 5.0;                  // gated, then restarted
    if (i % 400 > 190 && i % 400 < 200) pose = flight.pose(0.0);  // frozen
    if (i % 100 == 50) pose.position.y() = std::numeric_limits<double>::quiet_NaN();
    const InertialSample<Scalar> s{sample.angular_velocity.template cast<Scalar>(),
                                   sample.specific_force.template cast<Scalar>()};
    const MarkerPose<Scalar> p{pose.position.template cast<Scalar>(),
                               pose.orientation.template cast<Scalar>()};
    const double late = i % 7 == 0 ? 0.1 : 0.0, ahead = i % 11 == 0 ? 0.1 : i % 13 == 0 ? 1.0 : 0.0;
    const EkfStatus by_imu = count([&] { return ekf.on_imu(t, s); });
    const EkfStatus again = count([&] { return ekf.on_imu(t - (i % 2) * 0.003, s); });
    const EkfStatus by_pose = count([&] { return ekf.on_pose(t - late + ahead, p); });
    const EkfStatus twice = count([&] { return ekf.on_pose(t - late + ahead, p); });
    use = use + use_of([&] {
            finite += static_cast<double>(ekf.state().position.x() + ekf.nis()) + ekf.time() +
                      ekf.filter_time() + static_cast<double>(ekf.counts().used);
          });
    const double stamp = t - late + ahead;
    WorldVelocityMeasurement<Scalar> velocity;
    velocity.velocity = flight.state(t).velocity.template cast<Scalar>();
    use = use + use_of([&] {
            (void)ekf.on_measurement(stamp, HeightMeasurement<Scalar>());
            (void)ekf.on_measurement(stamp, PoseMeasurement<Scalar>());
            (void)ekf.on_measurement(stamp, FlowMeasurement<Scalar>());
            (void)ekf.on_measurement(stamp, WheelSpeedMeasurement<Scalar>());
            (void)ekf.on_measurement(stamp, velocity);
            finite += ekf.trust(t).imu_age;
          });
    if (i == 1000) use = use + use_of([&] { ekf.reset(); });
    reached.insert({by_imu, again, by_pose, twice});
    if (i < 5) use = {};
  }
  EXPECT_TRUE(use.none()) << use.allocations << " allocations";
  EXPECT_EQ(reached.size(), 11U);
  EXPECT_TRUE(std::isfinite(finite));
}

}  // namespace heap_in_the_estimator_test
}  // namespace tilt_ropter
