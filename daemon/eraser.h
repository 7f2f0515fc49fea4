#pragma once

#include <filesystem>
#include <functional>
#include <set>
#include <string>

#include "daemon/avatar_store.h"
#include "daemon/capture_journal.h"
#include "daemon/capture_session.h"
#include "daemon/event_bus.h"
#include "daemon/head_start.h"
#include "daemon/job_queue.h"
#include "daemon/serial_executor.h"
#include "pipeline/types/result.h"

namespace booth {

/// Removes every trace of a person: recording, job and avatar, whatever is under way with them. Each id is first marked
/// on the disk, so that a daemon that dies on the way finishes at its next start.
class Eraser {
 public:
  /// @param session  may be null
  Eraser(const std::filesystem::path& state, JobQueue& jobs, HeadStart& head_start, AvatarStore& avatars,
         const CaptureJournal& journal, CaptureSession* session, EventBus& events);

  /// Finishes what an earlier process did not; before the stores are opened. @error io
  static Result<void> finish_interrupted(const std::filesystem::path& state);

  /// Everything with one of these ids (is_safe_id) is no longer listed from now on, and soon no longer on the disk.
  /// @param done  called when that is so, from another thread
  /// @error busy  too many deletions are waiting
  Result<void> erase(const std::set<std::string>& ids, std::function<void(Result<void>)> done);

 private:
  Result<void> remove(const std::string& id);

  const std::filesystem::path state_;
  JobQueue& jobs_;
  HeadStart& head_start_;
  AvatarStore& avatars_;
  const CaptureJournal& journal_;
  CaptureSession* const session_;
  EventBus& events_;
  SerialExecutor executor_;
};

}  // namespace booth
