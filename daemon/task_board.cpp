#include "daemon/task_board.h"

#include <spdlog/spdlog.h>

#include <algorithm>
#include <chrono>

#include "daemon/identifier.h"

namespace booth {

std::string TaskBoard::begin(TaskKind kind) {
  const std::string id = std::string(to_string(kind)) + "-" + make_capture_id(std::chrono::system_clock::now());
  const std::lock_guard lock(mutex_);
  tasks_[id] = Task{id, kind};
  spdlog::info("task {}: started", id);
  events_.publish(TaskChanged{.task = id, .kind = kind, .state = TaskState::running, .result = {}, .error = {}});
  return id;
}

void TaskBoard::progress(const std::string& task, double fraction) {
  const std::lock_guard lock(mutex_);
  const auto found = tasks_.find(task);
  if (found == tasks_.end()) return;
  found->second.fraction = std::clamp(fraction, 0.0, 1.0);
  events_.publish(TaskChanged{.task = task,
                              .kind = found->second.kind,
                              .state = TaskState::running,
                              .fraction = found->second.fraction,
                              .result = {},
                              .error = {}});
}

void TaskBoard::finish(const std::string& task, const Result<TaskResult>& result) {
  const std::lock_guard lock(mutex_);
  const auto found = tasks_.find(task);
  if (found == tasks_.end()) return;
  TaskChanged event{.task = task,
                    .kind = found->second.kind,
                    .state = result ? TaskState::done : TaskState::failed,
                    .fraction = result ? 1 : found->second.fraction,
                    .result = {},
                    .error = {}};
  if (result)
    event.result = *result;
  else
    event.error = result.error();
  if (result)
    spdlog::info("task {}: done", task);
  else
    spdlog::warn("task {}: failed: {}", task, result.error().message);
  tasks_.erase(found);
  events_.publish(std::move(event));
}

std::vector<Task> TaskBoard::list() const {
  const std::lock_guard lock(mutex_);
  std::vector<Task> tasks;
  for (const auto& [id, task] : tasks_) tasks.push_back(task);
  return tasks;
}

}  // namespace booth
