#pragma once

#include <cstddef>
#include <functional>
#include <stop_token>
#include <string_view>

#include "pipeline/types/result.h"

namespace booth {

/// How a stage may work: it carries no data. Left out, the stage runs serially, cannot be stopped and tells
/// nobody how far it is.
struct Work {
  using Range = std::function<void(size_t begin, size_t end)>;

  std::stop_token stop;
  /// Called with the stage's fraction, 0 … 1, never falling, by one thread at a time.
  std::function<void(double)> progress;
  /// Runs `body` over [0, count) in pieces, on several threads, and returns when all are done; an exception of
  /// one piece is thrown again on the caller. Empty: serial. See pipeline/thread_pool.h.
  std::function<void(size_t count, size_t grain, const Range& body)> parallel;
  /// Told by Step what the calling thread begins to do, and with an empty name that it has done it. Empty: nobody
  /// looks.
  std::function<void(std::string_view step)> mark = {};

  /// Splits [0, count) into pieces of at most `grain` (0 is taken as 1) and runs them in any order. Pieces may not
  /// depend on each other; the split depends on count and grain only, never on the number of threads.
  void parallel_for(size_t count, size_t grain, const Range& body) const {
    if (count == 0) return;
    if (grain == 0) grain = 1;
    if (parallel) return parallel(count, grain, body);
    for (size_t begin = 0; begin < count; begin += grain) body(begin, begin + grain < count ? begin + grain : count);
  }
  /// Two things that do not depend on each other, at the same time where there are threads.
  template <class First, class Second>
  void both(const First& first, const Second& second) const {
    parallel_for(2, 1, [&](size_t begin, size_t end) {
      if (begin == 0) first();
      if (end == 2) second();
    });
  }
  void report(double fraction) const {
    if (progress) progress(fraction);
  }
  bool stopped() const { return stop.stop_requested(); }
  /// What a stage returns when it notices that it was asked to stop.
  static Error cancelled() { return {ErrorCode::cancelled, "the work was cancelled"}; }
};

/// A step of a stage, from here to the end of the block, by name, for whoever watches where the time goes.
class Step {
 public:
  Step(const Work& work, std::string_view name) : work_(work) {
    if (work_.mark) work_.mark(name);
  }
  ~Step() {
    if (work_.mark) work_.mark({});
  }
  Step(const Step&) = delete;
  Step& operator=(const Step&) = delete;

 private:
  const Work& work_;
};

}  // namespace booth
