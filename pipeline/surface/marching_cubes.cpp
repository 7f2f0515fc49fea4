#include "pipeline/surface/marching_cubes.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

namespace booth {
namespace {

// Corner c of a cell lies at (c & 1, c >> 1 & 1, c >> 2 & 1). Edge e runs along axis e / 4 from the corner
// edge_start(e); the vertex on it belongs to the sample at that corner, so that cells around it find the same one.
constexpr int corners_per_cell = 8;
constexpr int edges_per_cell = 12;

constexpr int edge_start(int edge) {
  const int axis = edge / 4, low = edge & 1, high = edge >> 1 & 1;
  return axis == 0 ? low << 1 | high << 2 : axis == 1 ? low | high << 2 : low | high << 1;
}
constexpr int edge_end(int edge) { return edge_start(edge) | 1 << edge / 4; }

int edge_between(int a, int b) {
  for (int edge = 0; edge < edges_per_cell; ++edge)
    if ((edge_start(edge) == a && edge_end(edge) == b) || (edge_start(edge) == b && edge_end(edge) == a)) return edge;
  return -1;
}

/// The corners of each face, counter-clockwise seen from outside the cell.
constexpr int faces[6][4] = {{0, 4, 6, 2}, {1, 3, 7, 5}, {0, 1, 5, 4}, {2, 6, 7, 3}, {0, 2, 3, 1}, {4, 5, 7, 6}};

bool on_one_face(int edge_a, int edge_b) {
  const auto holds = [](const int* face, int edge) {
    return std::count(face, face + 4, edge_start(edge)) + std::count(face, face + 4, edge_end(edge)) == 2;
  };
  return std::any_of(std::begin(faces), std::end(faces),
                     [&](const int* face) { return holds(face, edge_a) && holds(face, edge_b); });
}

/// Triangles of one of the 256 sign patterns, as triples of vertex slots: a cell's edges 0 … 11, then the centres of
/// its loops from 12 on.
struct CellCase {
  std::vector<std::array<uint8_t, 3>> triangles;
  std::vector<std::vector<uint8_t>> centred_loops;  ///< loops that need a vertex in their middle
};

/// Triangulates loop[first … last] without a diagonal inside a face of the cell; false when there is none.
bool triangulate(const std::vector<uint8_t>& loop, size_t first, size_t last,
                 std::vector<std::array<uint8_t, 3>>& triangles) {
  if (last - first < 2) return true;
  const auto allowed = [&](size_t a, size_t b) { return b - a == 1 || !on_one_face(loop[a], loop[b]); };
  const size_t kept = triangles.size();
  for (size_t apex = first + 1; apex < last; ++apex) {
    if (!allowed(first, apex) || !allowed(apex, last)) continue;
    triangles.push_back({loop[first], loop[apex], loop[last]});
    if (triangulate(loop, first, apex, triangles) && triangulate(loop, apex, last, triangles)) return true;
    triangles.resize(kept);
  }
  return false;
}

/// The surface inside a cell, by a rule that neighbours agree on: on every face, each run of inside corners is cut off
/// by a segment of its own (so inside corners that touch over a face's diagonal only stay apart). The segments of
/// the six faces link up to closed loops around the cell.
CellCase make_case(int inside_corners) {
  const auto inside = [&](int corner) { return (inside_corners >> corner & 1) != 0; };
  std::array<int, edges_per_cell> next;
  next.fill(-1);
  for (const auto& face : faces)
    for (int k = 0; k < 4; ++k) {
      if (inside(face[k]) || !inside(face[(k + 1) % 4])) continue;
      int last = k + 1;
      while (inside(face[(last + 1) % 4])) ++last;
      next[static_cast<size_t>(edge_between(face[k], face[(k + 1) % 4]))] =
          edge_between(face[last % 4], face[(last + 1) % 4]);
    }
  CellCase result;
  std::array<bool, edges_per_cell> done{};
  for (size_t start = 0; start < edges_per_cell; ++start) {
    if (next[start] < 0 || done[start]) continue;
    std::vector<uint8_t> loop;
    for (size_t edge = start; !done[edge]; edge = static_cast<size_t>(next[edge])) {
      done[edge] = true;
      loop.push_back(static_cast<uint8_t>(edge));
    }
    // A diagonal inside a face could be an edge of the neighbour as well, which would then have four triangles.
    if (triangulate(loop, 0, loop.size() - 1, result.triangles)) continue;
    const auto centre = static_cast<uint8_t>(edges_per_cell + result.centred_loops.size());
    for (size_t i = 0; i < loop.size(); ++i) result.triangles.push_back({loop[i], loop[(i + 1) % loop.size()], centre});
    result.centred_loops.push_back(loop);
  }
  return result;
}

const std::array<CellCase, 256>& cell_cases() {
  static const std::array<CellCase, 256> cases = [] {
    std::array<CellCase, 256> made;
    for (size_t i = 0; i < made.size(); ++i) made[i] = make_case(static_cast<int>(i));
    return made;
  }();
  return cases;
}

constexpr int side = Field::brick_side;
constexpr int reach = side + 1;  // samples along a brick's side with the first of the next brick

/// The samples of a brick and the first layer of the next ones, x fastest.
using Neighbourhood = std::array<float, static_cast<size_t>(reach) * reach * reach>;

/// Edges that cross the surface from a sample towards +x, +y, +z (bits 0 … 2) and, above them, how many vertices
/// the brick's earlier samples have.
using EdgeVertices = uint16_t;

struct BrickSurface {
  std::array<int, 3> place{};
  uint32_t first_vertex = 0, first_centre = 0, vertices = 0, centres = 0;
  size_t first_triangle = 0, triangles = 0;
  std::array<EdgeVertices, Field::samples_per_brick> edge_vertices{};
};

class Extraction {
 public:
  Extraction(const Field& field, const Work& work) : field_(field), work_(work), cases_(cell_cases()) {}

