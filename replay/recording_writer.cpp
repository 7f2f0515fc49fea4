#include "replay/recording_writer.h"

#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <mutex>
#include <set>
#include <system_error>
#include <tuple>
#include <utility>

#include "pipeline/image/codec.h"
#include "replay/durable_folder.h"
#include "replay/recording_file.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

Error invalid(const std::string& what) { return {ErrorCode::invalid_argument, what}; }

constexpr size_t largest_image_bytes = size_t{512} << 20;

/// frames/SHOT/CAMERA.png, or with the index where the shot holds a sequence.
std::string image_file(const ShotHeader& shot, const std::string& camera, int index, ImageFormat format) {
  std::string file = "frames/" + shot.name + "/" + camera;
  if (shot.role != ShotRole::body) {
    char number[16];
    std::snprintf(number, sizeof number, "-%03d", index);
    file += number;
  }
  return file + (format == ImageFormat::jpeg ? ".jpg" : ".png");
}

/// Links a file of another recording into a folder, or copies it where that cannot be.
Result<void> take_over(const Recording& from, const std::string& source, DurableFolder& folder,
                       const std::string& target) {
  const auto path = resolve_recording_file(from.folder, source);
  if (!path) return Error{ErrorCode::invalid_file, from.id + ": " + path.error().message};
  std::error_code code;
  fs::create_directories((folder.path() / target).parent_path(), code);
  if (!code && ::link(path->c_str(), (folder.path() / target).c_str()) == 0) return {};
  const auto bytes = read_recording_file(from.folder, source, largest_image_bytes);
  if (!bytes) return Error{ErrorCode::invalid_file, from.id + ": " + bytes.error().message};
  return folder.write(target, *bytes);
}

int last_index(const ShotHeader& shot) {
  if (shot.role == ShotRole::body) return 0;
  return shot.pattern ? pattern_count(*shot.pattern) - 1 : highest_index;
}

std::string name_of(const std::string& shot, const std::string& camera, int index) {
  return "frame " + std::to_string(index) + " of " + camera + " in shot " + shot;
}

}  // namespace

struct RecordingWriter::Content {
  struct OpenShot {
    ShotHeader header;
    std::vector<FrameRecord> frames;
    std::set<std::pair<std::string, int>> taken;  ///< camera and index
  };

  Content(DurableFolder folder_, RecordingHeader header_, Rig rig_, SpoolOptions options_)
      : folder(std::move(folder_)), header(std::move(header_)), rig(std::move(rig_)), options(options_) {}

  /// Registers a frame before it is stored, so that of two equal ones the second is refused.
  Result<ShotHeader> reserve(const std::string& shot, const std::string& camera, int index) {
    const std::lock_guard lock(mutex);
    const auto found =
        std::find_if(shots.begin(), shots.end(), [&](const OpenShot& s) { return s.header.name == shot; });
    if (found == shots.end()) return invalid("shot " + shot + " was not begun");
    if (index < 0 || index > last_index(found->header))
      return invalid(name_of(shot, camera, index) + ": the index is out of range");
    if (!found->taken.emplace(camera, index).second) return invalid(name_of(shot, camera, index) + " came twice");
    return found->header;
  }
  void record(const std::string& shot, FrameRecord frame) {
    const std::lock_guard lock(mutex);
    for (OpenShot& open : shots)
      if (open.header.name == shot) open.frames.push_back(std::move(frame));
  }

  /// Writes recording.json about the shots there are.
  Result<void> describe() {
    Recording recording;
    recording.id = header.id;
    recording.created = header.created;
    recording.label = header.label;
    recording.face = header.face;
    for (const OpenShot& open : shots) {
      // Frames came in any order; the file names them in one.
      std::vector<FrameRecord> frames = open.frames;
      std::sort(frames.begin(), frames.end(), [](const FrameRecord& a, const FrameRecord& b) {
        return std::tie(a.index, a.camera) < std::tie(b.index, b.camera);
      });
      recording.shots.push_back(
          {open.header.name, open.header.role, open.header.pattern, open.header.board, std::move(frames)});
    }
    return folder.replace("recording.json", write_recording_json(recording));
  }

  DurableFolder folder;
  const RecordingHeader header;
  const Rig rig;
  const SpoolOptions options;
  std::mutex mutex;
  std::vector<OpenShot> shots;  ///< guarded by mutex
};

RecordingWriter::RecordingWriter(std::unique_ptr<Content> content) : content_(std::move(content)) {}
RecordingWriter::~RecordingWriter() = default;

