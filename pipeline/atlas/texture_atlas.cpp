#include "pipeline/atlas/texture_atlas.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <utility>

#include "pipeline/atlas/blending.h"
#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/colour_balance.h"
#include "pipeline/atlas/grey_image.h"
#include "pipeline/atlas/occluder.h"
#include "pipeline/atlas/packing.h"
#include "pipeline/atlas/push_pull.h"
#include "pipeline/atlas/reference_texturing.h"
#include "pipeline/atlas/surface_offset.h"
#include "pipeline/atlas/view_alignment.h"

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

/// The cameras that have a usable frame and a silhouette, in the order of their ids, so that no sum depends on the
/// rig's order; a sentence for each that has not.
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
  std::sort(sources.begin(), sources.end(),
            [](const Source& l, const Source& r) { return l.camera->id < r.camera->id; });
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
    const auto rating = ratings.triangle(t);
    if (std::any_of(rating.begin(), rating.end(), [](float r) { return r > 0; })) seen += area;
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

/// What the product's method does before anything is painted: balances the colours and lays the surface where the
/// cameras agree on it.
///
/// @return the views' grey levels
std::vector<GreyLevels> prepare_fully(Mesh* mesh, std::span<PreparedView> views, const CameraRatings& ratings,
                                      std::span<const uint8_t> exact, const AtlasOptions& options, const Work& work) {
  if (options.balance_colours) {
    const std::vector<LightCorrection> corrections = balance_colours(*mesh, views, ratings);
    for (size_t c = 0; c < views.size(); ++c) views[c].balance = corrections[c];
  }
  std::vector<GreyLevels> greys = grey_levels(views, work);
  if (!options.align_surface) return greys;
  std::vector<float> limits = offset_limits(*mesh, views);
  for (size_t v = 0; v < exact.size(); ++v)
    if (exact[v] != 0) limits[v] = 0;
  const std::vector<float> weights = weigh_views(*mesh, views, ratings);
  const std::vector<float> offsets = find_surface_offsets(*mesh, views, greys, ratings, weights, limits, work);
  const std::vector<Eigen::Vector3f> normals = vertex_normals(*mesh);
  for (size_t v = 0; v < offsets.size(); ++v) mesh->positions[v] += offsets[v] * normals[v];
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t c = begin; c < end; ++c) project_again(*mesh, &views[c]);
  });
  return greys;
}

TexelColours paint(const Mesh& mesh, const Packing& packing, std::span<const PreparedView> views,
                   std::span<const GreyLevels> greys, const CameraRatings& ratings, const Occluder& occluder,
                   const AtlasOptions& options, const Work& work) {
  switch (options.method) {
    case TextureMethod::best_view: return paint_best_views(mesh, packing, options.size, views, ratings, work);
    case TextureMethod::blend: return paint_rating_means(mesh, packing, options.size, views, ratings, occluder, work);
    case TextureMethod::full: break;
  }
  const std::vector<float> weights = weigh_views(mesh, views, ratings);
  std::vector<Eigen::Vector2f> shifts;
  if (options.align_views) shifts = align_views(mesh, views, greys, ratings, weights, work);
  return blend_texels(mesh, packing, options.size, views, ratings, weights, shifts, work);
}

constexpr std::array<std::pair<TextureMethod, std::string_view>, 3> method_names{
    {{TextureMethod::best_view, "best_view"}, {TextureMethod::blend, "blend"}, {TextureMethod::full, "full"}}};

}  // namespace

std::string_view to_string(TextureMethod method) {
  const auto found =
      std::find_if(method_names.begin(), method_names.end(), [&](const auto& entry) { return entry.first == method; });
  return found->second;
}

std::optional<TextureMethod> texture_method_from(std::string_view name) {
  for (const auto& [method, word] : method_names)
    if (word == name) return method;
  return std::nullopt;
}

Result<TextureAtlas> build_texture_atlas(const Mesh& untextured, const Rig& rig, std::span<const Frame> frames,
                                         std::span<const Silhouette> silhouettes, const AtlasOptions& options,
                                         const Work& work, std::span<const uint8_t> exact) {
  if (options.size < 256 || options.size > 8192)
    return Error{ErrorCode::invalid_argument, "atlas size " + std::to_string(options.size) + ", expected 256 … 8192"};
  if (options.gutter_texels < 0 || options.gutter_texels > 32)
    return Error{ErrorCode::invalid_argument,
                 "atlas gutter " + std::to_string(options.gutter_texels) + ", expected 0 … 32 texels"};
  if (const auto checked = check(untextured); !checked) return checked.error();
  if (!exact.empty() && exact.size() != untextured.positions.size())
    return Error{ErrorCode::invalid_argument, "exact: " + std::to_string(exact.size()) + " values for " +
                                                  std::to_string(untextured.positions.size()) + " vertices"};
  if (untextured.triangles.empty())
    return Error{ErrorCode::invalid_argument, "a mesh without triangles cannot be textured"};

  TextureAtlas result;
  const std::vector<Source> sources = usable_sources(rig, frames, silhouettes, result.warnings);
  if (sources.empty())
    return Error{ErrorCode::too_few_views, "no camera of the rig has both a frame and a silhouette to texture from"};

  const Inpainting inpainting = options.method == TextureMethod::full ? Inpainting::push_pull : Inpainting::telea;
  Mesh mesh = untextured;
  std::vector<PreparedView> views(sources.size());
  std::optional<Step> step(std::in_place, work, "atlas: pictures");
  work.parallel_for(sources.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i)
      views[i] = prepare_view(mesh, *sources[i].camera, *sources[i].frame, *sources[i].silhouette, rim_m, inpainting);
  });
  if (work.stopped()) return Work::cancelled();
  work.report(0.3);

  step.emplace(work, "atlas: ratings");
  const Occluder occluder(mesh);
  const CameraRatings ratings = rate_cameras(mesh, occluder, views, work);
  result.seen_share = seen_share(mesh, ratings);
  if (!(result.seen_share > 0)) return Error{ErrorCode::too_few_views, "no camera sees the surface to texture"};
  if (work.stopped()) return Work::cancelled();
  work.report(0.4);

  step.emplace(work, "atlas: agreement");
  std::vector<GreyLevels> greys;
  if (options.method == TextureMethod::full) greys = prepare_fully(&mesh, views, ratings, exact, options, work);
  if (work.stopped()) return Work::cancelled();
  work.report(0.5);

  step.emplace(work, "atlas: charts");
  const Packing packing = lay_out(mesh, ratings, options, work);
  if (!(packing.texels_per_m > 0))
    return Error{ErrorCode::unsupported,
                 "the surface has too many charts for an atlas of " + std::to_string(options.size) + " texels"};
  if (work.stopped()) return Work::cancelled();
  work.report(0.6);

  step.emplace(work, "atlas: texels");
  TexelColours texels = paint(mesh, packing, views, greys, ratings, occluder, options, work);
  if (work.stopped()) return Work::cancelled();
  work.report(0.95);

  step.emplace(work, "atlas: filling");
  result.used_share = texels.used_share;
  result.positions = std::move(mesh.positions);
  result.atlas.uv = texture_coordinates(packing, options.size);
  result.atlas.image = std::move(push_pull(std::move(texels.image), std::move(texels.painted), work).front());
  work.report(1);
  return result;
}

}  // namespace booth
