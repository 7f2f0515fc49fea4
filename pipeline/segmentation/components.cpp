#include "pipeline/segmentation/components.h"

#include <algorithm>

namespace booth::segmentation {
namespace {

int32_t root_of(std::vector<int32_t>& parent, int32_t i) {
  while (parent[i] != i) {
    parent[i] = parent[parent[i]];
    i = parent[i];
  }
  return i;
}

}  // namespace

Components connected_components(std::span<const uint8_t> mask, int width, int height, uint8_t value,
                                Connectivity connectivity) {
  // Rows are cut into runs of equal value; a run joins those of the row above that it touches. Parts are numbered
  // by their first run, as the smaller root wins.
  struct Run {
    int begin, end;  // columns, end excluded
    int row;
  };
  std::vector<Run> runs;
  std::vector<int32_t> parent;
  const int touch = connectivity == Connectivity::eight ? 1 : 0;
  size_t above_begin = 0, above_end = 0;
  for (int y = 0; y < height; ++y) {
    const uint8_t* row = mask.data() + static_cast<size_t>(y) * static_cast<size_t>(width);
    const size_t row_begin = runs.size();
    size_t above = above_begin;
    for (int x = 0; x < width;) {
      if (row[x] != value) {
        ++x;
        continue;
      }
      const int begin = x;
      while (x < width && row[x] == value) ++x;
      const auto number = static_cast<int32_t>(runs.size());
      runs.push_back({begin, x, y});
      parent.push_back(number);
      while (above < above_end && runs[above].end + touch <= begin) ++above;
      for (size_t j = above; j < above_end && runs[j].begin < x + touch; ++j) {
        const int32_t a = root_of(parent, static_cast<int32_t>(j));
        const int32_t b = root_of(parent, number);
        parent[std::max(a, b)] = std::min(a, b);
      }
    }
    above_begin = row_begin;
    above_end = runs.size();
  }
  Components parts;
  parts.label.assign(mask.size(), -1);
  std::vector<int32_t> number_of(runs.size(), -1);
  for (size_t i = 0; i < runs.size(); ++i) {
    const int32_t root = root_of(parent, static_cast<int32_t>(i));
    if (number_of[root] < 0) {
      number_of[root] = static_cast<int32_t>(parts.areas.size());
      parts.areas.push_back(0);
    }
    const Run& run = runs[i];
    int32_t* label = parts.label.data() + static_cast<size_t>(run.row) * static_cast<size_t>(width);
    std::fill(label + run.begin, label + run.end, number_of[root]);
    parts.areas[number_of[root]] += static_cast<size_t>(run.end - run.begin);
  }
  return parts;
}

}  // namespace booth::segmentation
