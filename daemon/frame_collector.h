#pragma once

#include <map>
#include <memory>
#include <optional>
#include <set>
#include <stop_token>
#include <string>
#include <vector>

#include "daemon/camera_supervisor.h"
#include "drivers/clock.h"
#include "pipeline/types/frame.h"

namespace booth {

/// The frames of one trigger, and who did not deliver.
struct CollectedShot {
  FrameSet set;  ///< its index is the trigger's
  std::vector<std::string> missing;
  std::map<std::string, double> offsets_us;  ///< by camera: from the trigger to the beginning of its exposure
  double skew_us = 0;                        ///< between the first and the last exposure
  std::vector<std::string> remarks;          ///< sentences for an operator: frames that were off, too large a skew
};

/// Arms some cameras and gathers, trigger by trigger, the frames that belong together. The destructor disarms.
///
/// A frame belongs to the trigger that its index names, which its timestamp must confirm. A camera that missed a
/// trigger, or saw one that was none, counts wrong from then on: its frames go to the trigger that their timestamp
/// names, and those that no trigger explains are dropped.
class FrameCollector {
 public:
  /// @param ids        of the cameras to arm
  /// @param count      triggers that may follow
  /// @param most_skew  how far from its trigger a frame may be exposed
  FrameCollector(CameraSupervisor& cameras, std::vector<std::string> ids, ShotRole role, int count, Timestamp most_skew,
                 const Clock& clock);
  ~FrameCollector();
  FrameCollector(const FrameCollector&) = delete;
  FrameCollector& operator=(const FrameCollector&) = delete;

  /// Waits until each camera is armed or has said why not; after `deadline` those that have not are given up.
  void wait_armed(Timestamp deadline, const std::stop_token& stop);

  /// The next trigger, number 0 at first, fired at `when`: waits until each armed camera has answered it, or until
  /// `deadline`. Frames of earlier triggers came too late and are dropped.
  ///
  /// A camera that misses two triggers in a row is not waited for until it delivers again: a dead camera must not make
  /// each of many triggers last until its deadline.
  CollectedShot collect(Timestamp when, Timestamp deadline, const std::stop_token& stop);

  /// How many cameras are waited for.
  size_t reachable() const;
  bool is_reachable(const std::string& id) const;

 private:
  void note(CameraNews news);
  void note_frame(const std::string& camera, Frame frame);
  std::optional<size_t> trigger_of(const Frame& frame) const;
  size_t latest() const { return fired_.size() - 1; }
  CollectedShot gather(const std::stop_token& stop);

  CameraSupervisor& cameras_;
  const std::vector<std::string> ids_;
  const Timestamp most_skew_;
  const Clock& clock_;
  const std::shared_ptr<CameraInbox> inbox_;
  std::vector<Timestamp> fired_;                           ///< when each trigger was
  std::set<std::string> silent_;                           ///< not heard of since the order to arm
  std::set<std::string> gone_;                             ///< not armed, or lost since
  std::set<std::string> damaged_;                          ///< whose frame of this trigger was damaged
  std::map<std::string, int> misses_;                      ///< in a row
  std::map<size_t, std::map<std::string, Frame>> frames_;  ///< by trigger and camera
  std::vector<std::string> remarks_;                       ///< of this trigger
};

}  // namespace booth
