#include "daemon/job_runner.h"

#include <poll.h>
#include <pthread.h>
#include <spdlog/spdlog.h>
#include <sys/wait.h>

#include <algorithm>
#include <array>
#include <exception>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "daemon/child_output.h"
#include "daemon/child_process.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

using Json = nlohmann::json;
using SteadyClock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds step{50};            ///< how soon a cancelled job's process is killed
constexpr std::chrono::milliseconds publish_pause{100};  ///< between two progress events of a job
constexpr size_t most_cameras = 1024;                    ///< of which a process may tell the health

std::string text_of(const Json& object, const char* key, const char* otherwise) {
  const auto found = object.find(key);
  return found != object.end() && found->is_string() ? found->get<std::string>() : otherwise;
}

double number_of(const Json& object, const char* key, double otherwise) {
  const auto found = object.find(key);
  return found != object.end() && found->is_number() ? found->get<double>() : otherwise;
}

bool flag_of(const Json& object, const char* key) {
  const auto found = object.find(key);
  return found != object.end() && found->is_boolean() && found->get<bool>();
}

CameraHealth health_of(const Json& object) {
  return {.camera = text_of(object, "camera", ""),
          .moved = flag_of(object, "moved"),
          .offset_px = number_of(object, "offset_px", 0),
          .deviation = number_of(object, "deviation", 0),
          .light_factor = number_of(object, "light_factor", 1),
          .shifted = flag_of(object, "shifted"),
          .background_px = number_of(object, "background_px", 0),
          .background_share = number_of(object, "background_share", 1)};
}

std::string describe_end(int status, const std::string& last_words) {
  std::string text = WIFSIGNALED(status) ? "was killed by signal " + std::to_string(WTERMSIG(status))
                                         : "ended with status " + std::to_string(WEXITSTATUS(status));
  if (!last_words.empty()) text += ": " + last_words;
  return "the reconstruction's process " + text;
}

}  // namespace

/// One run of a process, from its start to its end.
struct JobRunner::Run {
  enum class End { exited, timed_out, too_large, unwanted, stopped, not_started };
  End end = End::not_started;
  int status = 0;               ///< of an exited one, as waitpid says
  std::optional<Reason> error;  ///< what it said itself, or why it could not be started
  Tail output;
};

JobRunner::JobRunner(JobRunnerOptions options, JobQueue& jobs, HeadStart& head_start, AvatarStore& avatars,
                     EventBus& events, Metrics& metrics, OnHealth on_health)
    : options_(std::move(options)),
      jobs_(jobs),
      head_start_(head_start),
      avatars_(avatars),
      events_(events),
      metrics_(metrics),
      on_health_(std::move(on_health)),
      pulses_(static_cast<size_t>(std::max(1, options_.workers))) {
  for (Pulse& pulse : pulses_) {
    workers_.emplace_back([this, &pulse](const std::stop_token& stop) { work(stop, pulse); });
    pthread_setname_np(workers_.back().native_handle(), "jobs");
  }
}

JobRunner::~JobRunner() { stop(); }

void JobRunner::stop() {
  for (std::jthread& worker : workers_) worker.request_stop();
  for (std::jthread& worker : workers_)
    if (worker.joinable()) worker.join();
}

SteadyClock::time_point JobRunner::last_pulse() const {
  SteadyClock::time_point slowest = SteadyClock::time_point::max();
  for (const Pulse& pulse : pulses_) slowest = std::min(slowest, pulse.last());
  return slowest;
}

void JobRunner::work(const std::stop_token& stop, Pulse& pulse) {
  constexpr std::chrono::milliseconds patience{500};
  while (!stop.stop_requested()) {
    pulse.beat();
    const auto lease = jobs_.take(stop, patience);
    if (!lease) {
      learn(stop, pulse);
      continue;
    }
    try {
      run(*lease, stop, pulse);
    } catch (const std::exception& fault) {
      spdlog::error("job {}: {}", lease->job.id, fault.what());
      jobs_.fail(*lease, {"internal", "the booth's program has a fault: " + std::string(fault.what())});
      persist(lease->job.id);
    }
    jobs_.release(*lease);
  }
}

