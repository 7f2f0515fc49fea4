#pragma once

#include <Eigen/Core>
#include <array>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "pipeline/face/head.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/work.h"

namespace booth {

/// How many landmarks a face has, in the order of iBUG's 300-W: 0 … 16 the jaw line from the subject's right ear over
/// the chin (8) to the left ear, 17 … 26 the brows, 27 … 35 the nose, 36 … 47 the eyes, 48 … 67 the lips. "Right" is
/// the subject's: towards −X when facing +Z.
/// Source: C. Sagonas et al., "300 Faces in-the-Wild Challenge", ICCV workshops 2013.
inline constexpr size_t face_landmarks = 68;

/// The jaw line is an occluding contour: what a view shows there is where its sight touches the face, another place of
/// the skin for every view.
inline constexpr bool is_contour_landmark(size_t landmark) { return landmark <= 16; }

/// A landmark in space.
struct ControlPoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< world frame, metres
  /// Of the position, world frame, square metres: noise of the pixels and the predictor's disagreement between views.
  /// A displacement d from the position is d·C⁻¹·d squared standard deviations away. Always positive definite.
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();
  int views = 0;  ///< cameras that agree on it, at least 2
  /// On the jaw line: the place is near the face's outline and no feature of the skin; its covariance is the wider,
  /// most of all along the outline. Better a constraint on the surface than a target of a vertex.
  bool contour = false;
};

/// What one camera saw of a face.
struct FaceObservation {
  std::string camera;
  double score = 0;   ///< of the detector; higher is surer
  double box_px = 0;  ///< side of the detector's box, from brows to chin, pixels
  /// Distorted pixels, as captured; for contour landmarks where that view's sight touches the face.
  std::array<Eigen::Vector2d, face_landmarks> pixels{};
  std::array<double, face_landmarks> sigma_px{};  ///< standard deviation of the place along one axis, pixels
  std::array<bool, face_landmarks> agrees{};      ///< with the other cameras: it took part in the control point
};

/// How a face is turned and how large it is. World frame, metres.
struct FaceFrame {
  Eigen::Vector3d middle = Eigen::Vector3d::Zero();    ///< between eyes and mouth
  Eigen::Vector3d forward = Eigen::Vector3d::UnitZ();  ///< where it looks, unit
  Eigen::Vector3d up = Eigen::Vector3d::UnitY();       ///< from the mouth to the eyes, unit
  Eigen::Vector3d left = Eigen::Vector3d::UnitX();     ///< the subject's, unit
  double eye_distance_m = 0;                           ///< between the eyes' middles
};

/// A face found in two cameras at least.
struct FaceControlPoints {
  std::array<std::optional<ControlPoint>, face_landmarks> points;  ///< empty where too few cameras agree
  FaceFrame frame;
  std::vector<FaceObservation> observations;  ///< of the cameras that agree, in the order of their ids
};

/// Triangulates the landmarks of one face by consensus of all views that saw it.
///
/// A landmark is the less certain the more the face is turned from the view, most of all on its far side. That and what
/// such predictors are known to err by at brows, nose, eyes, lips and jaw is added to the spread of each observation. A
/// view most of whose landmarks do not agree with the others' saw something else and is left out whole. What comes out
/// is checked: it must be an upright face of human size, in front of the head.
///
/// @param observations  at most one per camera of the rig; sigma_px the spread of repeated predictions, agrees unused
/// @error no_subject     what was placed has not the shape of a face in front of that head; the message says how
/// @error too_few_views  less than two observations, or no two agree; the message names the cameras
/// Source: R. Pagés et al., automatic avatar booth, section 4.3, whose two views become all that see the face.
Result<FaceControlPoints> place_landmarks(const Rig& rig, std::vector<FaceObservation> observations,
                                          const HeadRegion& head, double most_sigmas = 3);

class LandmarkPredictor;

struct ControlPointOptions {
  int most_cameras = 10;   ///< that are searched for the face, those that see it largest and frontally first, 2 … 60
  double most_sigmas = 3;  ///< a view's landmark farther from where the others see it does not take part, 1 … 10
};

/// Finds a standing person's face in the pictures and places its landmarks in space.
///
/// Around the hull's head every camera's picture is turned upright and undistorted, the face is detected there, and its
/// landmarks are predicted several times from slightly moved and mirrored starts: their mean is a fraction of a pixel
/// and their spread is part of the uncertainty. They are placed by place_landmarks; after that the depth of each but
/// the jaw line's is looked for in the pictures themselves, because predictors have learnt how deep faces are in
/// general and see that depth in everybody.
///
/// @param frames  at most one per camera of the rig, any order
/// @param head    from the hull
/// @error no_subject     no camera shows a face, or as place_landmarks
/// @error too_few_views  the face was found in one camera only, which the message names, or as place_landmarks
/// @error cancelled
Result<FaceControlPoints> find_control_points(const Rig& rig, std::span<const Frame> frames, const HeadRegion& head,
                                              const LandmarkPredictor& predictor,
                                              const ControlPointOptions& options = {}, const Work& work = {});

}  // namespace booth
