#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <deque>
#include <string>
#include <type_traits>
#include <vector>

/// Messages with known contents, for the structs of both vendors. The file that includes this one
/// defines fields(visitor, message), which passes every field to the visitor in its order.
namespace interoperability {

enum class Purpose { fill, check };

/// Fills a message with a sequence of values that depends on a seed only, or counts the fields that
/// differ from it. Sequences have 1 to 3 elements.
template <Purpose purpose>
class Visitor {
 public:
  explicit Visitor(std::uint32_t seed) : state_(seed * 2654435761U + 12345U) {}

  int fields_seen = 0, mismatches = 0;  ///< fields: numbers, strings, and lengths of sequences

  template <typename T>
  void operator()(T& value) {
    if constexpr (std::is_same_v<T, bool>)
      leaf(value, next() % 2U == 0U);
    else if constexpr (std::is_floating_point_v<T>)
      leaf(value, static_cast<T>(static_cast<double>(next() % 20001U) / 8.0 - 1250.0));
    else if constexpr (std::is_integral_v<T>)
      leaf(value, static_cast<T>((std::uint64_t{next()} << 32U) + next()));
    else if constexpr (std::is_same_v<T, std::string>)
      leaf(value, text());
    else if constexpr (std::is_same_v<T, char*>)
      c_string(value);
    else if constexpr (std::is_array_v<T>)
      for (auto& element : value) (*this)(element);
    else
      composed(value, 0);
  }

 private:
  [[nodiscard]] std::uint32_t next() {
    state_ = state_ * 1664525U + 1013904223U;
    return state_ >> 4U;
  }
  [[nodiscard]] std::string text() {
    const std::uint32_t number = next();
    return number % 5U == 0U ? "" : "text " + std::to_string(number);
  }
  template <typename T>
  void leaf(T& value, const T& wanted) {
    ++fields_seen;
    if constexpr (purpose == Purpose::fill)
      value = wanted;
    else
      mismatches += value == wanted ? 0 : 1;
  }

  // Strings and sequences of C point to memory of the visitor.
  void c_string(char*& value) {
    const std::string wanted = text();
    ++fields_seen;
    if constexpr (purpose == Purpose::fill) {
      value = static_cast<char*>(memory(wanted.size() + 1));
      std::memcpy(value, wanted.c_str(), wanted.size() + 1);
    } else {
      mismatches += wanted == value ? 0 : 1;
    }
  }
  template <typename Sequence>
  auto composed(Sequence& value, int) -> decltype(value._buffer, void()) {
    using Element = std::remove_pointer_t<decltype(value._buffer)>;
    std::uint32_t length = 1U + next() % 3U;
    if constexpr (purpose == Purpose::fill) {
      value._buffer = static_cast<Element*>(memory(length * sizeof(Element)));
      value._maximum = length;
    }
    leaf(value._length, length);
    for (std::uint32_t i = 0; i < value._length; ++i) (*this)(value._buffer[i]);
  }
  template <typename Element>
  void composed(std::vector<Element>& value, int) {
    const std::size_t length = 1U + next() % 3U;
    if constexpr (purpose == Purpose::fill) value.resize(length);
    std::size_t size = value.size();
    leaf(size, length);
    for (Element& element : value) (*this)(element);
  }
  template <typename Element, std::size_t size>
  void composed(std::array<Element, size>& value, int) {
    for (Element& element : value) (*this)(element);
  }
  template <typename Message>
  void composed(Message& value, long) {
    fields(*this, value);
  }

  [[nodiscard]] void* memory(std::size_t size) {
    memory_.emplace_back(size / sizeof(double) + 1);
    return memory_.back().data();
  }

  std::uint32_t state_;
  std::deque<std::vector<double>> memory_;  // zero at first
};

/// Seeds of what each side sends on its topic number `topic`.
[[nodiscard]] constexpr std::uint32_t from_cyclone(int topic) {
  return 1000U + static_cast<std::uint32_t>(topic);
}
[[nodiscard]] constexpr std::uint32_t from_fast_dds(int topic) {
  return 2000U + static_cast<std::uint32_t>(topic);
}

}  // namespace interoperability
