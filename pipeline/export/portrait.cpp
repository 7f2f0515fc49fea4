#include "pipeline/export/portrait.h"

#include <embree3/rtcore.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <numbers>
#include <span>
#include <stdexcept>
#include <type_traits>
#include <vector>

namespace booth {
namespace {

constexpr double vertical_view_rad = 0.4;  // a long lens, as portraits are taken with
constexpr double margin = 0.04;            // of width and height, on each side

// ---- where the viewer stands ----------------------------------------------------------------------------------------

/// Camera frame: +x right, +y down, +z forward.
struct Viewer {
  Eigen::Matrix3d rotation;  ///< camera_from_world
  Eigen::Vector3d center;    ///< world frame
  double focal_px = 0;

  Eigen::Vector3d to_camera(const Eigen::Vector3d& p_world) const { return rotation * (p_world - center); }
};

/// Looks from that direction; where from is still open.
Viewer look_from(double azimuth_rad, double elevation_rad) {
  Viewer viewer;
  const Eigen::Vector3d towards_viewer(std::sin(azimuth_rad) * std::cos(elevation_rad), std::sin(elevation_rad),
                                       std::cos(azimuth_rad) * std::cos(elevation_rad));
  viewer.rotation.row(0) = Eigen::Vector3d(std::cos(azimuth_rad), 0, -std::sin(azimuth_rad));
  viewer.rotation.row(2) = -towards_viewer;
  viewer.rotation.row(1) = viewer.rotation.row(2).cross(viewer.rotation.row(0));
  return viewer;
}

/// How far from `middle` (world frame) a viewer of that rotation has to stand so that every vertex projects inside the
/// margins.
double distance_for(const Mesh& mesh, const Viewer& viewer, const Eigen::Vector3d& middle, int width, int height) {
  const double half_tangent_y = std::tan(vertical_view_rad / 2) * (1 - 2 * margin);
  const double half_tangent_x = half_tangent_y * width / height;
  constexpr double nearest_m = 0.05;  // to the nearest vertex
  double distance = 0;
  for (const Eigen::Vector3f& p : mesh.positions) {
    const Eigen::Vector3d q = viewer.rotation * (p.cast<double>() - middle);
    distance = std::max({distance, std::abs(q.x()) / half_tangent_x - q.z(), std::abs(q.y()) / half_tangent_y - q.z(),
                         nearest_m - q.z()});
  }
  return distance;
}

void stand_back(const Eigen::Vector3d& middle, double distance, int height, Viewer& viewer) {
  viewer.center = middle - viewer.rotation.transpose() * Eigen::Vector3d(0, 0, distance);
  viewer.focal_px = height / 2.0 / std::tan(vertical_view_rad / 2);
}

Viewer place_viewer(const Mesh& mesh, const PortraitOptions& options) {
  Viewer viewer = look_from(options.azimuth_rad, options.elevation_rad);
  Eigen::AlignedBox3d seen;  // in camera directions, around the world's origin
  for (const Eigen::Vector3f& p : mesh.positions) seen.extend(viewer.rotation * p.cast<double>());
  const Eigen::Vector3d middle = viewer.rotation.transpose() * seen.center();
  stand_back(middle, distance_for(mesh, viewer, middle, options.width, options.height), options.height, viewer);
  return viewer;
}

// ---- light ----------------------------------------------------------------------------------------------------------

struct ReleaseDevice {
  void operator()(RTCDevice device) const { rtcReleaseDevice(device); }
};
struct ReleaseScene {
  void operator()(RTCScene scene) const { rtcReleaseScene(scene); }
};

/// The mesh, ready for shadow rays.
class Occluder {
 public:
  explicit Occluder(const Mesh& mesh) : device_(rtcNewDevice("threads=1,set_affinity=0")) {
    if (!device_) throw std::runtime_error("render_portrait: Embree refused to start");
    scene_.reset(rtcNewScene(device_.get()));
    const RTCGeometry geometry = rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_TRIANGLE);
    // Embree reads 16 bytes of the last vertex, so it gets a copy of its own that it pads.
    auto* positions = static_cast<Eigen::Vector3f*>(rtcSetNewGeometryBuffer(
        geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, sizeof(Eigen::Vector3f), mesh.positions.size()));
    auto* triangles = static_cast<std::array<uint32_t, 3>*>(rtcSetNewGeometryBuffer(
        geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, sizeof(std::array<uint32_t, 3>), mesh.triangles.size()));
    if (positions == nullptr || triangles == nullptr) throw std::bad_alloc();
    std::copy(mesh.positions.begin(), mesh.positions.end(), positions);
    std::copy(mesh.triangles.begin(), mesh.triangles.end(), triangles);
    rtcCommitGeometry(geometry);
    rtcAttachGeometry(scene_.get(), geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(scene_.get());
  }

