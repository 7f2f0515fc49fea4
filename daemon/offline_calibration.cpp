#include "daemon/offline_calibration.h"

#include <algorithm>
#include <charconv>
#include <nlohmann/json.hpp>
#include <set>

#include "pipeline/calibration/report.h"
#include "pipeline/calibration/world_frame.h"
#include "pipeline/image/develop.h"
#include "pipeline/structured_light/gray_code.h"
#include "replay/durable_folder.h"
#include "replay/recording.h"

namespace booth {
namespace {

bool same_board(const CalibrationBoard& a, const CalibrationBoard& b) {
  return a.type == b.type && a.squares_x == b.squares_x && a.squares_y == b.squares_y && a.square_m == b.square_m &&
         a.marker_m == b.marker_m && a.dictionary == b.dictionary;
}

/// N of "board-N".
std::optional<int> board_index(const std::string& shot) {
  constexpr std::string_view prefix = "board-";
  if (!shot.starts_with(prefix)) return std::nullopt;
  int index = 0;
  const char* end = shot.data() + shot.size();
  const auto [stop, fault] = std::from_chars(shot.data() + prefix.size(), end, index);
  if (fault != std::errc() || stop != end || index < 0) return std::nullopt;
  return index;
}

/// The boards that the cameras see in one shot, poses numbered from `first_pose` by index.
Result<std::vector<BoardView>> find_boards(const Recording& recording, const Shot& shot, int first_pose,
                                           std::vector<std::string>& messages, const Work& work) {
  LoadedShot loaded = load_shot(recording, shot, work);
  messages.insert(messages.end(), loaded.faults.begin(), loaded.faults.end());
  std::vector<const Frame*> frames;
  for (const FrameSet& set : loaded.sets)
    for (const Frame& frame : set.frames) frames.push_back(&frame);
  std::vector<std::optional<Result<BoardView>>> found(frames.size());
  work.parallel_for(frames.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      const auto frame = develop(*frames[i]);
      if (frame)
        found[i] = find_board(frame->camera, first_pose + frame->index, *frame->pixels, *shot.board);
      else
        found[i] = frame.error();
    }
  });
  if (work.stopped()) return Work::cancelled();
  std::vector<BoardView> views;
  for (auto& view : found) {
    if (!*view) return view->error();
    views.push_back(std::move(**view));
  }
  return views;
}

/// Of each Gray-code shot of the board, the projector's view by the camera that decoded most corners.
Result<std::vector<BoardView>> projector_views(const Recording& recording, const std::vector<BoardView>& views,
                                               int first_pose, std::vector<std::string>& messages, const Work& work) {
  std::vector<BoardView> best;
  for (const Shot& shot : recording.shots) {
    const auto index = board_index(shot.name);
    if (shot.role != ShotRole::gray_code || !shot.pattern || !index) continue;
    const LoadedShot loaded = load_shot(recording, shot, work);
    messages.insert(messages.end(), loaded.faults.begin(), loaded.faults.end());
    std::optional<BoardView> most;
    for (const BoardView& view : views) {
      if (view.pose != first_pose + *index || view.corners.empty()) continue;
      std::vector<Frame> frames;
      for (const FrameSet& set : loaded.sets)
        for (const Frame& frame : set.frames)
          if (frame.camera == view.camera) frames.push_back(frame);
      if (frames.empty()) continue;
      const auto decoded = decode_gray_code(frames, *shot.pattern, nullptr, {}, work);
      if (!decoded) {
        messages.push_back(shot.name + ": " + view.camera + ": " + decoded.error().message);
        continue;
      }
      auto lit = projector_view(view, decoded->position, decoded->sigma, recording.rig.projector->id);
      if (!lit) return lit.error();
      if (!most || lit->corners.size() > most->corners.size()) most = std::move(*lit);
    }
    if (most) best.push_back(std::move(*most));
  }
  return best;
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
    const bool first = !input.previous;
    if (first) {
      input.previous = recording->rig;
      input.devices = calibration_devices(recording->rig);
    }
    const auto devices = calibration_devices(recording->rig);
    const bool same =
        devices.size() == input.devices.size() &&
        std::equal(devices.begin(), devices.end(), input.devices.begin(), [](const auto& a, const auto& b) {
          return a.id == b.id && a.width == b.width && a.height == b.height;
        });
    if (!same)
      return Error{ErrorCode::invalid_argument, folder.string() + ": has other cameras than the first recording"};
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
      auto views = find_boards(*recording, shot, next_pose, gathered.messages, work);
      if (!views) return views.error();
      if (recording->rig.projector && first_shot) {
        auto lit = projector_views(*recording, *views, next_pose, gathered.messages, work);
        if (!lit) return lit.error();
        projector_seen |= !lit->empty();
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
    std::erase_if(input.devices, [&](const CalibrationDevice& device) {
      return std::none_of(input.views.begin(), input.views.end(),
                          [&](const BoardView& view) { return view.camera == device.id && !view.corners.empty(); });
    });
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
  if (!kept.empty()) solved.messages.push_back("never saw the board and keep their previous calibration: " + kept);
}

std::string figures_json(const Calibration& calibration) {
  using Json = nlohmann::ordered_json;
  Json json;
  json["format"] = "booth-calibration";
  json["version"] = 1;
  json["verdict"] = to_string(calibration.verdict);
  json["reason"] = calibration.reason;
  json["rms_px"] = calibration.rms_px;
  json["poses"] = calibration.poses;
  json["messages"] = calibration.messages;
  json["devices"] = Json::array();
  for (const DeviceQuality& device : calibration.devices)
    json["devices"].push_back({{"id", device.id},
                               {"solved", device.solved},
                               {"rms_px", device.rms_px},
                               {"views", device.views},
                               {"corners", device.corners},
                               {"outliers", device.outliers},
                               {"center_sigma_m", device.pose.center_m},
                               {"rotation_sigma_rad", device.pose.rotation_rad},
                               {"focal_sigma_px", device.focal_sigma_px},
                               {"principal_point_sigma_px", device.principal_point_sigma_px},
                               {"messages", device.messages}});
  return json.dump(1) + "\n";
}

}  // namespace

Result<Calibration> calibrate_recordings(const OfflineCalibrationOptions& options, const Work& work) {
  if (options.recordings.empty()) return Error{ErrorCode::invalid_argument, "no recording to calibrate from"};
  auto gathered = gather(options, work);
  if (!gathered) return gathered.error();
  auto solved = solve_calibration(gathered->input, options.solver, work);
  if (!solved) return solved.error();
  if (options.keep_unseen) keep_unseen(*gathered->input.previous, *solved);
  solved->messages.insert(solved->messages.end(), gathered->messages.begin(), gathered->messages.end());
  if (const auto valid = check(solved->rig); !valid) return valid.error();

  const auto whole = std::filesystem::absolute(options.out).lexically_normal();
  const auto folder_path = whole.has_filename() ? whole : whole.parent_path();
  auto folder = DurableFolder::begin(folder_path.parent_path(), folder_path.filename().string());
  if (!folder) return folder.error();
  for (const auto& [name, text] : {std::pair{"rig.json", write_rig_json(solved->rig)},
                                   {"report.html", calibration_report_html(*solved, gathered->input)},
                                   {"calibration.json", figures_json(*solved)}})
    if (const auto written = folder->write(name, text); !written) return written.error();
  if (const auto committed = folder->commit(); !committed) return committed.error();
  return solved;
}

}  // namespace booth
