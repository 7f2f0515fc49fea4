#include "pipeline/segmentation/segmentation.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <functional>
#include <limits>
#include <random>

#include "pipeline/image/codec.h"
#include "pipeline/segmentation/components.h"
#include "pipeline/segmentation/minimum_cut.h"
#include "pipeline/thread_pool.h"

namespace booth {
namespace {

using testing::HasSubstr;
using Color = std::array<double, 3>;  // linear light

double srgb_from_linear(double l) {
  l = std::clamp(l, 0.0, 1.0);
  return 255 * (l <= 0.0031308 ? 12.92 * l : 1.055 * std::pow(l, 1 / 2.4) - 0.055);
}

/// A photograph whose coverage is known: a subject of one colour before a wall and floor that fade into each other.
struct Scene {
  int width = 200, height = 260;
  int channels = 3;
  /// Whether a point is subject, in pixels.
  std::function<bool(double x, double y)> subject;
  std::function<Color(double x, double y)> subject_color = [](double, double) { return Color{0.05, 0.12, 0.30}; };
  /// What is left of the light at a point of the background when the subject is there.
  std::function<double(double x, double y)> shadow = [](double, double) { return 1.0; };
  std::function<Color(double x, double y)> wall = [](double x, double y) {
    const double light = 0.35 + 0.0006 * y + 0.03 * std::sin(x / 40);
    return Color{light, 0.99 * light, 0.96 * light};
  };
  /// Gain of the body frame over the background frames, per channel, at a point.
  std::function<Color(double x, double y)> gain = [](double, double) { return Color{1, 1, 1}; };
  double noise = 1.0;  ///< standard deviation in 8-bit levels
  int backgrounds = 2;
  uint32_t seed = 1;
  std::string camera = "body-03";

  double coverage(int x, int y) const {
    constexpr int samples = 8;
    int inside = 0;
    for (int j = 0; j < samples; ++j) {
      for (int i = 0; i < samples; ++i) {
        inside += subject && subject(x + (i + 0.5) / samples - 0.5, y + (j + 0.5) / samples - 0.5);
      }
    }
    return static_cast<double>(inside) / (samples * samples);
  }

  Frame photograph(bool with_subject, uint32_t shot) const {
    auto image = std::make_shared<Image>(width, height, channels);
    std::mt19937 random(seed * 1000 + shot);
    std::normal_distribution<double> grain(0, noise);
    for (int y = 0; y < height; ++y) {
      for (int x = 0; x < width; ++x) {
        const double alpha = with_subject ? coverage(x, y) : 0;
        const double light = with_subject ? shadow(x, y) : 1;
        const Color behind = wall(x, y);
        const Color front = subject_color(x, y);
        const Color factor = with_subject ? gain(x, y) : Color{1, 1, 1};
        for (int c = 0; c < channels; ++c) {
          const double linear = factor[c] * (alpha * front[c] + (1 - alpha) * light * behind[c]);
          const double level = srgb_from_linear(linear) + (noise > 0 ? grain(random) : 0);
          image->at(x, y, c) = static_cast<uint8_t>(std::lround(std::clamp(level, 0.0, 255.0)));
        }
      }
    }
    Frame frame;
    frame.camera = camera;
    frame.pixels = std::move(image);
    return frame;
  }

