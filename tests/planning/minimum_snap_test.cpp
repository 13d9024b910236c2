#include <tilt_ropter/planning/minimum_snap.hpp>
#include <tilt_ropter/planning/transition.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <stdexcept>
#include <vector>

namespace tilt_ropter {
namespace minimum_snap_test {

std::vector<MinimumSnapSettings> cases() {
  std::mt19937 generator(6);
  const auto uniform = [&generator](double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(generator);
  };
  const auto vector = [&uniform](double size) -> Eigen::Vector3d {
    return {uniform(-size, size), uniform(-size, size), uniform(-size, size)};
  };
  std::vector<MinimumSnapSettings> all;
  for (int i = 0; i < 30; ++i) {
    MinimumSnapSettings p;
    Eigen::Vector3d place = vector(5.0);
    for (int j = 0; j < 2 + i % 6; ++j) {
      p.points.push_back(place);
      place += Eigen::Vector3d(3.0, 0.0, 0.0) + vector(2.0);
    }
    p.max_speed = uniform(0.8, 3.0);
    p.max_acceleration = uniform(1.5, 4.0);
    if (i % 2 == 0) p.start_velocity << 0.3 * p.max_speed, 0.1, 0.0;
    if (i % 3 == 0) p.end_velocity << 0.3 * p.max_speed, -0.1, 0.1;
    p.yaw = uniform(-4.0, 4.0);
    all.push_back(p);
  }
  return all;
}

// The same, also with the heading along the path. A path that has to turn round while it moves has
// no such heading; these start and end at rest.
std::vector<MinimumSnapSettings> cases_with_headings() {
  std::vector<MinimumSnapSettings> all = cases();
  for (MinimumSnapSettings p : cases()) {
    p.heading = HeadingMode::along_velocity;
    p.start_velocity = p.end_velocity = Eigen::Vector3d::Zero();
    all.push_back(p);
  }
  return all;
}

TEST(MinimumSnap, PassesThroughItsPointsAndEndStates) {
  for (const MinimumSnapSettings& p : cases()) {
    const MinimumSnap path(p);
    const ReferencePoint start = path(path.start_time()), end = path(path.end_time());
    EXPECT_LT((start.position - p.points.front()).norm(), 1e-9);
    EXPECT_LT((end.position - p.points.back()).norm(), 1e-9);
    EXPECT_LT((start.velocity - p.start_velocity).norm(), 1e-9);
    EXPECT_LT((end.velocity - p.end_velocity).norm(), 1e-9);
    EXPECT_LT(start.acceleration.norm() + end.acceleration.norm(), 1e-8);
    EXPECT_LT(start.orientation.angularDistance(quaternion_from_yaw(p.yaw)), 1e-7);
    for (std::size_t i = 0; i < p.points.size(); ++i)
      EXPECT_LT((path(path.time_at(i)).position - p.points[i]).norm(), 1e-9);
  }
}

TEST(MinimumSnap, DerivativesAreThoseOfThePositionAndHeading) {
  for (const MinimumSnapSettings& p : cases_with_headings()) {
    const MinimumSnap path(p);
    const double h = 1e-5;
    for (double x : {0.0, 0.001, 0.01, 0.2, 0.5, 0.71, 0.99, 0.999, 1.0}) {
      const double t =
          std::min(std::max(path.start_time() + x * path.duration(), path.start_time() + h),
                   path.end_time() - h);
      const ReferencePoint before = path(t - h), now = path(t), after = path(t + h);
      EXPECT_LT((now.velocity - (after.position - before.position) / (2.0 * h)).norm(), 1e-7);
      EXPECT_LT((now.acceleration - (after.velocity - before.velocity) / (2.0 * h)).norm(), 1e-6);
      const Eigen::Vector3d turn =
          quaternion_log(Eigen::Quaterniond(before.orientation.conjugate() * after.orientation));
      EXPECT_LT((now.angular_velocity - turn / (2.0 * h)).norm(), 1e-3);
      if (p.heading == HeadingMode::fixed || x < 0.01 || x > 0.99) continue;
      EXPECT_NEAR(yaw_of(now.orientation), std::atan2(now.velocity.y(), now.velocity.x()), 1e-9);
      EXPECT_NEAR(now.angular_acceleration.z(),
                  (after.angular_velocity.z() - before.angular_velocity.z()) / (2.0 * h), 1e-3);
    }
  }
}

TEST(MinimumSnap, KeepsItsLimitsAndReachesTheTightest) {
  for (const MinimumSnapSettings& p : cases_with_headings()) {
    const MinimumSnap path(p);
    double speed = 0.0, acceleration = 0.0, turn = 0.0;
    for (double t = path.start_time(); t <= path.end_time(); t += 1e-3) {
      const ReferencePoint point = path(t);
      speed = std::max(speed, point.velocity.norm() / p.max_speed);
      acceleration = std::max(acceleration, point.acceleration.norm() / p.max_acceleration);
      turn = std::max(turn, std::abs(point.angular_velocity.z()) / p.max_yaw_rate);
    }
    EXPECT_LE(speed, 1.001);
    EXPECT_LE(acceleration, 1.01);
    EXPECT_LE(turn, 1.01);
    // A turn at low speed is shorter than the samples here.
    if (p.heading == HeadingMode::along_velocity) continue;
    EXPECT_GE(std::max(speed, acceleration), 0.9);
  }
}

// The same path from the definition: the least integral of squared snap over all pieces of degree 7
// with continuous position, velocity, acceleration and jerk, by its optimality conditions.
class LeastSnap {
 public:
  explicit LeastSnap(const MinimumSnap& path) {
    const MinimumSnapSettings& p = path.settings();
    for (std::size_t i = 1; i < p.points.size(); ++i)
      times_.push_back(path.time_at(i) - path.time_at(i - 1));
    const auto pieces = static_cast<Eigen::Index>(times_.size());
    const Eigen::Index unknowns = 8 * pieces, conditions = 5 * pieces + 3;
    Eigen::MatrixXd system = Eigen::MatrixXd::Zero(unknowns + conditions, unknowns + conditions);
    Eigen::MatrixX3d right = Eigen::MatrixX3d::Zero(unknowns + conditions, 3);
    Eigen::Index row = unknowns;
    const auto add = [&](Eigen::Index piece, int order, double x, double sign) {
      for (int k = order; k < 8; ++k) {
        const double entry = sign * factor(k, order) * std::pow(x, k - order) /
                             std::pow(times_[static_cast<std::size_t>(piece)], order);
        system(row, 8 * piece + k) += entry;
        system(8 * piece + k, row) += entry;
      }
    };
    const auto require_end = [&](Eigen::Index piece, int order, double x,
                                 const Eigen::Vector3d& value) {
      add(piece, order, x, 1.0);
      right.row(row++) = value.transpose();
    };
    for (Eigen::Index i = 0; i < pieces; ++i) {
      const double time = times_[static_cast<std::size_t>(i)];
      for (int j = 4; j < 8; ++j)
        for (int k = 4; k < 8; ++k)
          system(8 * i + j, 8 * i + k) =
              2.0 * factor(j, 4) * factor(k, 4) / (j + k - 7) / std::pow(time, 7);
      require_end(i, 0, 0.0, p.points[static_cast<std::size_t>(i)]);
      require_end(i, 0, 1.0, p.points[static_cast<std::size_t>(i) + 1]);
      if (i == 0) continue;
      for (int order = 1; order < 4; ++order) {
        add(i - 1, order, 1.0, 1.0);
        add(i, order, 0.0, -1.0);
        ++row;
      }
    }
    require_end(0, 1, 0.0, p.start_velocity);
    require_end(0, 2, 0.0, p.start_acceleration);
    require_end(0, 3, 0.0, Eigen::Vector3d::Zero());
    require_end(pieces - 1, 1, 1.0, p.end_velocity);
    require_end(pieces - 1, 2, 1.0, p.end_acceleration);
    require_end(pieces - 1, 3, 1.0, Eigen::Vector3d::Zero());
    solution_ = system.fullPivLu().solve(right);
  }