  Mesh run() {
    find_bricks();
    constexpr size_t grain = 16;
    work_.parallel_for(bricks_.size(), grain, [&](size_t begin, size_t end) {
      for (size_t b = begin; b < end; ++b) count(bricks_[b]);
    });
    uint32_t vertices = 0;
    size_t triangles = 0;
    for (BrickSurface& brick : bricks_) {
      brick.first_vertex = vertices;
      brick.first_centre = vertices + brick.vertices;
      brick.first_triangle = triangles;
      vertices += brick.vertices + brick.centres;
      triangles += brick.triangles;
    }
    mesh_.positions.resize(vertices);
    mesh_.triangles.resize(triangles);
    work_.parallel_for(bricks_.size(), grain, [&](size_t begin, size_t end) {
      for (size_t b = begin; b < end; ++b) place_vertices(bricks_[b]);
    });
    work_.parallel_for(bricks_.size(), grain, [&](size_t begin, size_t end) {
      for (size_t b = begin; b < end; ++b) place_triangles(bricks_[b]);
    });
    return std::move(mesh_);
  }

 private:
  bool exists(const std::array<int, 3>& place) const {
    return place[0] < field_.bricks()[0] && place[1] < field_.bricks()[1] && place[2] < field_.bricks()[2];
  }
  int32_t state(const std::array<int, 3>& place) const {
    return exists(place) ? field_.brick(field_.brick_index(place[0], place[1], place[2])) : Field::all_outside;
  }

