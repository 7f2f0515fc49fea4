#include "pipeline/atlas/texture_atlas.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/colour_balance.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/atlas/linear_light.h"
#include "pipeline/atlas/occluder.h"
#include "pipeline/geometry/camera_model.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

struct Scene {
  Mesh mesh;
  Rig rig;
  std::vector<Frame> frames;
  std::vector<Silhouette> silhouettes;
};

using Paint = std::function<Eigen::Vector3d(const Eigen::Vector3d&)>;

/// Photographs of the body in the given colours before a wall, one ray a pixel.
Scene photographed(const synthetic::Body& body, const Paint& paint, double voxel_m, const synthetic::RigOptions& rig) {
  Scene scene;
  scene.mesh = extract_surface(synthetic::sample_field(body, voxel_m));
  scene.rig = synthetic::ring_rig(rig);
  for (const RigCamera& camera : scene.rig.cameras) {
    auto image = std::make_shared<Image>(camera.intrinsics.width, camera.intrinsics.height, 3, uint8_t{190});
    Silhouette silhouette{camera.id, Image(camera.intrinsics.width, camera.intrinsics.height, 1)};
    for (int y = 0; y < image->height; ++y)
      for (int x = 0; x < image->width; ++x) {
        Eigen::Vector3d hit;
        if (!synthetic::trace(body, camera.center(), world_ray(camera, Eigen::Vector2d(x, y)), &hit)) continue;
        silhouette.coverage.at(x, y) = 255;
        const Eigen::Vector3d colour = paint(hit);
        for (int c = 0; c < 3; ++c) image->at(x, y, c) = static_cast<uint8_t>(std::lround(255 * colour[c]));
      }
    Frame frame;
    frame.camera = camera.id;
    frame.pixels = std::move(image);
    scene.frames.push_back(std::move(frame));
    scene.silhouettes.push_back(std::move(silhouette));
  }
  return scene;
}

Scene person_scene() {
  return photographed(synthetic::person().body, synthetic::colour_at, 0.03,
                      {.cameras = 6, .width = 270, .height = 360});
}

constexpr AtlasOptions small{.size = 512};

TextureAtlas textured(const Scene& scene, const AtlasOptions& options = small, const Work& work = {}) {
  auto result = build_texture_atlas(scene.mesh, scene.rig, scene.frames, scene.silhouettes, options, work);
  EXPECT_TRUE(result.ok()) << (result.ok() ? "" : result.error().message);
  return result.ok() ? std::move(result).value() : TextureAtlas{};
}

/// Bilinear, as a renderer does it; levels of 255.
Eigen::Vector3d look_up(const Image& image, const Eigen::Vector2f& uv) {
  const double x = std::clamp(static_cast<double>(uv.x()) * image.width - 0.5, 0.0, image.width - 1.001);
  const double y = std::clamp(static_cast<double>(uv.y()) * image.height - 0.5, 0.0, image.height - 1.001);
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  const double fx = x - i, fy = y - j;
  Eigen::Vector3d colour;
  for (int c = 0; c < 3; ++c)
    colour[c] = (1 - fy) * ((1 - fx) * image.at(i, j, c) + fx * image.at(i + 1, j, c)) +
                fy * ((1 - fx) * image.at(i, j + 1, c) + fx * image.at(i + 1, j + 1, c));
  return colour;
}

struct Sample {
  Eigen::Vector3d position, normal, colour;
};
/// The atlas at the triangles' middles.
std::vector<Sample> middles(const Mesh& mesh, const Atlas& atlas) {
  std::vector<Sample> samples;
  for (size_t t = 0; t < mesh.triangles.size(); ++t) {
    const auto p = [&](size_t k) { return mesh.positions[mesh.triangles[t][k]].cast<double>(); };
    const Eigen::Vector2f uv = (atlas.uv[t][0] + atlas.uv[t][1] + atlas.uv[t][2]) / 3;
    samples.push_back({(p(0) + p(1) + p(2)) / 3, (p(1) - p(0)).cross(p(2) - p(0)), look_up(atlas.image, uv)});
  }
  return samples;
}

