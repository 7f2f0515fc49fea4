#include "replay/recording.h"

#include <algorithm>
#include <limits>
#include <map>
#include <set>
#include <system_error>
#include <utility>

#include "pipeline/image/codec.h"
#include "replay/durable_folder.h"
#include "replay/json_field.h"
#include "replay/recording_file.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr size_t largest_json_bytes = size_t{16} << 20;
constexpr size_t largest_image_bytes = size_t{256} << 20;
constexpr int format_version = 1;

// Far beyond any booth, near enough that products of what passes stay finite and memory stays small.
constexpr size_t most_cameras = 256;
constexpr size_t most_shots = 1000;
constexpr size_t most_frames = 100000;  // of one shot
constexpr int longest_side_px = 32768;
constexpr double farthest_m = 1000;
constexpr double longest_volume_side_m = 10;
constexpr double largest_focal_px = 1e7;
constexpr double largest_distortion = 1e4;
constexpr Timestamp latest_ns = 4'000'000'000'000'000'000;  // differences of two stay inside 64 bits

void expect_format(const JsonField& root, const std::string& format) {
  const JsonField field = root.member("format");
  if (root.ok() && field.text(longest_text) != format) field.refuse_value("\"" + format + "\"");
  const JsonField version = root.member("version");
  if (root.ok() && version.integer(0, std::numeric_limits<int32_t>::max()) != format_version)
    version.refuse_value("version " + std::to_string(format_version));
}

Eigen::Vector3d read_vector(const JsonField& field, double largest) {
  Eigen::Vector3d vector = Eigen::Vector3d::Zero();
  if (!field.expect_elements(3, "3 numbers")) return vector;
  for (int i = 0; i < 3; ++i) vector[i] = field[static_cast<size_t>(i)].number(-largest, largest);
  return vector;
}

Eigen::Matrix3d read_matrix(const JsonField& field, double largest) {
  Eigen::Matrix3d matrix = Eigen::Matrix3d::Identity();
  if (!field.expect_elements(3, "3 rows of 3 numbers")) return matrix;
  for (size_t row = 0; row < 3; ++row) matrix.row(static_cast<int>(row)) = read_vector(field[row], largest);
  return matrix;
}

int read_int(const JsonField& field, int lowest, int highest) {
  return static_cast<int>(field.integer(lowest, highest));
}

Intrinsics read_intrinsics(const JsonField& view) {
  Intrinsics k;
  k.width = read_int(view.member("width"), 1, longest_side_px);
  k.height = read_int(view.member("height"), 1, longest_side_px);
  const JsonField field = view.member("K");
  const Eigen::Matrix3d matrix = read_matrix(field, largest_focal_px);
  k.fx = matrix(0, 0), k.skew = matrix(0, 1), k.cx = matrix(0, 2);
  k.fy = matrix(1, 1), k.cy = matrix(1, 2);
  if (k.fx <= 0 || k.fy <= 0) field.refuse("expected positive focal lengths K[0][0] and K[1][1]");
  if (matrix(1, 0) != 0 || matrix.row(2) != Eigen::RowVector3d(0, 0, 1))
    field.refuse("expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]");
  const JsonField distortion = view.member("distortion");
  if (!distortion.expect_elements(k.distortion.size(), "the 5 numbers k1, k2, p1, p2, k3")) return k;
  for (size_t i = 0; i < k.distortion.size(); ++i)
    k.distortion[i] = distortion[i].number(-largest_distortion, largest_distortion);
  return k;
}

void read_calibration(const JsonField& field, CalibratedView& view) {
  view.intrinsics = read_intrinsics(field);
  const JsonField rotation = field.member("R");
  const Eigen::Matrix3d r = read_matrix(rotation, 2);
  constexpr double tolerance = 1e-4;  // as check(Rig): files carry rounded decimals
  if (!(r * r.transpose()).isApprox(Eigen::Matrix3d::Identity(), tolerance) || r.determinant() < 0)
    rotation.refuse("is not a rotation");
  view.camera_from_world.linear() = r;
  view.camera_from_world.translation() = read_vector(field.member("t"), farthest_m);
}

