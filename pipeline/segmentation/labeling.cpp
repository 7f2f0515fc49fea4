#include "pipeline/segmentation/labeling.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>

#include "pipeline/segmentation/components.h"
#include "pipeline/segmentation/minimum_cut.h"

namespace booth::segmentation {
namespace {

// Evidence is in nats: the logarithm of how much likelier one explanation is than the other.

/// What a perfectly ordinary background cell says for background, and the most that a cell can say for subject:
/// no single cell may outvote its whole neighbourhood.
constexpr float background_evidence = 4;
constexpr float largest_evidence = 12;
/// Beyond this a cell is subject whatever its neighbours say, but for noise.
constexpr float clear_subject = 3;
/// What a cell says that is darker than the background by what a soft shadow could take, or lighter by what bounced
/// light could add: next to nothing. Its
/// boundary decides: shadows fade in, things have edges.
constexpr float shadow_evidence = 0.05F;
/// Evidence within ± this leaves a cell's patch to be judged by its rim, which then says so much per cell. A rim's
/// boundary is an edge when it costs less than this share of one in flat colour.
constexpr float doubtful_evidence = 2;
constexpr float patch_evidence = 1;
constexpr float no_edge = 0.6F;
/// Bounced light tints the background by this much (lightness differences between channels), shadows by more.
constexpr float tint = 0.02F;
constexpr float tint_in_shadow = 0.08F;
/// Bounced light brightens by this much at most.
constexpr float brightest_glow = 0.08F;
/// A change of lightness up to this is not even noticed.
constexpr float unnoticed_change = 0.03F;

/// How exactly shadows and drift keep the background's texture, in lightness.
constexpr float kept_texture = 0.012F;
/// A roughness up to this is noise; beyond, it speaks for subject, so much per unit and so much at most.
constexpr float noisy_roughness = 3;
constexpr float roughness_evidence = 1.5F;
constexpr float largest_roughness_evidence = 6;

/// Differences of lightness between neighbours beyond noise that count as an edge.
constexpr float edge_lightness = 0.04F;

/// Integer capacities per nat.
constexpr float capacity_scale = 256;

/// Evidence for subject (positive) or background (negative) by cell.
class Evidence {
 public:
  explicit Evidence(const LabelingOptions& options)
      : deepest_(-std::log(static_cast<float>(options.darkest_shadow)) / srgb_exponent) {}

  std::vector<float> operator()(const Residual& residual) const {
    const auto& d = residual.difference.values;
    const auto& v = residual.variance.values;
    std::vector<float> evidence(d[0].size());
    if (residual.difference.channels == 1) {
      for (size_t i = 0; i < evidence.size(); ++i)
        evidence[i] = std::min(of_lightness(d[0][i], v[0][i]), largest_evidence);
      return evidence;
    }
    for (size_t i = 0; i < evidence.size(); ++i) {
      const float lightness = (d[0][i] + d[1][i] + d[2][i]) * (1.0F / 3);
      const float variance = (v[0][i] + v[1][i] + v[2][i]) * (1.0F / 9);
      const float shadow = tint_in_shadow * std::min(std::max(-lightness, 0.0F), deepest_);
      const float slack = tint * tint + shadow * shadow;
      const float red = d[0][i] - d[1][i];
      const float blue = d[2][i] - d[1][i];
      const float unlikeness =
          0.5F * (red * red / (v[0][i] + v[1][i] + slack) + blue * blue / (v[2][i] + v[1][i] + slack));
      evidence[i] = std::min(unlikeness + of_lightness(lightness, variance), largest_evidence);
    }
    return evidence;
  }

 private:
  float of_lightness(float lightness, float variance) const {
    const float change = std::abs(lightness);
    const float noticed = std::max(0.0F, change - unnoticed_change);
    const float spread = variance + 0.25F * unnoticed_change * unnoticed_change;
    const float rising = std::min(0.5F * noticed * noticed / spread - background_evidence, shadow_evidence);
    // Beyond the deepest shadow or the brightest glow the evidence rises again.
    const float limit = lightness < 0 ? 1 / deepest_ : 1 / brightest_glow;
    const float beyond = std::max(0.0F, change * limit - 1);
    return rising + 2 * background_evidence * beyond;
  }

