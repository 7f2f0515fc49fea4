#include "pipeline/face/ray_caster.h"

#include <embree3/rtcore.h>

#include <algorithm>

namespace booth {

struct RayCaster::Scene {
  // One thread: building a mesh of this size takes milliseconds, and Embree's own workers would be threads of a stage.
  RTCDevice device = rtcNewDevice("threads=1");
  RTCScene scene = rtcNewScene(device);
  ~Scene() {
    rtcReleaseScene(scene);
    rtcReleaseDevice(device);
  }
  Scene() = default;
  Scene(const Scene&) = delete;
  Scene& operator=(const Scene&) = delete;
};

RayCaster::RayCaster(const Mesh& mesh) : scene_(std::make_unique<Scene>()) {
  rtcSetSceneFlags(scene_->scene, RTC_SCENE_FLAG_ROBUST);
  RTCGeometry geometry = rtcNewGeometry(scene_->device, RTC_GEOMETRY_TYPE_TRIANGLE);
  // Embree reads 16 bytes at each vertex of 12, so it gets a padded copy.
  auto* positions = static_cast<float*>(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                                                3 * sizeof(float), mesh.positions.size()));
  for (size_t v = 0; v < mesh.positions.size(); ++v) std::copy_n(mesh.positions[v].data(), 3, positions + 3 * v);
  auto* corners = static_cast<uint32_t*>(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                                                 3 * sizeof(uint32_t), mesh.triangles.size()));
  for (size_t t = 0; t < mesh.triangles.size(); ++t) std::copy_n(mesh.triangles[t].data(), 3, corners + 3 * t);
  rtcCommitGeometry(geometry);
  rtcAttachGeometry(scene_->scene, geometry);
  rtcReleaseGeometry(geometry);
  rtcCommitScene(scene_->scene);
}

RayCaster::~RayCaster() = default;

std::optional<RayCaster::Hit> RayCaster::cast(const Eigen::Vector3f& origin, const Eigen::Vector3f& direction,
                                              float nearest_m, float farthest_m) const {
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  RTCRayHit ray{};
  ray.ray.org_x = origin.x();
  ray.ray.org_y = origin.y();
  ray.ray.org_z = origin.z();
  ray.ray.dir_x = direction.x();
  ray.ray.dir_y = direction.y();
  ray.ray.dir_z = direction.z();
  ray.ray.tnear = nearest_m;
  ray.ray.tfar = farthest_m;
  ray.ray.mask = ~0U;
  ray.hit.geomID = RTC_INVALID_GEOMETRY_ID;
  rtcIntersect1(scene_->scene, &context, &ray);
  if (ray.hit.geomID == RTC_INVALID_GEOMETRY_ID) return std::nullopt;
  return Hit{ray.ray.tfar, ray.hit.primID};
}

}  // namespace booth
