#include "pipeline/segmentation/components.h"

#include <algorithm>
#include <cstring>

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

Components connected_components(std::span<const uint8_t> values, int width, int height, uint8_t low, uint8_t high,
                                Connectivity connectivity) {
  // A run joins those of the row above that it touches. The smaller root wins, so that roots are first runs.
  Components parts;
  std::vector<Components::Run>& runs = parts.runs;
  std::vector<int32_t> parent;
  const int touch = connectivity == Connectivity::eight ? 1 : 0;
  // 1 where a value is within the range, and something else behind the row's end.
  std::vector<uint8_t> within(static_cast<size_t>(width) + 1, 2);
  const auto end_of_stretch = [&within, width](int x) {
    const uint8_t value = within[x];
    // Masks are the same for long stretches: those are passed eight at a time.
    constexpr int at_once = sizeof(uint64_t);
    const uint64_t same = value * uint64_t{0x0101010101010101};
    for (uint64_t eight = same; x + at_once <= width; x += at_once) {
      std::memcpy(&eight, within.data() + x, at_once);
      if (eight != same) break;
    }
    while (within[x] == value) ++x;
    return x;
  };
  size_t above_begin = 0, above_end = 0;
  for (int y = 0; y < height; ++y) {
    const uint8_t* row = values.data() + static_cast<size_t>(y) * static_cast<size_t>(width);
    const size_t row_begin = runs.size();
    size_t above = above_begin;
    for (int x = 0; x < width; ++x) within[x] = row[x] >= low && row[x] <= high ? 1 : 0;
    for (int x = 0; x < width;) {
      const int begin = within[x] == 1 ? x : end_of_stretch(x);
      if (begin == width) break;
      x = end_of_stretch(begin);
      const auto number = static_cast<int32_t>(runs.size());
      runs.push_back({y, begin, x, 0});
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
  std::vector<int32_t> number_of(runs.size(), -1);
  for (size_t i = 0; i < runs.size(); ++i) {
    const int32_t root = root_of(parent, static_cast<int32_t>(i));
    if (number_of[root] < 0) {
      number_of[root] = static_cast<int32_t>(parts.areas.size());
      parts.areas.push_back(0);
    }
    runs[i].part = number_of[root];
    parts.areas[runs[i].part] += static_cast<size_t>(runs[i].end - runs[i].begin);
  }
  return parts;
}

}  // namespace booth::segmentation
