#include "pipeline/atlas/camera_ratings.h"

#include <Eigen/Geometry>
#include <algorithm>

#include "pipeline/atlas/occluder.h"

namespace booth {
namespace {

struct TriangleShape {
  Eigen::Vector3f middle, normal;
  float area = 0;
};

std::vector<TriangleShape> shapes_of(const Mesh& mesh) {
  std::vector<TriangleShape> shapes(mesh.triangles.size());
  for (size_t t = 0; t < shapes.size(); ++t) {
    const Eigen::Vector3f& a = mesh.positions[mesh.triangles[t][0]];
    const Eigen::Vector3f& b = mesh.positions[mesh.triangles[t][1]];
    const Eigen::Vector3f& c = mesh.positions[mesh.triangles[t][2]];
    const Eigen::Vector3f twice = (b - a).cross(c - a);
    const float length = twice.norm();
    shapes[t] = {(a + b + c) / 3, length > 0 ? Eigen::Vector3f(twice / length) : Eigen::Vector3f::Zero(),
                 0.5F * length};
  }
  return shapes;
}

/// The triangle's area in the image, pixels², or 0 where it is not wholly inside.
float projected_area(const PreparedView& view, const std::array<uint32_t, 3>& triangle) {
  const Intrinsics& k = view.camera->intrinsics;
  for (const uint32_t v : triangle) {
    const Eigen::Vector3f& p = view.projected[v];
    const float x = p.x() + static_cast<float>(view.left), y = p.y() + static_cast<float>(view.top);
    if (!(p.z() > 0 && x >= 0 && y >= 0 && x <= static_cast<float>(k.width - 1) &&
          y <= static_cast<float>(k.height - 1)))
      return 0;
  }
  const Eigen::Vector2f a = view.projected[triangle[0]].head<2>(), b = view.projected[triangle[1]].head<2>(),
                        c = view.projected[triangle[2]].head<2>();
  return 0.5F * std::abs((b - a).x() * (c - a).y() - (b - a).y() * (c - a).x());
}

}  // namespace

float usual_rating(const CameraRatings& ratings) {
  std::vector<float> best;
  for (size_t v = 0; v * ratings.cameras < ratings.of_vertex.size(); ++v) {
    const auto rating = ratings.vertex(v);
    if (const float most = *std::max_element(rating.begin(), rating.end()); most > 0) best.push_back(most);
  }
  if (best.empty()) return 1;
  std::nth_element(best.begin(), best.begin() + static_cast<std::ptrdiff_t>(best.size() / 2), best.end());
  return best[best.size() / 2];
}

CameraRatings rate_cameras(const Mesh& mesh, const Occluder& occluder, std::span<const PreparedView> views,
                           const Work& work) {
  constexpr float least_cosine = 0.08F;  // beyond 85° a pixel's colour says little
  constexpr float off_surface_m = 0.002F;
  const std::vector<TriangleShape> shapes = shapes_of(mesh);
  std::vector<float> area_around(mesh.positions.size(), 0.0F);
  for (size_t t = 0; t < shapes.size(); ++t)
    for (const uint32_t v : mesh.triangles[t]) area_around[v] += shapes[t].area;

  CameraRatings ratings;
  ratings.cameras = views.size();
  ratings.of_vertex.assign(mesh.positions.size() * views.size(), 0.0F);
  ratings.of_triangle.assign(mesh.triangles.size() * views.size(), 0.0F);
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t c = begin; c < end; ++c) {
      const Eigen::Vector3f eye = views[c].camera->center().cast<float>();
      for (size_t t = 0; t < shapes.size(); ++t) {
        const TriangleShape& shape = shapes[t];
        const Eigen::Vector3f to_eye = eye - shape.middle;
        const float distance = to_eye.norm();
        if (!(shape.normal.dot(to_eye) > least_cosine * distance)) continue;
        const float area_px = projected_area(views[c], mesh.triangles[t]);
        if (!(area_px > 0)) continue;
        if (occluder.between(shape.middle + off_surface_m * shape.normal, eye, off_surface_m / distance)) continue;
        ratings.of_triangle[t * views.size() + c] = shape.area > 0 ? area_px / shape.area : 0;
        // area_px / area is the triangle's rating; times its area for the weighted mean.
        for (const uint32_t v : mesh.triangles[t])
          if (area_around[v] > 0) ratings.of_vertex[v * views.size() + c] += area_px / area_around[v];
      }
    }
  });
  return ratings;
}

}  // namespace booth
