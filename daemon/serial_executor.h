#pragma once

#include <functional>
#include <string>
#include <thread>

#include "daemon/bounded_queue.h"
#include "daemon/pulse.h"

namespace booth {

/// One thread that carries out what others hand it, in their order: work that may wait for the disk.
class SerialExecutor {
 public:
  /// @param name  the thread's, ≤ 15 characters
  SerialExecutor(std::string name, size_t capacity);
  /// Carries out what was posted before, then ends.
  ~SerialExecutor();

  /// An exception that leaves the task is logged and goes no further.
  /// @return false: too much is waiting, and the task was not taken
  bool post(std::function<void()> task);

  /// A task that does not come back leaves it behind.
  Pulse::TimePoint last_pulse() const { return pulse_.last(); }

 private:
  void run();

  const std::string name_;
  BoundedQueue<std::function<void()>> tasks_;
  Pulse pulse_;
  std::jthread thread_;
};

}  // namespace booth
