#include "pipeline/geometry/interior.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace booth {
namespace {

constexpr int margin = 2;  // empty voxels around the body, so that neighbours always exist

/// Which side of the line through two vertices a point is on, the same answer from both triangles of an edge.
bool left_of(const Eigen::Vector2d& a, const Eigen::Vector2d& b, uint32_t index_a, uint32_t index_b,
             const Eigen::Vector2d& p) {
  const bool swapped = index_b < index_a;
  const Eigen::Vector2d& first = swapped ? b : a;
  const Eigen::Vector2d& second = swapped ? a : b;
  const double cross = (second.x() - first.x()) * (p.y() - first.y()) - (second.y() - first.y()) * (p.x() - first.x());
  return swapped ? !(cross >= 0) : cross >= 0;
}

struct Crossing {
  uint32_t column;
  float z;
  int turn;  // change of the winding number on the way towards +z
};

/// Where the columns of samples along z pass through the surface.
std::vector<Crossing> column_crossings(const Mesh& mesh, const Grid& grid) {
  std::vector<Crossing> crossings;
  crossings.reserve(4 * mesh.triangles.size());
  for (const auto& t : mesh.triangles) {
    std::array<Eigen::Vector3d, 3> corner;
    std::array<Eigen::Vector2d, 3> flat;
    for (size_t c = 0; c < 3; ++c) {
      corner[c] = mesh.positions[t[c]].cast<double>();
      flat[c] = corner[c].head<2>();
    }
    const Eigen::Vector3d normal = (corner[1] - corner[0]).cross(corner[2] - corner[0]);
    if (normal.z() == 0) continue;
    const bool left = normal.z() > 0;
    const auto first = [&](double low, int axis) {
      return std::max(0, static_cast<int>(std::ceil((low - grid.origin[axis]) / grid.voxel_m)));
    };
    const auto last = [&](double high, int axis) {
      return std::min(grid.size[static_cast<size_t>(axis)] - 1,
                      static_cast<int>(std::floor((high - grid.origin[axis]) / grid.voxel_m)));
    };
    const Eigen::Vector2d low = flat[0].cwiseMin(flat[1]).cwiseMin(flat[2]);
    const Eigen::Vector2d high = flat[0].cwiseMax(flat[1]).cwiseMax(flat[2]);
    for (int j = first(low.y(), 1); j <= last(high.y(), 1); ++j)
      for (int i = first(low.x(), 0); i <= last(high.x(), 0); ++i) {
        const Eigen::Vector2d p = grid.point(i, j, 0).head<2>();
        if (left_of(flat[0], flat[1], t[0], t[1], p) != left || left_of(flat[1], flat[2], t[1], t[2], p) != left ||
            left_of(flat[2], flat[0], t[2], t[0], p) != left)
          continue;
        const double z = corner[0].z() - normal.head<2>().dot(p - flat[0]) / normal.z();
        crossings.push_back({static_cast<uint32_t>(j * grid.size[0] + i), static_cast<float>(z), left ? -1 : 1});
      }
  }
  std::sort(crossings.begin(), crossings.end(), [](const Crossing& a, const Crossing& b) {
    if (a.column != b.column) return a.column < b.column;
    return a.z != b.z ? a.z < b.z : a.turn > b.turn;
  });
  return crossings;
}

std::vector<uint8_t> fill_columns(const std::vector<Crossing>& crossings, const Grid& grid) {
  const size_t plane = static_cast<size_t>(grid.size[0]) * static_cast<size_t>(grid.size[1]);
  std::vector<uint8_t> solid(plane * static_cast<size_t>(grid.size[2]), 0);
  int winding = 0;
  for (size_t c = 0; c + 1 < crossings.size(); ++c) {
    winding += crossings[c].turn;
    if (crossings[c + 1].column != crossings[c].column) {
      winding = 0;
      continue;
    }
    if (winding == 0) continue;
    const auto slice = [&](float z) { return (static_cast<double>(z) - grid.origin.z()) / grid.voxel_m; };
    const int from = std::max(0, static_cast<int>(std::ceil(slice(crossings[c].z))));
    const int to = std::min(grid.size[2] - 1, static_cast<int>(std::floor(slice(crossings[c + 1].z))));
    for (int k = from; k <= to; ++k) solid[static_cast<size_t>(k) * plane + crossings[c].column] = 1;
  }
  return solid;
}

/// The 26 neighbours of a voxel: offsets of the index, and the way there in tenths of a voxel.
struct Neighbours {
  std::array<std::ptrdiff_t, 26> offset{};
  std::array<uint32_t, 26> steps{};