/// Every triangle that reaches above that height as four. The mesh is open along the height.
Mesh split_above(const Mesh& mesh, float height) {
  Mesh split{mesh.positions, {}};
  std::map<std::pair<uint32_t, uint32_t>, uint32_t> middles_of;
  const auto middle = [&](uint32_t a, uint32_t b) {
    const auto [found, added] =
        middles_of.try_emplace(std::minmax(a, b), static_cast<uint32_t>(split.positions.size()));
    if (added) split.positions.push_back((mesh.positions[a] + mesh.positions[b]) / 2);
    return found->second;
  };
  for (const auto& [a, b, c] : mesh.triangles) {
    if (std::max({mesh.positions[a].y(), mesh.positions[b].y(), mesh.positions[c].y()}) < height) {
      split.triangles.push_back({a, b, c});
      continue;
    }
    const uint32_t ab = middle(a, b), bc = middle(b, c), ca = middle(c, a);
    for (const std::array<uint32_t, 3>& part : {std::array{a, ab, ca}, {ab, b, bc}, {ca, bc, c}, {ab, bc, ca}})
      split.triangles.push_back(part);
  }
  return split;
}

/// Mean absolute difference to the true colours, weighted by area, after the one gain a channel that nobody can know.
double mean_error(const Mesh& mesh, const Atlas& atlas, const Paint& paint, bool fit_gain = false) {
  const std::vector<Sample> samples = middles(mesh, atlas);
  Eigen::Array3d gain = Eigen::Array3d::Ones();
  if (fit_gain) {
    Eigen::Array3d found = Eigen::Array3d::Zero(), wanted = found;
    for (const Sample& s : samples) {
      found += s.normal.norm() * s.colour.array();
      wanted += s.normal.norm() * 255 * paint(s.position).array();
    }
    gain = wanted / found;
  }
  double sum = 0, area = 0;
  for (const Sample& s : samples) {
    sum += s.normal.norm() * (gain * s.colour.array() - 255 * paint(s.position).array()).abs().mean();
    area += s.normal.norm();
  }
  return sum / area;
}

/// Levels of 255 between the two sides of all chart borders, mean over points.
double seam_difference(const Mesh& mesh, const Atlas& atlas) {
  const auto neighbours = triangle_neighbours(mesh);
  double sum = 0, count = 0;
  for (size_t t = 0; t < mesh.triangles.size(); ++t)
    for (size_t k = 0; k < 3; ++k) {
      const auto n = static_cast<size_t>(neighbours[t][k]);
      const auto& other = mesh.triangles[n];
      const auto corner = [&](uint32_t v) {
        return static_cast<size_t>(std::find(other.begin(), other.end(), v) - other.begin());
      };
      const Eigen::Vector2f a = atlas.uv[t][k], b = atlas.uv[t][(k + 1) % 3];
      const Eigen::Vector2f c = atlas.uv[n][corner(mesh.triangles[t][k])];
      const Eigen::Vector2f d = atlas.uv[n][corner(mesh.triangles[t][(k + 1) % 3])];
      if ((a - c).norm() < 1e-6F && (b - d).norm() < 1e-6F) continue;
      for (const float s : {0.2F, 0.5F, 0.8F}) {
        sum += (look_up(atlas.image, a + s * (b - a)) - look_up(atlas.image, c + s * (d - c))).cwiseAbs().mean();
        ++count;
      }
    }
  return count > 0 ? sum / count : 0;
}

class TextureAtlasOfAPerson : public testing::Test {
 protected:
  static void SetUpTestSuite() { scene_ = std::make_unique<Scene>(person_scene()); }
  static void TearDownTestSuite() { scene_.reset(); }
  static std::unique_ptr<Scene> scene_;
};
std::unique_ptr<Scene> TextureAtlasOfAPerson::scene_;

TEST_F(TextureAtlasOfAPerson, HasTheirColoursWithoutSeams) {
  for (const Charting charting : {Charting::unfolding, Charting::flattening}) {
    AtlasOptions options = small;
    options.charting = charting;
    const TextureAtlas result = textured(*scene_, options);
    EXPECT_LT(mean_error(scene_->mesh, result.atlas, synthetic::colour_at), 3.0);
    EXPECT_LT(seam_difference(scene_->mesh, result.atlas), 1.0);
    EXPECT_GT(result.seen_share, 0.9);
    EXPECT_GT(result.used_share, 0.3);
    for (const auto& triangle : result.atlas.uv)
      for (const Eigen::Vector2f& uv : triangle) EXPECT_TRUE((uv.array() >= 0).all() && (uv.array() <= 1).all());
  }
}

