#pragma once

#include <Eigen/Geometry>
#include <iosfwd>
#include <memory>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/result.h"

namespace booth {

/// Finds frontal, upright faces in one image. Safe to use from several threads at once.
class FaceDetector {
 public:
  virtual ~FaceDetector() = default;

  /// Square boxes about faces in a grey image, pixels, the surest first. What exactly a box holds is the cascade's
  /// business: about from the middle of the forehead to the chin.
  ///
  /// @param least_px, most_px  sides that the boxes can have
  virtual std::vector<Eigen::AlignedBox2d> detect(const Image& grey, int least_px, int most_px) const = 0;
};

/// A cascade of boosted classifiers as OpenCV trains and stores them, such as haarcascade_frontalface_alt2.xml.
///
/// @param cascade  the bytes of the file, XML or YAML
/// @error invalid_file  no such cascade
/// Source: P. Viola, M. Jones, "Robust real-time face detection", IJCV 57(2), 2004.
Result<std::unique_ptr<FaceDetector>> read_face_cascade(std::istream& cascade);

}  // namespace booth
