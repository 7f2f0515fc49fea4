#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "daemon/avatar_store.h"
#include "daemon/event_bus.h"
#include "daemon/head_start.h"
#include "daemon/job_queue.h"
#include "daemon/metrics.h"
#include "daemon/pulse.h"
#include "daemon/reconstruct_program.h"
#include "pipeline/types/camera_health.h"

namespace booth {

struct JobRunnerOptions {
  ReconstructProgram program;
  int workers = 1;
  int retries = 1;  ///< of a job whose process died, hung, or took too much memory
};

/// What a job's process found out about the booth's cameras. Called by workers, several at a time.
using OnHealth = std::function<void(const std::string& capture, const std::vector<CameraHealth>& cameras)>;

/// Takes jobs from the queue and runs each in a process of its own, so that no input can take the daemon down. One that
/// dies, hangs or takes too much memory is tried again after the others, and set aside as failed when that repeats.
///
/// The process says on descriptor 3, one JSON object a line, how far it is: {"stage": "hull", "fraction": 0.42}, the
/// fraction that of the whole job; what it found out about each camera and, when that is all, null:
/// {"health": {"camera": "body-00", "moved": true, …}}; and why it failed: {"error": {"kind": "no_subject", "message":
/// "…"}}. It ends with status 0 after the avatar's folder has appeared by a rename.
class JobRunner {
 public:
  JobRunner(JobRunnerOptions options, JobQueue& jobs, HeadStart& head_start, AvatarStore& avatars, EventBus& events,
            Metrics& metrics, OnHealth on_health = {});
  ~JobRunner();

  /// Has a worker that finds no job learn the background of this recording into the cache (COMMAND RECORDING --learn
  /// --cache FOLDER), so that the next visitor need not wait for that. Returns at once.
  void prepare(const std::filesystem::path& recording);

  /// Kills what runs; those jobs go back into the queue. Waits for that.
  void stop();

  /// The slowest worker's sign of life.
  std::chrono::steady_clock::time_point last_pulse() const;

 private:
  struct Run;
  void work(const std::stop_token& stop, Pulse& pulse);
  void run(const JobQueue::Lease& lease, const std::stop_token& stop, Pulse& pulse);
  void conclude(const JobQueue::Lease& lease, const Run& run);
  void publish(const JobQueue::Lease& lease);
  void persist(const std::string& job);
  /// Learns what prepare() named last, if that is still to be done. A job that comes meanwhile waits for it: it would
  /// have to learn the same.
  void learn(const std::stop_token& stop, Pulse& pulse);

  const JobRunnerOptions options_;
  JobQueue& jobs_;
  HeadStart& head_start_;
  AvatarStore& avatars_;
  EventBus& events_;
  Metrics& metrics_;
  const OnHealth on_health_;
  std::vector<Pulse> pulses_;  ///< one a worker
  std::mutex mutex_;
  std::filesystem::path to_learn_;  ///< guarded by mutex_; empty: nothing
  std::vector<std::jthread> workers_;
};

}  // namespace booth
