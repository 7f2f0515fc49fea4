// How the capture session takes a shot of the calibration board.

#include <utility>

#include "daemon/calibration_desk.h"
#include "daemon/capture_session.h"

namespace booth {
namespace {

constexpr Timestamp arm_patience = seconds(3);

}  // namespace

Result<std::string> CaptureSession::capture_board(const BoardRequest& request) {
  if (request.patterns && !projector_)
    return Error{ErrorCode::unsupported, "this booth has no projector: take the shot without patterns"};
  if (const auto free = parts_.calibration.check_free(); !free) return free.error();
  return begin_task(TaskKind::calibration_capture, request, BoothState::calibrating);
}

/// One trigger for all cameras, and no second one for those that missed it: the next shot has a place of the board of
/// its own, and the operator hears who is missing.
Result<TaskResult> CaptureSession::work(const std::string& task, const BoardRequest& request,
                                        const std::stop_token& cancelled) {
  if (const auto room = parts_.check_disk(1, request.patterns); !room) return room.error();
  BoardPictures pictures;
  pictures.floor = request.floor;
  CollectedShot shot;
  {
    FrameCollector collector = arm(parts_.cameras.ids(), ShotRole::calibration_board, 1);
    collector.wait_armed(parts_.clock.now() + arm_patience, cancelled);
    auto taken = fire_and_collect(collector, ShotRole::calibration_board, cancelled);
    if (!taken) return taken.error();
    shot = std::move(*taken);
  }
  parts_.events.publish(ShotTaken{.capture = task,
                                  .role = ShotRole::calibration_board,
                                  .index = 0,
                                  .of = 1,
                                  .cameras = static_cast<int>(shot.set.frames.size()),
                                  .missing = shot.missing,
                                  .skew_us = shot.skew_us,
                                  .offsets_us = shot.offsets_us});
  if (shot.set.frames.empty()) {
    std::string names;
    for (const std::string& camera : shot.missing) names += (names.empty() ? "" : ", ") + camera;
    return Error{ErrorCode::device_lost, "no camera delivered a picture: " + names};
  }
  pictures.frames = std::move(shot.set.frames);
  constexpr double after_shot = 0.2, after_patterns = 0.6;
  parts_.tasks.progress(task, after_shot);

  if (request.patterns) {
    // Where face cameras are, the projector is theirs; the others would only fill the disk.
    auto cameras = parts_.cameras.ids(CameraRole::face);
    if (cameras.empty()) cameras = parts_.cameras.ids();
    auto taken = take_patterns(task, cameras, cancelled);
    if (!taken) return taken.error();
    pictures.patterns = std::move(*taken);
    const auto projector = projector_->get();
    if (!projector) return projector.error();
    pictures.pattern = (*projector)->info().pattern;
    parts_.tasks.progress(task, after_patterns);
  }
  auto looked = parts_.calibration.add(pictures, parts_.devices(), parts_.projector.value_or(""), shot.missing,
                                       cancelled, [this] { pulse_.beat(); });
  if (!looked) return looked.error();
  return TaskResult(CalibrationReport{std::move(*looked)});
}

}  // namespace booth