  std::vector<Frame> empty_booth() const {
    std::vector<Frame> frames;
    for (int i = 0; i < backgrounds; ++i) frames.push_back(photograph(false, static_cast<uint32_t>(i + 1)));
    return frames;
  }
  Frame body() const { return photograph(true, 0); }
  Image truth() const {
    Image image(width, height, 1);
    for (int y = 0; y < height; ++y) {
      for (int x = 0; x < width; ++x) image.at(x, y) = static_cast<uint8_t>(std::lround(255 * coverage(x, y)));
    }
    return image;
  }
};

bool in_ellipse(double x, double y, double cx, double cy, double rx, double ry) {
  const double u = (x - cx) / rx, v = (y - cy) / ry;
  return u * u + v * v < 1;
}

/// Head, trunk, two legs with a gap between them and an arm akimbo with a hole.
bool in_figure(double x, double y) {
  const bool head = in_ellipse(x, y, 100, 50, 16, 20);
  const bool trunk = x > 76.2 && x < 123.7 && y > 68 && y < 150;
  const bool legs = y >= 150 && y < 235.2 && ((x > 77.3 && x < 96.2) || (x > 104.8 && x < 123.3));
  const bool arm = in_ellipse(x, y, 124, 105, 30, 30) && !in_ellipse(x, y, 124, 105, 20, 20);
  return head || trunk || legs || arm;
}

Scene figure_scene() {
  Scene scene;
  scene.subject = in_figure;
  return scene;
}

struct Agreement {
  double iou = 0;
  double offset_px = 0;  ///< mean signed distance of the outlines, positive when too large
};

Agreement compare(const Image& found, const Image& truth) {
  size_t both = 0, either = 0, length = 0;
  double surplus = 0;
  for (int y = 0; y < truth.height; ++y) {
    for (int x = 0; x < truth.width; ++x) {
      const bool a = found.at(x, y) >= 128, b = truth.at(x, y) >= 128;
      both += a && b;
      either += a || b;
      surplus += (found.at(x, y) - truth.at(x, y)) / 255.0;
      if (x + 1 < truth.width) length += b != (truth.at(x + 1, y) >= 128);
      if (y + 1 < truth.height) length += b != (truth.at(x, y + 1) >= 128);
    }
  }
  return {static_cast<double>(both) / static_cast<double>(either), surplus / static_cast<double>(length)};
}

Result<Segmentation> run(const Scene& scene, const SegmentationOptions& options = {}) {
  return segment(scene.empty_booth(), scene.body(), options);
}

void expect_good(const Scene& scene, double least_iou = 0.985, double most_offset_px = 0.1) {
  const Result<Segmentation> result = run(scene);
  ASSERT_TRUE(result) << result.error().message;
  const Agreement agreement = compare(result->silhouette.coverage, scene.truth());
  EXPECT_GE(agreement.iou, least_iou);
  EXPECT_LE(std::abs(agreement.offset_px), most_offset_px) << agreement.offset_px;
}

TEST(Segmentation, FindsTheFigureItsGapsAndItsHole) {
  const Scene scene = figure_scene();
  const Result<Segmentation> result = run(scene);
  ASSERT_TRUE(result) << result.error().message;
  const Image& coverage = result->silhouette.coverage;
  EXPECT_EQ(result->silhouette.camera, scene.camera);
  EXPECT_EQ(coverage.width, scene.width);
  EXPECT_EQ(coverage.height, scene.height);
  EXPECT_EQ(coverage.channels, 1);
  EXPECT_TRUE(result->warnings.empty()) << result->warnings.front();
  EXPECT_EQ(coverage.at(134, 105), 0) << "through the arm";
  EXPECT_EQ(coverage.at(100, 200), 0) << "between the legs";
  EXPECT_EQ(coverage.at(100, 100), 255);
  size_t covered = 0;
  for (const uint8_t v : coverage.samples) covered += v >= 128;
  EXPECT_NEAR(result->subject_share, static_cast<double>(covered) / static_cast<double>(coverage.samples.size()),
              0.005);
  expect_good(scene);
}

TEST(Segmentation, OneBackgroundFrameIsEnough) {
  Scene scene = figure_scene();
  scene.backgrounds = 1;
  expect_good(scene);
}

TEST(Segmentation, PlacesAStraightOutlineToAFractionOfAPixel) {
  for (const double edge : {80.0, 80.25, 80.5, 80.75}) {
    Scene scene;
    scene.noise = 0.7;
    scene.subject = [edge](double x, double y) { return x > edge && x < 140 && y > 30 && y < 230; };
    const Result<Segmentation> result = run(scene);
    ASSERT_TRUE(result) << result.error().message;
    double sum = 0;
    int rows = 0;
    for (int y = 60; y < 200; ++y, ++rows) {
      // The subject's width left of x = 110; its outline crosses the rows at right angles.
      double width = 0;
      for (int x = 60; x <= 110; ++x) width += result->silhouette.coverage.at(x, y) / 255.0;
      sum += 110.5 - width;
    }
    EXPECT_NEAR(sum / rows, edge, 0.06);
  }
}

TEST(Segmentation, CopesWithNoise) {
  Scene scene = figure_scene();
  scene.noise = 4;
  expect_good(scene, 0.97, 0.15);
}

TEST(Segmentation, CompensatesGainAndWhiteBalance) {
  for (const Color& gain : {Color{1.15, 1.15, 1.15}, Color{0.85, 0.85, 0.85}, Color{1.1, 1.0, 0.9}}) {
    Scene scene = figure_scene();
    scene.gain = [gain](double, double) { return gain; };
    expect_good(scene);
  }
}

TEST(Segmentation, CompensatesADriftThatVariesOverTheImage) {
  Scene scene = figure_scene();
  scene.gain = [](double x, double) {
    const double g = 0.9 + 0.001 * x;
    return Color{g, g, 0.97 * g};
  };
  expect_good(scene);
}

TEST(Segmentation, SoftShadowsAreNotSubject) {
  Scene scene = figure_scene();
  scene.shadow = [](double x, double y) {
    const double u = (x - 110) / 35, v = (y - 236) / 10;
    return 1 - 0.6 * std::exp(-0.5 * (u * u + v * v));
  };
  expect_good(scene, 0.97, 0.2);
}

TEST(Segmentation, ADarkSubjectInItsShadowStays) {
  Scene scene = figure_scene();
  scene.subject_color = [](double, double) { return Color{0.015, 0.015, 0.015}; };
  scene.shadow = [](double x, double y) {
    const double u = (x - 110) / 35, v = (y - 236) / 10;
    return 1 - 0.7 * std::exp(-0.5 * (u * u + v * v));
  };
  expect_good(scene, 0.97, 0.2);
}

TEST(Segmentation, ClothesInTheWallsHueStay) {
  // A third darker than the wall behind, as a shadow might be, but with an outline as sharp as things have.
  Scene scene = figure_scene();
  scene.subject_color = [wall = scene.wall](double x, double y) {
    if (y < 70 || y > 150) return Color{0.05, 0.12, 0.30};
    const Color behind = wall(x, y);
    return Color{0.66 * behind[0], 0.66 * behind[1], 0.66 * behind[2]};
  };
  expect_good(scene, 0.96, 0.25);
}

TEST(Segmentation, DarkClothesBeforeADarkSpotStay) {
  Scene scene = figure_scene();
  const Color black{0.02, 0.02, 0.02};
  scene.subject_color = [black](double, double) { return black; };
  scene.wall = [black, wall = scene.wall](double x, double y) {
    return in_ellipse(x, y, 98, 110, 7, 7) || in_ellipse(x, y, 30, 60, 7, 7) ? black : wall(x, y);
  };
  expect_good(scene);
}

TEST(Segmentation, TheBorderMayCutTheSubject) {
  Scene scene;
  scene.subject = [](double x, double y) {
    return in_ellipse(x, y, 100, 90, 35, 45) || (y > 150 && std::abs(x - 100) < 90) ||
           (y > 125 && std::abs(x - 100) < 15);
  };
  const Result<Segmentation> result = run(scene);
  ASSERT_TRUE(result) << result.error().message;
  EXPECT_EQ(result->silhouette.coverage.at(100, scene.height - 1), 255);
  EXPECT_EQ(result->silhouette.coverage.at(20, scene.height - 1), 255);
  EXPECT_EQ(result->silhouette.coverage.at(2, scene.height - 1), 0);
  expect_good(scene);
}

TEST(Segmentation, SpecksAreDropped) {
  Scene scene = figure_scene();
  scene.subject = [](double x, double y) { return in_figure(x, y) || in_ellipse(x, y, 30, 200, 4, 4); };
  const Result<Segmentation> result = run(scene);
  ASSERT_TRUE(result) << result.error().message;
  EXPECT_EQ(result->silhouette.coverage.at(30, 200), 0);
}

TEST(Segmentation, GreyImagesWork) {
  Scene scene = figure_scene();
  scene.channels = 1;
  expect_good(scene, 0.97, 0.15);
}

TEST(Segmentation, LargeImagesAreDecidedOnCoarserCells) {
  Scene scene;
  scene.width = 900;
  scene.height = 1100;
  scene.channels = 1;
  scene.backgrounds = 1;
  scene.subject = [](double x, double y) { return in_figure(x / 4.4, y / 4.3); };
  expect_good(scene, 0.995, 0.1);
}

TEST(Segmentation, ABoothThatStayedEmptyHasNoSubject) {
  Scene scene;
  scene.gain = [](double, double) { return Color{1.08, 1.05, 1.06}; };
  const Result<Segmentation> result = run(scene);
  ASSERT_FALSE(result);
  EXPECT_EQ(result.error().code, ErrorCode::no_subject);
  EXPECT_THAT(result.error().message, HasSubstr("body-03"));
}

TEST(Segmentation, TheBackgroundItselfHasNoSubject) {
  const Scene scene;
  const std::vector<Frame> background = scene.empty_booth();
  const Result<Segmentation> result = segment(background, background[0], {});
  ASSERT_FALSE(result);
  EXPECT_EQ(result.error().code, ErrorCode::no_subject);
}

TEST(Segmentation, RefusesBackgroundsThatDoNotFit) {
  const Scene scene = figure_scene();
  const Frame body = scene.body();
  EXPECT_EQ(segment(std::span<const Frame>(), body, {}).error().code, ErrorCode::no_background);

  std::vector<Frame> frames = scene.empty_booth();
  frames[1].pixels = nullptr;
  EXPECT_EQ(segment(frames, body, {}).error().code, ErrorCode::no_background);
  frames[1].pixels = std::make_shared<Image>(scene.width, scene.height - 1, 3);
  EXPECT_EQ(segment(frames, body, {}).error().code, ErrorCode::no_background);
  frames[1].pixels = std::make_shared<Image>(scene.width, scene.height, 1);
  const Result<Segmentation> result = segment(frames, body, {});
  EXPECT_EQ(result.error().code, ErrorCode::no_background);
  EXPECT_THAT(result.error().message, HasSubstr("body-03"));
}

TEST(Segmentation, RefusesImpossibleInput) {
  const Scene scene = figure_scene();
  const std::vector<Frame> background = scene.empty_booth();
  Frame body = scene.body();
  body.pixels = nullptr;
  EXPECT_EQ(segment(background, body, {}).error().code, ErrorCode::invalid_argument);
  body.pixels = std::make_shared<Image>(scene.width, scene.height, 4);
  EXPECT_EQ(segment(background, body, {}).error().code, ErrorCode::invalid_argument);
  Image torn(scene.width, scene.height, 3);
  torn.samples.resize(10);
  body.pixels = std::make_shared<Image>(torn);
  EXPECT_EQ(segment(background, body, {}).error().code, ErrorCode::invalid_argument);

  body = scene.body();
  for (const double bad : {-1.0, 1000.0, std::numeric_limits<double>::quiet_NaN()}) {
    EXPECT_EQ(segment(background, body, {.darkest_shadow = bad}).error().code, ErrorCode::invalid_argument);
    EXPECT_EQ(segment(background, body, {.smoothness = bad}).error().code, ErrorCode::invalid_argument);
    EXPECT_EQ(segment(background, body, {.smallest_part = bad}).error().code, ErrorCode::invalid_argument);
    EXPECT_EQ(segment(background, body, {.smallest_subject = bad}).error().code, ErrorCode::invalid_argument);
  }
}

TEST(Segmentation, SurvivesAnyImage) {
  std::mt19937 random(4);
  for (const auto& [width, height] : {std::pair{1, 1}, {1, 40}, {40, 1}, {2, 3}, {17, 9}, {64, 64}}) {
    for (const int channels : {1, 3}) {
      const auto image = [&](auto value) {
        Frame frame;
        Image pixels(width, height, channels);
        for (uint8_t& v : pixels.samples) v = static_cast<uint8_t>(value());
        frame.pixels = std::make_shared<Image>(std::move(pixels));
        return frame;
      };
      const auto black = [] { return 0; };
      const auto white = [] { return 255; };
      const auto any = [&] { return random() & 255; };
      for (const std::vector<Frame>& background :
           {std::vector{image(black)}, std::vector{image(white), image(black)}, std::vector{image(any)}}) {
        for (const Frame& body : {image(black), image(white), image(any)}) {
          const Result<Segmentation> result = segment(background, body, {});
          if (!result) {
            EXPECT_EQ(result.error().code, ErrorCode::no_subject);
            continue;
          }
          EXPECT_EQ(result->silhouette.coverage.samples.size(), static_cast<size_t>(width * height));
        }
      }
    }
  }
}

TEST(Segmentation, WarnsOfALargeChangeOfLight) {
  Scene scene = figure_scene();
  scene.gain = [](double, double) { return Color{1.8, 1.8, 1.8}; };
  const Result<Segmentation> result = run(scene);
  ASSERT_TRUE(result) << result.error().message;
  ASSERT_FALSE(result->warnings.empty());
  EXPECT_THAT(result->warnings[0], HasSubstr("body-03"));
}

TEST(Segmentation, WarnsWhenSomethingFillsTheImage) {
  Scene scene;
  scene.subject = [](double x, double y) { return x < 170 || y > 200; };
  const Result<Segmentation> result = run(scene);
  ASSERT_TRUE(result) << result.error().message;
  EXPECT_THAT(result->warnings, testing::Contains(HasSubstr("border")));
}

TEST(Segmentation, WarnsOfASecondPersonAtTheEdge) {
  Scene scene = figure_scene();
  scene.subject = [](double x, double y) { return in_figure(x, y) || (x > 170 && y > 60 && y < 200); };
  const Result<Segmentation> result = run(scene);
  ASSERT_TRUE(result) << result.error().message;
  EXPECT_THAT(result->warnings, testing::Contains(HasSubstr("something else")));
}

TEST(Segmentation, TheSameBytesWhateverTheThreads) {
  const Scene scene = figure_scene();
  const std::vector<Frame> background = scene.empty_booth();
  const Frame body = scene.body();
  const Image alone = segment(background, body, {}).value().silhouette.coverage;
  ThreadPool pool(3);
  EXPECT_EQ(segment(background, body, {}, pool.work()).value().silhouette.coverage.samples, alone.samples);
  std::vector<Image> side_by_side(4);
  pool.run(side_by_side.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) side_by_side[i] = segment(background, body, {}).value().silhouette.coverage;
  });
  for (const Image& image : side_by_side) EXPECT_EQ(image.samples, alone.samples);
}

