#pragma once

#include <map>
#include <memory>
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
  double skew_us = 0;  ///< between the first and the last frame's timestamp
};

/// Arms some cameras and gathers, trigger by trigger, the frames that belong together. The destructor disarms.
class FrameCollector {
 public:
  /// @param ids    of the cameras to arm
  /// @param count  triggers that may follow
  FrameCollector(CameraSupervisor& cameras, std::vector<std::string> ids, ShotRole role, int count, const Clock& clock);
  ~FrameCollector();
  FrameCollector(const FrameCollector&) = delete;
  FrameCollector& operator=(const FrameCollector&) = delete;

  /// Waits until each camera is armed or has said why not; after `deadline` those that have not are given up.
  void wait_armed(Timestamp deadline, const std::stop_token& stop);

  /// Waits until each armed camera has answered trigger number `trigger` (from 0, rising), or until `deadline`. Frames
  /// of earlier triggers came too late and are dropped.
  ///
  /// A camera that misses two triggers in a row is not waited for until it delivers again: a dead camera must not make
  /// each of many triggers last until its deadline.
  CollectedShot collect(int trigger, Timestamp deadline, const std::stop_token& stop);

  /// How many cameras are waited for.
  size_t reachable() const;

 private:
  void note(CameraNews news, int trigger);
  bool is_reachable(const std::string& id) const;

  CameraSupervisor& cameras_;
  const std::vector<std::string> ids_;
  const Clock& clock_;
  const std::shared_ptr<CameraInbox> inbox_;
  std::set<std::string> silent_;                        ///< not heard of since the order to arm
  std::set<std::string> gone_;                          ///< not armed, or lost since
  std::set<std::string> damaged_;                       ///< whose frame of this trigger was damaged
  std::map<std::string, int> misses_;                   ///< in a row
  std::map<int, std::map<std::string, Frame>> frames_;  ///< by trigger and camera
};

}  // namespace booth
