// Monte Carlo tables: any table that merge_flights() accepts can be ranked and printed.

#include "../../examples/support/flight_table.hpp"
#include "fuzz/input.hpp"

#include <sys/mman.h>
#include <unistd.h>

#include <cmath>
#include <sstream>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  static const int file = memfd_create("flights.csv", 0);
  static const std::string path = "/proc/self/fd/" + std::to_string(file);
  static const std::vector<std::string> columns = examples::flight_columns();
  fuzz::Input input(bytes, size);
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
  return 0;
}
