#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// A file of the avatar's folder, as metadata.json lists it.
struct AvatarFile {
  std::string name;
  uint64_t size = 0;   ///< bytes
  std::string sha256;  ///< 64 hexadecimal digits
};

/// What metadata.json says about an avatar.
struct AvatarMetadata {
  std::string id;
  std::string created;    ///< ISO 8601, UTC: "2026-11-22T10:15:00Z"
  std::string label;      ///< the operator's words; may be empty
  std::string recording;  ///< id of the recording it was made from
  std::string software_version = BOOTH_VERSION;
  std::vector<std::string> cameras;  ///< ids of those that shaped it
  std::string face = "none";         ///< how it was made: "active", "passive", or "none": the hull's own
  std::string texture_method = {};   ///< "full", "blend" or "best_view"; empty where there is none
  uint64_t triangles = 0;
  uint64_t joints = 0;
  std::vector<std::pair<std::string, double>> stage_seconds;  ///< in the order the stages ran
  std::vector<std::string> warnings;                          ///< sentences for an operator
  std::vector<AvatarFile> files;                              ///< all but metadata.json itself
};

/// The metadata as JSON text, an object with these keys, in this order:
///
///     id, created, label, recording, software_version, face,
///     texture_method                                          strings
///     cameras, warnings                                       arrays of strings
///     triangles, joints                                       whole numbers
///     stage_seconds                                           {"hull": 0.21, …}
///     files                                                   {"avatar.dae": {"size": 2345678, "sha256": "…"}, …}
///
/// Bytes that are not UTF-8 are replaced by U+FFFD.
std::string write_metadata(const AvatarMetadata& metadata);

/// Reads it back. Keys that this version does not know are ignored; `label`, `face`, `texture_method`, `cameras`,
/// `warnings`, `stage_seconds` and `files` may be missing.
/// @error invalid_file  not JSON, a key of the others is missing, or a value is of another kind; names the key
Result<AvatarMetadata> read_metadata(std::string_view json);

}  // namespace booth
