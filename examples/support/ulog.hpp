#pragma once

#include "../../cmake/vehicle_file/tilt_ropter/input_file_error.hpp"
#include "csv.hpp"

#include <cstddef>
#include <cstdint>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace examples {

/// True if the name ends in .ulg, or the file begins as ULog files do.
[[nodiscard]] bool is_ulog(const std::string& path);

/// A log of PX4 (docs.px4.io, "ULog File Format"). All functions throw InputFileError that names
/// file, byte and what is expected there.
class Ulog {
 public:
  /// Reads the file. A last message that is cut off, as without power, is noted and ignored.
  explicit Ulog(const std::string& path);
  /// The same for the bytes of a file; `path` is its name in messages.
  Ulog(const std::string& path, std::string bytes);

  /// What was done that the file does not say, one sentence each.
  [[nodiscard]] const std::vector<std::string>& notes() const { return notes_; }
  /// `topic`: its name, or NAME:ID for an instance other than 0. True if there is data of it.
  [[nodiscard]] bool has(const std::string& topic) const;
  [[nodiscard]] bool has(const std::string& topic, const std::string& field) const;
  /// The fields as columns, such as timestamp [us], control[3], esc[0].esc_rpm; one row for each
  /// message, whose byte in the file is in `lines`.
  [[nodiscard]] CsvTable table(const std::string& topic,
                               const std::vector<std::string>& fields) const;

 private:
  struct Field {
    std::string type, name;
    std::size_t offset = 0;  ///< in the message [bytes]
  };
  struct Topic {
    std::string name;               ///< with :ID if it is not 0
    std::vector<Field> fields;      ///< numbers, those of nested messages, too
    std::size_t size = 0;           ///< least size of a message, without padding at its end
    std::vector<std::size_t> data;  ///< where each message begins
  };
  using Format = std::vector<std::pair<std::string, std::string>>;  ///< type, name

  [[noreturn]] void refuse(std::size_t at, const std::string& what) const;
  [[nodiscard]] std::uint64_t number(std::size_t at, std::size_t size) const;
  [[nodiscard]] double value(const Field& field, std::size_t message) const;
  void read_messages(std::size_t begin, std::size_t end);
  void read_flags(std::size_t at, std::size_t size);
  void read_format(std::size_t at, std::size_t size);
  void subscribe(std::size_t at, std::size_t size);
  void add_fields(Topic& topic, const std::string& format, const std::string& prefix,
                  std::size_t at, int depth) const;
  [[nodiscard]] const Topic& topic(const std::string& name) const;
  [[nodiscard]] const Topic* find(const std::string& name) const;
  [[nodiscard]] static const Field* find(const Topic& topic, const std::string& name);

  std::string path_, bytes_;
  std::vector<std::string> notes_;
  std::vector<std::size_t> appended_;
  std::map<std::string, Format> formats_;
  std::map<std::uint64_t, Topic> topics_;  ///< by the id of their messages
  std::vector<Topic> ended_;               ///< whose id was given up
};

}  // namespace examples
