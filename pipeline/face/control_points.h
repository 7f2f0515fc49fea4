#pragma once

#include <Eigen/Core>
#include <array>
#include <optional>
#include <string>
#include <vector>

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
  /// On the jaw line: the place is near the face's outline and no feature of the skin; its covariance is the wider, most
  /// of all along the outline. Better a constraint on the surface than a target of a vertex.
  bool contour = false;
};

/// What one camera saw of a face.
struct FaceObservation {
  std::string camera;
  double score = 0;  ///< of the detector; higher is surer, 0 just found
  /// Distorted pixels, as captured; for contour landmarks where that view's sight touches the face.
  std::array<Eigen::Vector2d, face_landmarks> pixels{};
  std::array<double, face_landmarks> sigma_px{};  ///< standard deviation of the place along one axis, pixels
  std::array<bool, face_landmarks> agrees{};      ///< with the other cameras: it took part in the control point
};

/// A face found in two cameras at least.
struct FaceControlPoints {
  std::array<std::optional<ControlPoint>, face_landmarks> points;  ///< empty where too few cameras agree
  std::vector<FaceObservation> observations;                       ///< in the order of the cameras' ids
};

}  // namespace booth
