#include "pipeline/atlas/input_preparation.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <opencv2/core.hpp>
#include <opencv2/photo.hpp>
#include <utility>

#include "pipeline/atlas/linear_light.h"
#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

constexpr float no_surface = 1e9F;
/// Coverage from which on a pixel shows nothing but the subject.
constexpr uint8_t fully_covered = 250;

struct Box {
  int left, top, right, bottom;  ///< the last two exclusive
};

/// Where the subject is, with a margin for what the surface overshoots.
Box subject_box(const Image& coverage) {
  std::vector<uint8_t> in_column(static_cast<size_t>(coverage.width), 0);
  int top = coverage.height, bottom = 0;
  for (int y = 0; y < coverage.height; ++y) {
    const uint8_t* row = coverage.pixel(0, y);
    uint8_t in_row = 0;
    for (size_t x = 0; x < in_column.size(); ++x) {
      in_column[x] = static_cast<uint8_t>(in_column[x] | row[x]);
      in_row = static_cast<uint8_t>(in_row | row[x]);
    }
    if (in_row == 0) continue;
    top = std::min(top, y);
    bottom = y + 1;
  }
  if (bottom == 0) return {0, 0, 2, 2};
  const auto covered = [](uint8_t any) { return any != 0; };
  const auto first = std::find_if(in_column.begin(), in_column.end(), covered);
  const auto last = std::find_if(in_column.rbegin(), in_column.rend(), covered);
  const auto left = static_cast<int>(first - in_column.begin());
  const auto right = static_cast<int>(in_column.rend() - last);
  constexpr int margin = 8;
  return {std::max(0, left - margin), std::max(0, top - margin), std::min(coverage.width, right + margin),
          std::min(coverage.height, bottom + margin)};
}

std::vector<Eigen::Vector3f> project_vertices(const Mesh& mesh, const RigCamera& camera, int left, int top) {
  std::vector<Eigen::Vector3f> projected(mesh.positions.size(), Eigen::Vector3f::Zero());
  for (size_t v = 0; v < projected.size(); ++v) {
    const Eigen::Vector3d p = camera.camera_from_world * mesh.positions[v].cast<double>();
    if (const auto pixel = project_camera_point(camera.intrinsics, p))
      projected[v] = Eigen::Vector3d(pixel->x() - left, pixel->y() - top, p.z()).cast<float>();
  }
  return projected;
}

/// Three channels of the box.
Image cropped_colours(const Image& pixels, const Box& box) {
  Image crop(box.right - box.left, box.bottom - box.top, 3);
  const int green = pixels.channels >= 3 ? 1 : 0, blue = pixels.channels >= 3 ? 2 : 0;
  for (int y = 0; y < crop.height; ++y) {
    const uint8_t* from = pixels.pixel(box.left, box.top + y);
    uint8_t* to = crop.pixel(0, y);
    for (int x = 0; x < crop.width; ++x, from += pixels.channels, to += 3) {
      to[0] = from[0];
      to[1] = from[green];
      to[2] = from[blue];
    }
  }
  return crop;
}

/// At half resolution: 255 where all pixels under one show the subject alone.
Image fully_inside(const Image& coverage, const Box& box) {
  const int width = (box.right - box.left + 1) / 2, height = (box.bottom - box.top + 1) / 2;
  Image covered(width, height, 1);
  for (int y = 0; y < height; ++y) {
    const int upper = box.top + 2 * y, lower = std::min(upper + 1, box.bottom - 1);
    const uint8_t* above = coverage.pixel(box.left, upper);
    const uint8_t* below = coverage.pixel(box.left, lower);
    uint8_t* row = covered.pixel(0, y);
    for (int x = 0; x < width; ++x) {
      const int u = 2 * x, v = std::min(u + 1, box.right - box.left - 1);
      const uint8_t least = std::min(std::min(above[u], above[v]), std::min(below[u], below[v]));
      row[x] = least >= fully_covered ? uint8_t{255} : uint8_t{0};
    }
  }
  return covered;
}

