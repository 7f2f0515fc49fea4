#include "drivers/v4l2/frame_choice.h"

#include <algorithm>
#include <cstdlib>
#include <limits>
#include <utility>

namespace booth {
namespace {

/// Frames are kept while a trigger that is told late could still want them; each may hold some megabytes.
constexpr size_t most_frames = 16;
constexpr size_t most_settled = 16;
constexpr Timestamp never = std::numeric_limits<Timestamp>::max();

}  // namespace

Timestamp FrameChoice::distance(const StreamedFrame& frame, const Trigger& trigger) const {
  const Timestamp offset = frame.begin_ns - trigger.when;
  if (rule_ == Rule::first_after && offset < 0) return never;
  return std::abs(offset);
}

bool FrameChoice::belongs(const StreamedFrame& frame, const Trigger& trigger) const {
  const Timestamp own = distance(frame, trigger);
  if (own > max_offset_) return false;
  const auto is_nearer = [&](const Trigger& other) { return distance(frame, other) < own - period_; };
  return std::none_of(waiting_.begin(), waiting_.end(), is_nearer) &&
         std::none_of(settled_.begin(), settled_.end(), is_nearer);
}

void FrameChoice::add_trigger(int index, Timestamp when) {
  if (index < 0 || index >= count_) return;
  std::erase_if(waiting_, [&](const Trigger& trigger) { return trigger.index == index; });
  waiting_.push_back({index, when});
}

void FrameChoice::add_frame(StreamedFrame frame) {
  const Timestamp newest = frame.begin_ns;
  frames_.push_back(std::move(frame));
  const Timestamp oldest_wanted = (waiting_.empty() ? newest : waiting_.front().when) - max_offset_;
  while (frames_.size() > most_frames || frames_.front().begin_ns < oldest_wanted) frames_.pop_front();
}

FrameChoice::Answer FrameChoice::settle(std::deque<StreamedFrame>::iterator frame) {
  const Trigger trigger = waiting_.front();
  waiting_.pop_front();
  settled_.push_back(trigger);
  if (settled_.size() > most_settled) settled_.pop_front();
  Answer answer{.index = trigger.index};
  if (frame == frames_.end()) return answer;
  answer.offset_ns = frame->begin_ns - trigger.when;
  if (frame->damage.empty())
    answer.frame = std::move(*frame);
  else
    answer.damage = frame->damage;
  // Later triggers are answered by later frames.
  frames_.erase(frames_.begin(), std::next(frame));
  return answer;
}

std::optional<FrameChoice::Answer> FrameChoice::next() {
  if (waiting_.empty()) return std::nullopt;
  const Trigger& trigger = waiting_.front();
  const auto nearest = [&](bool whole) {
    auto best = frames_.end();
    for (auto frame = frames_.begin(); frame != frames_.end(); ++frame)
      if (frame->damage.empty() == whole && belongs(*frame, trigger) &&
          (best == frames_.end() || distance(*frame, trigger) < distance(*best, trigger)))
        best = frame;
    return best;
  };
  const auto best = nearest(true);
  // A later frame could be nearer until one is there that begins after the trigger, or too late for it.
  const bool decided = std::any_of(frames_.begin(), frames_.end(), [&](const StreamedFrame& frame) {
    return frame.begin_ns > trigger.when + max_offset_ || (frame.damage.empty() && frame.begin_ns >= trigger.when);
  });
  if (!decided) return std::nullopt;
  return settle(best != frames_.end() ? best : nearest(false));
}

std::optional<FrameChoice::Answer> FrameChoice::next_damaged() {
  if (waiting_.empty()) return std::nullopt;
  const auto damaged = std::find_if(frames_.begin(), frames_.end(), [&](const StreamedFrame& frame) {
    return !frame.damage.empty() && belongs(frame, waiting_.front());
  });
  if (damaged == frames_.end()) return std::nullopt;
  return settle(damaged);
}

}  // namespace booth
