#include <tilt_ropter/actuation/allocation_matrix.hpp>
#include <tilt_ropter/model/frames.hpp>

#include <gtest/gtest.h>

#include <stdexcept>
#include <string>

#include "support/vehicles.hpp"

namespace allocation_matrix_test {

using namespace tilt_ropter;
using test_support::flat_quadrotor;
using test_support::omnidirectional_octocopter;
using test_support::tilting_hexacopter;

template <int Rotors>
void expect_moore_penrose(const Vehicle<Rotors>& vehicle, int nullity) {
  const AllocationMatrix<Rotors> allocation(vehicle);
  const auto& a = allocation.matrix;
  const auto& p = allocation.pseudoinverse;
  EXPECT_TRUE((a * p).isIdentity(1e-12));
  EXPECT_LT((p * a * p - p).norm(), 1e-12);
  EXPECT_LT((p * a - (p * a).transpose()).norm(), 1e-12);
  const Eigen::MatrixXd& n = allocation.null_space;
  ASSERT_EQ(n.cols(), nullity);
  EXPECT_LT((a * n).norm(), 1e-13);
  EXPECT_TRUE((n.transpose() * n).isIdentity(1e-12));
  for (int i = 0; i < Rotors; ++i) {
    if (vehicle.rotors[static_cast<std::size_t>(i)].tilts) continue;
    EXPECT_EQ(a.col(2 * i).norm() + p.row(2 * i).norm() + n.row(2 * i).norm(), 0.0);
  }
}

TEST(AllocationMatrix, PseudoinverseAndNullSpaceMatchTheMatrix) {
  expect_moore_penrose(tilt_ropter_vehicle(), 2);
  expect_moore_penrose(tilting_hexacopter(), 6);
  expect_moore_penrose(omnidirectional_octocopter(), 2);
  Vehicle<6> mixed = tilting_hexacopter();
  mixed.rotors[0].tilts = mixed.rotors[3].tilts = false;
  expect_moore_penrose(mixed, 4);
}

TEST(AllocationMatrix, ColumnsContainForceLeverArmAndReactionTorque) {
  const Vehicle<4> vehicle = tilt_ropter_vehicle();
  const AllocationMatrix<4> allocation(vehicle);
  for (std::size_t i = 0; i < 4; ++i) {
    const RotorGeometry& rotor = vehicle.rotors[i];
    for (const double alpha : {0.0, 0.4, pi / 2.0, -2.5}) {
      const Eigen::Vector3d force = rotor.orientation * thrust_direction(alpha);
      // A rotor that turns counter-clockwise exerts a clockwise torque on the body.
      const double reaction = rotor.spin == Spin::counter_clockwise ? -0.016 : 0.016;
      Eigen::Matrix<double, 6, 1> expected;
      expected << force, rotor.position.cross(force) + reaction * force;
      const auto column = static_cast<Eigen::Index>(2 * i);
      EXPECT_LT((allocation.matrix.col(column) * std::sin(alpha) +
                 allocation.matrix.col(column + 1) * std::cos(alpha) - expected)
                    .norm(),
                1e-15);
    }
  }
}

template <int Rotors>
std::string complaint(const Vehicle<Rotors>& vehicle) {
  try {
    const AllocationMatrix<Rotors> allocation(vehicle);
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return {};
}

TEST(AllocationMatrix, RejectsFlatQuadrotorAndNamesMissingDirections) {
  const std::string text = complaint(flat_quadrotor());
  EXPECT_NE(text.find("rank of the allocation matrix = 4: must be 6"), std::string::npos) << text;
  EXPECT_NE(text.find("2 direction(s)"), std::string::npos) << text;
  EXPECT_NE(text.find("force x, force y"), std::string::npos) << text;
  EXPECT_EQ(text.find("torque"), std::string::npos) << text;
}

TEST(AllocationMatrix, RejectsTooFewColumnsAndCoincidentRotors) {
  Vehicle<4> one_tilts = flat_quadrotor();
  one_tilts.rotors[2].tilts = true;
  EXPECT_NE(complaint(one_tilts).find("= 5: must be 6"), std::string::npos);
  Vehicle<4> no_arms = tilt_ropter_vehicle();
  for (RotorGeometry& rotor : no_arms.rotors) rotor.position.setZero();
  EXPECT_NE(complaint(no_arms).find("torque"), std::string::npos);
}

TEST(AllocationMatrix, RejectsVehicleSizeThatOverflows) {
  Vehicle<4> vehicle = tilt_ropter_vehicle();
  vehicle.rotors[1] = rotor_on_arm(pi / 4, 1.0, Spin::clockwise);
  vehicle.rotors[1].position << 1.7e308, 1.7e308, 0.0;  // finite, but its torques overflow
  EXPECT_NE(complaint(vehicle).find("size of the vehicle"), std::string::npos);
}

TEST(AllocationMatrix, RankIsIndependentOfVehicleSize) {
  for (const double scale : {1e-8, 1.0, 1e8}) {
    Vehicle<4> vehicle = tilt_ropter_vehicle(), flat = flat_quadrotor();
    vehicle.rotor.torque_ratio *= scale;
    flat.rotor.torque_ratio *= scale;
    for (std::size_t i = 0; i < 4; ++i) {
      vehicle.rotors[i].position *= scale;
      flat.rotors[i].position *= scale;
    }
    EXPECT_EQ(complaint(vehicle), "");
    EXPECT_NE(complaint(flat), "");
  }
}

}  // namespace allocation_matrix_test
