#pragma once

#include <array>
#include <memory>
#include <optional>

#include "pipeline/types/avatar.h"
#include "pipeline/types/image.h"
#include "pipeline/types/rig.h"

namespace booth::quality {

/// Where a ray meets a mesh: the triangle and the weights of its three corners.
struct Hit {
  uint32_t triangle = 0;
  Eigen::Vector3f corner_weights = Eigen::Vector3f::Zero();
};

/// Casts rays at a mesh (Embree).
class RayCaster {
 public:
  explicit RayCaster(const Mesh& mesh);
  ~RayCaster();
  RayCaster(const RayCaster&) = delete;
  RayCaster& operator=(const RayCaster&) = delete;

  /// @param direction  world frame, any length
  std::optional<Hit> cast(const Eigen::Vector3d& origin, const Eigen::Vector3d& direction) const;

 private:
  struct Scene;
  std::unique_ptr<Scene> scene_;
};

/// Intersection over union of the pixels whose centre's ray meets the mesh and those whose true coverage is at
/// least one half. Every `step`-th row and column is looked at.
double silhouette_iou(const RayCaster& caster, const RigCamera& camera, const Image& true_coverage, int step);

/// Peak signal-to-noise ratio in dB of the avatar's flat texture against a photograph that no camera of the rig
/// took, over the pixels that show the subject in both, after one gain fitted in linear light.
///
/// @param background  the photograph's plain background; other pixels are the subject
double view_psnr_db(const RayCaster& caster, const Avatar& avatar, const CalibratedView& view, const Image& photograph,
                    const std::array<uint8_t, 3>& background);

}  // namespace booth::quality