RigCamera read_camera(const JsonField& field, CameraRole role) {
  RigCamera camera;
  camera.role = role;
  read_calibration(field, camera);
  if (const auto turn = field.find("mount_rotation_deg")) {
    camera.mount_rotation_deg = read_int(*turn, 0, 270);
    if (camera.mount_rotation_deg % 90 != 0) turn->refuse_value("0, 90, 180 or 270");
  }
  if (const auto gain = field.find("colour_gain"); gain && gain->expect_elements(3, "3 numbers: red, green, blue"))
    for (size_t c = 0; c < 3; ++c)
      camera.colour_gain[static_cast<Eigen::Index>(c)] =
          static_cast<float>((*gain)[c].number(least_colour_gain, most_colour_gain));
  constexpr double largest_rms_px = 1e6;
  if (const auto rms = field.find("rms_px")) camera.rms_px = rms->number(0, largest_rms_px);
  constexpr double largest_uncertainty = 1e6;
  if (const auto uncertainty = field.find("uncertainty"))
    camera.uncertainty =
        PoseUncertainty{.center_m = uncertainty->member("center_m").number(0, largest_uncertainty),
                        .rotation_rad = uncertainty->member("rotation_rad").number(0, largest_uncertainty)};
  return camera;
}

Eigen::AlignedBox3d read_volume(const JsonField& field) {
  const Eigen::AlignedBox3d volume(read_vector(field.member("min"), farthest_m),
                                   read_vector(field.member("max"), farthest_m));
  const Eigen::Vector3d sides = volume.max() - volume.min();
  if ((sides.array() <= 0).any()) field.refuse("expected min below max in every axis");
  if ((sides.array() > longest_volume_side_m).any()) field.refuse("expected sides of at most 10 m");
  return volume;
}

std::optional<CameraRole> camera_role_from(const std::string& name) {
  if (name == "body") return CameraRole::body;
  if (name == "face") return CameraRole::face;
  return std::nullopt;
}

/// A rig, and the cameras in its file whose role this version does not know.
struct RigFile {
  Rig rig;
  std::set<std::string> unknown_cameras;
};

RigFile read_rig_fields(const JsonField& root) {
  RigFile file;
  expect_format(root, "booth-rig");
  if (!root.ok()) return file;
  if (const auto name = root.find("name")) file.rig.name = name->text(longest_text);
  file.rig.volume = read_volume(root.member("volume"));
  const JsonField cameras = root.member("cameras");
  const size_t count = cameras.size(most_cameras);
  std::set<std::string> ids;
  for (size_t i = 0; i < count && root.ok(); ++i) {
    const JsonField id = cameras[i].member("id");
    const std::string name = id.id();
    if (!ids.insert(name).second) id.refuse_value("an id that no other camera has");
    const auto role_field = cameras[i].find("role");
    const auto role = role_field ? camera_role_from(role_field->text(longest_text)) : CameraRole::body;
    if (!role) {
      file.unknown_cameras.insert(name);
      continue;
    }
    file.rig.cameras.push_back(read_camera(cameras[i], *role));
    file.rig.cameras.back().id = name;
  }
  if (file.rig.cameras.empty()) cameras.refuse("holds no camera of a known role");
  if (const auto projector = root.find("projector")) {
    file.rig.projector.emplace();
    const auto id = projector->find("id");
    file.rig.projector->id = id ? id->id() : "projector";
    read_calibration(*projector, *file.rig.projector);
  }
  return file;
}

Result<RigFile> read_rig_text(const std::string& name, std::span<const uint8_t> text) {
  auto document = JsonDocument::parse(name, text);
  if (!document) return document.error();
  RigFile file = read_rig_fields(JsonField(*document));
  if (!document->ok()) return document->error();
  if (const auto checked = check(file.rig); !checked)
    return Error{ErrorCode::invalid_file, name + ": " + checked.error().message};
  return file;
}