void JobRunner::prepare(const std::filesystem::path& recording) {
  if (options_.program.cache.empty()) return;
  const std::lock_guard lock(mutex_);
  to_learn_ = recording;
}

void JobRunner::learn(const std::stop_token& stop, Pulse& pulse) {
  std::filesystem::path recording;
  {
    const std::lock_guard lock(mutex_);
    recording = std::exchange(to_learn_, {});
  }
  if (recording.empty()) return;
  auto child = ChildProcess::start({options_.program.command, recording, "--learn", "--cache", options_.program.cache});
  if (!child) return spdlog::warn("the background is not prepared: {}", child.error().message);
  const auto deadline = SteadyClock::now() + options_.program.timeout;
  Tail output;
  bool output_open = true;
  for (;;) {
    pulse.beat();
    pollfd polled{output_open ? child->output() : -1, POLLIN, 0};
    ::poll(&polled, 1, static_cast<int>(step.count()));
    if (output_open) output_open = output.read(child->output());
    const auto status = child->poll_status();
    if (status && *status != 0) spdlog::warn("the background is not prepared: {}", output.last_line());
    if (status || stop.stop_requested() || SteadyClock::now() >= deadline) return;
  }
}

void JobRunner::persist(const std::string& job) {
  if (const auto written = jobs_.persist(job); !written) {
    spdlog::error("job {}: {}", job, written.error().message);
    events_.publish(Alert{Severity::error, std::string(to_string(written.error().code)), written.error().message});
  }
}

void JobRunner::run(const JobQueue::Lease& lease, const std::stop_token& stop, Pulse& pulse) {
  const std::string& id = lease.job.id;
  persist(id);  // that it runs, so that a job which brings the daemon down is counted
  // The daemon may have died after the avatar appeared and before that was written down.
  if (avatars_.publish(id)) return publish(lease);
  // Something else of that name would keep the avatar from appearing.
  if (const auto removed = avatars_.remove(id); !removed) spdlog::warn("{}", removed.error().message);

  const auto started = SteadyClock::now();
  Run run;
  {
    auto child = head_start_.take(id);
    spdlog::info("job {}: {}", id, child ? "goes on with what its capture began" : "started");
    if (!child) {
      auto fresh = ChildProcess::start(options_.program.arguments(id, lease.job.face));
      if (!fresh) {
        run.error = Reason{"internal", fresh.error().message};
        return conclude(lease, run);
      }
      child.emplace(*std::move(fresh));
    }

    auto last_published = SteadyClock::time_point::min();
    LineReader lines;
    std::vector<CameraHealth> cameras;
    const auto on_line = [&](const std::string& line) {
      const Json json = Json::parse(line, nullptr, false);
      if (!json.is_object()) return;
      if (const auto error = json.find("error"); error != json.end() && error->is_object()) {
        run.error = Reason{text_of(*error, "kind", "internal"), text_of(*error, "message", "it did not say why")};
      } else if (const auto health = json.find("health"); health != json.end()) {
        if (health->is_object()) {
          if (cameras.size() < most_cameras) cameras.push_back(health_of(*health));
        } else if (on_health_) {
          on_health_(id, std::exchange(cameras, {}));
        }
      } else if (const auto stage = json.find("stage"), fraction = json.find("fraction");
                 stage != json.end() && stage->is_string() && fraction != json.end() && fraction->is_number()) {
        const auto now = SteadyClock::now();
        const bool publish = now - publish_pause >= last_published;
        if (publish) last_published = now;
        jobs_.report(lease, stage->get<std::string>(), fraction->get<double>(), publish);
      }
    };

    const auto deadline = started + options_.program.timeout;
    const uint64_t most_bytes = options_.program.memory_limit();
    bool progress_open = true, output_open = true;
    for (;;) {
      pulse.beat();
      std::array<pollfd, 2> polled{pollfd{progress_open ? child->progress() : -1, POLLIN, 0},
                                   pollfd{output_open ? child->output() : -1, POLLIN, 0}};
      ::poll(polled.data(), polled.size(), static_cast<int>(step.count()));
      if (progress_open) progress_open = lines.read(child->progress(), on_line);
      if (output_open) output_open = run.output.read(child->output());
      if (const auto status = child->poll_status()) {
        // What it said between the reads above and its end; grandchildren may hold the pipes open.
        if (progress_open) lines.read(child->progress(), on_line);
        if (output_open) run.output.read(child->output());
        run.end = Run::End::exited;
        run.status = *status;
        break;
      }
      if (!jobs_.is_wanted(lease))
        run.end = Run::End::unwanted;
      else if (stop.stop_requested())
        run.end = Run::End::stopped;
      else if (SteadyClock::now() >= deadline)
        run.end = Run::End::timed_out;
      else if (child->resident_bytes() > most_bytes)
        run.end = Run::End::too_large;
      if (run.end != Run::End::not_started) break;
    }
  }  // the process is dead from here on
  metrics_.observe("job_seconds", std::chrono::duration<double>(SteadyClock::now() - started).count());
  conclude(lease, run);
}

