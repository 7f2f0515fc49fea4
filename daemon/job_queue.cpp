#include "daemon/job_queue.h"

#include <spdlog/spdlog.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <nlohmann/json.hpp>
#include <system_error>
#include <utility>

#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

/// How often a job may be running when the daemon dies. Power cuts and upgrades are no fault of the job; a job that
/// is there each time is.
constexpr int most_interruptions = 10;
constexpr size_t most_bytes = 64 * 1024;
constexpr int file_version = 1;

std::optional<JobState> job_state_from(const std::string& name) {
  for (const JobState state :
       {JobState::queued, JobState::running, JobState::failed, JobState::done, JobState::cancelled})
    if (to_string(state) == name) return state;
  return std::nullopt;
}

std::string write_job(const Job& job) {
  Json json{{"version", file_version},
            {"id", job.id},
            {"face", job.face},
            {"label", job.label},
            {"state", to_string(job.state)},
            {"interrupted", job.interrupted},
            {"died", job.died},
            {"recorded", job.recorded}};
  if (job.error) json["error"] = {{"kind", job.error->kind}, {"message", job.error->message}};
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

/// 0 where it is not there, or is no count.
int read_count(const Json& json, const char* name) {
  constexpr uint64_t most = 1000;  // beyond any that is acted on
  const auto found = json.find(name);
  if (found == json.end() || !found->is_number_unsigned()) return 0;
  return static_cast<int>(std::min(found->get<uint64_t>(), most));
}

/// Nothing for what is not a job of that id. Only what every version has is asked for.
std::optional<Job> parse_job(const std::vector<uint8_t>& bytes, const std::string& id) {
  try {
    const Json json = Json::parse(bytes);
    Job job;
    job.id = json.at("id").get<std::string>();
    job.face = json.value("face", "auto");
    job.label = json.value("label", "");
    job.interrupted = read_count(json, "interrupted");
    job.died = read_count(json, "died");
    job.recorded = json.value("recorded", true);
    if (const auto error = json.find("error"); error != json.end() && error->is_object())
      job.error = Reason{error->value("kind", "internal"), error->value("message", "it is not known why")};
    const auto state = job_state_from(json.at("state").get<std::string>());
    if (job.id != id || !is_safe_id(id)) return std::nullopt;
    job.state = state.value_or(JobState::queued);  // one of a newer version: this one starts over
    job.fraction = job.state == JobState::done ? 1 : 0;
    return job;
  } catch (const Json::exception&) {
    return std::nullopt;
  }
}

}  // namespace

std::string_view to_string(JobState state) {
  switch (state) {
    case JobState::queued: return "queued";
    case JobState::running: return "running";
    case JobState::failed: return "failed";
    case JobState::done: return "done";
    case JobState::cancelled: return "cancelled";
  }
  return "failed";
}

Result<std::unique_ptr<JobQueue>> JobQueue::open(const fs::path& folder, EventBus& events) {
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be made: " + code.message()};
  if (const auto removed = remove_partial_folders(folder); !removed) return removed.error();

  std::unique_ptr<JobQueue> queue(new JobQueue(folder, events));
  std::vector<std::string> changed;
  for (fs::directory_iterator file(folder, code), end; !code && file != end; file.increment(code)) {
    if (file->path().extension() != ".json") continue;
    const std::string id = file->path().stem().string();
    const auto bytes = read_file(file->path(), most_bytes);
    if (!bytes && bytes.error().code == ErrorCode::io) {
      spdlog::warn("{}", bytes.error().message);
      continue;
    }
    std::optional<Job> job;
    if (bytes) job = parse_job(*bytes, id);
    if (!job) {
      spdlog::warn("{}: not a readable job; it is removed", file->path().string());
      ::unlink(file->path().c_str());
      continue;
    }
    if (job->state == JobState::running) {
      job->state = JobState::queued;
      if (++job->interrupted > most_interruptions) {
        job->state = JobState::failed;
        job->error = Reason{"internal", "the reconstruction was running " + std::to_string(job->interrupted) +
                                            " times when the booth's program died; retry it by hand"};
      }
      changed.push_back(id);
    }
    const std::lock_guard lock(queue->mutex_);
    queue->entries_[id].job = *job;
  }
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be listed: " + code.message()};
  for (const std::string& id : changed)
    if (const auto written = queue->persist(id); !written) spdlog::warn("{}", written.error().message);
  return queue;
}

std::vector<Job> JobQueue::list() const {
  const std::lock_guard lock(mutex_);
  std::vector<Job> jobs;
  jobs.reserve(entries_.size());
  for (const auto& [id, entry] : entries_) jobs.push_back(entry.job);
  return jobs;
}

int JobQueue::unfinished() const {
  const std::lock_guard lock(mutex_);
  return static_cast<int>(std::count_if(entries_.begin(), entries_.end(), [](const auto& entry) {
    const JobState state = entry.second.job.state;
    return state == JobState::queued || state == JobState::running;
  }));
}

std::optional<Job> JobQueue::find(const std::string& id) const {
  const std::lock_guard lock(mutex_);
  const auto found = entries_.find(id);
  if (found == entries_.end()) return std::nullopt;
  return found->second.job;
}

void JobQueue::add(const Job& job) {
  const std::lock_guard lock(mutex_);
  if (entries_.try_emplace(job.id, Entry{.job = job}).second) occupied_.insert(job.id);
}

void JobQueue::redo(const std::string& id) {
  {
    const std::lock_guard lock(mutex_);
    const auto found = entries_.find(id);
    if (found == entries_.end() || found->second.job.state != JobState::done) return;
    Job& job = found->second.job;
    job = Job{.id = job.id, .face = job.face, .label = job.label};
  }
  queued_.notify_one();
}

