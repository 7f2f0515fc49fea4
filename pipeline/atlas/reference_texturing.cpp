#include "pipeline/atlas/reference_texturing.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cstdint>
#include <utility>
#include <vector>

#include "pipeline/atlas/surface_diffusion.h"
#include "pipeline/atlas/triangle_views.h"
#include "pipeline/atlas/view_sampling.h"

namespace booth {
namespace {

/// A ray starts above the surface, so that it does not meet the triangle that it leaves.
constexpr float off_surface_m = 0.002F;

using Corners = std::array<Eigen::Array4f, 3>;

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

Eigen::Array4f padded(const Eigen::Array3f& colour) { return {colour[0], colour[1], colour[2], 0}; }

Corners corners_of(const Mesh& mesh, size_t t, std::span<const Eigen::Array3f> colours) {
  const auto& [a, b, c] = mesh.triangles[t];
  return {padded(colours[a]), padded(colours[b]), padded(colours[c])};
}

template <class Value>
Value interpolated(const TexelBatch& batch, size_t i, const std::array<Value, 3>& corners) {
  const auto& [a, b, c] = batch.corner_weights;
  return a[i] * corners[0] + b[i] * corners[1] + c[i] * corners[2];
}

/// A triangle's places in one camera.
struct Places {
  TexelBatch::Each<float> rating, x, y, depth;

  Places(const TriangleView& view, const TexelBatch& batch) {
    view.for_each(batch.corner_weights, batch.count, &rating, &x, &y, &depth);
  }
};

/// The mean of the cameras' colours for the texels of one triangle.
class MeanPainter {
 public:
  MeanPainter(const Mesh& mesh, size_t t, const Corners& around, std::vector<TriangleView> seen,
              std::span<const PreparedView> views, const Occluder& occluder)
      : around_(around), seen_(std::move(seen)), views_(views), occluder_(&occluder) {
    for (size_t k = 0; k < 3; ++k) positions_[k] = mesh.positions[mesh.triangles[t][k]];
    normal_ = (positions_[1] - positions_[0]).cross(positions_[2] - positions_[0]).normalized();
  }

  void operator()(TexelBatch& batch) const {
    TexelBatch::Each<float> total{};
    for (size_t i = 0; i < batch.count; ++i) batch.light[i].setZero();
    for (const TriangleView& view : seen_) {
      const Places places(view, batch);
      const Eigen::Vector3f eye = views_[view.view].camera->center().cast<float>();
      for (size_t i = 0; i < batch.count; ++i) {
        const float rating = places.rating[i];
        if (!(rating > 0) || (!view.certain && hidden_from(eye, interpolated(batch, i, positions_)))) continue;
        batch.light[i] += rating * sample_pyramid(views_[view.view].colours, view.lod, places.x[i], places.y[i]);
        total[i] += rating;
      }
    }
    for (size_t i = 0; i < batch.count; ++i)
      batch.light[i] = total[i] > 0 ? Eigen::Array4f(batch.light[i] / total[i]) : interpolated(batch, i, around_);
  }

 private:
  bool hidden_from(const Eigen::Vector3f& eye, const Eigen::Vector3f& point) const {
    return occluder_->between(point + off_surface_m * normal_, eye, off_surface_m / (eye - point).norm());
  }

  Corners around_;
  std::vector<TriangleView> seen_;
  std::span<const PreparedView> views_;
  const Occluder* occluder_;
  std::array<Eigen::Vector3f, 3> positions_;
  Eigen::Vector3f normal_;
};

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
          return [corners = corners_of(mesh, t, around)](TexelBatch& batch) {
            for (size_t i = 0; i < batch.count; ++i) batch.light[i] = interpolated(batch, i, corners);
          };
        return [view = *view, &views](TexelBatch& batch) {
          const Places places(view, batch);
          for (size_t i = 0; i < batch.count; ++i)
            batch.light[i] = sample_pyramid(views[view.view].colours, view.lod, places.x[i], places.y[i]);
        };
      },
      work);
}

TexelColours paint_rating_means(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                                const CameraRatings& ratings, const Occluder& occluder, const Work& work) {
  const std::vector<Eigen::Array3f> around = colours_around(mesh, views, ratings);
  const float usual = usual_rating(ratings);
  return paint_texels(
      packing, size,
      [&](size_t t) -> TrianglePainter {
        return MeanPainter(mesh, t, corners_of(mesh, t, around),
                           views_of_triangle(mesh, packing, t, views, ratings, usual), views, occluder);
      },
      work);
}

}  // namespace booth
