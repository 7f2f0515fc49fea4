#include "pipeline/face/face_place.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "pipeline/face/head_view.h"
#include "pipeline/face/ray_caster.h"
#include "pipeline/geometry/camera_model.h"
#include "pipeline/geometry/point_triangulation.h"

namespace booth {
namespace {

/// Of a detector's box, from a small child's to the largest adult's.
constexpr double least_box_m = 0.11, most_box_m = 0.28;

/// A tenth of a box is how far its middle wanders from one view to the next.
constexpr double box_sigma = 0.1;

struct Searched {
  const RigCamera* camera = nullptr;
  const Image* picture = nullptr;
  double merit = 0;
};

/// The cameras that look at the place from the front, those made for faces and the nearest first.
std::vector<Searched> cameras_before(const Rig& rig, std::span<const Frame> frames, const Eigen::Vector3d& middle) {
  std::vector<Searched> cameras;
  for (const Frame& frame : frames) {
    const RigCamera* camera = rig.find(frame.camera);
    if (camera == nullptr || frame.pixels == nullptr) continue;
    const Eigen::Vector3d to_camera = camera->center() - middle;
    const double frontal = to_camera.z() / std::hypot(to_camera.x(), to_camera.z());
    constexpr double least_frontal = 0.34;  // cos 70°: farther round, a face that looks about ahead is a profile
    if (!(frontal > least_frontal)) continue;
    const double preferred = camera->role == CameraRole::face ? 1 : 0;
    cameras.push_back({camera, frame.pixels.get(), preferred + frontal});
  }
  std::sort(cameras.begin(), cameras.end(), [](const Searched& a, const Searched& b) {
    return a.merit != b.merit ? a.merit > b.merit : a.camera->id < b.camera->id;
  });
  constexpr size_t most_cameras = 5;
  if (cameras.size() > most_cameras) cameras.resize(most_cameras);
  return cameras;
}

/// A picture whose pixels are means of `by` × `by`.
Image shrink(const Image& picture, int by) {
  Image small(picture.width / by, picture.height / by, picture.channels);
  for (int y = 0; y < small.height; ++y)
    for (int x = 0; x < small.width; ++x)
      for (int c = 0; c < small.channels; ++c) {
        int sum = 0;
        for (int j = 0; j < by; ++j)
          for (int i = 0; i < by; ++i) sum += picture.at(by * x + i, by * y + j, c);
        small.at(x, y, c) = static_cast<uint8_t>((sum + by * by / 2) / (by * by));
      }
  return small;
}

/// The camera of the shrunk picture.
CalibratedView shrink(const CalibratedView& camera, const Image& small, int by) {
  CalibratedView view = camera;
  Intrinsics& k = view.intrinsics;
  k.width = small.width;
  k.height = small.height;
  k.fx /= by;
  k.fy /= by;
  k.skew /= by;
  k.cx = (k.cx + 0.5) / by - 0.5;
  k.cy = (k.cy + 0.5) / by - 0.5;
  return view;
}

struct SeenBox {
  CalibratedView view;  ///< upright, without distortion
  Eigen::Vector2d middle = Eigen::Vector2d::Zero();
  double width_px = 0;
  double width_at(const Eigen::Vector3d& p) const { return width_px / view.intrinsics.fx * (p - view.center()).norm(); }
};

/// The surest face of human size in one picture.
std::optional<SeenBox> see_face(const Searched& searched, const Eigen::Vector3d& middle, double width_m,
                                const FaceDetector& detector) {
  constexpr double px_per_m = 320;  // the smallest face is 35 pixels wide then; cascades want 20 … 24
  const auto view = upright_view(*searched.camera, middle, width_m, static_cast<int>(std::lround(px_per_m * width_m)));
  if (!view) return std::nullopt;
  const Intrinsics& k = searched.camera->intrinsics;
  const double finer = std::min(k.fx, k.fy) / view->intrinsics.fx;
  constexpr double coarsest = 0.3;  // below that the picture lacks the pixels that a cascade wants
  if (finer < coarsest) return std::nullopt;
  const int by = std::max(1, static_cast<int>(finer));
  const Image small = shrink(*searched.picture, by);
  const Image seen = render_view(shrink(*searched.camera, small, by), small, *view);
  const auto boxes = detector.detect(seen, static_cast<int>(std::ceil(px_per_m * least_box_m)),
                                     static_cast<int>(std::floor(px_per_m * most_box_m)));
  if (boxes.empty()) return std::nullopt;
  return SeenBox{*view, boxes.front().center(), boxes.front().sizes().mean()};
}

/// Whether the face is that head's, which then is no larger than heads with such a face are.
bool belongs_to(const FacePlace& face, const HeadRegion& head) {
  constexpr double most_widths = 2.2;  // from neck to crown: a high neck under piled-up hair
  if (static_cast<double>(head.height()) > most_widths * face.width_m) return false;
  // A box's edges are no sharper a place than this.
  constexpr double sure_half = 0.35;
  const Eigen::Vector3d up(0, sure_half * face.width_m, 0);
  return head.box().contains(face.middle + up) && head.box().contains(face.middle - up);
}

}  // namespace

std::optional<FacePlace> place_face(const Rig& rig, std::span<const Frame> frames, const Mesh& surface,
                                    const Eigen::Vector3d& middle, double width_m, const FaceDetector& detector,
                                    const Work& work) {
  const auto cameras = cameras_before(rig, frames, middle);
  std::vector<std::optional<SeenBox>> found(cameras.size());
  work.parallel_for(cameras.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) found[i] = see_face(cameras[i], middle, width_m, detector);
  });
  std::vector<SeenBox> boxes;
  for (auto& box : found)
    if (box) boxes.push_back(std::move(*box));
  if (boxes.empty()) return std::nullopt;

  FacePlace face;
  std::vector<SeenBox> agreeing;
  if (boxes.size() == 1) {
    const Eigen::Vector3d eye = boxes[0].view.center(), ray = world_ray(boxes[0].view, boxes[0].middle);
    const auto hit = RayCaster(surface).cast(eye.cast<float>(), ray.cast<float>(), 0, 100);
    if (!hit) return std::nullopt;
    face.middle = eye + static_cast<double>(hit->distance_m) * ray;
    agreeing = boxes;
  } else {
    std::vector<Sighting> sightings;
    for (const SeenBox& box : boxes) sightings.push_back({&box.view, box.middle, box_sigma * box.width_px});
    constexpr double most_sigmas = 2.5;
    const auto point = triangulate_consensus(sightings, most_sigmas);
    if (!point) return std::nullopt;
    face.middle = point->point.position;
    for (size_t i = 0; i < boxes.size(); ++i)
      if (point->agrees[i]) agreeing.push_back(boxes[i]);
  }
  double width = 0;
  Eigen::Vector3d towards = Eigen::Vector3d::Zero();
  for (const SeenBox& box : agreeing) {
    width += box.width_at(face.middle) / static_cast<double>(agreeing.size());
    towards += (box.view.center() - face.middle).normalized();
  }
  towards.y() = 0;
  if (width < least_box_m || width > most_box_m || !(towards.norm() > 0)) return std::nullopt;
  face.width_m = width;
  face.towards = towards.normalized();
  face.views = static_cast<int>(agreeing.size());
  return face;
}

