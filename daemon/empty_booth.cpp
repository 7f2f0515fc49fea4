#include "daemon/empty_booth.h"

#include <algorithm>

namespace booth {
namespace {

constexpr int cells_across = 64;  ///< of the longer side: a cell is a hand's width where a camera sees a whole person
constexpr float changed_by = 0.06F;  ///< of the picture's mean; the noise of a cell's mean is far below

}  // namespace

CoarseView coarse_view(const Frame& frame) {
  const Image& image = *frame.pixels;
  // An even size averages all colours of a mosaic alike.
  const int longer = std::max(image.width, image.height);
  const int edge = std::max(2, (longer / cells_across + 1) / 2 * 2);
  CoarseView view{.columns = (image.width + edge - 1) / edge, .rows = (image.height + edge - 1) / edge, .cells = {}};
  std::vector<double> sums(static_cast<size_t>(view.columns) * static_cast<size_t>(view.rows));
  std::vector<double> counts(sums.size());
  double total = 0;
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) {
      const size_t cell =
          static_cast<size_t>(y / edge) * static_cast<size_t>(view.columns) + static_cast<size_t>(x / edge);
      double sum = 0;
      for (int channel = 0; channel < image.channels; ++channel) sum += image.at(x, y, channel);
      sums[cell] += sum;
      counts[cell] += image.channels;
      total += sum;
    }
  const double mean = total / std::max<double>(1, static_cast<double>(image.samples.size()));
  view.cells.reserve(sums.size());
  for (size_t i = 0; i < sums.size(); ++i)
    view.cells.push_back(static_cast<float>(mean > 0 ? sums[i] / counts[i] / mean : 1));
  return view;
}

double changed_share(std::span<const CoarseView> views) {
  if (views.size() < 2) return 0;
  const CoarseView& first = views.front();
  size_t changed = 0;
  for (size_t cell = 0; cell < first.cells.size(); ++cell) {
    float least = first.cells[cell], most = least;
    for (const CoarseView& view : views) {
      if (view.columns != first.columns || view.rows != first.rows) continue;
      least = std::min(least, view.cells[cell]);
      most = std::max(most, view.cells[cell]);
    }
    changed += most - least > changed_by ? 1 : 0;
  }
  return static_cast<double>(changed) / static_cast<double>(std::max<size_t>(1, first.cells.size()));
}

}  // namespace booth
