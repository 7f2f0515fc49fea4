#include "pipeline/atlas/reference_texturing.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/atlas/surface_diffusion.h"
#include "pipeline/atlas/triangle_views.h"
#include "pipeline/atlas/view_sampling.h"

namespace booth {
namespace {

/// A ray starts above the surface, so that it does not meet the triangle that it leaves.
constexpr float off_surface_m = 0.002F;

using Corners = std::array<Eigen::Array3f, 3>;

/// What texels show that no camera sees: the vertices' own colours, diffused to those that have none.
std::vector<Eigen::Array3f> colours_around(const Mesh& mesh, std::span<const PreparedView> views,
                                           const CameraRatings& ratings) {
  constexpr size_t blurred = 2;  // levels: a vertex stands for its surroundings
  std::vector<Eigen::Array3f> colours(mesh.positions.size(), Eigen::Array3f::Zero());
  std::vector<uint8_t> known(mesh.positions.size(), 0);
  for (size_t v = 0; v < colours.size(); ++v) {
    float total = 0;
    for (size_t c = 0; c < views.size(); ++c) {
      const float rating = ratings.vertex(v)[c];
      const Eigen::Vector3f& p = views[c].projected[v];
      if (!(rating > 0 && p.z() > 0)) continue;
      colours[v] +=
          rating * sample_level(views[c].colours, std::min(blurred, views[c].colours.size() - 1), p.x(), p.y());
      total += rating;
    }
    if (!(total > 0)) continue;
    colours[v] /= total;
    known[v] = 1;
  }
  diffuse_colours(mesh, colours, known);
  return colours;
}

Corners corners_of(const Mesh& mesh, size_t t, std::span<const Eigen::Array3f> colours) {
  const auto& [a, b, c] = mesh.triangles[t];
  return {colours[a], colours[b], colours[c]};
}

Eigen::Array3f interpolated(const Corners& corners, const Eigen::Vector3f& weights) {
  return weights[0] * corners[0] + weights[1] * corners[1] + weights[2] * corners[2];
}

}  // namespace

TexelColours paint_best_views(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                              const CameraRatings& ratings, const Work& work) {
  const std::vector<Eigen::Array3f> around = colours_around(mesh, views, ratings);
  const float usual = usual_rating(ratings);
  return paint_texels(
      packing, size,
      [&](size_t t) -> TrianglePainter {
        const auto rating = ratings.triangle(t);
        const auto best = std::max_element(rating.begin(), rating.end());
        const auto seen = views_of_triangle(mesh, packing, t, views, ratings, usual);
        const auto view = std::find_if(seen.begin(), seen.end(), [&](const TriangleView& candidate) {
          return candidate.view == static_cast<size_t>(best - rating.begin());
        });
        if (!(*best > 0) || view == seen.end())
          return [corners = corners_of(mesh, t, around)](const Eigen::Vector3f& weights) {
            return interpolated(corners, weights);
          };
        return [view = *view, &views](const Eigen::Vector3f& weights) {
          const Eigen::Vector3f p = view.pixel_at(weights);
          return sample_pyramid(views[view.view].colours, view.lod, p.x(), p.y());
        };
      },
      work);
}

TexelColours paint_rating_means(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                                const CameraRatings& ratings, const Occluder& occluder, const Work& work) {
  const std::vector<Eigen::Array3f> around = colours_around(mesh, views, ratings);
  const float usual = usual_rating(ratings);
  std::vector<Eigen::Vector3f> eyes;
  for (const PreparedView& view : views) eyes.push_back(view.camera->center().cast<float>());
  return paint_texels(
      packing, size,
      [&](size_t t) -> TrianglePainter {
        std::array<Eigen::Vector3f, 3> positions;
        for (size_t k = 0; k < 3; ++k) positions[k] = mesh.positions[mesh.triangles[t][k]];
        const Eigen::Vector3f normal = (positions[1] - positions[0]).cross(positions[2] - positions[0]).normalized();
        return [&views, &eyes, &occluder, positions, normal, corners = corners_of(mesh, t, around),
                seen = views_of_triangle(mesh, packing, t, views, ratings, usual)](const Eigen::Vector3f& weights) {
          const Eigen::Vector3f point =
              weights[0] * positions[0] + weights[1] * positions[1] + weights[2] * positions[2];
          Eigen::Array3f light = Eigen::Array3f::Zero();
          float total = 0;
          for (const TriangleView& view : seen) {
            const float rating = view.rating_at(weights);
            if (!(rating > 0)) continue;
            const Eigen::Vector3f& eye = eyes[view.view];
            const auto hidden = [&] {
              return occluder.between(point + off_surface_m * normal, eye, off_surface_m / (eye - point).norm());
            };
            if (!view.certain && hidden()) continue;
            const Eigen::Vector3f p = view.pixel_at(weights);
            light += rating * sample_pyramid(views[view.view].colours, view.lod, p.x(), p.y());
            total += rating;
          }
          return total > 0 ? Eigen::Array3f(light / total) : interpolated(corners, weights);
        };
      },
      work);
}

}  // namespace booth