  explicit Neighbours(const Interior& interior) {
    size_t n = 0;
    for (int k = -1; k <= 1; ++k)
      for (int j = -1; j <= 1; ++j)
        for (int i = -1; i <= 1; ++i) {
          if (i == 0 && j == 0 && k == 0) continue;
          offset[n] = (static_cast<std::ptrdiff_t>(k) * interior.grid.size[1] + j) * interior.grid.size[0] + i;
          steps[n++] =
              std::array<uint32_t, 4>{0, 10, 14, 17}[static_cast<size_t>(std::abs(i) + std::abs(j) + std::abs(k))];
        }
  }
};

/// Clears all but the largest connected part.
void keep_largest_part(const Interior& interior, std::vector<uint8_t>& solid) {
  const Neighbours neighbours(interior);
  std::vector<uint32_t> best, part;
  for (size_t seed = 0; seed < solid.size(); ++seed) {
    if (solid[seed] != 1) continue;
    part.assign(1, static_cast<uint32_t>(seed));
    solid[seed] = 2;
    for (size_t next = 0; next < part.size(); ++next)
      for (const std::ptrdiff_t offset : neighbours.offset) {
        const size_t at = part[next] + static_cast<size_t>(offset);
        if (solid[at] != 1) continue;
        solid[at] = 2;
        part.push_back(static_cast<uint32_t>(at));
      }
    if (part.size() > best.size()) best.swap(part);
  }
  std::fill(solid.begin(), solid.end(), uint8_t{0});
  for (const uint32_t at : best) solid[at] = 1;
}

/// Lower envelope of the parabolas that stand on f (Felzenszwalb and Huttenlocher, algorithm DT), squared distances.
class ParabolaEnvelope {
 public:
  explicit ParabolaEnvelope(int longest)
      : f_(static_cast<size_t>(longest)),
        vertex_(static_cast<size_t>(longest)),
        from_(static_cast<size_t>(longest) + 1) {}

  void transform(float* values, int count, std::ptrdiff_t stride) {
    constexpr float infinity = std::numeric_limits<float>::infinity();
    for (int q = 0; q < count; ++q) f_[static_cast<size_t>(q)] = values[q * stride];
    int k = -1;
    for (int q = 0; q < count; ++q) {
      const float fq = f_[static_cast<size_t>(q)] + static_cast<float>(q * q);
      if (f_[static_cast<size_t>(q)] == infinity) continue;
      float start = -infinity;
      while (k >= 0) {
        const int v = vertex_[static_cast<size_t>(k)];
        start = (fq - f_[static_cast<size_t>(v)] - static_cast<float>(v * v)) / static_cast<float>(2 * (q - v));
        if (start > from_[static_cast<size_t>(k)]) break;
        --k;
        start = -infinity;
      }
      ++k;
      vertex_[static_cast<size_t>(k)] = q;
      from_[static_cast<size_t>(k)] = start;
      from_[static_cast<size_t>(k) + 1] = infinity;
    }
    if (k < 0) return;
    size_t at = 0;
    for (int q = 0; q < count; ++q) {
      while (from_[at + 1] < static_cast<float>(q)) ++at;
      const int v = vertex_[at];
      values[q * stride] = static_cast<float>((q - v) * (q - v)) + f_[static_cast<size_t>(v)];
    }
  }

 private:
  std::vector<float> f_;
  std::vector<int> vertex_;
  std::vector<float> from_;
};

std::vector<float> depths(const Grid& grid, const std::vector<uint8_t>& solid) {
  std::vector<float> depth(solid.size());
  for (size_t v = 0; v < solid.size(); ++v) depth[v] = solid[v] != 0 ? std::numeric_limits<float>::infinity() : 0.0F;
  const auto [nx, ny, nz] = grid.size;
  const std::ptrdiff_t row = nx, plane = static_cast<std::ptrdiff_t>(nx) * ny;
  ParabolaEnvelope envelope(std::max({nx, ny, nz}));
  for (int k = 0; k < nz; ++k)
    for (int j = 0; j < ny; ++j) envelope.transform(depth.data() + k * plane + j * row, nx, 1);
  for (int k = 0; k < nz; ++k)
    for (int i = 0; i < nx; ++i) envelope.transform(depth.data() + k * plane + i, ny, row);
  for (int j = 0; j < ny; ++j)
    for (int i = 0; i < nx; ++i) envelope.transform(depth.data() + j * row + i, nz, plane);
  // The surface lies about half a voxel short of the first sample outside.
  for (float& d : depth)
    if (d > 0) d = static_cast<float>(grid.voxel_m) * (std::sqrt(d) - 0.5F);
  return depth;
}

/// Union-find over voxels that are added one by one; a part remembers its first voxel.
class Parts {
 public:
  explicit Parts(size_t voxels) : parent_(voxels, none) {}
  static constexpr uint32_t none = UINT32_MAX;

