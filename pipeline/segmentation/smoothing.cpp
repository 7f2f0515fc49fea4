#include "pipeline/segmentation/smoothing.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace booth::segmentation {
namespace {

/// Runs `line(values, stride, count)` over every row, then over every column.
template <class Line>
void along_both_axes(std::vector<float>& values, int width, int height, const Line& line) {
  for (int y = 0; y < height; ++y) line(values.data() + static_cast<size_t>(y) * static_cast<size_t>(width), 1, width);
  for (int x = 0; x < width; ++x) line(values.data() + x, width, height);
}

}  // namespace

void box_mean_3x3(std::vector<float>& values, int width, int height) {
  const auto w = static_cast<size_t>(width);
  std::vector<float> rows(values.size());
  for (int y = 0; y < height; ++y) {
    const float* in = values.data() + static_cast<size_t>(y) * w;
    float* out = rows.data() + static_cast<size_t>(y) * w;
    for (int x = 1; x + 1 < width; ++x) out[x] = in[x - 1] + in[x] + in[x + 1];
    out[0] = 2 * in[0] + in[std::min(1, width - 1)];
    out[width - 1] = 2 * in[width - 1] + in[std::max(width - 2, 0)];
  }
  for (int y = 0; y < height; ++y) {
    const float* above = rows.data() + static_cast<size_t>(std::max(y - 1, 0)) * w;
    const float* here = rows.data() + static_cast<size_t>(y) * w;
    const float* below = rows.data() + static_cast<size_t>(std::min(y + 1, height - 1)) * w;
    float* out = values.data() + static_cast<size_t>(y) * w;
    for (int x = 0; x < width; ++x) out[x] = (above[x] + here[x] + below[x]) / 9;
  }
}

void gaussian_blur(std::vector<float>& values, int width, int height, float sigma) {
  const int reach = std::max(1, static_cast<int>(std::ceil(3 * sigma)));
  std::vector<float> kernel(static_cast<size_t>(2 * reach + 1));
  float sum = 0;
  for (int i = -reach; i <= reach; ++i) {
    const float t = static_cast<float>(i) / sigma;
    sum += kernel[i + reach] = std::exp(-0.5F * t * t);
  }
  for (float& k : kernel) k /= sum;
  std::vector<float> copy;
  along_both_axes(values, width, height, [&](float* first, int stride, int count) {
    copy.resize(static_cast<size_t>(count));
    for (int i = 0; i < count; ++i) copy[i] = first[static_cast<ptrdiff_t>(i) * stride];
    for (int i = 0; i < count; ++i) {
      float blurred = 0;
      for (int j = std::max(0, i - reach); j <= std::min(count - 1, i + reach); ++j) {
        blurred += copy[j] * kernel[j - i + reach];
      }
      first[static_cast<ptrdiff_t>(i) * stride] = blurred;
    }
  });
}

}  // namespace booth::segmentation