  /// Lists the bricks that can hold a vertex: those that are stored, next to one, or where inside meets outside.
  void find_bricks() {
    const auto [nx, ny, nz] = field_.bricks();
    surface_of_.assign(static_cast<size_t>(nx) * static_cast<size_t>(ny) * static_cast<size_t>(nz), -1);
    for (int z = 0; z < nz; ++z)
      for (int y = 0; y < ny; ++y)
        for (int x = 0; x < nx; ++x) {
          const int32_t own = state({x, y, z});
          bool uniform = own < 0;
          // An inside brick in the grid's first layer is open there, unless its border is looked at.
          if (own == Field::all_inside && (x == 0 || y == 0 || z == 0)) uniform = false;
          for (int c = 1; c < corners_per_cell && uniform; ++c)
            uniform = state({x + (c & 1), y + (c >> 1 & 1), z + (c >> 2)}) == own;
          if (uniform) continue;
          surface_of_[field_.brick_index(x, y, z)] = static_cast<int32_t>(bricks_.size());
          bricks_.emplace_back().place = {x, y, z};
        }
  }

  /// Samples on or beyond the grid's border count as outside, so that the surface is closed whatever the field.
  Neighbourhood gather(const BrickSurface& brick) const {
    Neighbourhood values;
    const auto& size = field_.grid().size;
    for (int c = 0; c < corners_per_cell; ++c) {
      const std::array<int, 3> step{c & 1, c >> 1 & 1, c >> 2};
      const std::array<int, 3> place{brick.place[0] + step[0], brick.place[1] + step[1], brick.place[2] + step[2]};
      const int32_t block = state(place);
      const float* samples = block >= 0 ? field_.block(block) : nullptr;
      const float constant = block == Field::all_inside ? -1.0F : 1.0F;
      const auto count_along = [&](size_t axis) { return step[axis] == 0 ? side : 1; };
      for (int k = 0; k < count_along(2); ++k)
        for (int j = 0; j < count_along(1); ++j)
          for (int i = 0; i < count_along(0); ++i)
            values[at(i + step[0] * side, j + step[1] * side, k + step[2] * side)] =
                samples != nullptr ? samples[(k * side + j) * side + i] : constant;
    }
    for (size_t axis = 0; axis < 3; ++axis) {
      const int first = brick.place[axis] * side;
      if (first > 0 && first + reach < size[axis]) continue;
      for (int k = 0; k < reach; ++k)
        for (int j = 0; j < reach; ++j)
          for (int i = 0; i < reach; ++i) {
            const int along = first + (axis == 0 ? i : axis == 1 ? j : k);
            float& value = values[at(i, j, k)];
            if (along <= 0 || along >= size[axis] - 1) value = std::abs(value);
          }
    }
    return values;
  }

  static size_t at(int i, int j, int k) { return static_cast<size_t>((k * reach + j) * reach + i); }
  static bool is_inside(float value) { return value < 0; }
  static int sign_pattern(const Neighbourhood& values, int i, int j, int k) {
    int pattern = 0;
    for (int c = 0; c < corners_per_cell; ++c)
      pattern |= static_cast<int>(is_inside(values[at(i + (c & 1), j + (c >> 1 & 1), k + (c >> 2))])) << c;
    return pattern;
  }

  template <class Visitor>
  static void for_each_sample(const Visitor& visit) {
    for (int k = 0; k < side; ++k)
      for (int j = 0; j < side; ++j)
        for (int i = 0; i < side; ++i) visit(i, j, k);
  }

  void count(BrickSurface& brick) const {
    const Neighbourhood values = gather(brick);
    size_t sample = 0;
    for_each_sample([&](int i, int j, int k) {
      const bool inside = is_inside(values[at(i, j, k)]);
      unsigned crossings = 0;
      if (is_inside(values[at(i + 1, j, k)]) != inside) crossings |= 1U;
      if (is_inside(values[at(i, j + 1, k)]) != inside) crossings |= 2U;
      if (is_inside(values[at(i, j, k + 1)]) != inside) crossings |= 4U;
      brick.edge_vertices[sample++] = static_cast<EdgeVertices>(brick.vertices << 3 | crossings);
      brick.vertices += (crossings & 1U) + (crossings >> 1 & 1U) + (crossings >> 2);
      const CellCase& cell = cases_[static_cast<size_t>(sign_pattern(values, i, j, k))];
      brick.triangles += cell.triangles.size();
      brick.centres += static_cast<uint32_t>(cell.centred_loops.size());
    });
  }

