#include "pipeline/atlas/texture_atlas.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <utility>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/colour_balance.h"
#include "pipeline/atlas/packing.h"
#include "pipeline/atlas/push_pull.h"

namespace booth {
namespace {

/// How far the surface of a visual hull may lie from the true one: what is nearer to an outline is not trusted.
constexpr double rim_m = 0.012;
/// Triangles of one chart that are not neighbours keep this distance, so that filtering does not mix them.
constexpr double clearance_texels = 2;

struct Source {
  const RigCamera* camera;
  const Frame* frame;
  const Silhouette* silhouette;
};

bool fits(const Image* image, const Intrinsics& k) {
  return image != nullptr && image->width == k.width && image->height == k.height;
}

/// The cameras that have a usable frame and a silhouette, in the rig's order; a sentence for each that has not.
std::vector<Source> usable_sources(const Rig& rig, std::span<const Frame> frames,
                                   std::span<const Silhouette> silhouettes, std::vector<std::string>& warnings) {
  std::vector<Source> sources;
  for (const RigCamera& camera : rig.cameras) {
    const auto frame =
        std::find_if(frames.begin(), frames.end(), [&](const Frame& f) { return f.camera == camera.id; });
    const auto silhouette = std::find_if(silhouettes.begin(), silhouettes.end(),
                                         [&](const Silhouette& s) { return s.camera == camera.id; });
    if (frame == frames.end() || silhouette == silhouettes.end()) continue;
    if (!fits(frame->pixels.get(), camera.intrinsics) || !fits(&silhouette->coverage, camera.intrinsics) ||
        silhouette->coverage.channels != 1) {
      warnings.push_back("texture: the image of " + camera.id + " is not of its camera's size and is left out");
      continue;
    }
    sources.push_back({&camera, &*frame, &*silhouette});
  }
  return sources;
}

double triangle_area(const Mesh& mesh, size_t t) {
  const auto& [a, b, c] = mesh.triangles[t];
  const Eigen::Vector3d origin = mesh.positions[a].cast<double>();
  return 0.5 * (mesh.positions[b].cast<double>() - origin).cross(mesh.positions[c].cast<double>() - origin).norm();
}

double seen_share(const Mesh& mesh, const CameraRatings& ratings) {
  double seen = 0, total = 0;
  for (size_t t = 0; t < mesh.triangles.size(); ++t) {
    const double area = triangle_area(mesh, t);
    total += area;
    if (ratings.triangle_seen[t] != 0) seen += area;
  }
  return total > 0 ? seen / total : 0;
}

/// More texels for charts that a camera resolves finer than the atlas would, as close-up cameras do the face.
std::vector<double> chart_densities(const Mesh& mesh, std::span<const Chart> charts, const CameraRatings& ratings,
                                    double texel_m) {
  constexpr double most = 2;
  std::vector<double> densities;
  for (const Chart& chart : charts) {
    double pixels = 0, area = 0;
    for (const uint32_t t : chart.triangles) {
      const double here = triangle_area(mesh, t);
      area += here;
      for (const uint32_t v : mesh.triangles[t]) {
        const auto rating = ratings.vertex(v);
        pixels += here / 3 * static_cast<double>(*std::max_element(rating.begin(), rating.end()));
      }
    }
    const double pixels_a_texel = area > 0 ? std::sqrt(pixels / area) * texel_m : 1;
    densities.push_back(std::clamp(pixels_a_texel, 1.0, most));
  }
  return densities;
}

/// Charts of the whole surface, placed in the atlas.
Packing lay_out(const Mesh& mesh, const CameraRatings& ratings, const AtlasOptions& options, const Work& work) {
  double area = 0;
  for (size_t t = 0; t < mesh.triangles.size(); ++t) area += triangle_area(mesh, t);
  const double texel_m = std::sqrt(area) / options.size;
  const std::vector<Chart> charts = cut_into_charts(mesh, options.charting, clearance_texels * texel_m, work);
  const std::vector<double> density = chart_densities(mesh, charts, ratings, texel_m);
  return pack_charts(charts, mesh.triangles.size(), density, options.size, options.gutter_texels, work);
}

std::vector<std::array<Eigen::Vector2f, 3>> texture_coordinates(const Packing& packing, int size) {
  std::vector<std::array<Eigen::Vector2f, 3>> uv(packing.corners.size());
  for (size_t t = 0; t < uv.size(); ++t)
    for (size_t k = 0; k < 3; ++k) uv[t][k] = (packing.corners[t][k] / size).cwiseMax(0.0).cwiseMin(1.0).cast<float>();
  return uv;
}

}  // namespace

Result<TextureAtlas> build_texture_atlas(const Mesh& mesh, const Rig& rig, std::span<const Frame> frames,
                                         std::span<const Silhouette> silhouettes, const AtlasOptions& options,
                                         const Work& work) {
  if (options.size < 256 || options.size > 8192)
    return Error{ErrorCode::invalid_argument, "atlas size " + std::to_string(options.size) + ", expected 256 … 8192"};
  if (options.gutter_texels < 0 || options.gutter_texels > 32)
    return Error{ErrorCode::invalid_argument,
                 "atlas gutter " + std::to_string(options.gutter_texels) + ", expected 0 … 32 texels"};
  if (const auto checked = check(mesh); !checked) return checked.error();
  if (mesh.triangles.empty()) return Error{ErrorCode::invalid_argument, "a mesh without triangles cannot be textured"};

  TextureAtlas result;
  const std::vector<Source> sources = usable_sources(rig, frames, silhouettes, result.warnings);
  if (sources.empty())
    return Error{ErrorCode::too_few_views, "no camera of the rig has both a frame and a silhouette to texture from"};

  std::vector<PreparedView> views(sources.size());
  work.parallel_for(sources.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i)
      views[i] =
          prepare_view(mesh, *sources[i].camera, *sources[i].frame, *sources[i].silhouette, rim_m, options.inpainting);
  });
  if (work.stopped()) return Work::cancelled();
  work.report(0.3);

  const CameraRatings ratings = rate_cameras(mesh, views, work);
  result.seen_share = seen_share(mesh, ratings);
  if (!(result.seen_share > 0)) return Error{ErrorCode::too_few_views, "no camera sees the surface to texture"};
  if (work.stopped()) return Work::cancelled();
  work.report(0.4);

  const Packing packing = lay_out(mesh, ratings, options, work);
  if (!(packing.texels_per_m > 0))
    return Error{ErrorCode::unsupported,
                 "the surface has too many charts for an atlas of " + std::to_string(options.size) + " texels"};
  if (work.stopped()) return Work::cancelled();
  work.report(0.6);

  const std::vector<Eigen::Array3f> gains = options.balance_colours
                                                ? balance_colours(mesh, views, ratings)
                                                : std::vector<Eigen::Array3f>(views.size(), Eigen::Array3f::Ones());
  TexelColours texels = blend_texels(mesh, packing, options.size, views, ratings, gains, options.blending, work);
  if (work.stopped()) return Work::cancelled();
  work.report(0.95);

  result.used_share = texels.used_share;
  result.atlas.uv = texture_coordinates(packing, options.size);
  result.atlas.image = std::move(push_pull(std::move(texels.image), texels.painted).front());
  work.report(1);
  return result;
}

}  // namespace booth
