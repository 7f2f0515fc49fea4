#pragma once

#include <unistd.h>

#include <cerrno>
#include <nlohmann/json.hpp>
#include <string>

namespace booth {

/// A child process's news for the process that started it: a JSON object a line.
class ProgressPipe {
 public:
  /// @param descriptor  open for writing; negative: nobody listens
  explicit ProgressPipe(int descriptor) : descriptor_(descriptor) {}

  void tell(const nlohmann::json& news) const {
    if (descriptor_ < 0) return;
    const std::string line = news.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace) + "\n";
    for (size_t sent = 0; sent < line.size();) {
      const ssize_t count = ::write(descriptor_, line.data() + sent, line.size() - sent);
      if (count < 0 && errno == EINTR) continue;
      if (count <= 0) return;  // the reader is gone; what is on the disk counts
      sent += static_cast<size_t>(count);
    }
  }

 private:
  int descriptor_;
};

}  // namespace booth