TEST_F(TextureAtlasOfAPerson, HasTheirColoursByTheMethodsOfReferenceToo) {
  for (const TextureMethod method : {TextureMethod::best_view, TextureMethod::blend}) {
    const TextureAtlas result = textured(*scene_, {.size = 512, .charting = Charting::unfolding, .method = method});
    EXPECT_LT(mean_error(scene_->mesh, result.atlas, synthetic::colour_at), 5.0) << to_string(method);
    EXPECT_EQ(result.positions, scene_->mesh.positions) << to_string(method);
  }
}

TEST_F(TextureAtlasOfAPerson, IsOfOneColourWhereTheCamerasGainsAreKnown) {
  const Eigen::Array3f light(0.3F, 0.22F, 0.14F);
  Scene scene = *scene_;
  for (size_t c = 0; c < scene.frames.size(); ++c) {
    const float turn = static_cast<float>(c);
    const Eigen::Array3f gain(0.8F + 0.09F * turn, 1.25F - 0.08F * turn, c % 2 == 0 ? 0.85F : 1.2F);
    auto image = std::make_shared<Image>(*scene.frames[c].pixels);
    for (int y = 0; y < image->height; ++y)
      for (int x = 0; x < image->width; ++x)
        for (int k = 0; k < 3; ++k) image->at(x, y, k) = srgb_from_linear(light[k] / gain[k]);
    scene.frames[c].pixels = std::move(image);
    scene.rig.cameras[c].colour_gain = gain;
  }
  AtlasOptions options = small;
  options.balance_colours = false;
  const auto worst_error_of = [&](const Scene& seen) {
    double worst = 0;
    for (const Sample& sample : middles(seen.mesh, textured(seen, options).atlas))
      for (int k = 0; k < 3; ++k) worst = std::max(worst, std::abs(sample.colour[k] - srgb_from_linear(light[k])));
    return worst;
  };
  EXPECT_LE(worst_error_of(scene), 1.0) << "what rounding leaves";
  for (RigCamera& camera : scene.rig.cameras) camera.colour_gain.setOnes();
  EXPECT_GT(worst_error_of(scene), 10.0);
}

TEST_F(TextureAtlasOfAPerson, IsTheSameOnAnyNumberOfThreads) {
  ThreadPool pool(3);
  const TextureAtlas serial = textured(*scene_), parallel = textured(*scene_, small, pool.work());
  EXPECT_EQ(serial.atlas.image.samples, parallel.atlas.image.samples);
  EXPECT_EQ(serial.atlas.uv, parallel.atlas.uv);
}

TEST_F(TextureAtlasOfAPerson, IsTheSameWhateverTheOrderOfTheCameras) {
  Scene shuffled = *scene_;
  std::rotate(shuffled.rig.cameras.begin(), shuffled.rig.cameras.begin() + 2, shuffled.rig.cameras.end());
  std::reverse(shuffled.frames.begin(), shuffled.frames.end());
  std::swap(shuffled.silhouettes[0], shuffled.silhouettes[3]);
  for (const TextureMethod method : {TextureMethod::blend, TextureMethod::full}) {
    const AtlasOptions options{.size = 512, .method = method};
    const TextureAtlas one = textured(*scene_, options), other = textured(shuffled, options);
    EXPECT_EQ(one.atlas.image.samples, other.atlas.image.samples) << to_string(method);
    EXPECT_EQ(one.positions, other.positions) << to_string(method);
  }
}

/// Each pixel the mean of four.
Image halved(const Image& fine) {
  Image coarse(fine.width / 2, fine.height / 2, 3);
  for (int y = 0; y < coarse.height; ++y)
    for (int x = 0; x < coarse.width; ++x)
      for (int c = 0; c < 3; ++c)
        coarse.at(x, y, c) = static_cast<uint8_t>((fine.at(2 * x, 2 * y, c) + fine.at(2 * x + 1, 2 * y, c) +
                                                   fine.at(2 * x, 2 * y + 1, c) + fine.at(2 * x + 1, 2 * y + 1, c)) /
                                                  4);
  return coarse;
}

