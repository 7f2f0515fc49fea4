#pragma once

#include <Eigen/Core>
#include <array>
#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/refine/smooth_distance.h"
#include "pipeline/types/field.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/image.h"
#include "pipeline/types/work.h"

namespace booth {

/// Where the surface is by what photographs show of it.
struct SeenSurface {
  Eigen::Vector3f position;  ///< metres, world frame
  Eigen::Vector3f normal;    ///< unit, outwards: the guess's
  float confidence = 0;      ///< 0 … 1
};

/// The photographs of a capture, ready to look for the subject's surface in them.
/// Source: normalised cross-correlation of patches, Y. Furukawa, J. Ponce, "Accurate, dense, and robust multi-view
/// stereopsis", IEEE PAMI 32(8), 2010.
class PhotoConsistency {
 public:
  /// @param frames  at most one a camera, as delivered; cameras without one do not look
  /// @param views   the cameras, and where they see the subject; they outlive this
  /// @param hull    nothing of the subject is outside; it tells what hides a place from a camera; outlives this
  PhotoConsistency(std::span<const Frame> frames, const SilhouetteViews& views, const Field& hull,
                   const Work& work = {});

  /// Looks for the surface around a guess of it: a small plane patch is moved along the guess's normal, and is on the
  /// surface where the cameras that see it from the front see the same on it. Brightness and contrast of each camera
  /// are its own.
  ///
  /// @param guess      of the surface, inside the hull
  /// @param samples    of the hull, near the guess
  /// @param inwards_m  how far inside the guess to look; outside it, as far as the hull goes
  /// @return by sample; nothing where fewer than two cameras see the place, it has no texture, no place looks alike to
  ///         them or several do
  /// Cost: grows with the samples. Same input, same bytes, whatever the threads and the order of views and frames.
  std::vector<std::optional<SeenSurface>> find(const SmoothDistance& guess, std::span<const HullSample> samples,
                                               double inwards_m, const Work& work = {}) const;

 private:
  /// A camera's picture around the subject, without colour.
  struct Grey {
    int shrunk = 1;         ///< pixels of the camera along a side of one of these
    int left = 0, top = 0;  ///< the place of the first one in the shrunk picture
    Image image;            ///< empty where the camera has no picture
  };
  struct Place {
    Eigen::Vector3f position, normal;
  };
  static Grey shrink(const Image& picture, const Image& coverage, int by);
  std::optional<SeenSurface> look(const SmoothDistance& guess, const HullSample& sample, int inwards) const;
  std::vector<size_t> cameras_that_see(const SmoothDistance& guess, const Place& place) const;
  bool is_hidden(const SmoothDistance& guess, const Eigen::Vector3f& p, const Eigen::Vector3f& sight) const;
  bool is_in_hull(const Eigen::Vector3f& p) const;

  /// A square of samples on the surface.
  static constexpr int half_side = 5;  ///< samples, to each side of the middle
  static constexpr size_t patch_samples = size_t{2 * half_side + 1} * (2 * half_side + 1);
  using Patch = std::array<float, patch_samples>;
  float likeness(const std::vector<size_t>& seeing, const Eigen::Vector3f& middle, const Eigen::Vector3f& right,
                 const Eigen::Vector3f& up) const;
  bool look_at(size_t view, const Eigen::Vector3f& middle, const Eigen::Vector3f& right, const Eigen::Vector3f& up,
               Patch& patch) const;

  const SilhouetteViews& views_;
  const Field& hull_;
  float spacing_m_ = 0;      ///< between the samples of a patch
  std::vector<Grey> greys_;  ///< by view
};

}  // namespace booth