  bool blocks(const Eigen::Vector3f& origin, const Eigen::Vector3f& direction) const {
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    RTCRay ray{};
    ray.org_x = origin.x();
    ray.org_y = origin.y();
    ray.org_z = origin.z();
    ray.dir_x = direction.x();
    ray.dir_y = direction.y();
    ray.dir_z = direction.z();
    ray.tfar = std::numeric_limits<float>::infinity();
    ray.mask = std::numeric_limits<unsigned>::max();
    rtcOccluded1(scene_.get(), &context, &ray);
    return ray.tfar < 0;
  }

 private:
  std::unique_ptr<std::remove_pointer_t<RTCDevice>, ReleaseDevice> device_;
  std::unique_ptr<std::remove_pointer_t<RTCScene>, ReleaseScene> scene_;
};

/// One of the lamps that the dome consists of, infinitely far away.
struct Lamp {
  Eigen::Vector3f direction;  ///< towards it
  float strength;
};

/// Lamps spread evenly over the sphere: bright above, dimmer below. `key` is how much brighter it is around a point
/// above the viewer's left shoulder. Scaled so that an unshadowed surface which faces the viewer receives 1.
std::vector<Lamp> light_dome(const Viewer& viewer, double key_light) {
  constexpr int lamps = 128;
  constexpr double floor_light = 0.45, sky_light = 0.35, key_sharpness = 6;
  const Eigen::Vector3d towards_viewer = -viewer.rotation.row(2).transpose();
  const Eigen::Vector3d key =
      (towards_viewer - 0.55 * viewer.rotation.row(0).transpose() + Eigen::Vector3d(0, 0.75, 0)).normalized();
  std::vector<Lamp> dome;
  double facing = 0;
  for (int i = 0; i < lamps; ++i) {
    // The spherical Fibonacci lattice.
    const double y = 1 - (2 * i + 1.0) / lamps, radius = std::sqrt(1 - y * y);
    const double angle = 2 * std::numbers::pi * i / std::numbers::phi;
    const Eigen::Vector3d direction(radius * std::cos(angle), y, radius * std::sin(angle));
    const double strength = floor_light + sky_light * (0.5 + 0.5 * y) +
                            key_light * std::pow(std::max(0.0, direction.dot(key)), key_sharpness);
    dome.push_back({direction.cast<float>(), static_cast<float>(strength)});
    facing += strength * std::max(0.0, direction.dot(towards_viewer));
  }
  for (Lamp& lamp : dome) lamp.strength /= static_cast<float>(facing);
  return dome;
}

/// What every vertex receives from the lamps that it sees, about 0 … 1.2. With a viewer, nothing where it is turned
/// away so far that it can only be seen from inside.
std::vector<float> light_at_vertices(const Mesh& mesh, const std::vector<Lamp>& dome, const Viewer* viewer,
                                     const Work& work) {
  const std::vector<Eigen::Vector3f> normals = vertex_normals(mesh);
  const Occluder occluder(mesh);
  std::vector<float> light(mesh.positions.size(), 0);
  constexpr size_t grain = 256;
  work.parallel_for(light.size(), grain, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end; ++v) {
      constexpr float turned_away = -0.5F;  // cosine; triangles at the outline reach a little behind it
      if (viewer != nullptr &&
          normals[v].dot((viewer->center.cast<float>() - mesh.positions[v]).normalized()) < turned_away)
        continue;
      constexpr float lift_m = 1e-3F;  // off the vertex's own triangles
      const Eigen::Vector3f origin = mesh.positions[v] + lift_m * normals[v];
      for (const Lamp& lamp : dome) {
        const float cosine = normals[v].dot(lamp.direction);
        if (cosine > 0 && !occluder.blocks(origin, lamp.direction)) light[v] += cosine * lamp.strength;
      }
    }
  });
  return light;
}

