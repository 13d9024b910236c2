// Mass, CoM and inertia of the reference vehicle as a sum of its parts. The masses of the parts
// with a model name are those of the paper (paper, Sec. Hardware System Design, component table);
// their places and sizes, and the masses of the other parts, are estimates.

#include <tilt_ropter/model/vehicle.hpp>

#include <gtest/gtest.h>

#include <Eigen/Core>

#include <vector>

namespace tilt_ropter {
namespace component_inertia_test {

struct Part {
  double mass;             ///< [kg]
  Eigen::Vector3d centre;  ///< body frame [m]
  Eigen::Vector3d size;    ///< of a solid box [m]
};

std::vector<Part> parts() {
  const Eigen::Vector3d small(0.02, 0.02, 0.02);
  std::vector<Part> all = {
      {0.485, {0.0, 0.0, -0.025}, {0.155, 0.045, 0.05}},  // battery ACE 5300 mAh 45C: paper
      {0.150, {0.0, 0.0, 0.045}, {0.10, 0.08, 0.035}},    // NVIDIA Jetson Orin NX: paper
      {0.014, {0.0, 0.0, 0.01}, {0.04, 0.04, 0.01}},      // ESC Holybro Tekko32 60A: paper
      {0.008, {0.0, 0.0, 0.02}, {0.04, 0.04, 0.01}},      // Holybro Kakute H7 V1.3: paper
      {0.248, {0.0, 0.0, 0.0}, {0.22, 0.17, 0.07}},       // base frame: what is left of 1.5 kg
  };
  for (const Eigen::Vector3d& out : {Eigen::Vector3d(0, -1, 0), Eigen::Vector3d(0, 1, 0),
                                     Eigen::Vector3d(1, 0, 0), Eigen::Vector3d(-1, 0, 0)}) {
    const bool axle = out.x() == 0.0;  // reaches to the wheel
    const Eigen::Vector3d up(0.0, 0.0, 1.0), across = Eigen::Vector3d(0.012, 0.012, 0.012);
    const double inner = 0.03, outer = axle ? 0.25 : 0.17;
    all.push_back({0.145 / 4.0, 0.05 * out, {0.03, 0.03, 0.03}});      // servo GDW RS0708: paper
    all.push_back({0.146 / 4.0, 0.17 * out + 0.015 * up, small});      // T-Motor F80 Pro: paper
    all.push_back({0.020 / 4.0, 0.17 * out + 0.034 * up, small});      // Foxeer 5145 Donut: paper
    all.push_back({0.025, 0.17 * out, small});                         // mount of the motor
    all.push_back({axle ? 0.030 : 0.022, 0.5 * (inner + outer) * out,  // arm
                   across + (outer - inner) * out.cwiseAbs()});
    // A wheel. Its inertia about body y is not part of the inertia of the vehicle.
    if (axle) all.push_back({0.040, 0.26 * out, {0.0, 0.245, 0.0}});
  }
  return all;
}

TEST(ReferenceVehicle, HasTheMassOfItsPartsAndAtMostTwiceTheirInertia) {
  const Vehicle<4> v = tilt_ropter_vehicle();
  double mass = 0.0;
  Eigen::Vector3d moment = Eigen::Vector3d::Zero();
  Eigen::Matrix3d inertia = Eigen::Matrix3d::Zero();
  for (const Part& part : parts()) {
    const Eigen::Vector3d square = part.size.cwiseAbs2();
    mass += part.mass;
    moment += part.mass * part.centre;
    inertia += part.mass * (part.centre.squaredNorm() * Eigen::Matrix3d::Identity() -
                            part.centre * part.centre.transpose());
    inertia.diagonal() += part.mass / 12.0 * (Eigen::Vector3d::Constant(square.sum()) - square);
  }
  EXPECT_NEAR(mass, v.body.mass, 1e-3);
  EXPECT_LT((moment / mass).norm(), 2e-3);
  // The parts add up to 0.013, 0.0075 and 0.0185 kg m^2. The vehicle's values are above them:
  // cables, guards and whatever else sits far out is not in the list.
  const Eigen::Vector3d sum(0.013, 0.0075, 0.0185);
  for (int axis = 0; axis < 3; ++axis) {
    EXPECT_NEAR(inertia(axis, axis) / sum(axis), 1.0, 0.05) << axis;
    EXPECT_GT(v.body.inertia(axis, axis), inertia(axis, axis)) << axis;
    EXPECT_LT(v.body.inertia(axis, axis), 2.0 * inertia(axis, axis)) << axis;
  }
  inertia.diagonal().setZero();
  EXPECT_LT(inertia.cwiseAbs().maxCoeff(), 1e-9);
}

}  // namespace component_inertia_test
}  // namespace tilt_ropter