TEST(Segmentation, StopsWhenAskedAndReportsProgress) {
  const Scene scene = figure_scene();
  Work work;
  double last = 0;
  work.progress = [&](double fraction) {
    EXPECT_GE(fraction, last);
    last = fraction;
  };
  ASSERT_TRUE(segment(scene.empty_booth(), scene.body(), {}, work));
  EXPECT_EQ(last, 1);
  std::stop_source source;
  source.request_stop();
  work.stop = source.get_token();
  EXPECT_EQ(
      segment(scene.empty_booth(), scene.body(), {}, Work{.stop = source.get_token(), .progress = {}, .parallel = {}})
          .error()
          .code,
      ErrorCode::cancelled);
}

Image load(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  const std::vector<uint8_t> bytes{std::istreambuf_iterator<char>(file), {}};
  return decode_image(bytes).value();
}

/// Segments every camera of a recording and compares with its exact masks.
void expect_good_recording(const std::filesystem::path& recording, double least_iou, double least_mean_iou,
                           double most_offset_px) {
  double sum = 0;
  int cameras = 0;
  for (const auto& entry : std::filesystem::directory_iterator(recording / "truth" / "masks")) {
    const std::string camera = entry.path().stem().string();
    SCOPED_TRACE(camera);
    const auto frame = [&](const std::filesystem::path& path) {
      Frame f;
      f.camera = camera;
      f.pixels = std::make_shared<Image>(load(path));
      return f;
    };
    std::vector<Frame> background;
    for (int i = 0; i < 3; ++i) {
      const auto path = recording / "frames" / "background" / (camera + "-00" + std::to_string(i) + ".jpg");
      if (std::filesystem::exists(path)) background.push_back(frame(path));
    }
    const Result<Segmentation> result =
        segment(background, frame(recording / "frames" / "body" / (camera + ".jpg")), {});
    ASSERT_TRUE(result) << result.error().message;
    EXPECT_TRUE(result->warnings.empty()) << result->warnings.front();
    const Agreement agreement = compare(result->silhouette.coverage, load(entry.path()));
    EXPECT_GE(agreement.iou, least_iou);
    EXPECT_LE(std::abs(agreement.offset_px), most_offset_px);
    sum += agreement.iou;
    ++cameras;
  }
  ASSERT_GT(cameras, 0);
  EXPECT_GE(sum / cameras, least_mean_iou);
}

