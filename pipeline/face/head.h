#pragma once

#include <Eigen/Geometry>
#include <functional>
#include <optional>

#include "pipeline/types/mesh.h"

namespace booth {

/// Where the head is, in the world frame, metres.
struct HeadRegion {
  Eigen::Vector3f barycentre = Eigen::Vector3f::Zero();  ///< of the surface between neck and crown
  float neck_y = 0;                                      ///< height of the narrowest place below the chin
  float crown_y = 0;                                     ///< height of the topmost point
  float height() const { return crown_y - neck_y; }
  /// Height down to which a scan is used: chin and throat hide where the neck begins.
  float lowest_face_y() const { return neck_y - 0.1F * height(); }
  /// What holds the head with its hair, down to the lowest height of a face.
  Eigen::AlignedBox3d box() const {
    const float half = 0.8F * height();
    return {Eigen::Vector3d(barycentre.x() - half, lowest_face_y(), barycentre.z() - half),
            Eigen::Vector3d(barycentre.x() + half, crown_y + 0.1F * height(), barycentre.z() + half)};
  }
};

/// The head of a standing person by proportions: the narrowest place of the body between 8 and 25 % of the stature
/// below its crown is the neck.
///
/// @param mesh  closed, world frame, feet on the floor
/// @return nothing for a shape without such a place (empty, flat)
/// Source: proportions: NASA, "Anthropometric Source Book", 1978 (head height 12 … 14 % of an adult's stature, up to a
/// fifth of a small child's).
std::optional<HeadRegion> find_head(const Mesh& mesh);

/// The barycentre of a part of the surface, each triangle by its area; world frame.
///
/// @param counts  whether a triangle is of that part, by the middle of its corners
/// @return nothing where no triangle is
std::optional<Eigen::Vector3f> surface_barycentre(const Mesh& mesh,
                                                  const std::function<bool(const Eigen::Vector3f&)>& counts);

}  // namespace booth
