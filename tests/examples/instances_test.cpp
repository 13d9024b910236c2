// Instance files are read exactly, and every error in them is reported with its place.

#include "../../examples/support/instances.hpp"

#include "support/instance_files.hpp"
#include "support/random.hpp"

#include <gtest/gtest.h>

#include <Eigen/Geometry>

#include <cstddef>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace instances_test {

using examples::Instance;
using examples::instance_columns;
using examples::instance_header;
using examples::InstanceBounds;
using examples::InstanceError;
using examples::InstanceFile;
using examples::parse_instance;
using examples::to_csv;
using test_support::at_rest;
using test_support::file_of;
using test_support::line_with;
using test_support::read;
using test_support::split;
using test_support::step_instance;

TEST(Instances, WrittenInstancesAreReadBack) {
  test_support::Random random(1);
  for (int i = 0; i < 1000; ++i) {
    Instance in = step_instance();
    in.id = "run " + std::to_string(i);
    in.bounds = i % 2 == 0 ? InstanceBounds::paper : InstanceBounds::wide;
    in.external = {random.vector(3.0), random.vector(1e-300)};
    in.start.wrench = {random.vector(1e300), random.vector(0.1)};
    in.start.body.position = random.vector(2.0);
    in.start.body.velocity = random.vector(2.0);
    in.start.body.orientation = random.orientation();
    in.start.body.angular_velocity = random.vector(3.0);
    in.reference.position = random.vector(1.0);
    in.reference.velocity = random.vector(1.0);
    in.reference.orientation = random.orientation();
    InstanceError error;
    const auto out = parse_instance(to_csv(in), error);
    ASSERT_TRUE(out) << error.message;
    EXPECT_EQ(out->id, in.id);
    EXPECT_EQ(out->bounds, in.bounds);
    EXPECT_EQ(out->external.force, in.external.force);
    EXPECT_EQ(out->external.torque, in.external.torque);
    EXPECT_EQ(out->start.wrench.force, in.start.wrench.force);
    EXPECT_EQ(out->start.wrench.torque, in.start.wrench.torque);
    EXPECT_EQ(out->start.body.position, in.start.body.position);
    EXPECT_EQ(out->start.body.velocity, in.start.body.velocity);
    EXPECT_EQ(out->start.body.angular_velocity, in.start.body.angular_velocity);
    EXPECT_EQ(out->reference.position, in.reference.position);
    EXPECT_EQ(out->reference.velocity, in.reference.velocity);
    const auto apart = [](const Eigen::Quaterniond& a, const Eigen::Quaterniond& b) {
      return (a.coeffs() - b.coeffs()).norm();
    };
    EXPECT_LT(apart(out->start.body.orientation, in.start.body.orientation), 1e-15);
    EXPECT_LT(apart(out->reference.orientation, in.reference.orientation), 1e-15);
  }
}

TEST(Instances, RejectsMalformedAndNonFiniteNumbers) {
  InstanceError error;
  const std::map<std::string, double> good = {{"+1.5", 1.5}, {" 2 ", 2.0}, {"\t1e3", 1e3},
                                              {".5", 0.5},   {"5.", 5.0},  {"-0", 0.0}};
  for (const auto& [text, value] : good) {
    const auto instance = parse_instance(line_with("v_y", text), error);
    ASSERT_TRUE(instance) << text << ": " << error.message;
    EXPECT_EQ(instance->start.body.velocity.y(), value) << text;
  }
  const std::map<std::string, std::string> bad = {{"", "is not a number"},
                                                  {" ", "is not a number"},
                                                  {"1.0x", "is not a number"},
                                                  {"x1", "is not a number"},
                                                  {"1 2", "is not a number"},
                                                  {"0x10", "is not a number"},
                                                  {"--1", "is not a number"},
                                                  {"+-1", "is not a number"},
                                                  {"++1", "is not a number"},
                                                  {"+", "is not a number"},
                                                  {"1e", "is not a number"},
                                                  {std::string("1\0", 2), "is not a number"},
                                                  {"\"1\"", "is not a number"},
                                                  {"nan", "is not finite"},
                                                  {"-nan", "is not finite"},
                                                  {"inf", "is not finite"},
                                                  {"-Infinity", "is not finite"},
                                                  {"1e999", "is out of the range of a double"},
                                                  {"1e-999", "is out of the range of a double"}};
  for (const auto& [text, message] : bad) {
    error = {};
    EXPECT_FALSE(parse_instance(line_with("v_y", text), error)) << text;
    EXPECT_NE(error.message.find(message), std::string::npos) << error.message;
    EXPECT_NE(error.message.find("v_y = "), std::string::npos) << error.message;
  }
}

