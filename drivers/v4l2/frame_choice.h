#pragma once

#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/frame.h"

namespace booth {

/// A frame of a stream, as the device delivered it.
struct StreamedFrame {
  Timestamp begin_ns = 0;  ///< of its exposure
  uint64_t sequence = 0;
  std::vector<uint8_t> bytes = {};
  std::string damage = {};  ///< what is wrong with it; then it answers no trigger
};

/// Chooses from a stream of frames those that answer triggers: the frame whose exposure begins nearest the trigger, or
/// the first that does not begin before it. A frame answers one trigger at most, and none that is farther than a limit
/// or farther than another by more than a frame period (so that after a lost frame the next one is not taken for it);
/// damaged frames answer none.
class FrameChoice {
 public:
  enum class Rule { nearest, first_after };

  /// @param count       triggers with an index in [0, count) are answered
  /// @param max_offset  farthest that an exposure may begin from its trigger, nanoseconds
  /// @param period      between two frames of the stream, nanoseconds; 0 where it is not known
  FrameChoice(Rule rule, int count, Timestamp max_offset, Timestamp period)
      : rule_(rule), count_(count), max_offset_(max_offset), period_(period) {}

  /// A trigger fired; later ones are later. An index that waits for its frame waits from now on with this instant.
  void add_trigger(int index, Timestamp when);
  /// The next frame of the stream.
  void add_frame(StreamedFrame frame);

  struct Answer {
    int index = 0;
    Timestamp offset_ns = 0;                  ///< exposure minus trigger
    std::optional<StreamedFrame> frame = {};  ///< absent: no frame answers the trigger, for this reason
    std::string damage = {};                  ///< of the frame that would have answered
  };
  /// The answer to the trigger that waits longest, once no later frame can be a better one.
  std::optional<Answer> next();
  /// Gives up the trigger that waits longest, if a damaged frame came in place of its answer.
  std::optional<Answer> next_damaged();

 private:
  struct Trigger {
    int index = 0;
    Timestamp when = 0;
  };
  Timestamp distance(const StreamedFrame& frame, const Trigger& trigger) const;
  bool belongs(const StreamedFrame& frame, const Trigger& trigger) const;
  Answer settle(std::deque<StreamedFrame>::iterator frame);

  Rule rule_;
  int count_;
  Timestamp max_offset_;
  Timestamp period_;
  std::deque<Trigger> waiting_;
  std::deque<Trigger> settled_;  ///< the last few, so that a frame of theirs is not given to a later trigger
  std::deque<StreamedFrame> frames_;
};

}  // namespace booth
