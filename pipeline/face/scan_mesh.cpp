#include "pipeline/face/scan_mesh.h"

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

namespace booth {
namespace {

constexpr uint32_t none = std::numeric_limits<uint32_t>::max();
constexpr size_t row_grain = 8;

/// A plane through the neighbours, robust against the few that belong to another surface; the point goes onto it.
/// Removes points that stand off.
void average_noise(const RangeScan& scan, const ScanMeshOptions& options, const Work& work, RangeScan* out) {
  const int radius = options.smoothing_radius;
  const float gap = static_cast<float>(options.most_gap_m);
  const float spread = 0.5F * static_cast<float>(radius);
  const int side = 2 * radius + 1;
  std::vector<float> kernel(static_cast<size_t>(side * side));
  for (int v = -radius; v <= radius; ++v)
    for (int u = -radius; u <= radius; ++u)
      kernel[static_cast<size_t>((v + radius) * side + u + radius)] =
          std::exp(-0.5F * static_cast<float>(u * u + v * v) / (spread * spread));
  work.parallel_for(static_cast<size_t>(scan.height), row_grain, [&](size_t begin, size_t end) {
    for (int y = static_cast<int>(begin); y < static_cast<int>(end); ++y)
      for (int x = 0; x < scan.width; ++x) {
        const size_t i = scan.index(x, y);
        if (!scan.measured(i)) continue;
        const Eigen::Vector3f own = scan.points[i];
        float sum = 0;
        Eigen::Vector3f mean = Eigen::Vector3f::Zero();
        Eigen::Matrix3f second = Eigen::Matrix3f::Zero();
        int around = 0, window = 0;
        for (int v = std::max(-radius, -y); v <= radius && y + v < scan.height; ++v)
          for (int u = std::max(-radius, -x); u <= radius && x + u < scan.width; ++u) {
            ++window;
            const size_t j = scan.index(x + u, y + v);
            if (!scan.measured(j)) continue;
            const Eigen::Vector3f step = scan.points[j] - own;
            if (step.squaredNorm() > gap * gap) continue;
            ++around;
            const float w =
                kernel[static_cast<size_t>((v + radius) * side + u + radius)] / (scan.sigma_m[j] * scan.sigma_m[j]);
            sum += w;
            mean += w * step;
            second += w * step * step.transpose();
          }
        constexpr float least_share = 0.3F;  // a corner of a surface has a quarter of a window and some more
        if (static_cast<float>(around) < least_share * static_cast<float>(window)) continue;
        mean /= sum;
        second = second / sum - mean * mean.transpose();
        Eigen::SelfAdjointEigenSolver<Eigen::Matrix3f> eigen;
        eigen.computeDirect(second);
        const Eigen::Vector3f normal = eigen.eigenvectors().col(0);
        const float off = normal.dot(mean);
        constexpr float most_off_m = 0.002F;
        if (!(std::abs(off) < most_off_m)) continue;
        out->points[i] = own + off * normal;
        out->sigma_m[i] = scan.sigma_m[i];
      }
  });
}

/// Drops what is narrower than a square of points, such as the lace that grazing light leaves at the sides of a head: a
/// point stays where it lies in a square that is measured but for a few points (an opening of the grid).
void drop_narrow(int side, RangeScan* scan) {
  const int width = scan->width, height = scan->height;
  if (side < 2 || width < side || height < side) return;
  // Sums over the rectangle before each point.
  const auto at = [&](int x, int y) {
    return static_cast<size_t>(y) * static_cast<size_t>(width + 1) + static_cast<size_t>(x);
  };
  const size_t size = static_cast<size_t>(width + 1) * static_cast<size_t>(height + 1);
  const auto sums_of = [&](const auto& value) {
    std::vector<int> sums(size, 0);
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x)
        sums[at(x + 1, y + 1)] = value(x, y) + sums[at(x, y + 1)] + sums[at(x + 1, y)] - sums[at(x, y)];
    return sums;
  };
  const auto in_square = [&](const std::vector<int>& sums, int x, int y) {
    const int x0 = std::max(x, 0), y0 = std::max(y, 0), x1 = std::min(x + side, width), y1 = std::min(y + side, height);
    return sums[at(x1, y1)] - sums[at(x0, y1)] - sums[at(x1, y0)] + sums[at(x0, y0)];
  };
  const std::vector<int> measured = sums_of([&](int x, int y) { return scan->measured(scan->index(x, y)) ? 1 : 0; });
  constexpr double least_share = 0.95;
  const int least = static_cast<int>(std::ceil(least_share * side * side));
  const std::vector<int> full = sums_of([&](int x, int y) {
    return x + side <= width && y + side <= height && in_square(measured, x, y) >= least ? 1 : 0;
  });
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      if (in_square(full, x - side + 1, y - side + 1) == 0)
        scan->points[scan->index(x, y)].setConstant(std::numeric_limits<float>::quiet_NaN());
}

/// Joins the two sides of narrow gaps in the grid's rows and columns, as they lie between a near surface and a far one.
/// Points that it adds have an infinite sigma.
void close_gaps(RangeScan* scan) {
  constexpr int widest = 8;  // points
  const RangeScan before = *scan;
  const auto along = [&](int count, const auto& index_of) {
    int last = -1;
    for (int i = 0; i < count; ++i) {
      if (!before.measured(index_of(i))) continue;
      const int gap = last < 0 ? 0 : i - last;
      if (gap > 1 && gap <= widest) {
        const Eigen::Vector3f &a = before.points[index_of(last)], &b = before.points[index_of(i)];
        for (int k = 1; k < gap; ++k)
          if (!scan->measured(index_of(last + k)))
            scan->points[index_of(last + k)] = a + (b - a) * (static_cast<float>(k) / static_cast<float>(gap));
      }
      last = i;
    }
  };
  for (int y = 0; y < scan->height; ++y) along(scan->width, [&](int x) { return scan->index(x, y); });
  for (int x = 0; x < scan->width; ++x) along(scan->height, [&](int y) { return scan->index(x, y); });
}

/// Fills regions of the grid without points that do not reach its border and whose surroundings are no farther apart
/// than `largest_m`. Points that it adds have an infinite sigma.
void close_holes(double largest_m, RangeScan* scan) {
  const int width = scan->width;
  std::vector<uint8_t> seen(scan->points.size(), 0);
  const std::array<int, 4> steps{-1, 1, -width, width};
  std::vector<size_t> hole;
  for (size_t start = 0; start < seen.size(); ++start) {
    if (seen[start] != 0 || scan->measured(start)) continue;
    hole.assign(1, start);
    seen[start] = 1;
    bool open = false;
    Eigen::AlignedBox3f around;
    for (size_t h = 0; h < hole.size(); ++h) {
      const int x = static_cast<int>(hole[h]) % width, y = static_cast<int>(hole[h]) / width;
      if (x == 0 || y == 0 || x + 1 == width || y + 1 == scan->height) {
        open = true;
        continue;
      }
      for (const int step : steps) {
        const size_t n = hole[h] + static_cast<size_t>(step);
        if (scan->measured(n))
          around.extend(scan->points[n]);
        else if (seen[n] == 0) {
          seen[n] = 1;
          hole.push_back(n);
        }
      }
    }
    if (open || around.isEmpty() || around.diagonal().norm() > static_cast<float>(largest_m)) continue;
    // Gauss–Seidel over a few dozen points; from the middle of what lies around.
    constexpr int sweeps = 60;
    for (const size_t h : hole) scan->points[h] = around.center();
    for (int sweep = 0; sweep < sweeps; ++sweep)
      for (const size_t h : hole) {
        Eigen::Vector3f sum = Eigen::Vector3f::Zero();
        for (const int step : steps) sum += scan->points[h + static_cast<size_t>(step)];
        scan->points[h] = 0.25F * sum;
      }
  }
}

/// Distances of the vertices from the grid's unmeasured points, by two chamfer passes over the grid, metres.
std::vector<float> distances_from_rim(const RangeScan& scan) {
  constexpr float farthest_m = 0.05F;
  std::vector<float> distance(scan.points.size());
  for (size_t i = 0; i < distance.size(); ++i) distance[i] = scan.measured(i) ? farthest_m : 0;
  const auto relax = [&](int x, int y, int u, int v) {
    if (u < 0 || v < 0 || u >= scan.width || v >= scan.height) return;
    const size_t i = scan.index(x, y), j = scan.index(u, v);
    if (!scan.measured(i)) return;
    const float step = scan.measured(j) ? (scan.points[i] - scan.points[j]).norm() : 0.0F;
    distance[i] = std::min(distance[i], distance[j] + step);
  };
  for (int y = 0; y < scan.height; ++y)
    for (int x = 0; x < scan.width; ++x)
      for (const auto& [u, v] : {std::pair{-1, 0}, {0, -1}, {-1, -1}, {1, -1}}) relax(x, y, x + u, y + v);
  for (int y = scan.height - 1; y >= 0; --y)
    for (int x = scan.width - 1; x >= 0; --x)
      for (const auto& [u, v] : {std::pair{1, 0}, {0, 1}, {1, 1}, {-1, 1}}) relax(x, y, x + u, y + v);
  return distance;
}

/// Triangle indices of the grid's quads, by the shorter diagonal, where no side is too long.
Mesh join_neighbours(const RangeScan& scan, float gap, std::vector<uint32_t>* source) {
  Mesh mesh;
  std::vector<uint32_t> vertex(scan.points.size(), none);
  for (size_t i = 0; i < scan.points.size(); ++i)
    if (scan.measured(i)) {
      vertex[i] = static_cast<uint32_t>(mesh.positions.size());
      mesh.positions.push_back(scan.points[i]);
      source->push_back(static_cast<uint32_t>(i));
    }
  const auto add = [&](size_t a, size_t b, size_t c) {
    if (vertex[a] == none || vertex[b] == none || vertex[c] == none) return;
    const auto& p = scan.points;
    const float longest2 =
        std::max({(p[a] - p[b]).squaredNorm(), (p[b] - p[c]).squaredNorm(), (p[c] - p[a]).squaredNorm()});
    if (longest2 <= gap * gap) mesh.triangles.push_back({vertex[a], vertex[b], vertex[c]});
  };
  for (int y = 0; y + 1 < scan.height; ++y)
    for (int x = 0; x + 1 < scan.width; ++x) {
      const size_t a = scan.index(x, y), b = a + 1, c = scan.index(x, y + 1), d = c + 1;
      const bool other =
          !scan.measured(a) || !scan.measured(d) ||
          (scan.measured(b) && scan.measured(c) &&
           (scan.points[b] - scan.points[c]).squaredNorm() < (scan.points[a] - scan.points[d]).squaredNorm());
      if (other) {
        add(a, b, c);
        add(b, d, c);
      } else {
        add(a, b, d);
        add(a, d, c);
      }
    }
  return mesh;
}

float area_of(const Mesh& mesh, const std::array<uint32_t, 3>& t) {
  const Eigen::Vector3f& a = mesh.positions[t[0]];
  return 0.5F * (mesh.positions[t[1]] - a).cross(mesh.positions[t[2]] - a).norm();
}

void remove_strays(Mesh* mesh, double smallest_m2) {
  std::vector<uint32_t> parent(mesh->positions.size());
  for (uint32_t v = 0; v < parent.size(); ++v) parent[v] = v;
  const auto find = [&](uint32_t v) {
    while (parent[v] != v) v = parent[v] = parent[parent[v]];
    return v;
  };
  for (const auto& [a, b, c] : mesh->triangles) {
    parent[find(b)] = find(a);
    parent[find(c)] = find(a);
  }
  std::vector<double> area(mesh->positions.size(), 0);
  for (const auto& t : mesh->triangles) area[find(t[0])] += area_of(*mesh, t);
  std::erase_if(mesh->triangles, [&](const auto& t) { return area[find(t[0])] < smallest_m2; });
}

/// 0 at the mesh's rims, growing by one with every ring of triangles, up to `most`.
std::vector<int> rings_from_rim(const Mesh& mesh, int most) {
  // A vertex inside has as many triangles as neighbours; one at a rim has one neighbour more.
  std::vector<std::pair<uint32_t, uint32_t>> sides;
  sides.reserve(mesh.triangles.size() * 3);
  for (const auto& t : mesh.triangles)
    for (size_t k = 0; k < 3; ++k) {
      const auto [low, high] = std::minmax(t[k], t[(k + 1) % 3]);
      sides.emplace_back(low, high);
    }
  std::sort(sides.begin(), sides.end());
  std::vector<int> rings(mesh.positions.size(), most);
  for (size_t i = 0; i < sides.size(); ++i) {
    const bool alone = (i == 0 || sides[i - 1] != sides[i]) && (i + 1 == sides.size() || sides[i + 1] != sides[i]);
    if (alone) rings[sides[i].first] = rings[sides[i].second] = 0;
  }
  for (int ring = 0; ring + 1 < most; ++ring)
    for (const auto& t : mesh.triangles)
      if (rings[t[0]] == ring || rings[t[1]] == ring || rings[t[2]] == ring)
        for (const uint32_t v : t) rings[v] = std::min(rings[v], ring + 1);
  return rings;
}

}  // namespace

