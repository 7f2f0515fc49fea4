#include "replay/frame_cache.h"

namespace booth {
namespace {

size_t size_of(const Frame& frame) {
  return frame.pixels->samples.size() + (frame.encoded ? frame.encoded->size() : 0);
}

}  // namespace

Frame FrameCache::find(const std::string& file) {
  const std::lock_guard lock(mutex_);
  const auto found = files_.find(file);
  if (found == files_.end()) return {};
  entries_.splice(entries_.begin(), entries_, found->second);
  return entries_.front().frame;
}

void FrameCache::keep(const std::string& file, const Frame& frame) {
  const std::lock_guard lock(mutex_);
  if (size_of(frame) > most_bytes_ || files_.contains(file)) return;
  entries_.push_front({file, frame});
  files_[file] = entries_.begin();
  bytes_ += size_of(frame);
  while (bytes_ > most_bytes_) {
    bytes_ -= size_of(entries_.back().frame);
    files_.erase(entries_.back().file);
    entries_.pop_back();
  }
}

}  // namespace booth
