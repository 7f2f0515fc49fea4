#include "tests/quality/measures.h"

#include <embree3/rtcore.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "pipeline/geometry/camera_model.h"

namespace booth::quality {
namespace {

double to_linear(double srgb) { return srgb <= 0.04045 ? srgb / 12.92 : std::pow((srgb + 0.055) / 1.055, 2.4); }
double to_srgb(double linear) {
  linear = std::clamp(linear, 0.0, 1.0);
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * std::pow(linear, 1 / 2.4) - 0.055;
}

/// The texture at a uv, bilinear, in linear light.
Eigen::Vector3d sample_linear(const Image& image, const Eigen::Vector2f& uv) {
  const double x = std::clamp<double>(static_cast<double>(uv.x()) * image.width - 0.5, 0, image.width - 1);
  const double y = std::clamp<double>(static_cast<double>(uv.y()) * image.height - 0.5, 0, image.height - 1);
  const int left = std::min(static_cast<int>(x), image.width - 2),
            top = std::min(static_cast<int>(y), image.height - 2);
  const double fx = x - left, fy = y - top;
  Eigen::Vector3d colour;
  for (int c = 0; c < 3; ++c) {
    const auto texel = [&](int dx, int dy) { return to_linear(image.at(left + dx, top + dy, c) / 255.0); };
    colour[c] =
        (1 - fy) * ((1 - fx) * texel(0, 0) + fx * texel(1, 0)) + fy * ((1 - fx) * texel(0, 1) + fx * texel(1, 1));
  }
  return colour;
}

}  // namespace

struct RayCaster::Scene {
  RTCDevice device = rtcNewDevice("threads=1");
  RTCScene scene = rtcNewScene(device);
  ~Scene() {
    rtcReleaseScene(scene);
    rtcReleaseDevice(device);
  }
};

RayCaster::RayCaster(const Mesh& mesh) : scene_(std::make_unique<Scene>()) {
  RTCGeometry geometry = rtcNewGeometry(scene_->device, RTC_GEOMETRY_TYPE_TRIANGLE);
  void* positions = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 3 * sizeof(float),
                                            mesh.positions.size());
  std::memcpy(positions, mesh.positions.data(), mesh.positions.size() * 3 * sizeof(float));
  void* triangles = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 3 * sizeof(uint32_t),
                                            mesh.triangles.size());
  std::memcpy(triangles, mesh.triangles.data(), mesh.triangles.size() * 3 * sizeof(uint32_t));
  rtcCommitGeometry(geometry);
  rtcAttachGeometry(scene_->scene, geometry);
  rtcReleaseGeometry(geometry);
  rtcCommitScene(scene_->scene);
}

RayCaster::~RayCaster() = default;

std::optional<Hit> RayCaster::cast(const Eigen::Vector3d& origin, const Eigen::Vector3d& direction) const {
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  RTCRayHit ray{};
  const Eigen::Vector3f from = origin.cast<float>(), along = direction.cast<float>();
  ray.ray.org_x = from.x();
  ray.ray.org_y = from.y();
  ray.ray.org_z = from.z();
  ray.ray.dir_x = along.x();
  ray.ray.dir_y = along.y();
  ray.ray.dir_z = along.z();
  ray.ray.tfar = std::numeric_limits<float>::infinity();
  ray.ray.mask = ~0U;
  ray.hit.geomID = RTC_INVALID_GEOMETRY_ID;
  rtcIntersect1(scene_->scene, &context, &ray);
  if (ray.hit.geomID == RTC_INVALID_GEOMETRY_ID) return std::nullopt;
  return Hit{ray.hit.primID, {1 - ray.hit.u - ray.hit.v, ray.hit.u, ray.hit.v}};
}

double silhouette_iou(const RayCaster& caster, const RigCamera& camera, const Image& true_coverage, int step) {
  const Eigen::Vector3d center = camera.center();
  size_t both = 0, either = 0;
  for (int y = 0; y < camera.intrinsics.height; y += step)
    for (int x = 0; x < camera.intrinsics.width; x += step) {
      const bool made = caster.cast(center, world_ray(camera, Eigen::Vector2d(x, y))).has_value();
      const bool wanted = true_coverage.at(x, y) >= 128;
      both += made && wanted;
      either += made || wanted;
    }
  return either == 0 ? 0 : static_cast<double>(both) / static_cast<double>(either);
}

double view_psnr_db(const RayCaster& caster, const Avatar& avatar, const CalibratedView& view, const Image& photograph,
                    const std::array<uint8_t, 3>& background) {
  const auto is_subject = [&](int x, int y) {
    constexpr int tolerance = 3;
    for (int c = 0; c < 3; ++c)
      if (std::abs(photograph.at(x, y, c) - background[static_cast<size_t>(c)]) > tolerance) return true;
    return false;
  };
  constexpr int rim = 2;  // pixels at the outline mix subject and background
  const auto is_inside = [&](int x, int y) {
    for (int dy = -rim; dy <= rim; dy += rim)
      for (int dx = -rim; dx <= rim; dx += rim)
        if (!photograph.contains(x + dx, y + dy) || !is_subject(x + dx, y + dy)) return false;
    return true;
  };
  std::vector<std::array<double, 3>> made, wanted;
  double cross = 0, square = 0;
  for (int y = 0; y < photograph.height; ++y)
    for (int x = 0; x < photograph.width; ++x) {
      if (!is_inside(x, y)) continue;
      const auto hit = caster.cast(view.center(), world_ray(view, Eigen::Vector2d(x, y)));
      if (!hit) continue;
      const auto& corners = avatar.atlas.uv[hit->triangle];
      const Eigen::Vector2f uv = hit->corner_weights[0] * corners[0] + hit->corner_weights[1] * corners[1] +
                                 hit->corner_weights[2] * corners[2];
      const Eigen::Vector3d colour = sample_linear(avatar.atlas.image, uv);
      std::array<double, 3> true_colour{};
      for (int c = 0; c < 3; ++c) {
        true_colour[static_cast<size_t>(c)] = photograph.at(x, y, c) / 255.0;
        cross += colour[c] * to_linear(photograph.at(x, y, c) / 255.0);
      }
      square += colour.squaredNorm();
      made.push_back({colour[0], colour[1], colour[2]});
      wanted.push_back(true_colour);
    }
  if (made.empty()) return 0;
  const double gain = cross / std::max(square, 1e-12);
  double error = 0;
  for (size_t i = 0; i < made.size(); ++i)
    for (size_t c = 0; c < 3; ++c) error += std::pow(to_srgb(gain * made[i][c]) - wanted[i][c], 2);
  return -10 * std::log10(std::max(error / (3.0 * static_cast<double>(made.size())), 1e-12));
}

}  // namespace booth::quality
