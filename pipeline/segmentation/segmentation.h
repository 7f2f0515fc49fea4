#pragma once

#include <span>
#include <string>
#include <vector>

#include "pipeline/types/empty_view.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/result.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

struct SegmentationOptions {
  /// Share of the light that the deepest soft shadow on floor and walls leaves, 0.05 … 0.95. Lower where a single
  /// lamp casts heavy shadows, higher where dark clothes get lost.
  double darkest_shadow = 0.25;
  /// How strongly the outline avoids places without an edge, 0 … 20. Higher removes more ragged pieces, lower keeps
  /// more fine ones.
  double smoothness = 3;
  /// Parts smaller than this share of the largest are dropped as specks, 0 … 1.
  double smallest_part = 0.02;
  /// Least share of the image that counts as somebody being there, 0 … 1.
  double smallest_subject = 0.002;
};

struct Segmentation {
  Silhouette silhouette;
  double subject_share = 0;           ///< of the image's area, 0 … 1
  double light_factor = 1;            ///< how many times brighter or darker the place became since the background
  double movement_px = 0;             ///< of the picture since the background
  double background_share = 1;        ///< of the image, that looks like the background under that light, 0 … 1
  std::vector<std::string> warnings;  ///< what an operator should know, naming the camera
};

/// What one camera saw of the empty booth, learned once for any number of captures.
///
/// @param background  1 … 256 frames of one camera, size and channel count; 8-bit grey or RGB (sRGB)
/// @error no_background  there are none, too many, or one is not like that
/// Cost: O(pixels × frames); serial.
Result<EmptyView> learn_empty_view(std::span<const Frame> background);

/// Separates the subject from the background that the same camera saw in the empty booth.
///
/// A model of the empty booth with its noise; drift of light, gain and white balance found from what still looks
/// like it; shadows told from things by keeping the background's chromaticity and by fading in; a minimum cut for
/// what is ambiguous; then the share that the subject covers of each pixel along the outline, in linear light.
///
/// @param empty       of the same camera, size and channels as `body`
/// @param body        8-bit grey or RGB (sRGB), distorted pixels as captured; the subject may be cut by the border
/// @return a coverage of the frame's size, in its pixels: 255 subject, 0 background, its 127.5 level the outline
/// @error no_background     `empty` is of another size or channel count
/// @error no_subject        nothing in the frame differs from the background
/// @error invalid_argument  an option outside its range, or a body frame that is empty or neither grey nor RGB
/// @error cancelled         asked to stop
/// Cost: O(pixels), about 20 bytes a pixel. One call is serial: run the cameras side by side.
/// Source: J. Sun et al., "Background Cut", ECCV 2006; T. Horprasert et al. 1999 for shadows; for the outline the
/// compositing equation I = α F + (1 − α) B with B known, R. J. Qian, M. I. Sezan, "Video background replacement
/// without a blue screen", ICIP 1999.
Result<Segmentation> segment(const EmptyView& empty, const Frame& body, const SegmentationOptions& options,
                             const Work& work = {});

/// The same before a background that is not kept. @error as learn_empty_view and above
Result<Segmentation> segment(std::span<const Frame> background, const Frame& body, const SegmentationOptions& options,
                             const Work& work = {});

}  // namespace booth
