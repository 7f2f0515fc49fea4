#include "pipeline/segmentation/segmentation.h"

#include <cmath>
#include <sstream>

#include "pipeline/segmentation/background_model.h"
#include "pipeline/segmentation/labeling.h"
#include "pipeline/segmentation/matting.h"

namespace booth {
namespace {

using segmentation::BackgroundModel;
using segmentation::Labeling;
using segmentation::Residual;

// When an operator should have a look.
constexpr double much_border = 0.5;         ///< share of the image's border that the subject touches
constexpr double much_drift = 1.4;          ///< factor in linear light between the captures
constexpr double little_agreement = 0.25;   ///< share of the image that still looks like the background
constexpr double large_second_part = 0.03;  ///< see Labeling::second_part
/// See Labeling::faint_outline. Measured: up to 0.05 in colour, from 0.09 in grey with skin as bright as the wall.
constexpr double much_faint_outline = 0.08;
constexpr double little_contrast = 0.3;  ///< see Labeling::contrast

/// What is left of a camera's movement is undone to first order when smaller than this; the background is moved by
/// whole pixels and looked at anew when larger.
constexpr float small_movement_px = 0.6F;
constexpr int most_realignments = 3;
constexpr float largest_movement_px = 12;  ///< more is no camera that was touched but one that looks elsewhere
constexpr float much_movement_px = 0.6F;   ///< the calibration suffers

bool is_misaligned(const BackgroundModel& model, const Residual& residual) {
  const float x = residual.movement_px[0], y = residual.movement_px[1];
  return std::hypot(x, y) <= largest_movement_px &&
         std::max(std::abs(x - static_cast<float>(model.offset.x)), std::abs(y - static_cast<float>(model.offset.y))) >
             small_movement_px;
}

Result<void> check(const SegmentationOptions& options) {
  const auto in = [](double value, double low, double high) { return value >= low && value <= high; };
  std::ostringstream message;
  if (!in(options.darkest_shadow, 0.05, 0.95)) {
    message << "segmentation.darkest_shadow: " << options.darkest_shadow << ", expected 0.05 … 0.95";
  } else if (!in(options.smoothness, 0, 20)) {
    message << "segmentation.smoothness: " << options.smoothness << ", expected 0 … 20";
  } else if (!in(options.smallest_part, 0, 1)) {
    message << "segmentation.smallest_part: " << options.smallest_part << ", expected 0 … 1";
  } else if (!in(options.smallest_subject, 0, 1)) {
    message << "segmentation.smallest_subject: " << options.smallest_subject << ", expected 0 … 1";
  } else {
    return {};
  }
  return Error{ErrorCode::invalid_argument, message.str()};
}

std::string describe(const Image& image) {
  std::ostringstream text;
  text << image.width << " × " << image.height << " with " << image.channels << " channel(s)";
  return text.str();
}

bool holds_its_samples(const Image& image) {
  return image.width > 0 && image.height > 0 && (image.channels == 1 || image.channels == 3) &&
         image.samples.size() ==
             static_cast<size_t>(image.width) * static_cast<size_t>(image.height) * static_cast<size_t>(image.channels);
}

bool same_size(const Image& a, const Image& b) {
  return a.width == b.width && a.height == b.height && a.channels == b.channels;
}

Result<void> check(const EmptyView& empty, const Frame& body) {
  if (!body.pixels || !holds_its_samples(*body.pixels))
    return Error{ErrorCode::invalid_argument, "camera " + body.camera + ": the body frame is no grey or RGB image"};
  if (!same_size(empty.mean, *body.pixels) || !holds_its_samples(empty.mean))
    return Error{ErrorCode::no_background, "camera " + body.camera + ": the empty booth was seen as " +
                                               describe(empty.mean) + ", the body frame is " + describe(*body.pixels)};
  return {};
}

double covered_share(const Image& coverage) {
  uint64_t sum = 0;
  for (const uint8_t v : coverage.samples) sum += v;
  return static_cast<double>(sum) / 255 / static_cast<double>(coverage.samples.size());
}

/// Share of the image's border pixels that are subject.
double border_share(const Image& coverage) {
  size_t covered = 0;
  for (int x = 0; x < coverage.width; ++x) {
    covered += coverage.at(x, 0) >= 128;
    covered += coverage.at(x, coverage.height - 1) >= 128;
  }
  for (int y = 0; y < coverage.height; ++y) {
    covered += coverage.at(0, y) >= 128;
    covered += coverage.at(coverage.width - 1, y) >= 128;
  }
  return static_cast<double>(covered) / (2.0 * (coverage.width + coverage.height));
}

/// The channel's that changed most, at least 1.
double light_factor(const Residual& residual) {
  double drift = 1;
  for (int c = 0; c < residual.difference.channels; ++c)
    drift = std::max<double>(drift, std::exp(segmentation::srgb_exponent * std::abs(residual.mean_drift[c])));
  return drift;
}

std::vector<std::string> find_warnings(const Residual& residual, const Labeling& labeling, const Segmentation& result,
                                       const std::string& camera) {
  std::vector<std::string> warnings;
  const auto warn = [&](const std::string& what) { warnings.push_back("camera " + camera + ": " + what); };
  if (result.light_factor > much_drift) {
    std::ostringstream text;
    text.precision(2);
    text << "the light changed by a factor of " << result.light_factor << " since the background was captured";
    warn(text.str());
  }
  if (result.movement_px > much_movement_px) {
    std::ostringstream text;
    text.precision(2);
    text << "the camera moved by " << result.movement_px
         << " pixels since the background was captured; calibrate it anew";
    warn(text.str());
  }
  if (residual.drift_support < little_agreement) warn("little of the image still looks like the background");
  if (labeling.faint_outline > much_faint_outline || labeling.contrast < little_contrast)
    warn("the subject hardly differs from the background; parts of it may be missing");
  if (labeling.second_part > large_second_part) warn("something else than the subject seems to be in view");
  if (border_share(result.silhouette.coverage) > much_border)
    warn("the subject reaches over most of the image's border");
  return warnings;
}

}  // namespace

Result<EmptyView> learn_empty_view(std::span<const Frame> background) {
  constexpr size_t most_frames = 256;  // whose sums 16 bits hold
  if (background.empty()) return Error{ErrorCode::no_background, "no background frame"};
  const std::string& camera = background.front().camera;
  const auto fault = [&](const std::string& what) {
    return Error{ErrorCode::no_background, "camera " + camera + ": " + what};
  };
  if (background.size() > most_frames)
    return fault(std::to_string(background.size()) + " background frames, at most " + std::to_string(most_frames) +
                 " can be used");
  for (const Frame& frame : background) {
    if (!frame.pixels || !holds_its_samples(*frame.pixels)) return fault("a background frame is no grey or RGB image");
    if (!same_size(*frame.pixels, *background.front().pixels))
      return fault("a background frame is " + describe(*frame.pixels) + ", another " +
                   describe(*background.front().pixels));
  }
  return segmentation::learn_view(background);
}

Result<Segmentation> segment(std::span<const Frame> background, const Frame& body, const SegmentationOptions& options,
                             const Work& work) {
  const auto empty = learn_empty_view(background);
  if (!empty) return empty.error();
  return segment(*empty, body, options, work);
}

Result<Segmentation> segment(const EmptyView& empty, const Frame& body, const SegmentationOptions& options,
                             const Work& work) {
  if (Result<void> ok = check(options); !ok) return ok.error();
  if (Result<void> ok = check(empty, body); !ok) return ok.error();

  BackgroundModel model = segmentation::model_background(empty);
  const segmentation::CellFrame cells = segmentation::average_cells(*body.pixels, model.grid);
  Residual residual = segmentation::compare(model, cells);
  for (int n = 0; n < most_realignments && is_misaligned(model, residual); ++n) {
    const auto whole = [](float px) { return static_cast<int>(std::lround(px)); };
    model = segmentation::model_background(empty, {whole(residual.movement_px[0]), whole(residual.movement_px[1])});
    residual = segmentation::compare(model, cells);
  }
  if (work.stopped()) return Work::cancelled();
  work.report(0.5);

  const Labeling labeling = segmentation::label_cells(model.grid, residual, cells.lightness,
                                                      {.darkest_shadow = options.darkest_shadow,
                                                       .smoothness = options.smoothness,
                                                       .smallest_part = options.smallest_part});
  const double share = static_cast<double>(labeling.subject_cells) / static_cast<double>(model.grid.count());
  if (labeling.subject_cells == 0 || share < options.smallest_subject) {
    return Error{ErrorCode::no_subject, "camera " + body.camera + ": nobody stands before the background"};
  }
  if (work.stopped()) return Work::cancelled();
  work.report(0.8);

  Segmentation result;
  result.silhouette.camera = body.camera;
  result.silhouette.coverage = segmentation::matte(empty.mean, *body.pixels, model, residual, labeling.subject);
  result.subject_share = covered_share(result.silhouette.coverage);
  result.light_factor = light_factor(residual);
  result.movement_px = std::hypot(residual.movement_px[0], residual.movement_px[1]);
  result.background_share = residual.drift_support;
  result.warnings = find_warnings(residual, labeling, result, body.camera);
  work.report(1);
  return result;
}

}  // namespace booth
