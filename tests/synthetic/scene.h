#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"
#include "tests/synthetic/body.h"

namespace booth::synthetic {

struct RigOptions {
  int cameras = 8;
  int width = 240;
  int height = 320;
  double distance_m = 2.6;
  bool distorted = true;  ///< mild lens distortion, another for each camera
  uint32_t seed = 1;
};

/// Cameras in a ring at alternating heights, upright, looking at the subject's middle; volume 1.8 × 2.2 × 1.2 m.
Rig ring_rig(const RigOptions& options = {});

/// The body's exact coverage in a camera: `samples`² rays a pixel.
Silhouette render_silhouette(const Body& body, const RigCamera& camera, int samples = 3);
std::vector<Silhouette> render_silhouettes(const Body& body, const Rig& rig, int samples = 3);

/// A surface's sRGB colour, 0 … 1, the same from everywhere.
using Paint = std::function<Eigen::Vector3d(const Eigen::Vector3d& p_world)>;
/// Smoothly varying.
Eigen::Vector3d colour_at(const Eigen::Vector3d& p_world);
/// Like cloth: speckles of a few centimetres, nowhere the same again.
Eigen::Vector3d cloth_at(const Eigen::Vector3d& p_world);

/// A photograph of the painted body before a plain wall.
Frame render_photograph(const Body& body, const RigCamera& camera, int samples = 2, const Paint& paint = colour_at);

/// Where a ray first meets the body, by sphere tracing; false where it misses.
bool trace(const Body& body, const Eigen::Vector3d& origin, const Eigen::Vector3d& direction, Eigen::Vector3d* hit);

}  // namespace booth::synthetic
