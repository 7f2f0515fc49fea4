#pragma once

#include <Eigen/Core>
#include <cmath>
#include <memory>
#include <vector>

#include "pipeline/geometry/outline_distance.h"
#include "pipeline/types/image.h"
#include "pipeline/types/rig.h"

namespace booth {

/// A camera with the outline that it sees, and what can be said about points in the world from it.
class SilhouetteView {
 public:
  /// @param camera    must outlive the view
  /// @param coverage  the size of the camera's image; small holes in the subject are filled in the view's own copy
  SilhouetteView(const RigCamera& camera, const Image& coverage);

  const RigCamera& camera() const { return *camera_; }
  const Image& coverage() const { return coverage_; }
  const OutlineDistance& outline() const { return outline_; }
  float per_focal() const { return per_focal_; }  ///< metres a pixel, at a depth of one metre

  /// Pixel coordinates and depth of a point in the world, and how many pixels it lies inside the image, negative
  /// outside and for points that are not imaged. As `project` of pipeline/geometry, in single precision.
  void project(float x, float y, float z, float& u, float& v, float& depth_m, float& within_px) const {
    const float* r = rotation_.data();
    const float camera_z = r[2] * x + r[5] * y + r[8] * z + translation_[2];
    const float d = camera_z > nearest_m ? camera_z : nearest_m;
    const float a = (r[0] * x + r[3] * y + r[6] * z + translation_[0]) / d;
    const float b = (r[1] * x + r[4] * y + r[7] * z + translation_[1]) / d;
    const float r2 = a * a + b * b;
    const float radial = 1 + r2 * (lens_.k1 + r2 * (lens_.k2 + r2 * lens_.k3));
    const float da = a * radial + 2 * lens_.p1 * a * b + lens_.p2 * (r2 + 2 * a * a);
    const float db = b * radial + lens_.p1 * (r2 + 2 * b * b) + 2 * lens_.p2 * a * b;
    u = lens_.fx * da + lens_.skew * db + lens_.cx;
    v = lens_.fy * db + lens_.cy;
    depth_m = d;
    const float across = std::min(u + 0.5F, lens_.right - u), down = std::min(v + 0.5F, lens_.bottom - v);
    const float within = std::min(across, down);
    constexpr float nowhere = -1e6F;
    within_px = camera_z > nearest_m && r2 < image_radius2_ ? within : nowhere;
  }

  /// The distance to the outline at a point in the world, metres; NaN where the camera does not see it.
  float distance_m(const Eigen::Vector3f& p_world) const;

  /// What the camera can say about all points of a ball.
  struct Verdict {
    bool seen = false;               ///< the whole ball is inside the image
    bool hidden = false;             ///< no point of it is
    double least_m = 0, most_m = 0;  ///< bounds of the distance at points that are seen
  };
  Verdict judge(const Eigen::Vector3d& center, double radius_m) const;

 private:
  static constexpr float nearest_m = 0.01F;  ///< points closer to the camera's plane are not seen
  struct Lens {
    float fx, fy, cx, cy, skew, k1, k2, p1, p2, k3, right, bottom;
  };

  void measure_lens();

  const RigCamera* camera_;
  Image coverage_;
  OutlineDistance outline_;
  Eigen::Matrix3f rotation_;
  Eigen::Vector3f translation_;
  Lens lens_;
  float per_focal_;
  double stretch_px_ = 0;    ///< the most pixels that a step of one in the plane z = 1 moves a projection
  float image_radius2_ = 0;  ///< beyond this squared distance from the axis in the plane z = 1, nothing is imaged
};

using SilhouetteViews = std::vector<std::unique_ptr<SilhouetteView>>;

}  // namespace booth
