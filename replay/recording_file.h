#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "replay/recording.h"

namespace booth {

/// Bytes of a label and other free text.
constexpr size_t longest_text = 1000;
/// Of a frame in a sequence that does not say how long it is.
constexpr int highest_index = 99999;

/// "2026-11-22T10:15:00Z", also with fractions of a second or a zone as +01:00.
bool is_date_and_time(const std::string& text);

/// Where one file of a recording is, with every symbolic link followed. Messages begin with the file as the
/// recording names it. @error not_found; @error invalid_file  it leads out of the folder; @error io
Result<std::filesystem::path> resolve_recording_file(const std::filesystem::path& folder, const std::string& file);

/// The bytes of one file of a recording. Messages begin with the file as the recording names it.
/// @error as resolve_recording_file; @error invalid_file  larger than `most_bytes`, or not a regular file
Result<std::vector<uint8_t>> read_recording_file(const std::filesystem::path& folder, const std::string& file,
                                                 size_t most_bytes);

/// rig.json's text; `name` is how messages call the file. @error as read_recording
Result<Rig> parse_rig(const std::string& name, std::span<const uint8_t> rig_json);

/// The bytes of a file that a recording names.
using ReadFile = std::function<Result<std::vector<uint8_t>>(const std::string& file)>;

/// recording.json's text, with the rig that it names read by `read`; the folder is left empty. @error as read_recording
Result<Recording> parse_recording(std::span<const uint8_t> recording_json, const ReadFile& read);

/// Decodes a camera's PNG or JPEG to grey or RGB; transparency is dropped. An image that is not the size of its
/// camera is refused before its pixels are decoded. @error invalid_file
Result<Image> decode_frame(std::span<const uint8_t> bytes, const Intrinsics& expected);

/// Reads and decodes one frame; it carries its encoded bytes.
/// @error not_found, io; invalid_file  damaged or wrongly sized; the message begins with the file's name
Result<Frame> load_frame(const Recording& recording, const FrameRecord& record);

}  // namespace booth
