#pragma once

#include <unistd.h>

#include <cstddef>
#include <iostream>
#include <string>

namespace examples {

/// Shows the progress of a long run on standard error, so that results can be piped: a bar on a
/// terminal, otherwise a line whenever the current activity changes, and every tenth of the run.
class Progress {
 public:
  /// `fraction` of the run that is done, 0 to 1. `doing`: the current activity.
  void show(double fraction, const std::string& doing) {
    const auto done = static_cast<std::size_t>(25.0 * fraction);
    const int percent = static_cast<int>(100.0 * fraction);
    if (terminal_)
      std::cerr << "\r[" << std::string(done, '#') << std::string(25 - done, '.') << "] " << percent
                << " %  " << doing << "        " << std::flush;
    else if (doing != last_ || percent / 10 != tenths_)
      std::cerr << percent << " % " << doing << std::endl;
    last_ = doing;
    tenths_ = percent / 10;
  }

  void finish() { std::cerr << (terminal_ ? "\r" : "") << "100 %" << std::string(50, ' ') << '\n'; }

 private:
  bool terminal_ = isatty(STDERR_FILENO) != 0;
  std::string last_;
  int tenths_ = 0;
};

}  // namespace examples
