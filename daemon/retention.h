#pragma once

#include <chrono>
#include <string>
#include <vector>

#include "config/booth_config.h"
#include "daemon/avatar_store.h"
#include "daemon/job_queue.h"

namespace booth {

/// Avatars that are to be deleted with their recordings, the oldest first: those that are too old, those that are too
/// many, and, where there is no room for the next capture and the configuration wants it so, the oldest that is left.
/// Captures that have no avatar yet, or whose job runs again, are never among them. What a booth whose clock was not
/// set dated into a distant past is not taken for old.
///
/// @param avatars  newest first, as AvatarStore::list gives them
/// @param room     whether the next capture can be stored
std::vector<std::string> avatars_to_delete(const RetentionConfig& config, const std::vector<AvatarSummary>& avatars,
                                           const JobQueue& jobs, std::chrono::system_clock::time_point now, bool room);

}  // namespace booth
