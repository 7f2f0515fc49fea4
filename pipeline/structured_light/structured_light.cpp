#include "pipeline/structured_light/structured_light.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numbers>
#include <optional>
#include <utility>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

std::string millimetres(double metres) { return std::to_string(std::lround(1000 * metres)) + " mm"; }

/// Distances along a ray, in units of its direction, at which it enters and leaves a box; nothing where it misses it.
std::optional<std::pair<double, double>> crossing(const Eigen::AlignedBox3d& box, const Eigen::Vector3d& origin,
                                                  const Eigen::Vector3d& direction) {
  double enter = 0, leave = std::numeric_limits<double>::infinity();
  for (int axis = 0; axis < 3; ++axis) {
    if (direction[axis] == 0) {
      if (origin[axis] < box.min()[axis] || origin[axis] > box.max()[axis]) return std::nullopt;
      continue;
    }
    const double a = (box.min()[axis] - origin[axis]) / direction[axis],
                 b = (box.max()[axis] - origin[axis]) / direction[axis];
    enter = std::max(enter, std::min(a, b));
    leave = std::min(leave, std::max(a, b));
  }
  if (enter > leave) return std::nullopt;
  return std::pair{enter, leave};
}

/// Which tiles of a camera's images can show something of a box, and from which of the projector's pixels it can be
/// lit: those that project what the tile's corner rays have in the box.
SearchTiles tiles_showing(const Eigen::AlignedBox3d& box, const RigCamera& camera, const CalibratedView* projector,
                          const GrayCodePattern& pattern) {
  SearchTiles tiles = SearchTiles::everywhere(camera.intrinsics.width, camera.intrinsics.height);
  const Eigen::Vector3d center = camera.center();
  // A tile's corner rays may pass beside the box while those between them meet it.
  const double farthest = (box.center() - center).norm() + 0.5 * box.diagonal().norm();
  const double tile_m = std::numbers::sqrt2 * SearchTiles::size_px * farthest / camera.intrinsics.fx;
  const Eigen::AlignedBox3d wide(box.min().array() - tile_m, box.max().array() + tile_m);
  struct Corner {
    bool meets = false;
    Eigen::AlignedBox2d lit_from;  ///< empty: cannot be told
  };
  std::vector<Corner> corners;
  for (int row = 0; row <= tiles.rows; ++row)
    for (int column = 0; column <= tiles.columns; ++column) {
      Corner& corner = corners.emplace_back();
      const Eigen::Vector3d ray = world_ray(camera, SearchTiles::size_px * Eigen::Vector2d(column, row));
      const auto inside = crossing(wide, center, ray);
      corner.meets = inside.has_value();
      if (!inside || projector == nullptr) continue;
      const auto enters = project(*projector, center + inside->first * ray),
                 leaves = project(*projector, center + inside->second * ray);
      if (enters && leaves) corner.lit_from.extend(*enters).extend(*leaves);
    }
  const Eigen::AlignedBox2i whole(Eigen::Vector2i::Zero(), Eigen::Vector2i(pattern.width, pattern.height));
  for (int row = 0; row < tiles.rows; ++row)
    for (int column = 0; column < tiles.columns; ++column) {
      Eigen::AlignedBox2d lit_from;
      bool meets = false, told = true;
      for (const int at : {row * (tiles.columns + 1) + column, (row + 1) * (tiles.columns + 1) + column})
        for (const Corner* corner : {&corners[static_cast<size_t>(at)], &corners[static_cast<size_t>(at + 1)]}) {
          meets |= corner->meets;
          if (!corner->meets) continue;
          told &= !corner->lit_from.isEmpty();
          lit_from.extend(corner->lit_from);
        }
      Eigen::AlignedBox2i& found = tiles.at(column, row);
      if (!meets) {
        found.setEmpty();
      } else if (told) {
        constexpr double bent = 4;  // projector pixels: lines between the corners' points are not straight
        const Eigen::Vector2d size = whole.max().cast<double>();
        found = Eigen::AlignedBox2i((lit_from.min().array() - bent).max(0.0).min(size.array()).matrix().cast<int>(),
                                    (lit_from.max().array() + bent).max(0.0).min(size.array()).matrix().cast<int>());
      } else {
        found = whole;
      }
    }
  return tiles;
}

