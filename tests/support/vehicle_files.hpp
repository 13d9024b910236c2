#pragma once

#include <gtest/gtest.h>

#include <string>

/// Files of vehicles. Programs that include this header need VEHICLES_DIR, which CMake sets.
namespace test_support {

/// Returns the path of a vehicle file of the examples.
inline std::string shipped(const std::string& name) {
  return VEHICLES_DIR "/" + name + ".json";
}

/// Returns the text with the first `find` replaced.
inline std::string with(std::string text, const std::string& find, const std::string& replace) {
  EXPECT_NE(text.find(find), std::string::npos) << find;
  return text.replace(text.find(find), find.size(), replace);
}

}  // namespace test_support