  bool has(size_t v) const { return parent_[v] != none; }
  void add(uint32_t v) { parent_[v] = v; }
  void join(uint32_t root, uint32_t into) { parent_[root] = into; }
  uint32_t root(uint32_t v) {
    while (parent_[v] != v) v = parent_[v] = parent_[parent_[v]];
    return v;
  }

 private:
  std::vector<uint32_t> parent_;
};

/// Voxels inside, farthest from the source first; equal ones by index. A counting sort, as distances are small numbers.
std::vector<uint32_t> farthest_first(const Interior& interior, const Geodesics& geodesics) {
  uint32_t farthest = 0;
  for (const uint32_t v : interior.inside)
    if (geodesics.steps[v] != Geodesics::unreached) farthest = std::max(farthest, geodesics.steps[v]);
  const auto rank = [&](uint32_t v) { return farthest + 1 - std::min(geodesics.steps[v], farthest + 1); };
  std::vector<uint32_t> begin(size_t{farthest} + 3, 0);
  for (const uint32_t v : interior.inside) ++begin[rank(v) + 1];
  std::partial_sum(begin.begin(), begin.end(), begin.begin());
  std::vector<uint32_t> order(interior.inside.size());
  for (const uint32_t v : interior.inside) order[begin[rank(v)]++] = v;
  return order;
}

}  // namespace

std::array<int, 3> Interior::cell(size_t index_) const {
  const size_t nx = static_cast<size_t>(grid.size[0]), ny = static_cast<size_t>(grid.size[1]);
  return {static_cast<int>(index_ % nx), static_cast<int>(index_ / nx % ny), static_cast<int>(index_ / (nx * ny))};
}

Eigen::Vector3d Interior::point(size_t index_) const {
  const auto [i, j, k] = cell(index_);
  return grid.point(i, j, k);
}

double Interior::depth(const Eigen::Vector3d& p) const {
  const Eigen::Vector3d at = (p - grid.origin) / grid.voxel_m;
  std::array<int, 3> base{};
  for (size_t axis = 0; axis < 3; ++axis) {
    const double floor = std::floor(at[static_cast<int>(axis)]);
    if (!(floor >= 0 && floor < grid.size[axis] - 1)) return 0;
    base[axis] = static_cast<int>(floor);
  }
  const Eigen::Vector3d t = at - Eigen::Vector3d(base[0], base[1], base[2]);
  double sum = 0;
  for (int corner = 0; corner < 8; ++corner) {
    const int i = corner & 1, j = corner >> 1 & 1, k = corner >> 2;
    const double weight = (i != 0 ? t.x() : 1 - t.x()) * (j != 0 ? t.y() : 1 - t.y()) * (k != 0 ? t.z() : 1 - t.z());
    sum += weight * static_cast<double>(depth_m[index(base[0] + i, base[1] + j, base[2] + k)]);
  }
  return sum;
}

Interior sample_interior(const Mesh& mesh, int cells) {
  Eigen::AlignedBox3d box;
  for (const auto& t : mesh.triangles)
    for (const uint32_t v : t) box.extend(mesh.positions[v].cast<double>());
  Interior interior;
  Grid& grid = interior.grid;
  // Samples lie symmetrically about the box's middle, so that the mirrored mesh has the mirrored voxels.
  if (box.isEmpty() || !(box.sizes().maxCoeff() > 0)) return interior;
  grid.voxel_m = std::max({box.sizes().y(), 0.5 * box.sizes().x(), box.sizes().z()}) / cells;
  for (int axis = 0; axis < 3; ++axis) {
    const int half = static_cast<int>(std::ceil(0.5 * box.sizes()[axis] / grid.voxel_m)) + margin;
    grid.size[static_cast<size_t>(axis)] = 2 * half + 1;
    grid.origin[axis] = box.center()[axis] - half * grid.voxel_m;
  }
  std::vector<uint8_t> solid = fill_columns(column_crossings(mesh, grid), grid);
  keep_largest_part(interior, solid);
  interior.depth_m = depths(grid, solid);
  for (size_t v = 0; v < solid.size(); ++v)
    if (solid[v] != 0) interior.inside.push_back(static_cast<uint32_t>(v));
  return interior;
}

