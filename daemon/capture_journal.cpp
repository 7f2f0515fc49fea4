#include "daemon/capture_journal.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <system_error>

#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

Error fault(const fs::path& path, const std::string& doing, int number) {
  const bool full = number == ENOSPC || number == EDQUOT;
  return {full ? ErrorCode::disk_full : ErrorCode::io,
          path.string() + ": " + doing + ": " + std::generic_category().message(number)};
}

}  // namespace

Result<CaptureJournal> CaptureJournal::open(const fs::path& folder) {
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) return fault(folder, "cannot be made", code.value());
  return CaptureJournal(folder);
}

Result<std::vector<std::string>> CaptureJournal::unfinished() const {
  std::vector<std::string> ids;
  std::error_code code;
  for (fs::directory_iterator entry(folder_, code), end; !code && entry != end; entry.increment(code))
    if (const std::string id = entry->path().filename().string(); is_safe_id(id)) ids.push_back(id);
  if (code) return fault(folder_, "cannot be listed", code.value());
  std::sort(ids.begin(), ids.end());  // ids sort by their time
  return ids;
}

Result<void> CaptureJournal::begin(const std::string& id) const {
  const fs::path file = folder_ / id;
  int descriptor = -1;
  do descriptor = ::open(file.c_str(), O_CREAT | O_EXCL | O_WRONLY | O_CLOEXEC, 0600);
  while (descriptor < 0 && errno == EINTR);
  if (descriptor < 0) return fault(file, "cannot be made", errno);
  ::close(descriptor);  // nothing was written that could be lost
  return {};
}

Result<void> CaptureJournal::sync(const std::string& id) const {
  if (const auto flushed = flush_to_disk(folder_ / id); !flushed) return flushed;
  return flush_to_disk(folder_);
}

Result<void> CaptureJournal::end(const std::string& id) const {
  const fs::path file = folder_ / id;
  if (::unlink(file.c_str()) != 0) {
    if (errno == ENOENT) return {};
    return fault(file, "cannot be removed", errno);
  }
  return flush_to_disk(folder_);
}

}  // namespace booth
