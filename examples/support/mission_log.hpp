#pragma once

#include <charconv>
#include <cstddef>
#include <fstream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace examples {

/// Writes a CSV file with a header line, row by row. PlotJuggler and gnuplot can open it.
class MissionLog {
 public:
  /// Throws std::runtime_error if the file cannot be written.
  MissionLog(const std::string& path, std::vector<std::string> columns)
      : path_(path), columns_(std::move(columns)), file_(path) {
    if (!file_) throw std::runtime_error("cannot write " + path);
    for (std::size_t i = 0; i < columns_.size(); ++i) file_ << (i ? "," : "") << columns_[i];
    file_ << '\n';
  }

  MissionLog& add(double value) {
    char digits[32];  // std::to_chars takes a third of the time of a stream
    char* const end =
        std::to_chars(digits, std::end(digits), value, std::chars_format::general, 8).ptr;
    if (count_++ > 0) row_ += ',';
    row_.append(digits, end);
    return *this;
  }

  template <typename Vector>
  MissionLog& add_all(const Vector& values) {
    for (int i = 0; i < values.size(); ++i) add(values(i));
    return *this;
  }

  /// Ends the row. Throws std::logic_error if the row has a different number of values than the
  /// header, and std::runtime_error if writing fails, for example because the disk is full.
  void end_row() {
    if (count_ != columns_.size())
      throw std::logic_error(path_ + ": row of " + std::to_string(count_) + " values under " +
                             std::to_string(columns_.size()) + " columns");
    row_ += '\n';
    file_ << row_;
    if (!file_) throw std::runtime_error("cannot write " + path_);
    row_.clear();
    count_ = 0;
  }

 private:
  std::string path_;
  std::vector<std::string> columns_;
  std::ofstream file_;
  std::string row_;
  std::size_t count_ = 0;
};

}  // namespace examples
