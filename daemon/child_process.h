#pragma once

#include <sys/types.h>

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// A program that runs beside the daemon, in a process group of its own. It dies with the thread that started it,
/// and so with the daemon, however that ends. The destructor kills it and waits for it.
class ChildProcess {
 public:
  /// Starts `command` (a path, then its arguments) with nothing open but: standard input empty, standard output and
  /// error together a pipe (output()), descriptor 3 another pipe (progress()).
  /// @error io  the operating system refused; not_found  the program cannot be executed
  static Result<ChildProcess> start(const std::vector<std::string>& command);

  ChildProcess(ChildProcess&& other) noexcept;
  ChildProcess& operator=(ChildProcess&&) = delete;
  ~ChildProcess();

  /// The reading ends, which do not block.
  int progress() const { return progress_; }
  int output() const { return output_; }

  /// SIGKILL to the whole group.
  void kill() noexcept;

  /// Memory that it takes now, without what it may have started itself; 0 where that is not known.
  uint64_t resident_bytes() const;

  /// How it ended, as waitpid says; nothing while it runs.
  std::optional<int> poll_status();

 private:
  ChildProcess() = default;
  pid_t pid_ = -1;
  int progress_ = -1, output_ = -1;
  std::optional<int> status_;
};

}  // namespace booth
