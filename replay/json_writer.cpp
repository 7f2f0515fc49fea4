#include <nlohmann/json.hpp>

#include "replay/recording.h"
#include "replay/recording_writer.h"

namespace booth {
namespace {

using Json = nlohmann::ordered_json;

constexpr int format_version = 1;
constexpr int indent = 1;

Json vector_json(const Eigen::Vector3d& v) { return Json::array({v.x(), v.y(), v.z()}); }

Json matrix_json(const Eigen::Matrix3d& m) {
  return Json::array({vector_json(m.row(0)), vector_json(m.row(1)), vector_json(m.row(2))});
}

/// The members that cameras and the projector share.
void add_calibration(Json& json, const CalibratedView& view) {
  const Intrinsics& k = view.intrinsics;
  Eigen::Matrix3d matrix;
  matrix << k.fx, k.skew, k.cx, 0, k.fy, k.cy, 0, 0, 1;
  json["K"] = matrix_json(matrix);
  json["distortion"] = k.distortion;
  json["R"] = matrix_json(view.camera_from_world.linear());
  json["t"] = vector_json(view.camera_from_world.translation());
}

Json camera_json(const RigCamera& camera) {
  Json json;
  json["id"] = camera.id;
  json["role"] = camera.role == CameraRole::face ? "face" : "body";
  json["width"] = camera.intrinsics.width;
  json["height"] = camera.intrinsics.height;
  json["mount_rotation_deg"] = camera.mount_rotation_deg;
  add_calibration(json, camera);
  if ((camera.colour_gain != 1).any()) json["colour_gain"] = vector_json(camera.colour_gain.matrix().cast<double>());
  if (camera.rms_px) json["rms_px"] = *camera.rms_px;
  if (camera.uncertainty)
    json["uncertainty"] = {{"center_m", camera.uncertainty->center_m},
                           {"rotation_rad", camera.uncertainty->rotation_rad}};
  return json;
}

Json projector_json(const CalibratedView& projector) {
  Json json;
  json["id"] = projector.id;
  json["width"] = projector.intrinsics.width;
  json["height"] = projector.intrinsics.height;
  add_calibration(json, projector);
  return json;
}

Json frame_json(const FrameRecord& frame) {
  Json json = {{"camera", frame.camera},     {"index", frame.index},
               {"file", frame.file},         {"timestamp_ns", frame.timestamp_ns},
               {"frame_id", frame.frame_id}, {"exposure_us", frame.exposure_us},
               {"gain_db", frame.gain_db}};
  if (frame.mosaic)
    json["mosaic"] = {{"pattern", bayer_patterns.at(static_cast<size_t>(frame.mosaic->pattern)).second},
                      {"linear", frame.mosaic->linear}};
  return json;
}

Json pattern_json(const GrayCodePattern& pattern) {
  return {{"width", pattern.width},
          {"height", pattern.height},
          {"columns", pattern.columns},
          {"rows", pattern.rows},
          {"inverse", pattern.inverse}};
}

Json board_json(const CalibrationBoard& board) {
  return {{"type", board.type},         {"squares_x", board.squares_x}, {"squares_y", board.squares_y},
          {"square_m", board.square_m}, {"marker_m", board.marker_m},   {"dictionary", board.dictionary}};
}

Json shot_json(const Shot& shot) {
  Json json;
  json["name"] = shot.name;
  json["role"] = to_string(shot.role);
  if (shot.pattern) json["pattern"] = pattern_json(*shot.pattern);
  if (shot.board) json["board"] = board_json(*shot.board);
  json["frames"] = Json::array();
  for (const FrameRecord& frame : shot.frames) json["frames"].push_back(frame_json(frame));
  return json;
}

/// Text that is not UTF-8 is written with replacement characters instead of being refused.
std::string text_of(const Json& json) { return json.dump(indent, ' ', false, Json::error_handler_t::replace) + "\n"; }

}  // namespace

std::string write_rig_json(const Rig& rig) {
  Json json;
  json["format"] = "booth-rig";
  json["version"] = format_version;
  json["name"] = rig.name;
  json["volume"] = {{"min", vector_json(rig.volume.min())}, {"max", vector_json(rig.volume.max())}};
  json["cameras"] = Json::array();
  for (const RigCamera& camera : rig.cameras) json["cameras"].push_back(camera_json(camera));
  if (rig.projector) json["projector"] = projector_json(*rig.projector);
  return text_of(json);
}

std::string write_recording_json(const Recording& recording) {
  Json json;
  json["format"] = "booth-recording";
  json["version"] = format_version;
  json["id"] = recording.id;
  json["created"] = recording.created;
  if (!recording.label.empty()) json["label"] = recording.label;
  if (!recording.face.empty()) json["face"] = recording.face;
  json["rig"] = "rig.json";
  json["shots"] = Json::array();
  for (const Shot& shot : recording.shots) json["shots"].push_back(shot_json(shot));
  return text_of(json);
}

}  // namespace booth
