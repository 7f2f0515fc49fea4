#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

namespace booth {

/// A GPIO chip of the kernel's module gpio-sim, and everything that happens on its lines, as the kernel traces it: no
/// edge is missed, however short the pulse.
class GpioPeer {
 public:
  struct Edge {
    int64_t when_us = 0;  ///< CLOCK_MONOTONIC
    int line = 0;
    int level = 0;  ///< 1: high
  };
  using Listener = std::function<void(const Edge&)>;

  /// @param lines     how many; line i is called names[i] where there is such a name
  /// @param listener  called for each edge, on a thread of the peer
  GpioPeer(int lines, const std::vector<std::string>& names, Listener listener);
  ~GpioPeer();
  GpioPeer(const GpioPeer&) = delete;
  GpioPeer& operator=(const GpioPeer&) = delete;

  const std::string& chip() const { return chip_; }  ///< "gpiochip0"
  /// The level of a line now, also of one that nobody holds.
  int level(int line) const;
  /// What the circuit does to a line that nobody drives.
  void set_pull(int line, bool up);
  /// All edges of these lines so far, once `count` are there. Fails the test where they never come.
  std::vector<Edge> wait_edges(const std::vector<int>& lines, size_t count);
  void forget_edges();

 private:
  void watch();

  const Listener listener_;
  std::string chip_;
  std::string device_;  ///< its folder in sysfs
  int first_line_ = 0;  ///< its number in the kernel's count of all lines
  std::atomic<bool> ends_ = false;
  std::mutex mutex_;
  std::condition_variable changed_;
  std::vector<Edge> edges_;  ///< guarded by mutex_
  std::jthread thread_;
};

}  // namespace booth
