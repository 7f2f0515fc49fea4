#include "drivers/aravis/frame_matcher.h"

#include <algorithm>

namespace booth {
namespace {

/// How many frames after `from` the frame `to` was numbered.
int64_t steps_between(uint64_t from, uint64_t to) {
  constexpr uint64_t last_id = 65535;  // of 16-bit ids, which go on at 1
  if (to < from && from <= last_id) return static_cast<int64_t>(to + last_id - from);
  return static_cast<int64_t>(to - from);
}

}  // namespace

void FrameMatcher::begin(int count) {
  count_ = count;
  next_ = damaged_ = 0;
  last_.reset();
  triggers_.clear();
}

void FrameMatcher::note_trigger(int index, Timestamp when) {
  triggers_are_noted_ = true;
  triggers_[index] = when;
}

void FrameMatcher::note_damaged() { ++damaged_; }

int FrameMatcher::counted(uint64_t frame_id) const {
  if (!last_) return damaged_;
  // A camera that does not number its frames, or began anew: count what came.
  const int64_t steps = steps_between(last_->frame_id, frame_id);
  constexpr int64_t most_lost = 1000;
  if (steps < 1 || steps > most_lost) return last_->index + 1 + damaged_;
  return last_->index + static_cast<int>(steps);
}

std::optional<int> FrameMatcher::trigger_at(Timestamp exposed_ns, Timestamp unsure_ns) const {
  std::optional<int> nearest;
  Timestamp least = 0;
  for (const auto& [index, when] : triggers_) {
    const Timestamp late = exposed_ns - when;
    if (late < -options_.early_ns - unsure_ns || late > options_.late_ns + unsure_ns) continue;
    const Timestamp distance = late < 0 ? -late : late;
    if (!nearest || distance < least) nearest = index, least = distance;
  }
  return nearest;
}

FrameMatcher::Match FrameMatcher::match(uint64_t frame_id, Timestamp exposed_ns, Timestamp unsure_ns, Timestamp now) {
  Match match{Verdict::answers, counted(frame_id), false};
  if (triggers_are_noted_) {
    const auto fired = trigger_at(exposed_ns, unsure_ns);
    if (!fired && !triggers_.contains(match.index) && match.index < count_ && now < wait_until(exposed_ns))
      return {Verdict::wait, match.index, false};
    if (!fired) return {match.index < count_ ? Verdict::unwanted : Verdict::too_many, match.index, true};
    match.slipped = *fired != match.index;
    match.index = *fired;
  }
  if (match.index >= count_) return {Verdict::too_many, match.index, match.slipped};
  if (match.index < next_) return {Verdict::unwanted, match.index, match.slipped};
  last_ = Answer{frame_id, match.index};
  next_ = match.index + 1;
  damaged_ = 0;
  return match;
}

bool FrameMatcher::owes_answer(Timestamp when) const {
  return std::any_of(triggers_.begin(), triggers_.end(), [&](const auto& trigger) {
    return trigger.first >= next_ && trigger.first < count_ && trigger.second <= when;
  });
}

}  // namespace booth
