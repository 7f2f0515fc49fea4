#include "pipeline/structured_light/structured_light.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <memory>
#include <optional>
#include <utility>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

std::string millimetres(double metres) { return std::to_string(std::lround(1000 * metres)) + " mm"; }

/// The pixels of a camera that can show something of a box; all of them where part of it is behind the camera.
Eigen::AlignedBox2i pixels_of(const Eigen::AlignedBox3d& box, const RigCamera& camera) {
  const Eigen::Vector2i last(camera.intrinsics.width - 1, camera.intrinsics.height - 1);
  const Eigen::AlignedBox2i whole(Eigen::Vector2i::Zero(), last);
  Eigen::AlignedBox2i pixels;
  for (int corner = 0; corner < 8; ++corner) {
    const auto at = project(camera, box.corner(static_cast<Eigen::AlignedBox3d::CornerType>(corner)));
    if (!at) return whole;
    const Eigen::Vector2d near = at->cwiseMax(0.0).cwiseMin(last.cast<double>());
    pixels.extend(near.array().round().matrix().cast<int>());
  }
  return pixels;
}

Image part_of(const Image& image, const Eigen::AlignedBox2i& pixels) {
  const Eigen::Vector2i size = pixels.sizes() + Eigen::Vector2i::Ones();
  Image part(size.x(), size.y(), image.channels);
  for (int y = 0; y < size.y(); ++y)
    std::copy_n(image.pixel(pixels.min().x(), pixels.min().y() + y),
                static_cast<size_t>(size.x()) * static_cast<size_t>(image.channels), part.pixel(0, y));
  return part;
}

/// decode_gray_code for the part of a camera's images that the region lies in.
Result<ProjectorCoordinates> decode_part(std::vector<Frame> frames, const GrayCodePattern& pattern,
                                         const Image* subject, const Eigen::AlignedBox2i& pixels,
                                         const GrayCodeOptions& options, const Work& work) {
  std::optional<Image> subject_part;
  const Eigen::Vector2i needed = pixels.max() + Eigen::Vector2i::Ones();
  for (Frame& frame : frames) {
    if (frame.pixels->width < needed.x() || frame.pixels->height < needed.y())
      return Error{ErrorCode::invalid_argument, "camera " + frame.camera + ": image " + std::to_string(frame.index) +
                                                    " of the Gray-code sequence is smaller than the rig says"};
    frame.pixels = std::make_shared<const Image>(part_of(*frame.pixels, pixels));
  }
  if (subject != nullptr && subject->width >= needed.x() && subject->height >= needed.y())
    subject_part = part_of(*subject, pixels);
  auto decoded = decode_gray_code(frames, pattern, subject_part ? &*subject_part : nullptr, options, work);
  if (decoded) decoded->origin = pixels.min();
  return decoded;
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
    auto decoded =
        decode_part(frames, capture.pattern, subject, pixels_of(inside, *calibrated), options.decoding, work);
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