/// What is measured outside the volume (walls, housings) is not the subject.
size_t crop(const Eigen::AlignedBox3d& volume, RangeScan* scan) {
  size_t left = 0;
  for (size_t i = 0; i < scan->points.size(); ++i) {
    if (!scan->measured(i)) continue;
    if (volume.contains(scan->points[i].cast<double>()))
      ++left;
    else
      scan->points[i].setConstant(std::numeric_limits<float>::quiet_NaN());
  }
  return left;
}

double median_distance(const RangeScan& scan, const Eigen::Vector3f& from) {
  constexpr size_t stride = 17;  // enough of them
  std::vector<float> distances;
  for (size_t i = 0; i < scan.points.size(); i += stride)
    if (scan.measured(i)) distances.push_back((scan.points[i] - from).norm());
  if (distances.empty()) return 0;
  const auto middle = distances.begin() + static_cast<std::ptrdiff_t>(distances.size() / 2);
  std::nth_element(distances.begin(), middle, distances.end());
  return static_cast<double>(*middle);
}

}  // namespace

Result<StructuredLightScan> scan_structured_light(const Rig& rig, const GrayCodeCapture& capture,
                                                  std::span<const Silhouette> silhouettes,
                                                  const Eigen::AlignedBox3d& region,
                                                  const StructuredLightOptions& options, const Work& work) {
  const Eigen::AlignedBox3d inside = rig.volume.intersection(region);
  if (inside.isEmpty()) return Error{ErrorCode::no_subject, "the face lies outside the capture volume"};
  std::map<std::string, std::vector<Frame>> sequences;  // by camera, so that their order does not matter
  for (const FrameSet& set : capture.sets)
    for (const Frame& frame : set.frames) sequences[frame.camera].push_back(frame);

  StructuredLightScan out;
  std::vector<ProjectorCoordinates> views;
  std::optional<Error> first_error;
  for (const auto& [camera, frames] : sequences) {
    const auto silhouette = std::find_if(silhouettes.begin(), silhouettes.end(),
                                         [&, &id = camera](const Silhouette& s) { return s.camera == id; });
    const Image* subject = silhouette == silhouettes.end() ? nullptr : &silhouette->coverage;
    const RigCamera* calibrated = rig.find(camera);
    if (calibrated == nullptr) return Error{ErrorCode::not_found, "the rig has no camera " + camera};
    const SearchTiles tiles =
        tiles_showing(inside, *calibrated, rig.projector ? &*rig.projector : nullptr, capture.pattern);
    auto decoded = decode_gray_code(frames, capture.pattern, subject, &tiles, options.decoding, work);
    if (work.stopped()) return Work::cancelled();
    if (!decoded) {
      out.warnings.push_back("left out of the face scan: " + decoded.error().message);
      if (!first_error) first_error = decoded.error();
      continue;
    }
    out.warnings.insert(out.warnings.end(), decoded->warnings.begin(), decoded->warnings.end());
    views.push_back(std::move(*decoded));
  }
  if (views.empty()) return first_error.value_or(Error{ErrorCode::no_subject, "the face scan has no images"});

  auto scan = triangulate(rig, views, capture.pattern.width, capture.pattern.height, options.triangulation, work);
  if (!scan) return scan.error();
  out.scan = std::move(*scan);
  const size_t points = crop(inside, &out.scan);
  if (points < static_cast<size_t>(options.fewest_points))
    return Error{ErrorCode::no_subject,
                 "the face scan has only " + std::to_string(points) + " points on the subject, too few to use"};

  if (rig.projector) {
    out.eye = rig.projector->center().cast<float>();
  } else {
    for (const ProjectorCoordinates& view : views)
      out.eye += rig.find(view.camera)->center().cast<float>() / static_cast<float>(views.size());
  }
  for (const ProjectorCoordinates& view : views) {
    const RigCamera& camera = *rig.find(view.camera);
    const double distance = median_distance(out.scan, camera.center().cast<float>());
    out.motion_m = std::max(out.motion_m, view.motion_px * distance / camera.intrinsics.fx);
  }
  constexpr double noticeable_motion_m = 0.0015;
  if (out.motion_m > options.most_motion_m)
    return Error{ErrorCode::no_subject,
                 "the subject moved by " + millimetres(out.motion_m) + " during the face scan, too far to use it"};
  if (out.motion_m > noticeable_motion_m)
    out.warnings.push_back("the subject moved by " + millimetres(out.motion_m) + " during the face scan");
  return out;
}

}  // namespace booth
