#include "tests/synthetic/scene.h"

#include <cmath>
#include <memory>
#include <numbers>
#include <random>
#include <string>

#include "pipeline/geometry/camera_model.h"

namespace booth::synthetic {
namespace {

/// Whether nothing of the body is inside the cone around a ray; may say no where there is nothing.
bool is_clear(const Body& body, const Eigen::Vector3d& origin, const Eigen::Vector3d& direction,
              double half_angle_rad) {
  const Eigen::AlignedBox3d box = bounds(body);
  const double far = (box.center() - origin).norm() + box.diagonal().norm();
  for (double along = 0; along < far;) {
    const double free = signed_distance(body, origin + along * direction) - along * std::tan(half_angle_rad);
    constexpr double too_little_m = 0.002;
    if (free < too_little_m) return false;
    along += free;
  }
  return true;
}

/// Calls `visit(x, y, hits)` for every pixel, with the hits of a regular pattern of rays in it.
template <class Visitor>
void for_each_pixel(const Body& body, const RigCamera& camera, int samples, const Visitor& visit) {
  const Eigen::Vector3d origin = camera.center();
  const Intrinsics& k = camera.intrinsics;
  constexpr int tile = 8;  // most tiles are empty, which one ray down their middle finds
  std::vector<Eigen::Vector3d> hits;
  for (int top = 0; top < k.height; top += tile)
    for (int left = 0; left < k.width; left += tile) {
      const Eigen::Vector3d middle = world_ray(camera, {left + 0.5 * (tile - 1), top + 0.5 * (tile - 1)});
      double half_angle_rad = 0;
      for (const double x : {left - 0.5, left + tile - 0.5})
        for (const double y : {top - 0.5, top + tile - 0.5})
          half_angle_rad = std::max(half_angle_rad, std::acos(std::min(1.0, middle.dot(world_ray(camera, {x, y})))));
      const bool empty = is_clear(body, origin, middle, half_angle_rad);
      for (int y = top; y < std::min(top + tile, k.height); ++y)
        for (int x = left; x < std::min(left + tile, k.width); ++x) {
          hits.clear();
          for (int sample = 0; sample < samples * samples && !empty; ++sample) {
            const Eigen::Vector2d pixel(x - 0.5 + (sample % samples + 0.5) / samples,
                                        y - 0.5 + (sample / samples + 0.5) / samples);
            if (Eigen::Vector3d hit; trace(body, origin, world_ray(camera, pixel), &hit)) hits.push_back(hit);
          }
          visit(x, y, hits);
        }
    }
}

uint8_t to_byte(double share) { return static_cast<uint8_t>(std::lround(255 * std::clamp(share, 0.0, 1.0))); }

}  // namespace

Rig ring_rig(const RigOptions& options) {
  Rig rig;
  rig.name = "synthetic-ring";
  rig.volume = Eigen::AlignedBox3d(Eigen::Vector3d(-0.9, 0, -0.6), Eigen::Vector3d(0.9, 2.2, 0.6));
  std::mt19937 random(options.seed);
  std::uniform_real_distribution<double> jitter(-1, 1);
  for (int i = 0; i < options.cameras; ++i) {
    RigCamera camera;
    camera.id = "body-" + std::string(i < 10 ? "0" : "") + std::to_string(i);
    Intrinsics& k = camera.intrinsics;
    k.width = options.width;
    k.height = options.height;
    k.fx = k.fy = 1.05 * options.height * options.distance_m / 2.6;
    k.cx = 0.5 * (options.width - 1) + jitter(random);
    k.cy = 0.5 * (options.height - 1) + jitter(random);
    if (options.distorted) k.distortion = {-0.05 + 0.01 * jitter(random), 0.008, 0.0004 * jitter(random), 0.0003, 0};
    const double azimuth = 2 * std::numbers::pi * i / options.cameras;
    const Eigen::Vector3d center(options.distance_m * std::sin(azimuth), i % 2 == 0 ? 1.0 : 1.8,
                                 options.distance_m * std::cos(azimuth));
    const Eigen::Vector3d forward = (Eigen::Vector3d(0, 0.95, 0) - center).normalized();
    const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitY()).normalized();
    Eigen::Matrix3d rotation;
    rotation.row(0) = right;
    rotation.row(1) = forward.cross(right);
    rotation.row(2) = forward;
    camera.camera_from_world.linear() = rotation;
    camera.camera_from_world.translation() = -rotation * center;
    rig.cameras.push_back(camera);
  }
  return rig;
}

