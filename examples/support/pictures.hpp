#pragma once

#include <cstdlib>
#include <filesystem>
#include <iostream>
#include <string>

namespace examples {

/// Runs a gnuplot script of the examples in `directory`. The script reads its data there and writes
/// its pictures there. A failure prints a message on standard error but does not change the result
/// of the program.
inline void draw_pictures(const std::string& script, const std::string& directory) {
  std::cout << "drawing pictures in " << directory << " (gnuplot)" << std::endl;
  const std::string path = TILT_ROPTER_EXAMPLES_DIR "/" + script;
  std::filesystem::current_path(directory);
  if (std::system(("gnuplot '" + path + "'").c_str()) != 0)
    std::cerr << "no pictures: gnuplot is missing or failed on " << path << '\n';
}

}  // namespace examples