// ---- colour ---------------------------------------------------------------------------------------------------------

float linear_from_srgb(float value) {
  return value <= 0.04045F ? value / 12.92F : std::pow((value + 0.055F) / 1.055F, 2.4F);
}
float srgb_from_linear(float value) {
  return value <= 0.0031308F ? value * 12.92F : 1.055F * std::pow(value, 1 / 2.4F) - 0.055F;
}

/// The atlas, sampled bilinearly in linear light.
class Texture {
 public:
  explicit Texture(const Image& image) : image_(image) {
    for (size_t i = 0; i < linear_.size(); ++i) linear_[i] = linear_from_srgb(static_cast<float>(i) / 255);
  }

  Eigen::Array3f sample(const Eigen::Vector2f& uv) const {
    const float x =
        std::clamp(uv.x() * static_cast<float>(image_.width) - 0.5F, 0.0F, static_cast<float>(image_.width - 1));
    const float y =
        std::clamp(uv.y() * static_cast<float>(image_.height) - 0.5F, 0.0F, static_cast<float>(image_.height - 1));
    const int left = static_cast<int>(x), top = static_cast<int>(y);
    const int right = std::min(left + 1, image_.width - 1), bottom = std::min(top + 1, image_.height - 1);
    const float fx = x - static_cast<float>(left), fy = y - static_cast<float>(top);
    return (1 - fy) * ((1 - fx) * texel(left, top) + fx * texel(right, top)) +
           fy * ((1 - fx) * texel(left, bottom) + fx * texel(right, bottom));
  }

 private:
  Eigen::Array3f texel(int x, int y) const {
    const uint8_t* p = image_.pixel(x, y);
    return {linear_[p[0]], linear_[p[1]], linear_[p[2]]};
  }

  const Image& image_;
  std::array<float, 256> linear_{};
};

// ---- picture --------------------------------------------------------------------------------------------------------

/// A vertex in the picture: position in samples, and the reciprocal of its depth, which is linear there.
struct Projected {
  float x, y, inverse_depth;
};

/// The triangle nearest to the viewer at a sample, and where on it.
struct Fragment {
  float inverse_depth = 0;  ///< 0 infinitely far: nothing
  uint32_t triangle = 0;
  float second = 0, third = 0;  ///< barycentric coordinates in the picture, of those corners
};

/// What the rendering of all rows shares.
struct Picture {
  const Avatar& avatar;
  int width, height;     // pixels
  int samples_per_axis;  // of a pixel
  std::vector<Projected> vertices;
  std::vector<float> light;
  Texture texture;
};

/// Rows of samples [top, bottom) with their fragments.
struct Band {
  int top, bottom, width;
  std::vector<Fragment> fragments;

  Fragment& at(int x, int y) {
    return fragments[static_cast<size_t>(y - top) * static_cast<size_t>(width) + static_cast<size_t>(x)];
  }
};

