#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

/// A reader of MCAP files with messages of ROS 2, written from the specification of the format
/// (mcap.dev/spec) and from that of CDR. It shares no code with the writer and refuses, by
/// std::runtime_error, what the specification forbids.
namespace test_support {

/// Fields by their path, such as pose.pose.position.x and name[0].
struct McapMessage {
  std::string topic;
  std::uint64_t time = 0;  // [ns]
  std::map<std::string, double> numbers;
  std::map<std::string, std::string> texts;
};

struct McapFile {
  std::string profile;
  std::map<std::string, std::string> types;  // by topic
  std::vector<McapMessage> messages;
  std::size_t chunks = 0;

  [[nodiscard]] std::vector<McapMessage> of(const std::string& topic) const {
    std::vector<McapMessage> found;
    for (const McapMessage& m : messages)
      if (m.topic == topic) found.push_back(m);
    return found;
  }
};

class McapReader {
 public:
  static McapFile read(const std::string& bytes) { return McapReader(bytes).file_; }

 private:
  struct Schema {
    std::string name;
    std::map<std::string, std::vector<std::pair<std::string, std::string>>> fields;  // by message
  };
  struct Channel {
    std::string topic;
    const Schema* schema = nullptr;
    std::uint64_t count = 0;
  };
  struct Cursor {
    const std::string& bytes;
    std::size_t at = 0, end = 0;

    std::uint64_t number(std::size_t size) {
      require(at + size <= end, "a number beyond the end");
      std::uint64_t value = 0;
      for (std::size_t i = 0; i < size; ++i)
        value |= std::uint64_t{static_cast<unsigned char>(bytes[at++])} << (8 * i);
      return value;
    }
    std::string text(std::size_t size) {
      require(size <= end - at, "a text beyond the end");
      at += size;
      return bytes.substr(at - size, size);
    }
    std::string text() { return text(number(4)); }
  };

  static void require(bool good, const char* what) {
    if (!good) throw std::runtime_error(what);
  }

  static std::uint32_t check_of(const std::string& bytes) {
    std::uint32_t crc = 0xFFFFFFFFU;
    for (const char c : bytes) {
      crc ^= static_cast<unsigned char>(c);
      for (int i = 0; i < 8; ++i) crc = (crc >> 1) ^ (0xEDB88320U & (0U - (crc & 1U)));
    }
    return ~crc;
  }

  explicit McapReader(const std::string& bytes) : bytes_(bytes) {
    const std::string magic("\x89MCAP0\r\n");
    require(bytes.size() > 2 * magic.size() && bytes.substr(0, 8) == magic, "no magic");
    require(bytes.substr(bytes.size() - 8) == magic, "no magic at the end");
    Cursor in{bytes_, 8, bytes.size() - 8};
    bool summary = false;
    std::uint64_t summary_start = 0, counted = 0;
    for (bool over = false; !over;) {
      const std::size_t start = in.at;
      const std::uint64_t kind = in.number(1), size = in.number(8);
      require(size <= in.end - in.at, "a record beyond the end");
      Cursor r{bytes_, in.at, in.at + size};
      in.at += size;
      require((start == 8) == (kind == 1), "the header is not first");
      switch (kind) {
        case 1:
          file_.profile = r.text(), (void)r.text();
          break;
        case 2: {
          require(summary && r.number(8) == summary_start, "the footer names no summary");
          const std::size_t offsets = r.number(8), check_at = r.at;
          require(offsets > summary_start && offsets < start, "no summary offsets");
          require(r.number(4) == check_of(bytes.substr(summary_start, check_at - summary_start)),
                  "check sum of the summary");
          over = true;
          break;
        }
        case 3:
          add_schema(r, summary);
          break;
        case 4:
          add_channel(r, summary);
          break;
        case 6:
          require(!summary, "a chunk in the summary");
          read_chunk(r, start);
          break;
        case 7:
          r.at = r.end;
          break;  // checked by its chunk's index
        case 8:
          require(summary, "a chunk index before the summary");
          check_index(r);
          break;
        case 11:
          require(r.number(8) == file_.messages.size(), "count of messages");
          require(r.number(2) == schemas_.size() && r.number(4) == channels_.size(), "counts");
          require(r.number(4) == 0 && r.number(4) == 0, "attachments and metadata");
          require(r.number(4) == file_.chunks && r.number(8) == first_ && r.number(8) == last_,
                  "chunks or times");
          for (std::uint64_t left = r.number(4) / 10; left > 0; --left) {
            const std::uint64_t channel = r.number(2);
            require(r.number(8) == channels_.at(channel).count, "count of a channel");
            counted += channels_.at(channel).count;
          }
          require(counted == file_.messages.size(), "counts of channels");
          break;
        case 14: {
          const std::uint64_t group = r.number(1), at = r.number(8), length = r.number(8);
          require(at + length <= start && bytes[at] == static_cast<char>(group), "no such group");
          break;
        }
        case 15:
          require(r.number(4) == check_of(bytes.substr(0, start)), "check sum of the data");
          summary = true;
          summary_start = in.at;
          break;
        default:
          throw std::runtime_error("an unknown record");
      }
      require(r.at == r.end, "a record with more than its fields");
    }
    require(in.at == in.end, "something after the footer");
    require(indexed_ == file_.messages.size(), "messages without index");
  }

