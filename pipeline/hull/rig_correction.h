#pragma once

#include <span>
#include <string>
#include <vector>

#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

struct RigCorrectionOptions {
  double voxel_m = 0.004;  ///< as in VisualHullOptions
};

/// What the captures say about one camera.
struct CameraCorrection {
  std::string camera;
  int captures = 0;       ///< in which its outline was measured
  double deviation = 0;   ///< in standard deviations, of all captures together; 0 where nobody can tell
  bool moved = false;     ///< by more than a camera deviates that stands where it was calibrated: it is corrected
  bool doubtful = false;  ///< it deviates by too much, but nobody can tell whether it moved or others did
  double offset_px = 0;   ///< by how much the correction moves its picture of the subject, root of the mean square
  /// How far its outline misses the hull of the others, root of the mean square, pixels: as calibrated, and corrected.
  double before_px = 0, after_px = 0;
  double carried_m = 0, turned_rad = 0;  ///< what the correction says that happened to it
  /// Of the corrected pose. A camera that was turned and one that was carried see a slender subject much alike: these
  /// are far larger than what they leave open in the picture of the subject.
  PoseUncertainty uncertainty;
};

struct RigCorrection {
  Rig rig;                                ///< with the cameras that moved where they are now; as given when none did
  std::vector<CameraCorrection> cameras;  ///< in the order of the rig; those that no capture shows are left out
  int captures = 0;                       ///< that were used
  bool needed = false;                    ///< a camera moved
  std::vector<std::string> messages;      ///< sentences for the operator
};

/// Where cameras are that were moved since their calibration, from the subjects that the booth captured since, without
/// a board. The silhouettes of all captures are weighed together: what one leaves in doubt several may settle, all the
/// more when the subjects stood in different places. Cameras that stay within what a fair calibration leaves open keep
/// their poses to the last digit, so that a correction cannot make a good rig drift; intrinsics stay.
///
/// A proposal: nobody is to apply it without having looked at it.
///
/// @param rig       as calibrated
/// @param captures  silhouettes of one capture each, as carve_visual_hull takes them
/// @error too_few_views  no capture has silhouettes of six cameras: fewer cannot tell who moved
/// @error otherwise as carve_visual_hull, when it can use no capture; cancelled
/// Cost: that of a visual hull a capture, and of a look at all outlines for each camera that is tried.
/// Same input, same bytes, whatever the thread count.
/// Source: see camera_alignment.h; over several captures as C. Hernández, F. Schmitt, R. Cipolla, "Silhouette coherence
/// for camera calibration under circular motion", IEEE PAMI 29(2), 2007.
Result<RigCorrection> correct_rig(const Rig& rig, std::span<const std::vector<Silhouette>> captures,
                                  const RigCorrectionOptions& options = {}, const Work& work = {});

}  // namespace booth
