#pragma once

#include <condition_variable>
#include <cstddef>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

#include "pipeline/types/work.h"

namespace booth {

/// A few threads that run the pieces of Work::parallel_for. The caller of a loop works along; loops may be started by
/// several threads and from inside pieces. A thread with nothing to do helps with the loop started last, a caller that
/// waits for the rest of its own loop with those started since: its pieces may be waiting for them.
class ThreadPool {
 public:
  /// @param threads  how many work at once, the caller included; 0 for as many as there are processors
  explicit ThreadPool(unsigned threads = 0);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  unsigned threads() const { return static_cast<unsigned>(workers_.size()) + 1; }

  /// The same contract as Work::parallel_for.
  void run(size_t count, size_t grain, const Work::Range& body);

  /// A Work whose loops run here. The pool must outlive it.
  Work work();

 private:
  struct Loop;
  static void work_on(Loop& loop);
  void worker(const std::stop_token& stop);
  void help(std::unique_lock<std::mutex>& lock);

  std::mutex mutex_;
  std::condition_variable_any news_;  ///< a loop began, or the last helper left one
  std::vector<Loop*> loops_;          ///< guarded by mutex_; those that may have pieces to give, the newest last
  size_t begun_ = 0;                  ///< guarded by mutex_; loops so far
  std::vector<std::jthread> workers_;
};

}  // namespace booth
