#pragma once

#include "flight_request.hpp"
#include "flight_table.hpp"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <filesystem>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

/// The table of a Monte Carlo run while it is flown: a killed run loses only the flights that were
/// in the air, and is continued later.
namespace examples {

/// A file descriptor, closed by the destructor.
class OpenFile {
 public:
  OpenFile() = default;
  OpenFile(const std::string& path, int flags) : number_(open(path.c_str(), flags, 0666)) {}
  ~OpenFile() {
    if (number_ >= 0) close(number_);
  }
  OpenFile(OpenFile&& other) noexcept : number_(std::exchange(other.number_, -1)) {}
  OpenFile& operator=(OpenFile&& other) noexcept {
    std::swap(number_, other.number_);
    return *this;
  }

  [[nodiscard]] bool is_open() const { return number_ >= 0; }
  [[nodiscard]] int number() const { return number_; }
  /// False if another process has locked this file. A file system without locks gives true.
  [[nodiscard]] bool lock() const {
    return flock(number_, LOCK_EX | LOCK_NB) == 0 || errno != EWOULDBLOCK;
  }

 private:
  int number_ = -1;
};

/// Appends one row per flight, as it comes, each by a single write. finish() sorts the rows.
class FlightFile {
 public:
  /// Starts the table at `path` for `request`. With `resume`, continues a table that is there,
  /// without the last line if it is damaged. Throws std::runtime_error with the file and the reason
  /// if it cannot be written, is of another run, is damaged elsewhere, or if another process is
  /// writing it.
  FlightFile(std::string path, const FlightRequest& request, bool resume) : path_(std::move(path)) {
    const OpenFile old(path_, O_RDWR | O_CLOEXEC);
    if (old.is_open()) require_lock(old);
    if (old.is_open() && resume) read(request);
    if (!resume) std::filesystem::remove(path_);
    write_request(request, path_);
    const std::string temporary = path_ + ".new";
    file_ = OpenFile(temporary, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC);
    if (!file_.is_open()) refuse_to_write();
    require_lock(file_);
    if (ftruncate(file_.number(), 0) != 0) refuse_to_write();
    write(sorted());
    if (rename(temporary.c_str(), path_.c_str()) != 0) refuse_to_write();
  }

  [[nodiscard]] bool has(std::uint64_t index) const { return rows_.count(index) > 0; }
  [[nodiscard]] std::size_t rows() const { return rows_.size(); }
  /// What was wrong with the last line of a continued table, or empty.
  [[nodiscard]] const std::string& damage() const { return damage_; }

  void add(std::uint64_t index, std::string row) {
    row += '\n';
    write(row);
    in_order_ = in_order_ && (rows_.empty() || rows_.rbegin()->first < index);
    rows_.emplace(index, std::move(row));
  }

  /// Sorts the rows by the index of the vehicle.
  void finish() const {
    if (!in_order_) write_atomically(path_, sorted());
  }

 private:
  void read(const FlightRequest& request) {
    require_same_run(read_request(path_), path_, request, "this run");
    const FlightPart part = read_flights(path_, true);
    damage_ = part.damage;
    for (std::size_t i = 0; i < part.flights.rows(); ++i) {
      const auto seed = static_cast<std::uint64_t>(part.flights["seed"][i]);
      const auto index = static_cast<std::uint64_t>(part.flights["index"][i]);
      const std::string where = path_ + ':' + std::to_string(part.flights.lines[i]) + ": vehicle " +
                                std::to_string(index) + " of seed " + std::to_string(seed);
      if (seed != request.seed || index < request.first || index >= request.end())
        throw std::runtime_error(where + " is not in this run, which has vehicles " +
                                 std::to_string(request.first) + " to " +
                                 std::to_string(request.end() - 1) + " of seed " +
                                 std::to_string(request.seed));
      if (!rows_.emplace(index, flight_line(part.flights, i) + '\n').second)
        throw std::runtime_error(where + " is there twice");
    }
  }

  [[nodiscard]] std::string sorted() const {
    std::string text = joined(flight_columns()) + '\n';
    for (const auto& [index, row] : rows_) text += row;
    return text;
  }

  void write(const std::string& text) const {
    for (std::size_t done = 0; done < text.size();) {
      const ssize_t n = ::write(file_.number(), text.data() + done, text.size() - done);
      if (n < 0 && errno != EINTR) refuse_to_write();
      done += static_cast<std::size_t>(std::max<ssize_t>(n, 0));
    }
  }

  void require_lock(const OpenFile& file) const {
    if (!file.lock()) throw std::runtime_error(path_ + ": another process is writing it");
  }
  [[noreturn]] void refuse_to_write() const {
    throw std::runtime_error("cannot write " + path_ + ": " + std::strerror(errno));
  }

  std::string path_, damage_;
  OpenFile file_;
  std::map<std::uint64_t, std::string> rows_;
  bool in_order_ = true;
};

}  // namespace examples
