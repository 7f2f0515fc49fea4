#pragma once

#include <cstdint>
#include <map>
#include <optional>

#include "drivers/clock.h"

namespace booth {

/// Which trigger a frame answers: by counting, and by the instants at which triggers are known to have fired.
///
/// Cameras number their frames; a gap in the numbers is a trigger whose frame was lost. A trigger line that picks up
/// noise, or a trigger that a camera did not see, makes the count slip: where triggers are noted, the instant decides.
class FrameMatcher {
 public:
  struct Options {
    /// A frame's exposure begins this much before its trigger at the earliest (clocks are not perfect), …
    Timestamp early_ns = milliseconds(5);
    /// … and this much after it at the latest.
    Timestamp late_ns = milliseconds(250);
    /// How long after the beginning of its exposure a frame is kept waiting for its trigger to be noted.
    Timestamp patience_ns = milliseconds(400);
  };
  enum class Verdict {
    answers,   ///< trigger `index`
    wait,      ///< its trigger may still be noted; ask again
    unwanted,  ///< nothing triggered it, or its trigger was answered already
    too_many   ///< more triggers fired than the camera is armed for
  };
  struct Match {
    Verdict verdict = Verdict::unwanted;
    int index = 0;
    bool slipped = false;  ///< the count alone would have said otherwise
  };

  FrameMatcher() : FrameMatcher(Options{}) {}
  explicit FrameMatcher(const Options& options) : options_(options) {}

  /// The camera was armed anew for triggers 0 … count − 1. What is known of its habits stays.
  void begin(int count);
  void note_trigger(int index, Timestamp when);
  /// A frame arrived damaged: it answered a trigger all the same.
  void note_damaged();

  /// @param frame_id     as the camera numbers it: rising, 16-bit ids without 0
  /// @param exposed_ns   the beginning of the exposure less the trigger delay, on the booth's clock
  /// @param unsure_ns    how far off that may be
  Match match(uint64_t frame_id, Timestamp exposed_ns, Timestamp unsure_ns, Timestamp now);

  /// The instant until which a frame that had to wait should be kept.
  Timestamp wait_until(Timestamp exposed_ns) const { return exposed_ns + options_.patience_ns; }
  /// A trigger that fired by `when` and has no answer yet.
  bool owes_answer(Timestamp when) const;

 private:
  int counted(uint64_t frame_id) const;
  std::optional<int> trigger_at(Timestamp exposed_ns, Timestamp unsure_ns) const;

  Options options_;
  int count_ = 0;
  int next_ = 0;     ///< lowest trigger without an answer
  int damaged_ = 0;  ///< frames since the last whole one, or since the beginning
  bool triggers_are_noted_ = false;
  struct Answer {
    uint64_t frame_id;
    int index;
  };
  std::optional<Answer> last_;
  std::map<int, Timestamp> triggers_;
};

}  // namespace booth
