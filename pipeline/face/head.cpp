#include "pipeline/face/head.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace booth {

std::optional<Eigen::Vector3f> surface_barycentre(const Mesh& mesh,
                                                  const std::function<bool(const Eigen::Vector3f&)>& counts) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double area = 0;
  for (const auto& [a, b, c] : mesh.triangles) {
    const Eigen::Vector3f middle = (mesh.positions[a] + mesh.positions[b] + mesh.positions[c]) / 3;
    if (!counts(middle)) continue;
    const Eigen::Vector3f ab = mesh.positions[b] - mesh.positions[a], ac = mesh.positions[c] - mesh.positions[a];
    const Eigen::Vector3f cross(ab.y() * ac.z() - ab.z() * ac.y(), ab.z() * ac.x() - ab.x() * ac.z(),
                                ab.x() * ac.y() - ab.y() * ac.x());
    sum += static_cast<double>(cross.norm()) * middle.cast<double>();
    area += static_cast<double>(cross.norm());
  }
  if (!(area > 0)) return std::nullopt;
  return Eigen::Vector3f((sum / area).cast<float>());
}

std::optional<HeadRegion> find_head(const Mesh& mesh) {
  if (mesh.positions.empty()) return std::nullopt;
  float floor = std::numeric_limits<float>::infinity(), crown = -floor;
  Eigen::Vector3f top = Eigen::Vector3f::Zero();
  for (const Eigen::Vector3f& p : mesh.positions) {
    floor = std::min(floor, p.y());
    if (p.y() > crown) {
      crown = p.y();
      top = p;
    }
  }
  const float stature = crown - floor;
  constexpr float least_stature_m = 0.3F;
  if (!(stature > least_stature_m)) return std::nullopt;

  // Widths of thin slices around the crown's vertical; arms hang or stand off farther away.
  constexpr float highest = 0.08F, lowest = 0.25F, beside = 0.12F;  // of the stature
  constexpr int slices = 34;
  struct Slice {
    float left = std::numeric_limits<float>::infinity(), right = -left, back = left, front = -left;
    float size() const { return std::max(right - left, 0.0F) * std::max(front - back, 0.0F); }
  };
  std::vector<Slice> slice(slices);
  for (const Eigen::Vector3f& p : mesh.positions) {
    const float below = (crown - p.y()) / stature;
    const int s = static_cast<int>(std::floor((below - highest) / (lowest - highest) * slices));
    if (s < 0 || s >= slices || std::abs(p.x() - top.x()) > beside * stature) continue;
    Slice& at = slice[static_cast<size_t>(s)];
    at.left = std::min(at.left, p.x());
    at.right = std::max(at.right, p.x());
    at.back = std::min(at.back, p.z());
    at.front = std::max(at.front, p.z());
  }
  size_t neck = 0;
  for (size_t s = 0; s < slice.size(); ++s)
    if (slice[s].size() > 0 && (slice[neck].size() <= 0 || slice[s].size() < slice[neck].size())) neck = s;
  if (slice[neck].size() <= 0) return std::nullopt;

  HeadRegion head;
  head.crown_y = crown;
  head.neck_y = crown - stature * (highest + (lowest - highest) * (static_cast<float>(neck) + 0.5F) / slices);
  const auto barycentre = surface_barycentre(mesh, [&](const Eigen::Vector3f& p) {
    return !(p.y() < head.neck_y) && !(std::abs(p.x() - top.x()) > beside * stature);
  });
  if (!barycentre) return std::nullopt;
  head.barycentre = *barycentre;
  return head;
}

}  // namespace booth
