#pragma once

#include <cstdlib>
#include <filesystem>
#include <iostream>
#include <string>

namespace examples {

/// Runs a gnuplot script of the examples in `directory`, where it reads its data and leaves its
/// pictures. Says so on standard error if that fails; a program's result does not hang on pictures.
inline void draw_pictures(const std::string& script, const std::string& directory) {
  std::cout << "drawing pictures in " << directory << " (gnuplot)" << std::endl;
  const std::string path = TILT_ROPTER_EXAMPLES_DIR "/" + script;
  std::filesystem::current_path(directory);
  if (std::system(("gnuplot '" + path + "'").c_str()) != 0)
    std::cerr << "no pictures: gnuplot is missing or failed on " << path << '\n';
}

}  // namespace examples
