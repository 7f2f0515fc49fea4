#pragma once

#include <atomic>
#include <chrono>

namespace booth {

/// A thread's sign of life, for the watchdog.
class Pulse {
 public:
  using TimePoint = std::chrono::steady_clock::time_point;

  void beat() { last_.store(std::chrono::steady_clock::now(), std::memory_order_relaxed); }
  TimePoint last() const { return last_.load(std::memory_order_relaxed); }

 private:
  std::atomic<TimePoint> last_{std::chrono::steady_clock::now()};
};

}  // namespace booth