void JobRunner::conclude(const JobQueue::Lease& lease, const Run& run) {
  const std::string& id = lease.job.id;
  if (run.end == Run::End::exited && WIFEXITED(run.status) && WEXITSTATUS(run.status) == 0) {
    const auto published = avatars_.publish(id);
    if (published) return publish(lease);
    jobs_.fail(lease, {"internal", "the reconstruction ended well but left no avatar: " + published.error().message});
  } else if (run.end == Run::End::exited && WIFSIGNALED(run.status)) {
    jobs_.died(lease, options_.retries, {"internal", describe_end(run.status, run.output.last_line())});
  } else if (run.end == Run::End::exited) {
    jobs_.fail(lease, run.error ? *run.error : Reason{"internal", describe_end(run.status, run.output.last_line())});
  } else if (run.end == Run::End::timed_out) {
    jobs_.died(lease, options_.retries,
               {"timeout", "the reconstruction took longer than " +
                               std::to_string(options_.program.timeout.count() / 1000) + " s and was stopped"});
  } else if (run.end == Run::End::too_large) {
    jobs_.died(
        lease, options_.retries,
        {"out_of_memory", "the reconstruction took more memory than it may and was stopped: see jobs.memory_mib"});
  } else if (run.end == Run::End::not_started) {
    jobs_.fail(lease, *run.error);
  } else if (run.end == Run::End::stopped) {
    jobs_.give_back(lease);
  }
  // Nothing half-made stays, and no avatar of a job that was cancelled while it appeared.
  if (const auto removed = avatars_.remove(id); !removed) spdlog::warn("{}", removed.error().message);
  if (const auto removed = remove_partial_folders(avatars_.folder()); !removed)
    spdlog::warn("{}", removed.error().message);

  persist(id);
  const auto job = jobs_.find(id);
  if (job && job->died > 0 && job->state != JobState::failed) {
    metrics_.add("jobs_retried");
    spdlog::warn("job {}: its process died, hung or took too much memory; it is tried again", id);
  }
  if (!job || job->state != JobState::failed) return;
  metrics_.add("jobs_failed");
  spdlog::error("job {}: failed: {}: {}", id, job->error->kind, job->error->message);
  if (!run.output.text().empty()) spdlog::error("job {}: its last words:\n{}", id, run.output.text());
}

void JobRunner::publish(const JobQueue::Lease& lease) {
  const std::string& id = lease.job.id;
  if (!jobs_.finish(lease)) {
    // Cancelled or deleted a moment ago.
    if (const auto removed = avatars_.remove(id); !removed) spdlog::warn("{}", removed.error().message);
    persist(id);
    return;
  }
  persist(id);
  const auto avatar = avatars_.find(id);
  if (!avatar) return;  // deleted a moment ago
  // Whoever fetches a file need not wait for its digest.
  for (const std::string& file : avatar->files)
    if (const auto digest = avatars_.fetch(id, file, 0, 0); !digest) spdlog::warn("{}", digest.error().message);
  metrics_.add("jobs_done");
  spdlog::info("job {}: done", id);
  if (const auto job = jobs_.find(id); job && !job->stage.empty())
    events_.publish(JobProgressed{id, id, job->stage, 1});
  events_.publish(AvatarPublished{id, id, id, avatar->label.empty() ? lease.job.label : avatar->label, avatar->files});
}

}  // namespace booth