/// The same with black wherever no triangle lies.
Image with_black_gaps(const Atlas& atlas) {
  Image black(atlas.image.width, atlas.image.height, 3);
  const auto cross = [](const Eigen::Vector2f& a, const Eigen::Vector2f& b) { return a.x() * b.y() - a.y() * b.x(); };
  for (auto corners : atlas.uv) {
    for (Eigen::Vector2f& p : corners)
      p = p * static_cast<float>(black.width) - Eigen::Vector2f::Constant(0.5F);  // a texel's centre is a whole number
    const float area = cross(corners[1] - corners[0], corners[2] - corners[0]);
    const Eigen::Array2f low = corners[0].cwiseMin(corners[1]).cwiseMin(corners[2]);
    const Eigen::Array2f high = corners[0].cwiseMax(corners[1]).cwiseMax(corners[2]);
    for (int y = static_cast<int>(std::ceil(low.y())); static_cast<float>(y) <= high.y(); ++y)
      for (int x = static_cast<int>(std::ceil(low.x())); static_cast<float>(x) <= high.x(); ++x) {
        const Eigen::Vector2f q(static_cast<float>(x), static_cast<float>(y));
        bool inside = area != 0;
        for (size_t k = 0; k < 3; ++k)
          inside = inside && cross(corners[(k + 1) % 3] - corners[k], q - corners[k]) / area >= 0;
        if (inside) std::copy_n(atlas.image.pixel(x, y), 3, black.pixel(x, y));
      }
  }
  return black;
}

// Its charts' borders show no other chart in smaller versions of the atlas either.
TEST_F(TextureAtlasOfAPerson, HasNoSeamsInItsMipMaps) {
  Atlas atlas = textured(*scene_, {.size = 1024}).atlas, gaping = atlas;
  gaping.image = with_black_gaps(atlas);
  for (int level = 1; level <= 2; ++level) {
    atlas.image = halved(atlas.image);
    gaping.image = halved(gaping.image);
    EXPECT_LT(seam_difference(scene_->mesh, atlas), 3.0) << "level " << level;
    EXPECT_GT(seam_difference(scene_->mesh, gaping), 6.0) << "level " << level << ", the check is blind";
  }
}

TEST_F(TextureAtlasOfAPerson, DoesNotShowCamerasOfDifferentGain) {
  Scene uneven = *scene_;
  for (const size_t i : {size_t{1}, size_t{4}}) {
    auto image = std::make_shared<Image>(*uneven.frames[i].pixels);
    for (size_t s = 0; s < image->samples.size(); ++s)
      image->samples[s] = static_cast<uint8_t>(image->samples[s] * (s % 3 == 0 ? 0.8 : 0.9));
    uneven.frames[i].pixels = std::move(image);
  }
  AtlasOptions off = small;
  off.balance_colours = false;
  const double without = mean_error(uneven.mesh, textured(uneven, off).atlas, synthetic::colour_at, true);
  const double with = mean_error(uneven.mesh, textured(uneven).atlas, synthetic::colour_at, true);
  EXPECT_LT(with, 3.0);
  EXPECT_LT(with, 0.6 * without);
}

TEST_F(TextureAtlasOfAPerson, IsUniformWhereTheyAreWhateverTheGains) {
  const std::array<double, 6> gains{1, 0.7, 1.25, 0.85, 1.1, 0.6};
  const Eigen::Array3d colour(0.35, 0.22, 0.16);  // linear light
  Scene uniform = *scene_;
  for (size_t i = 0; i < uniform.frames.size(); ++i) {
    auto image = std::make_shared<Image>(*uniform.frames[i].pixels);
    const Image& coverage = uniform.silhouettes[i].coverage;
    for (size_t pixel = 0; pixel < coverage.samples.size(); ++pixel)
      for (size_t c = 0; c < 3; ++c) {
        const double light = gains[i] * (coverage.samples[pixel] != 0 ? colour[static_cast<Eigen::Index>(c)] : 0.5);
        image->samples[3 * pixel + c] =
            static_cast<uint8_t>(std::lround(255 * (1.055 * std::pow(light, 1 / 2.4) - 0.055)));
      }
    uniform.frames[i].pixels = std::move(image);
  }
  const TextureAtlas result = textured(uniform);
  Eigen::Array3d least = Eigen::Array3d::Constant(255), most = Eigen::Array3d::Zero();
  for (const Sample& s : middles(uniform.mesh, result.atlas)) {
    least = least.min(s.colour.array());
    most = most.max(s.colour.array());
  }
  EXPECT_LE((most - least).maxCoeff(), 1.0) << least.transpose() << " … " << most.transpose();
}

