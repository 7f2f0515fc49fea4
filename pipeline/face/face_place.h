#pragma once

#include <Eigen/Core>
#include <optional>
#include <span>

#include "pipeline/face/face_detector.h"
#include "pipeline/face/head.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/work.h"

namespace booth {

/// A face in space, by the boxes that a detector draws about it. World frame, metres.
struct FacePlace {
  Eigen::Vector3d middle = Eigen::Vector3d::Zero();    ///< of the boxes: the face's front, about the nose
  Eigen::Vector3d towards = Eigen::Vector3d::UnitZ();  ///< to the cameras that saw it: horizontal, unit
  double width_m = 0;                                  ///< of the boxes
  int views = 0;                                       ///< cameras that agree
};

/// The face that the cameras see near a place: in each picture, undistorted and upright, the surest face of human
/// size; together, the point that the most cameras' boxes agree on. A single camera's box is taken to lie on the
/// surface where its middle's ray meets that.
///
/// @param frames   at most one per camera of the rig, any order; a few that look at the face from the front are used
/// @param surface  the subject's
/// @param middle   world frame, metres: where to look
/// @param width_m  how much of the world around it is searched, across and up
/// @return nothing where no face is seen or the cameras do not agree; incomplete when the work is stopped
std::optional<FacePlace> place_face(const Rig& rig, std::span<const Frame> frames, const Mesh& surface,
                                    const Eigen::Vector3d& middle, double width_m, const FaceDetector& detector,
                                    const Work& work = {});

/// The head about a face, by proportions of the detector's box.
///
/// @return nothing where the surface does not end above the face as a head does
/// Source: R. Pagés et al., automatic avatar booth, section 4.2; proportions as find_head.
std::optional<HeadRegion> head_about(const FacePlace& face, const Mesh& surface);

/// Where the head is by the hull's shape and, as a second opinion, by the face that cameras see. Where the face lies in
/// the head that find_head names and is as large as is due to it, that is the head; elsewhere it is the one about the
/// face, if two cameras saw it or find_head found none.
///
/// @param frames  as place_face
/// @return nothing where neither finds a head
std::optional<HeadRegion> find_head(const Mesh& surface, const Rig& rig, std::span<const Frame> frames,
                                    const FaceDetector& detector, const Work& work = {});

}  // namespace booth
