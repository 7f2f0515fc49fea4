#pragma once

#include <Eigen/Core>
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/types/field.h"
#include "pipeline/types/mesh.h"

namespace booth {

/// The inside of a closed mesh as voxels: where a skeleton may lie. Index of voxel (i, j, k): x fastest, then y.
struct Interior {
  Grid grid;
  std::vector<float> depth_m;    ///< distance to the nearest voxel outside; 0 outside
  std::vector<uint32_t> inside;  ///< indices of the voxels inside, ascending

  size_t index(int i, int j, int k) const {
    return (static_cast<size_t>(k) * static_cast<size_t>(grid.size[1]) + static_cast<size_t>(j)) *
               static_cast<size_t>(grid.size[0]) +
           static_cast<size_t>(i);
  }
  std::array<int, 3> cell(size_t index) const;
  Eigen::Vector3d point(size_t index) const;
  /// Trilinear depth at a point, world frame; 0 off the grid.
  double depth(const Eigen::Vector3d& p) const;
};

/// Samples the mesh's inside (non-zero winding number along z), keeps the largest connected part and measures depths.
///
/// @param mesh   closed, world frame; its parts may overlap
/// @param cells  voxels along the mesh's height; fewer where it is more than twice as wide or deeper than tall
/// @return no voxels inside when the mesh encloses nothing
/// Cost: O(voxels). Source of the distances: P. Felzenszwalb, D. Huttenlocher, "Distance transforms of sampled
/// functions", Theory of Computing 8, 2012.
Interior sample_interior(const Mesh& mesh, int cells);

/// Shortest ways inside the body, over the 26 neighbours of a voxel. By voxel index:
struct Geodesics {
  static constexpr uint32_t unreached = UINT32_MAX;
  std::vector<uint32_t> steps;   ///< tenths of a voxel from the nearest source; at most 12 % longer than the true way
  std::vector<uint32_t> origin;  ///< which source that is; ties go to the one that was there first
};

/// Where ways begin, with a lead or lag: `start` tenths of a voxel are added to every way from there.
struct GeodesicSource {
  size_t voxel = 0;
  uint32_t start = 0;
};

/// @param sources  inside the body; others are ignored
/// Source: R. Dial, "Algorithm 360: shortest-path forest with topological ordering", CACM 12(11), 1969.
Geodesics geodesics_from(const Interior& interior, std::span<const GeodesicSource> sources);

/// A part of the body that sticks out: a voxel farther from the core than all around it.
struct Extremity {
  size_t tip = 0;             ///< the farthest voxel
  uint32_t tip_steps = 0;     ///< its geodesic distance
  uint32_t saddle_steps = 0;  ///< where it joins a part that reaches farther; 0 for the farthest of all

  uint32_t persistence() const { return tip_steps - saddle_steps; }
};

/// The local maxima of the distance from the core that stand out by at least `min_persistence` from where they join
/// one that reaches farther; farthest first.
/// Source: 0-dimensional persistence, H. Edelsbrunner, J. Harer, "Computational topology", 2010.
std::vector<Extremity> find_extremities(const Interior& interior, const Geodesics& geodesics, uint32_t min_persistence);

/// For each given extremity the voxels that are connected to it above every distance at which it meets another of
/// them: its limb. Ordered from the tip inwards.
std::vector<std::vector<uint32_t>> limbs_of(const Interior& interior, const Geodesics& geodesics,
                                            const std::vector<size_t>& tips);

}  // namespace booth
