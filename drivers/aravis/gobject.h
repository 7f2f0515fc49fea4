#pragma once

#include <arv.h>

#include <memory>
#include <string>

#include "pipeline/types/result.h"

namespace booth {

/// Owns one reference.
struct GObjectUnref {
  void operator()(gpointer object) const { g_object_unref(object); }
};
template <class Object>
using GObjectPtr = std::unique_ptr<Object, GObjectUnref>;

/// Takes the GError that a call left behind.
class GErrorSlot {
 public:
  GErrorSlot() = default;
  ~GErrorSlot() { g_clear_error(&error_); }
  GErrorSlot(const GErrorSlot&) = delete;
  GErrorSlot& operator=(const GErrorSlot&) = delete;

  GError** out() {
    g_clear_error(&error_);
    return &error_;
  }
  explicit operator bool() const { return error_ != nullptr; }
  std::string message() const { return error_ != nullptr ? error_->message : ""; }
  /// Whether the camera did not answer, rather than refuse.
  bool is_loss() const {
    return error_ != nullptr && error_->domain == ARV_DEVICE_ERROR &&
           (error_->code == ARV_DEVICE_ERROR_TIMEOUT || error_->code == ARV_DEVICE_ERROR_TRANSFER_ERROR ||
            error_->code == ARV_DEVICE_ERROR_NOT_CONNECTED || error_->code == ARV_DEVICE_ERROR_NOT_CONTROLLER ||
            error_->code == ARV_DEVICE_ERROR_PROTOCOL_ERROR_ACCESS_DENIED);
  }

 private:
  GError* error_ = nullptr;
};

}  // namespace booth
