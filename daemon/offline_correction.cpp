#include "daemon/offline_correction.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <optional>

#include "pipeline/health/background_registration.h"
#include "pipeline/hull/rig_correction_report.h"
#include "pipeline/image/develop.h"
#include "pipeline/segmentation/segmentation.h"
#include "replay/durable_folder.h"
#include "replay/recording.h"

namespace booth {
namespace {

bool same_calibration(const Rig& a, const Rig& b) {
  return std::equal(a.cameras.begin(), a.cameras.end(), b.cameras.begin(), b.cameras.end(),
                    [](const RigCamera& x, const RigCamera& y) {
                      return x.id == y.id && x.intrinsics.fx == y.intrinsics.fx && x.intrinsics.cx == y.intrinsics.cx &&
                             x.camera_from_world.matrix() == y.camera_from_world.matrix();
                    });
}

/// What one frame shows; a message where it cannot be used.
struct Seen {
  std::optional<Silhouette> silhouette;
  std::optional<BackgroundMotion> motion;
  std::string message;
};

Seen look_at(const Rig& rig, const std::vector<FrameSet>& background, const Frame& raw) {
  Seen seen;
  const auto frame = develop(raw);
  if (!frame) return {{}, {}, frame.error().message};
  std::vector<Frame> empty;
  for (const FrameSet& set : background)
    for (const Frame& one : set.frames) {
      if (one.camera != raw.camera) continue;
      auto developed = develop(one);
      if (!developed) return {{}, {}, developed.error().message};
      empty.push_back(std::move(*developed));
    }
  const auto view = learn_empty_view(empty);
  if (!view) return {{}, {}, view.error().message};
  auto segmentation = segment(*view, *frame, {});
  if (!segmentation) return {{}, {}, segmentation.error().message};
  if (const RigCamera* camera = rig.find(raw.camera)) {
    const auto motion = register_background(view->mean, *frame, segmentation->silhouette.coverage, camera->intrinsics);
    if (motion) seen.motion = *motion;
  }
  seen.silhouette = std::move(segmentation->silhouette);
  return seen;
}

struct Gathered {
  Rig rig;
  std::vector<std::vector<Silhouette>> captures;
  std::vector<std::string> messages;
};

Result<Gathered> gather(const OfflineCorrectionOptions& options, const Work& work) {
  Gathered gathered;
  for (const auto& folder : options.recordings) {
    const auto recording = read_recording(folder);
    if (!recording) return recording.error();
    if (&folder == &options.recordings.front())
      gathered.rig = recording->rig;
    else if (!same_calibration(gathered.rig, recording->rig))
      return Error{ErrorCode::invalid_argument,
                   folder.string() + ": rig.json: another calibration than the first recording's"};
    const Shot* body = recording->find(ShotRole::body);
    const Shot* empty = recording->find(ShotRole::background);
    if (!body || !empty)
      return Error{ErrorCode::not_found, folder.string() + ": holds no " + (body ? "background" : "body") + " shot"};
    const LoadedShot background = load_shot(*recording, *empty, work);
    LoadedShot shown = load_shot(*recording, *body, work);
    for (const LoadedShot* shot : {&background, &std::as_const(shown)})
      gathered.messages.insert(gathered.messages.end(), shot->faults.begin(), shot->faults.end());
    if (work.stopped()) return Work::cancelled();
    for (FrameSet& set : shown.sets) {
      std::sort(set.frames.begin(), set.frames.end(),
                [](const Frame& a, const Frame& b) { return a.camera < b.camera; });
      std::vector<Seen> seen(set.frames.size());
      work.parallel_for(seen.size(), 1, [&](size_t begin, size_t end) {
        for (size_t i = begin; i < end && !work.stopped(); ++i)
          seen[i] = look_at(gathered.rig, background.sets, set.frames[i]);
      });
      if (work.stopped()) return Work::cancelled();
      std::vector<Silhouette> silhouettes;
      for (size_t i = 0; i < seen.size(); ++i) {
        const std::string where = folder.filename().string() + ": camera " + set.frames[i].camera;
        if (!seen[i].message.empty()) gathered.messages.push_back(where + ": " + seen[i].message);
        if (seen[i].silhouette) silhouettes.push_back(std::move(*seen[i].silhouette));
        if (seen[i].motion && seen[i].motion->moved)
          gathered.messages.push_back(where +
                                      ": its background has shifted since it was learned; this camera was "
                                      "touched, unless it was calibrated after that");
      }
      gathered.captures.push_back(std::move(silhouettes));
    }
  }
  return gathered;
}

std::string figures_json(const RigCorrection& correction) {
  using Json = nlohmann::ordered_json;
  Json json;
  json["format"] = "booth-correction";
  json["version"] = 1;
  json["needed"] = correction.needed;
  json["summary"] = describe(correction);
  json["captures"] = correction.captures;
  json["messages"] = correction.messages;
  json["cameras"] = Json::array();
  for (const CameraCorrection& camera : correction.cameras)
    json["cameras"].push_back({{"id", camera.camera},
                               {"moved", camera.moved},
                               {"captures", camera.captures},
                               {"deviation", camera.deviation},
                               {"offset_px", camera.offset_px},
                               {"before_px", camera.before_px},
                               {"after_px", camera.after_px},
                               {"carried_m", camera.carried_m},
                               {"turned_rad", camera.turned_rad},
                               {"center_sigma_m", camera.uncertainty.center_m},
                               {"rotation_sigma_rad", camera.uncertainty.rotation_rad}});
  return json.dump(1) + "\n";
}

}  // namespace

Result<RigCorrection> correct_from_recordings(const OfflineCorrectionOptions& options, const Work& work) {
  if (options.recordings.empty()) return Error{ErrorCode::invalid_argument, "no recording to correct the cameras from"};
  auto gathered = gather(options, work);
  if (!gathered) return gathered.error();
  auto correction = correct_rig(gathered->rig, gathered->captures, {}, work);
  if (!correction) return correction.error();
  correction->messages.insert(correction->messages.end(), gathered->messages.begin(), gathered->messages.end());
  if (const auto valid = check(correction->rig); !valid) return valid.error();

  const auto whole = std::filesystem::absolute(options.out).lexically_normal();
  const auto folder_path = whole.has_filename() ? whole : whole.parent_path();
  auto folder = DurableFolder::begin(folder_path.parent_path(), folder_path.filename().string());
  if (!folder) return folder.error();
  std::vector<std::pair<std::string, std::string>> files{{"report.html", rig_correction_report_html(*correction)},
                                                         {"correction.json", figures_json(*correction)}};
  if (correction->needed) files.emplace_back("rig.json", write_rig_json(correction->rig));
  for (const auto& [name, text] : files)
    if (const auto written = folder->write(name, text); !written) return written.error();
  if (const auto committed = folder->commit(); !committed) return committed.error();
  return correction;
}

}  // namespace booth
