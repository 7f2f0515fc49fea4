#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <span>
#include <string>

#include "pipeline/reconstruct.h"
#include "pipeline/types/empty_view.h"
#include "pipeline/types/result.h"
#include "pipeline/types/work.h"
#include "replay/recording.h"

namespace booth {

/// What cameras saw of the empty booth, kept for the jobs to come: learning it anew from its frames would cost more
/// than anything else about a frame of the subject. A file a camera and set of frames; any of them may be lost at any
/// time. Safe for several processes.
class EmptyViewStore {
 public:
  /// @param most_bytes  of all files; those longest unused go first
  explicit EmptyViewStore(std::filesystem::path folder, uint64_t most_bytes = uint64_t{1} << 30);

  /// What was learned from exactly these files, or nothing: never kept, damaged, or a file cannot be looked at.
  std::optional<EmptyView> find(const Recording& recording, std::span<const FrameRecord> frames) const;

  /// Keeps what was learned from these files. The folder is made where it is missing.
  /// @error io, disk_full
  Result<void> keep(const Recording& recording, std::span<const FrameRecord> frames, const EmptyView& view) const;

 private:
  void make_room() const;

  std::filesystem::path folder_;
  uint64_t most_bytes_;
};

/// What each camera saw of the empty booth, from the store where it is there and otherwise from the frames, which is
/// then kept in it. A frame that cannot be used is left out; the faults say which and why.
///
/// @param background  a shot of the recording
/// @param store       nullptr: nothing is kept
EmptyBooth learn_background(const Recording& recording, const Shot& background, const EmptyViewStore* store,
                            const Work& work = {});

}  // namespace booth
