#pragma once

#include <cstdint>
#include <map>
#include <mutex>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

#include "pipeline/types/work.h"

namespace booth {

/// Where a job's time and memory go: the steps that each thread takes, and the pieces of loops that it runs, with wall
/// and processor time, and the process's resident memory at each change. Safe for several threads.
class JobTrace {
 public:
  JobTrace();

  /// The same work, watched. The trace must outlive it.
  Work watch(Work work);

  /// A step begins on the calling thread; with an empty name the innermost one ends.
  void mark(std::string_view step);

  /// The trace as Chrome's trace-event JSON, which Perfetto (ui.perfetto.dev) and chrome://tracing open: complete
  /// events
  /// ("X") with `ts`, `dur` and `tdur` (processor time) in microseconds, the counter "resident memory" in MiB. Pieces
  /// of loops carry the name of the step that started the loop.
  std::string json() const;

 private:
  struct Event {
    std::string name;
    int thread;
    bool piece;
    int64_t begin_ns, wall_ns, processor_ns;
  };
  struct Open {
    std::string name;
    bool piece;
    int64_t begin_ns, begin_processor_ns;
  };
  struct Sample {
    int64_t at_ns;
    double mebibytes;
  };

  void begin(std::string_view name, bool piece);
  void end();
  std::string innermost();
  /// The calling thread's number, in the order of appearance. @pre mutex_ is held
  int thread();

  const int64_t started_ns_;
  mutable std::mutex mutex_;
  std::map<std::thread::id, int> threads_;  ///< guarded by mutex_
  std::vector<std::vector<Open>> open_;     ///< guarded by mutex_; by thread
  std::vector<Event> events_;               ///< guarded by mutex_
  std::vector<Sample> memory_;              ///< guarded by mutex_
};

}  // namespace booth
