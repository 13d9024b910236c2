// Reader of PX4's logs: any bytes give columns of one length, or an error with file and byte.

#include "../../examples/support/ulog.hpp"
#include "../support/ulog_writer.hpp"
#include "fuzz/input.hpp"

#include <string>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  test_support::UlogWriter log;
  if (input.coin()) {
    log.format("u:float a;int8_t b;");
    log.format("t:uint64_t timestamp;float[2] x;u[2] y;uint8_t[3] _padding0;");
    (void)log.subscribe("t");
    (void)log.subscribe("t", 1);
  }
  std::string text = log.bytes();
  if (input.coin()) text[16 + 3 + 8] = 1;  // data was appended
  if (input.coin()) text[16 + 3 + 16] = static_cast<char>(input.integer(0, 255));
  try {
    const examples::Ulog read("log.ulg", text + input.rest());
    for (const char* topic : {"t", "t:1"}) {
      if (!read.has(topic)) continue;
      for (const char* field : {"timestamp", "x[1]", "y[1].b"}) {
        if (!read.has(topic, field)) continue;
        const examples::CsvTable table = read.table(topic, {field});
        fuzz::expect(table.columns.size() == 1 && table.columns[0].size() == table.rows(),
                     "a number for each message");
      }
    }
    (void)read.table("nothing", {"x"});
  } catch (const tilt_ropter::InputFileError& error) {
    fuzz::expect(std::string(error.what()).rfind("log.ulg: ", 0) == 0, "an error says where");
  }
  return 0;
}
