#pragma once

#include "program.hpp"

#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <string>
#include <utility>

namespace test_support {

/// Runs a program in the background. wait() returns its exit code and its output.
class Background {
 public:
  Background(const std::string& program, const std::string& arguments, std::string report)
      : report_(std::move(report)) {
    pid_ = fork();
    if (pid_ == 0) {
      const std::string command =
          "exec '" + program + "' " + arguments + " > '" + report_ + "' 2>&1";
      execl("/bin/sh", "sh", "-c", command.c_str(), static_cast<char*>(nullptr));
      _exit(127);
    }
  }
  ~Background() {
    if (pid_ > 0) crash();
  }
  Background(const Background&) = delete;
  Background& operator=(const Background&) = delete;

  void crash() {
    kill(pid_, SIGKILL);
    wait();
  }
  /// Asks the program to end, as Ctrl-C does.
  Outcome stop() {
    kill(pid_, SIGINT);
    return wait();
  }
  Outcome wait() {
    int status = 0;
    waitpid(pid_, &status, 0);
    pid_ = -1;
    Outcome outcome = run("cat", "'" + report_ + "'");
    outcome.exit_code = WIFEXITED(status) ? WEXITSTATUS(status) : -1;
    return outcome;
  }

 private:
  std::string report_;
  pid_t pid_ = -1;
};

}  // namespace test_support
