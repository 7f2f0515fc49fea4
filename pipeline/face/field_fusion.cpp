#include "pipeline/face/field_fusion.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>
#include <vector>

#include "pipeline/face/ray_caster.h"

namespace booth {
namespace {

constexpr int side = Field::brick_side;

/// How deep the scan's surface lies beyond a point, along the ray from the eye; negative where it lies before it.
class ScanDepth {
 public:
  ScanDepth(const HeadRegion& head, const ScanMesh& scan, const Eigen::Vector3f& eye)
      : head_(head), scan_(scan), eye_(eye), rays_(scan.mesh) {}

  /// What a ray meets of the scan.
  struct Depth {
    float distance = -std::numeric_limits<float>::infinity();  ///< metres from the surface, positive towards the eye
    float cosine = 0;                                          ///< of the angle at which the ray meets the surface
    float rim_m = 0;                                           ///< how far from the scan's rim
  };
  /// −infinity where the scan says nothing.
  Depth at(const Eigen::Vector3f& p) const {
    if (p.y() < head_.lowest_face_y()) return {};
    const Eigen::Vector3f way = (p - eye_).normalized();
    const auto hit = rays_.cast(eye_, way, 0, std::numeric_limits<float>::infinity());
    if (!hit) return {};
    const auto& corner = scan_.mesh.triangles[hit->triangle];
    const auto& points = scan_.mesh.positions;
    const Eigen::Vector3f normal =
        (points[corner[1]] - points[corner[0]]).cross(points[corner[2]] - points[corner[0]]).normalized();
    const float rim = std::min({scan_.rim_m[corner[0]], scan_.rim_m[corner[1]], scan_.rim_m[corner[2]]});
    constexpr float slope = 3, deepest_m = 0.03F;
    const float held_back = std::max(0.0F, deepest_m - slope * rim);
    constexpr float least_cosine = 0.2F;
    const float cosine = std::max(least_cosine, std::abs(normal.dot(way)));
    return {(hit->distance_m - held_back - (p - eye_).norm()) * cosine, cosine, rim};
  }