TEST(SegmentationQuality, MiniRecording) {
  const std::filesystem::path recording = std::filesystem::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini";
  if (!std::filesystem::exists(recording)) GTEST_SKIP() << "no " << recording;
  expect_good_recording(recording, 0.983, 0.988, 0.15);
}

TEST(SegmentationQuality, LargeRecordings) {
  const char* folder = std::getenv("BOOTH_RECORDINGS");
  if (folder == nullptr) GTEST_SKIP() << "BOOTH_RECORDINGS is not set";
  for (const char* name : {"man-casual", "woman-casual"}) {
    SCOPED_TRACE(name);
    expect_good_recording(std::filesystem::path(folder) / name, 0.99, 0.995, 0.15);
  }
}

TEST(MinimumCut, EqualsTheBestOfAllLabelings) {
  std::mt19937 random(11);
  for (int round = 0; round < 300; ++round) {
    constexpr int side = 3, n = side * side;
    segmentation::CutGraph graph;
    graph.nodes.resize(n);
    for (int y = 0; y < side; ++y) {
      for (int x = 0; x < side; ++x) {
        auto& node = graph.nodes[static_cast<size_t>(y * side + x)];
        node.terminal = static_cast<int32_t>(random() % 41) - 20;
        for (size_t k = 4; k < 8; ++k) {
          const int u = x + segmentation::neighbor_steps[k][0], v = y + segmentation::neighbor_steps[k][1];
          if (u < 0 || v < 0 || u >= side || v >= side) continue;
          const auto price = static_cast<int32_t>(random() % 12);
          auto& other = graph.nodes[static_cast<size_t>(v * side + u)];
          node.neighbor[k] = v * side + u;
          node.capacity[k] = price;
          other.neighbor[7 - k] = y * side + x;
          other.capacity[7 - k] = price;
        }
      }
    }
    const auto energy = [&](const auto& on_source) {
      long sum = 0;
      for (int i = 0; i < n; ++i) {
        const auto& node = graph.nodes[static_cast<size_t>(i)];
        if (on_source(i) && node.terminal < 0) sum -= node.terminal;
        if (!on_source(i) && node.terminal > 0) sum += node.terminal;
        for (size_t k = 0; k < 8; ++k) {
          if (node.neighbor[k] >= 0 && on_source(i) && !on_source(node.neighbor[k])) sum += node.capacity[k];
        }
      }
      return sum;
    };
    long best = std::numeric_limits<long>::max();
    for (int labels = 0; labels < 1 << n; ++labels) {
      best = std::min(best, energy([labels](int i) { return (labels >> i & 1) != 0; }));
    }
    const std::vector<uint8_t> cut = segmentation::minimum_cut(graph);
    EXPECT_EQ(energy([&](int i) { return cut[static_cast<size_t>(i)] != 0; }), best);
  }
}

