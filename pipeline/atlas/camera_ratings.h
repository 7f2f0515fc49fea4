#pragma once

#include <span>
#include <vector>

#include "pipeline/atlas/input_preparation.h"
#include "pipeline/atlas/occluder.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// How well each camera sees each triangle and vertex: pixels per square metre of surface, 0 = not seen.
struct CameraRatings {
  size_t cameras = 0;
  std::vector<float> of_triangle;  ///< triangle by triangle, one a camera
  std::vector<float> of_vertex;    ///< vertex by vertex, one a camera

  std::span<const float> triangle(size_t t) const { return {of_triangle.data() + t * cameras, cameras}; }
  std::span<const float> vertex(size_t v) const { return {of_vertex.data() + v * cameras, cameras}; }
};

/// The rating of a place that is seen well: the median over vertices of their best camera's.
float usual_rating(const CameraRatings& ratings);

/// Rates every triangle in every camera by its projected area; the mean around a vertex, weighted by the surface
/// area, is the vertex's rating. A camera that sees a triangle from behind or too obliquely, not wholly within its
/// image, or behind another part of the surface (one ray from the triangle's middle), rates it 0.
///
/// @param occluder  of the same mesh
/// Source: Pagés et al., CGF 2015, section 3.2. Ours divides by the area, so that weights of small and large
/// triangles compare, and adds the test for occlusion.
CameraRatings rate_cameras(const Mesh& mesh, const Occluder& occluder, std::span<const PreparedView> views,
                           const Work& work = {});

}  // namespace booth
