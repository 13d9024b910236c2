// The CSV reader of the examples.

#include "../../examples/support/csv.hpp"

#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <cstddef>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace csv_test {

using examples::CsvNumbers;
using examples::CsvTable;
using examples::read_csv;
using Column = std::vector<double>;

CsvTable read(const std::string& text, const std::vector<std::string>& wanted = {},
              CsvNumbers allowed = CsvNumbers::finite) {
  std::istringstream in(text);
  return read_csv(in, "log.csv", wanted, allowed);
}

/// Error message of reading `text`; "not refused" if there is no error.
std::string refusal(const std::string& text, const std::vector<std::string>& wanted = {},
                    CsvNumbers allowed = CsvNumbers::finite) {
  try {
    (void)read(text, wanted, allowed);
  } catch (const std::runtime_error& error) {
    return error.what();
  }
  return "not refused";
}

TEST(Csv, ReadsColumnsByNameInRequestedOrder) {
  const std::string text = "time_s,note,angle_rad\n0.5,first,-1e-3\n1,,+2.25\n";
  const CsvTable table = read(text, {"angle_rad", "time_s"});
  EXPECT_EQ(table.names, (std::vector<std::string>{"angle_rad", "time_s"}));
  EXPECT_EQ(table.columns[0], (Column{-1e-3, 2.25}));
  EXPECT_EQ(table["time_s"], (Column{0.5, 1.0}));
  EXPECT_EQ(table.rows(), 2u);
  EXPECT_TRUE(table.has("time_s"));
  EXPECT_FALSE(table.has("note"));
  EXPECT_THROW((void)table["note"], std::runtime_error);
}

TEST(Csv, ReadsAllColumnsIfNoneIsRequested) {
  const CsvTable table = read("a,b\n1,2\n3,4\n");
  EXPECT_EQ(table.names, (std::vector<std::string>{"a", "b"}));
  EXPECT_EQ(table["a"], (Column{1.0, 3.0}));
  EXPECT_EQ(table["b"], (Column{2.0, 4.0}));
}

TEST(Csv, ReadsOptionalColumnsIfPresent) {
  std::istringstream with("x,b,a\nnote,2,1\n"), without("x,a\nnote,1\n");
  const std::vector<std::string> wanted = {"a"}, optional = {"c", "b"};
  const CsvTable both = examples::read_csv(with, "log.csv", wanted, CsvNumbers::finite, optional);
  EXPECT_EQ(both.names, (std::vector<std::string>{"a", "b"}));
  EXPECT_EQ(both["b"], std::vector<double>{2.0});
  EXPECT_FALSE(both.has("c"));
  EXPECT_EQ(examples::read_csv(without, "log.csv", wanted, CsvNumbers::finite, optional).names,
            wanted);
}

TEST(Csv, IgnoresCommentsBlankLinesAndByteOrderMark) {
  const CsvTable table = read(
      "\xEF\xBB\xBF# a comment\r\n\r\n  # another\r\n a ,\tb\r\n1 , 2\r\n# in between\r\n  \r\n"
      "3,4\r\n\r\n\n\n");
  EXPECT_EQ(table["a"], (Column{1.0, 3.0}));
  EXPECT_EQ(table["b"], (Column{2.0, 4.0}));
  EXPECT_EQ(table.lines, (std::vector<std::size_t>{5, 8}));
  EXPECT_EQ(read("\xEF\xBB\xBF"
                 "a\n1")["a"],
            (Column{1.0}));
}

TEST(Csv, HeaderLineAloneGivesAnEmptyTable) {
  EXPECT_EQ(read("a,b").rows(), 0u);
  EXPECT_TRUE(read("a,b")["b"].empty());
}

TEST(Csv, ErrorsNameFileLineAndColumn) {
  const std::string head = "# log\ntime_s,angle_rad\n0,1\n";
  EXPECT_EQ(refusal(head + "1,two\n"), "log.csv:4: column angle_rad (2): 'two' is not a number");
  EXPECT_EQ(refusal(head + "\n,2\n"), "log.csv:5: column time_s (1): '' is not a number");
  EXPECT_EQ(refusal(head + "1,2 3\n"), "log.csv:4: column angle_rad (2): '2 3' is not a number");
  EXPECT_EQ(refusal(head + "1,+-2\n"), "log.csv:4: column angle_rad (2): '+-2' is not a number");
  EXPECT_EQ(refusal(head + "1,0x2\n"), "log.csv:4: column angle_rad (2): '0x2' is not a number");
  EXPECT_EQ(refusal(head + "1e999,2\n"),
            "log.csv:4: column time_s (1): '1e999' is out of the range of a double");
  EXPECT_EQ(refusal(head + "1\n"), "log.csv:4: 1 fields, the header line has 2");
  EXPECT_EQ(refusal(head + "1,2,\n"), "log.csv:4: 3 fields, the header line has 2");
  EXPECT_EQ(refusal(head, {"command_rad"}),
            "log.csv:2: no column command_rad, the header line has 'time_s', 'angle_rad'");
  EXPECT_EQ(refusal("a,b,a\n1,2,3\n", {"a"}), "log.csv:1: column a is there twice");
  EXPECT_EQ(refusal("a,,b\n1,2,3\n"), "log.csv:1: column (2) has no name");
  EXPECT_EQ(refusal(""), "log.csv:1: no header line");
  EXPECT_EQ(refusal("\n# nothing\n"), "log.csv:2: no header line");
}

TEST(Csv, ReadsNonFiniteNumbersOnlyIfAllowed) {
  EXPECT_EQ(refusal("a\nnan\n"), "log.csv:2: column a (1): 'nan' is not finite");
  EXPECT_EQ(refusal("a\n-inf\n"), "log.csv:2: column a (1): '-inf' is not finite");
  const CsvTable table = read("a\nnan\n-inf\n", {}, CsvNumbers::any);
  EXPECT_TRUE(std::isnan(table["a"][0]));
  EXPECT_TRUE(std::isinf(table["a"][1]));
  EXPECT_EQ(refusal("a\nnone\n", {}, CsvNumbers::any),
            "log.csv:2: column a (1): 'none' is not a number");
}

TEST(Csv, ErrorsMaskControlCharactersAndAreShort) {
  EXPECT_EQ(refusal("a\n1\x1b[2J\n"), "log.csv:2: column a (1): '1?[2J' is not a number");
  EXPECT_EQ(refusal("a\n" + std::string(1000, 'x') + "\n"),
            "log.csv:2: column a (1): '" + std::string(40, 'x') + "...' is not a number");
}

TEST(Csv, ReadsFilesAndNamesUnreadableOnes) {
  namespace fs = std::filesystem;
  const fs::path path = fs::path(testing::TempDir()) / ("csv_" + std::to_string(getpid()) + ".csv");
  std::ofstream(path) << "a\n1\n";
  EXPECT_EQ(read_csv(path.string())["a"], (Column{1.0}));
  fs::remove(path);
  for (const std::string& bad : {path.string(), testing::TempDir()}) {
    try {
      (void)read_csv(bad);
      ADD_FAILURE() << bad << " was read";
    } catch (const std::runtime_error& error) {
      EXPECT_EQ(error.what(), "cannot read " + bad);
    }
  }
}

}  // namespace csv_test
