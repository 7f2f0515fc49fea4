#include "pipeline/atlas/colour_balance.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>

#include "pipeline/atlas/view_sampling.h"

namespace booth {
namespace {

/// Two cameras' logarithmic colours of the same vertex.
struct Pair {
  int one, other;
  float weight;
  Eigen::Array3f difference;  ///< log(one) − log(other)
};

/// The area around each vertex, as a multiple of the mean.
std::vector<float> relative_areas(const Mesh& mesh) {
  std::vector<float> areas(mesh.positions.size(), 0.0F);
  for (const auto& [a, b, c] : mesh.triangles) {
    const Eigen::Vector3f one = mesh.positions[b] - mesh.positions[a];
    const float area = one.cross(mesh.positions[c] - mesh.positions[a]).norm();
    for (const uint32_t v : {a, b, c}) areas[v] += area;
  }
  const double sum = std::accumulate(areas.begin(), areas.end(), 0.0);
  const float scale = sum > 0 ? static_cast<float>(static_cast<double>(areas.size()) / sum) : 0.0F;
  for (float& area : areas) area *= scale;
  return areas;
}

std::vector<Pair> overlaps(const Mesh& mesh, std::span<const PreparedView> views, const CameraRatings& ratings) {
  constexpr float good_share = 0.1F;                    // of the best camera's rating
  constexpr float least_trust = 0.5F;                   // clear of outlines and depth steps
  constexpr size_t level = 2;                           // blurred by four pixels: the surface is not exact
  constexpr float darkest = 0.003F, brightest = 0.85F;  // noise below, clipping above
  struct Sample {
    int camera;
    float weight;  ///< of a slanted or doubtful look little, but where two cameras share no better one, enough
    Eigen::Array3f light;
  };
  std::vector<Pair> pairs;
  std::vector<Sample> samples;
  const std::vector<float> areas = relative_areas(mesh);
  for (size_t v = 0; v < mesh.positions.size(); ++v) {
    const auto rating = ratings.vertex(v);
    const float best = *std::max_element(rating.begin(), rating.end());
    if (!(best > 0)) continue;
    samples.clear();
    for (size_t c = 0; c < views.size(); ++c) {
      if (rating[c] < good_share * best) continue;
      const Eigen::Vector3f& p = views[c].projected[v];
      if (!(p.z() > 0)) continue;
      const Trust trust = look_up(views[c], p.x(), p.y(), p.z());
      if (trust.visible * trust.confidence < least_trust) continue;
      const Eigen::Array3f light =
          sample_level(views[c].colours, std::min(level, views[c].colours.size() - 1), p.x(), p.y());
      if (light.minCoeff() < darkest || light.maxCoeff() > brightest) continue;
      samples.push_back({static_cast<int>(c), rating[c] / best * trust.visible * trust.confidence, light.log()});
    }
    for (size_t i = 0; i < samples.size(); ++i)
      for (size_t j = i + 1; j < samples.size(); ++j)
        pairs.push_back({samples[i].camera, samples[j].camera, areas[v] * samples[i].weight * samples[j].weight,
                         samples[i].light - samples[j].light});
  }
  return pairs;
}

}  // namespace

std::vector<Eigen::Array3f> balance_colours(const Mesh& mesh, std::span<const PreparedView> views,
                                            const CameraRatings& ratings) {
  const auto cameras = static_cast<Eigen::Index>(views.size());
  const std::vector<Pair> pairs = overlaps(mesh, views, ratings);
  std::vector<Eigen::Array3f> gains(views.size(), Eigen::Array3f::Ones());
  constexpr int rounds = 8;       // the last two at the scale
  constexpr double scale = 0.08;  // log units: what disagrees by more is another surface or a highlight
  // In observations: keeps cameras without overlap at 1, and is nothing against the few that a narrow overlap has.
  constexpr double prior = 1e-3;
  for (int channel = 0; channel < 3; ++channel) {
    Eigen::VectorXd correction = Eigen::VectorXd::Zero(cameras);
    for (int round = 0; round < rounds; ++round) {
      Eigen::MatrixXd normal = prior * Eigen::MatrixXd::Identity(cameras, cameras);
      Eigen::VectorXd right = Eigen::VectorXd::Zero(cameras);
      for (const Pair& pair : pairs) {
        const auto difference = static_cast<double>(pair.difference[channel]);
        const double residual = difference + correction[pair.one] - correction[pair.other];
        // From plain least squares to the scale step by step: what an outlier is shows only beside good gains.
        const double tolerated = scale * std::exp2(std::max(0, rounds - 2 - round));
        const double robust = round == 0 ? 1 : 1 / (1 + residual * residual / (tolerated * tolerated));
        const double weight = static_cast<double>(pair.weight) * robust;
        normal(pair.one, pair.one) += weight;
        normal(pair.other, pair.other) += weight;
        normal(pair.one, pair.other) -= weight;
        normal(pair.other, pair.one) -= weight;
        right[pair.one] -= weight * difference;
        right[pair.other] += weight * difference;
      }
      correction = normal.ldlt().solve(right);
    }
    for (Eigen::Index c = 0; c < cameras; ++c)
      gains[static_cast<size_t>(c)][channel] = static_cast<float>(std::exp(correction[c]));
  }
  return gains;
}

void apply_gains(std::span<PreparedView> views, std::span<const Eigen::Array3f> gains, const Work& work) {
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t c = begin; c < end; ++c)
      for (LightImage& level : views[c].colours)
        for (size_t i = 0; i < level.samples.size(); i += 4)
          for (size_t k = 0; k < 3; ++k) {
            const float light = gains[c][static_cast<Eigen::Index>(k)] * static_cast<float>(level.samples[i + k]);
            level.samples[i + k] = static_cast<int16_t>(std::min(light + 0.5F, brightest_light));
          }
  });
}

}  // namespace booth
