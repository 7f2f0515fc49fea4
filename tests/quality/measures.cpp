#include "tests/quality/measures.h"

#include <embree3/rtcore.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <fstream>
#include <limits>
#include <random>
#include <stdexcept>
#include <string>
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

/// Linear light of the avatar's texture.
Eigen::Vector3d texture_at(const Avatar& avatar, const Hit& hit) {
  const auto& corners = avatar.atlas.uv[hit.triangle];
  const Eigen::Vector2f uv =
      hit.corner_weights[0] * corners[0] + hit.corner_weights[1] * corners[1] + hit.corner_weights[2] * corners[2];
  return sample_linear(avatar.atlas.image, uv);
}

}  // namespace

struct RayCaster::Scene {
  explicit Scene(const Mesh& shape) : mesh(shape) {}
  Mesh mesh;
  RTCDevice device = rtcNewDevice("threads=1");
  RTCScene scene = rtcNewScene(device);
  ~Scene() {
    rtcReleaseScene(scene);
    rtcReleaseDevice(device);
  }
};

RayCaster::RayCaster(const Mesh& mesh) : scene_(std::make_unique<Scene>(mesh)) {
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

namespace {

/// The point of a triangle next to p (C. Ericson, "Real-Time Collision Detection", 5.1.5).
Eigen::Vector3f nearest_on_triangle(const Eigen::Vector3f& p, const Eigen::Vector3f& a, const Eigen::Vector3f& b,
                                    const Eigen::Vector3f& c) {
  const Eigen::Vector3f ab = b - a, ac = c - a, ap = p - a, bp = p - b, cp = p - c;
  const float d1 = ab.dot(ap), d2 = ac.dot(ap), d3 = ab.dot(bp), d4 = ac.dot(bp), d5 = ab.dot(cp), d6 = ac.dot(cp);
  if (d1 <= 0 && d2 <= 0) return a;
  if (d3 >= 0 && d4 <= d3) return b;
  if (d6 >= 0 && d5 <= d6) return c;
  const float vc = d1 * d4 - d3 * d2, vb = d5 * d2 - d1 * d6, va = d3 * d6 - d5 * d4;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return a + d1 / (d1 - d3) * ab;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return a + d2 / (d2 - d6) * ac;
  if (va <= 0 && d4 >= d3 && d5 >= d6) return b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b);
  const float sum = va + vb + vc;
  return a + vb / sum * ab + vc / sum * ac;
}

}  // namespace

double RayCaster::distance_m(const Eigen::Vector3d& p) const {
  struct Nearest {
    const Mesh& mesh;
    Eigen::Vector3f point;
    float distance;
  } nearest{scene_->mesh, p.cast<float>(), std::numeric_limits<float>::infinity()};
  RTCPointQuery query{};
  query.x = nearest.point.x();
  query.y = nearest.point.y();
  query.z = nearest.point.z();
  query.radius = std::numeric_limits<float>::infinity();
  RTCPointQueryContext context;
  rtcInitPointQueryContext(&context);
  const auto look = [](RTCPointQueryFunctionArguments* arguments) {
    auto* found = static_cast<Nearest*>(arguments->userPtr);
    const auto& [a, b, c] = found->mesh.triangles[arguments->primID];
    const auto& at = found->mesh.positions;
    const float distance = (nearest_on_triangle(found->point, at[a], at[b], at[c]) - found->point).norm();
    if (distance >= found->distance) return false;
    found->distance = arguments->query->radius = distance;
    return true;
  };
  rtcPointQuery(scene_->scene, &query, &context, look, &nearest);
  return static_cast<double>(nearest.distance);
}

Mesh read_ply(const std::filesystem::path& file) {
  std::ifstream stream(file, std::ios::binary);
  stream.exceptions(std::ios::failbit | std::ios::badbit);
  size_t vertices = 0, faces = 0, floats = 0, colour_bytes = 0;
  for (std::string line; line != "end_header";) {
    std::getline(stream, line);
    if (line.rfind("element vertex ", 0) == 0) vertices = std::stoul(line.substr(15));
    if (line.rfind("element face ", 0) == 0) faces = std::stoul(line.substr(13));
    if (line.rfind("property float ", 0) == 0) ++floats;
    if (line.rfind("property uchar ", 0) == 0) ++colour_bytes;
  }
  Mesh mesh;
  mesh.positions.resize(vertices);
  std::array<char, 32> skipped{};
  if (floats < 3) throw std::runtime_error(file.string() + ": a vertex has no position");
  const size_t others = (floats - 3) * sizeof(float) + colour_bytes;
  if (others > skipped.size()) throw std::runtime_error(file.string() + ": too many properties");
  for (Eigen::Vector3f& p : mesh.positions) {
    stream.read(reinterpret_cast<char*>(p.data()), 3 * sizeof(float));
    stream.read(skipped.data(), static_cast<std::streamsize>(others));
  }
  mesh.triangles.resize(faces);
  for (auto& triangle : mesh.triangles) {
    if (stream.get() != 3) throw std::runtime_error(file.string() + ": a face is no triangle");
    stream.read(reinterpret_cast<char*>(triangle.data()), sizeof(triangle));
  }
  return mesh;
}