Geodesics geodesics_from(const Interior& interior, std::span<const GeodesicSource> sources) {
  const Neighbours neighbours(interior);
  Geodesics result;
  result.steps.assign(interior.depth_m.size(), Geodesics::unreached);
  result.origin.assign(interior.depth_m.size(), 0);
  // A ring of buckets: longer than the longest step and the latest start, so that no two distances share a bucket.
  uint32_t latest = 0;
  for (const GeodesicSource& source : sources) latest = std::max(latest, source.start);
  std::vector<std::vector<uint32_t>> ring(latest + 18);
  const auto reach = [&](size_t voxel, uint32_t steps, uint32_t origin) {
    if (interior.depth_m[voxel] <= 0 || steps >= result.steps[voxel]) return;
    result.steps[voxel] = steps;
    result.origin[voxel] = origin;
    ring[steps % ring.size()].push_back(static_cast<uint32_t>(voxel));
  };
  for (size_t s = 0; s < sources.size(); ++s) reach(sources[s].voxel, sources[s].start, static_cast<uint32_t>(s));
  for (uint32_t now = 0, idle = 0; idle < ring.size(); ++now) {
    std::vector<uint32_t>& bucket = ring[now % ring.size()];
    idle = bucket.empty() ? idle + 1 : 0;
    for (const uint32_t at : bucket) {
      if (result.steps[at] != now) continue;
      for (size_t n = 0; n < neighbours.offset.size(); ++n)
        reach(at + static_cast<size_t>(neighbours.offset[n]), now + neighbours.steps[n], result.origin[at]);
    }
    bucket.clear();
  }
  return result;
}

std::vector<Extremity> find_extremities(const Interior& interior, const Geodesics& geodesics,
                                        uint32_t min_persistence) {
  const Neighbours neighbours(interior);
  Parts parts(interior.depth_m.size());  // the root of a part is its tip, the first voxel of it
  std::vector<Extremity> found;
  const auto report = [&](uint32_t tip, uint32_t saddle) {
    const Extremity extremity{tip, geodesics.steps[tip], saddle};
    if (extremity.persistence() >= min_persistence) found.push_back(extremity);
  };
  const std::vector<uint32_t> order = farthest_first(interior, geodesics);
  for (const uint32_t v : order) {
    parts.add(v);
    for (const std::ptrdiff_t offset : neighbours.offset) {
      const size_t other = v + static_cast<size_t>(offset);
      if (!parts.has(other)) continue;
      uint32_t a = parts.root(v), b = parts.root(static_cast<uint32_t>(other));
      if (a == b) continue;
      if (geodesics.steps[a] < geodesics.steps[b] || (geodesics.steps[a] == geodesics.steps[b] && a > b))
        std::swap(a, b);
      if (b != v) report(b, geodesics.steps[v]);
      parts.join(b, a);
    }
  }
  if (!order.empty()) report(order.front(), 0);
  std::sort(found.begin(), found.end(), [](const Extremity& a, const Extremity& b) {
    return a.tip_steps != b.tip_steps ? a.tip_steps > b.tip_steps : a.tip < b.tip;
  });
  return found;
}

std::vector<std::vector<uint32_t>> limbs_of(const Interior& interior, const Geodesics& geodesics,
                                            const std::vector<size_t>& tips) {
  const Neighbours neighbours(interior);
  constexpr int nobody = -1, shared = -2;
  Parts parts(interior.depth_m.size());
  std::vector<int> owner(interior.depth_m.size(), nobody);  // by a part's root
  std::vector<uint32_t> met(tips.size(), 0);                // at which distance a limb meets another
  for (const uint32_t v : farthest_first(interior, geodesics)) {
    parts.add(v);
    for (size_t t = 0; t < tips.size(); ++t)
      if (tips[t] == v) owner[v] = static_cast<int>(t);
    for (const std::ptrdiff_t offset : neighbours.offset) {
      const size_t other = v + static_cast<size_t>(offset);
      if (!parts.has(other)) continue;
      const uint32_t a = parts.root(v), b = parts.root(static_cast<uint32_t>(other));
      if (a == b) continue;
      int merged = owner[a] == nobody ? owner[b] : owner[a];
      if (owner[a] != nobody && owner[b] != nobody) {
        for (const int o : {owner[a], owner[b]})
          if (o >= 0) met[static_cast<size_t>(o)] = geodesics.steps[v];
        merged = shared;
      }
      parts.join(a, b);
      owner[b] = merged;
    }
  }
  // What hangs together above the meeting distance and holds the tip.
  std::vector<std::vector<uint32_t>> members(tips.size());
  std::vector<uint8_t> seen(interior.depth_m.size(), 0);
  for (size_t t = 0; t < tips.size(); ++t) {
    std::vector<uint32_t>& limb = members[t];
    limb.assign(1, static_cast<uint32_t>(tips[t]));
    seen[tips[t]] = 1;
    for (size_t next = 0; next < limb.size(); ++next)
      for (const std::ptrdiff_t offset : neighbours.offset) {
        const size_t at = limb[next] + static_cast<size_t>(offset);
        if (interior.depth_m[at] <= 0 || seen[at] != 0 || geodesics.steps[at] <= met[t]) continue;
        seen[at] = 1;
        limb.push_back(static_cast<uint32_t>(at));
      }
    std::sort(limb.begin(), limb.end(), [&](uint32_t a, uint32_t b) {
      return geodesics.steps[a] != geodesics.steps[b] ? geodesics.steps[a] > geodesics.steps[b] : a < b;
    });
  }
  return members;
}

}  // namespace booth