Result<ScanMesh> mesh_scan(const RangeScan& scan, const ScanMeshOptions& options, const Work& work) {
  RangeScan smooth(scan.width, scan.height);
  if (options.smoothing_radius > 0)
    average_noise(scan, options, work, &smooth);
  else
    smooth = scan;
  if (work.stopped()) return Work::cancelled();
  drop_narrow(options.narrowest, &smooth);
  close_gaps(&smooth);
  close_holes(options.largest_hole_m, &smooth);
  std::vector<uint32_t> source;
  ScanMesh out;
  out.mesh = join_neighbours(smooth, static_cast<float>(options.most_gap_m), &source);
  remove_strays(&out.mesh, options.smallest_region_m2);

  constexpr int rim_rings = 3;  // positions at a rim mix two surfaces
  const std::vector<int> rings = rings_from_rim(out.mesh, rim_rings);
  constexpr float usual_sigma_m = 2e-4F;
  const std::vector<float> rim = distances_from_rim(smooth);
  for (const uint32_t i : source) out.rim_m.push_back(rim[i]);
  out.confidence.resize(out.mesh.positions.size());
  for (size_t v = 0; v < out.confidence.size(); ++v) {
    const float ratio = smooth.sigma_m[source[v]] / usual_sigma_m;
    out.confidence[v] = static_cast<float>(rings[v]) / rim_rings / (1 + ratio * ratio);
  }
  return out;
}

}  // namespace booth