/// 255 where all pixels under and around do, which erodes the silhouette by two to three pixels.
Image eroded(const Image& covered) {
  Image inside(covered.width, covered.height, 1);
  const int width = covered.width;
  std::vector<uint8_t> column(static_cast<size_t>(width));  // what three rows have in common
  for (int y = 1; y + 1 < covered.height; ++y) {
    const uint8_t *above = covered.pixel(0, y - 1), *here = covered.pixel(0, y), *below = covered.pixel(0, y + 1);
    for (size_t x = 0; x < column.size(); ++x) column[x] = static_cast<uint8_t>(above[x] & here[x] & below[x]);
    uint8_t* row = inside.pixel(0, y);
    for (int x = 1; x + 1 < width; ++x) {
      const uint8_t* around = column.data() + x;
      row[x] = static_cast<uint8_t>(around[-1] & around[0] & around[1]);
    }
  }
  return inside;
}

/// The nearest surface at the pixels of level 1, by scan conversion of the triangles that face the camera.
FloatImage depth_map(const Mesh& mesh, const std::vector<Eigen::Vector3f>& projected, int width, int height) {
  FloatImage inverse(width, height, 1, 0.0F);
  for (const auto& triangle : mesh.triangles) {
    Eigen::Vector3f p[3];
    bool in_front = true;
    for (size_t k = 0; k < 3; ++k) {
      const Eigen::Vector3f& q = projected[triangle[k]];
      in_front = in_front && q.z() > 0;
      p[k] = {0.5F * q.x() - 0.25F, 0.5F * q.y() - 0.25F, q.z() > 0 ? 1 / q.z() : 0};
    }
    if (!in_front) continue;
    const Eigen::Vector3f ab = p[1] - p[0], ac = p[2] - p[0];
    const float twice_area = ab.x() * ac.y() - ab.y() * ac.x();
    if (!(twice_area < 0)) continue;  // pixels run downwards, so outer faces are clockwise
    const int x0 = std::max(0, static_cast<int>(std::ceil(std::min({p[0].x(), p[1].x(), p[2].x()}))));
    const int x1 = std::min(width - 1, static_cast<int>(std::floor(std::max({p[0].x(), p[1].x(), p[2].x()}))));
    const int y0 = std::max(0, static_cast<int>(std::ceil(std::min({p[0].y(), p[1].y(), p[2].y()}))));
    const int y1 = std::min(height - 1, static_cast<int>(std::floor(std::max({p[0].y(), p[1].y(), p[2].y()}))));
    const float share = 1 / twice_area;
    for (int y = y0; y <= y1; ++y) {
      float* row = inverse.pixel(0, y);
      const float dy = static_cast<float>(y) - p[0].y();
      for (int x = x0; x <= x1; ++x) {
        const float dx = static_cast<float>(x) - p[0].x();
        const float b = (dx * ac.y() - dy * ac.x()) * share, c = (ab.x() * dy - ab.y() * dx) * share;
        const float nearness = p[0].z() + b * ab.z() + c * ac.z();
        row[x] = b >= 0 && c >= 0 && b + c <= 1 && nearness > row[x] ? nearness : row[x];
      }
    }
  }
  for (float& sample : inverse.samples) sample = sample > 0 ? 1 / sample : no_surface;
  return inverse;
}

/// Chamfer distance (3-4 weights, in thirds of a pixel) to the nearest marked pixel; outside the image all is marked.
Raster<uint16_t> chamfer_distance(const Image& marked) {
  constexpr int16_t straight = 3, diagonal = 4, far = 30000;
  const int width = marked.width, height = marked.height;
  Raster<uint16_t> distance(width, height, 1);
  // Two rows with a pixel of the outside on both sides: the one before in the sweep's direction, and the present one.
  std::vector<int16_t> before(static_cast<size_t>(width) + 2, 0), here = before;
  // From the row before at once for all pixels, then along the row.
  const auto relax_from_row_before = [&] {
    const int16_t* b = before.data() + 1;
    int16_t* h = here.data() + 1;
    for (int x = 0; x < width; ++x) {
      const auto beside = static_cast<int16_t>(std::min(b[x - 1], b[x + 1]) + diagonal);
      const auto ahead = static_cast<int16_t>(b[x] + straight);
      h[x] = std::min(h[x], std::min(beside, ahead));
    }
  };
  for (int y = 0; y < height; ++y) {
    const uint8_t* mark = marked.pixel(0, y);
    for (size_t x = 0; x < static_cast<size_t>(width); ++x) here[x + 1] = mark[x] != 0 ? int16_t{0} : far;
    relax_from_row_before();
    for (size_t x = 1; x <= static_cast<size_t>(width); ++x)
      here[x] = std::min(here[x], static_cast<int16_t>(here[x - 1] + straight));
    std::copy_n(here.begin() + 1, width, distance.pixel(0, y));
    before.swap(here);
    here.front() = here.back() = 0;
  }
  std::fill(before.begin(), before.end(), int16_t{0});
  for (int y = height - 1; y >= 0; --y) {
    std::copy_n(distance.pixel(0, y), width, here.begin() + 1);
    relax_from_row_before();
    for (size_t x = static_cast<size_t>(width); x >= 1; --x)
      here[x] = std::min(here[x], static_cast<int16_t>(here[x + 1] + straight));
    std::copy_n(here.begin() + 1, width, distance.pixel(0, y));
    before.swap(here);
    here.front() = here.back() = 0;
  }
  return distance;
}

