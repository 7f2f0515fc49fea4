#include "daemon/retention.h"

#include <algorithm>

#include "daemon/identifier.h"

namespace booth {
namespace {

/// Before this software was: a clock without a battery starts in 1970.
constexpr const char* earliest_plausible = "2024-01-01T00:00:00Z";

}  // namespace

std::vector<std::string> avatars_to_delete(const RetentionConfig& config, const std::vector<AvatarSummary>& avatars,
                                           const JobQueue& jobs, std::chrono::system_clock::time_point now, bool room) {
  // Dates of this form sort as texts.
  const std::string oldest_kept = iso8601(now - std::chrono::hours(config.max_age_h));
  std::vector<std::string> ids;
  size_t kept = avatars.size();
  for (auto avatar = avatars.rbegin(); avatar != avatars.rend(); ++avatar) {
    const auto job = jobs.find(avatar->capture.empty() ? avatar->id : avatar->capture);
    if (job && job->state != JobState::done) continue;
    const bool old = config.max_age_h > 0 && avatar->created >= earliest_plausible && avatar->created < oldest_kept;
    const bool surplus = config.max_captures > 0 && kept > static_cast<size_t>(config.max_captures);
    const bool for_room = config.make_room && !room && ids.empty();
    if (!old && !surplus && !for_room) continue;
    ids.push_back(avatar->id);
    --kept;
  }
  return ids;
}

}  // namespace booth