bool trace(const Body& body, const Eigen::Vector3d& origin, const Eigen::Vector3d& direction, Eigen::Vector3d* hit) {
  // Skip to the bounding box first: most rays of a picture miss it.
  const Eigen::AlignedBox3d box = bounds(body);
  double near = 0, far = 10;
  for (int axis = 0; axis < 3; ++axis) {
    const double a = (box.min()[axis] - origin[axis]) / direction[axis];
    const double b = (box.max()[axis] - origin[axis]) / direction[axis];
    near = std::max(near, std::min(a, b));
    far = std::min(far, std::max(a, b));
  }
  constexpr double on_surface_m = 2e-5;
  for (double along = near; along < far;) {
    const Eigen::Vector3d p = origin + along * direction;
    const double distance = signed_distance(body, p);
    if (distance < on_surface_m) {
      *hit = p;
      return true;
    }
    along += distance;
  }
  return false;
}

Silhouette render_silhouette(const Body& body, const RigCamera& camera, int samples) {
  Silhouette silhouette{camera.id, Image(camera.intrinsics.width, camera.intrinsics.height, 1)};
  for_each_pixel(body, camera, samples, [&](int x, int y, const std::vector<Eigen::Vector3d>& hits) {
    silhouette.coverage.at(x, y) = to_byte(static_cast<double>(hits.size()) / (samples * samples));
  });
  return silhouette;
}

std::vector<Silhouette> render_silhouettes(const Body& body, const Rig& rig, int samples) {
  std::vector<Silhouette> silhouettes;
  for (const RigCamera& camera : rig.cameras) silhouettes.push_back(render_silhouette(body, camera, samples));
  return silhouettes;
}

Eigen::Vector3d colour_at(const Eigen::Vector3d& p) {
  return {0.5 + 0.3 * std::sin(5 * p.y()), 0.5 + 0.3 * std::sin(7 * p.x() + 1), 0.5 + 0.3 * std::cos(9 * p.z())};
}

Eigen::Vector3d cloth_at(const Eigen::Vector3d& p) {
  constexpr double speckle_m = 0.02;
  const Eigen::Vector3d at = p / speckle_m;
  const Eigen::Vector3d first = at.array().floor(), share = at - first;
  double grey = 0;
  for (int corner = 0; corner < 8; ++corner) {
    uint32_t hash = 1;
    double weight = 1;
    for (int axis = 0; axis < 3; ++axis) {
      const int step = corner >> axis & 1;
      hash = (hash ^ static_cast<uint32_t>(static_cast<int>(first[axis]) + step)) * 2654435761U;
      hash ^= hash >> 15;
      weight *= step == 1 ? share[axis] : 1 - share[axis];
    }
    grey += weight * (hash >> 8) / static_cast<double>(1U << 24);
  }
  return Eigen::Vector3d::Constant(grey);
}

Frame render_photograph(const Body& body, const RigCamera& camera, int samples, const Paint& paint) {
  auto image = std::make_shared<Image>(camera.intrinsics.width, camera.intrinsics.height, 3);
  const Eigen::Vector3d wall(0.75, 0.76, 0.74);
  for_each_pixel(body, camera, samples, [&](int x, int y, const std::vector<Eigen::Vector3d>& hits) {
    Eigen::Vector3d colour = wall * (samples * samples - static_cast<int>(hits.size()));
    for (const Eigen::Vector3d& hit : hits) colour += paint(hit);
    for (int c = 0; c < 3; ++c) image->at(x, y, c) = to_byte(colour[c] / (samples * samples));
  });
  Frame frame;
  frame.camera = camera.id;
  frame.pixels = std::move(image);
  return frame;
}

}  // namespace booth::synthetic
