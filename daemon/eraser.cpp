#include "daemon/eraser.h"

#include <fcntl.h>
#include <spdlog/spdlog.h>
#include <unistd.h>

#include <cerrno>
#include <system_error>
#include <utility>
#include <vector>

#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr size_t most_waiting = 1024;

fs::path marks_of(const fs::path& state) { return state / "deleting"; }

/// Creating an empty file does not wait for the disk; it outlives this process, and a power cut a moment later.
void mark(const fs::path& state, const std::string& id) {
  const int file = ::open((marks_of(state) / id).c_str(), O_CREAT | O_WRONLY | O_CLOEXEC, 0600);
  // A full disk keeps no mark, but is no reason not to delete.
  if (file < 0)
    spdlog::warn("{}: cannot be marked as deleted: {}", id, std::generic_category().message(errno));
  else
    ::close(file);
}

void unmark(const fs::path& state, const std::string& id) { ::unlink((marks_of(state) / id).c_str()); }

}  // namespace

Eraser::Eraser(const fs::path& state, JobQueue& jobs, HeadStart& head_start, AvatarStore& avatars,
               const CaptureJournal& journal, CaptureSession* session, EventBus& events)
    : state_(state),
      jobs_(jobs),
      head_start_(head_start),
      avatars_(avatars),
      journal_(journal),
      session_(session),
      events_(events),
      executor_("eraser", most_waiting) {}

Result<void> Eraser::finish_interrupted(const fs::path& state) {
  std::error_code code;
  fs::create_directories(marks_of(state), code);
  std::vector<std::string> ids;
  for (fs::directory_iterator entry(marks_of(state), code), end; !code && entry != end; entry.increment(code))
    ids.push_back(entry->path().filename().string());
  if (code) return Error{ErrorCode::io, marks_of(state).string() + ": " + code.message()};
  for (const std::string& id : ids) {
    if (is_safe_id(id)) {
      for (const char* folder : {"recordings", "avatars"})
        if (const auto removed = remove_folder(state / folder, id); !removed) return removed;
      ::unlink((state / "jobs" / (id + ".json")).c_str());
      ::unlink((state / "capturing" / id).c_str());
    }
    unmark(state, id);
  }
  return {};
}

Result<void> Eraser::erase(const std::set<std::string>& ids, std::function<void(Result<void>)> done) {
  std::set<std::string> published;
  for (const std::string& id : ids) {
    mark(state_, id);
    if (session_ != nullptr) session_->abandon(id);
    jobs_.forget(id);
    if (avatars_.find(id)) published.insert(id);
    avatars_.forget(id);
  }
  const bool taken = executor_.post([this, ids, published, done = std::move(done)] {
    Result<void> outcome;
    for (const std::string& id : ids) {
      const auto removed = remove(id);
      if (!removed) {
        spdlog::error("{}: cannot be deleted, the next start tries again: {}", id, removed.error().message);
        outcome = removed;
      } else if (published.contains(id)) {
        events_.publish(AvatarDeleted{id});
      }
    }
    done(outcome);
  });
  if (!taken) return Error{ErrorCode::busy, "too many deletions are waiting; try again in a moment"};
  return {};
}

Result<void> Eraser::remove(const std::string& id) {
  if (session_ != nullptr) session_->wait_over(id);
  jobs_.forget(id);  // a capture that ended a moment ago may have left one
  jobs_.wait_released(id);
  head_start_.drop(id);
  if (const auto removed = avatars_.remove(id); !removed) return removed;
  if (const auto removed = remove_folder(state_ / "recordings", id); !removed) return removed;
  if (const auto removed = jobs_.persist(id); !removed) return removed;
  if (const auto removed = journal_.end(id); !removed) return removed;
  unmark(state_, id);
  spdlog::info("{}: deleted", id);
  return {};
}

}  // namespace booth
