// Readers of CSV files: any bytes give what the program needs, or an error that says where.

#include "../../examples/support/csv.hpp"
#include "../../examples/support/flight_table.hpp"
#include "../../examples/support/instances.hpp"
#include "fuzz/input.hpp"

#include <sys/mman.h>
#include <unistd.h>

#include <cmath>
#include <sstream>

namespace {

// Logs: columns of one length.
void read_log(fuzz::Input& input) {
  const auto allowed = input.coin() ? examples::CsvNumbers::any : examples::CsvNumbers::finite;
  std::vector<std::string> wanted;
  std::string text;
  if (input.coin()) {
    wanted = {"time_s", "b"};
    text = "a,time_s,b\n";
  }
  std::istringstream in(text + input.rest());
  try {
    const examples::CsvTable table = examples::read_csv(in, "log.csv", wanted, allowed);
    fuzz::expect(!table.names.empty() && table.columns.size() == table.names.size(),
                 "each column has a name");
    for (const std::vector<double>& column : table.columns) {
      fuzz::expect(column.size() == table.rows(), "columns are of one length");
      for (const double value : column)
        fuzz::expect(allowed == examples::CsvNumbers::any || std::isfinite(value),
                     "numbers are finite");
    }
    for (const std::string& name : table.names)
      fuzz::expect(table.has(name) && table[name].size() == table.rows(), "columns by name");
  } catch (const std::runtime_error& error) {
    fuzz::expect(std::string(error.what()).rfind("log.csv:", 0) == 0, "an error says where");
  }
}

// Tables of a Monte Carlo: what merge_flights() accepts can be ranked and printed.
void read_flights(fuzz::Input& input) {
  static const int file = memfd_create("flights.csv", 0);
  static const std::string path = "/proc/self/fd/" + std::to_string(file);
  static const std::vector<std::string> columns = examples::flight_columns();
  std::string text;
  for (const std::string& name : columns) (text += text.empty() ? "" : ",") += name;
  const int rows = input.integer(0, 6);
  for (int row = 0; row < rows; ++row) {
    std::ostringstream line;
    line << '\n' << (input.integer(0, 7) == 0 ? input.number(9.0) : 1.0);  // seed
    line << ',' << (input.integer(0, 7) == 0 ? input.number(9.0) : row);   // index
    for (std::size_t i = 2; i < columns.size(); ++i)
      line << ',' << (columns[i] == "verdict" ? input.integer(0, 3) : input.number(3.0));
    text += line.str();
  }
  text += '\n' + input.rest();
  fuzz::expect(ftruncate(file, 0) == 0 &&
                   pwrite(file, text.data(), text.size(), 0) == static_cast<ssize_t>(text.size()),
               "the file can be written");
  try {
    const examples::CsvTable flights = examples::merge_flights({path});
    fuzz::expect(examples::worst_first(flights).size() == flights.rows(), "every row has a place");
    std::ostringstream out;
    examples::print_flights(out, flights, "monte_carlo");
    fuzz::expect(!out.str().empty(), "there is a summary");
  } catch (const std::runtime_error&) {
  }
}

void expect_the_same(const examples::Instance& instance) {
  examples::InstanceError error;
  const auto again = examples::parse_instance(examples::to_csv(instance), error);
  fuzz::expect(again.has_value() && again->id == instance.id && again->bounds == instance.bounds,
               "what is written can be read");
  // Quaternions may be rounded differently, because they are normalised a second time.
  fuzz::expect(again->start.body.position == instance.start.body.position &&
                   again->reference.velocity == instance.reference.velocity &&
                   again->external.torque == instance.external.torque,
               "what is written is read");
  fuzz::expect(std::abs(instance.start.body.orientation.norm() - 1.0) < 1e-9 &&
                   std::abs(instance.reference.orientation.norm() - 1.0) < 1e-9,
               "quaternions are of unit length");
  fuzz::expect(is_finite(instance.start.body) && is_finite(instance.start.wrench) &&
                   is_finite(instance.external) && is_finite(instance.reference),
               "numbers are finite");
}

// Instances of the benchmark's problem: each that is read stays the same when it is written and
// read.
void read_problems(fuzz::Input& input) {
  std::string text = input.coin() ? "" : examples::instance_header() + '\n';
  const int rows = input.integer(0, 3);
  for (int row = 0; row < rows; ++row) {
    text += input.integer(0, 7) == 0 ? input.text(8) : "a";
    text += input.coin() ? ",paper" : ",wide";
    for (std::size_t i = 2; i < examples::instance_columns.size(); ++i)
      text += ',' + (input.integer(0, 31) == 0 ? input.text(8)
                                               : examples::to_csv(input.uniform(-9.0, 9.0)));
    text += '\n';
  }
  std::istringstream in(text + input.rest());
  const examples::InstanceFile file = examples::read_instances(in);
  for (const examples::Instance& instance : file.instances) expect_the_same(instance);
  for (const examples::InstanceError& error : file.errors)
    fuzz::expect(error.line >= 1 && error.column >= 1 && !error.message.empty(),
                 "an error says where and what");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  switch (input.integer(0, 2)) {
    case 0:
      read_log(input);
      break;
    case 1:
      read_flights(input);
      break;
    default:
      read_problems(input);
      break;
  }
  return 0;
}
