#pragma once

#include <string>

namespace booth {

/// What a capture says about one of the booth's cameras.
struct CameraHealth {
  std::string camera;
  /// It no longer stands where it was calibrated: its silhouette contradicts the other cameras'.
  bool moved = false;
  double offset_px = 0;         ///< by how much its picture of the subject is off
  double deviation = 0;         ///< the same in standard deviations; 0 where nobody can tell
  double light_factor = 1;      ///< how many times brighter or darker than when the background was learned, at least 1
  bool shifted = false;         ///< it no longer stands where it stood then: its background is elsewhere in its picture
  double background_px = 0;     ///< by how much it is
  double background_share = 1;  ///< of its picture, that still looks like the background but for that light, 0 … 1
};

}  // namespace booth
