#include "pipeline/atlas/colour_balance.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <array>
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
  float one_radius2, other_radius2;
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
    float radius2;
  };
  std::vector<Pair> pairs;
  std::vector<Sample> samples;
  const std::vector<float> areas = relative_areas(mesh);
  constexpr size_t enough = 4000;  // vertices, about
  const size_t step = std::max<size_t>(1, mesh.positions.size() / enough);
  for (size_t v = 0; v < mesh.positions.size(); v += step) {
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
      samples.push_back({static_cast<int>(c), rating[c] / best * trust.visible * trust.confidence, light.log(),
                         views[c].squared_radius(p.x(), p.y())});
    }
    for (size_t i = 0; i < samples.size(); ++i)
      for (size_t j = i + 1; j < samples.size(); ++j)
        pairs.push_back({samples[i].camera, samples[j].camera, areas[v] * samples[i].weight * samples[j].weight,
                         samples[i].light - samples[j].light, samples[i].radius2, samples[j].radius2});
  }
  return pairs;
}

/// Unknowns of a camera: the logarithms of three gains, and the vignetting.
constexpr Eigen::Index unknowns = 4, vignetting = 3;

/// The normal equations of all cameras' unknowns.
struct Equations {
  Eigen::MatrixXd matrix;
  Eigen::VectorXd right;

  explicit Equations(Eigen::Index count)
      : matrix(Eigen::MatrixXd::Zero(count, count)), right(Eigen::VectorXd::Zero(count)) {}

  /// That factors · (the unknowns of that number) shall be `value`.
  void add(const std::array<Eigen::Index, 4>& number, const Eigen::Vector4d& factors, double value, double weight) {
    for (Eigen::Index i = 0; i < 4; ++i) {
      const double weighted = weight * factors[i];
      for (Eigen::Index k = 0; k < 4; ++k)
        matrix(number[static_cast<size_t>(i)], number[static_cast<size_t>(k)]) += weighted * factors[k];
      right[number[static_cast<size_t>(i)]] += weighted * value;
    }
  }
};

/// Of each camera, the weights of its pairs.
std::vector<double> weight_of_cameras(std::span<const Pair> pairs, size_t cameras) {
  std::vector<double> weights(cameras, 0);
  for (const Pair& pair : pairs)
    for (const int camera : {pair.one, pair.other})
      weights[static_cast<size_t>(camera)] += static_cast<double>(pair.weight);
  return weights;
}

double vignetting_of(const Eigen::VectorXd& correction, size_t view) {
  return correction[unknowns * static_cast<Eigen::Index>(view) + vignetting];
}
/// That with the least vignetting.
size_t clearest_view(const Eigen::VectorXd& correction) {
  size_t clearest = 0;
  for (size_t c = 1; c < static_cast<size_t>(correction.size() / unknowns); ++c)
    if (vignetting_of(correction, c) < vignetting_of(correction, clearest)) clearest = c;
  return clearest;
}

}  // namespace

std::vector<LightCorrection> balance_colours(const Mesh& mesh, std::span<const PreparedView> views,
                                             const CameraRatings& ratings) {
  const std::vector<Pair> pairs = overlaps(mesh, views, ratings);
  const std::vector<double> seen = weight_of_cameras(pairs, views.size());
  constexpr int rounds = 8;       // the last two at the scale
  constexpr double scale = 0.08;  // log units: what disagrees by more is another surface or a highlight
  // In observations: keeps cameras without overlap at 1, and is nothing against the few that a narrow overlap has.
  constexpr double prior = 1e-3;
  // As a share of a camera's observations, each of three channels: what shines differently from different sides looks
  // like vignetting where squared distances from the middles differ by less than about the root of this.
  constexpr double vignetting_prior = 3e-4;
  const auto count = unknowns * static_cast<Eigen::Index>(views.size());
  Eigen::VectorXd correction = Eigen::VectorXd::Zero(count);
  std::vector<uint8_t> none(views.size(), 0);  // cameras that are held to have no vignetting
  for (int round = 0; round < rounds; ++round) {
    Equations equations(count);
    equations.matrix.diagonal().setConstant(prior);
    for (size_t c = 0; c < views.size(); ++c) {
      const auto at = unknowns * static_cast<Eigen::Index>(c) + vignetting;
      equations.matrix(at, at) += 3 * (none[c] != 0 ? 1 : vignetting_prior) * seen[c];
    }
    // From plain least squares to the scale step by step: what an outlier is shows only beside good gains.
    const double tolerated = scale * std::exp2(std::max(0, rounds - 2 - round));
    for (const Pair& pair : pairs) {
      const Eigen::Index one = unknowns * pair.one, other = unknowns * pair.other;
      const Eigen::Vector4d factors(1, -1, static_cast<double>(pair.one_radius2),
                                    -static_cast<double>(pair.other_radius2));
      for (Eigen::Index channel = 0; channel < 3; ++channel) {
        const std::array<Eigen::Index, 4> number{one + channel, other + channel, one + vignetting, other + vignetting};
        const auto difference = static_cast<double>(pair.difference[channel]);
        double residual = difference;
        for (Eigen::Index i = 0; i < 4; ++i) residual += factors[i] * correction[number[static_cast<size_t>(i)]];
        const double robust = round == 0 ? 1 : 1 / (1 + residual * residual / (tolerated * tolerated));
        equations.add(number, factors, -difference, static_cast<double>(pair.weight) * robust);
      }
    }
    correction = equations.matrix.ldlt().solve(equations.right);
    // No lens brightens a corner: what the overlaps leave open is such that the clearest one does not darken it.
    if (const auto clearest = clearest_view(correction); round + 2 < rounds && vignetting_of(correction, clearest) < 0)
      none[clearest] = 1;
  }
  std::vector<LightCorrection> corrections(views.size());
  for (size_t c = 0; c < views.size(); ++c) {
    const auto at = unknowns * static_cast<Eigen::Index>(c);
    corrections[c].gain = correction.segment<3>(at).array().exp().cast<float>();
    corrections[c].vignetting = static_cast<float>(std::max(0.0, vignetting_of(correction, c)));
  }
  return corrections;
}

}  // namespace booth
