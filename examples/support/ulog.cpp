#include "ulog.hpp"

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cstring>
#include <fstream>
#include <iterator>
#include <string_view>
#include <system_error>

namespace examples {
namespace {

constexpr std::string_view magic("ULog\x01\x12\x35");
constexpr std::size_t header_size = 16;  // magic, version, time

/// Bytes of a number; 0 for other types.
std::size_t size_of(const std::string& type) {
  static const std::map<std::string, std::size_t> sizes = {
      {"int8_t", 1},   {"uint8_t", 1}, {"bool", 1},     {"char", 1},
      {"int16_t", 2},  {"float", 4},   {"uint16_t", 2}, {"int32_t", 4},
      {"uint32_t", 4}, {"int64_t", 8}, {"uint64_t", 8}, {"double", 8}};
  const auto found = sizes.find(type);
  return found == sizes.end() ? 0 : found->second;
}

std::string bytes_of(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  std::string bytes(std::istreambuf_iterator<char>(in), {});
  if (!in) throw tilt_ropter::InputFileError("cannot read " + path);
  return bytes;
}

}  // namespace

bool is_ulog(const std::string& path) {
  if (path.size() > 4 && path.compare(path.size() - 4, 4, ".ulg") == 0) return true;
  std::ifstream in(path, std::ios::binary);
  std::string start(magic.size(), '\0');
  in.read(start.data(), static_cast<std::streamsize>(start.size()));
  return in && start == magic;
}

Ulog::Ulog(const std::string& path) : Ulog(path, bytes_of(path)) {}

Ulog::Ulog(const std::string& path, std::string bytes) : path_(path), bytes_(std::move(bytes)) {
  if (bytes_.compare(0, magic.size(), magic) != 0)
    refuse(0, "not the start of a ULog file, expected is 'ULog' 01 12 35");
  if (bytes_.size() < header_size) refuse(bytes_.size(), "the file ends within its header");
  // The flags, if any, are in the first message: they say where data was appended later.
  const std::size_t first = header_size + 3;
  if (bytes_.size() >= first && bytes_[header_size + 2] == 'B') {
    const std::size_t size = number(header_size, 2);
    if (size <= bytes_.size() - first) read_flags(first, size);
  }
  std::sort(appended_.begin(), appended_.end());
  std::size_t begin = header_size;
  appended_.push_back(bytes_.size());
  for (const std::size_t end : appended_) {
    read_messages(begin, end);
    begin = end;
  }
}

void Ulog::refuse(std::size_t at, const std::string& what) const {
  throw tilt_ropter::InputFileError(path_ + ": byte " + std::to_string(at) + ": " + what);
}

std::uint64_t Ulog::number(std::size_t at, std::size_t size) const {
  std::uint64_t value = 0;
  for (std::size_t i = 0; i < size; ++i)
    value |= std::uint64_t{static_cast<unsigned char>(bytes_[at + i])} << (8 * i);
  return value;
}

void Ulog::read_messages(std::size_t begin, std::size_t end) {
  for (std::size_t at = begin; at < end;) {
    const std::size_t data = at + 3;
    const bool has_header = data <= end;
    const std::size_t size = has_header ? number(at, 2) : 0;
    if (!has_header || size > end - data) {
      notes_.push_back(path_ + ": byte " + std::to_string(at) + ": the last message is cut off" +
                       (has_header ? ", " + std::to_string(end - data) + " of its " +
                                         std::to_string(size) + " bytes are there"
                                   : std::string()));
      return;
    }
    const auto type = static_cast<unsigned char>(bytes_[at + 2]);
    const auto require = [&](std::size_t least, const char* what) {
      if (size < least)
        refuse(at, std::string(what) + " of " + std::to_string(size) +
                       " bytes, expected are at least " + std::to_string(least));
    };
    switch (type) {
      case 'F':
        read_format(data, size);
        break;
      case 'A':
        require(4, "a subscription");
        subscribe(data, size);
        break;
      case 'R': {
        require(2, "the end of a subscription");
        const auto found = topics_.find(number(data, 2));
        if (found == topics_.end()) break;
        ended_.push_back(std::move(found->second));
        topics_.erase(found);
        break;
      }
      case 'D': {
        require(2, "data");
        const auto found = topics_.find(number(data, 2));
        if (found == topics_.end())
          refuse(at, "data of message " + std::to_string(number(data, 2)) +
                         ", to which nothing subscribed before");
        if (size - 2 < found->second.size)
          refuse(at, std::to_string(size - 2) + " bytes of " + found->second.name +
                         ", its format has " + std::to_string(found->second.size));
        found->second.data.push_back(data + 2);
        break;
      }
      default:  // the format lets types be added
        if (std::isalpha(type) == 0)
          refuse(at + 2, "a message of type " + std::to_string(type) + ", expected is a letter");
    }
    at = data + size;
  }
}

void Ulog::read_flags(std::size_t at, std::size_t size) {
  if (size < 40) refuse(at, "flags of " + std::to_string(size) + " bytes, expected are 40");
  for (std::size_t i = 8; i < 16; ++i)
    if ((number(at + i, 1) & (i == 8 ? 0xFEU : 0xFFU)) != 0)
      refuse(at + i, "an incompatible flag that is not known, expected is data appended (1)");
  if ((number(at + 8, 1) & 1U) == 0) return;
  for (std::size_t i = 16; i < 40; i += 8) {
    const std::uint64_t offset = number(at + i, 8);
    if (offset == 0) continue;
    if (offset < at + size || offset > bytes_.size())
      refuse(at + i, "data appended at byte " + std::to_string(offset) + ", the file has " +
                         std::to_string(bytes_.size()));
    appended_.push_back(static_cast<std::size_t>(offset));
  }
}

void Ulog::read_format(std::size_t at, std::size_t size) {
  const std::string text = bytes_.substr(at, size);
  const std::size_t colon = text.find(':');
  if (colon == std::string::npos || colon == 0)
    refuse(at, "the format " + detail::csv_quoted(text) + ", expected is NAME:TYPE FIELD;...");
  Format format;
  for (std::size_t start = colon + 1; start < text.size();) {
    const std::size_t end = std::min(text.find(';', start), text.size());
    const std::string part = text.substr(start, end - start);
    const std::size_t blank = part.find(' ');
    if (!part.empty() && (blank == std::string::npos || blank == 0 || blank + 1 == part.size()))
      refuse(at + start, "the field " + detail::csv_quoted(part) + ", expected is TYPE FIELD");
    if (!part.empty()) format.emplace_back(part.substr(0, blank), part.substr(blank + 1));
    start = end + 1;
  }
  formats_[text.substr(0, colon)] = std::move(format);
}

void Ulog::subscribe(std::size_t at, std::size_t size) {
  const std::uint64_t instance = number(at, 1), id = number(at + 1, 2);
  const std::string name = bytes_.substr(at + 3, size - 3);
  Topic topic;
  topic.name = name + (instance > 0 ? ':' + std::to_string(instance) : "");
  add_fields(topic, name, "", at, 0);
  for (const Field& field : topic.fields)
    if (field.name.find("_padding") == std::string::npos)
      topic.size = std::max(topic.size, field.offset + size_of(field.type));
  if (find(topic, "timestamp") == nullptr)
    refuse(at, "the format of " + detail::csv_quoted(name) + " has no timestamp");
  topics_[id] = std::move(topic);
}

/// Appends the fields of `format` after those that are there.
void Ulog::add_fields(Topic& topic, const std::string& format, const std::string& prefix,
                      std::size_t at, int depth) const {
  constexpr std::size_t most_fields = 20000;
  const auto found = formats_.find(format);
  if (found == formats_.end() || depth > 8)
    refuse(at, detail::csv_quoted(format) + " has no format before this, or is within itself");
  for (const auto& [declared, name] : found->second) {
    const std::size_t bracket = declared.find('[');
    const std::string type = declared.substr(0, bracket);
    std::size_t count = 1;
    if (bracket != std::string::npos) {
      const char* const first = declared.data() + bracket + 1;
      const auto [end, code] = std::from_chars(first, declared.data() + declared.size(), count);
      if (code != std::errc() || *end != ']' || count == 0 || count > most_fields)
        refuse(at, "the type " + detail::csv_quoted(declared) + " in the format of " + format +
                       ", expected is TYPE[COUNT]");
    }
    for (std::size_t i = 0; i < count; ++i) {
      const std::string path =
          prefix + name + (bracket == std::string::npos ? "" : '[' + std::to_string(i) + ']');
      if (size_of(type) == 0) {
        const std::size_t before = topic.fields.size();
        add_fields(topic, type, path + '.', at, depth + 1);
        if (topic.fields.size() == before)
          refuse(at, "the format of " + detail::csv_quoted(type) + " has no fields");
        continue;
      }
      const std::size_t offset =
          topic.fields.empty() ? 0 : topic.fields.back().offset + size_of(topic.fields.back().type);
      topic.fields.push_back({type, path, offset});
      if (topic.fields.size() > most_fields) refuse(at, format + " has too many fields");
    }
  }
}

double Ulog::value(const Field& field, std::size_t message) const {
  const std::size_t size = size_of(field.type);
  const std::uint64_t bits = number(message + field.offset, size);
  if (field.type == "double") {
    double value = 0.0;
    std::memcpy(&value, &bits, sizeof value);
    return value;
  }
  if (field.type == "float") {
    const auto half = static_cast<std::uint32_t>(bits);
    float value = 0.0F;
    std::memcpy(&value, &half, sizeof value);
    return static_cast<double>(value);
  }
  if (field.type[0] != 'i') return static_cast<double>(bits);
  const std::uint64_t sign = std::uint64_t{1} << (8 * size - 1);  // two's complement
  return (bits & sign) == 0 ? static_cast<double>(bits)
                            : -static_cast<double>((~bits & (sign - 1)) + 1);
}

const Ulog::Topic* Ulog::find(const std::string& name) const {
  for (const auto& [id, topic] : topics_)
    if (topic.name == name && !topic.data.empty()) return &topic;
  for (const Topic& topic : ended_)
    if (topic.name == name && !topic.data.empty()) return &topic;
  return nullptr;
}

const Ulog::Field* Ulog::find(const Topic& topic, const std::string& name) {
  const auto found = std::find_if(topic.fields.begin(), topic.fields.end(),
                                  [&](const Field& field) { return field.name == name; });
  return found == topic.fields.end() ? nullptr : &*found;
}

bool Ulog::has(const std::string& topic) const {
  return find(topic) != nullptr;
}

bool Ulog::has(const std::string& topic, const std::string& field) const {
  const Topic* const found = find(topic);
  return found != nullptr && find(*found, field) != nullptr;
}

const Ulog::Topic& Ulog::topic(const std::string& name) const {
  if (const Topic* const found = find(name)) return *found;
  std::string names;
  for (const auto& [id, topic] : topics_)
    if (!topic.data.empty()) names += (names.empty() ? "" : ", ") + topic.name;
  throw tilt_ropter::InputFileError(path_ + ": no data of " + name + ", the log has " +
                                    (names.empty() ? "none at all" : names));
}

CsvTable Ulog::table(const std::string& name, const std::vector<std::string>& fields) const {
  const Topic& from = topic(name);
  CsvTable table{path_, fields, {}, from.data};
  for (const std::string& wanted : fields) {
    const Field* const field = find(from, wanted);
    if (field == nullptr) {
      std::string message = path_ + ": " + name + " has no field " + wanted + ", it has";
      constexpr std::size_t most = 60;  // names
      for (std::size_t i = 0; i < std::min(most, from.fields.size()); ++i)
        message += (i == 0 ? " " : ", ") + from.fields[i].name;
      throw tilt_ropter::InputFileError(message + (from.fields.size() > most ? ", ..." : ""));
    }
    std::vector<double>& column = table.columns.emplace_back();
    for (const std::size_t message : from.data) column.push_back(value(*field, message));
  }
  return table;
}

}  // namespace examples
