#include "drivers/aravis/ptp_watch.h"

namespace booth {

std::optional<std::string> PtpWatch::note(const std::string& camera, const std::string& state) {
  const std::lock_guard lock(mutex_);
  if (state != "Master") {
    masters_.erase(camera);
    return std::nullopt;
  }
  if (!masters_.insert(camera).second || masters_.size() == 1) return std::nullopt;
  std::string names;
  for (const std::string& master : masters_) names += (names.empty() ? "" : ", ") + master;
  return "ptp: " + names + " are all masters, so that their clocks do not agree: they must be on one network";
}

}  // namespace booth
