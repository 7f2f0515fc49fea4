#include "daemon/board_shots.h"

#include <algorithm>
#include <charconv>
#include <iterator>
#include <string_view>

#include "pipeline/image/develop.h"
#include "pipeline/structured_light/gray_code.h"

namespace booth {
namespace {

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

}  // namespace

Result<std::vector<BoardView>> find_boards(const Recording& recording, const Shot& shot, int first_pose,
                                           std::vector<std::string>& messages, const Work& work,
                                           std::vector<WhiteSample>* whites) {
  LoadedShot loaded = load_shot(recording, shot, work);
  messages.insert(messages.end(), loaded.faults.begin(), loaded.faults.end());
  std::vector<const Frame*> frames;
  for (const FrameSet& set : loaded.sets)
    for (const Frame& frame : set.frames) frames.push_back(&frame);
  std::vector<std::optional<Result<BoardView>>> found(frames.size());
  std::vector<std::vector<WhiteSample>> white(frames.size());
  work.parallel_for(frames.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      const auto frame = develop(*frames[i]);
      if (!frame) {
        found[i] = frame.error();
        continue;
      }
      found[i] = find_board(frame->camera, first_pose + frame->index, *frame->pixels, *shot.board);
      if (whites != nullptr && found[i]->ok()) white[i] = sample_whites(**found[i], *frame->pixels, *shot.board);
    }
  });
  if (work.stopped()) return Work::cancelled();
  std::vector<BoardView> views;
  for (auto& view : found) {
    if (!*view) return view->error();
    views.push_back(std::move(**view));
  }
  if (whites != nullptr)
    for (const auto& samples : white) whites->insert(whites->end(), samples.begin(), samples.end());
  return views;
}

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
      const auto decoded = decode_gray_code(frames, *shot.pattern, nullptr, nullptr, {}, work);
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

}  // namespace booth
