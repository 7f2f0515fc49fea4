#include "tests/quality/panels.h"

#include <algorithm>
#include <fstream>
#include <stdexcept>

#include "pipeline/image/codec.h"

namespace booth::quality {

Image part_of(const Image& picture, const Window& window) {
  if (window.left < 0 || window.top < 0 || window.width < 1 || window.height < 1 ||
      window.left + window.width > picture.width || window.top + window.height > picture.height)
    throw std::runtime_error("the part does not lie in the photograph");
  Image part(window.width, window.height, 3);
  for (int y = 0; y < part.height; ++y)
    std::copy_n(picture.pixel(window.left, window.top + y), 3 * part.width, part.pixel(0, y));
  return part;
}

Image in_rows(const std::vector<std::vector<Image>>& rows) {
  constexpr int gap = 6;
  const int width = rows[0][0].width, height = rows[0][0].height;
  const int across = static_cast<int>(rows[0].size()), down = static_cast<int>(rows.size());
  Image all(across * (width + gap) - gap, down * (height + gap) - gap, 3, uint8_t{255});
  for (int row = 0; row < down; ++row)
    for (int column = 0; column < across; ++column)
      for (int y = 0; y < height; ++y)
        std::copy_n(rows[static_cast<size_t>(row)][static_cast<size_t>(column)].pixel(0, y), 3 * width,
                    all.pixel(column * (width + gap), row * (height + gap) + y));
  return all;
}

void write_jpeg(const Image& picture, const std::filesystem::path& file) {
  constexpr int quality = 85;
  const std::vector<uint8_t> bytes = encode_jpeg(picture, quality);
  std::ofstream out(file, std::ios::binary);
  out.write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size())).flush();
  if (!out) throw std::runtime_error(file.string() + " cannot be written");
}

}  // namespace booth::quality
