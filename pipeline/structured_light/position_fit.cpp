#include "pipeline/structured_light/position_fit.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <optional>

#include "pipeline/types/vector_clones.h"

namespace booth {
namespace {

constexpr int lanes = 8;
using Lanes [[gnu::vector_size(lanes * sizeof(float))]] = float;
using Mask [[gnu::vector_size(lanes * sizeof(float))]] = int32_t;
constexpr int widest_radius = 6;
constexpr float usual_residual_px = 0.2F;

[[gnu::always_inline]] inline void load(const float* from, Lanes* to) { std::memcpy(to, from, sizeof(Lanes)); }

/// What neighbours have to be near to: a step at (u, v) of offset + u × along + v × down, within tolerance + per_pixel
/// × max(|u|, |v|). One lane a pixel.
struct Prediction {
  Lanes column{}, column_along{}, column_down{};
  Lanes row{}, row_along{}, row_down{};
  Lanes tolerance{};
  float per_pixel = 0;
};

/// Weighted least-squares planes through the steps from each lane's centre of the pixels around it that are near to
/// what is predicted.
struct Planes {
  Lanes column{}, column_along{}, column_down{};
  Lanes row{}, row_along{}, row_down{};
  Lanes continuing{};  ///< pixels
  Lanes variance{};    ///< of the offset
  Lanes residual2{};   ///< mean square
};

[[gnu::always_inline]] inline void fit_planes(const RawPositions& raw, std::ptrdiff_t at, int radius,
                                              const Lanes& center_column, const Lanes& center_row,
                                              const Prediction& near, Planes* planes) {
  Lanes s{}, su{}, sv{}, suu{}, suv{}, svv{}, c{}, cu{}, cv{}, r{}, ru{}, rv{}, squares{}, count{};
  for (int v = -radius; v <= radius; ++v) {
    const float fv = static_cast<float>(v);
    const std::ptrdiff_t line = at + v * raw.stride();
    const Lanes near_column = near.column + fv * near.column_down, near_row = near.row + fv * near.row_down;
    Lanes w0{}, w1{}, w2{}, c0{}, c1{}, r0{}, r1{};  // sums over the line
    for (int u = -radius; u <= radius; ++u) {
      const float fu = static_cast<float>(u);
      Lanes column, row, w;
      load(raw.column.data() + line + u, &column);
      load(raw.row.data() + line + u, &row);
      load(raw.weight.data() + line + u, &w);
      column -= center_column;
      row -= center_row;
      const Lanes off_column = column - near_column - fu * near.column_along;
      const Lanes off_row = row - near_row - fu * near.row_along;
      const Lanes most = near.tolerance + near.per_pixel * static_cast<float>(std::max(std::abs(u), std::abs(v)));
      const Mask continues = (off_column <= most) & (off_column >= -most) & (off_row <= most) & (off_row >= -most);
      const Lanes zero{};
      w = continues ? w : zero;
      count += continues ? zero + 1.0F : zero;
      const Lanes wc = w * column, wr = w * row;
      w0 += w;
      w1 += fu * w;
      w2 += (fu * fu) * w;
      c0 += wc;
      c1 += fu * wc;
      r0 += wr;
      r1 += fu * wr;
      squares += wc * column + wr * row;
    }
    s += w0;
    su += w1;
    suu += w2;
    sv += fv * w0;
    suv += fv * w1;
    svv += (fv * fv) * w0;
    c += c0;
    cu += c1;
    cv += fv * c0;
    r += r0;
    ru += r1;
    rv += fv * r0;
  }
  // The inverse of the symmetric matrix of moments by its cofactors.
  const Lanes a00 = suu * svv - suv * suv, a01 = suv * sv - su * svv, a02 = su * suv - suu * sv;
  const Lanes a11 = s * svv - sv * sv, a12 = su * sv - s * suv, a22 = s * suu - su * su;
  const Lanes inverse = 1.0F / (s * a00 + su * a01 + sv * a02);
  planes->column = (a00 * c + a01 * cu + a02 * cv) * inverse;
  planes->column_along = (a01 * c + a11 * cu + a12 * cv) * inverse;
  planes->column_down = (a02 * c + a12 * cu + a22 * cv) * inverse;
  planes->row = (a00 * r + a01 * ru + a02 * rv) * inverse;
  planes->row_along = (a01 * r + a11 * ru + a12 * rv) * inverse;
  planes->row_down = (a02 * r + a12 * ru + a22 * rv) * inverse;
  planes->continuing = count;
  planes->variance = a00 * inverse;
  planes->residual2 = (squares - planes->column * c - planes->column_along * cu - planes->column_down * cv -
                       planes->row * r - planes->row_along * ru - planes->row_down * rv) /
                      s;
}

/// The change of position per pixel along `step` of the arrays: of both sides the gentler, as beyond an edge it leaps.
[[gnu::always_inline]] inline void slopes(const RawPositions& raw, std::ptrdiff_t at, std::ptrdiff_t step,
                                          const Lanes& center_column, const Lanes& center_row, float steepest,
                                          Lanes* column, Lanes* row) {
  constexpr int reach = 2;
  const Lanes zero{};
  Lanes least = zero + steepest * steepest;
  *column = *row = zero;
  for (const int side : {-reach, reach}) {
    Lanes there_column, there_row;
    load(raw.column.data() + at + side * step, &there_column);
    load(raw.row.data() + at + side * step, &there_row);
    const Lanes along_column = (there_column - center_column) / static_cast<float>(side);
    const Lanes along_row = (there_row - center_row) / static_cast<float>(side);
    const Lanes square = along_column * along_column + along_row * along_row;
    const Mask gentler = square < least;
    least = gentler ? square : least;
    *column = gentler ? along_column : *column;
    *row = gentler ? along_row : *row;
  }
}

/// The median of the positions around a pixel, each axis by itself; nothing where fewer than `fewest` are placed.
std::optional<std::array<float, 2>> median_around(const RawPositions& raw, std::ptrdiff_t at, int radius, int fewest) {
  constexpr size_t most = (2 * widest_radius + 1) * (2 * widest_radius + 1);
  std::array<std::array<float, most>, 2> values;
  size_t count = 0;
  for (int v = -radius; v <= radius; ++v)
    for (int u = -radius; u <= radius; ++u) {
      const auto i = static_cast<size_t>(at + v * raw.stride() + u);
      if (raw.column[i] == RawPositions::none) continue;
      values[0][count] = raw.column[i];
      values[1][count++] = raw.row[i];
    }
  if (count < static_cast<size_t>(fewest)) return std::nullopt;
  std::array<float, 2> median{};
  for (size_t axis = 0; axis < 2; ++axis) {
    const auto middle = values[axis].begin() + static_cast<std::ptrdiff_t>(count / 2);
    std::nth_element(values[axis].begin(), middle, values[axis].begin() + static_cast<std::ptrdiff_t>(count));
    median[axis] = *middle;
  }
  return median;
}

/// What continues a pixel's own position, or its median's, roughly.
[[gnu::always_inline]] inline void predict(const RawPositions& raw, std::ptrdiff_t at, const Lanes& center_column,
                                           const Lanes& center_row, float scale, Prediction* near) {
  constexpr float tolerance = 0.6F, per_pixel = 0.15F;
  constexpr float most_slope = 3;  // times the usual step: steeper is another surface
  slopes(raw, at, 1, center_column, center_row, most_slope * scale, &near->column_along, &near->row_along);
  slopes(raw, at, raw.stride(), center_column, center_row, most_slope * scale, &near->column_down, &near->row_down);
  near->tolerance = Lanes{} + tolerance;
  near->per_pixel = per_pixel;
}

/// What a block of pixels in a row became.
struct Fitted {
  std::array<float, lanes> column, row, variance;
  std::array<bool, lanes> found;
};

BOOTH_VECTOR_CLONES
void fit_block(const RawPositions& raw, std::ptrdiff_t at, int radius, float scale, Fitted* fitted) {
  const int window = (2 * radius + 1) * (2 * radius + 1),
            fewest = (window + 2) / 3;  // a surface's corner has a quarter
  const Lanes zero{};
  Lanes center_column, center_row;
  load(raw.column.data() + at, &center_column);
  load(raw.row.data() + at, &center_row);
  Prediction near;
  predict(raw, at, center_column, center_row, scale, &near);
  Planes planes;
  fit_planes(raw, at, radius, center_column, center_row, near, &planes);
  const Mask placed = center_column != zero + RawPositions::none;
  planes.continuing = placed ? planes.continuing : zero;

  bool any = false;
  for (int l = 0; l < lanes; ++l) {
    const float weight = raw.weight[static_cast<size_t>(at + l)];
    fitted->found[l] = weight != 0;
    if (weight == 0 || planes.continuing[l] >= static_cast<float>(fewest)) continue;
    const auto median = median_around(raw, at + l, radius, fewest);
    fitted->found[l] = median.has_value();
    if (!median) continue;
    any = true;
    center_column[l] = (*median)[0];
    center_row[l] = (*median)[1];
  }
  if (any) {
    predict(raw, at, center_column, center_row, scale, &near);
    fit_planes(raw, at, radius, center_column, center_row, near, &planes);
  }
  // Where a plane explains its pixels badly there is an edge or a wrong bit among them: those near it once more.
  any = false;
  for (int l = 0; l < lanes; ++l) {
    fitted->found[l] = fitted->found[l] && planes.continuing[l] >= static_cast<float>(fewest);
    any |= fitted->found[l] && planes.residual2[l] > usual_residual_px * usual_residual_px;
  }
  if (any) {
    near.column = planes.column;
    near.column_along = planes.column_along;
    near.column_down = planes.column_down;
    near.row = planes.row;
    near.row_along = planes.row_along;
    near.row_down = planes.row_down;
    near.per_pixel = 0;
    for (int l = 0; l < lanes; ++l)
      near.tolerance[l] = std::max(2 * usual_residual_px, std::sqrt(std::max(planes.residual2[l], 0.0F)));
    Planes again;
    fit_planes(raw, at, radius, center_column, center_row, near, &again);
    const Mask better = (planes.residual2 > zero + usual_residual_px * usual_residual_px) &
                        (again.continuing >= zero + static_cast<float>(fewest));
    planes.column = better ? again.column : planes.column;
    planes.row = better ? again.row : planes.row;
    planes.variance = better ? again.variance : planes.variance;
  }
  const Lanes column = center_column + planes.column, row = center_row + planes.row;
  for (int l = 0; l < lanes; ++l) {
    constexpr float spike = 1.5F;
    fitted->found[l] = fitted->found[l] && planes.variance[l] > 0 && std::isfinite(planes.variance[l]) &&
                       std::abs(planes.column[l]) < spike && std::abs(planes.row[l]) < spike;
    fitted->column[l] = column[l];
    fitted->row[l] = row[l];
    fitted->variance[l] = planes.variance[l];
  }
}

}  // namespace

RawPositions::RawPositions(int width, int height) : width_(width), height_(height), stride_(width + 2 * margin) {
  const size_t size = static_cast<size_t>(stride_ * (height + 2 * margin));
  column.assign(size, none);
  row.assign(size, none);
  weight.assign(size, 0);
}

PositionFit::PositionFit(const RawPositions& raw) : raw_(raw) {
  std::vector<float> steps;
  constexpr int stride = 3;
  for (int y = 0; y < raw.height(); y += stride)
    for (int x = 0; x + 1 < raw.width(); x += stride) {
      const auto i = static_cast<size_t>(raw.index(x, y));
      if (raw.column[i] == RawPositions::none || raw.column[i + 1] == RawPositions::none) continue;
      const float along = raw.column[i + 1] - raw.column[i], down = raw.row[i + 1] - raw.row[i];
      steps.push_back(along * along + down * down);
    }
  if (steps.empty()) return;
  const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
  std::nth_element(steps.begin(), middle, steps.end());
  constexpr float least = 0.1F, most = 4;
  scale_ = std::clamp(std::sqrt(*middle), least, most);
  constexpr float stripes_wanted = 2.5F;  // a window this wide, in projector pixels, holds edges of every direction
  radius_ = std::clamp(static_cast<int>(std::lround(0.5F * stripes_wanted / scale_)), 2, widest_radius);
}

void PositionFit::fit(int y, int first, int last, ProjectorCoordinates* out) const {
  for (int x = first; x < last; x += lanes) {
    const auto weight = raw_.weight.begin() + raw_.index(x, y);
    if (std::all_of(weight, weight + lanes, [](float w) { return w == 0; })) continue;
    Fitted fitted;
    fit_block(raw_, raw_.index(x, y), radius_, scale_, &fitted);
    for (int l = 0; l < std::min(lanes, last - x); ++l) {
      if (!fitted.found[l]) continue;
      float* position = out->position.pixel(x + l, y);
      position[0] = fitted.column[l];
      position[1] = fitted.row[l];
      constexpr float model_error = 0.03F;  // of blur that varies over the image, projector pixels
      out->sigma.at(x + l, y) = std::sqrt(fitted.variance[l] + model_error * model_error);
    }
  }
}

}  // namespace booth
