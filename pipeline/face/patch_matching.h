#pragma once

#include <Eigen/Core>
#include <optional>
#include <span>

#include "pipeline/types/image.h"
#include "pipeline/types/rig.h"

namespace booth {

/// A picture without distortion and the pinhole it was taken with.
struct PinholePicture {
  CalibratedView view;  ///< no distortion
  Image grey;           ///< 1 channel, of the view's size
};

struct PatchMatch {
  double depth_m = 0;      ///< how far along the sight the surface is from where it was searched, metres
  double sigma_m = 0;      ///< its standard deviation
  double correlation = 0;  ///< mean over the pictures that were compared, −1 … 1
};

struct PatchSearch {
  double half_size_m = 0.008;  ///< of the square patch of surface that is compared
  double range_m = 0.012;      ///< how far along the sight it is searched, to both sides
  double least_correlation = 0.8;
};

/// How far along a sight the surface lies, by what several pictures see of it: a small plane patch is moved along the
/// reference's ray, and is on the surface where it looks the same in all.
///
/// @param reference  its ray through `point` is searched
/// @param others     compared with it; those that would see the patch at a slant of more than 60° are not
/// @param point      world frame, metres: in the middle of the search
/// @param normal     about how the surface is turned, unit; turns by half a right angle are tried, too
/// @return nothing where no place looks alike, or several do, or the patch has no contrast
/// Source: normalised cross-correlation of patches over depth, Y. Furukawa, J. Ponce, "Accurate, dense, and robust
/// multi-view stereopsis", IEEE PAMI 32(8), 2010.
std::optional<PatchMatch> match_patch(const PinholePicture& reference, std::span<const PinholePicture* const> others,
                                      const Eigen::Vector3d& point, const Eigen::Vector3d& normal,
                                      const PatchSearch& search = {});

/// How alike the pictures are where a plane patch of surface would be: the mean correlation of the reference with each
/// of the others that would see it at a slant of less than 60°.
///
/// @param normal  of the surface there, unit
/// @return −1 … 1; nothing where fewer than two pictures show it or the patch has no contrast
std::optional<double> patch_correlation(const PinholePicture& reference, std::span<const PinholePicture* const> others,
                                        const Eigen::Vector3d& point, const Eigen::Vector3d& normal,
                                        double half_size_m = 0.008);

}  // namespace booth
