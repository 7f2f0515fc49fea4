#include "pipeline/atlas/camera_ratings.h"

#include <embree3/rtcore.h>

#include <Eigen/Geometry>
#include <limits>
#include <stdexcept>

namespace booth {
namespace {

/// The surface as something that rays are cast against.
class Occluder {
 public:
  explicit Occluder(const Mesh& mesh) : device_(rtcNewDevice("threads=1,set_affinity=0")) {
    if (device_ == nullptr) throw std::runtime_error("the ray tracer could not be set up");
    scene_ = rtcNewScene(device_);
    RTCGeometry geometry = rtcNewGeometry(device_, RTC_GEOMETRY_TYPE_TRIANGLE);
    auto* positions = static_cast<float*>(rtcSetNewGeometryBuffer(
        geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 3 * sizeof(float), mesh.positions.size()));
    for (size_t v = 0; v < mesh.positions.size(); ++v)
      for (int k = 0; k < 3; ++k) positions[3 * v + static_cast<size_t>(k)] = mesh.positions[v][k];
    auto* indices = static_cast<uint32_t*>(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                                                   3 * sizeof(uint32_t), mesh.triangles.size()));
    for (size_t t = 0; t < mesh.triangles.size(); ++t)
      for (size_t k = 0; k < 3; ++k) indices[3 * t + k] = mesh.triangles[t][k];
    rtcCommitGeometry(geometry);
    rtcAttachGeometry(scene_, geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(scene_);
  }
  ~Occluder() {
    rtcReleaseScene(scene_);
    rtcReleaseDevice(device_);
  }
  Occluder(const Occluder&) = delete;
  Occluder& operator=(const Occluder&) = delete;

  /// Whether the surface lies between the points; the first `skip` (a share of the way) does not count.
  bool between(const Eigen::Vector3f& from, const Eigen::Vector3f& to, float skip) const {
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    const Eigen::Vector3f way = to - from;
    RTCRay ray{};
    ray.org_x = from.x();
    ray.org_y = from.y();
    ray.org_z = from.z();
    ray.dir_x = way.x();
    ray.dir_y = way.y();
    ray.dir_z = way.z();
    ray.tnear = skip;
    ray.tfar = 1;
    ray.mask = std::numeric_limits<unsigned>::max();
    rtcOccluded1(scene_, &context, &ray);
    return ray.tfar < 0;
  }

 private:
  RTCDevice device_;
  RTCScene scene_ = nullptr;
};

struct TriangleShape {
  Eigen::Vector3f middle, normal;
  float area = 0;
};

std::vector<TriangleShape> shapes_of(const Mesh& mesh) {
  std::vector<TriangleShape> shapes(mesh.triangles.size());
  for (size_t t = 0; t < shapes.size(); ++t) {
    const Eigen::Vector3f& a = mesh.positions[mesh.triangles[t][0]];
    const Eigen::Vector3f& b = mesh.positions[mesh.triangles[t][1]];
    const Eigen::Vector3f& c = mesh.positions[mesh.triangles[t][2]];
    const Eigen::Vector3f twice = (b - a).cross(c - a);
    const float length = twice.norm();
    shapes[t] = {(a + b + c) / 3, length > 0 ? Eigen::Vector3f(twice / length) : Eigen::Vector3f::Zero(),
                 0.5F * length};
  }
  return shapes;
}

/// The triangle's area in the image, pixels², or 0 where it is not wholly inside.
float projected_area(const PreparedView& view, const std::array<uint32_t, 3>& triangle) {
  const Intrinsics& k = view.camera->intrinsics;
  for (const uint32_t v : triangle) {
    const Eigen::Vector3f& p = view.projected[v];
    const float x = p.x() + static_cast<float>(view.left), y = p.y() + static_cast<float>(view.top);
    if (!(p.z() > 0 && x >= 0 && y >= 0 && x <= static_cast<float>(k.width - 1) &&
          y <= static_cast<float>(k.height - 1)))
      return 0;
  }
  const Eigen::Vector2f a = view.projected[triangle[0]].head<2>(), b = view.projected[triangle[1]].head<2>(),
                        c = view.projected[triangle[2]].head<2>();
  return 0.5F * std::abs((b - a).x() * (c - a).y() - (b - a).y() * (c - a).x());
}

}  // namespace

CameraRatings rate_cameras(const Mesh& mesh, std::span<const PreparedView> views, const Work& work) {
  constexpr float least_cosine = 0.08F;  // beyond 85° a pixel's colour says little
  constexpr float off_surface_m = 0.002F;
  const Occluder occluder(mesh);
  const std::vector<TriangleShape> shapes = shapes_of(mesh);
  std::vector<float> area_around(mesh.positions.size(), 0.0F);
  for (size_t t = 0; t < shapes.size(); ++t)
    for (const uint32_t v : mesh.triangles[t]) area_around[v] += shapes[t].area;

  CameraRatings ratings;
  ratings.cameras = views.size();
  ratings.of_vertex.assign(mesh.positions.size() * views.size(), 0.0F);
  std::vector<std::vector<uint8_t>> seen(views.size(), std::vector<uint8_t>(mesh.triangles.size(), 0));
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t c = begin; c < end; ++c) {
      const Eigen::Vector3f eye = views[c].camera->center().cast<float>();
      for (size_t t = 0; t < shapes.size(); ++t) {
        const TriangleShape& shape = shapes[t];
        const Eigen::Vector3f to_eye = eye - shape.middle;
        const float distance = to_eye.norm();
        if (!(shape.normal.dot(to_eye) > least_cosine * distance)) continue;
        const float area_px = projected_area(views[c], mesh.triangles[t]);
        if (!(area_px > 0)) continue;
        if (occluder.between(shape.middle + off_surface_m * shape.normal, eye, off_surface_m / distance)) continue;
        seen[c][t] = 1;
        // area_px / area is the triangle's rating; times its area for the weighted mean.
        for (const uint32_t v : mesh.triangles[t])
          if (area_around[v] > 0) ratings.of_vertex[v * views.size() + c] += area_px / area_around[v];
      }
    }
  });
  ratings.triangle_seen.assign(mesh.triangles.size(), 0);
  for (const auto& by_camera : seen)
    for (size_t t = 0; t < by_camera.size(); ++t)
      ratings.triangle_seen[t] = std::max(ratings.triangle_seen[t], by_camera[t]);
  return ratings;
}

}  // namespace booth
