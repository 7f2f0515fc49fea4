#pragma once

#include <arv.h>

#include <cstddef>
#include <memory>
#include <mutex>

#include "pipeline/types/image.h"

namespace booth {

/// The memory that a stream receives frames in: images whose samples Aravis writes to directly. An image that is lent
/// goes back to the stream when the last reference to it dies, in whatever thread and however late; after close() it is
/// freed instead.
class BufferPool : public std::enable_shared_from_this<BufferPool> {
 public:
  /// @param stream   outlives the pool, or its close()
  /// @param payload  bytes of a frame as the camera sends it, at least width × height × channels
  BufferPool(ArvStream* stream, size_t payload, int width, int height, int channels);
  ~BufferPool();
  BufferPool(const BufferPool&) = delete;
  BufferPool& operator=(const BufferPool&) = delete;

  /// Gives the stream more memory, until there is room for that many frames in all.
  void grow_to(size_t frames);
  size_t frames() const { return frames_; }

  /// The image in a buffer that the stream filled. The pool has the buffer from now on.
  std::shared_ptr<const Image> lend(ArvBuffer* buffer);
  /// A buffer whose content nobody wants.
  void give_back(ArvBuffer* buffer);
  /// From now on the stream is not touched.
  void close();

 private:
  std::mutex mutex_;
  ArvStream* stream_;  ///< guarded by mutex_; null once closed
  const size_t payload_;
  const int width_, height_, channels_;
  size_t frames_ = 0;
};

}  // namespace booth
