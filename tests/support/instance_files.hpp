#pragma once

#include "../../examples/support/instances.hpp"

#include "support/benchmark_problem.hpp"

#include <cstddef>
#include <sstream>
#include <string>
#include <vector>

/// Instances of the benchmark problem and the text of files of them.
namespace test_support {

/// Returns the instance of the benchmark problem STEP.
inline examples::Instance step_instance() {
  examples::Instance instance;
  instance.id = "step";
  instance.start = step_start();
  instance.reference.position << 0.0, 0.0, 1.5;
  return instance;
}

/// Returns an instance with this id that hovers on its reference.
inline examples::Instance at_rest(const std::string& id) {
  examples::Instance instance;
  instance.id = id;
  instance.start.wrench.force = benchmark_hover_force();
  return instance;
}

/// Returns the fields of a CSV line.
inline std::vector<std::string> split(const std::string& line) {
  std::vector<std::string> fields;
  std::istringstream in(line);
  for (std::string field; std::getline(in, field, ',');) fields.push_back(field);
  return fields;
}

/// Returns the line of step_instance() with the field of one column replaced.
inline std::string line_with(const std::string& column, const std::string& value) {
  std::string line;
  const std::vector<std::string> fields = split(examples::to_csv(step_instance()));
  for (std::size_t i = 0; i < fields.size(); ++i)
    line += (i ? "," : "") + (examples::instance_columns[i] == column ? value : fields[i]);
  return line;
}

/// Reads the text of an instance file.
inline examples::InstanceFile read(const std::string& text) {
  std::istringstream in(text);
  return examples::read_instances(in);
}

/// Returns the text of an instance file with these lines below the header line.
inline std::string file_of(const std::vector<std::string>& lines) {
  std::string text = examples::instance_header() + '\n';
  for (const std::string& line : lines) text += line + '\n';
  return text;
}

}  // namespace test_support
