#pragma once

#include <span>
#include <vector>

#include "pipeline/atlas/input_preparation.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// How well each camera sees each vertex.
struct CameraRatings {
  size_t cameras = 0;
  std::vector<float> of_vertex;        ///< vertex-major: pixels per square metre of surface, 0 = not seen
  std::vector<uint8_t> triangle_seen;  ///< 1 where at least one camera sees the triangle

  std::span<const float> vertex(size_t v) const { return {of_vertex.data() + v * cameras, cameras}; }
};

/// Rates every triangle in every camera by its projected area; the mean around a vertex, weighted by the surface
/// area, is the vertex's rating. A camera that sees a triangle from behind or too obliquely, not wholly within its
/// image, or behind another part of the surface (one ray from the triangle's middle), rates it 0.
///
/// Source: Pagés et al., CGF 2015, section 3.2. Ours divides by the area, so that weights of small and large
/// triangles compare, and adds the test for occlusion.
CameraRatings rate_cameras(const Mesh& mesh, std::span<const PreparedView> views, const Work& work = {});

}  // namespace booth
