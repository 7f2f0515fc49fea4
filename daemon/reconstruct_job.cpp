#include "daemon/reconstruct_job.h"

#include <algorithm>
#include <chrono>
#include <ctime>
#include <functional>
#include <future>
#include <optional>
#include <stop_token>

#include "pipeline/export/avatar_files.h"
#include "replay/durable_folder.h"
#include "replay/recording.h"
#include "replay/scan_file.h"

namespace booth {
namespace {

using SteadyClock = std::chrono::steady_clock;

/// Roughly how a job's time falls to its stages, so that the bar moves evenly.
double share_of(std::string_view stage) {
  if (stage == "segmentation") return 0.25;
  if (stage == "hull" || stage == "face") return 0.15;
  if (stage == "refine") return 0.1;
  if (stage == "surface") return 0.15;
  if (stage == "atlas") return 0.20;
  if (stage == "export") return 0.15;
  return 0.05;
}

/// Times the stages, which may overlap, and turns their fractions into the whole job's.
class StageClock {
 public:
  explicit StageClock(const JobProgress& progress) : progress_(progress) {
    for (const std::string& stage : job_stages()) total_ += share_of(stage);
  }

  void tell(std::string_view stage, double fraction) {
    auto told = std::find_if(stages_.begin(), stages_.end(), [&](const Stage& s) { return s.name == stage; });
    if (told == stages_.end()) told = stages_.insert(told, {std::string(stage), SteadyClock::now(), {}, 0});
    told->fraction = std::max(told->fraction, std::clamp(fraction, 0.0, 1.0));
    if (told->fraction >= 1 && !told->seconds) told->seconds = seconds_since(told->began);
    if (!progress_) return;
    double done = 0;
    for (const Stage& s : stages_) done += s.fraction * share_of(s.name);
    progress_(stage, std::min(done / total_, 1.0));
  }

  /// The seconds of each stage that began, in the order of job_stages(); so far, where one is under way.
  std::vector<std::pair<std::string, double>> times() const {
    std::vector<std::pair<std::string, double>> times;
    for (const std::string& name : job_stages())
      for (const Stage& s : stages_)
        if (s.name == name) times.emplace_back(name, s.seconds ? *s.seconds : seconds_since(s.began));
    return times;
  }

 private:
  struct Stage {
    std::string name;
    SteadyClock::time_point began;
    std::optional<double> seconds;  ///< once it has ended
    double fraction;
  };
  static double seconds_since(SteadyClock::time_point then) {
    return std::chrono::duration<double>(SteadyClock::now() - then).count();
  }

  const JobProgress& progress_;
  double total_ = 0;
  std::vector<Stage> stages_;
};

/// Whether there is something at `target` that a new avatar replaces: an earlier avatar, and nothing else.
Result<bool> replaces_earlier(const std::filesystem::path& target) {
  std::error_code ignored;  // what cannot be looked at cannot be written to either, which commit() will say
  if (!std::filesystem::exists(target, ignored) || std::filesystem::is_empty(target, ignored)) return false;
  if (std::filesystem::exists(target / "metadata.json", ignored)) return true;
  return Error{ErrorCode::invalid_state, target.string() + ": there is something else than an avatar"};
}

std::string utc_now() {
  const std::time_t now = std::chrono::system_clock::to_time_t(std::chrono::system_clock::now());
  std::tm utc{};
  gmtime_r(&now, &utc);
  char text[sizeof "2026-11-22T10:15:00Z"];
  std::strftime(text, sizeof text, "%Y-%m-%dT%H:%M:%SZ", &utc);
  return text;
}

void append(std::vector<std::string>* to, const std::vector<std::string>& from) {
  to->insert(to->end(), from.begin(), from.end());
}

/// The empty booth and the subject of a recording, the rest of which may still be missing; what could not be used is
/// said in `warnings`.
Result<CaptureFrames> load_body(const Recording& recording, const EmptyViewStore* kept, const Work& work,
                                std::vector<std::string>* warnings) {
  const Shot* body = recording.find(ShotRole::body);
  if (body == nullptr) return Error{ErrorCode::no_subject, "recording.json: shots has none with the role body"};
  const Shot* background = recording.find(ShotRole::background);
  if (background == nullptr)
    return Error{ErrorCode::no_background, "recording.json: shots has none with the role background"};
  CaptureFrames capture;
  capture.rig = recording.rig;
  {
    const Step step(work, "load: empty booth");
    EmptyBooth learned = learn_background(recording, *background, kept, work);
    append(warnings, learned.faults);
    capture.background = std::move(learned.views);
  }
  LoadedShot loaded = load_shot(recording, *body, work);
  append(warnings, loaded.faults);
  if (loaded.sets.empty()) {
    const std::string reason = loaded.faults.empty() ? "the body shot has no frames" : loaded.faults.front();
    return Error{ErrorCode::too_few_views, "no image of the body shot can be used: " + reason};
  }
  capture.body = std::move(loaded.sets.front());
  return capture;
}

/// As soon as the recording has its body shot.
Result<CaptureFrames> load_body_early(RecordingSource& source, const EmptyViewStore* kept, const Work& work,
                                      std::vector<std::string>* warnings) {
  if (!source.is_complete()) {
    const auto part = source.with(ShotRole::body, work.stop);
    if (!part) return part.error();
    if (!source.is_complete()) {
      std::vector<std::string> faults;
      auto capture = load_body(*part, kept, work, &faults);
      // Otherwise its files moved to their place meanwhile, unless they cannot be used there either.
      if (capture && faults.empty()) return capture;
    }
  }
  const auto recording = source.complete(work.stop);
  if (!recording) return recording.error();
  return load_body(*recording, kept, work, warnings);
}

/// The rest of a recording: waited for, and its face decoded, on a thread of its own beside the body's reconstruction.
class RestOfRecording {
 public:
  struct Rest {
    Recording recording;
    FaceCapture face;
    std::vector<std::string> warnings;
  };