/// What balance_colours() finds where each camera's picture is darkened as its factor of `gains` and `vignetting` says.
std::vector<LightCorrection> balance_of_darkened(const Scene& scene, std::span<const double> gains,
                                                 std::span<const double> vignetting) {
  const Occluder occluder(scene.mesh);
  std::vector<PreparedView> views;
  for (size_t c = 0; c < scene.frames.size(); ++c) {
    auto image = std::make_shared<Image>(*scene.frames[c].pixels);
    const Intrinsics& k = scene.rig.cameras[c].intrinsics;
    const double corner2 =
        std::pow(std::max(k.cx, k.width - 1 - k.cx), 2) + std::pow(std::max(k.cy, k.height - 1 - k.cy), 2);
    for (int y = 0; y < image->height; ++y)
      for (int x = 0; x < image->width; ++x) {
        const double radius2 = (std::pow(x - k.cx, 2) + std::pow(y - k.cy, 2)) / corner2;
        const double factor = gains[c] * std::exp(-vignetting[c] * radius2);
        for (int i = 0; i < 3; ++i) {
          uint8_t& sample = image->at(x, y, i);
          sample = srgb_from_linear(static_cast<float>(factor) * linear_from_srgb(sample));
        }
      }
    Frame frame = scene.frames[c];
    frame.pixels = std::move(image);
    views.push_back(
        prepare_view(scene.mesh, scene.rig.cameras[c], frame, scene.silhouettes[c], 0.012, Inpainting::push_pull));
  }
  return balance_colours(scene.mesh, views, rate_cameras(scene.mesh, occluder, views));
}

TEST_F(TextureAtlasOfAPerson, FindsVignettingWhereTheOverlapsTellAndNoneWhereThereIsNone) {
  const std::array<double, 6> level{1, 1, 1, 1, 1, 1}, none{}, gains{1, 0.8, 1.1, 0.9, 1, 0.85};
  const std::array<double, 6> vignetting{0.5, 0, 0.3, 0.1, 0.6, 0};
  for (const LightCorrection& correction : balance_of_darkened(*scene_, level, none)) {
    EXPECT_NEAR(correction.vignetting, 0, 0.05);
    EXPECT_NEAR(correction.gain.mean(), 1, 0.02);
  }
  const auto corrections = balance_of_darkened(*scene_, gains, vignetting);
  for (size_t c = 0; c < corrections.size(); ++c)
    EXPECT_NEAR(corrections[c].vignetting, vignetting[c], 0.12) << "camera " << c;
}

TEST_F(TextureAtlasOfAPerson, DoesNotLetAFinelyMeshedGlossyHeadDecideTheBodysColours) {
  constexpr float neck = 1.45F;  // of the synthetic person, metres
  Scene glossy = *scene_;
  for (int round = 0; round < 3; ++round) glossy.mesh = split_above(glossy.mesh, neck);
  auto image = std::make_shared<Image>(*glossy.frames[0].pixels);
  const auto row = project(glossy.rig.cameras[0], Eigen::Vector3d(0, neck, 0));
  ASSERT_TRUE(row.has_value());
  for (int y = 0; y < row->y(); ++y)
    for (int x = 0; x < image->width; ++x)
      for (int c = 0; c < 3; ++c) image->at(x, y, c) = static_cast<uint8_t>(std::min(255.0, 1.12 * image->at(x, y, c)));
  glossy.frames[0].pixels = std::move(image);

  const TextureAtlas result = textured(glossy);
  double sum = 0, area = 0;
  for (const Sample& s : middles(glossy.mesh, result.atlas)) {
    if (s.position.y() > neck - 0.1) continue;
    sum += s.normal.norm() * (s.colour - 255 * synthetic::colour_at(s.position)).cwiseAbs().mean();
    area += s.normal.norm();
  }
  EXPECT_LT(sum / area, 3.0);
}

TEST_F(TextureAtlasOfAPerson, GetsAlongWithMissingFramesAndSaysWhatDoesNotFit) {
  Scene fewer = *scene_;
  fewer.frames.erase(fewer.frames.begin() + 2);
  fewer.silhouettes.erase(fewer.silhouettes.begin());
  fewer.frames[2].pixels = std::make_shared<Image>(10, 10, 3);
  fewer.frames.push_back({"unknown", 0, 0, 0, 0, 0, std::make_shared<Image>(10, 10, 3)});
  const TextureAtlas result = textured(fewer);
  ASSERT_EQ(result.warnings.size(), 1U);
  EXPECT_NE(result.warnings[0].find(fewer.frames[2].camera), std::string::npos);
  EXPECT_LT(mean_error(fewer.mesh, result.atlas, synthetic::colour_at), 20.0);
}

