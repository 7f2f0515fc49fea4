#include "daemon/api/event_codec.h"

#include <nlohmann/json.hpp>
#include <utility>
#include <variant>

#include "daemon/api/errors.h"
#include "daemon/api/json_values.h"
#include "daemon/identifier.h"

namespace booth::api {
namespace {

using Json = nlohmann::json;
using Topic = std::pair<const char*, Json>;

Topic topic_of(const StateChanged& e) {
  return {"state",
          {{"state", to_string(e.state)},
           {"previous", to_string(e.previous)},
           {"ready", e.ready},
           {"not_ready", to_json(e.not_ready)}}};
}
Topic topic_of(const CountdownTick& e) {
  return {"countdown", {{"capture", e.capture}, {"remaining_s", e.remaining_s}}};
}
Topic topic_of(const ShotTaken& e) {
  return {"shot",
          {{"capture", e.capture},
           {"role", to_string(e.role)},
           {"index", e.index},
           {"of", e.of},
           {"cameras", e.cameras},
           {"missing", e.missing},
           {"skew_us", e.skew_us},
           {"retries", e.retries},
           {"offsets_us", e.offsets_us},
           {"decided_ms", e.decided_ms}}};
}
Topic topic_of(const CaptureDone& e) { return {"capture.done", {{"capture", e.capture}, {"job", e.job}}}; }
Topic topic_of(const CaptureFailed& e) {
  return {"capture.failed", {{"capture", e.capture}, {"kind", event_kind(e.error.code)}, {"message", e.error.message}}};
}
Topic topic_of(const JobProgressed& e) {
  return {"job.progress", {{"job", e.job}, {"capture", e.capture}, {"stage", e.stage}, {"fraction", e.fraction}}};
}
Topic topic_of(const JobFailed& e) {
  return {"job.failed", {{"job", e.job}, {"capture", e.capture}, {"error", to_json(e.error)}}};
}
Topic topic_of(const JobCancelled& e) {
  return {"job.cancelled",
          {{"job", e.job}, {"capture", e.capture}, {"error", to_json(Reason{"cancelled", "the job was cancelled"})}}};
}
Topic topic_of(const AvatarPublished& e) {
  return {"avatar.published",
          {{"avatar", e.avatar},
           {"job", e.job},
           {"capture", e.capture},
           {"label", text_or_null(e.label)},
           {"files", e.files}}};
}
Topic topic_of(const AvatarDeleted& e) { return {"avatar.deleted", {{"avatar", e.avatar}}}; }
Topic topic_of(const CameraChanged& e) {
  return {"camera", {{"camera", e.camera}, {"state", to_string(e.state)}, {"message", text_or_null(e.message)}}};
}
Json result_json(const std::monostate&) { return nullptr; }
Json result_json(const CamerasDiscovered& found) {
  Json cameras = Json::array();
  for (const auto& [camera, configured] : found.cameras)
    cameras.push_back({{"id", camera.id},
                       {"driver", camera.driver},
                       {"configured", configured},
                       {"model", text_or_null(camera.model)},
                       {"serial", text_or_null(camera.serial)},
                       {"address", text_or_null(camera.address)}});
  return {{"cameras", cameras}, {"faults", found.faults}};
}
Json result_json(const BackgroundLearned& learned) {
  return {{"created", learned.created},
          {"frames", learned.frames},
          {"missing", learned.missing},
          {"warnings", learned.warnings}};
}
Json result_json(const TriggerTested& tested) {
  return {{"offsets_us", tested.offsets_us},
          {"missing", tested.missing},
          {"skew_us", tested.skew_us},
          {"warnings", tested.warnings}};
}
Json result_json(const ProjectorCalibrated& calibrated) {
  return {{"delay_us", calibrated.delay_us},
          {"measured_us", calibrated.measured_us},
          {"contrast", calibrated.contrast},
          {"camera", calibrated.camera}};
}
Json result_json(const CalibrationReport& report) { return Json::parse(report.json); }
Topic topic_of(const TaskChanged& e) {
  return {"task",
          {{"task", e.task},
           {"kind", to_string(e.kind)},
           {"state", to_string(e.state)},
           {"fraction", e.fraction},
           {"result", std::visit([](const auto& result) { return result_json(result); }, e.result)},
           {"error", e.error ? to_json(Reason{event_kind(e.error->code), e.error->message}) : Json(nullptr)}}};
}
Topic topic_of(const Alert& e) {
  return {"alert", {{"severity", to_string(e.severity)}, {"kind", e.kind}, {"message", e.message}}};
}
Topic topic_of(const Heartbeat& e) { return {"heartbeat", {{"state", to_string(e.state)}, {"ready", e.ready}}}; }

}  // namespace

EncodedEvent encode(const NumberedEvent& event, const std::string& boot) {
  auto [topic, fields] = std::visit([](const auto& e) { return topic_of(e); }, event.event);
  fields["boot"] = boot;
  fields["sequence"] = event.sequence;
  fields["time"] = iso8601(event.time, true);
  return {topic, to_text(fields)};
}

std::string preview_topic(const std::string& camera) { return "preview." + camera; }

EncodedEvent encode(const PreviewPicture& picture, const std::string& boot) {
  return {preview_topic(picture.camera), to_text({{"boot", boot},
                                                  {"sequence", picture.sequence},
                                                  {"time", iso8601(picture.time, true)},
                                                  {"camera", picture.camera},
                                                  {"timestamp_ns", picture.timestamp_ns},
                                                  {"width", picture.width},
                                                  {"height", picture.height}})};
}

std::vector<std::string> topics() {
  return {"state",          "countdown",    "shot",       "task",          "capture.done",
          "capture.failed", "job.progress", "job.failed", "job.cancelled", "avatar.published",
          "avatar.deleted", "camera",       "alert",      "heartbeat"};
}

}  // namespace booth::api