/// 255 beyond `rim_px` from every place where the colour may belong to something else: outside the eroded
/// silhouette, at a step in depth on both of its sides, beyond the image.
Image confidence_map(const Image& inside, const FloatImage& depth, double rim_px) {
  constexpr float step_m = 0.03F;
  const int width = inside.width, height = inside.height;
  Image doubtful(width, height, 1);
  const auto differs = [](float one, float other) { return std::abs(one - other) > step_m; };
  for (int y = 0; y < height; ++y) {
    const uint8_t* is_inside = inside.pixel(0, y);
    const float* here = depth.pixel(0, y);
    const float* above = depth.pixel(0, std::max(0, y - 1));
    const float* below = depth.pixel(0, std::min(height - 1, y + 1));
    uint8_t* doubt = doubtful.pixel(0, y);
    for (int x = 0; x < width; ++x)
      doubt[x] =
          (is_inside[x] == 0) | differs(here[x], above[x]) | differs(here[x], below[x]) ? uint8_t{255} : uint8_t{0};
    for (int x = 0; x + 1 < width; ++x) {
      const uint8_t step = differs(here[x], here[x + 1]) ? 255 : 0;
      doubt[x] = static_cast<uint8_t>(doubt[x] | step);
      doubt[x + 1] = static_cast<uint8_t>(doubt[x + 1] | step);
    }
  }
  const Raster<uint16_t> distance = chamfer_distance(doubtful);
  Image confidence(inside.width, inside.height, 1);
  std::vector<uint8_t> rising;  // by thirds of a pixel
  for (double share = 0; share < 1; share = static_cast<double>(rising.size()) / (3 * rim_px))
    rising.push_back(static_cast<uint8_t>(std::lround(255 * share * share * (3 - 2 * share))));
  for (size_t i = 0; i < confidence.samples.size(); ++i)
    confidence.samples[i] = distance.samples[i] < rising.size() ? rising[distance.samples[i]] : uint8_t{255};
  return confidence;
}

/// At the right and the lower border, the border goes on.
Raster<TrustCell> trust_map(const FloatImage& depth, const Image& confidence) {
  Raster<TrustCell> trust(depth.width, depth.height, 1);
  for (int y = 0; y < trust.height; ++y) {
    const int below = std::min(y + 1, trust.height - 1);
    const std::array<const float*, 2> depths{depth.pixel(0, y), depth.pixel(0, below)};
    const std::array<const uint8_t*, 2> sure{confidence.pixel(0, y), confidence.pixel(0, below)};
    TrustCell* row = trust.pixel(0, y);
    const auto set = [&](int x, int right) {
      row[x].surface_m = std::max(std::max(depths[0][x], depths[0][right]), std::max(depths[1][x], depths[1][right]));
      row[x].confidence = uint32_t{sure[0][x]} | uint32_t{sure[0][right]} << 8 | uint32_t{sure[1][x]} << 16 |
                          uint32_t{sure[1][right]} << 24;
    };
    for (int x = 0; x + 1 < trust.width; ++x) set(x, x + 1);
    set(trust.width - 1, trust.width - 1);
  }
  return trust;
}