void rasterise(const Picture& picture, uint32_t triangle, Band& band) {
  const auto& [ia, ib, ic] = picture.avatar.mesh.triangles[triangle];
  const Projected &a = picture.vertices[ia], &b = picture.vertices[ib], &c = picture.vertices[ic];
  const int first_y = std::max(band.top, static_cast<int>(std::ceil(std::min({a.y, b.y, c.y}))));
  const int last_y = std::min(band.bottom - 1, static_cast<int>(std::floor(std::max({a.y, b.y, c.y}))));
  if (first_y > last_y) return;
  const int first_x = std::max(0, static_cast<int>(std::ceil(std::min({a.x, b.x, c.x}))));
  const int last_x = std::min(band.width - 1, static_cast<int>(std::floor(std::max({a.x, b.x, c.x}))));
  const float twice_area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
  if (twice_area == 0) return;
  // Barycentric coordinates grow evenly over the picture.
  const float second_by_x = (c.y - a.y) / twice_area, second_by_y = (a.x - c.x) / twice_area;
  const float third_by_x = (a.y - b.y) / twice_area, third_by_y = (b.x - a.x) / twice_area;
  for (int y = first_y; y <= last_y; ++y) {
    const float dy = static_cast<float>(y) - a.y;
    // Where on the row all three coordinates are positive, a sample more on each side: the test below decides, so that
    // no rounding opens a crack between neighbours.
    float low = static_cast<float>(first_x), high = static_cast<float>(last_x);
    const auto cut = [&](float at_a, float by_x) {
      const float zero = a.x - at_a / by_x;
      if (by_x > 0) low = std::max(low, zero - 1);
      if (by_x < 0) high = std::min(high, zero + 1);
    };
    cut(dy * second_by_y, second_by_x);
    cut(dy * third_by_y, third_by_x);
    cut(1 - dy * (second_by_y + third_by_y), -second_by_x - third_by_x);
    for (int x = static_cast<int>(std::ceil(low)); static_cast<float>(x) <= high; ++x) {
      const float dx = static_cast<float>(x) - a.x;
      const float second = dx * second_by_x + dy * second_by_y;
      const float third = dx * third_by_x + dy * third_by_y;
      if (second < 0 || third < 0 || second + third > 1) continue;
      const float inverse_depth =
          a.inverse_depth + second * (b.inverse_depth - a.inverse_depth) + third * (c.inverse_depth - a.inverse_depth);
      if (Fragment& nearest = band.at(x, y); inverse_depth > nearest.inverse_depth)
        nearest = {inverse_depth, triangle, second, third};
    }
  }
}

/// Linear light that leaves the surface at a fragment.
Eigen::Array3f shade(const Picture& picture, const Fragment& fragment) {
  // The light falls on a texture that was photographed in light: it may only tint, or shadows would count twice.
  constexpr float unshaded = 0.4F;
  const auto& corners = picture.avatar.mesh.triangles[fragment.triangle];
  const auto& uv = picture.avatar.atlas.uv[fragment.triangle];
  const std::array<float, 3> in_picture{1 - fragment.second - fragment.third, fragment.second, fragment.third};
  float light = 0;
  Eigen::Vector2f place = Eigen::Vector2f::Zero();
  for (size_t k = 0; k < 3; ++k) {
    const float share = in_picture[k] * picture.vertices[corners[k]].inverse_depth / fragment.inverse_depth;
    light += share * picture.light[corners[k]];
    place += share * uv[k];
  }
  return picture.texture.sample(place) * (unshaded + (1 - unshaded) * light);
}

void render_rows(const Picture& picture, std::span<const uint32_t> triangles, int first, int last, Image& image) {
  const int samples = picture.samples_per_axis;
  Band band{first * samples, last * samples, picture.width * samples, {}};
  band.fragments.resize(static_cast<size_t>(band.bottom - band.top) * static_cast<size_t>(band.width));
  for (const uint32_t t : triangles) rasterise(picture, t, band);
  for (int y = first; y < last; ++y)
    for (int x = 0; x < picture.width; ++x) {
      Eigen::Array3f sum = Eigen::Array3f::Zero();
      int covered = 0;
      for (int sy = 0; sy < samples; ++sy)
        for (int sx = 0; sx < samples; ++sx) {
          const Fragment& fragment = band.at(x * samples + sx, y * samples + sy);
          if (fragment.inverse_depth == 0) continue;
          sum += shade(picture, fragment);
          ++covered;
        }
      if (covered == 0) continue;
      for (int c = 0; c < 3; ++c)
        image.at(x, y, c) = static_cast<uint8_t>(
            std::lround(255 * srgb_from_linear(std::min(1.0F, sum[c] / static_cast<float>(covered)))));
      image.at(x, y, 3) = static_cast<uint8_t>(std::lround(255.0 * covered / (samples * samples)));
    }
}

