#include "daemon/api/dispatcher.h"

#include <algorithm>
#include <exception>
#include <utility>

#include "daemon/api/event_codec.h"
#include "daemon/api/json_values.h"
#include "daemon/api/requests.h"
#include "daemon/identifier.h"
#include "daemon/reconstruct_job.h"

namespace booth::api {
namespace {

using Json = nlohmann::json;

constexpr int api_version = 1;

Json to_json(const Job& job) {
  return {{"id", job.id},
          {"capture", job.id},
          {"state", to_string(job.state)},
          {"stage", text_or_null(job.stage)},
          {"fraction", job.fraction},
          {"error", job.error ? api::to_json(*job.error) : Json(nullptr)},
          {"avatar", job.state == JobState::done ? Json(job.id) : Json(nullptr)}};
}

Json to_json(const std::vector<Job>& jobs) {
  Json list = Json::array();
  for (const Job& job : jobs) list.push_back(to_json(job));
  return list;
}

/// Of a device that is offline: whether waiting may help, or only a changed setting.
Json fault_of(DeviceState state, bool permanent) {
  if (state != DeviceState::offline) return nullptr;
  return permanent ? "permanent" : "temporary";
}

Json to_json(const CameraStatus& camera) {
  return {{"id", camera.id},
          {"driver", camera.driver},
          {"role", camera.role == CameraRole::face ? "face" : "body"},
          {"state", to_string(camera.state)},
          {"last_frame_age_s", camera.last_frame_age_s ? Json(*camera.last_frame_age_s) : Json(nullptr)},
          {"frames", camera.frames},
          {"dropped", camera.dropped},
          {"message", text_or_null(camera.message)},
          {"warnings", camera.warnings},
          {"fault", fault_of(camera.state, camera.permanent)}};
}

/// @param name  what the interface calls the device's name: the projector's `id`, the trigger's `driver`
Json to_json(const std::optional<DeviceStatus>& device, const char* name) {
  if (!device) return nullptr;
  return {{name, device->name},
          {"state", to_string(device->state)},
          {"message", text_or_null(device->message)},
          {"fault", fault_of(device->state, device->permanent)}};
}

Answer task_answer(const Result<std::string>& task) {
  if (!task) return task.error();
  return Reply{{{"task", *task}}};
}

Json to_json(const std::optional<CalibrationSessionStatus>& session) {
  if (!session) return nullptr;
  return {{"shots", session->shots}, {"enough", session->enough}, {"verdict", text_or_null(session->verdict)}};
}

Json to_json(const std::vector<Task>& tasks) {
  Json list = Json::array();
  for (const Task& task : tasks)
    list.push_back({{"task", task.id}, {"kind", to_string(task.kind)}, {"fraction", task.fraction}});
  return list;
}

}  // namespace

template <class Request>
bool Dispatcher::refused(const Result<Request>& request, const Responder& respond) {
  if (!request) respond(request.error());
  return !request;
}

void Dispatcher::on_disk(const Responder& respond, std::function<Answer()> work) {
  const bool taken = booth_.disk().post([respond, work = std::move(work)] {
    try {
      respond(work());
    } catch (const std::exception& fault) {
      respond(Error{ErrorCode::internal, "the booth's program has a fault: " + std::string(fault.what())});
    }
  });
  if (!taken) respond(Error{ErrorCode::busy, "too many requests wait for the disk; try again in a moment"});
}

std::optional<Reply> Dispatcher::dispatch(Method method, const Json& params, const Responder& respond) {
  const auto no_params = [&](auto&& answer) -> Answer {
    if (const auto request = parse_no_params(params); !request) return request.error();
    return answer();
  };
  switch (method) {
    case Method::system_describe: respond(no_params([&] { return describe(); })); break;
    case Method::system_status: respond(no_params([&] { return status(); })); break;
    case Method::system_metrics: respond(no_params([&] { return metrics(); })); break;
    case Method::system_history: respond(history(params)); break;
    case Method::system_shutdown: respond(no_params([&] { return shut_down_(), Answer(Reply{}); })); break;
    case Method::camera_discover: respond(no_params([&] { return task_answer(booth_.discover_cameras()); })); break;
    case Method::preview_start: respond(start_preview(params)); break;
    case Method::preview_stop: respond(stop_preview(params)); break;
    case Method::background_learn: respond(learn_background(params)); break;
    case Method::trigger_test: respond(no_params([&] { return task_answer(booth_.test_trigger()); })); break;
    case Method::projector_calibrate:
      respond(no_params([&] { return task_answer(booth_.calibrate_projector()); }));
      break;
    case Method::calibration_capture:
    case Method::calibration_solve:
    case Method::calibration_apply:
    case Method::calibration_discard:
    case Method::calibration_restore:
    case Method::calibration_status: calibrate(method, params, respond); break;
    case Method::capture_start: return start_capture(params, respond);
    case Method::capture_cancel:
      if (const auto request = parse_id(params, "capture"); !refused(request, respond)) {
        const auto cancelled = booth_.cancel_capture(request->id);
        respond(cancelled ? Answer(Reply{}) : cancelled.error());
      }
      break;
    case Method::job_list: respond(list_jobs(params)); break;
    case Method::avatar_list: respond(list_avatars(params)); break;
    case Method::avatar_get: get_avatar(params, respond); break;
    case Method::avatar_fetch: fetch_avatar(params, respond); break;
    case Method::job_retry:
    case Method::job_cancel: return change_job(method, params, respond);
    case Method::capture_delete:
    case Method::avatar_delete: return remove(method, params, respond);
  }
  return std::nullopt;
}

Answer Dispatcher::describe() const {
  Json names = Json::array();
  for (const MethodEntry& entry : methods) names.push_back(entry.name);
  std::vector<std::string> every_topic = topics();
  for (const CameraStatus& camera : booth_.status().cameras) every_topic.push_back(preview_topic(camera.id));
  return Reply{{{"name", booth_.name()},
                {"version", BOOTH_VERSION},
                {"api", api_version},
                {"methods", names},
                {"topics", every_topic},
                {"stages", job_stages()}}};
}

Answer Dispatcher::status() const {
  const BoothStatus status = booth_.status();
  Json cameras = Json::array();
  for (const CameraStatus& camera : status.cameras) cameras.push_back(to_json(camera));
  return Reply{{{"state", to_string(status.state)},
                {"state_since", iso8601(status.state_since, true)},
                {"boot", status.boot},
                {"sequence", status.sequence},
                {"ready", status.not_ready.empty()},
                {"not_ready", api::to_json(status.not_ready)},
                {"capture", status.capture ? Json(*status.capture) : Json(nullptr)},
                {"tasks", to_json(status.tasks)},
                {"cameras", cameras},
                {"projector", to_json(status.projector, "id")},
                {"trigger", to_json(status.trigger, "driver")},
                {"calibration",
                 {{"loaded", status.calibration.loaded},
                  {"rms_px", status.calibration.rms_px ? Json(*status.calibration.rms_px) : Json(nullptr)},
                  {"created", text_or_null(status.calibration.created)},
                  {"moved", status.calibration.moved},
                  {"session", to_json(status.calibration.session)}}},
                {"background",
                 {{"learned", status.background.learned},
                  {"created", text_or_null(status.background.created)},
                  {"stale", text_or_null(status.background.stale.value_or(""))}}},
                {"queue", to_json(status.queue)},
                {"disk",
                 {{"free_bytes", status.disk.free_bytes},
                  {"limit_bytes", status.disk.limit_bytes},
                  {"used_bytes", status.disk.used_bytes},
                  {"quota_bytes", status.disk.quota_bytes},
                  {"capture_bytes", status.disk.capture_bytes}}},
                {"uptime_s", status.uptime_s}}};
}

Answer Dispatcher::metrics() const { return Reply{booth_.measurements()}; }

Answer Dispatcher::history(const Json& params) const {
  const auto request = parse_system_history(params);
  if (!request) return request.error();
  const auto since = std::chrono::system_clock::now() - std::chrono::hours(request->hours);
  Json samples = Json::array();
  for (const HealthSample& sample : booth_.history().samples(since, request->limit))
    samples.push_back(booth::to_json(sample));
  return Reply{{{"samples", samples}}};
}

std::optional<Reply> Dispatcher::start_capture(const Json& params, const Responder& respond) {
  const auto request = parse_capture_start(params);
  if (refused(request, respond)) return std::nullopt;
  const auto answer = [](const std::string& id) { return Reply{{{"capture", id}}}; };
  const auto started = booth_.start_capture(*request, [respond, answer](const Result<std::string>& id) {
    respond(id ? Answer(answer(*id)) : Answer(id.error()));
  });
  if (refused(started, respond)) return std::nullopt;
  return answer(*started);
}

Answer Dispatcher::start_preview(const Json& params) {
  const auto request = parse_preview_start(params);
  if (!request) return request.error();
  const auto started = booth_.start_preview(request->camera, request->settings);
  if (!started) return started.error();
  return Reply{};
}

Answer Dispatcher::stop_preview(const Json& params) {
  const auto request = parse_id(params, "camera");
  if (!request) return request.error();
  const auto stopped = booth_.stop_preview(request->id);
  if (!stopped) return stopped.error();
  return Reply{};
}

Answer Dispatcher::learn_background(const Json& params) {
  const auto request = parse_background_learn(params);
  if (!request) return request.error();
  return task_answer(booth_.learn_background(request->frames));
}

void Dispatcher::calibrate(Method method, const Json& params, const Responder& respond) {
  CalibrationDesk& desk = booth_.calibration();
  // Of a request that has been read: what it does waits for the disk.
  const auto change = [&](const auto& request, const auto& work) {
    if (refused(request, respond)) return;
    on_disk(respond, [work, asked = *request]() -> Answer {
      if (const auto done = work(asked); !done) return done.error();
      return Reply{};
    });
  };
  switch (method) {
    case Method::calibration_capture:
      if (const auto request = parse_calibration_capture(params); !refused(request, respond))
        respond(task_answer(booth_.capture_board(*request)));
      break;
    case Method::calibration_solve:
      if (const auto request = parse_calibration_solve(params); !refused(request, respond))
        respond(task_answer(desk.solve(request->keep_unseen)));
      break;
    case Method::calibration_apply:
      change(parse_calibration_apply(params),
             [&desk](const CalibrationApply& asked) { return desk.apply(asked.force); });
      break;
    case Method::calibration_discard:
      change(parse_calibration_discard(params),
             [&desk](const CalibrationDiscard& asked) { return desk.discard(asked.shots); });
      break;
    case Method::calibration_restore:
      change(parse_calibration_restore(params),
             [&desk](const CalibrationRestore& asked) { return desk.restore(asked.name); });
      break;
    default:
      if (const auto request = parse_no_params(params); !refused(request, respond))
        on_disk(respond, [&desk]() -> Answer { return Reply{Json::parse(desk.report())}; });
      break;
  }
}

Answer Dispatcher::list_jobs(const Json& params) {
  const auto request = parse_job_list(params);
  if (!request) return request.error();
  if (!request->job) return Reply{{{"jobs", to_json(booth_.jobs().list())}}};
  const auto job = booth_.jobs().find(*request->job);
  if (!job) return Error{ErrorCode::not_found, "there is no job " + *request->job};
  return Reply{{{"jobs", to_json(std::vector<Job>{*job})}}};
}

std::optional<Reply> Dispatcher::change_job(Method method, const Json& params, const Responder& respond) {
  const auto request = parse_id(params, "job");
  if (refused(request, respond)) return std::nullopt;
  JobQueue& jobs = booth_.jobs();
  const auto changed = method == Method::job_retry ? jobs.retry(request->id) : jobs.cancel(request->id);
  if (refused(changed, respond)) return std::nullopt;
  on_disk(respond, [&jobs, id = request->id]() -> Answer {
    if (const auto written = jobs.persist(id); !written) return written.error();
    return Reply{};
  });
  return Reply{};
}

std::optional<Reply> Dispatcher::remove(Method method, const Json& params, const Responder& respond) {
  const bool avatar = method == Method::avatar_delete;
  const auto request = parse_id(params, avatar ? "avatar" : "capture");
  if (refused(request, respond)) return std::nullopt;
  const auto done = [respond](const Result<void>& deleted) {
    respond(deleted ? Answer(Reply{}) : Answer(deleted.error()));
  };
  const auto begun = avatar ? booth_.delete_avatar(request->id, done) : booth_.delete_capture(request->id, done);
  if (refused(begun, respond)) return std::nullopt;
  return Reply{};
}

Answer Dispatcher::list_avatars(const Json& params) {
  const auto request = parse_avatar_list(params);
  if (!request) return request.error();
  const auto found = booth_.avatars().list(request->limit, request->before);
  if (!found) return found.error();
  Json list = Json::array();
  for (const AvatarSummary& avatar : *found) {
    const std::string& capture = avatar.capture.empty() ? avatar.id : avatar.capture;
    list.push_back({{"id", avatar.id},
                    {"created", text_or_null(avatar.created)},
                    {"label", text_or_null(avatar.label)},
                    {"capture", text_or_null(avatar.capture)},
                    {"job", booth_.jobs().find(capture) ? Json(capture) : Json(nullptr)},
                    {"files", avatar.files},
                    {"triangles", avatar.triangles ? Json(*avatar.triangles) : Json(nullptr)},
                    {"warnings", avatar.warnings}});
  }
  return Reply{{{"avatars", list}}};
}

void Dispatcher::get_avatar(const Json& params, const Responder& respond) {
  const auto request = parse_id(params, "avatar");
  if (refused(request, respond)) return;
  on_disk(respond, [&avatars = booth_.avatars(), id = request->id]() -> Answer {
    const auto text = avatars.metadata(id);
    if (!text) return text.error();
    return Reply{Json::parse(*text)};
  });
}

void Dispatcher::fetch_avatar(const Json& params, const Responder& respond) {
  const auto request = parse_avatar_fetch(params);
  if (refused(request, respond)) return;
  on_disk(respond, [&avatars = booth_.avatars(), fetch = *request]() -> Answer {
    auto piece = avatars.fetch(fetch.avatar, fetch.file, fetch.offset, fetch.length);
    if (!piece) return piece.error();
    return Reply{{{"size", piece->size}, {"sha256", piece->sha256}}, std::move(piece->bytes)};
  });
}

}  // namespace booth::api
