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
  Box box{coverage.width, coverage.height, 0, 0};
  for (int y = 0; y < coverage.height; ++y) {
    const uint8_t* row = coverage.pixel(0, y);
    for (int x = 0; x < coverage.width; ++x) {
      if (row[x] == 0) continue;
      box.left = std::min(box.left, x);
      box.right = std::max(box.right, x + 1);
      box.top = std::min(box.top, y);
      box.bottom = std::max(box.bottom, y + 1);
    }
  }
  if (box.right == 0) return {0, 0, 2, 2};
  constexpr int margin = 8;
  return {std::max(0, box.left - margin), std::max(0, box.top - margin), std::min(coverage.width, box.right + margin),
          std::min(coverage.height, box.bottom + margin)};
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

Image cropped_colours(const Image& pixels, const Box& box) {
  Image crop(box.right - box.left, box.bottom - box.top, 3);
  for (int y = 0; y < crop.height; ++y) {
    const uint8_t* from = pixels.pixel(box.left, box.top + y);
    uint8_t* to = crop.pixel(0, y);
    if (pixels.channels == 3)
      std::copy_n(from, 3 * static_cast<ptrdiff_t>(crop.width), to);
    else
      for (int x = 0; x < crop.width; ++x, from += pixels.channels, to += 3)
        for (int c = 0; c < 3; ++c) to[c] = from[pixels.channels > 3 ? c : 0];
  }
  return crop;
}

/// At half resolution: 255 where all pixels under one show the subject alone.
Image fully_inside(const Image& coverage, const Box& box) {
  const int width = (box.right - box.left + 1) / 2, height = (box.bottom - box.top + 1) / 2;
  Image covered(width, height, 1, 255);
  for (int y = box.top; y < box.bottom; ++y)
    for (int x = box.left; x < box.right; ++x)
      if (coverage.at(x, y) < fully_covered) covered.at((x - box.left) / 2, (y - box.top) / 2) = 0;
  return covered;
}

/// 255 where all pixels under and around do, which erodes the silhouette by two to three pixels.
Image eroded(const Image& covered) {
  Image inside(covered.width, covered.height, 1);
  for (int y = 1; y + 1 < inside.height; ++y)
    for (int x = 1; x + 1 < inside.width; ++x) {
      uint8_t all = 255;
      for (int v = y - 1; v <= y + 1; ++v)
        for (int u = x - 1; u <= x + 1; ++u) all = static_cast<uint8_t>(all & covered.at(u, v));
      inside.at(x, y) = all;
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
  constexpr uint16_t straight = 3, diagonal = 4;
  const int width = marked.width, height = marked.height;
  Raster<uint16_t> distance(width, height, 1);
  const auto at = [&](int x, int y) { return distance.contains(x, y) ? distance.at(x, y) : uint16_t{0}; };
  const auto relax = [](uint16_t& here, uint16_t neighbour, uint16_t step) {
    here = std::min(here, static_cast<uint16_t>(neighbour + step));
  };
  constexpr uint16_t far = 30000;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      uint16_t here = marked.at(x, y) != 0 ? uint16_t{0} : far;
      relax(here, at(x - 1, y), straight);
      relax(here, at(x - 1, y - 1), diagonal);
      relax(here, at(x, y - 1), straight);
      relax(here, at(x + 1, y - 1), diagonal);
      distance.at(x, y) = here;
    }
  for (int y = height - 1; y >= 0; --y)
    for (int x = width - 1; x >= 0; --x) {
      uint16_t& here = distance.at(x, y);
      relax(here, at(x + 1, y), straight);
      relax(here, at(x + 1, y + 1), diagonal);
      relax(here, at(x, y + 1), straight);
      relax(here, at(x - 1, y + 1), diagonal);
    }
  return distance;
}

/// 255 beyond `rim_px` from every place where the colour may belong to something else: outside the eroded
/// silhouette, at a step in depth on both of its sides, beyond the image.
Image confidence_map(const Image& inside, const FloatImage& depth, double rim_px) {
  constexpr float step_m = 0.03F;
  Image doubtful(inside.width, inside.height, 1);
  for (int y = 0; y < doubtful.height; ++y)
    for (int x = 0; x < doubtful.width; ++x) {
      if (inside.at(x, y) == 0) doubtful.at(x, y) = 255;
      const float here = depth.at(x, y);
      for (const auto& [u, v] : {std::pair{x + 1, y}, std::pair{x, y + 1}}) {
        if (!depth.contains(u, v)) continue;
        if (std::abs(depth.at(u, v) - here) > step_m) doubtful.at(x, y) = doubtful.at(u, v) = 255;
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

LightImage linear_light(const Image& srgb, const Eigen::Array3f& colour_gain) {
  std::array<std::array<int16_t, 256>, 3> tables{};
  for (size_t c = 0; c < 3; ++c)
    for (size_t i = 0; i < tables[c].size(); ++i)
      tables[c][i] = static_cast<int16_t>(std::lround(
          std::min(brightest_light, colour_gain[static_cast<Eigen::Index>(c)] * full_light * linear_light_of_srgb[i])));
  LightImage linear(srgb.width, srgb.height, 4);
  const uint8_t* from = srgb.samples.data();
  for (size_t i = 0; i < linear.samples.size(); i += 4, from += 3)
    for (size_t c = 0; c < 3; ++c) linear.samples[i + c] = tables[c][from[c]];
  return linear;
}

double median_depth(const FloatImage& depth) {
  std::vector<float> covered;
  std::copy_if(depth.samples.begin(), depth.samples.end(), std::back_inserter(covered),
               [](float metres) { return metres < no_surface; });
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
  view.depth = depth_map(mesh, view.projected, inside.width, inside.height);
  const double half_resolution_px_per_m = 0.5 * camera.intrinsics.fx / median_depth(view.depth);
  view.confidence = confidence_map(inside, view.depth, std::max(2.0, rim_m * half_resolution_px_per_m));

  Image colours = cropped_colours(*frame.pixels, box);
  Image valid(colours.width, colours.height, 1);
  for (int y = 0; y < valid.height; ++y)
    for (int x = 0; x < valid.width; ++x) valid.at(x, y) = inside.at(x / 2, y / 2);
  if (inpainting == Inpainting::telea) inpaint_rim(colours, valid);
  view.colours = push_pull(linear_light(colours, camera.colour_gain), valid);
  return view;
}

void project_again(const Mesh& mesh, PreparedView* view) {
  view->projected = project_vertices(mesh, *view->camera, view->left, view->top);
}

}  // namespace booth
