#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/face/face_pictures.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// Where pictures agree on what is near a place of a surface.
struct SurfaceMatch {
  std::array<uint32_t, 3> vertex{};                   ///< a triangle's corners
  Eigen::Vector3f weights = Eigen::Vector3f::Zero();  ///< of the place, barycentric
  Eigen::Vector3f normal = Eigen::Vector3f::Zero();   ///< of the surface there, unit
  double along_m = 0;                                 ///< how far along the normal the pictures agree best, metres
  double sigma_m =
      0;  ///< its standard deviation; neighbours share pictures, and this allows for it: take them as independent
  double correlation = 0;  ///< mean over pairs of pictures there, −1 … 1
};

struct SurfaceMatchOptions {
  double spacing_m = 0.0015;     ///< of the samples that are compared; coarser where the pictures are
  double half_window_m = 0.007;  ///< of the windows that are compared
  double range_m = 0.005;        ///< searched to both sides of the surface
  double step_m = 0.001;         ///< of the search; maxima are found between steps
  double least_correlation = 0.6;
};

/// Moves a face's surface along its normals and compares, window by window, what every two pictures would show on it.
/// Both luma and what is free of highlights count, each by how well it agrees anywhere (the likelihood of noise of
/// unknown strength). Windows follow the surface's own shape; only what both pictures see unoccluded by the surface is
/// compared.
///
/// @param pictures         at least two, else nothing is found
/// @param surface          a head, facing +Z of its own frame; world frame
/// @param world_from_head  its frame: origin inside, +Y up; places within 80° of +Z, as seen from the Y axis, are tried
/// @return places of a regular grid, half of half a window apart, those that have texture and one clear best
/// displacement Source: normalised cross-correlation over sweeps of a surface, as P. Fua, Y. Leclerc, "Object-centered
/// surface reconstruction", IJCV 16, 1995, and T. Beeler et al., "High-quality single-shot capture of facial geometry",
/// SIGGRAPH 2010, do.
std::vector<SurfaceMatch> match_surface(std::span<const FacePicture> pictures, const Mesh& surface,
                                        const Eigen::Isometry3d& world_from_head,
                                        const SurfaceMatchOptions& options = {}, const Work& work = {});

}  // namespace booth
