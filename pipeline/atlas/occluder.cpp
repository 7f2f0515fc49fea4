#include "pipeline/atlas/occluder.h"

#include <embree3/rtcore.h>

#include <limits>
#include <stdexcept>

namespace booth {

struct Occluder::Scene {
  RTCDevice device = rtcNewDevice("threads=1,set_affinity=0");
  RTCScene scene = device != nullptr ? rtcNewScene(device) : nullptr;

  Scene() {
    if (device == nullptr) throw std::runtime_error("the ray tracer could not be set up");
  }
  ~Scene() {
    rtcReleaseScene(scene);
    rtcReleaseDevice(device);
  }
  Scene(const Scene&) = delete;
  Scene& operator=(const Scene&) = delete;
};

Occluder::Occluder(const Mesh& mesh) : scene_(std::make_unique<Scene>()) {
  RTCGeometry geometry = rtcNewGeometry(scene_->device, RTC_GEOMETRY_TYPE_TRIANGLE);
  auto* positions = static_cast<float*>(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                                                3 * sizeof(float), mesh.positions.size()));
  for (size_t v = 0; v < mesh.positions.size(); ++v)
    for (int k = 0; k < 3; ++k) positions[3 * v + static_cast<size_t>(k)] = mesh.positions[v][k];
  auto* indices = static_cast<uint32_t*>(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                                                 3 * sizeof(uint32_t), mesh.triangles.size()));
  for (size_t t = 0; t < mesh.triangles.size(); ++t)
    for (size_t k = 0; k < 3; ++k) indices[3 * t + k] = mesh.triangles[t][k];
  rtcCommitGeometry(geometry);
  rtcAttachGeometry(scene_->scene, geometry);
  rtcReleaseGeometry(geometry);
  rtcCommitScene(scene_->scene);
}

Occluder::~Occluder() = default;

bool Occluder::between(const Eigen::Vector3f& from, const Eigen::Vector3f& to, float skip) const {
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
  rtcOccluded1(scene_->scene, &context, &ray);
  return ray.tfar < 0;
}

}  // namespace booth
