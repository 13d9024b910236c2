// Reader of logs: any bytes give a table with equally long columns, or an error with file and line.

#include "../../examples/support/csv.hpp"
#include "fuzz/input.hpp"

#include <cmath>
#include <sstream>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
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
  return 0;
}
