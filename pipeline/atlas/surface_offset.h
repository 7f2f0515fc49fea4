#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/grey_image.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// How far each vertex may be moved along its normal, metres, without leaving a silhouette or tearing its outline: in
/// no camera's image by more than it lies from the outline; between half a millimetre and two centimetres.
std::vector<float> offset_limits(const Mesh& mesh, std::span<const PreparedView> views);

/// The offset of each vertex along its normal, metres, at which the cameras agree best on what is there. A visual hull
/// is off by some millimetres where no outline touches it; the photographs tell. Where there is nothing to see that
/// could be compared, the offset is interpolated; it changes little from vertex to vertex and never so much that the
/// surface would fold at once.
///
/// Method: normalised cross-correlation of patches of the tangent plane between all cameras that see a vertex well,
/// for offsets on both sides; the correlations of neighbours are added, then each vertex takes the best offset that
/// lies near its neighbours' (iterated conditional modes). Outwards the limits hold. Inwards they have a price, for an
/// outline may be another vertex's.
///
/// @param greys    of grey_levels()
/// @param weights  vertex by vertex, one a view: how much its picture of the vertex is worth, 0 = nothing
/// @param limits   of offset_limits(); 0 for a vertex that is known to be right and stays
/// Cost: vertices × up to 4 cameras × 13 offsets × 49 samples.
/// Source: the correlation, G. Vogiatzis, C. Hernández, P. H. S. Torr, R. Cipolla, "Multiview stereo via volumetric
/// graph-cuts and occlusion robust photo-consistency", IEEE PAMI 29(12), 2007; the minimisation, J. Besag, "On the
/// statistical analysis of dirty pictures", J. R. Stat. Soc. B 48(3), 1986.
std::vector<float> find_surface_offsets(const Mesh& mesh, std::span<const PreparedView> views,
                                        std::span<const GreyLevels> greys, const CameraRatings& ratings,
                                        std::span<const float> weights, std::span<const float> limits,
                                        const Work& work = {});

}  // namespace booth
