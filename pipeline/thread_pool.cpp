#include "pipeline/thread_pool.h"

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <exception>

namespace booth {
namespace {

thread_local bool inside_piece = false;

}  // namespace

struct ThreadPool::Loop {
  size_t count, grain;
  const Work::Range& body;
  std::atomic<size_t> next{0};
  std::mutex fault_mutex;
  std::exception_ptr fault;  ///< guarded by fault_mutex; the first one
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
  inside_piece = true;
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
  inside_piece = false;
}

void ThreadPool::worker(const std::stop_token& stop) {
  size_t seen = 0;
  std::unique_lock lock(mutex_);
  while (wake_.wait(lock, stop, [&] { return loop_ != nullptr && generation_ != seen; })) {
    seen = generation_;
    Loop& loop = *loop_;
    ++inside_;
    lock.unlock();
    work_on(loop);
    lock.lock();
    if (--inside_ == 0) idle_.notify_all();
  }
}

void ThreadPool::run(size_t count, size_t grain, const Work::Range& body) {
  grain = std::max<size_t>(grain, 1);
  if (workers_.empty() || inside_piece || count <= grain) return Work{}.parallel_for(count, grain, body);
  const std::lock_guard one_at_a_time(caller_mutex_);
  Loop loop{.count = count, .grain = grain, .body = body, .next = {}, .fault_mutex = {}, .fault = {}};
  {
    const std::lock_guard lock(mutex_);
    loop_ = &loop;
    ++generation_;
  }
  wake_.notify_all();
  work_on(loop);
  {
    std::unique_lock lock(mutex_);
    loop_ = nullptr;
    idle_.wait(lock, [&] { return inside_ == 0; });
  }
  if (loop.fault) std::rethrow_exception(loop.fault);
}

Work ThreadPool::work() {
  Work work;
  work.parallel = [this](size_t count, size_t grain, const Work::Range& body) { run(count, grain, body); };
  return work;
}

}  // namespace booth
