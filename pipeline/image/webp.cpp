#include "pipeline/image/webp.h"

#include <webp/encode.h>
#include <webp/mux.h>

#include <cmath>
#include <memory>
#include <new>
#include <stdexcept>
#include <string>

namespace booth {
namespace {

struct DeleteEncoder {
  void operator()(WebPAnimEncoder* encoder) const { WebPAnimEncoderDelete(encoder); }
};

/// The library's picture, freed at the end.
struct Picture {
  WebPPicture value;

  explicit Picture(const Image& image) {
    if (WebPPictureInit(&value) == 0) throw std::runtime_error("webp: another version of the library");
    value.use_argb = 1;
    value.width = image.width;
    value.height = image.height;
    if (WebPPictureImportRGBA(&value, image.samples.data(), image.width * image.channels) == 0) throw std::bad_alloc();
  }
  ~Picture() { WebPPictureFree(&value); }
  Picture(const Picture&) = delete;
  Picture& operator=(const Picture&) = delete;
};

}  // namespace

std::vector<uint8_t> encode_webp_animation(std::span<const Image> frames, double frame_s, int quality) {
  constexpr double shortest_s = 0.01;
  if (frames.empty() || !(frame_s >= shortest_s)) throw std::invalid_argument("webp: no frames, or too short ones");
  for (const Image& frame : frames)
    if (frame.channels != 4 || frame.empty() || frame.width != frames[0].width || frame.height != frames[0].height)
      throw std::invalid_argument("webp: frames have to be RGBA of one size");
  WebPAnimEncoderOptions options;
  WebPConfig config;
  if (WebPAnimEncoderOptionsInit(&options) == 0 || WebPConfigInit(&config) == 0)
    throw std::runtime_error("webp: another version of the library");
  // Every frame by itself, without search for what it shares with the one before: a figure that turns shares little.
  options.kmin = 0;
  options.kmax = 1;
  config.quality = static_cast<float>(quality);
  config.method = 1;
  config.alpha_quality = 100;
  const std::unique_ptr<WebPAnimEncoder, DeleteEncoder> encoder(
      WebPAnimEncoderNew(frames[0].width, frames[0].height, &options));
  if (!encoder) throw std::bad_alloc();
  const auto require = [&](int done) {
    if (done == 0) throw std::runtime_error(std::string("webp: ") + WebPAnimEncoderGetError(encoder.get()));
  };
  constexpr double ms_per_s = 1000;
  const auto time_ms = [&](size_t frame) {
    return static_cast<int>(std::lround(ms_per_s * frame_s * static_cast<double>(frame)));
  };
  for (size_t i = 0; i < frames.size(); ++i) {
    Picture picture(frames[i]);
    require(WebPAnimEncoderAdd(encoder.get(), &picture.value, time_ms(i), &config));
  }
  require(WebPAnimEncoderAdd(encoder.get(), nullptr, time_ms(frames.size()), nullptr));
  WebPData data;
  WebPDataInit(&data);
  require(WebPAnimEncoderAssemble(encoder.get(), &data));
  std::vector<uint8_t> bytes(data.bytes, data.bytes + data.size);
  WebPDataClear(&data);
  return bytes;
}

}  // namespace booth
