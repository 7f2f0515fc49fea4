#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <string_view>

#include "pipeline/types/result.h"

namespace booth {

/// The layout of configurations that this program reads and writes, their key `version`. One without the key is of this
/// version, unless it shows to be older:
///   1  has [drivers] camera = "replay", where now whatever is not in [[cameras]] is played back
constexpr int config_version = 2;

struct MigratedConfig {
  int from = 0;      ///< its version
  std::string text;  ///< what it is in this version; comments stay
};

/// @return nothing  it is of this version, or no configuration
/// @error unsupported  it is of a newer version, which the message begins with
Result<std::optional<MigratedConfig>> migrate_config(std::string_view toml);

/// Brings a file to this version: the original is kept beside it as FILE.bak-1 (or the next number that is free), then
/// it is replaced, whole or not at all, with the owner and the permissions that it has.
/// @return a sentence that says what was done; empty: nothing
/// @error not_found, invalid_file; unsupported  it is of a newer version; disk_full, io  it is as it was
Result<std::string> migrate_config_file(const std::filesystem::path& file);

}  // namespace booth
