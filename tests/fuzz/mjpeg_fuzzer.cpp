#include <cstdlib>

#include "drivers/v4l2/mjpeg.h"
#include "pipeline/image/codec.h"

/// What a USB camera delivers as a JPEG: a whole one lies within the bytes, is found again when the padding is gone,
/// and is decoded as its header says, or refused.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const auto length = booth::whole_jpeg({data, size});
  if (!length) return 0;
  if (*length > size || booth::whole_jpeg({data, *length}) != length) std::abort();
  const auto header = booth::read_image_header({data, *length});
  constexpr int largest_side = 2048;
  if (!header || header->width > largest_side || header->height > largest_side) return 0;
  const auto image = booth::decode_image({data, *length});
  if (image && (image->width != header->width || image->height != header->height)) std::abort();
  return 0;
}
