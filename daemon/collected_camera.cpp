#include "daemon/collected_camera.h"

#include <utility>

namespace booth {

CollectedCamera::CollectedCamera(CameraSupervisor& cameras, const std::string& id, Timestamp arm_patience,
                                 Timestamp most_skew, const Clock& clock, std::stop_token cancelled)
    : cameras_(cameras),
      info_{.id = id, .driver = cameras.camera(id).status().driver, .role = cameras.camera(id).status().role},
      arm_patience_(arm_patience),
      most_skew_(most_skew),
      clock_(clock),
      cancelled_(std::move(cancelled)) {}

Result<void> CollectedCamera::arm(const CaptureSettings& settings, int count) {
  collector_.reset();
  if (cancelled_.stop_requested()) return Error{ErrorCode::cancelled, info_.id + ": was stopped"};
  collector_.emplace(cameras_, std::vector<std::string>{info_.id}, settings.role, count, most_skew_, clock_);
  collector_->wait_armed(clock_.now() + arm_patience_, cancelled_);
  if (collector_->reachable() == 1) return {};
  return Error{ErrorCode::device_lost, info_.id + ": cannot be armed: " + cameras_.camera(info_.id).status().message};
}

void CollectedCamera::note_trigger(int, Timestamp when) noexcept { fired_ = when; }

Result<Frame> CollectedCamera::wait_frame(Timestamp deadline) {
  if (!collector_) return Error{ErrorCode::cancelled, info_.id + ": is not armed"};
  CollectedShot shot = collector_->collect(fired_, deadline, cancelled_);
  if (cancelled_.stop_requested()) return Error{ErrorCode::cancelled, info_.id + ": was stopped"};
  if (shot.set.frames.empty()) return Error{ErrorCode::timeout, info_.id + ": delivered no frame in time"};
  return std::move(shot.set.frames.front());
}

}  // namespace booth
