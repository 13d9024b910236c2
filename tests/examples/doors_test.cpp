// CTest: optimised
// Doors and lies: a log, a trajectory or a sensor in another unit, order, sign or frame is read as
// what it is, refused by name, or its reason is found.

#include "../../examples/support/flight_log.hpp"
#include "../../examples/support/replay.hpp"
#include "../../examples/support/trajectory_file.hpp"
#include "support/flights.hpp"
#include "support/program.hpp"

#include <tilt_ropter/estimation/wrench_observer.hpp>

#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <functional>
#include <sstream>
#include <string>
#include <vector>

namespace doors_test {

using namespace tilt_ropter;
using examples::FlightLogs;
using examples::RecordedFlight;

const test_support::Directory directory("doors");

/// What `read` throws; "not refused" if it throws nothing.
template <typename Read>
std::string refusal(const Read& read) {
  try {
    read();
  } catch (const InputFileError& error) {
    return error.what();
  }
  return "not refused";
}

std::string number(double value, bool comma) {
  char text[64];
  (void)std::snprintf(text, sizeof text, "%.9f", value);
  std::string digits = text;
  if (comma) digits[digits.find('.')] = ',';
  return digits;
}

struct Form {
  char separator;
  const char* mark;  // before the header
  double unit;       // of the stamps [s]
  const char* unit_name;
  bool says_unit, w_first;
  double start;  // [s]
};

/// A log of poses in any form, with remarks around it.
std::string poses_in(const Form& form) {
  const bool comma = form.separator == ';';
  const std::string sep(1, form.separator);
  std::ostringstream text;
  text << "# exported by hand\n" << form.mark << "timestamp";
  if (form.says_unit) text << (form.separator == ' ' ? "[" : " [") << form.unit_name << ']';
  for (const char* name : {"tx", "ty", "tz"}) text << sep << name;
  for (const char* name : {"qw", "qx", "qy", "qz"})
    if (form.w_first || name[1] != 'w') text << sep << name;
  text << (form.w_first ? "" : sep + "qw") << "\r\n";
  for (int i = 0; i < 40; ++i) {
    text << number((form.start + 0.01 * i) / form.unit, comma);
    for (const double value : {1.0 + i, 2.0, -3.0}) text << sep << number(value, comma);
    if (form.w_first) text << sep << number(0.8, comma);
    for (const double value : {0.6, 0.0, 0.0}) text << sep << number(value, comma);
    text << (form.w_first ? "" : sep + number(0.8, comma)) << "\r\n";
  }
  text << "# end\nthe remark of a spreadsheet\n";
  return text.str();
}

// 256 combinations of separator, header, unit of time, its name, order of the quaternion and epoch.
TEST(Doors, PosesOfAnyFormAreReadAsTheyAre) {
  int count = 0;
  for (const char separator : {',', ';', '\t', ' '})
    for (const char* mark : {"", "#"})
      for (const auto& [unit, name] : {std::make_pair(1.0, "s"), std::make_pair(1e-3, "ms"),
                                       std::make_pair(1e-6, "us"), std::make_pair(1e-9, "ns")})
        for (const bool says_unit : {false, true})
          for (const bool w_first : {false, true})
            for (const double start : {2.0, 1.4e9}) {
              const Form form{separator, mark, unit, name, says_unit, w_first, start};
              const std::string file = directory.write("pose.csv", poses_in(form));
              FlightLogs logs;
              const auto poses = logs.poses(file).poses;
              ++count;
              SCOPED_TRACE(separator + std::string(mark) + name + (says_unit ? " said" : ""));
              ASSERT_EQ(poses.size(), 40u);
              EXPECT_NEAR(poses[39].time - poses[0].time, 0.39, 2e-6);
              EXPECT_NEAR(poses[5].value.position.x(), 6.0, 1e-9);
              EXPECT_NEAR(poses[5].value.orientation.w(), 0.8, 1e-9);
              EXPECT_NEAR(poses[5].value.orientation.x(), 0.6, 1e-9);
              const bool assumed = !says_unit && unit != 1.0;
              std::string notes;
              for (const std::string& note : logs.notes()) notes += note + '\n';
              EXPECT_EQ(notes.find(std::string("read as ") + name) != std::string::npos, assumed)
                  << notes;
              EXPECT_NE(notes.find("text after the last row"), std::string::npos) << notes;
            }
  EXPECT_EQ(count, 256);
}

TEST(Doors, UnitsInTheHeaderAreConverted) {
  const std::string row = "0,180,0,0,1,0,0\n0.01,180,0,0,1,0,0\n";
  for (const char* rate : {"wx[deg/s],wy[deg/s],wz[deg/s]", "gyro_x_dps,gyro_y_dps,gyro_z_dps"})
    for (const char* force : {"ax[g],ay[g],az[g]", "acc_x_g,acc_y_g,acc_z_g"}) {
      FlightLogs logs;
      const auto imu =
          logs.imu(directory.write("imu.csv", std::string("t,") + rate + ',' + force + '\n' + row));
      EXPECT_NEAR(imu[0].value.angular_velocity.x(), pi, 1e-9) << rate;
      EXPECT_NEAR(imu[0].value.specific_force.x(), gravity, 1e-9) << force;
      EXPECT_EQ(logs.notes().size(), 6u);
    }
}

TEST(Doors, NamesOfOtherProgramsAreKnown) {
  using examples::detail::role_of;
  for (const auto& [name, role] :
       std::vector<std::pair<std::string, std::string>>{{"#timestamp [ns]", "t"},
                                                        {"%time", "t"},
                                                        {"time_s", "t"},
                                                        {"stamp", "t"},
                                                        {"p_RS_R_x [m]", "px"},
                                                        {"q_RS_w []", "qw"},
                                                        {"w_RS_S_z [rad s^-1]", "wz"},
                                                        {"a_RS_S_y [m s^-2]", "fy"},
                                                        {"v_RS_R_x [m s^-1]", "vx"},
                                                        {"b_w_RS_S_x [rad s^-1]", ""},
                                                        {"field.pose.orientation.w", "qw"},
                                                        {"pose.position.x", "px"},
                                                        {"angular_velocity.x", "wx"},
                                                        {"linear_acceleration.z", "fz"},
                                                        {"orientation_w", "qw"},
                                                        {"position_m_x", "px"},
                                                        {"specific_force_mps2_x", "fx"},
                                                        {"angular_velocity_radps_z", "wz"},
                                                        {"w.x", "wx"},
                                                        {"a.x", "fx"},
                                                        {"x", "px"},
                                                        {"positionX", "px"},
                                                        {"gx", "wx"},
                                                        {"velocity_mps_y", "vy"},
                                                        {"field.header.seq", ""},
                                                        {"deviation_position_m_x", ""},
                                                        {"temperature", ""}})
    EXPECT_EQ(role_of(name).role, role) << name;
}

// Each column of each file: a text, an infinite number, a missing field and a missing column.
TEST(Doors, WhatIsNoLogIsRefusedByLineAndColumn) {
  struct File {
    std::string header, row;
    std::function<void(FlightLogs&, const std::string&)> read;
  };
  const std::vector<File> files = {
      {"t,wx,wy,wz,ax,ay,az", "0,0,0,0,0,9.8",
       [](FlightLogs& logs, const std::string& path) { (void)logs.imu(path); }},
      {"t,px,py,pz,qw,qx,qy,qz", "1,2,3,1,0,0,0",
       [](FlightLogs& logs, const std::string& path) { (void)logs.poses(path); }},
      {"t,px,py,pz,qw,qx,qy,qz,vx,vy,vz", "1,2,3,1,0,0,0,0,0,0",
       [](FlightLogs& logs, const std::string& path) { (void)logs.truth(path); }}};
  int count = 0;
  for (const File& file : files) {
    const auto names = examples::detail::recorded_fields(file.header, ',');
    const auto values = examples::detail::recorded_fields(file.row, ',');
    for (std::size_t i = 1; i < names.size(); ++i)
      for (const char* lie : {"five", "inf", ""}) {
        const bool allowed = std::string(lie).empty() && file.header.size() == 22;  // poses
        std::string bad = "0.01";
        for (std::size_t k = 1; k < names.size(); ++k) bad += ',' + (k == i ? lie : values[k - 1]);
        const std::string good = "0.02," + file.row + "\n0.03," + file.row + '\n';
        const std::string path =
            directory.write("bad.csv", file.header + "\n0," + file.row + '\n' + bad + '\n' + good);
        const std::string what = refusal([&] {
          FlightLogs logs;
          file.read(logs, path);
        });
        ++count;
        const std::string place = ":3: column " + names[i] + " (" + std::to_string(i + 1) + ')';
        EXPECT_EQ(what.find(place) != std::string::npos, !allowed) << what << ' ' << names[i];
        if (lie[0] != 'f') continue;
        std::string header = file.header;
        header.replace(header.find(names[i]), names[i].size(), "other");
        const std::string missing = refusal([&] {
          FlightLogs logs;
          file.read(logs, directory.write("bad.csv", header + '\n' + good));
        });
        EXPECT_NE(missing.find(":1: no column for "), std::string::npos) << missing;
      }
  }
  EXPECT_EQ(count, 69);
  std::string rounded = "t,px,py,pz,qw,qx,qy,qz\n";
  for (int i = 0; i < 40; ++i) rounded += "1.40372E+18,0,0,1,1,0,0,0\n";
  EXPECT_NE(refusal([&] {
              (void)FlightLogs().poses(directory.write("bad.csv", rounded));
            }).find("bad.csv:3: column t (1) does not increase, as 39 of 40 stamps"),
            std::string::npos);
}

TEST(Doors, RowsWithoutOrientationArePositionsAndEmptyOnesAreLost) {
  FlightLogs logs;
  const auto log = logs.poses(directory.write("pose.csv",
                                              "t,px,py,pz,qw,qx,qy,qz\n0,1,2,3,1,0,0,0\n"
                                              "0.1,1,2,3,,,,\n0.2,1,2,3,0,0,0,0\n0.3,nan,nan,nan,"
                                              "nan,nan,nan,nan\n0.4,,,,,,,\n0.5,0,0,0,0,0,0,0\n"
                                              "0.6,1,2,3,1,0,0,0\n"));
  EXPECT_EQ(log.poses.size(), 2u);
  EXPECT_EQ(log.positions.size(), 2u);
  EXPECT_EQ(log.lost, 3);
}

/// 12 s with an IMU of 100 Hz and 50 poses per second.
RecordedFlight recorded() {
  const test_support::Flight flight(3);
  test_support::NoisyImu imu(flight, {2e-4, 2e-3, 2e-5, 3e-4}, 0.01, 4);
  test_support::Random random(5);
  RecordedFlight log;
  for (int i = 0; i < 1200; ++i) {
    log.imu.push_back({0.01 * i, imu(0.01 * i)});
    if (i % 2 == 0)
      log.marker.poses.push_back(
          {0.01 * i, test_support::noisy(flight.pose(0.01 * i), {1e-3, 3e-3}, random)});
  }
  return log;
}

TEST(Doors, TheReasonOfRefusedPosesIsFound) {
  const RecordedFlight good = recorded();
  const auto reception_of = [](const RecordedFlight& flight) {
    examples::Reception reception;
    (void)examples::run_filter(flight, {}, reception, [](const Ekfd&, std::size_t) {});
    return reception;
  };
  EXPECT_TRUE(reception_of(good).is_good());
  using Imu = InertialSampled;
  using Pose = MarkerPosed;
  struct Lie {
    const char* said;
    std::function<void(Imu&)> imu;
    std::function<void(Pose&)> pose;
  };
  const auto same_imu = [](Imu&) {};
  const auto same_pose = [](Pose&) {};
  const auto turned = [](const Eigen::Quaterniond& q) {
    return [q](Pose& p) {
      p.position = q * p.position;
      p.orientation = q * p.orientation;
    };
  };
  const auto in_g = [](Imu& s) { s.specific_force /= gravity; };
  const auto xyzw = [](Pose& p) {
    const Eigen::Quaterniond q = p.orientation;
    p.orientation = Eigen::Quaterniond(q.x(), q.y(), q.z(), q.w());
  };
  const std::vector<Lie> lies = {
      {"accelerometer is in g", in_g, same_pose},
      {"accelerometer has the reversed", [](Imu& s) { s.specific_force *= -1.0; }, same_pose},
      {"gyroscope is in degrees", [](Imu& s) { s.angular_velocity *= 180.0 / pi; }, same_pose},
      {"gyroscope has the reversed", [](Imu& s) { s.angular_velocity *= -1.0; }, same_pose},
      {"are exchanged", [](Imu& s) { std::swap(s.angular_velocity, s.specific_force); }, same_pose},
      {"forward, right, down",
       [](Imu& s) {
         s.angular_velocity.tail<2>() *= -1.0;
         s.specific_force.tail<2>() *= -1.0;
       },
       same_pose},
      {"in mm", same_imu, [](Pose& p) { p.position *= 1e3; }},
      {"in cm", same_imu, [](Pose& p) { p.position *= 1e2; }},
      {"x y z w", same_imu, xyzw},
      {"world to the body", same_imu, [](Pose& p) { p.orientation = p.orientation.conjugate(); }},
      {"NED", same_imu, turned(Eigen::Quaterniond(0.0, std::sqrt(0.5), std::sqrt(0.5), 0.0))},
      {"y of the world", same_imu,
       turned(Eigen::Quaterniond(std::sqrt(0.5), -std::sqrt(0.5), 0.0, 0.0))},
      {"height has the reversed", same_imu, [](Pose& p) { p.position.z() *= -1.0; }},
      {"accelerometer is in ft/s^2", [](Imu& s) { s.specific_force /= 0.3048; }, same_pose},
      {"y axis of the accelerometer", [](Imu& s) { s.specific_force.y() *= -1.0; }, same_pose},
      {"x and y axes of the gyroscope",
       [](Imu& s) { std::swap(s.angular_velocity.x(), s.angular_velocity.y()); }, same_pose},
      {"in inches", same_imu, [](Pose& p) { p.position /= 0.0254; }},
      {"y and z positions are exchanged", same_imu,
       [](Pose& p) { std::swap(p.position.y(), p.position.z()); }},
      {"in g instead of m/s^2; the quaternions are x y z w", in_g, xyzw}};
  for (const Lie& lie : lies) {
    RecordedFlight flight = good;
    for (auto& sample : flight.imu) lie.imu(sample.value);
    for (auto& pose : flight.marker.poses) lie.pose(pose.value);
    const examples::Reception taken = reception_of(flight);
    EXPECT_TRUE(taken.is_poor()) << lie.said << ": " << taken.used;
    const std::string reason = examples::likely_reason(flight, {});
    EXPECT_NE(reason.find(lie.said), std::string::npos) << lie.said << ": " << reason;
  }
  RecordedFlight late = good;
  for (auto& pose : late.marker.poses) pose.time += 0.4;
  EXPECT_NE(examples::likely_reason(late, {}).find("off by -0.400 s"), std::string::npos);
}

// The accelerometer at rest and in hover, leaning by up to 20 degrees: unit, sign and axis.
TEST(Doors, AnAccelerometerThatContradictsTheWeightIsNamed) {
  int count = 0;
  for (const double roll : {-0.35, 0.0, 0.35})
    for (const double pitch : {-0.35, 0.0, 0.35}) {
      const Eigen::Vector3d up =
          Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()) *
          (Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) * Eigen::Vector3d(0.0, 0.0, gravity));
      using Status = CalibrationStatus;
      const std::vector<std::pair<Eigen::Vector3d, Status>> lies = {
          {up, Status::calibrated},
          {up / gravity, Status::in_g},
          {-up, Status::reversed},
          {Eigen::Vector3d::Zero(), Status::without_gravity},
          {Eigen::Vector3d(up.z(), up.x(), up.y()), Status::along_x},
          {Eigen::Vector3d(up.x(), up.z(), up.y()), Status::along_y},
          {1e3 * up, Status::implausible}};
      for (const auto& [felt, status] : lies) {
        ++count;
        EXPECT_EQ(check_specific_force(felt, up), status) << to_string(status) << roll << pitch;
        EXPECT_EQ(contradicts_weight(status), status != Status::calibrated);
      }
    }
  EXPECT_EQ(count, 63);
}