Result<void> JobQueue::retry(const std::string& id) {
  {
    const std::lock_guard lock(mutex_);
    const auto found = entries_.find(id);
    if (found == entries_.end()) return Error{ErrorCode::not_found, "there is no job " + id};
    Job& job = found->second.job;
    if (job.state != JobState::failed && job.state != JobState::cancelled)
      return Error{ErrorCode::invalid_state, "job " + id + " is " + std::string(to_string(job.state)) +
                                                 "; only a failed or cancelled one can be retried"};
    if (!job.recorded)
      return Error{ErrorCode::invalid_state,
                   "capture " + id + " was not finished, there is nothing to retry: take it again"};
    job = Job{.id = job.id, .face = job.face, .label = job.label};
    found->second.lease = 0;
  }
  queued_.notify_one();
  return {};
}

Result<void> JobQueue::cancel(const std::string& id) {
  const std::lock_guard lock(mutex_);
  const auto found = entries_.find(id);
  if (found == entries_.end()) return Error{ErrorCode::not_found, "there is no job " + id};
  Job& job = found->second.job;
  if (job.state != JobState::queued && job.state != JobState::running)
    return Error{ErrorCode::invalid_state, "job " + id + " is over: it is " + std::string(to_string(job.state))};
  job.state = JobState::cancelled;
  job.error = Reason{"cancelled", "the job was cancelled"};
  found->second.lease = 0;
  events_.publish(JobCancelled{id, id});
  return {};
}

void JobQueue::forget(const std::string& id) {
  const std::lock_guard lock(mutex_);
  entries_.erase(id);
}

Result<void> JobQueue::persist(const std::string& id) {
  const std::lock_guard disk_lock(disk_mutex_);
  const auto job = find(id);
  if (job) return write_file_atomically(file_of(id), write_job(*job));
  if (::unlink(file_of(id).c_str()) != 0 && errno != ENOENT)
    return Error{ErrorCode::io,
                 file_of(id).string() + ": cannot be removed: " + std::generic_category().message(errno)};
  return {};
}

std::optional<JobQueue::Lease> JobQueue::take(const std::stop_token& stop, std::chrono::milliseconds patience) {
  std::unique_lock lock(mutex_);
  const auto next = [this] {
    auto found = entries_.end();
    for (auto entry = entries_.begin(); entry != entries_.end(); ++entry) {
      const Job& job = entry->second.job;
      if (job.state != JobState::queued || occupied_.contains(entry->first)) continue;
      if (found == entries_.end() || job.died < found->second.job.died) found = entry;
    }
    return found;
  };
  if (!queued_.wait_for(lock, stop, patience, [&] { return next() != entries_.end(); }) || stop.stop_requested())
    return std::nullopt;
  Entry& entry = next()->second;
  entry.job.state = JobState::running;
  entry.lease = ++leases_;
  occupied_.insert(entry.job.id);
  return Lease{entry.job, entry.lease};
}

JobQueue::Entry* JobQueue::leased(const Lease& lease) {
  const auto found = entries_.find(lease.job.id);
  return found != entries_.end() && found->second.lease == lease.number ? &found->second : nullptr;
}

bool JobQueue::is_wanted(const Lease& lease) const {
  const std::lock_guard lock(mutex_);
  const auto found = entries_.find(lease.job.id);
  return found != entries_.end() && found->second.lease == lease.number;
}

void JobQueue::report(const Lease& lease, const std::string& stage, double fraction, bool publish) {
  const std::lock_guard lock(mutex_);
  Entry* entry = leased(lease);
  if (entry == nullptr) return;
  entry->job.stage = stage;
  entry->job.fraction = std::max(entry->job.fraction, std::clamp(fraction, 0.0, 1.0));
  if (publish) events_.publish(JobProgressed{lease.job.id, lease.job.id, stage, entry->job.fraction});
}

bool JobQueue::finish(const Lease& lease) {
  const std::lock_guard lock(mutex_);
  Entry* entry = leased(lease);
  if (entry == nullptr) return false;
  entry->job.state = JobState::done;
  entry->job.fraction = 1;
  entry->lease = 0;
  return true;
}

bool JobQueue::fail(const Lease& lease, const Reason& error) {
  const std::lock_guard lock(mutex_);
  Entry* entry = leased(lease);
  if (entry == nullptr) return false;
  entry->job.state = JobState::failed;
  entry->job.error = error;
  entry->lease = 0;
  events_.publish(JobFailed{lease.job.id, lease.job.id, error});
  return true;
}

bool JobQueue::died(const Lease& lease, int retries, const Reason& error) {
  {
    const std::lock_guard lock(mutex_);
    Entry* entry = leased(lease);
    if (entry == nullptr) return false;
    if (++entry->job.died <= retries) {
      entry->job.state = JobState::queued;
      entry->lease = 0;
      queued_.notify_one();
      return true;
    }
  }
  return fail(lease, error);
}

void JobQueue::give_back(const Lease& lease) {
  const std::lock_guard lock(mutex_);
  Entry* entry = leased(lease);
  if (entry == nullptr) return;
  entry->job.state = JobState::queued;
  entry->lease = 0;
}

void JobQueue::release(const std::string& id) {
  {
    const std::lock_guard lock(mutex_);
    occupied_.erase(id);
  }
  released_.notify_all();
  queued_.notify_all();
}

void JobQueue::wait_released(const std::string& id) {
  std::unique_lock lock(mutex_);
  released_.wait(lock, [&] { return !occupied_.contains(id); });
}

}  // namespace booth
