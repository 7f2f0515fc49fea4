#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "pipeline/types/mesh.h"

namespace booth {

/// Colours for the vertices that have none, spread smoothly over the surface from those that have: each the mean of
/// its neighbours (a harmonic function). Parts of the surface without any colour get the mean of all.
///
/// @param colours  one a vertex; those that are not known are overwritten
/// @param known    one a vertex, not 0 where the colour is given
void diffuse_colours(const Mesh& mesh, std::span<Eigen::Array3f> colours, std::span<const uint8_t> known);

}  // namespace booth
