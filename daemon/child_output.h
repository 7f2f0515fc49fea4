#pragma once

#include <unistd.h>

#include <array>
#include <cerrno>
#include <string>
#include <string_view>

namespace booth {

/// Splits what comes through a pipe into lines; one that is too long is dropped.
class LineReader {
 public:
  /// Reads what is there. @return false at the end of the pipe
  template <class OnLine>
  bool read(int descriptor, const OnLine& on_line) {
    std::array<char, 4096> bytes;
    for (;;) {
      const ssize_t got = ::read(descriptor, bytes.data(), bytes.size());
      if (got < 0 && errno == EINTR) continue;
      if (got < 0) return true;  // nothing more for now
      if (got == 0) return false;
      for (const char byte : std::string_view(bytes.data(), static_cast<size_t>(got))) {
        if (byte != '\n') {
          if (line_.size() <= longest_line_) line_ += byte;
          continue;
        }
        if (line_.size() <= longest_line_) on_line(line_);
        line_.clear();
      }
    }
  }
  const std::string& rest() const { return line_; }

 private:
  static constexpr size_t longest_line_ = 4096;  ///< of the progress protocol; more is not ours
  std::string line_;
};

/// The last words of a process.
class Tail {
 public:
  bool read(int descriptor) {
    std::array<char, 4096> bytes;
    for (;;) {
      const ssize_t got = ::read(descriptor, bytes.data(), bytes.size());
      if (got < 0 && errno == EINTR) continue;
      if (got < 0) return true;
      if (got == 0) return false;
      text_.append(bytes.data(), static_cast<size_t>(got));
      if (text_.size() > 2 * longest_) text_.erase(0, text_.size() - longest_);
    }
  }
  std::string last_line() const {
    const size_t end = text_.find_last_not_of(" \r\n");
    if (end == std::string::npos) return {};
    const size_t begin = text_.find_last_of('\n', end);
    return text_.substr(begin == std::string::npos ? 0 : begin + 1,
                        end - (begin == std::string::npos ? 0 : begin + 1) + 1);
  }
  const std::string& text() const { return text_; }

 private:
  static constexpr size_t longest_ = 8192;  ///< that is kept: the end
  std::string text_;
};

}  // namespace booth