Result<std::unique_ptr<RecordingWriter>> RecordingWriter::begin(const fs::path& parent, const RecordingHeader& header,
                                                                const Rig& rig, const SpoolOptions& options) {
  if (const auto checked = check(rig); !checked) return invalid("the rig cannot be stored: " + checked.error().message);
  if (!is_date_and_time(header.created)) return invalid("\"" + header.created + "\" is not a date and time");
  if (header.label.size() > longest_text) return invalid("the label is longer than " + std::to_string(longest_text));
  if (!header.face.empty() && !is_safe_id(header.face)) return invalid("\"" + header.face + "\" is no face mode");
  auto folder = DurableFolder::begin(parent, header.id);
  if (!folder) return folder.error();
  if (const auto written = folder->write("rig.json", write_rig_json(rig)); !written) return written.error();
  return std::unique_ptr<RecordingWriter>(
      new RecordingWriter(std::make_unique<Content>(*std::move(folder), header, rig, options)));
}

Result<void> RecordingWriter::begin_shot(const ShotHeader& shot) {
  if (!is_safe_id(shot.name)) return invalid("\"" + shot.name + "\" is not a plain name for a shot");
  if (shot.role == ShotRole::gray_code && !shot.pattern) return invalid("shot " + shot.name + " needs its pattern");
  const std::lock_guard lock(content_->mutex);
  for (const Content::OpenShot& open : content_->shots)
    if (open.header.name == shot.name) return invalid("shot " + shot.name + " was begun already");
  content_->shots.push_back({shot, {}, {}});
  return {};
}

Result<void> RecordingWriter::add(const std::string& shot, const Frame& frame) {
  const std::string name = name_of(shot, frame.camera, frame.index);
  const RigCamera* camera = content_->rig.find(frame.camera);
  if (camera == nullptr) return invalid(name + ": the rig has no such camera");
  if (!frame.pixels) return invalid(name + " has no pixels");
  if (frame.pixels->width != camera->intrinsics.width || frame.pixels->height != camera->intrinsics.height)
    return invalid(name + " has " + std::to_string(frame.pixels->width) + " × " + std::to_string(frame.pixels->height) +
                   " pixels, the rig says " + std::to_string(camera->intrinsics.width) + " × " +
                   std::to_string(camera->intrinsics.height));
  if (frame.mosaic && frame.pixels->channels != 1) return invalid(name + " is a mosaic of more than one channel");
  const auto header = content_->reserve(shot, frame.camera, frame.index);
  if (!header) return header.error();

  std::vector<uint8_t> encoded;
  // JPEG would smear the colours of a mosaic into one another.
  const bool lossy = content_->options.format == SpoolOptions::Format::jpeg && !frame.mosaic;
  ImageFormat format = lossy ? ImageFormat::jpeg : ImageFormat::png;
  std::span<const uint8_t> bytes;
  if (frame.encoded && content_->options.keep_encoded) {
    const auto image = read_image_header(*frame.encoded);
    if (!image) return invalid(name + ": its encoded bytes " + image.error().message);
    format = image->format;
    bytes = *frame.encoded;
  } else {
    encoded = lossy ? encode_jpeg(*frame.pixels, content_->options.jpeg_quality)
                    : encode_png(*frame.pixels, content_->options.png_level);
    bytes = encoded;
  }
  FrameRecord record{.camera = frame.camera,
                     .index = frame.index,
                     .file = image_file(*header, frame.camera, frame.index, format),
                     .timestamp_ns = frame.timestamp_ns,
                     .frame_id = frame.frame_id,
                     .exposure_us = frame.exposure_us,
                     .gain_db = frame.gain_db,
                     .mosaic = frame.mosaic};
  if (const auto written = content_->folder.write(record.file, bytes); !written) return written;
  content_->record(shot, std::move(record));
  return {};
}

Result<void> RecordingWriter::add_shot(const Recording& from, const Shot& shot) {
  const ShotHeader header{.name = shot.name, .role = shot.role, .pattern = shot.pattern, .board = shot.board};
  if (const auto begun = begin_shot(header); !begun) return begun;
  for (const FrameRecord& frame : shot.frames) {
    if (content_->rig.find(frame.camera) == nullptr)
      return invalid(name_of(shot.name, frame.camera, frame.index) + ": the rig has no such camera");
    if (const auto reserved = content_->reserve(shot.name, frame.camera, frame.index); !reserved)
      return reserved.error();
    FrameRecord record = frame;
    record.file = image_file(header, frame.camera, frame.index,
                             fs::path(frame.file).extension() == ".png" ? ImageFormat::png : ImageFormat::jpeg);
    if (const auto taken = take_over(from, frame.file, content_->folder, record.file); !taken) return taken;
    content_->record(shot.name, std::move(record));
  }
  return {};
}

Result<fs::path> RecordingWriter::show_so_far() {
  if (const auto written = content_->describe(); !written) return written.error();
  return content_->folder.path();
}

Result<void> RecordingWriter::commit() {
  if (const auto written = content_->describe(); !written) return written;
  const auto readable = read_recording(content_->folder.path());
  if (!readable) return Error{ErrorCode::internal, "the recording cannot be read again: " + readable.error().message};
  return content_->folder.commit();
}

const fs::path& RecordingWriter::final_path() const { return content_->folder.final_path(); }

}  // namespace booth