  RestOfRecording(RecordingSource& source, FaceMode face, const std::function<void(const Recording&)>& on_complete,
                  const Work& work)
      : rest_(std::async(std::launch::async,
                         [&source, face, on_complete, mark = work.mark, stop = stop_.get_token()] {
                           return load(source, face, on_complete,
                                       {.stop = stop, .progress = {}, .parallel = {}, .mark = mark});
                         })),
        asked_to_stop_(work.stop, [this] { stop_.request_stop(); }) {}
  ~RestOfRecording() { stop_.request_stop(); }
  RestOfRecording(const RestOfRecording&) = delete;
  RestOfRecording& operator=(const RestOfRecording&) = delete;

  /// Waits for it. @error what RecordingSource::complete returns
  Result<Rest>& get() {
    if (!got_) got_ = rest_.get();
    return *got_;
  }

 private:
  static Result<Rest> load(RecordingSource& source, FaceMode face,
                           const std::function<void(const Recording&)>& on_complete, const Work& work) {
    auto recording = source.complete(work.stop);
    if (!recording) return recording.error();
    if (on_complete) on_complete(*recording);
    Rest rest{*std::move(recording), {}, {}};
    if (!wants_scan(face)) return rest;
    const Step step(work, "load: face");
    const Shot* scan = rest.recording.find(ShotRole::gray_code);
    if (scan != nullptr && scan->pattern) {
      LoadedShot patterns = load_shot(rest.recording, *scan, work);
      append(&rest.warnings, patterns.faults);
      rest.face.patterns = {*scan->pattern, std::move(patterns.sets)};
    }
    auto file = find_scan_file(rest.recording.folder);
    if (!file)
      rest.warnings.push_back(file.error().message);
    else if (*file)
      rest.face.scan = std::move((*file)->mesh);
    return rest;
  }

  std::stop_source stop_;
  std::future<Result<Rest>> rest_;
  std::optional<Result<Rest>> got_;
  std::stop_callback<std::function<void()>> asked_to_stop_;
};

}  // namespace

const std::vector<std::string>& job_stages() {
  static const std::vector<std::string> stages = [] {
    std::vector<std::string> names{"load"};
    append(&names, reconstruction_stages());
    names.emplace_back("export");
    return names;
  }();
  return stages;
}

Result<JobReport> reconstruct_recording(RecordingSource& source, const std::filesystem::path& avatar,
                                        const ReconstructionOptions& options, const JobSources& sources,
                                        const AvatarFileOptions& files, const Work& work, const JobProgress& progress,
                                        const HealthReport& health) {
  // A trailing slash names the same folder.
  const std::filesystem::path target = avatar.has_filename() ? avatar : avatar.parent_path();
  const std::filesystem::path parent = target.has_parent_path() ? target.parent_path() : ".";
  const auto replaces = replaces_earlier(target);
  if (!replaces) return replaces.error();
  auto folder = DurableFolder::begin(parent, target.filename().string());
  if (!folder) return folder.error();

  StageClock clock(progress);
  clock.tell("load", 0);
  JobReport report;
  auto capture = [&] {
    const Step step(work, "load");
    return load_body_early(source, sources.kept, work, &report.warnings);
  }();
  if (work.stopped()) return Work::cancelled();
  if (!capture) return capture.error();
  clock.tell("load", 1);

  RestOfRecording rest(source, options.face, sources.on_complete, work);
  const auto face = [&]() -> Result<FaceCapture> {
    auto& loaded = rest.get();
    if (!loaded) return loaded.error();
    return std::move(loaded->face);
  };
  const auto stage_progress = [&](std::string_view stage, double fraction) { clock.tell(stage, fraction); };
  auto made =
      reconstruct(*std::move(capture), options, {sources.model, sources.detector, face}, work, stage_progress, health);
  if (!made) return made.error();
  const auto& whole = rest.get();
  if (!whole) return whole.error();
  append(&report.warnings, whole->warnings);
  append(&report.warnings, made->warnings);

  AvatarMetadata metadata;
  metadata.id = target.filename().string();
  metadata.created = utc_now();
  metadata.label = whole->recording.label;
  metadata.recording = whole->recording.id;
  metadata.cameras = std::move(made->cameras);
  metadata.face = to_string(made->face);
  metadata.texture_method = to_string(options.atlas.method);
  metadata.warnings = report.warnings;
  metadata.stage_seconds = clock.times();
  clock.tell("export", 0);
  const Step step(work, "export");
  for (const NamedBytes& file : make_avatar_files(made->avatar, std::move(metadata), files, work))
    if (const auto written = folder->write(file.name, file.bytes); !written) return written.error();
  if (work.stopped()) return Work::cancelled();
  if (*replaces)
    if (const auto removed = remove_folder(parent, target.filename().string()); !removed) return removed.error();
  if (const auto committed = folder->commit(); !committed) return committed.error();
  clock.tell("export", 1);
  report.stage_seconds = clock.times();
  return report;
}

}  // namespace booth