TEST_F(TextureAtlasOfAPerson, IsGreyFromGreyFrames) {
  Scene grey = *scene_;
  for (Frame& frame : grey.frames) {
    auto image = std::make_shared<Image>(frame.pixels->width, frame.pixels->height, 1);
    for (int y = 0; y < image->height; ++y)
      for (int x = 0; x < image->width; ++x) image->at(x, y) = frame.pixels->at(x, y, 1);
    frame.pixels = std::move(image);
  }
  const auto& samples = textured(grey).atlas.image.samples;
  for (size_t i = 0; i < samples.size(); i += 3)
    ASSERT_TRUE(samples[i] == samples[i + 1] && samples[i] == samples[i + 2]);
}

TEST_F(TextureAtlasOfAPerson, NeedsACameraThatSeesThem) {
  const auto none = build_texture_atlas(scene_->mesh, scene_->rig, {}, scene_->silhouettes, small);
  ASSERT_FALSE(none.ok());
  EXPECT_EQ(none.error().code, ErrorCode::too_few_views);

  Mesh elsewhere = scene_->mesh;
  for (Eigen::Vector3f& p : elsewhere.positions) p.y() += 50;
  const auto away = build_texture_atlas(elsewhere, scene_->rig, scene_->frames, scene_->silhouettes, small);
  ASSERT_FALSE(away.ok());
  EXPECT_EQ(away.error().code, ErrorCode::too_few_views);
}

TEST_F(TextureAtlasOfAPerson, RefusesBadOptionsAndMeshesAndStopsWhenAsked) {
  const auto code = [&](const Mesh& mesh, const AtlasOptions& options, const Work& work = {}) {
    const auto result = build_texture_atlas(mesh, scene_->rig, scene_->frames, scene_->silhouettes, options, work);
    return result.ok() ? ErrorCode::internal : result.error().code;
  };
  EXPECT_EQ(code(scene_->mesh, {.size = 10}), ErrorCode::invalid_argument);
  EXPECT_EQ(code(scene_->mesh, {.size = 512, .gutter_texels = -1}), ErrorCode::invalid_argument);
  EXPECT_EQ(code({}, small), ErrorCode::invalid_argument);
  Mesh broken = scene_->mesh;
  broken.positions[0].x() = std::nanf("");
  EXPECT_EQ(code(broken, small), ErrorCode::invalid_argument);
  std::stop_source source;
  source.request_stop();
  Work stopped;
  stopped.stop = source.get_token();
  EXPECT_EQ(code(scene_->mesh, small, stopped), ErrorCode::cancelled);
}

// A red bar stands before a blue column; the front camera sees the bar where the column continues behind it.
TEST(TextureAtlas, WhatStandsInFrontDoesNotPrintOnWhatIsBehind) {
  const synthetic::Body body{{{0, 0.2, 0}, {0, 1.6, 0}, 0.2, 0.2}, {{0.05, 0.3, 0.4}, {0.05, 1.5, 0.4}, 0.04, 0.04}};
  const auto is_bar = [](const Eigen::Vector3d& p) { return p.z() > 0.3; };
  const Paint paint = [&](const Eigen::Vector3d& p) {
    return is_bar(p) ? Eigen::Vector3d(0.9, 0.1, 0.1) : Eigen::Vector3d(0.1, 0.2, 0.8);
  };
  const Scene scene = photographed(body, paint, 0.025, {.cameras = 8, .width = 180, .height = 240});
  const TextureAtlas result = textured(scene);
  size_t wrong = 0, all = 0;
  for (const Sample& s : middles(scene.mesh, result.atlas)) {
    ++all;
    if ((s.colour.x() > s.colour.z()) != is_bar(s.position)) ++wrong;
  }
  EXPECT_LT(static_cast<double>(wrong), 0.005 * static_cast<double>(all));
}

/// A ball with stripes of many widths, and a mesh that is larger than it.
struct StripedBall {
  static constexpr double radius_m = 0.4;
  Scene scene;
  Eigen::Vector3d middle = Eigen::Vector3d::Zero();