TEST(ConnectedComponents, FollowsTheNeighborhoodAskedFor) {
  // clang-format off
  const std::vector<uint8_t> mask{1, 0, 0, 1, 1,
                                  0, 1, 0, 0, 1,
                                  0, 0, 0, 1, 1,
                                  1, 1, 0, 1, 0};
  // clang-format on
  const auto eight = segmentation::connected_components(mask, 5, 4, 1, 1, segmentation::Connectivity::eight);
  EXPECT_EQ(eight.areas, (std::vector<size_t>{2, 6, 2}));
  const auto four = segmentation::connected_components(mask, 5, 4, 1, 1, segmentation::Connectivity::four);
  EXPECT_EQ(four.areas, (std::vector<size_t>{1, 6, 1, 2}));
  const auto gaps = segmentation::connected_components(mask, 5, 4, 0, 0, segmentation::Connectivity::four);
  EXPECT_EQ(gaps.areas, (std::vector<size_t>{9, 1}));
  ASSERT_FALSE(gaps.runs.empty());
  EXPECT_EQ(gaps.runs.back().row, 3);
  EXPECT_EQ(gaps.runs.back().begin, 4);
  EXPECT_EQ(gaps.runs.back().end, 5);
  EXPECT_EQ(gaps.runs.back().part, 1);
}

}  // namespace
}  // namespace booth