  Eigen::Vector3d at(double elapsed) const {
    std::size_t i = 0;
    while (i + 1 < times_.size() && elapsed > times_[i]) elapsed -= times_[i++];
    Eigen::Vector3d position = Eigen::Vector3d::Zero();
    for (int k = 0; k < 8; ++k)
      position += std::pow(elapsed / times_[i], k) *
                  solution_.row(static_cast<Eigen::Index>(8 * i) + k).transpose();
    return position;
  }

 private:
  static double factor(int power, int order) {  // of the derivative of x^power
    double all = 1.0;
    for (int j = 0; j < order; ++j) all *= power - j;
    return all;
  }

  std::vector<double> times_;
  Eigen::MatrixX3d solution_;
};

TEST(MinimumSnap, EqualsTheSolutionOfTheOptimalityConditions) {
  for (const MinimumSnapSettings& p : cases()) {
    const MinimumSnap path(p);
    const LeastSnap truth(path);
    for (double x = 0.0; x <= 1.0; x += 0.05)
      EXPECT_LT(
          (path(path.start_time() + x * path.duration()).position - truth.at(x * path.duration()))
              .norm(),
          1e-7);
  }
}

// Between two rests the path of least snap is the one of Transition, which has a closed form.
TEST(MinimumSnap, FromRestToRestIsATransition) {
  for (const double acceleration : {0.3, 1.5, 20.0}) {
    TransitionSettings known;
    known.to.position << 3.0, -1.0, 0.5;
    known.max_speed = 1.2;
    known.max_acceleration = acceleration;
    const Transition transition(known);
    MinimumSnapSettings p;
    p.points = {known.from.position, known.to.position};
    p.max_speed = known.max_speed;
    p.max_acceleration = acceleration;
    const MinimumSnap path(p);
    EXPECT_GE(path.duration(), (1.0 - 1e-3) * transition.duration());
    EXPECT_LE(path.duration(), 1.01 * transition.duration());
    for (double x = 0.0; x <= 1.0; x += 0.1)
      EXPECT_LT(
          (path(x * path.duration()).position - transition(x * transition.duration()).position)
              .norm(),
          1e-9);
  }
}

TEST(MinimumSnap, StraightAtConstantSpeedIsALine) {
  MinimumSnapSettings p;
  p.points = {{0.0, 0.0, 0.11}, {1.0, 1.0, 0.11}};
  p.start_velocity = p.end_velocity = Eigen::Vector3d(1.0, 1.0, 0.0);
  p.max_speed = std::sqrt(2.0);
  p.heading = HeadingMode::along_velocity;
  const MinimumSnap path(p);
  EXPECT_NEAR(path.duration(), 1.0, 1e-9);
  for (double t = 0.0; t <= 1.0; t += 0.1) {
    EXPECT_LT((path(t).position - Eigen::Vector3d(t, t, 0.11)).norm(), 1e-12);
    EXPECT_NEAR(yaw_of(path(t).orientation), 0.25 * pi, 1e-12);
  }
}

TEST(MinimumSnap, IsDefinedForEveryTime) {
  const MinimumSnap path(cases().front());
  const double infinity = std::numeric_limits<double>::infinity();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto at = [&path](double time) { return path(time).position; };
  EXPECT_EQ(at(nan), at(path.start_time()));
  EXPECT_EQ(at(-infinity), at(path.start_time()));
  EXPECT_EQ(at(infinity), at(path.end_time()));
}

TEST(MinimumSnap, TakesAGivenDurationThatKeepsTheLimits) {
  for (MinimumSnapSettings p : cases()) {
    if (!p.start_velocity.isZero() || !p.end_velocity.isZero()) continue;
    const double shortest = MinimumSnap(p).duration();
    p.duration = 1.5 * shortest;
    EXPECT_NEAR(MinimumSnap(p).duration(), p.duration, 1e-9);
    p.duration = 0.9 * shortest;
    EXPECT_THROW(MinimumSnap{p}, std::invalid_argument);
  }
}

TEST(MinimumSnap, StopsFromAnyMotionWithinTheAcceleration) {
  std::mt19937 generator(7);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  const auto vector = [&]() -> Eigen::Vector3d {
    return {uniform(generator), uniform(generator), uniform(generator)};
  };
  for (int i = 0; i < 200; ++i) {
    ReferencePoint from;
    from.position = 5.0 * vector();
    from.velocity = (i % 4) * vector();
    if (i % 3 > 0) from.acceleration = 0.8 * vector();
    from.orientation = quaternion_from_yaw(3.0 * uniform(generator));
    const double limit = i % 2 == 0 ? 1.5 : 9.0;
    const MinimumSnap path = stop(from, limit);
    const ReferencePoint start = path(0.0), end = path(path.end_time());
    EXPECT_LT((start.position - from.position).norm(), 1e-9);
    EXPECT_LT((start.velocity - from.velocity).norm(), 1e-9);
    EXPECT_LT((start.acceleration - from.acceleration).norm(), 1e-9);
    EXPECT_LT(start.orientation.angularDistance(from.orientation), 1e-7);
    EXPECT_LT(end.velocity.norm() + end.acceleration.norm(), 1e-8);
    double most = 0.0;
    for (double t = 0.0; t < path.duration(); t += 0.01)
      most = std::max(most, path(t).acceleration.norm());
    EXPECT_LE(most, 1.002 * limit);
    const double speed = from.velocity.norm();
    if (from.acceleration.isZero() && speed > 0.2) {
      EXPECT_NEAR(path.duration(), 1.875 * speed / limit, 1e-3);
      EXPECT_LT((end.position - from.position - 0.5 * path.duration() * from.velocity).norm(),
                1e-9);
    }
  }
  ReferencePoint bad;
  bad.acceleration.x() = 2.0;
  EXPECT_THROW((void)stop(bad, 1.0), std::invalid_argument);
  bad.acceleration.x() = std::nan("");
  EXPECT_THROW((void)stop(bad, 1.0), std::invalid_argument);
}

}  // namespace minimum_snap_test
}  // namespace tilt_ropter