TEST(Instances, ErrorsNameLineAndColumnAndOtherLinesAreRead) {
  const std::string good = to_csv(step_instance());
  const std::string nan = line_with("Fe_y", "NaN");
  const std::string zero = line_with("q_w", "0");
  std::string no_turn = zero;  // all four components of q
  for (const char* name : {"q_x", "q_y", "q_z"}) {
    std::vector<std::string> fields = split(no_turn);
    for (std::size_t i = 0; i < fields.size(); ++i)
      if (instance_columns[i] == name) fields[i] = "0";
    no_turn.clear();
    for (const std::string& field : fields) no_turn += (no_turn.empty() ? "" : ",") + field;
  }
  const InstanceFile file = read(file_of({
      good,                           // 2
      nan,                            // 3: "step,wide,0,NaN"
      line_with("bounds", "wied"),    // 4
      "",                             // 5
      "short,wide,1",                 // 6
      good + ",1",                    // 7
      no_turn,                        // 8
      line_with("id", ""),            // 9
      line_with("id", "a\x1b[2J"),    // 10
      "\xC3\xA9\xC3\xA9,wied",        // 11: two characters of two bytes each
      line_with("bounds", " x"),      // 12: the error starts after the blank
      line_with("ref_q_z", "1e200"),  // 13: can be normalised
      good,                           // 14
  }));
  ASSERT_EQ(file.instances.size(), 3u);
  EXPECT_NEAR(file.instances[1].reference.orientation.z(), 1.0, 1e-15);
  const std::vector<std::pair<std::size_t, std::size_t>> expected = {
      {3, 13}, {4, 6},  {6, 13}, {7, good.size() + 2}, {8, no_turn.find("0,0,0,0,0.5") + 1}, {9, 1},
      {10, 1}, {11, 8}, {12, 7}};
  ASSERT_EQ(file.errors.size(), expected.size());
  for (std::size_t i = 0; i < expected.size(); ++i) {
    EXPECT_EQ(file.errors[i].line, expected[i].first);
    EXPECT_EQ(file.errors[i].column, expected[i].second) << file.errors[i].message;
    EXPECT_EQ(file.errors[i].message.find('\x1b'), std::string::npos);
  }
}

TEST(Instances, QuaternionsAreNormalised) {
  InstanceError error;
  const auto instance = parse_instance(line_with("ref_q_w", "7"), error);
  ASSERT_TRUE(instance);
  EXPECT_EQ(instance->reference.orientation.w(), 1.0);
  EXPECT_FALSE(parse_instance(line_with("ref_q_w", "1e-9"), error));
  EXPECT_NE(error.message.find("ref_q"), std::string::npos);
}

TEST(Instances, AcceptsAnyLineEndsBlankLinesAndByteOrderMark) {
  const std::string a = to_csv(step_instance()), b = to_csv(at_rest("rest"));
  const std::string h = instance_header();
  for (const std::string& text :
       {h + "\n" + a + "\n" + b + "\n", h + "\r\n" + a + "\r\n" + b + "\r\n",
        h + "\n" + a + "\n" + b, h + "\n\n" + a + "\r\n \t\r\n\n" + b + "\n\n\n",
        "\xEF\xBB\xBF" + h + "\n" + a + "\n" + b}) {
    const InstanceFile file = read(text);
    EXPECT_TRUE(file.errors.empty()) << file.errors[0].message;
    ASSERT_EQ(file.instances.size(), 2u) << text;
    EXPECT_EQ(to_csv(file.instances[1]), b);
  }
}

TEST(Instances, RejectsWrongHeaderAndNamesFirstDifference) {
  const std::string h = instance_header();
  const auto error = [](const std::string& header) {
    const InstanceFile file = read(header + "\n" + to_csv(step_instance()) + "\n");
    EXPECT_TRUE(file.instances.empty());
    EXPECT_EQ(file.errors.size(), 1u);
    return file.errors.empty() ? InstanceError{} : file.errors[0];
  };
  std::string renamed = h;
  renamed.replace(renamed.find("Fe_z"), 4, "Fz");
  EXPECT_EQ(error(renamed).column, h.find("Fe_z") + 1);
  EXPECT_NE(error(renamed).message.find("\"Fz\", must be \"Fe_z\""), std::string::npos);
  EXPECT_EQ(error(h + ",more").column, h.size() + 2);
  EXPECT_NE(error(h + ",more").message.find("38 columns, must have 37"), std::string::npos);
  EXPECT_EQ(error("id,bounds").column, 10u);
  EXPECT_NE(error(to_csv(step_instance())).message.find("\"step\", must be \"id\""),
            std::string::npos);
  EXPECT_EQ(read("").errors.size(), 1u);
  EXPECT_EQ(read("\n").errors.size(), 1u);
  EXPECT_EQ(read("\n").errors[0].line, 1u);
}

TEST(Instances, RandomTextGivesValidInstanceOrError) {
  test_support::Random random(3);
  const std::string good = to_csv(step_instance());
  std::string alphabet = "0123456789.,-+eEnaif \t\r\n\"\x80\xff;";
  alphabet.push_back('\0');
  int accepted = 0;
  for (int i = 0; i < 20000; ++i) {
    std::string line = good;
    const int changes = static_cast<int>(random.uniform(0.0, 4.0));
    for (int j = 0; j < changes; ++j) {
      const auto at =
          static_cast<std::size_t>(random.uniform(0.0, static_cast<double>(line.size())));
      const auto c =
          static_cast<std::size_t>(random.uniform(0.0, static_cast<double>(alphabet.size())));
      if (random.uniform(0.0, 1.0) < 0.5)
        line[at] = alphabet[c];
      else
        line.erase(at, static_cast<std::size_t>(random.uniform(1.0, 5.0)));
    }
    InstanceError error;
    if (const auto instance = parse_instance(line, error)) {
      ++accepted;
      EXPECT_TRUE(is_finite(instance->start.body) && is_finite(instance->start.wrench));
      EXPECT_NEAR(instance->start.body.orientation.norm(), 1.0, 1e-12);
    } else {
      EXPECT_FALSE(error.message.empty());
      EXPECT_GE(error.column, 1u);
      EXPECT_LE(error.column, line.size() + 1);
    }
  }
  EXPECT_GT(accepted, 1000);
  EXPECT_LT(accepted, 19000);
}

}  // namespace instances_test
