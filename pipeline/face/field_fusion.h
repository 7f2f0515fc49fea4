#pragma once

#include <Eigen/Core>
#include <span>

#include "pipeline/face/head.h"
#include "pipeline/face/scan_mesh.h"
#include "pipeline/types/field.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// Puts the scan's surface into a hull's field. What lies between the scan's eye and its surface goes away; what lies a
/// little behind the surface and was outside, because a silhouette cut too deep, is filled. Folds that the hull has in
/// front of the scan, which no displacement of a mesh could undo, are gone before there is a mesh.
///
/// Towards the scan's rim it cuts ever shallower, so that it leaves a slope and no step; there it fills nothing.
///
/// @param field  as carve_visual_hull returns it
/// @param eye    world frame, metres: where the scan was seen from
/// @return the field with the scan's surface in it to about a tenth of a voxel, metres where stored. Its zero level may
///         have closed-off cavities and loose parts, see solid_parts.h
/// Source: Y. Yemez, C. Wetherilt, "A volumetric fusion technique for surface reconstruction from silhouettes and range
/// data", CVIU 105(1), 2007.
Field fuse_scan(const Field& field, const HeadRegion& head, const ScanMesh& scan, const Eigen::Vector3f& eye,
                const Work& work = {});

/// Bends a hull's field to a surface that is known everywhere, such as a fitted face: where its weight is 1 the zero
/// level is the surface, where it is 0 the hull, and between them it goes over smoothly, without a step or a rim. How
/// far the surface is is measured along the eye's sight where this faces it, along the surface's normals where it
/// grazes it.
///
/// @param field    as carve_visual_hull returns it
/// @param surface  open, world frame, facing the eye; where the eye looks at it more than once, the first counts
/// @param weight   per vertex of it, 0 … 1, falling to 0 at its rim
/// @param eye      world frame, metres: what lies between it and the surface goes away; up to 12 mm behind the surface
///                 is filled
Field blend_surface(const Field& field, const Mesh& surface, std::span<const float> weight, const Eigen::Vector3f& eye,
                    const Work& work = {});

}  // namespace booth
