#include "daemon/offline_calibration.h"

#include <algorithm>
#include <nlohmann/json.hpp>

#include "daemon/board_shots.h"
#include "pipeline/calibration/coverage.h"
#include "pipeline/calibration/report.h"
#include "pipeline/calibration/world_frame.h"
#include "replay/durable_folder.h"
#include "replay/recording.h"

namespace booth {
namespace {

bool same_board(const CalibrationBoard& a, const CalibrationBoard& b) {
  return a.type == b.type && a.squares_x == b.squares_x && a.squares_y == b.squares_y && a.square_m == b.square_m &&
         a.marker_m == b.marker_m && a.dictionary == b.dictionary;
}

/// Those that the recording's rig has; cameras that come and go between recordings are of one rig all the same where
/// `more` may be added.
Result<void> add_devices(const Recording& recording, bool more, std::vector<CalibrationDevice>& devices) {
  const auto own = calibration_devices(recording.rig);
  const Error differs{ErrorCode::invalid_argument,
                      recording.folder.string() + ": has other cameras than the first recording"};
  if (!more && own.size() != devices.size()) return differs;
  for (const CalibrationDevice& device : own) {
    const auto known = std::find_if(devices.begin(), devices.end(), [&](const auto& d) { return d.id == device.id; });
    if (known == devices.end() && !more) return differs;
    if (known == devices.end())
      devices.push_back(device);
    else if (known->width != device.width || known->height != device.height)
      return Error{ErrorCode::invalid_argument,
                   recording.folder.string() + ": the pictures of " + device.id + " have another size than before"};
  }
  return {};
}

/// Whether the device has a calibration that can go on without the board, which it did not see: blurred pictures are
/// no such thing.
bool may_stay_unseen(const CalibrationDevice& device, const CalibrationInput& input) {
  if (std::any_of(input.views.begin(), input.views.end(), [&](const BoardView& view) {
        return view.camera == device.id && (!view.corners.empty() || view.blurred);
      }))
    return false;
  if (!input.previous) return false;
  const CalibratedView* before = input.previous->find(device.id);
  if (device.projector && input.previous->projector) before = &*input.previous->projector;
  return before != nullptr && before->intrinsics.width == device.width && before->intrinsics.height == device.height;
}

struct Gathered {
  CalibrationInput input;
  std::vector<std::string> messages;
};

Result<Gathered> gather(const OfflineCalibrationOptions& options, const Work& work) {
  Gathered gathered;
  CalibrationInput& input = gathered.input;
  bool projector_seen = false;
  int next_pose = 0;
  for (const auto& folder : options.recordings) {
    const auto recording = read_recording(folder);
    if (!recording) return recording.error();
    const bool first = &folder == &options.recordings.front();
    if (first) input.previous = options.nominal ? options.previous : recording->rig;
    if (const auto added = add_devices(*recording, first || options.nominal, input.devices); !added)
      return added.error();
    bool first_shot = true;
    for (const Shot& shot : recording->shots) {
      if (shot.role != ShotRole::calibration_board) continue;
      if (!shot.board)
        return Error{ErrorCode::invalid_file,
                     folder.string() + ": recording.json: shot " + shot.name + " has no board"};
      if (next_pose == 0)
        input.board = *shot.board;
      else if (!same_board(input.board, *shot.board))
        return Error{ErrorCode::invalid_argument, folder.string() + ": shot " + shot.name + " shows another board"};
      auto views = find_boards(*recording, shot, next_pose, gathered.messages, work, &input.whites);
      if (!views) return views.error();
      if (recording->rig.projector && first_shot) {
        auto lit = projector_views(*recording, *views, next_pose, gathered.messages, work);
        if (!lit) return lit.error();
        projector_seen |= std::any_of(lit->begin(), lit->end(), [](const auto& view) { return !view.corners.empty(); });
        std::move(lit->begin(), lit->end(), std::back_inserter(input.views));
      }
      if (shot.name == "floor") input.floor_pose = next_pose;
      if (first && first_shot && options.floor_index) input.floor_pose = next_pose + *options.floor_index;
      first_shot = false;
      for (const FrameRecord& frame : shot.frames) next_pose = std::max(next_pose, frame.index + 1);
      for (const BoardView& view : *views) next_pose = std::max(next_pose, view.pose + 1);
      std::move(views->begin(), views->end(), std::back_inserter(input.views));
    }
  }
  if (next_pose == 0)
    return Error{ErrorCode::not_found, options.recordings.front().string() + ": holds no shot of a calibration board"};
  // Without patterns on the board nothing is known of the projector: it is not asked for.
  if (!projector_seen) std::erase_if(input.devices, [](const auto& device) { return device.projector; });
  if (options.keep_unseen)
    for (auto device = input.devices.begin(); device != input.devices.end();) {
      if (!may_stay_unseen(*device, input)) {
        ++device;
        continue;
      }
      std::erase_if(input.views, [&](const BoardView& view) { return view.camera == device->id; });
      device = input.devices.erase(device);
    }
  return gathered;
}

/// Adds what the solution lacks from the rig before it, moved along with the cameras that both have.
void keep_unseen(const Rig& previous, Calibration& solved) {
  const auto alignment = align_rigs(previous, solved.rig);
  const Eigen::Isometry3d old_from_new =
      alignment ? alignment->target_from_source.inverse() : Eigen::Isometry3d::Identity();
  std::string kept;
  for (RigCamera camera : previous.cameras) {
    if (solved.rig.find(camera.id)) continue;
    camera.camera_from_world = camera.camera_from_world * old_from_new;
    kept += (kept.empty() ? "" : ", ") + camera.id;
    solved.rig.cameras.push_back(std::move(camera));
  }
  if (!solved.rig.projector && previous.projector) {
    solved.rig.projector = previous.projector;
    solved.rig.projector->camera_from_world = previous.projector->camera_from_world * old_from_new;
    kept += (kept.empty() ? "" : ", ") + previous.projector->id;
  }
  if (kept.empty()) return;
  solved.messages.push_back("never saw the board and keep their previous calibration: " + kept);
  // Nobody looked whether they still stand where they stood.
  if (solved.verdict != CalibrationVerdict::good) return;
  solved.verdict = CalibrationVerdict::usable;
  solved.reason = solved.messages.back();
}

std::string figures_json(const Calibration& calibration, const CalibrationInput& input) {
  using Json = nlohmann::ordered_json;
  const Coverage coverage = assess_coverage(input.devices, input.board, input.views);
  Json json;
  json["format"] = "booth-calibration";
  json["version"] = 1;
  json["verdict"] = to_string(calibration.verdict);
  json["reason"] = calibration.reason;
  json["rms_px"] = calibration.rms_px;
  json["poses"] = calibration.poses;
  json["messages"] = calibration.messages;
  json["devices"] = Json::array();
  for (size_t i = 0; i < calibration.devices.size(); ++i) {
    const DeviceQuality& device = calibration.devices[i];
    const CameraCoverage& seen = coverage.cameras[i];
    json["devices"].push_back({{"id", device.id},
                               {"projector", input.devices[i].projector},
                               {"solved", device.solved},
                               {"rms_px", device.rms_px},
                               {"views", device.views},
                               {"corners", device.corners},
                               {"outliers", device.outliers},
                               {"center_sigma_m", device.pose.center_m},
                               {"rotation_sigma_rad", device.pose.rotation_rad},
                               {"focal_sigma_px", device.focal_sigma_px},
                               {"principal_point_sigma_px", device.principal_point_sigma_px},
                               {"covered", seen.covered},
                               {"shared_views", seen.shared_views},
                               {"enough", seen.enough},
                               {"wants", seen.wants.empty() ? Json(nullptr) : Json(seen.wants)},
                               {"messages", device.messages}});
  }
  json["colours"] = {
      {"before", calibration.colours.before}, {"after", calibration.colours.after}, {"cameras", Json::array()}};
  for (const CameraColour& camera : calibration.colours.cameras)
    json["colours"]["cameras"].push_back({{"id", camera.id},
                                          {"gain", {camera.gain[0], camera.gain[1], camera.gain[2]}},
                                          {"matched", camera.matched},
                                          {"samples", camera.samples},
                                          {"clipped", camera.clipped},
                                          {"before", camera.before},
                                          {"after", camera.after}});
  return json.dump(1) + "\n";
}

}  // namespace

Result<Calibration> calibrate_recordings(const OfflineCalibrationOptions& options, const Work& work) {
  if (options.recordings.empty()) return Error{ErrorCode::invalid_argument, "no recording to calibrate from"};
  auto gathered = gather(options, work);
  if (!gathered) return gathered.error();
  auto solved = solve_calibration(gathered->input, options.solver, work);
  if (!solved) return solved.error();
  if (options.keep_unseen && gathered->input.previous) keep_unseen(*gathered->input.previous, *solved);
  solved->messages.insert(solved->messages.end(), gathered->messages.begin(), gathered->messages.end());
  if (const auto valid = check(solved->rig); !valid) return valid.error();

  const auto whole = std::filesystem::absolute(options.out).lexically_normal();
  const auto folder_path = whole.has_filename() ? whole : whole.parent_path();
  auto folder = DurableFolder::begin(folder_path.parent_path(), folder_path.filename().string());
  if (!folder) return folder.error();
  for (const auto& [name, text] : {std::pair{"rig.json", write_rig_json(solved->rig)},
                                   {"report.html", calibration_report_html(*solved, gathered->input)},
                                   {"calibration.json", figures_json(*solved, gathered->input)}})
    if (const auto written = folder->write(name, text); !written) return written.error();
  if (const auto committed = folder->commit(); !committed) return committed.error();
  return solved;
}

}  // namespace booth
