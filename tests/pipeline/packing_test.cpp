#include "pipeline/atlas/packing.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <set>
#include <vector>

#include "pipeline/atlas/charting.h"
#include "pipeline/atlas/planar_grid.h"
#include "pipeline/atlas/push_pull.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

constexpr int size = 512;

struct Packed {
  Mesh mesh;
  std::vector<Chart> charts;
  Packing packing;
};

Packed packed_person(Charting charting, int gutter, double first_density = 1, const Work& work = {}) {
  Packed result;
  result.mesh = extract_surface(synthetic::sample_field(synthetic::person().body, 0.04));
  result.charts = cut_into_charts(result.mesh, charting, 0.005);
  std::vector<double> density(result.charts.size(), 1);
  density[0] = first_density;
  result.packing = pack_charts(result.charts, result.mesh.triangles.size(), density, size, gutter, work);
  return result;
}

double twice_area(const std::array<Eigen::Vector2d, 3>& p) {
  const Eigen::Vector2d ab = p[1] - p[0], ac = p[2] - p[0];
  return ab.x() * ac.y() - ab.y() * ac.x();
}

/// The chart whose triangle holds each texel's centre, −1 where none does; −2 where two charts do.
Raster<int> chart_at_texels(const Packed& packed) {
  Raster<int> owner(size, size, 1, -1);
  for (size_t c = 0; c < packed.charts.size(); ++c)
    for (const uint32_t t : packed.charts[c].triangles) {
      const auto& p = packed.packing.corners[t];
      const double area = twice_area(p);
      if (std::abs(area) < 1e-12) continue;
      const Eigen::Array2d low = p[0].cwiseMin(p[1]).cwiseMin(p[2]), high = p[0].cwiseMax(p[1]).cwiseMax(p[2]);
      for (int y = static_cast<int>(low.y()); y <= static_cast<int>(high.y()); ++y)
        for (int x = static_cast<int>(low.x()); x <= static_cast<int>(high.x()); ++x) {
          const Eigen::Vector2d q(x + 0.5, y + 0.5);
          bool inside = true;
          for (size_t k = 0; k < 3; ++k) inside = inside && twice_area({p[k], p[(k + 1) % 3], q}) / area > 0;
          if (!inside) continue;
          int& here = owner.at(x, y);
          here = here == -1 || here == static_cast<int>(c) ? static_cast<int>(c) : -2;
        }
    }
  return owner;
}

TEST(Packing, ChartsKeepTheirGutterInsideTheAtlas) {
  for (const Charting charting : {Charting::unfolding, Charting::flattening}) {
    constexpr int gutter = 4;
    const Packed packed = packed_person(charting, gutter);
    ASSERT_GT(packed.packing.texels_per_m, 0);
    for (const auto& corners : packed.packing.corners)
      for (const Eigen::Vector2d& p : corners) {
        EXPECT_GE(p.minCoeff(), 0);
        EXPECT_LE(p.maxCoeff(), size);
      }
    const Raster<int> owner = chart_at_texels(packed);
    size_t used = 0;
    for (int y = 0; y < size; ++y)
      for (int x = 0; x < size; ++x) {
        const int here = owner.at(x, y);
        ASSERT_NE(here, -2);
        if (here == -1) continue;
        ++used;
        for (int v = y; v <= std::min(size - 1, y + gutter); ++v)
          for (int u = std::max(0, x - gutter); u <= std::min(size - 1, x + gutter); ++u)
            ASSERT_TRUE((u - x) * (u - x) + (v - y) * (v - y) > gutter * gutter || owner.at(u, v) == -1 ||
                        owner.at(u, v) == here)
                << x << ' ' << y;
      }
    EXPECT_GT(static_cast<double>(used) / (size * size), charting == Charting::flattening ? 0.5 : 0.2);
  }
}

/// Pairs of triangles of the atlas that overlap by more than rounding does, by the separating axes of their edges.
size_t overlapping_pairs(const Packing& packing) {
  constexpr double rounding_texels = 1e-6, cell_texels = 8;
  const size_t triangles = packing.corners.size();
  PlanarGrid grid(cell_texels);
  std::vector<FlatCorners> upright;  // counter-clockwise with y upwards
  for (const auto& corners : packing.corners) {
    FlatCorners& flipped = upright.emplace_back(corners);
    for (Eigen::Vector2d& p : flipped) p.y() = -p.y();
  }
  size_t pairs = 0;
  for (size_t t = 0; t < triangles; ++t) {
    std::set<int32_t> overlapping;  // the grid may name one repeatedly
    grid.all_near(upright[t], 0, [&](int32_t other) {
      const FlatCorners& there = upright[static_cast<size_t>(other)];
      if (std::max(separation(upright[t], there), separation(there, upright[t])) < -rounding_texels)
        overlapping.insert(other);
      return true;
    });
    pairs += overlapping.size();
    grid.add(static_cast<int32_t>(t), upright[t]);
  }
  return pairs;
}

