#pragma once

#include <Eigen/Geometry>
#include <vector>

#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"

namespace booth::quality {

/// What a camera of a synthetic recording would have seen from another pose, made from what it saw: the recordings'
/// room is a box, whose walls, floor and ceiling are looked up where the camera saw them, and the subject is taken to
/// be flat, in the plane through the volume's middle that faces the camera. Exact for turns; of a camera that was
/// carried, the parallax of the subject's relief and of the housings before the walls is missing. Interpolation takes
/// some of the noise off.
class KnockedCamera {
 public:
  /// @param subject  its silhouette in the frame
  KnockedCamera(const Rig& rig, const RigCamera& camera, const Frame& frame, const Silhouette& subject);

  struct View {
    Frame frame;
    Image subject;
  };
  /// @param motion  of the camera: x_camera becomes motion · x_camera
  View see(const Eigen::Isometry3d& motion) const;

 private:
  const RigCamera& camera_;
  const Frame& frame_;
  const Silhouette& subject_;
  Eigen::Vector3d middle_;
  std::vector<Eigen::Vector2f> rays_;  ///< by pixel, in the plane z = 1
};

}  // namespace booth::quality
