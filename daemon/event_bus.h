#pragma once

#include <atomic>
#include <deque>
#include <mutex>
#include <string>

#include "daemon/bounded_queue.h"
#include "daemon/event.h"
#include "daemon/wakeup.h"

namespace booth {

/// Takes events from any thread, numbers them, and hands them in that order to the one thread that publishes them.
class EventBus {
 public:
  /// @param capacity  events that may wait for the publisher; further ones are lost, which the numbers show
  explicit EventBus(size_t capacity = 8192);

  /// Never blocks.
  void publish(Event event);

  /// An id made anew for each bus: sequences of different boots do not compare.
  const std::string& boot() const { return boot_; }
  /// Of the last event. Whatever an event up to it says has already happened.
  uint64_t sequence() const;
  uint64_t lost() const { return lost_; }

  /// The publisher's side: readable when take() has something.
  Wakeup& wakeup() { return wakeup_; }
  std::deque<NumberedEvent> take() { return queue_.take(); }

 private:
  const std::string boot_;
  BoundedQueue<NumberedEvent> queue_;
  Wakeup wakeup_;
  mutable std::mutex mutex_;  ///< held while an event is numbered and queued, so that both have one order
  uint64_t sequence_ = 0;     ///< guarded by mutex_
  std::atomic<uint64_t> lost_{0};
};

}  // namespace booth
