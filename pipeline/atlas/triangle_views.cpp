#include "pipeline/atlas/triangle_views.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>

#include "pipeline/atlas/view_sampling.h"

namespace booth {
namespace {

bool certainly_seen(const PreparedView& view, const std::array<uint32_t, 3>& triangle) {
  Eigen::Array2f low = Eigen::Array2f::Constant(std::numeric_limits<float>::infinity()), high = -low;
  for (const uint32_t v : triangle) {
    const Eigen::Vector3f& p = view.projected[v];
    if (look_up(view, p.x(), p.y(), p.z()).visible < 1) return false;
    low = low.min(p.head<2>().array());
    high = high.max(p.head<2>().array());
  }
  // In pixels of the confidence map, with one more for interpolation and the band around the triangle.
  const int x0 = static_cast<int>(std::floor(0.5F * low.x())) - 1, x1 = static_cast<int>(0.5F * high.x()) + 1;
  const int y0 = static_cast<int>(std::floor(0.5F * low.y())) - 1, y1 = static_cast<int>(0.5F * high.y()) + 1;
  if (!view.trust.contains(x0, y0) || !view.trust.contains(x1, y1)) return false;
  constexpr uint32_t all_sure = 0xFFFFFFFF;
  uint32_t common = all_sure;
  for (int y = y0; y < y1; ++y) {
    const TrustCell* row = view.trust.pixel(0, y);
    for (int x = x0; x < x1; ++x) common &= row[x].confidence;
    if (common != all_sure) return false;
  }
  return true;
}

float texels_per_m2(const Mesh& mesh, const Packing& packing, size_t t) {
  const auto& corners = packing.corners[t];
  const Eigen::Vector2d ab = corners[1] - corners[0], ac = corners[2] - corners[0];
  const auto texels = static_cast<float>(std::abs(ab.x() * ac.y() - ab.y() * ac.x()));
  const auto& triangle = mesh.triangles[t];
  const Eigen::Vector3f e = mesh.positions[triangle[1]] - mesh.positions[triangle[0]];
  const Eigen::Vector3f f = mesh.positions[triangle[2]] - mesh.positions[triangle[0]];
  const float area_m2 = e.cross(f).norm();
  return area_m2 > 0 ? texels / area_m2 : 0;
}

float most(const TriangleView& view) { return *std::max_element(view.rating.begin(), view.rating.end()); }

}  // namespace

std::vector<TriangleView> views_of_triangle(const Mesh& mesh, const Packing& packing, size_t t,
                                            std::span<const PreparedView> views, const CameraRatings& ratings,
                                            float usual, std::span<const Eigen::Vector2f> shifts) {
  const auto& triangle = mesh.triangles[t];
  const float density = texels_per_m2(mesh, packing, t);
  std::vector<TriangleView> seen;
  for (size_t c = 0; c < views.size(); ++c) {
    TriangleView view;
    view.view = c;
    bool usable = true;
    float sum = 0;
    for (size_t k = 0; k < 3; ++k) {
      const Eigen::Vector3f& p = views[c].projected[triangle[k]];
      usable = usable && p.z() > 0;
      view.rating[k] = ratings.vertex(triangle[k])[c] / usual;
      view.depth[k] = p.z();
      view.x_depth[k] = p.x() * p.z();
      view.y_depth[k] = p.y() * p.z();
      if (!shifts.empty()) {
        view.x_shift[k] = shifts[triangle[k] * views.size() + c].x();
        view.y_shift[k] = shifts[triangle[k] * views.size() + c].y();
      }
      sum += view.rating[k];
    }
    if (!usable || !(sum > 0)) continue;
    const float pixels_per_m2 = sum / 3 * usual;
    view.lod = density > 0 ? 0.5F * std::log2(pixels_per_m2 / density) : 0;
    view.certain = certainly_seen(views[c], triangle);
    seen.push_back(view);
  }
  if (seen.size() > most_views_of_triangle) {
    std::stable_sort(seen.begin(), seen.end(),
                     [](const TriangleView& l, const TriangleView& r) { return most(l) > most(r); });
    seen.resize(most_views_of_triangle);
  }
  return seen;
}

}  // namespace booth
