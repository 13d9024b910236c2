#pragma once

#include <unistd.h>

#include <cstddef>
#include <iostream>
#include <string>

namespace examples {

/// How far a long run is: a bar on a terminal; elsewhere a line whenever what is being done
/// changes. On standard error, for results to be piped.
class Progress {
 public:
  /// `share` of the run is done, from 0 to 1; `doing` says what is being done now.
  void show(double share, const std::string& doing) {
    const auto done = static_cast<std::size_t>(25.0 * share);
    const int percent = static_cast<int>(100.0 * share);
    if (terminal_)
      std::cerr << "\r[" << std::string(done, '#') << std::string(25 - done, '.') << "] " << percent
                << " %  " << doing << "        " << std::flush;
    else if (doing != last_)
      std::cerr << percent << " % " << doing << std::endl;
    last_ = doing;
  }

  void finish() { std::cerr << (terminal_ ? "\r" : "") << "100 %" << std::string(50, ' ') << '\n'; }

 private:
  bool terminal_ = isatty(STDERR_FILENO) != 0;
  std::string last_;
};

}  // namespace examples
