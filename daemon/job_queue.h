#pragma once

#include <condition_variable>
#include <cstdint>
#include <filesystem>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <set>
#include <stop_token>
#include <string>
#include <vector>

#include "daemon/event_bus.h"
#include "pipeline/types/result.h"

namespace booth {

enum class JobState { queued, running, failed, done, cancelled };
std::string_view to_string(JobState state);

/// One reconstruction: of the capture that has the same id, into the avatar that has the same id.
struct Job {
  std::string id;
  std::string face;        ///< how the capture asked for the face
  std::string label = {};  ///< may be empty
  JobState state = JobState::queued;
  std::string stage = {};  ///< the last one reported; empty before the first
  double fraction = 0;     ///< of the whole job
  std::optional<Reason> error = {};
  int interrupted = 0;   ///< how often the daemon died while it ran
  bool recorded = true;  ///< false: the capture ended with the daemon, and there is nothing to reconstruct
  int died = 0;          ///< how often its own process died, hung, or took more memory than it may
};

/// The jobs, one file each, so that they survive the daemon. Changes take effect in memory at once and block
/// nobody; persist() brings them to the disk. Any thread.
///
/// The files have a version. Those of older and of newer programs are read too: what is missing has its default, what
/// is unknown is left out, so that a queue survives an upgrade and the way back.
///
///     queued → running → done | failed | cancelled → (retry) queued
class JobQueue {
 public:
  /// Reads the jobs of `folder`, which is made where it is missing. One that was running goes on as queued, unless
  /// the daemon died too often while it ran: then it has failed, lest it bring the daemon down for ever. A file
  /// that is no job is removed, one that the disk does not give is left: either way the capture gets a new job.
  /// @error io, disk_full
  static Result<std::unique_ptr<JobQueue>> open(const std::filesystem::path& folder, EventBus& events);

  std::vector<Job> list() const;  ///< oldest first
  std::optional<Job> find(const std::string& id) const;
  int unfinished() const;  ///< how many are queued or running

  /// A new job, queued. One that is already there is left alone. No worker takes it before release(id).
  void add(const Job& job);
  void release(const std::string& id);
  /// What a done job made is gone: it is queued again. Other jobs are left alone.
  void redo(const std::string& id);
  /// @error not_found; invalid_state  neither failed nor cancelled, or nothing was recorded
  Result<void> retry(const std::string& id);
  /// The job is cancelled from now on; a worker that has it sees so by is_wanted.
  /// @error not_found; invalid_state  over already
  Result<void> cancel(const std::string& id);
  /// As if it had never been.
  void forget(const std::string& id);
  /// Brings what the job is now to the disk, its absence too. Waits for the disk.
  /// @error io, disk_full
  Result<void> persist(const std::string& id);

  // What the workers do. A lease ends when its job is cancelled, retried or forgotten; its calls then change nothing.
  struct Lease {
    Job job;
    uint64_t number = 0;
  };
  /// Waits for the oldest queued job and takes it, unless a worker still clears away an earlier run of it. Jobs whose
  /// process died before come after all others. Nothing: `stop` was requested, or nothing came for `patience`. The
  /// worker ends with release().
  std::optional<Lease> take(const std::stop_token& stop, std::chrono::milliseconds patience);
  bool is_wanted(const Lease& lease) const;
  /// @param publish  whether listeners hear of it
  void report(const Lease& lease, const std::string& stage, double fraction, bool publish);
  /// @return whether the lease was still good
  bool finish(const Lease& lease);
  bool fail(const Lease& lease, const Reason& error);
  /// The job's process died, or had to be killed. It is queued again, behind the others, unless that happened more than
  /// `retries` times: then it failed.
  bool died(const Lease& lease, int retries, const Reason& error);
  /// The job goes back into the queue, and this run does not count: the daemon is stopping.
  void give_back(const Lease& lease);
  /// The worker has left nothing behind, neither a process nor files that should not be.
  void release(const Lease& lease) { release(lease.job.id); }
  /// Waits until no worker has anything of that job any more, and whoever added it has released it.
  void wait_released(const std::string& id);

 private:
  struct Entry {
    Job job;
    uint64_t lease = 0;  ///< of the worker that has it
  };
  JobQueue(std::filesystem::path folder, EventBus& events) : folder_(std::move(folder)), events_(events) {}
  std::filesystem::path file_of(const std::string& id) const { return folder_ / (id + ".json"); }
  Entry* leased(const Lease& lease);

  const std::filesystem::path folder_;
  EventBus& events_;
  std::mutex disk_mutex_;  ///< held while a file is written, so that the newest state is written last
  mutable std::mutex mutex_;
  std::condition_variable_any queued_;
  std::map<std::string, Entry> entries_;  ///< guarded by mutex_; ids sort by their time
  uint64_t leases_ = 0;                   ///< guarded by mutex_
  std::set<std::string> occupied_;        ///< guarded by mutex_; ids that a worker, or who added them, has not released
  std::condition_variable_any released_;
};

}  // namespace booth
