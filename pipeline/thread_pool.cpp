#include "pipeline/thread_pool.h"

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <exception>

namespace booth {

struct ThreadPool::Loop {
  size_t count, grain;
  const Work::Range& body;
  std::atomic<size_t> next{0};
  std::mutex fault_mutex;
  std::exception_ptr fault;  ///< guarded by fault_mutex; the first one
  size_t number = 0;         ///< in the order in which loops began
  size_t helpers = 0;        ///< guarded by the pool's mutex_; other threads at this loop's pieces
};

ThreadPool::ThreadPool(unsigned threads) {
  const unsigned wanted = threads > 0 ? threads : std::max(1U, std::thread::hardware_concurrency());
  for (unsigned i = 1; i < wanted; ++i) {
    workers_.emplace_back([this](const std::stop_token& stop) { worker(stop); });
    pthread_setname_np(workers_.back().native_handle(), "pool");
  }
}

ThreadPool::~ThreadPool() {
  for (std::jthread& thread : workers_) thread.request_stop();
}

void ThreadPool::work_on(Loop& loop) {
  for (;;) {
    const size_t begin = loop.next.fetch_add(loop.grain, std::memory_order_relaxed);
    if (begin >= loop.count) break;
    try {
      loop.body(begin, std::min(begin + loop.grain, loop.count));
    } catch (...) {
      const std::lock_guard lock(loop.fault_mutex);
      if (!loop.fault) loop.fault = std::current_exception();
      loop.next.store(loop.count, std::memory_order_relaxed);
    }
  }
}

/// Works on the newest loop. @pre mutex_ is held by `lock` and there is one
void ThreadPool::help(std::unique_lock<std::mutex>& lock) {
  Loop& loop = *loops_.back();
  ++loop.helpers;
  lock.unlock();
  work_on(loop);
  lock.lock();
  std::erase(loops_, &loop);
  if (--loop.helpers == 0) news_.notify_all();
}

void ThreadPool::worker(const std::stop_token& stop) {
  std::unique_lock lock(mutex_);
  while (news_.wait(lock, stop, [&] { return !loops_.empty(); })) help(lock);
}

void ThreadPool::run(size_t count, size_t grain, const Work::Range& body) {
  grain = std::max<size_t>(grain, 1);
  if (workers_.empty() || count <= grain) return Work{}.parallel_for(count, grain, body);
  Loop loop{.count = count, .grain = grain, .body = body, .next = {}, .fault_mutex = {}, .fault = {}};
  {
    const std::lock_guard lock(mutex_);
    loop.number = begun_++;
    loops_.push_back(&loop);
  }
  news_.notify_all();
  work_on(loop);
  {
    std::unique_lock lock(mutex_);
    std::erase(loops_, &loop);
    const auto newer = [&] { return !loops_.empty() && loops_.back()->number > loop.number; };
    while (loop.helpers > 0) {
      if (newer())
        help(lock);
      else
        news_.wait(lock, [&] { return loop.helpers == 0 || newer(); });
    }
  }
  if (loop.fault) std::rethrow_exception(loop.fault);
}

Work ThreadPool::work() {
  Work work;
  work.parallel = [this](size_t count, size_t grain, const Work::Range& body) { run(count, grain, body); };
  return work;
}

}  // namespace booth
