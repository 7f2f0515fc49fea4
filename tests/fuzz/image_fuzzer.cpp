#include <cstdlib>

#include "pipeline/image/codec.h"

/// An image is as large as its header says. Large ones are left alone: they only cost time.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const auto header = booth::read_image_header({data, size});
  constexpr int largest_side = 2048;
  if (!header || header->width > largest_side || header->height > largest_side) return 0;
  const auto image = booth::decode_image({data, size});
  if (!image) return 0;
  if (image->width != header->width || image->height != header->height || image->channels != header->channels)
    std::abort();
  return 0;
}