GrayCodePattern read_pattern(const JsonField& field) {
  GrayCodePattern pattern;
  pattern.width = read_int(field.member("width"), 1, longest_side_px);
  pattern.height = read_int(field.member("height"), 1, longest_side_px);
  if (const auto columns = field.find("columns")) pattern.columns = columns->boolean();
  if (const auto rows = field.find("rows")) pattern.rows = rows->boolean();
  if (const auto inverse = field.find("inverse")) pattern.inverse = inverse->boolean();
  return pattern;
}

CalibrationBoard read_board(const JsonField& field) {
  constexpr int most_squares = 1000;
  constexpr double largest_square_m = 10;
  constexpr double smallest_square_m = 1e-4;
  CalibrationBoard board;
  if (const auto type = field.find("type")) board.type = type->text(longest_text);
  board.squares_x = read_int(field.member("squares_x"), 2, most_squares);
  board.squares_y = read_int(field.member("squares_y"), 2, most_squares);
  board.square_m = field.member("square_m").number(smallest_square_m, largest_square_m);
  if (const auto marker = field.find("marker_m")) board.marker_m = marker->number(0, board.square_m);
  if (const auto dictionary = field.find("dictionary")) board.dictionary = dictionary->text(longest_text);
  return board;
}

Mosaic read_mosaic(const JsonField& field) {
  Mosaic mosaic;
  const JsonField pattern = field.member("pattern");
  const std::string name = pattern.text(longest_text);
  const auto found = std::find_if(bayer_patterns.begin(), bayer_patterns.end(),
                                  [&](const auto& known) { return known.second == name; });
  if (found == bayer_patterns.end())
    pattern.refuse_value("\"rggb\", \"grbg\", \"gbrg\" or \"bggr\"");
  else
    mosaic.pattern = found->first;
  if (const auto linear = field.find("linear")) mosaic.linear = linear->boolean();
  return mosaic;
}

FrameRecord read_frame(const JsonField& field, int last_index) {
  constexpr double longest_exposure_us = 1e9;
  constexpr double largest_gain_db = 1000;
  FrameRecord frame;
  frame.camera = field.member("camera").id();
  frame.file = field.member("file").relative_path();
  if (const auto index = field.find("index")) frame.index = read_int(*index, 0, last_index);
  if (const auto time = field.find("timestamp_ns")) frame.timestamp_ns = time->integer(0, latest_ns);
  if (const auto id = field.find("frame_id")) frame.frame_id = id->unsigned_integer();
  if (const auto exposure = field.find("exposure_us")) frame.exposure_us = exposure->number(0, longest_exposure_us);
  if (const auto gain = field.find("gain_db")) frame.gain_db = gain->number(-largest_gain_db, largest_gain_db);
  if (const auto mosaic = field.find("mosaic")) frame.mosaic = read_mosaic(*mosaic);
  return frame;
}

Shot read_shot(const JsonField& field, ShotRole role, const RigFile& rig) {
  Shot shot;
  shot.role = role;
  if (role == ShotRole::gray_code) shot.pattern = read_pattern(field.member("pattern"));
  if (role == ShotRole::calibration_board) shot.board = read_board(field.member("board"));
  const int last_index = shot.pattern ? pattern_count(*shot.pattern) - 1 : highest_index;
  const JsonField frames = field.member("frames");
  const size_t count = frames.size(most_frames);
  std::set<std::pair<std::string, int>> taken;
  for (size_t i = 0; i < count && field.ok(); ++i) {
    FrameRecord frame = read_frame(frames[i], last_index);
    if (!field.ok() || rig.unknown_cameras.contains(frame.camera)) continue;
    if (rig.rig.find(frame.camera) == nullptr) frames[i].member("camera").refuse_value("a camera of the rig");
    if (!taken.emplace(frame.camera, frame.index).second)
      frames[i].refuse("is the second frame of " + frame.camera + " with index " + std::to_string(frame.index));
    shot.frames.push_back(std::move(frame));
  }
  return shot;
}

