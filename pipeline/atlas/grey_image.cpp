#include "pipeline/atlas/grey_image.h"

#include <algorithm>
#include <cmath>

namespace booth {
namespace {

FloatImage grey_image(const PreparedView& view, size_t level) {
  const LightImage& light = view.colours[level];
  FloatImage grey(light.width, light.height, 1);
  const Eigen::Array3f share = Eigen::Array3f(0.25F, 0.5F, 0.25F) * view.balance.gain / full_light;
  const auto pixels = static_cast<float>(1 << level);
  const auto at = [&](int i) { return (static_cast<float>(i) + 0.5F) * pixels - 0.5F; };
  // The correction is a product of one for the column and one for the row, relative to that at the first pixel.
  const auto correction = [&](float x, float y) {
    return std::exp(view.balance.vignetting * (view.squared_radius(x, y) - view.squared_radius(at(0), at(0))));
  };
  std::vector<float> of_column(static_cast<size_t>(light.width));
  for (int x = 0; x < light.width; ++x) of_column[static_cast<size_t>(x)] = correction(at(x), at(0));
  const float of_first = std::exp(view.balance.vignetting * view.squared_radius(at(0), at(0)));
  for (int y = 0; y < light.height; ++y) {
    const int16_t* p = light.pixel(0, y);
    float* row = grey.pixel(0, y);
    const float of_row = of_first * correction(at(0), at(y));
    for (int x = 0; x < light.width; ++x, p += 4) {
      const float luma = share[0] * static_cast<float>(p[0]) + share[1] * static_cast<float>(p[1]) +
                         share[2] * static_cast<float>(p[2]);
      row[x] = 255 * std::sqrt(luma * of_row * of_column[static_cast<size_t>(x)]);
    }
  }
  return grey;
}

}  // namespace

std::vector<GreyLevels> grey_levels(std::span<const PreparedView> views, const Work& work) {
  std::vector<GreyLevels> levels(views.size());
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t c = begin; c < end; ++c)
      for (size_t k = 0; k < GreyLevels::count; ++k)
        levels[c].images[k] = grey_image(views[c], std::min(k + GreyLevels::finest, views[c].colours.size() - 1));
  });
  return levels;
}

}  // namespace booth