 private:
  const HeadRegion& head_;
  const ScanMesh& scan_;
  Eigen::Vector3f eye_;
  RayCaster rays_;
};

/// The field with other samples between an eye and what lies in a box: all that can lie before a surface there.
/// @param box     of the surface
/// @param sample  (point, value so far, metres) → its new value; may be called by several threads
template <class Sample>
Field rewrite(const Field& field, const Eigen::AlignedBox3f& box, const Eigen::Vector3f& eye, Sample&& sample,
              const Work& work) {
  const Grid& grid = field.grid();
  const float cut_off = 2 * static_cast<float>(grid.voxel_m);
  Eigen::AlignedBox3f reach = box;
  constexpr float hull_excess_m = 0.08F;
  const Eigen::Vector3f towards = (eye - box.center()).normalized() * hull_excess_m;
  reach.extend(box.min() + towards);
  reach.extend(box.max() + towards);

  // New samples of the bricks in reach, and what each brick is then.
  const auto bricks = field.bricks();
  const int nx = bricks[0], ny = bricks[1], nz = bricks[2];
  std::vector<std::vector<float>> changed(static_cast<size_t>(nx) * static_cast<size_t>(ny) * static_cast<size_t>(nz));
  work.parallel_for(static_cast<size_t>(nz) * static_cast<size_t>(ny), 1, [&](size_t begin, size_t end) {
    for (size_t row = begin; row < end && !work.stopped(); ++row) {
      const int by = static_cast<int>(row) % ny, bz = static_cast<int>(row) / ny;
      for (int bx = 0; bx < nx; ++bx) {
        const size_t brick = field.brick_index(bx, by, bz);
        const int32_t block = field.brick(brick);
        if (block == Field::all_outside) continue;
        const Eigen::Vector3f low = grid.point(bx * side, by * side, bz * side).cast<float>();
        const Eigen::Vector3f high = low + Eigen::Vector3f::Constant(static_cast<float>(side * grid.voxel_m));
        if (!reach.intersects(Eigen::AlignedBox3f(low, high))) continue;
        std::vector<float> samples(Field::samples_per_brick);
        bool any = false;
        size_t s = 0;
        for (int z = 0; z < side; ++z)
          for (int y = 0; y < side; ++y)
            for (int x = 0; x < side; ++x, ++s) {
              const int i = bx * side + x, j = by * side + y, k = bz * side + z;
              const bool beyond = i >= grid.size[0] || j >= grid.size[1] || k >= grid.size[2];
              const float before = block == Field::all_inside ? -cut_off : field.block(block)[s];
              samples[s] = before;
              if (beyond || before >= cut_off) continue;
              const float after = std::min(sample(grid.point(i, j, k).cast<float>(), before), cut_off);
              any = any || after != before;
              samples[s] = after;
            }
        if (any) changed[brick] = std::move(samples);
      }
    }
  });

  Field out(grid);
  size_t blocks = 0;
  for (size_t brick = 0; brick < changed.size(); ++brick)
    if (!changed[brick].empty() || field.brick(brick) >= 0) ++blocks;
  out.allocate_blocks(blocks);
  int32_t next = 0;
  for (size_t brick = 0; brick < changed.size(); ++brick) {
    if (!changed[brick].empty()) {
      std::copy(changed[brick].begin(), changed[brick].end(), out.block(next));
    } else if (field.brick(brick) >= 0) {
      std::copy_n(field.block(field.brick(brick)), Field::samples_per_brick, out.block(next));
    } else {
      out.set_brick(brick, field.brick(brick));
      continue;
    }
    out.set_brick(brick, next++);
  }
  return out;
}

/// 0 up to `from`, 1 beyond `to`, smooth between them.
float smooth_step(float from, float to, float value) {
  const float t = std::clamp((value - from) / (to - from), 0.0F, 1.0F);
  constexpr float two = 2, three = 3;
  return t * t * (three - two * t);
}

/// A surface's vertices by where they are.
class NearestVertex {
 public:
  explicit NearestVertex(const std::vector<Eigen::Vector3f>& positions) : positions_(positions) {
    for (const Eigen::Vector3f& p : positions) box_.extend(p);
    size_ = ((box_.sizes() / cell_m).array().floor().cast<int>() + 1).matrix();
    cells_.resize(static_cast<size_t>(size_.x()) * static_cast<size_t>(size_.y()) * static_cast<size_t>(size_.z()));
    for (uint32_t v = 0; v < positions.size(); ++v) cells_[index(cell_of(positions[v]))].push_back(v);
  }

  /// The one nearest to a point, of those within two centimetres.
  std::optional<uint32_t> operator()(const Eigen::Vector3f& p) const {
    constexpr int reach = 2;
    float nearest = (reach * cell_m) * (reach * cell_m);
    std::optional<uint32_t> found;
    const Eigen::Vector3i middle = cell_of(p);
    const Eigen::Vector3i low = (middle.array() - reach).max(0), high = (middle.array() + reach).min(size_.array() - 1);
    for (int z = low.z(); z <= high.z(); ++z)
      for (int y = low.y(); y <= high.y(); ++y)
        for (int x = low.x(); x <= high.x(); ++x)
          for (const uint32_t v : cells_[index({x, y, z})])
            if (const float away = (positions_[v] - p).squaredNorm(); away < nearest) {
              nearest = away;
              found = v;
            }
    return found;
  }

 private:
  static constexpr float cell_m = 0.01F;
  Eigen::Vector3i cell_of(const Eigen::Vector3f& p) const {
    return ((p - box_.min()) / cell_m).array().floor().cast<int>();
  }
  size_t index(const Eigen::Vector3i& cell) const {
    return (static_cast<size_t>(cell.z()) * static_cast<size_t>(size_.y()) + static_cast<size_t>(cell.y())) *
               static_cast<size_t>(size_.x()) +
           static_cast<size_t>(cell.x());
  }

