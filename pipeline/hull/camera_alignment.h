#pragma once

#include <span>
#include <vector>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/hull/pose_estimation.h"
#include "pipeline/types/field.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/work.h"

namespace booth {

/// How far a camera's pose lies from where the silhouettes of all cameras expect it.
struct CameraDeviation {
  double offset_px = 0;  ///< by how much its outline of the subject is off, root of the mean square
  /// In standard deviations of what outlines and a fair calibration leave open; 0 where nobody can tell.
  double deviation = 0;
  bool moved = false;  ///< by more than a camera deviates that stands where it was calibrated
};

/// Finds cameras that were moved since their calibration, and puts them where the silhouettes expect them. All poses
/// are estimated together, so that one camera's fault is not taken for its neighbours'; the one camera whose freedom to
/// move explains most is put back, and all are looked at anew. What counts as moved grows with the unrest of the rig's
/// other cameras. With fewer than six views nobody can tell, and none is moved; at most a third is.
///
/// @param rig    holds the cameras of the views
/// @param views  those of moved cameras are made anew
/// @param hull   carved from the same views; it tells where to look
/// @return by view
/// Source: see pose_estimation.h; the choice one by one is a matching pursuit, S. Mallat, Z. Zhang, IEEE Transactions
/// on Signal Processing 41(12), 1993.
std::vector<CameraDeviation> realign_cameras(Rig& rig, SilhouetteViews& views, const Field& hull,
                                             const Work& work = {});

/// What one capture shows.
struct AlignmentScene {
  SilhouetteViews* views = nullptr;
  const Field* hull = nullptr;  ///< carved from the views; it tells where to look
};

/// Several captures by the same cameras; together they say more about each.
class AlignmentScenes {
 public:
  /// @param rig  holds the cameras of all views, and is changed with them; scenes of fewer than six views are left out
  AlignmentScenes(Rig& rig, std::span<const AlignmentScene> scenes);

  /// Those that are in a scene are counted in the order in which they appear.
  size_t cameras() const { return cameras_.size(); }
  const RigCamera& camera(size_t camera) const { return *cameras_[camera]; }
  void put(size_t camera, const Eigen::Isometry3d& camera_from_world);
  /// Of all scenes; their views are cameras.
  std::vector<CoherenceSample> sample(const Work& work) const;
  std::vector<PoseScale> scales(std::span<const CoherenceSample> samples) const;

 private:
  std::vector<AlignmentScene> scenes_;
  std::vector<RigCamera*> cameras_;
  std::vector<size_t> cameras_of_views_;  ///< one scene after the other
};

/// The same from several captures. @return by camera of the scenes
std::vector<CameraDeviation> realign_cameras(AlignmentScenes& scenes, const Work& work = {});

}  // namespace booth