  float deepest_;
};

/// How much rougher than noise a cell's surroundings are in the difference to the background, 1 for noise alone.
/// Shadows keep the background's texture, so that nothing of it is left in the difference; whoever stands before it
/// brings a texture of their own. What counts is the twist a − b − c + d of 2 × 2 cells, as it is blind to the
/// gradients of soft shadows. Squares that hold a cell which is clearly subject are left out, and of the four 3 × 3
/// windows with the cell at a corner the smoothest counts: neither looks across the subject's outline.
std::vector<float> roughness(const Residual& residual, const CellGrid& grid, const std::vector<float>& evidence) {
  const int channels = residual.difference.channels;
  const auto width = static_cast<size_t>(grid.width);
  std::vector<float> twist(grid.count(), 0), used(grid.count(), 0), window(grid.count(), 0), rough(grid.count(), 0);
  for (int c = 0; c < channels; ++c) {
    for (int y = 0; y + 1 < grid.height; ++y) {
      const float* here = residual.difference.values[c].data() + grid.index(0, y);
      const float* below = here + width;
      const float* variance = residual.variance.values[c].data() + grid.index(0, y);
      float* out = twist.data() + grid.index(0, y);
      for (int x = 0; x + 1 < grid.width; ++x) {
        const float t = here[x] - here[x + 1] - below[x] + below[x + 1];
        out[x] += t * t / (variance[x] + kept_texture * kept_texture);
      }
    }
  }
  for (int y = 0; y + 1 < grid.height; ++y) {
    const float* here = evidence.data() + grid.index(0, y);
    const float* below = here + width;
    for (int x = 0; x + 1 < grid.width; ++x) {
      const float most = std::max(std::max(here[x], here[x + 1]), std::max(below[x], below[x + 1]));
      used[grid.index(x, y)] = most < clear_subject ? 1.0F : 0.0F;
      twist[grid.index(x, y)] *= used[grid.index(x, y)];
    }
  }
  // window (x, y) covers the cells x … x + 2, y … y + 2.
  const float scale = 1.0F / static_cast<float>(4 * channels);
  for (int y = 0; y + 2 < grid.height; ++y) {
    const float* t = twist.data() + grid.index(0, y);
    const float* n = used.data() + grid.index(0, y);
    float* out = window.data() + grid.index(0, y);
    for (int x = 0; x + 2 < grid.width; ++x) {
      const float sum = t[x] + t[x + 1] + t[x + width] + t[x + width + 1];
      const float count = n[x] + n[x + 1] + n[x + width] + n[x + width + 1];
      out[x] = scale * sum / std::max(count, 1.0F);
    }
  }
  for (int y = 2; y + 2 < grid.height; ++y) {
    const float* up = window.data() + grid.index(0, y - 2);
    const float* here = window.data() + grid.index(0, y);
    float* out = rough.data() + grid.index(0, y);
    for (int x = 2; x + 2 < grid.width; ++x) {
      out[x] = std::min(std::min(up[x - 2], up[x]), std::min(here[x - 2], here[x]));
    }
  }
  return rough;
}

/// What it costs to draw a boundary between two neighbouring cells.
class BoundaryCost {
 public:
  BoundaryCost(const Residual& residual, const CellPlanes& body, double smoothness)
      : residual_(residual), body_(body), smoothness_(static_cast<float>(smoothness) * capacity_scale) {}

  int32_t operator()(size_t a, size_t b, bool diagonal) const {
    const float distance = diagonal ? 0.70710678F : 1.0F;
    return static_cast<int32_t>(smoothness_ * distance * std::exp(-0.5F * edge(a, b))) + 1;
  }

  /// How clearly an edge runs between two neighbours, as an exponent of the cost: 0 in flat colour.
  float edge(size_t a, size_t b) const {
    // An edge needs to show in the image itself and in its difference to the background: an edge of the
    // background alone is no boundary of the subject, nor is one that the background shows as well.
    float seen = 0, new_ = 0;
    const int channels = residual_.difference.channels;
    for (int c = 0; c < channels; ++c) {
      const float noise =
          residual_.variance.values[c][a] + residual_.variance.values[c][b] + edge_lightness * edge_lightness;
      const float in_body = body_.values[c][a] - body_.values[c][b];
      const float in_difference = residual_.difference.values[c][a] - residual_.difference.values[c][b];
      seen += in_body * in_body / noise;
      new_ += in_difference * in_difference / noise;
    }
    return std::min(seen, new_) / static_cast<float>(channels);
  }

