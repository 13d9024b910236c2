// Runs reproduce_paper with hardware in the loop, in real time.
// CTest: long real_time dds

#include "support/dds_on_loopback.hpp"
#include "support/program.hpp"

#include <gtest/gtest.h>

#include <string>

namespace reproduce_paper_hitl_test {

TEST(ReproducePaperHitl, StartsTheThreeProgramsAndReadsTheirFigures) {
  test_support::dds_on_loopback();
  const test_support::Directory directory("reproduce_paper_hitl");
  const test_support::Outcome loop = test_support::run(
      REPRODUCE_PAPER_PROGRAM,  // set by CMake
      "--no-pictures --only hitl --hitl-until 3 --output '" + directory.file("") + "'");
  ASSERT_EQ(loop.exit_code, 0) << loop.output;
  EXPECT_LT(loop["hybrid_library_hitl_rmse_from_start_m"], 0.05);
  EXPECT_NE(test_support::read_file(directory.file("hitl_onboard.txt")).find("onboard_ticks: "),
            std::string::npos);
}

}  // namespace reproduce_paper_hitl_test