std::vector<Projected> project_vertices(const Mesh& mesh, const Viewer& viewer, int width, int height, int samples) {
  std::vector<Projected> projected;
  projected.reserve(mesh.positions.size());
  for (const Eigen::Vector3f& p : mesh.positions) {
    const Eigen::Vector3d q = viewer.to_camera(p.cast<double>());
    // Sample i of n lies (i + 0.5) / n − 0.5 from a pixel's centre; the axis meets the picture's middle.
    const double x = samples * (width / 2.0 + viewer.focal_px * q.x() / q.z()) - 0.5;
    const double y = samples * (height / 2.0 + viewer.focal_px * q.y() / q.z()) - 0.5;
    projected.push_back({static_cast<float>(x), static_cast<float>(y), static_cast<float>(1 / q.z())});
  }
  return projected;
}

/// For every band of so many rows of pixels the triangles that reach into it, in their order.
std::vector<std::vector<uint32_t>> triangles_by_band(const Picture& picture, int rows) {
  const float samples_a_band = static_cast<float>(rows * picture.samples_per_axis);
  std::vector<std::vector<uint32_t>> bands(static_cast<size_t>((picture.height + rows - 1) / rows));
  const auto last_band = static_cast<float>(bands.size() - 1);
  const auto& triangles = picture.avatar.mesh.triangles;
  for (uint32_t t = 0; t < triangles.size(); ++t) {
    const auto& [a, b, c] = triangles[t];
    const auto [top, bottom] = std::minmax({picture.vertices[a].y, picture.vertices[b].y, picture.vertices[c].y});
    if (!(bottom >= 0)) continue;
    const auto first = static_cast<size_t>(std::clamp(top / samples_a_band, 0.0F, last_band));
    const auto last = static_cast<size_t>(std::min(bottom / samples_a_band, last_band));
    for (size_t band = first; band <= last; ++band) bands[band].push_back(t);
  }
  return bands;
}

Image render(const Picture& picture, const Work& work) {
  Image image(picture.width, picture.height, 4);
  constexpr int rows_a_band = 8;
  const std::vector<std::vector<uint32_t>> bands = triangles_by_band(picture, rows_a_band);
  work.parallel_for(bands.size(), 1, [&](size_t begin, size_t end) {
    for (size_t band = begin; band < end; ++band) {
      const int first = static_cast<int>(band) * rows_a_band;
      render_rows(picture, bands[band], first, std::min(first + rows_a_band, picture.height), image);
    }
  });
  return image;
}

}  // namespace

Image render_portrait(const Avatar& avatar, const PortraitOptions& options, const Work& work) {
  if (avatar.mesh.triangles.empty()) return {options.width, options.height, 4};
  constexpr double key_light = 2.2;
  const Viewer viewer = place_viewer(avatar.mesh, options);
  return render(
      {avatar, options.width, options.height, options.samples_per_axis,
       project_vertices(avatar.mesh, viewer, options.width, options.height, options.samples_per_axis),
       light_at_vertices(avatar.mesh, light_dome(viewer, key_light), &viewer, work), Texture(avatar.atlas.image)},
      work);
}

std::vector<Image> render_turntable(const Avatar& avatar, const TurntableOptions& options, const Work& work) {
  std::vector<Image> images;
  if (avatar.mesh.triangles.empty()) {
    images.assign(static_cast<size_t>(options.frames), Image(options.width, options.height, 4));
    return images;
  }
  constexpr double elevation_rad = 0.08;
  std::vector<Viewer> viewers;
  for (int i = 0; i < options.frames; ++i)
    viewers.push_back(look_from(2 * std::numbers::pi * i / options.frames, elevation_rad));
  Eigen::AlignedBox3d box;
  for (const Eigen::Vector3f& p : avatar.mesh.positions) box.extend(p.cast<double>());
  double distance = 0;  // the same all round
  for (const Viewer& viewer : viewers)
    distance = std::max(distance, distance_for(avatar.mesh, viewer, box.center(), options.width, options.height));

  constexpr double no_key_light = 0;
  const std::vector<float> light =
      light_at_vertices(avatar.mesh, light_dome(viewers.front(), no_key_light), nullptr, work);
  for (Viewer& viewer : viewers) {
    stand_back(box.center(), distance, options.height, viewer);
    images.push_back(
        render({avatar, options.width, options.height, options.samples_per_axis,
                project_vertices(avatar.mesh, viewer, options.width, options.height, options.samples_per_axis), light,
                Texture(avatar.atlas.image)},
               work));
  }
  return images;
}

}  // namespace booth