/// Replaces a band around the valid pixels by Telea's method and marks it valid.
void inpaint_rim(Image& colours, Image& valid) {
  constexpr int band_px = 12;
  constexpr double radius_px = 3;
  cv::Mat image(colours.height, colours.width, CV_8UC3, colours.samples.data());
  cv::Mat known(valid.height, valid.width, CV_8UC1, valid.samples.data());
  cv::Mat grown;
  cv::dilate(known, grown, cv::getStructuringElement(cv::MORPH_ELLIPSE, {2 * band_px + 1, 2 * band_px + 1}));
  cv::Mat missing = grown & ~known, filled;
  cv::inpaint(image, missing, filled, radius_px, cv::INPAINT_TELEA);
  filled.copyTo(image);
  grown.copyTo(known);
}

/// The light of the valid pixels, times the camera's gain; 0 elsewhere.
LightImage linear_light(const Image& srgb, const Image& valid, const Eigen::Array3f& colour_gain) {
  std::array<std::array<int16_t, 256>, 3> tables{};
  for (size_t c = 0; c < 3; ++c)
    for (size_t i = 0; i < tables[c].size(); ++i)
      tables[c][i] = static_cast<int16_t>(std::lround(
          std::min(brightest_light, colour_gain[static_cast<Eigen::Index>(c)] * full_light * linear_light_of_srgb[i])));
  LightImage linear(srgb.width, srgb.height, 4);
  const uint8_t* from = srgb.samples.data();
  int16_t* to = linear.samples.data();
  for (const uint8_t is_valid : valid.samples) {
    if (is_valid != 0)
      for (size_t c = 0; c < 3; ++c) to[c] = tables[c][from[c]];
    from += 3;
    to += 4;
  }
  return linear;
}

/// About: not every pixel is looked at.
double median_depth(const FloatImage& depth) {
  constexpr size_t step = 7;
  std::vector<float> covered;
  for (size_t i = 0; i < depth.samples.size(); i += step)
    if (depth.samples[i] < no_surface) covered.push_back(depth.samples[i]);
  if (covered.empty()) return 1;
  std::nth_element(covered.begin(), covered.begin() + static_cast<std::ptrdiff_t>(covered.size() / 2), covered.end());
  return static_cast<double>(covered[covered.size() / 2]);
}

}  // namespace

PreparedView prepare_view(const Mesh& mesh, const RigCamera& camera, const Frame& frame, const Silhouette& silhouette,
                          double rim_m, Inpainting inpainting) {
  const Box box = subject_box(silhouette.coverage);
  PreparedView view;
  view.camera = &camera;
  view.left = box.left;
  view.top = box.top;
  view.projected = project_vertices(mesh, camera, box.left, box.top);
  const Image covered = fully_inside(silhouette.coverage, box);
  const Image inside = eroded(covered);
  Image outside = covered;
  for (uint8_t& sample : outside.samples) sample = static_cast<uint8_t>(255 - sample);
  view.margin = chamfer_distance(outside);
  const FloatImage depth = depth_map(mesh, view.projected, inside.width, inside.height);
  const double half_resolution_px_per_m = 0.5 * camera.intrinsics.fx / median_depth(depth);
  view.trust = trust_map(depth, confidence_map(inside, depth, std::max(2.0, rim_m * half_resolution_px_per_m)));

  Image colours = cropped_colours(*frame.pixels, box);
  Image valid(colours.width, colours.height, 1);
  for (int y = 0; y < valid.height; ++y) {
    const uint8_t* half = inside.pixel(0, y / 2);
    uint8_t* row = valid.pixel(0, y);
    for (int x = 0; x < valid.width; ++x) row[x] = half[x / 2];
  }
  if (inpainting == Inpainting::telea) inpaint_rim(colours, valid);
  LightImage light = linear_light(colours, valid, camera.colour_gain);
  view.colours = push_pull(std::move(light), std::move(valid));
  return view;
}

float PreparedView::squared_radius(float x, float y) const {
  const Intrinsics& k = camera->intrinsics;
  const auto cx = static_cast<float>(k.cx), cy = static_cast<float>(k.cy);
  const float widest = std::max(cx, static_cast<float>(k.width - 1) - cx);
  const float highest = std::max(cy, static_cast<float>(k.height - 1) - cy);
  const float across = x + static_cast<float>(left) - cx, down = y + static_cast<float>(top) - cy;
  return (across * across + down * down) / (widest * widest + highest * highest);
}

void project_again(const Mesh& mesh, PreparedView* view) {
  view->projected = project_vertices(mesh, *view->camera, view->left, view->top);
}

}  // namespace booth
