#pragma once

#include <deque>
#include <functional>
#include <mutex>
#include <string>
#include <utility>

namespace booth {

/// Carries what drivers warn of to whoever tells the operator, who may come later than the first warnings. Any thread.
class WarningRelay {
 public:
  using Listener = std::function<void(const std::string& sentence)>;

  void warn(const std::string& sentence) {
    const std::lock_guard lock(mutex_);
    if (listener_) return listener_(sentence);
    constexpr size_t most_waiting = 256;
    if (waiting_.size() < most_waiting) waiting_.push_back(sentence);
  }
  /// From now on; what was said before comes at once. An empty one listens no more.
  void listen(Listener listener) {
    const std::lock_guard lock(mutex_);
    listener_ = std::move(listener);
    if (!listener_) return;
    for (const std::string& sentence : std::exchange(waiting_, {})) listener_(sentence);
  }

 private:
  std::mutex mutex_;
  Listener listener_;                ///< guarded by mutex_
  std::deque<std::string> waiting_;  ///< guarded by mutex_
};

}  // namespace booth
