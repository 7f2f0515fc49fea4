#include "pipeline/structured_light/structured_light.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <utility>

namespace booth {
namespace {

std::string millimetres(double metres) { return std::to_string(std::lround(1000 * metres)) + " mm"; }

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
  std::vector<float> distances;
  for (size_t i = 0; i < scan.points.size(); ++i)
    if (scan.measured(i)) distances.push_back((scan.points[i] - from).norm());
  const auto middle = distances.begin() + static_cast<std::ptrdiff_t>(distances.size() / 2);
  std::nth_element(distances.begin(), middle, distances.end());
  return static_cast<double>(*middle);
}

}  // namespace

Result<StructuredLightScan> scan_structured_light(const Rig& rig, const GrayCodeCapture& capture,
                                                  std::span<const Silhouette> silhouettes,
                                                  const StructuredLightOptions& options, const Work& work) {
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
    auto decoded = decode_gray_code(frames, capture.pattern, subject, options.decoding, work);
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
  const size_t points = crop(rig.volume, &out.scan);
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
