#include "daemon/api/event_codec.h"

#include <nlohmann/json.hpp>
#include <utility>

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
           {"skew_us", e.skew_us}}};
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

std::vector<std::string> topics() {
  return {"state",        "countdown",  "shot",          "capture.done",     "capture.failed",
          "job.progress", "job.failed", "job.cancelled", "avatar.published", "avatar.deleted",
          "camera",       "alert",      "heartbeat"};
}

}  // namespace booth::api
