#pragma once

#include <span>
#include <vector>

#include "pipeline/face/control_points.h"
#include "pipeline/face/head.h"
#include "pipeline/face/landmark_predictor.h"
#include "pipeline/face/patch_matching.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/work.h"

namespace booth {

/// A face in one camera's picture.
struct SeenFace {
  FaceObservation observation;  ///< sigma_px is the spread of repeated predictions
  PinholePicture picture;       ///< the face, upright, its detector's box 200 pixels wide
};

struct FaceSearch {
  std::vector<SeenFace> faces;  ///< in the order of the cameras' ids
  size_t searched = 0;          ///< how many cameras were
};

/// Looks for the face in the pictures of the cameras that see the head largest and from the front.
///
/// @param most_cameras  that are searched
/// @param work          when it is stopped, fewer faces are found
FaceSearch search_faces(const Rig& rig, std::span<const Frame> frames, const HeadRegion& head,
                        const LandmarkPredictor& predictor, size_t most_cameras, const Work& work);

}  // namespace booth
