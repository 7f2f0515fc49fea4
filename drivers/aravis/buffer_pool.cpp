#include "drivers/aravis/buffer_pool.h"

#include <stdexcept>

namespace booth {

BufferPool::BufferPool(ArvStream* stream, size_t payload, int width, int height, int channels)
    : stream_(stream), payload_(payload), width_(width), height_(height), channels_(channels) {
  if (payload < static_cast<size_t>(width) * static_cast<size_t>(height) * static_cast<size_t>(channels))
    throw std::logic_error("a payload smaller than its image");
}

BufferPool::~BufferPool() { close(); }

void BufferPool::grow_to(size_t frames) {
  const std::lock_guard lock(mutex_);
  for (; stream_ != nullptr && frames_ < frames; ++frames_) {
    auto image = std::make_unique<Image>();
    image->width = width_;
    image->height = height_;
    image->channels = channels_;
    // Room for all that the camera sends, every page touched; what is beyond the picture is not part of it.
    image->samples.resize(payload_);
    image->samples.resize(static_cast<size_t>(width_) * static_cast<size_t>(height_) * static_cast<size_t>(channels_));
    uint8_t* const memory = image->samples.data();
    ArvBuffer* const buffer = arv_buffer_new_full(payload_, memory, image.release(),
                                                  [](gpointer owned) { delete static_cast<Image*>(owned); });
    arv_stream_push_buffer(stream_, buffer);
  }
}

std::shared_ptr<const Image> BufferPool::lend(ArvBuffer* buffer) {
  const auto* image = static_cast<const Image*>(arv_buffer_get_user_data(buffer));
  return {image, [pool = shared_from_this(), buffer](const Image*) { pool->give_back(buffer); }};
}

void BufferPool::give_back(ArvBuffer* buffer) {
  {
    const std::lock_guard lock(mutex_);
    if (stream_ != nullptr) return arv_stream_push_buffer(stream_, buffer);
  }
  g_object_unref(buffer);
}

void BufferPool::close() {
  const std::lock_guard lock(mutex_);
  stream_ = nullptr;
}

}  // namespace booth