 private:
  const Residual& residual_;
  const CellPlanes& body_;
  float smoothness_;
};

/// Settles, patch by patch, what could be a shadow as well as clothes in the background's hue. Patches are bounded by
/// edges; a shadow's rim towards clear background fades, that of a thing does not. A patch without such a rim lies
/// inside the subject.
void judge_patches(const CellGrid& grid, const BoundaryCost& cost, std::vector<float>& evidence) {
  const float least_edge = -2 * std::log(no_edge);
  const auto is_edge = [&](size_t a, size_t b) { return cost.edge(a, b) > least_edge; };
  std::vector<float> verdict(grid.count(), 0);
  CellMask visited(evidence.size(), 0);
  std::vector<size_t> members;
  for (size_t seed = 0; seed < grid.count(); ++seed) {
    if (visited[seed] != 0 || std::abs(evidence[seed]) > doubtful_evidence) continue;
    visited[seed] = 1;
    members.assign(1, seed);
    size_t rim = 0, sharp = 0;
    for (size_t n = 0; n < members.size(); ++n) {
      const size_t cell = members[n];
      const int x = static_cast<int>(cell % static_cast<size_t>(grid.width));
      const int y = static_cast<int>(cell / static_cast<size_t>(grid.width));
      for (const int k : {1, 3, 4, 6}) {
        const int nx = x + neighbor_steps[k][0];
        const int ny = y + neighbor_steps[k][1];
        if (!grid.contains(nx, ny)) continue;
        const size_t other = grid.index(nx, ny);
        if (evidence[other] < -doubtful_evidence) {
          ++rim;
          sharp += is_edge(cell, other);
        } else if (visited[other] == 0 && evidence[other] <= doubtful_evidence && !is_edge(cell, other)) {
          visited[other] = 1;
          members.push_back(other);
        }
      }
    }
    const double sharp_share = rim > 0 ? static_cast<double>(sharp) / static_cast<double>(rim) : 1;
    for (const size_t cell : members) verdict[cell] = static_cast<float>(2 * sharp_share - 1) * patch_evidence;
  }
  for (size_t i = 0; i < evidence.size(); ++i) evidence[i] += verdict[i];
}

/// Cells whose neighbourhood agrees so clearly that no boundary can run there; the others are the graph's nodes.
enum class Certainty : uint8_t { open, subject, background };

std::vector<Certainty> certain_cells(const std::vector<float>& evidence, const CellGrid& grid) {
  // Runs of equal clear cells that reach so far both ways, first along rows, then along columns. The image's border
  // agrees with whatever is beside it.
  constexpr int reach = 2;
  constexpr float clear_background = -2;
  std::vector<Certainty> clear(grid.count());
  std::transform(evidence.begin(), evidence.end(), clear.begin(), [](float e) {
    return e > clear_subject ? Certainty::subject : e < clear_background ? Certainty::background : Certainty::open;
  });
  const auto agree = [](Certainty here, bool same) { return same ? here : Certainty::open; };
  std::vector<Certainty> rows(grid.count());
  for (int y = 0; y < grid.height; ++y) {
    const Certainty* in = clear.data() + grid.index(0, y);
    Certainty* out = rows.data() + grid.index(0, y);
    for (int x = reach; x + reach < grid.width; ++x)
      out[x] = agree(in[x], in[x - 2] == in[x] && in[x - 1] == in[x] && in[x + 1] == in[x] && in[x + 2] == in[x]);
    for (int x = 0; x < grid.width; ++x) {
      if (x == reach) x = std::max(x, grid.width - reach);
      bool same = true;
      for (int d = -reach; d <= reach; ++d) same = same && in[std::clamp(x + d, 0, grid.width - 1)] == in[x];
      out[x] = agree(in[x], same);
    }
  }
  std::vector<Certainty>& certain = clear;
  for (int y = 0; y < grid.height; ++y) {
    std::array<const Certainty*, 2 * reach + 1> at{};
    for (int d = -reach; d <= reach; ++d)
      at[d + reach] = rows.data() + grid.index(0, std::clamp(y + d, 0, grid.height - 1));
    Certainty* out = certain.data() + grid.index(0, y);
    for (int x = 0; x < grid.width; ++x) {
      const Certainty here = at[reach][x];
      out[x] = agree(here, at[0][x] == here && at[1][x] == here && at[3][x] == here && at[4][x] == here);
    }
  }
  return clear;
}

CellMask cut(const std::vector<float>& evidence, const BoundaryCost& cost, const CellGrid& grid) {
  const std::vector<Certainty> certain = certain_cells(evidence, grid);
  std::vector<int32_t> node_of(grid.count(), -1);
  std::vector<size_t> cell_of;
  for (size_t i = 0; i < certain.size(); ++i) {
    if (certain[i] != Certainty::open) continue;
    node_of[i] = static_cast<int32_t>(cell_of.size());
    cell_of.push_back(i);
  }
  CutGraph graph;
  graph.nodes.resize(cell_of.size());
  for (size_t n = 0; n < cell_of.size(); ++n) {
    const size_t cell = cell_of[n];
    const int x = static_cast<int>(cell % static_cast<size_t>(grid.width));
    const int y = static_cast<int>(cell / static_cast<size_t>(grid.width));
    CutGraph::Node& node = graph.nodes[n];
    node.terminal += static_cast<int32_t>(evidence[cell] * capacity_scale);
    for (int k = 0; k < 8; ++k) {
      const int nx = x + neighbor_steps[k][0];
      const int ny = y + neighbor_steps[k][1];
      if (!grid.contains(nx, ny)) continue;
      const size_t other = grid.index(nx, ny);
      if (certain[other] != Certainty::open) {
        const int32_t price = cost(cell, other, k == 0 || k == 2 || k == 5 || k == 7);
        node.terminal += certain[other] == Certainty::subject ? price : -price;
        continue;
      }
      node.neighbor[k] = node_of[other];
      if (k < 4) continue;  // set from the other side
      const int32_t price = cost(cell, other, k == 5 || k == 7);
      node.capacity[k] = price;
      graph.nodes[node_of[other]].capacity[7 - k] = price;
    }
  }
  const std::vector<uint8_t> subject_side = minimum_cut(std::move(graph));
  CellMask mask(grid.count());
  for (size_t i = 0; i < mask.size(); ++i) {
    mask[i] = node_of[i] >= 0 ? subject_side[node_of[i]] : certain[i] == Certainty::subject;
  }
  return mask;
}

/// Parts that are tiny beside the largest are specks: noise, insects, a reflection.
/// @return the second largest part's share of the largest
double remove_specks(CellMask& mask, const CellGrid& grid, double smallest_part) {
  const Components parts = connected_components(mask, grid.width, grid.height, 1, 1, Connectivity::eight);
  if (parts.areas.empty()) return 0;
  std::vector<size_t> areas = parts.areas;
  std::sort(areas.begin(), areas.end(), std::greater<>());
  const auto largest = static_cast<double>(areas[0]);
  for (const Components::Run& run : parts.runs) {
    if (static_cast<double>(parts.areas[run.part]) >= smallest_part * largest) continue;
    std::fill(mask.begin() + static_cast<long>(grid.index(run.begin, run.row)),
              mask.begin() + static_cast<long>(grid.index(run.end, run.row)), uint8_t{0});
  }
  return areas.size() > 1 ? static_cast<double>(areas[1]) / largest : 0;
}

/// A hole through which one sees the background has a rim that shows as an edge. One without is a piece of the
/// subject that happens to look like the background behind it.
void fill_false_holes(CellMask& mask, const CellGrid& grid, const std::vector<float>& evidence,
                      const BoundaryCost& cost) {
  const Components gaps = connected_components(mask, grid.width, grid.height, 0, 0, Connectivity::four);
  struct Gap {
    bool open = false;  ///< reaches the border
    double rim = 0, price = 0, looks = 0;
  };
  std::vector<Gap> of(gaps.areas.size());
  for (const Components::Run& run : gaps.runs)
    if (run.row == 0 || run.row == grid.height - 1 || run.begin == 0 || run.end == grid.width) of[run.part].open = true;
  for (const Components::Run& run : gaps.runs) {
    Gap& gap = of[run.part];
    if (gap.open) continue;
    for (int x = run.begin; x < run.end; ++x) {
      const size_t cell = grid.index(x, run.row);
      gap.looks += evidence[cell];
      for (const int k : {1, 3, 4, 6}) {
        const size_t other = grid.index(x + neighbor_steps[k][0], run.row + neighbor_steps[k][1]);
        if (mask[other] == 0) continue;
        gap.rim += 1;
        gap.price += cost(cell, other, false) / static_cast<double>(capacity_scale);
      }
    }
  }
  // A rim counts as an edge when a boundary costs less than this share of what it costs in flat colour; a hole of a
  // few cells must on top look like background on average, as noise inside dark clothes does not.
  constexpr double faint_rim = 0.6;
  constexpr size_t few_cells = 12;
  for (const Components::Run& run : gaps.runs) {
    const Gap& gap = of[run.part];
    if (gap.open) continue;
    const size_t area = gaps.areas[run.part];
    const bool faint = gap.price > faint_rim * gap.rim;
    const bool doubtful = area < few_cells && gap.looks > -0.5 * static_cast<double>(area);
    if (faint || doubtful)
      std::fill(mask.begin() + static_cast<long>(grid.index(run.begin, run.row)),
                mask.begin() + static_cast<long>(grid.index(run.end, run.row)), uint8_t{1});
  }
}

/// Share of the subject's outline inside which, to a cell's reach, nothing is clearly subject.
double faint_share(const CellMask& mask, const CellGrid& grid, const std::vector<float>& evidence) {
  size_t outline = 0, faint = 0;
  for (int y = 1; y + 1 < grid.height; ++y) {
    for (int x = 1; x + 1 < grid.width; ++x) {
      const size_t i = grid.index(x, y);
      const auto width = static_cast<size_t>(grid.width);
      if (mask[i] == 0 || (mask[i - 1] & mask[i + 1] & mask[i - width] & mask[i + width]) != 0) continue;
      float clearest = 0;
      for (const size_t row : {i - width, i, i + width})
        for (const size_t cell : {row - 1, row, row + 1})
          if (mask[cell] != 0) clearest = std::max(clearest, evidence[cell]);
      ++outline;
      faint += clearest < clear_subject;
    }
  }
  return outline > 0 ? static_cast<double>(faint) / static_cast<double>(outline) : 0;
}

}  // namespace

Labeling label_cells(const CellGrid& grid, const Residual& residual, const CellPlanes& body,
                     const LabelingOptions& options) {
  std::vector<float> evidence = Evidence(options)(residual);
  const std::vector<float> rough = roughness(residual, grid, evidence);
  for (size_t i = 0; i < evidence.size(); ++i) {
    const float texture = roughness_evidence * std::max(0.0F, rough[i] - noisy_roughness);
    evidence[i] = std::min(evidence[i] + std::min(texture, largest_roughness_evidence), largest_evidence);
  }

  const BoundaryCost plain_cost(residual, body, 1);
  judge_patches(grid, plain_cost, evidence);

  Labeling labeling;
  labeling.subject = cut(evidence, BoundaryCost(residual, body, options.smoothness), grid);
  labeling.second_part = remove_specks(labeling.subject, grid, options.smallest_part);
  fill_false_holes(labeling.subject, grid, evidence, plain_cost);
  labeling.faint_outline = faint_share(labeling.subject, grid, evidence);
  std::vector<float> of_subject;
  for (size_t i = 0; i < evidence.size(); ++i) {
    if (labeling.subject[i] != 0) of_subject.push_back(evidence[i]);
  }
  labeling.subject_cells = of_subject.size();
  if (!of_subject.empty()) {
    const auto middle = of_subject.begin() + static_cast<long>(of_subject.size() / 2);
    std::nth_element(of_subject.begin(), middle, of_subject.end());
    labeling.contrast = std::clamp(*middle / largest_evidence, 0.0F, 1.0F);
  }
  return labeling;
}

}  // namespace booth::segmentation
