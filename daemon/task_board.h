#pragma once

#include <map>
#include <mutex>
#include <string>
#include <vector>

#include "daemon/event.h"
#include "daemon/event_bus.h"
#include "pipeline/types/result.h"

namespace booth {

/// A task that is under way.
struct Task {
  std::string id;
  TaskKind kind;
  double fraction = 0;
};

/// What the booth does on request and answers later: each step becomes a `task` event. Any thread.
class TaskBoard {
 public:
  explicit TaskBoard(EventBus& events) : events_(events) {}

  /// @return the new task's id
  std::string begin(TaskKind kind);
  /// @param fraction  of the whole, 0 … 1
  void progress(const std::string& task, double fraction);
  void finish(const std::string& task, const Result<TaskResult>& result);

  std::vector<Task> list() const;

 private:
  EventBus& events_;
  mutable std::mutex mutex_;           ///< also held while an event is published, so that events have the tasks' order
  std::map<std::string, Task> tasks_;  ///< guarded by mutex_; under way
};

}  // namespace booth
