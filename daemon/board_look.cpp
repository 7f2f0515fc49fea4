#include "daemon/board_look.h"

#include <Eigen/Dense>
#include <algorithm>
#include <map>
#include <nlohmann/json.hpp>
#include <numbers>
#include <optional>
#include <system_error>

#include "daemon/board_shots.h"
#include "pipeline/calibration/calibration.h"
#include "pipeline/calibration/coverage.h"
#include "pipeline/image/codec.h"
#include "pipeline/image/develop.h"
#include "replay/durable_folder.h"
#include "replay/recording.h"
#include "replay/recording_file.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr const char* floor_shot = "floor";
constexpr size_t largest_views_bytes = size_t{64} << 20;
constexpr int picture_width = 480;

/// What was found in one shot.
struct SeenShot {
  std::vector<BoardView> views;  ///< without crops; the projector's too
  std::vector<std::string> messages;
};

Json to_json(const SeenShot& seen) {
  Json views = Json::array();
  for (const BoardView& view : seen.views) {
    Json corners = Json::array();
    for (const TargetCorner& corner : view.corners) corners.push_back({corner.id, corner.pixel.x(), corner.pixel.y()});
    views.push_back({{"camera", view.camera},
                     {"corners", corners},
                     {"markers", view.markers},
                     {"blur_px", view.blur_px},
                     {"blurred", view.blurred},
                     {"message", view.message}});
  }
  return {{"views", views}, {"messages", seen.messages}};
}

/// Nothing where the file was not written by to_json for this board: the shot is then looked at again.
std::optional<SeenShot> read_views(const fs::path& file, const CalibrationBoard& board) {
  const int corners = (board.squares_x - 1) * (board.squares_y - 1);
  const auto bytes = read_file(file, largest_views_bytes);
  if (!bytes) return std::nullopt;
  try {
    const Json json = Json::parse(*bytes);
    SeenShot seen{.views = {}, .messages = json.at("messages").get<std::vector<std::string>>()};
    for (const Json& stored : json.at("views")) {
      BoardView view;
      view.camera = stored.at("camera").get<std::string>();
      for (const Json& corner : stored.at("corners"))
        view.corners.push_back(
            {.id = corner.at(0).get<int>(), .pixel = {corner.at(1).get<double>(), corner.at(2).get<double>()}});
      if (std::any_of(view.corners.begin(), view.corners.end(),
                      [&](const TargetCorner& corner) { return corner.id < 0 || corner.id >= corners; }))
        return std::nullopt;
      view.markers = stored.at("markers").get<int>();
      view.blur_px = stored.at("blur_px").get<double>();
      view.blurred = stored.at("blurred").get<bool>();
      view.message = stored.at("message").get<std::string>();
      seen.views.push_back(std::move(view));
    }
    return seen;
  } catch (const Json::exception&) {
    return std::nullopt;
  }
}

Result<SeenShot> look_at(const Recording& recording, const Shot& board, const Work& work) {
  SeenShot seen;
  auto views = find_boards(recording, board, 0, seen.messages, work);
  if (!views) return views.error();
  seen.views = std::move(*views);
  if (recording.rig.projector) {
    auto lit = projector_views(recording, seen.views, 0, seen.messages, work);
    if (!lit) return lit.error();
    std::move(lit->begin(), lit->end(), std::back_inserter(seen.views));
  }
  for (BoardView& view : seen.views) view.crop = {};
  return seen;
}

Result<void> write_text(const fs::path& file, const Json& json) {
  std::error_code code;
  fs::create_directories(file.parent_path(), code);
  if (code) return Error{ErrorCode::io, file.parent_path().string() + ": cannot be made: " + code.message()};
  return write_file_atomically(file, json.dump(1, ' ', false, Json::error_handler_t::replace) + "\n");
}

/// Everything that was seen, and who is there to see.
struct Seen {
  std::vector<CalibrationDevice> devices;  ///< cameras
  std::string projector;                   ///< its id; empty: there is none
  CalibrationBoard board;
  std::vector<BoardView> views;  ///< poses are the shots' numbers
  int latest_pose = 0;
  bool floor = false;
  std::vector<std::string> messages;  ///< of the latest shot
};

void add_devices(const Rig& rig, Seen& seen) {
  for (const CalibrationDevice& device : calibration_devices(rig)) {
    if (device.projector) {
      seen.projector = device.id;
      continue;
    }
    const auto known =
        std::find_if(seen.devices.begin(), seen.devices.end(), [&](const auto& d) { return d.id == device.id; });
    if (known == seen.devices.end()) seen.devices.push_back(device);
  }
}