  void add_schema(Cursor& r, bool again) {
    Schema schema;
    const std::uint64_t id = r.number(2);
    schema.name = r.text();
    require(id != 0 && (schemas_.count(id) == 1) == again, "schema");
    require(r.text() == "ros2msg", "encoding of a schema");
    std::istringstream lines(r.text());
    std::string message;
    for (std::string line; std::getline(lines, line);) {
      if (line == std::string(80, '=')) {
        require(!std::getline(lines, line).fail() && line.substr(0, 5) == "MSG: ", "MSG:");
        message = line.substr(5);
        continue;
      }
      const std::size_t blank = line.find(' ');
      require(blank != std::string::npos, "a field without name");
      schema.fields[message].emplace_back(line.substr(0, blank), line.substr(blank + 1));
    }
    if (!again) schemas_[id] = schema;
  }

  void add_channel(Cursor& r, bool again) {
    const std::uint64_t id = r.number(2), schema = r.number(2);
    const std::string topic = r.text();
    require(r.text() == "cdr", "encoding of messages");
    r.at += r.number(4);  // metadata
    require(schemas_.count(schema) == 1 && (channels_.count(id) == 1) == again, "channel");
    if (again) return;
    channels_[id] = {topic, &schemas_[schema], 0};
    require(file_.types.emplace(topic, schemas_[schema].name).second, "a topic twice");
  }

  void read_chunk(Cursor& r, std::size_t start) {
    const std::uint64_t first = r.number(8), last = r.number(8), size = r.number(8);
    const std::uint64_t check = r.number(4);
    require(r.text().empty() && r.number(8) == size && size == r.end - r.at, "compressed");
    require(check == check_of(bytes_.substr(r.at, size)), "check sum of a chunk");
    chunk_starts_[start] = r.at;
    ++file_.chunks;
    while (r.at < r.end) {
      message_starts_.insert(r.at);
      require(r.number(1) == 5, "not a message in a chunk");
      const std::uint64_t length = r.number(8);
      require(length <= r.end - r.at, "a message beyond the chunk");
      Cursor m{bytes_, r.at, r.at + length};
      r.at = m.end;
      const auto channel = channels_.find(m.number(2));
      require(channel != channels_.end(), "no such channel");
      require(m.number(4) == channel->second.count++, "sequence");
      McapMessage message;
      message.topic = channel->second.topic;
      message.time = m.number(8);
      require(m.number(8) == message.time, "publish time");
      require(message.time >= first && message.time <= last, "time outside of the chunk");
      if (file_.messages.empty()) first_ = last_ = message.time;
      first_ = std::min(first_, message.time);
      last_ = std::max(last_, message.time);
      require(m.number(4) == 0x100, "not little-endian CDR");
      origin_ = m.at;
      decode(*channel->second.schema, "", "", m, message);
      require(m.at == m.end, "bytes after a message");
      file_.messages.push_back(message);
    }
  }

  void check_index(Cursor& r) {
    (void)r.number(8), (void)r.number(8);  // times
    const std::uint64_t start = r.number(8), length = r.number(8);
    require(chunk_starts_.count(start) == 1, "no chunk where the index says");
    std::uint64_t left = r.number(4) / 10;
    for (; left > 0; --left) {
      const std::uint64_t channel = r.number(2);
      Cursor index{bytes_, r.number(8), bytes_.size()};
      require(index.at >= start + length && index.number(1) == 7, "no message index");
      (void)index.number(8);
      require(index.number(2) == channel, "index of another channel");
      for (std::uint64_t entries = index.number(4) / 16; entries > 0; --entries) {
        (void)index.number(8);
        require(message_starts_.count(chunk_starts_[start] + index.number(8)) == 1, "index");
        ++indexed_;
      }
    }
    (void)r.number(8), (void)r.text(), (void)r.number(8), (void)r.number(8);
  }

  void decode(const Schema& schema, const std::string& message, const std::string& prefix,
              Cursor& in, McapMessage& out) {
    const auto fields = schema.fields.find(message);
    require(fields != schema.fields.end(), "a message that the schema does not define");
    for (const auto& [declared, name] : fields->second) {
      const std::size_t bracket = declared.find('[');
      const std::string type = declared.substr(0, bracket);
      std::uint64_t count = 1;
      if (bracket != std::string::npos)
        count = declared[bracket + 1] == ']' ? aligned(in, 4)
                                             : std::stoul(declared.substr(bracket + 1));
      require(count < 1000, "a long sequence");
      for (std::uint64_t i = 0; i < count; ++i) {
        const std::string path =
            prefix + name + (bracket == std::string::npos ? "" : '[' + std::to_string(i) + ']');
        if (type == "string") {
          std::string text = in.text(aligned(in, 4));
          require(!text.empty() && text.back() == '\0', "a string without its end");
          text.pop_back();
          out.texts[path] = text;
        } else if (type == "float64") {
          const std::uint64_t bits = aligned(in, 8);
          std::memcpy(&out.numbers[path], &bits, sizeof bits);
        } else if (type == "int32" || type == "uint32") {
          out.numbers[path] = static_cast<double>(aligned(in, 4));
        } else {
          decode(schema, type, path + '.', in, out);
        }
      }
    }
  }

  std::uint64_t aligned(Cursor& in, std::size_t size) const {
    while ((in.at - origin_) % size != 0) ++in.at;
    return in.number(size);
  }

  const std::string& bytes_;
  McapFile file_;
  std::map<std::uint64_t, Schema> schemas_;
  std::map<std::uint64_t, Channel> channels_;
  std::map<std::size_t, std::size_t> chunk_starts_;  // of the chunk and of its messages
  std::set<std::size_t> message_starts_;
  std::uint64_t first_ = 0, last_ = 0, indexed_ = 0;
  std::size_t origin_ = 0;
};

}  // namespace test_support
