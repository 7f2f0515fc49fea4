#pragma once

#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <variant>

namespace booth {

/// What went wrong, as a stable word that programs branch on. What happened in detail is in
/// Error::message, a sentence an operator can act on.
enum class ErrorCode {
  invalid_argument,  ///< a value outside its documented range
  invalid_file,      ///< a file that exists but does not hold what it should
  not_found,         ///< a file, device, job or avatar that is not there
  io,                ///< the operating system refused a read or a write
  disk_full,         ///< no room for what must be stored
  no_background,     ///< no background to segment against
  no_subject,        ///< nobody in the images
  too_few_views,     ///< fewer usable cameras than the method needs
  not_riggable,      ///< the shape holds no recognisable skeleton
  timeout,           ///< a device did not deliver in time
  device_lost,       ///< a device is gone
  cancelled,         ///< somebody asked to stop
  busy,              ///< something exclusive is under way
  invalid_state,     ///< asked for at the wrong moment
  unsupported,       ///< not offered by this build or this rig
  not_calibrated,    ///< the booth has no rig
  not_ready,         ///< the booth cannot do that now, for reasons that the message names
  internal           ///< a bug
};

/// The code's name, as it is written in logs and in metadata ("no_subject").
std::string_view to_string(ErrorCode code);

struct Error {
  ErrorCode code = ErrorCode::internal;
  std::string message;
};

/// A value or the reason why there is none. What can go wrong in a healthy program (device, file,
/// message, operator, unusable images) is returned like this; a bug throws instead.
template <class T>
class [[nodiscard]] Result {
 public:
  Result(T value) : content_(std::in_place_index<0>, std::move(value)) {}
  Result(Error error) : content_(std::in_place_index<1>, std::move(error)) {}

  bool ok() const { return content_.index() == 0; }
  explicit operator bool() const { return ok(); }

  /// The value. Asking a failed result for it is a bug and throws std::logic_error with its message.
  T& value() & { return checked(), *std::get_if<0>(&content_); }
  const T& value() const& { return checked(), *std::get_if<0>(&content_); }
  T&& value() && { return checked(), std::move(*std::get_if<0>(&content_)); }
  T& operator*() & { return value(); }
  const T& operator*() const& { return value(); }
  T&& operator*() && { return std::move(*this).value(); }
  T* operator->() { return &value(); }
  const T* operator->() const { return &value(); }

  /// The error. Asking a successful result for it is a bug and throws std::logic_error.
  const Error& error() const {
    if (ok()) throw std::logic_error("error() of a successful result");
    return *std::get_if<1>(&content_);
  }

 private:
  void checked() const {
    if (!ok()) throw std::logic_error("value() of a failed result: " + std::get_if<1>(&content_)->message);
  }
  std::variant<T, Error> content_;
};

/// Success without a value, or the reason for failure.
template <>
class [[nodiscard]] Result<void> {
 public:
  Result() = default;
  Result(Error error) : error_(std::move(error)) {}

  bool ok() const { return !error_.has_value(); }
  explicit operator bool() const { return ok(); }
  const Error& error() const {
    if (ok()) throw std::logic_error("error() of a successful result");
    return *error_;
  }

 private:
  std::optional<Error> error_;
};

}  // namespace booth
