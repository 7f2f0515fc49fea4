#include "daemon/background_store.h"

#include <spdlog/spdlog.h>

#include <algorithm>
#include <functional>
#include <system_error>
#include <utility>
#include <vector>

#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {

namespace fs = std::filesystem;

Result<std::unique_ptr<BackgroundStore>> BackgroundStore::open(const fs::path& folder) {
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be made: " + code.message()};
  if (const auto removed = remove_partial_folders(folder); !removed) return removed.error();

  std::vector<std::string> ids;
  for (fs::directory_iterator entry(folder, code), end; !code && entry != end; entry.increment(code))
    if (is_safe_id(entry->path().filename().string())) ids.push_back(entry->path().filename().string());
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be listed: " + code.message()};
  std::sort(ids.begin(), ids.end(), std::greater<>());

  std::unique_ptr<BackgroundStore> store(new BackgroundStore(folder));
  for (const std::string& id : ids) {
    auto recording = read_recording(folder / id);
    if (recording && recording->find(ShotRole::background) != nullptr) {
      store->current_ = std::make_shared<const Recording>(std::move(*recording));
      break;
    }
    spdlog::warn("{}: not a background{}", (folder / id).string(), recording ? "" : ": " + recording.error().message);
  }
  return store;
}

std::shared_ptr<const Recording> BackgroundStore::current() const {
  const std::lock_guard lock(mutex_);
  return current_;
}

Result<void> BackgroundStore::adopt(const Recording& recording, const std::string& id, const std::string& created) {
  const Shot* shot = recording.find(ShotRole::background);
  if (shot == nullptr)
    return Error{ErrorCode::no_background, recording.folder.string() + ": the recording has no background shot"};
  auto writer = begin(recording.rig, {}, id, created);
  if (!writer) return writer.error();
  if (const auto added = (*writer)->add_shot(recording, *shot); !added) return added;
  return finish(**writer, id);
}

Result<std::unique_ptr<RecordingWriter>> BackgroundStore::begin(const Rig& rig, const SpoolOptions& images,
                                                                const std::string& id,
                                                                const std::string& created) const {
  return RecordingWriter::begin(folder_, {.id = id, .created = created, .label = {}, .face = {}}, rig, images);
}

Result<void> BackgroundStore::finish(RecordingWriter& writer, const std::string& id) {
  if (const auto committed = writer.commit(); !committed) return committed;
  auto written = read_recording(folder_ / id);
  if (!written) return written.error();

  std::shared_ptr<const Recording> previous;
  {
    const std::lock_guard lock(mutex_);
    previous = std::exchange(current_, std::make_shared<const Recording>(std::move(*written)));
  }
  // A capture that still links to it keeps the images that it has linked, and fails on the others.
  if (previous != nullptr)
    if (const auto removed = remove_folder(folder_, previous->folder.filename().string()); !removed)
      spdlog::warn("{}", removed.error().message);
  return {};
}

}  // namespace booth
