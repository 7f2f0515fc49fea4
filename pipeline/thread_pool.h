#pragma once

#include <condition_variable>
#include <cstddef>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

#include "pipeline/types/work.h"

namespace booth {

/// A few threads that run the pieces of a Work::parallel_for. One loop at a time; the caller works along, and a
/// loop started from inside a piece runs serially on its thread.
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

  std::mutex caller_mutex_;  ///< held by the caller of the one loop under way
  std::mutex mutex_;
  std::condition_variable_any wake_;
  std::condition_variable idle_;
  Loop* loop_ = nullptr;   ///< guarded by mutex_
  size_t generation_ = 0;  ///< guarded by mutex_; counts loops, so that a worker joins each at most once
  size_t inside_ = 0;      ///< guarded by mutex_; workers that hold a pointer to loop_
  std::vector<std::jthread> workers_;
};

}  // namespace booth