std::vector<Eigen::Vector3d> sample_surface(const Mesh& mesh, size_t count) {
  std::vector<double> area_up_to;
  double area = 0;
  for (const auto& [a, b, c] : mesh.triangles) {
    const Eigen::Vector3d ab = (mesh.positions[b] - mesh.positions[a]).cast<double>();
    area_up_to.push_back(area += ab.cross((mesh.positions[c] - mesh.positions[a]).cast<double>()).norm());
  }
  std::mt19937 random(1);
  const auto share = [&random] { return static_cast<double>(random()) / 4294967296.0; };
  std::vector<Eigen::Vector3d> points;
  for (size_t n = 0; n < count; ++n) {
    // Strata of equal area, a point somewhere in each.
    const double at = (static_cast<double>(n) + share()) / static_cast<double>(count) * area;
    const auto found = std::lower_bound(area_up_to.begin(), area_up_to.end(), at);
    const auto& [a, b, c] = mesh.triangles[static_cast<size_t>(found - area_up_to.begin())];
    const double root = std::sqrt(share()), v = share();
    points.push_back((1 - root) * mesh.positions[a].cast<double>() + root * (1 - v) * mesh.positions[b].cast<double>() +
                     root * v * mesh.positions[c].cast<double>());
  }
  return points;
}

std::vector<Eigen::Vector3d> seen_points(std::span<const Eigen::Vector3d> points, const RayCaster& caster,
                                         const Rig& rig) {
  constexpr double self_m = 1e-3;  // a ray starts so far off the surface
  std::vector<Eigen::Vector3d> seen;
  for (const Eigen::Vector3d& p : points) {
    const bool by_any = std::any_of(rig.cameras.begin(), rig.cameras.end(), [&](const RigCamera& camera) {
      const auto pixel = project(camera, p);
      if (!pixel) return false;
      const Eigen::Vector2d at = *pixel;
      if (at.x() < 0 || at.y() < 0 || at.x() > camera.intrinsics.width - 1 || at.y() > camera.intrinsics.height - 1)
        return false;
      const Eigen::Vector3d direction = (camera.center() - p).normalized();
      return !caster.cast(p + self_m * direction, direction);
    });
    if (by_any) seen.push_back(p);
  }
  return seen;
}

double mean_distance_m(std::span<const Eigen::Vector3d> points, const RayCaster& to) {
  double sum = 0;
  for (const Eigen::Vector3d& p : points) sum += to.distance_m(p);
  return sum / static_cast<double>(points.size());
}

MaskAgreement compare_masks(const Image& coverage, const Image& true_coverage) {
  size_t both = 0, either = 0;
  double smaller = 0, larger = 0;
  for (int y = 0; y < coverage.height; ++y)
    for (int x = 0; x < coverage.width; ++x) {
      const int made = coverage.at(x, y), wanted = true_coverage.at(x, y);
      both += made >= 128 && wanted >= 128;
      either += made >= 128 || wanted >= 128;
      smaller += std::min(made, wanted);
      larger += std::max(made, wanted);
    }
  return {static_cast<double>(both) / static_cast<double>(either), smaller / larger};
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
      const Eigen::Vector3d colour = texture_at(avatar, *hit);
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

Image render_view(const RayCaster& caster, const Avatar& avatar, const CalibratedView& view, const Window& window,
                  const std::array<uint8_t, 3>& background) {
  constexpr std::array<double, 2> offsets{-0.25, 0.25};
  const Eigen::Vector3d behind(to_linear(background[0] / 255.0), to_linear(background[1] / 255.0),
                               to_linear(background[2] / 255.0));
  Image picture(window.width, window.height, 3);
  for (int y = 0; y < window.height; ++y)
    for (int x = 0; x < window.width; ++x) {
      Eigen::Vector3d light = Eigen::Vector3d::Zero();
      for (const double dy : offsets)
        for (const double dx : offsets) {
          const Eigen::Vector2d pixel(window.left + x + dx, window.top + y + dy);
          const auto hit = caster.cast(view.center(), world_ray(view, pixel));
          light += 0.25 * (hit ? texture_at(avatar, *hit) : behind);
        }
      for (int c = 0; c < 3; ++c)
        picture.at(x, y, c) = static_cast<uint8_t>(std::lround(255 * std::clamp(to_srgb(light[c]), 0.0, 1.0)));
    }
  return picture;
}

}  // namespace booth::quality
