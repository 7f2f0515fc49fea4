#pragma once

#include <array>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "pipeline/types/avatar.h"
#include "pipeline/types/image.h"
#include "pipeline/types/rig.h"

namespace booth::quality {

/// Where a ray meets a mesh: the triangle and the weights of its three corners.
struct Hit {
  uint32_t triangle = 0;
  Eigen::Vector3f corner_weights = Eigen::Vector3f::Zero();
};

/// Casts rays at a mesh, and finds its point next to another (Embree).
class RayCaster {
 public:
  explicit RayCaster(const Mesh& mesh);
  ~RayCaster();
  RayCaster(const RayCaster&) = delete;
  RayCaster& operator=(const RayCaster&) = delete;

  /// @param direction  world frame, any length
  std::optional<Hit> cast(const Eigen::Vector3d& origin, const Eigen::Vector3d& direction) const;

  /// How far a point is from the nearest of the mesh's surface, metres.
  double distance_m(const Eigen::Vector3d& p) const;

 private:
  struct Scene;
  std::unique_ptr<Scene> scene_;
};

/// A binary little-endian PLY file's vertices, whose position comes first, and triangles. Throws what the standard
/// library throws at files that are none: truth files are part of a test.
Mesh read_ply(const std::filesystem::path& file);

/// Points evenly spread over a mesh's surface, the same for the same mesh.
std::vector<Eigen::Vector3d> sample_surface(const Mesh& mesh, size_t count);

/// Of points on the surface that the caster holds, those that at least one camera sees unoccluded.
std::vector<Eigen::Vector3d> seen_points(std::span<const Eigen::Vector3d> points, const RayCaster& caster,
                                         const Rig& rig);

double mean_distance_m(std::span<const Eigen::Vector3d> points, const RayCaster& to);

/// How well a mask covers the truth.
struct MaskAgreement {
  double iou = 0;       ///< of the pixels that are covered by one half or more
  double soft_iou = 0;  ///< sum of the smaller over sum of the larger coverage of every pixel
};
MaskAgreement compare_masks(const Image& coverage, const Image& true_coverage);

/// Intersection over union of the pixels whose centre's ray meets the mesh and those whose true coverage is at
/// least one half. Every `step`-th row and column is looked at.
double silhouette_iou(const RayCaster& caster, const RigCamera& camera, const Image& true_coverage, int step);

/// Peak signal-to-noise ratio in dB of the avatar's flat texture against a photograph that no camera of the rig
/// took, over the pixels that show the subject in both, after one gain fitted in linear light.
///
/// @param background  the photograph's plain background; other pixels are the subject
double view_psnr_db(const RayCaster& caster, const Avatar& avatar, const CalibratedView& view, const Image& photograph,
                    const std::array<uint8_t, 3>& background);

/// Part of a picture, pixels.
struct Window {
  int left = 0, top = 0, width = 0, height = 0;
};

/// The avatar's flat texture as a view shows it, four rays a pixel, before a plain background.
Image render_view(const RayCaster& caster, const Avatar& avatar, const CalibratedView& view, const Window& window,
                  const std::array<uint8_t, 3>& background);

}  // namespace booth::quality