TEST(Packing, NoTwoTrianglesOverlap) {
  for (const Charting charting : {Charting::unfolding, Charting::flattening}) {
    Packing packing = packed_person(charting, 2).packing;
    ASSERT_GT(packing.texels_per_m, 0);
    EXPECT_EQ(overlapping_pairs(packing), 0U);
    const Eigen::Vector2d onto_another = packing.corners.back()[0] - packing.corners[0][0];
    for (Eigen::Vector2d& p : packing.corners[0]) p += onto_another;
    EXPECT_GT(overlapping_pairs(packing), 0U) << "the check is blind";
  }
}

TEST(Packing, FillsThreeQuartersOfAnAtlas) {
  constexpr int large = 2048, gutter = 4;
  const Mesh mesh = extract_surface(synthetic::sample_field(synthetic::person().body, 0.02));
  const std::vector<Chart> charts = cut_into_charts(mesh, Charting::flattening, 0.002);
  const Packing packing =
      pack_charts(charts, mesh.triangles.size(), std::vector<double>(charts.size(), 1.0), large, gutter);
  double twice_used = 0;
  for (const auto& corners : packing.corners) twice_used += std::abs(twice_area(corners));
  EXPECT_GE(0.5 * twice_used / (large * large), 0.75);
}

TEST(Packing, ChartsAreScaledAlikeAndNeverMirrored) {
  const Packed packed = packed_person(Charting::flattening, 4, 2);
  for (size_t c = 0; c < packed.charts.size(); ++c) {
    const double scale = packed.packing.texels_per_m * (c == 0 ? 2 : 1);
    const Chart& chart = packed.charts[c];
    for (size_t i = 0; i < chart.triangles.size(); ++i) {
      const auto& corners = packed.packing.corners[chart.triangles[i]];
      for (size_t k = 0; k < 3; ++k)
        EXPECT_NEAR((corners[(k + 1) % 3] - corners[k]).norm(),
                    scale * (chart.corners[i][(k + 1) % 3] - chart.corners[i][k]).norm(), 1e-6);
      EXPECT_LE(twice_area(corners), 1e-9);  // counter-clockwise with y upwards is clockwise with y downwards
    }
  }
}

TEST(Packing, IsTheSameOnAnyNumberOfThreads) {
  ThreadPool pool(3);
  EXPECT_EQ(packed_person(Charting::flattening, 4).packing.corners,
            packed_person(Charting::flattening, 4, 1, pool.work()).packing.corners);
}

TEST(Packing, TooManyChartsForTheAtlasGiveNoScale) {
  std::vector<Chart> charts(2000);
  for (uint32_t t = 0; t < charts.size(); ++t) {
    charts[t].triangles = {t};
    charts[t].corners = {{Eigen::Vector2d(0, 0), Eigen::Vector2d(1, 0), Eigen::Vector2d(0, 1)}};
  }
  EXPECT_EQ(pack_charts(charts, charts.size(), std::vector<double>(charts.size(), 1.0), 256, 32).texels_per_m, 0);
}

TEST(PushPull, KeepsWhatIsValidAndContinuesIt) {
  Image image(37, 21, 3), valid(37, 21, 1);
  for (int y = 5; y < 9; ++y)
    for (int x = 10; x < 14; ++x) {
      valid.at(x, y) = 255;
      for (int c = 0; c < 3; ++c) image.at(x, y, c) = static_cast<uint8_t>(60 * (c + 1));
    }
  const Pyramid pyramid = push_pull(image, valid);
  EXPECT_EQ(pyramid.back().width, 1);
  for (const Image& level : pyramid)
    for (size_t i = 0; i < level.samples.size(); ++i)
      EXPECT_NEAR(level.samples[i], 60 * static_cast<int>(i % 3 + 1), 1);
}

TEST(PushPull, WithoutAnythingValidIsGrey) {
  const Pyramid pyramid = push_pull(Image(5, 3, 3), Image(5, 3, 1));
  for (const uint8_t sample : pyramid.front().samples) EXPECT_EQ(sample, 128);
}

}  // namespace
}  // namespace booth