void read_header(const JsonField& root, Recording& recording) {
  recording.id = root.member("id").id();
  const JsonField created = root.member("created");
  recording.created = created.text(longest_text);
  if (root.ok() && !is_date_and_time(recording.created))
    created.refuse_value("a date and time such as \"2026-11-22T10:15:00Z\"");
  if (const auto label = root.find("label")) recording.label = label->free_text(longest_text);
  if (const auto face = root.find("face")) recording.face = face->text(longest_text);
}

std::vector<Shot> read_shots(const JsonField& shots, const RigFile& rig) {
  std::vector<Shot> read;
  std::set<std::string> names;
  const size_t count = shots.size(most_shots);
  for (size_t i = 0; i < count && shots.ok(); ++i) {
    const auto role = shot_role_from(shots[i].member("role").text(longest_text));
    if (!role) continue;
    const JsonField name = shots[i].member("name");
    const std::string id = name.id();
    if (!names.insert(id).second) name.refuse_value("a name that no other shot has");
    read.push_back(read_shot(shots[i], *role, rig));
    read.back().name = id;
  }
  return read;
}

}  // namespace

bool is_date_and_time(const std::string& text) {
  const std::string form = "dddd-dd-ddTdd:dd:dd";
  const auto is_digit = [](char c) { return c >= '0' && c <= '9'; };
  const auto matches = [&](size_t at, const std::string& part) {
    if (text.size() < at + part.size()) return false;
    for (size_t i = 0; i < part.size(); ++i)
      if (part[i] == 'd' ? !is_digit(text[at + i]) : text[at + i] != part[i]) return false;
    return true;
  };
  if (!matches(0, form)) return false;
  size_t at = form.size();
  if (matches(at, ".d"))
    for (++at; at < text.size() && is_digit(text[at]);) ++at;
  if (text.substr(at) == "Z") return true;
  return text.size() == at + 6 && (matches(at, "+dd:dd") || matches(at, "-dd:dd"));
}

const Shot* Recording::find(ShotRole role) const {
  const auto found = std::find_if(shots.begin(), shots.end(), [&](const Shot& shot) { return shot.role == role; });
  return found == shots.end() ? nullptr : &*found;
}

Result<fs::path> resolve_recording_file(const fs::path& folder, const std::string& file) {
  if (!is_safe_relative_path(file)) return Error{ErrorCode::invalid_file, file + ": leads out of the recording"};
  std::error_code code;
  const fs::path root = fs::canonical(folder, code);
  const fs::path path = code ? fs::path() : fs::canonical(root / file, code);
  if (code == std::errc::no_such_file_or_directory || code == std::errc::not_a_directory)
    return Error{ErrorCode::not_found, file + ": is not there"};
  if (code) return Error{ErrorCode::io, file + ": " + code.message()};
  const auto [root_end, unused] = std::mismatch(root.begin(), root.end(), path.begin(), path.end());
  if (root_end != root.end()) return Error{ErrorCode::invalid_file, file + ": leads out of the recording"};
  return path;
}

Result<std::vector<uint8_t>> read_recording_file(const fs::path& folder, const std::string& file, size_t most_bytes) {
  const auto path = resolve_recording_file(folder, file);
  if (!path) return path.error();
  auto bytes = read_file(*path, most_bytes);
  if (!bytes) return Error{bytes.error().code, file + bytes.error().message.substr(path->string().size())};
  return bytes;
}

Result<Image> decode_frame(std::span<const uint8_t> bytes, const Intrinsics& expected) {
  const auto header = read_image_header(bytes);
  if (!header) return header.error();
  if (header->width != expected.width || header->height != expected.height)
    return Error{ErrorCode::invalid_file, "has " + std::to_string(header->width) + " × " +
                                              std::to_string(header->height) + " pixels, the rig says " +
                                              std::to_string(expected.width) + " × " + std::to_string(expected.height)};
  auto image = decode_image(bytes);
  if (!image || image->channels != 4) return image;
  Image opaque(image->width, image->height, 3);
  const size_t pixels = image->samples.size() / 4;
  for (size_t i = 0; i < pixels; ++i)
    std::copy_n(image->samples.begin() + static_cast<ptrdiff_t>(4 * i), 3,
                opaque.samples.begin() + static_cast<ptrdiff_t>(3 * i));
  return opaque;
}