  void place_vertices(const BrickSurface& brick) {
    if (brick.vertices == 0) return;
    const Neighbourhood values = gather(brick);
    const Grid& grid = field_.grid();
    uint32_t vertex = brick.first_vertex;
    size_t sample = 0;
    for_each_sample([&](int i, int j, int k) {
      const unsigned crossings = brick.edge_vertices[sample++] & 7U;
      for (int axis = 0; axis < 3; ++axis) {
        if ((crossings >> axis & 1U) == 0) continue;
        const float from = values[at(i, j, k)];
        const float to = values[at(i + (axis == 0), j + (axis == 1), k + (axis == 2))];
        Eigen::Vector3d p(brick.place[0] * side + i, brick.place[1] * side + j, brick.place[2] * side + k);
        p[axis] += crossing(from, to);
        mesh_.positions[vertex++] = (grid.origin + grid.voxel_m * p).cast<float>();
      }
    });
  }

  /// Where the surface cuts an edge, as a share of it. Never at an end: vertices of different edges must not meet in
  /// a sample that is exactly zero, or triangles between them would have no area.
  static double crossing(float from, float to) {
    constexpr double closest = 0.01;
    const double share = static_cast<double>(from) / (static_cast<double>(from) - static_cast<double>(to));
    return share > closest ? std::min(share, 1 - closest) : closest;
  }

  uint32_t edge_vertex(const BrickSurface& brick, int i, int j, int k, int edge) const {
    const int corner = edge_start(edge);
    const int x = i + (corner & 1), y = j + (corner >> 1 & 1), z = k + (corner >> 2);
    const BrickSurface* owner = &brick;
    if (x == side || y == side || z == side) {
      const size_t place =
          field_.brick_index(brick.place[0] + x / side, brick.place[1] + y / side, brick.place[2] + z / side);
      owner = &bricks_[static_cast<size_t>(surface_of_[place])];
    }
    const EdgeVertices found =
        owner->edge_vertices[static_cast<size_t>(((z % side) * side + y % side) * side + x % side)];
    const int axis = edge / 4;
    const unsigned before = found & ((1U << axis) - 1U);  // crossings of the same sample along earlier axes
    return owner->first_vertex + (static_cast<unsigned>(found) >> 3) + (before & 1U) + (before >> 1);
  }

  void place_triangles(const BrickSurface& brick) {
    if (brick.triangles == 0) return;
    const Neighbourhood values = gather(brick);
    size_t triangle = brick.first_triangle;
    uint32_t centre = brick.first_centre;
    for_each_sample([&](int i, int j, int k) {
      const CellCase& cell = cases_[static_cast<size_t>(sign_pattern(values, i, j, k))];
      if (cell.triangles.empty()) return;
      for (const auto& slots : cell.triangles) {
        auto& corners = mesh_.triangles[triangle++];
        for (size_t c = 0; c < 3; ++c)
          corners[c] = slots[c] < edges_per_cell ? edge_vertex(brick, i, j, k, slots[c])
                                                 : centre + (slots[c] - static_cast<uint32_t>(edges_per_cell));
      }
      for (const auto& loop : cell.centred_loops) {
        Eigen::Vector3f sum = Eigen::Vector3f::Zero();
        for (const uint8_t edge : loop) sum += mesh_.positions[edge_vertex(brick, i, j, k, edge)];
        mesh_.positions[centre++] = sum / static_cast<float>(loop.size());
      }
    });
  }

  const Field& field_;
  const Work& work_;
  const std::array<CellCase, 256>& cases_;
  std::vector<BrickSurface> bricks_;
  std::vector<int32_t> surface_of_;  ///< by brick index: its place in bricks_, or -1
  Mesh mesh_;
};

}  // namespace

Mesh extract_surface(const Field& field, const Work& work) { return Extraction(field, work).run(); }

}  // namespace booth
