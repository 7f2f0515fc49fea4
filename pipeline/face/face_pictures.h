#pragma once

#include <span>
#include <vector>

#include "pipeline/face/control_points.h"
#include "pipeline/face/patch_matching.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/image.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/work.h"

namespace booth {

/// A face as one camera shows it.
struct FacePicture {
  PinholePicture pinhole;
  /// Red less blue in linear light, −1 … 1, of the same size: highlights, which have the light's colour and not the
  /// skin's and wander with the eye, cancel. All 0 for a grey camera.
  /// Source: S. Mallick et al., "Beyond Lambert: reconstructing specular surfaces using color", CVPR 2005.
  FloatImage matte;
};

/// What the cameras in front of a face and beside it show of it: upright, without distortion, as fine as their pixels
/// or a third of a millimetre, by the cameras' ids. Of many cameras the ones that see it largest and frontally.
///
/// @param frames        at most one per camera, any order
/// @param work          when it is stopped, pictures are missing
/// @param most_cameras  that are chosen
std::vector<FacePicture> face_pictures(const Rig& rig, std::span<const Frame> frames, const FaceFrame& face,
                                       const Work& work = {}, size_t most_cameras = 7);

}  // namespace booth