Result<Rig> parse_rig(const std::string& name, std::span<const uint8_t> rig_json) {
  auto rig = read_rig_text(name, rig_json);
  if (!rig) return rig.error();
  return std::move(rig->rig);
}

Result<Rig> read_rig(const fs::path& file) {
  const auto text = read_file(file, largest_json_bytes);
  if (!text) return text.error();
  return parse_rig(file.filename().string(), *text);
}

Result<Recording> parse_recording(std::span<const uint8_t> recording_json, const ReadFile& read) {
  const std::string name = "recording.json";
  auto document = JsonDocument::parse(name, recording_json);
  if (!document) return document.error();
  const JsonField root(*document);

  Recording recording;
  expect_format(root, "booth-recording");
  read_header(root, recording);
  const std::string rig_file = root.member("rig").relative_path();
  if (!document->ok()) return document->error();

  const auto rig_text = read(rig_file);
  if (!rig_text) return Error{ErrorCode::invalid_file, name + ": rig: " + rig_text.error().message};
  auto rig = read_rig_text(rig_file, *rig_text);
  if (!rig) return rig.error();
  recording.shots = read_shots(root.member("shots"), *rig);
  if (!document->ok()) return document->error();
  recording.rig = std::move(rig->rig);
  return recording;
}

Result<Recording> read_recording(const fs::path& folder) {
  std::error_code code;
  if (!fs::is_directory(folder, code)) return Error{ErrorCode::not_found, folder.string() + ": is not a folder"};
  const std::string name = "recording.json";
  const auto read = [&](const std::string& file) { return read_recording_file(folder, file, largest_json_bytes); };
  const auto text = read(name);
  if (!text && text.error().code == ErrorCode::not_found)
    return Error{ErrorCode::not_found, folder.string() + ": is not a recording: it holds no " + name};
  if (!text) return text.error();
  auto recording = parse_recording(*text, read);
  if (recording) recording->folder = folder;
  return recording;
}

Result<Frame> load_frame(const Recording& recording, const FrameRecord& record) {
  const RigCamera* camera = recording.rig.find(record.camera);
  if (camera == nullptr)
    return Error{ErrorCode::invalid_file, record.file + ": the rig has no camera " + record.camera};
  auto bytes = read_recording_file(recording.folder, record.file, largest_image_bytes);
  if (!bytes) return bytes.error();
  auto image = decode_frame(*bytes, camera->intrinsics);
  if (!image) return Error{image.error().code, record.file + ": " + image.error().message};
  if (record.mosaic && image->channels != 1)
    return Error{ErrorCode::invalid_file, record.file + ": is said to be a mosaic, but is not grey"};
  return Frame{.camera = record.camera,
               .index = record.index,
               .timestamp_ns = record.timestamp_ns,
               .frame_id = record.frame_id,
               .exposure_us = record.exposure_us,
               .gain_db = record.gain_db,
               .pixels = std::make_shared<const Image>(*std::move(image)),
               .encoded = std::make_shared<const std::vector<uint8_t>>(*std::move(bytes)),
               .mosaic = record.mosaic};
}

LoadedShot load_shot(const Recording& recording, const Shot& shot, const Work& work) {
  std::vector<std::optional<Result<Frame>>> frames(shot.frames.size());
  work.parallel_for(frames.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      frames[i] = load_frame(recording, shot.frames[i]);
      if (frames[i]->ok()) frames[i]->value().encoded = nullptr;  // reconstruction has no use for it
    }
  });

  LoadedShot loaded;
  std::map<int, FrameSet> sets;
  for (auto& frame : frames) {
    if (!frame) continue;  // the work was stopped
    if (frame->ok()) {
      const int index = frame->value().index;
      sets[index].index = index;
      sets[index].frames.push_back(std::move(*frame).value());
    } else {
      loaded.faults.push_back(frame->error().message);
    }
  }
  for (auto& [index, set] : sets) loaded.sets.push_back(std::move(set));
  return loaded;
}

}  // namespace booth