std::optional<HeadRegion> head_about(const FacePlace& face, const Mesh& surface) {
  // In widths of the box.
  constexpr double behind = 0.6, radius = 0.7, to_neck = 0.65, least_to_crown = 0.5, most_to_crown = 1.5;
  const Eigen::Vector3d axis = face.middle - behind * face.width_m * face.towards;
  const auto in_column = [&](const Eigen::Vector3f& p) {
    const Eigen::Vector3d away = p.cast<double>() - axis;
    return std::hypot(away.x(), away.z()) < radius * face.width_m;
  };
  double crown = -std::numeric_limits<double>::infinity();
  for (const Eigen::Vector3f& p : surface.positions)
    if (in_column(p)) crown = std::max(crown, static_cast<double>(p.y()));
  const double above = (crown - face.middle.y()) / face.width_m;
  if (above < least_to_crown || above > most_to_crown) return std::nullopt;
  HeadRegion head;
  head.crown_y = static_cast<float>(crown);
  head.neck_y = static_cast<float>(face.middle.y() - to_neck * face.width_m);
  const auto barycentre =
      surface_barycentre(surface, [&](const Eigen::Vector3f& p) { return p.y() > head.neck_y && in_column(p); });
  if (!barycentre) return std::nullopt;
  head.barycentre = *barycentre;
  return head;
}

std::optional<HeadRegion> find_head(const Mesh& surface, const Rig& rig, std::span<const Frame> frames,
                                    const FaceDetector& detector, const Work& work) {
  const auto by_shape = find_head(surface);
  if (by_shape) {
    constexpr double around = 1.5;
    const auto face = place_face(rig, frames, surface, by_shape->barycentre.cast<double>(),
                                 around * static_cast<double>(by_shape->height()), detector, work);
    if (face && belongs_to(*face, *by_shape)) return by_shape;
  }
  if (surface.positions.empty()) return by_shape;

  // Wherever a head can be on what stands, sits or holds up its arms.
  Eigen::AlignedBox3d body;
  for (const Eigen::Vector3f& p : surface.positions) body.extend(p.cast<double>());
  constexpr double middle_of_stature = 0.75, of_stature = 0.6;
  Eigen::Vector3d middle = body.center();
  middle.y() = body.min().y() + middle_of_stature * body.sizes().y();
  const auto face = place_face(rig, frames, surface, middle, of_stature * body.sizes().y(), detector, work);
  if (!face || (by_shape && (face->views < 2 || belongs_to(*face, *by_shape)))) return by_shape;
  const auto by_face = head_about(*face, surface);
  return by_face ? by_face : by_shape;
}

}  // namespace booth
