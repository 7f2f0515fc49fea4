#pragma once

#include <array>
#include <charconv>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>

namespace booth {

/// Text that grows. Numbers are written by std::to_chars: the shortest that reads back equal, in every locale.
class NumberText {
 public:
  NumberText& operator<<(std::string_view text) {
    text_ += text;
    return *this;
  }
  NumberText& operator<<(char character) {
    text_ += character;
    return *this;
  }
  template <class Number>
  requires std::is_arithmetic_v<Number> NumberText& operator<<(Number number) {
    std::array<char, 32> digits;                                          // the longest double has 24
    if constexpr (std::is_floating_point_v<Number>) number += Number{0};  // −0 becomes 0
    const auto [end, fault] = std::to_chars(digits.data(), digits.data() + digits.size(), number);
    static_cast<void>(fault);  // too little room, the only fault there is, cannot be
    text_.append(digits.data(), static_cast<size_t>(end - digits.data()));
    return *this;
  }
  void reserve(size_t size) { text_.reserve(size); }
  std::string take() { return std::move(text_); }

 private:
  std::string text_;
};

}  // namespace booth