  static Eigen::Vector3d paint(const Eigen::Vector3d& p) {
    const double wave = std::sin(70 * p.y() + 9 * std::sin(21 * p.x())) + std::sin(60 * p.x() + 50 * p.z());
    return Eigen::Vector3d::Constant(0.5 + 0.2 * wave);
  }
  explicit StripedBall(double too_large_m)
      : scene(photographed(synthetic::sphere(radius_m), paint, 0.03, {.cameras = 10, .width = 240, .height = 320})) {
    for (const Eigen::Vector3f& p : scene.mesh.positions) middle += p.cast<double>();
    middle /= static_cast<double>(scene.mesh.positions.size());
    for (Eigen::Vector3f& p : scene.mesh.positions)
      p = (middle + (radius_m + too_large_m) * (p.cast<double>() - middle).normalized()).cast<float>();
  }
  bool seen_from_all_around(const Eigen::Vector3d& p) const { return std::abs(p.y() - middle.y()) < 0.6 * radius_m; }
};

// Averaged where they do not meet, the stripes would lose their contrast; one over the other they keep it.
TEST(TextureAtlas, LaysThePicturesOverEachOtherWhereTheSurfaceIsWrong) {
  const StripedBall ball(0.010);
  const auto contrast = [&](bool align) {
    AtlasOptions options = small;
    options.align_surface = false;
    options.align_views = align;
    double sum = 0, squares = 0, count = 0;
    for (const Sample& s : middles(ball.scene.mesh, textured(ball.scene, options).atlas)) {
      if (!ball.seen_from_all_around(s.position)) continue;
      sum += s.colour.mean();
      squares += s.colour.mean() * s.colour.mean();
      ++count;
    }
    return std::sqrt(squares / count - sum * sum / count / count);
  };
  const double without = contrast(false), with = contrast(true), whole = 0.2 * 255;
  EXPECT_LT(without, 0.93 * whole) << "nothing to be cured";
  EXPECT_GT(with, without + 0.6 * (whole - without));
}

// The cameras tell where the surface of a ball is that is 6 mm smaller than its mesh.
TEST(TextureAtlas, LaysTheSurfaceWhereTheCamerasAgreeButNotWhereItIsKnown) {
  constexpr double too_large_m = 0.006, radius_m = StripedBall::radius_m;
  const StripedBall ball(too_large_m);
  const Scene& scene = ball.scene;
  const auto mean_distance = [&](const std::vector<Eigen::Vector3f>& positions) {
    double sum = 0, count = 0;
    for (const Eigen::Vector3f& p : positions) {
      if (!ball.seen_from_all_around(p.cast<double>())) continue;
      sum += std::abs((p.cast<double>() - ball.middle).norm() - radius_m);
      ++count;
    }
    return sum / count;
  };
  EXPECT_LT(mean_distance(textured(scene).positions), 0.5 * too_large_m);

  const std::vector<uint8_t> exact(scene.mesh.positions.size(), 1);
  const auto kept = build_texture_atlas(scene.mesh, scene.rig, scene.frames, scene.silhouettes, small, {}, exact);
  ASSERT_TRUE(kept.ok());
  EXPECT_EQ(kept.value().positions, scene.mesh.positions);
  const auto refused =
      build_texture_atlas(scene.mesh, scene.rig, scene.frames, scene.silhouettes, small, {}, std::span(exact).first(3));
  ASSERT_FALSE(refused.ok());
  EXPECT_EQ(refused.error().code, ErrorCode::invalid_argument);
}

// Seen from one side only: the other side continues the colours around it.
TEST(TextureAtlas, WhatNoCameraSeesIsFilledFromItsSurroundings) {
  const synthetic::Body ball = synthetic::sphere(0.4);
  const Paint paint = [](const Eigen::Vector3d& p) { return Eigen::Vector3d(0.3, 0.5 + 0.5 * p.y(), 0.2); };
  Scene scene = photographed(ball, paint, 0.03, {.cameras = 8, .width = 180, .height = 240});
  scene.frames.resize(2);  // in front and to the left
  const TextureAtlas result = textured(scene);
  EXPECT_LT(result.seen_share, 0.8);
  for (const Sample& s : middles(scene.mesh, result.atlas)) {
    ASSERT_NEAR(s.colour.x(), 255 * 0.3, 6);
    ASSERT_NEAR(s.colour.y(), 255 * 0.7, 255 * 0.25);
    ASSERT_NEAR(s.colour.z(), 255 * 0.2, 6);
  }
}

}  // namespace
}  // namespace booth
