#pragma once

#include <sys/types.h>

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// A program that runs beside the daemon, in a process group of its own. It dies with the thread that started it,
/// and so with the daemon, however that ends. The destructor kills it and waits for it.
class ChildProcess {
 public:
  enum class Input { empty, told };  ///< told: what tell() says

  /// Starts `command` (a path, then its arguments) with nothing open but: standard input, standard output and error
  /// together a pipe (output()), descriptor 3 another pipe (progress()).
  /// @error io  the operating system refused; not_found  the program cannot be executed
  static Result<ChildProcess> start(const std::vector<std::string>& command, Input input = Input::empty);

  ChildProcess(ChildProcess&& other) noexcept;
  ChildProcess& operator=(ChildProcess&&) = delete;
  ~ChildProcess();

  /// The reading ends, which do not block.
  int progress() const { return progress_; }
  int output() const { return output_; }

  /// Writes to its standard input, without waiting for it to read. @return whether all of it was taken
  bool tell(std::string_view text);

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
  int input_ = -1;  ///< a socket, so that writing to a dead process raises no signal
  std::optional<int> status_;
};

}  // namespace booth
