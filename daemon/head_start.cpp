#include "daemon/head_start.h"

#include <pthread.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <nlohmann/json.hpp>
#include <utility>

#include "replay/durable_folder.h"

namespace booth {
namespace {

constexpr std::chrono::milliseconds watch_pause{200};

}  // namespace

HeadStart::HeadStart(ReconstructProgram program, int workers, JobQueue& jobs)
    : program_(std::move(program)),
      workers_(workers),
      jobs_(jobs),
      thread_([this](const std::stop_token& stop) { run(stop); }) {
  pthread_setname_np(thread_.native_handle(), "head start");
}

HeadStart::~HeadStart() {
  thread_.request_stop();
  thread_.join();
  end();
}

void HeadStart::grow(const std::string& capture, const std::string& face, const std::filesystem::path& folder) {
  {
    const std::lock_guard lock(mutex_);
    if (capture != capture_) {
      end();
      if (!has_room()) return;
      capture_ = capture;
      face_ = face;
    }
    folder_ = folder;
    told_ = false;
  }
  changed_.notify_all();
}

std::optional<ChildProcess> HeadStart::take(const std::string& job) {
  const std::lock_guard lock(mutex_);
  if (capture_ != job) {
    if (!has_room()) end();
    return std::nullopt;
  }
  const bool lives = process_ && !process_->poll_status() && process_->tell("{\"complete\": true}\n");
  std::optional<ChildProcess> taken;
  if (lives) taken.emplace(*std::exchange(process_, std::nullopt));
  end();
  return taken;
}

void HeadStart::drop(const std::string& capture) {
  const std::lock_guard lock(mutex_);
  if (capture_ == capture) end();
}

/// Whether a worker is idle.
bool HeadStart::has_room() const { return jobs_.unfinished() < workers_; }

/// Kills the process, and forgets whose it was.
void HeadStart::end() {
  const bool ran = process_.has_value();
  process_.reset();
  capture_.clear();
  if (!ran) return;
  if (const auto removed = remove_partial_folders(program_.avatars); !removed)
    spdlog::warn("{}", removed.error().message);
}

void HeadStart::run(const std::stop_token& stop) {
  std::unique_lock lock(mutex_);
  while (!stop.stop_requested()) {
    if (process_)
      changed_.wait_for(lock, stop, watch_pause, [this] { return !capture_.empty() && !told_; });
    else
      changed_.wait(lock, stop, [this] { return !capture_.empty() && !told_; });
    if (stop.stop_requested() || capture_.empty()) continue;
    if (!told_) start();
    if (process_) watch();
  }
}

/// Sees to it that the process runs and knows what there is.
void HeadStart::start() {
  told_ = true;
  if (!process_) {
    std::vector<std::string> command = program_.arguments(capture_, face_);
    command.emplace_back("--growing");
    auto started = ChildProcess::start(command, ChildProcess::Input::told);
    if (!started) {
      spdlog::warn("capture {}: its reconstruction begins later: {}", capture_, started.error().message);
      return end();
    }
    process_.emplace(*std::move(started));
    started_ = std::chrono::steady_clock::now();
  }
  const std::string news = nlohmann::json{{"so_far", folder_.string()}}.dump() + "\n";
  if (!process_->tell(news)) end();
}

/// Ends a process that nobody will want, or that takes too much.
void HeadStart::watch() {
  const auto job = jobs_.find(capture_);
  const bool wanted = !job || job->state == JobState::queued || job->state == JobState::running;
  const bool late = std::chrono::steady_clock::now() - started_ > program_.timeout;
  if (!wanted || late || process_->resident_bytes() > program_.memory_limit()) end();
}

}  // namespace booth
