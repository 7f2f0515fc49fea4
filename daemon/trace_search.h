#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// Where something of a person is left: each file or folder below `folder` whose name or content has one of the words,
/// byte by byte. Of the answers that are kept for a day for requests that come twice (keys.jsonl), only the clients'
/// own words count: ids in the answers name nobody once nothing else does.
///
/// @param words  ids of captures and avatars, a label; empty ones find nothing
/// @error io  something cannot be read: then nothing is proven
Result<std::vector<std::filesystem::path>> find_traces(const std::filesystem::path& folder,
                                                       const std::vector<std::string>& words);

/// Whether a file has one of the words. @error not_found, io
Result<bool> has_trace(const std::filesystem::path& file, const std::vector<std::string>& words);

}  // namespace booth