TEST(Doors, ATrajectoryBelowTheGroundOrInDegreesIsRefused) {
  const Undercarriage wheels = *undercarriage(tilt_ropter_vehicle());
  const auto read = [&](const std::string& text) {
    return refusal(
        [&] { (void)examples::read_trajectory(directory.write("path.csv", text), wheels); });
  };
  const std::string head = "time_s,x_m,y_m,z_m,yaw_rad\n";
  EXPECT_EQ(read(head + "0,0,0,1,0\n2,1,0,1,1.5\n"), "not refused");
  EXPECT_EQ(read(head + "0,0,0,1,3.1\n2,1,0,1,-3.1\n"), "not refused");
  EXPECT_NE(read(head + "0,0,0,1,0\n2,1,0,1,90\n").find("path.csv:3: column yaw_rad: 90 looks"),
            std::string::npos);
  EXPECT_NE(read(head + "0,0,0,1,90\n2,1,0,1,90\n").find("path.csv:2: column yaw_rad: 90 looks"),
            std::string::npos);
  for (const char* z : {"-1", "0.01"})
    EXPECT_NE(read(head + "0,0,0,1,0\n2,1,0," + z + ",0\n").find("path.csv:3: column z_m: "),
              std::string::npos);
  EXPECT_NE(read("time_s,x_m,y_m,z_m,yaw_rad,yaw_deg\n0,0,0,1,0,0\n1,0,0,1,0,0\n").find("not both"),
            std::string::npos);
  // Other units: too fast, too strong, too slow, in another world, or in degrees.
  const auto scaled = [&](double time, double metres, double x) {
    std::string text = head;
    for (int i = 0; i <= 20; ++i) {
      const double s = 0.05 * i;
      const std::string place = std::to_string(x + metres * s * s * (3.0 - 2.0 * s));
      text += std::to_string(time * i) + ',' + place + ',' + place + ",1,0\n";
    }
    return read(text);
  };
  EXPECT_EQ(scaled(0.4, 2.0, 0.0), "not refused");
  EXPECT_NE(scaled(0.4, 2e3, 0.0).find("m/s^2: are the columns in m and s?"), std::string::npos);
  EXPECT_NE(scaled(0.4 / 60.0, 2.0, 0.0).find("path.csv:3: "), std::string::npos);
  for (const double unit : {1e3, 1e6, 1e9})
    EXPECT_NE(scaled(0.4 * unit, 2.0, 0.0).find("path.csv: the trajectory is nowhere faster"),
              std::string::npos);
  for (const double x : {4.6e5, -5.2e6})
    EXPECT_NE(scaled(0.4, 2.0, x).find("path.csv: column x_m is from "), std::string::npos);
  EXPECT_NE(scaled(0.4, 2e-5, 47.3).find("Not UTM, not degrees"), std::string::npos);
  const Mission turn = examples::read_trajectory(
      directory.write("path.csv", "time_s,x_m,y_m,z_m,yaw_deg\n0,0,0,1,0\n2,1,0,1,90\n"), wheels);
  EXPECT_NEAR(yaw_of(turn(2.0).orientation), pi / 2.0, 1e-9);
}

}  // namespace doors_test