  const std::vector<Eigen::Vector3f>& positions_;
  Eigen::AlignedBox3f box_;
  Eigen::Vector3i size_;
  std::vector<std::vector<uint32_t>> cells_;
};

}  // namespace

Field fuse_scan(const Field& field, const HeadRegion& head, const ScanMesh& scan, const Eigen::Vector3f& eye,
                const Work& work) {
  if (scan.mesh.triangles.empty()) return field;
  const ScanDepth depth(head, scan, eye);
  Eigen::AlignedBox3f box;
  for (const auto& triangle : scan.mesh.triangles)
    for (const uint32_t v : triangle)
      if (scan.mesh.positions[v].y() > head.lowest_face_y()) box.extend(scan.mesh.positions[v]);
  return rewrite(
      field, box, eye,
      [&](const Eigen::Vector3f& p, float before) {
        const auto [distance, cosine, rim] = depth.at(p);
        constexpr float thickest_fill_m = 0.012F, fill_from_rim_m = 0.005F, steepest_fill = 0.4F;
        const bool fills = distance < 0 && distance > -thickest_fill_m && rim > fill_from_rim_m &&
                           cosine > steepest_fill && before > distance;
        return distance > before || fills ? distance : before;
      },
      work);
}

Field blend_surface(const Field& field, const Mesh& surface, std::span<const float> weight, const Eigen::Vector3f& eye,
                    const Work& work) {
  if (surface.triangles.empty()) return field;
  const RayCaster rays(surface);
  Eigen::AlignedBox3f box;
  for (const auto& triangle : surface.triangles)
    for (const uint32_t v : triangle) box.extend(surface.positions[v]);
  // Of what lies behind the surface only a little is filled: other parts lie there.
  constexpr float fill_m = 0.006F, no_fill_m = 0.012F;
  const auto trust_in = [](float distance) { return distance >= 0 ? 1 : smooth_step(-no_fill_m, -fill_m, distance); };
  const std::vector<Eigen::Vector3f> normals = vertex_normals(surface);
  const NearestVertex nearest(surface.positions);
  const auto along_normal = [&](const Eigen::Vector3f& p, float before) {
    const auto v = nearest(p);
    if (!v) return before;
    const float distance = (p - surface.positions[*v]).dot(normals[*v]);
    return before + weight[*v] * trust_in(distance) * (distance - before);
  };
  return rewrite(
      field, box, eye,
      [&](const Eigen::Vector3f& p, float before) {
        const float far = (p - eye).norm();
        const Eigen::Vector3f way = (p - eye) / far;
        const auto hit = rays.cast(eye, way, 0, std::numeric_limits<float>::infinity());
        if (!hit) return along_normal(p, before);
        const auto& [a, b, c] = surface.triangles[hit->triangle];
        const Eigen::Vector3f &pa = surface.positions[a], &pb = surface.positions[b], &pc = surface.positions[c];
        const Eigen::Vector3f normal = (pb - pa).cross(pc - pa);
        const Eigen::Vector3f at = eye + hit->distance_m * way;
        const float whole = normal.squaredNorm();
        const float wb = (pc - pa).cross(pa - at).dot(normal) / whole,
                    wc = (pa - at).cross(pb - pa).dot(normal) / whole;
        const float share = (1 - wb - wc) * weight[a] + wb * weight[b] + wc * weight[c];
        const float slant = -way.dot(normal) / std::sqrt(whole);
        // Where sight grazes the surface, its depth says little about how far it is.
        constexpr float grazing = 0.4F, facing = 0.7F;
        const float facing_share = smooth_step(grazing, facing, slant);
        const float distance = (hit->distance_m - far) * slant;
        const float by_sight = before + share * trust_in(distance) * (distance - before);
        return facing_share >= 1 ? by_sight : facing_share * by_sight + (1 - facing_share) * along_normal(p, before);
      },
      work);
}

}  // namespace booth