Result<void> draw_pictures(const BoardSession& session, const Recording& latest, const Seen& seen,
                           const Coverage& coverage, const Work& work) {
  std::error_code code;
  fs::create_directories(session.picture("any").parent_path(), code);
  if (code) return Error{ErrorCode::io, session.folder().string() + ": cannot be written to: " + code.message()};
  const Shot& board = *latest.find(ShotRole::calibration_board);
  std::vector<Result<void>> written(seen.devices.size());
  work.parallel_for(seen.devices.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      const CalibrationDevice& device = seen.devices[i];
      const auto record = std::find_if(board.frames.begin(), board.frames.end(),
                                       [&](const FrameRecord& frame) { return frame.camera == device.id; });
      std::optional<Frame> backdrop;
      if (record != board.frames.end())
        if (auto loaded = load_frame(latest, *record))
          if (auto developed = develop(*loaded)) backdrop = std::move(*developed);
      const Image picture = draw_coverage(device, coverage.cameras[i], seen.views,
                                          backdrop ? backdrop->pixels.get() : nullptr, picture_width);
      written[i] = write_file_atomically(session.picture(device.id), encode_png(picture, 1));
    }
  });
  for (const auto& each : written)
    if (!each) return each;
  return {};
}

Json describe(const BoardSession& session, const Seen& seen, const Coverage& coverage, size_t shots) {
  Json cameras = Json::array();
  bool any = false;
  for (const CameraCoverage& camera : coverage.cameras) {
    const auto view = std::find_if(seen.views.begin(), seen.views.end(), [&](const BoardView& v) {
      return v.camera == camera.camera && v.pose == seen.latest_pose;
    });
    const bool there = view != seen.views.end();
    any |= there && !view->corners.empty();
    cameras.push_back({{"id", camera.camera},
                       {"corners", there ? view->corners.size() : 0},
                       {"markers", there ? view->markers : 0},
                       {"blur_px", there ? view->blur_px : 0},
                       {"blurred", there && view->blurred},
                       {"message", there && !view->message.empty() ? Json(view->message) : Json(nullptr)},
                       {"views", camera.views},
                       {"shared_views", camera.shared_views},
                       {"covered", camera.covered},
                       {"tilt_deg", camera.tilt_rad * 180 / std::numbers::pi},
                       {"enough", camera.enough},
                       {"wants", camera.wants.empty() ? Json(nullptr) : Json(camera.wants)},
                       {"picture", session.picture(camera.camera).string()}});
  }
  Json projector = nullptr;
  if (!seen.projector.empty()) {
    size_t corners = 0;
    int views = 0;
    for (const BoardView& view : seen.views) {
      if (view.camera != seen.projector || view.corners.empty()) continue;
      ++views;
      if (view.pose == seen.latest_pose) corners = view.corners.size();
    }
    projector = {{"id", seen.projector}, {"corners", corners}, {"views", views}};
  }
  std::vector<std::string> warnings;
  if (!any)
    warnings.emplace_back("no camera found the board in this shot: is it the configured board, and in the light?");
  warnings.insert(warnings.end(), seen.messages.begin(), seen.messages.end());
  return {{"shots", shots},
          {"floor", seen.floor},
          {"cameras", cameras},
          {"projector", projector},
          {"enough", coverage.enough},
          {"wants", coverage.wants.empty() ? Json(nullptr) : Json(coverage.wants)},
          {"warnings", warnings}};
}

}  // namespace

Result<void> look_at_boards(const BoardSession& session, const Work& work) {
  const std::vector<std::string> shots = session.shots();
  if (shots.empty()) return Error{ErrorCode::not_found, session.folder().string() + ": holds no shot of the board"};
  Seen seen;
  std::optional<Recording> latest;
  for (const std::string& name : shots) {
    auto recording = read_recording(session.shots_folder() / name);
    if (!recording) return recording.error();
    const Shot* board = recording->find(ShotRole::calibration_board);
    if (board == nullptr || !board->board)
      return Error{ErrorCode::invalid_file, recording->folder.string() + ": shows no board"};
    auto views = read_views(session.views_file(name), *board->board);
    if (!views) {
      auto looked = look_at(*recording, *board, work);
      if (!looked) return looked.error();
      if (const auto written = write_text(session.views_file(name), to_json(*looked)); !written) return written;
      views = std::move(*looked);
    }
    add_devices(recording->rig, seen);
    seen.board = *board->board;
    seen.floor |= board->name == floor_shot;
    ++seen.latest_pose;
    for (BoardView& view : views->views) {
      view.pose = seen.latest_pose;
      seen.views.push_back(std::move(view));
    }
    seen.messages = views->messages;
    latest = std::move(*recording);
    work.report(0.8 * seen.latest_pose / static_cast<double>(shots.size()));
  }
  const Coverage coverage = assess_coverage(seen.devices, seen.board, seen.views);
  if (const auto drawn = draw_pictures(session, *latest, seen, coverage, work); !drawn) return drawn;
  return write_text(session.look_file(), describe(session, seen, coverage, shots.size()));
}

}  // namespace booth
