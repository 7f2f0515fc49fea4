#include "drivers/v4l2/video_device.h"

#include <linux/videodev2.h>
#include <poll.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>
#include <sstream>
#include <utility>

#include "drivers/v4l2/video_controls.h"
#include "drivers/v4l2/video_error.h"

namespace booth {
namespace {

/// In the order in which an automatic choice prefers them: MJPG lets several cameras share a USB controller.
constexpr std::array<std::pair<V4l2Format, uint32_t>, 7> pixel_formats{{{V4l2Format::mjpg, V4L2_PIX_FMT_MJPEG},
                                                                        {V4l2Format::yuyv, V4L2_PIX_FMT_YUYV},
                                                                        {V4l2Format::bayer_rggb, V4L2_PIX_FMT_SRGGB8},
                                                                        {V4l2Format::bayer_grbg, V4L2_PIX_FMT_SGRBG8},
                                                                        {V4l2Format::bayer_gbrg, V4L2_PIX_FMT_SGBRG8},
                                                                        {V4l2Format::bayer_bggr, V4L2_PIX_FMT_SBGGR8},
                                                                        {V4l2Format::grey, V4L2_PIX_FMT_GREY}}};

uint32_t fourcc(V4l2Format format) {
  for (const auto& [known, code] : pixel_formats)
    if (known == format) return code;
  return 0;
}

template <class T>
T cleared() {
  T value;
  std::memset(&value, 0, sizeof value);
  return value;
}

/// A device that lists without end is broken.
constexpr uint32_t most_listed = 256;

/// Sizes that a format comes in; a single one where min and max agree.
struct SizeRange {
  int min_width = 0, max_width = 0, step_width = 1;
  int min_height = 0, max_height = 0, step_height = 1;

  bool offers(int width, int height) const {
    return width >= min_width && width <= max_width && (width - min_width) % step_width == 0 && height >= min_height &&
           height <= max_height && (height - min_height) % step_height == 0;
  }
};

std::vector<SizeRange> offered_sizes(VideoSystem& system, int fd, uint32_t code) {
  std::vector<SizeRange> sizes;
  for (uint32_t i = 0; i < most_listed; ++i) {
    auto size = cleared<v4l2_frmsizeenum>();
    size.index = i;
    size.pixel_format = code;
    if (system.control(fd, VIDIOC_ENUM_FRAMESIZES, &size) < 0) break;
    if (size.type == V4L2_FRMSIZE_TYPE_DISCRETE) {
      const int width = static_cast<int>(size.discrete.width), height = static_cast<int>(size.discrete.height);
      sizes.push_back({width, width, 1, height, height, 1});
      continue;
    }
    const v4l2_frmsize_stepwise& range = size.stepwise;
    sizes.push_back({static_cast<int>(range.min_width), static_cast<int>(range.max_width),
                     std::max(1, static_cast<int>(range.step_width)), static_cast<int>(range.min_height),
                     static_cast<int>(range.max_height), std::max(1, static_cast<int>(range.step_height))});
    break;
  }
  return sizes;
}

double rate_of(const v4l2_fract& interval) {
  return interval.numerator == 0 ? 0 : static_cast<double>(interval.denominator) / interval.numerator;
}

/// Frame rates of a size, frames a second. A camera that takes any rate in a range lists its ends.
struct Rates {
  std::vector<double> listed;
  bool continuous = false;

  /// Rates are compared as finely as drivers round them.
  static bool same(double a, double b) { return std::abs(a - b) <= 0.01 * std::max(a, b); }
  bool offers(double fps) const {
    if (listed.empty()) return false;
    if (continuous)
      return fps >= *std::min_element(listed.begin(), listed.end()) &&
             fps <= *std::max_element(listed.begin(), listed.end());
    return std::any_of(listed.begin(), listed.end(), [&](double rate) { return same(rate, fps); });
  }
};

Rates offered_rates(VideoSystem& system, int fd, uint32_t code, int width, int height) {
  Rates rates;
  for (uint32_t i = 0; i < most_listed; ++i) {
    auto interval = cleared<v4l2_frmivalenum>();
    interval.index = i;
    interval.pixel_format = code;
    interval.width = static_cast<uint32_t>(width);
    interval.height = static_cast<uint32_t>(height);
    if (system.control(fd, VIDIOC_ENUM_FRAMEINTERVALS, &interval) < 0) break;
    if (interval.type == V4L2_FRMIVAL_TYPE_DISCRETE) {
      rates.listed.push_back(rate_of(interval.discrete));
      continue;
    }
    rates.continuous = true;
    rates.listed = {rate_of(interval.stepwise.max), rate_of(interval.stepwise.min)};
    break;
  }
  return rates;
}

/// One format in one size (of a range: the largest) as the camera offers it.
struct Offer {
  V4l2Format format = V4l2Format::automatic;
  SizeRange sizes;
  Rates rates;
};

std::string describe(const std::vector<Offer>& offers) {
  constexpr size_t most = 24;
  std::ostringstream text;
  for (size_t i = 0; i < offers.size() && i < most; ++i) {
    const Offer& offer = offers[i];
    text << (i == 0 ? "" : ", ") << to_string(offer.format) << " ";
    if (offer.sizes.min_width != offer.sizes.max_width || offer.sizes.min_height != offer.sizes.max_height)
      text << offer.sizes.min_width << "x" << offer.sizes.min_height << " … ";
    text << offer.sizes.max_width << "x" << offer.sizes.max_height;
    for (size_t j = 0; j < offer.rates.listed.size(); ++j)
      text << (j == 0 ? " at " : offer.rates.continuous ? " … " : "/") << std::round(offer.rates.listed[j] * 100) / 100;
  }
  if (offers.size() > most) text << " and more";
  return text.str();
}

std::string describe(const V4l2CameraSettings& settings) {
  std::ostringstream text;
  if (settings.format != V4l2Format::automatic) text << "format " << to_string(settings.format) << " ";
  if (settings.width != 0) text << "size " << settings.width << "x" << settings.height << " ";
  if (settings.fps != 0) text << "fps " << settings.fps << " ";
  return text.str();
}

Result<VideoNode> identify(VideoSystem& system, int fd, const std::string& node) {
  auto capability = cleared<v4l2_capability>();
  if (const int result = system.control(fd, VIDIOC_QUERYCAP, &capability); result < 0)
    return system_error(node, "cannot be asked what it is", -result);
  const auto text = [](const auto& field) {
    return std::string(reinterpret_cast<const char*>(field),
                       strnlen(reinterpret_cast<const char*>(field), sizeof field));
  };
  // `capabilities` speaks of the whole device, all its nodes together; this node's own are in device_caps.
  const uint32_t node_can =
      capability.capabilities & V4L2_CAP_DEVICE_CAPS ? capability.device_caps : capability.capabilities;
  return VideoNode{node, text(capability.card), text(capability.bus_info),
                   (node_can & V4L2_CAP_VIDEO_CAPTURE) != 0 && (node_can & V4L2_CAP_STREAMING) != 0};
}

}  // namespace

Result<VideoNode> identify(VideoSystem& system, const std::string& node) {
  const int fd = system.open(node);
  if (fd < 0) return system_error(node, "cannot be opened", -fd);
  auto identified = identify(system, fd, node);
  system.close(fd);
  return identified;
}

Result<std::unique_ptr<VideoDevice>> VideoDevice::open(std::shared_ptr<VideoSystem> system, const std::string& node,
                                                       const V4l2CameraSettings& settings) {
  const int fd = system->open(node);
  if (fd < 0) return system_error(settings.id, node + " cannot be opened", -fd);
  std::unique_ptr<VideoDevice> device(new VideoDevice(std::move(system), fd, settings.id));
  const auto identified = identify(*device->system_, fd, node);
  if (!identified) return identified.error();
  if (!identified->captures)
    return Error{ErrorCode::unsupported, settings.id + ": " + node + " is not a camera's picture stream"};
  if (const auto negotiated = device->negotiate(settings); !negotiated) return negotiated.error();
  return device;
}

VideoDevice::~VideoDevice() {
  stop();
  system_->close(fd_);
}

Result<void> VideoDevice::check_presence() const {
  // Nothing is polled for but the hang-up, which always counts: who polls for input before a stream has begun may start
  // the kernel's emulation of read(2), which then owns the buffers.
  pollfd poll_fd{fd_, 0, 0};
  if (::poll(&poll_fd, 1, 0) > 0 && (poll_fd.revents & (POLLHUP | POLLNVAL)) != 0)
    return Error{ErrorCode::device_lost, name_ + ": was unplugged"};
  return {};
}

Result<void> VideoDevice::negotiate(const V4l2CameraSettings& settings) {
  std::vector<uint32_t> codes;
  for (uint32_t i = 0; i < most_listed; ++i) {
    auto description = cleared<v4l2_fmtdesc>();
    description.index = i;
    description.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
    if (ioctl(VIDIOC_ENUM_FMT, &description) < 0) break;
    codes.push_back(description.pixelformat);
  }
  std::vector<Offer> offers;
  for (const auto& [format, code] : pixel_formats) {
    if (std::find(codes.begin(), codes.end(), code) == codes.end()) continue;
    for (const SizeRange& sizes : offered_sizes(*system_, fd_, code))
      offers.push_back({format, sizes, offered_rates(*system_, fd_, code, sizes.max_width, sizes.max_height)});
  }
  if (offers.empty())
    return Error{ErrorCode::unsupported,
                 name_ + ": the camera offers none of the formats mjpg, yuyv, grey and 8-bit Bayer"};

  const auto meets = [&](const Offer& offer) {
    if (settings.format != V4l2Format::automatic && offer.format != settings.format) return false;
    if (settings.width != 0 && !offer.sizes.offers(settings.width, settings.height)) return false;
    return settings.fps == 0 || offer.rates.listed.empty() || offer.rates.offers(settings.fps);
  };
  const auto area = [](const Offer& offer) { return int64_t{offer.sizes.max_width} * offer.sizes.max_height; };
  const Offer* best = nullptr;
  for (const Offer& offer : offers)
    if (meets(offer) && (best == nullptr || (offer.format == best->format && area(offer) > area(*best)))) best = &offer;
  if (best == nullptr)
    return Error{ErrorCode::invalid_argument,
                 name_ + ": " + describe(settings) + "is not possible; this camera offers " + describe(offers)};
  const int width = settings.width != 0 ? settings.width : best->sizes.max_width;
  const int height = settings.height != 0 ? settings.height : best->sizes.max_height;
  double fps = settings.fps;
  if (fps == 0 && !best->rates.listed.empty())
    fps = *std::max_element(best->rates.listed.begin(), best->rates.listed.end());
  return set_mode(settings, best->format, width, height, fps);
}

Result<void> VideoDevice::set_mode(const V4l2CameraSettings& settings, V4l2Format format, int width, int height,
                                   double fps) {
  auto wanted = cleared<v4l2_format>();
  wanted.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  wanted.fmt.pix.width = static_cast<uint32_t>(width);
  wanted.fmt.pix.height = static_cast<uint32_t>(height);
  wanted.fmt.pix.pixelformat = fourcc(format);
  wanted.fmt.pix.field = V4L2_FIELD_NONE;
  if (const int result = ioctl(VIDIOC_S_FMT, &wanted); result < 0)
    return system_error(name_, "its format cannot be set", -result);
  const v4l2_pix_format& got = wanted.fmt.pix;
  if (got.pixelformat != fourcc(format) || got.width != static_cast<uint32_t>(width) ||
      got.height != static_cast<uint32_t>(height)) {
    std::ostringstream message;
    message << name_ << ": " << to_string(format) << " " << width << "x" << height
            << " was asked for and is offered, but the camera set itself to " << got.width << "x" << got.height;
    return Error{ErrorCode::invalid_argument, message.str()};
  }
  mode_ = {.format = format, .width = width, .height = height, .bytes_per_line = got.bytesperline, .fps = fps};
  if (format == V4l2Format::yuyv) {
    const uint32_t least = static_cast<uint32_t>(width) * 2;
    mode_.bytes_per_line = std::max(mode_.bytes_per_line, least);
    const uint32_t encoding = got.ycbcr_enc == V4L2_YCBCR_ENC_DEFAULT
                                  ? static_cast<uint32_t>(V4L2_MAP_YCBCR_ENC_DEFAULT(got.colorspace))
                                  : got.ycbcr_enc;
    mode_.encoding.bt709 = encoding == V4L2_YCBCR_ENC_709;
    const uint32_t quantization =
        got.quantization == V4L2_QUANTIZATION_DEFAULT
            ? static_cast<uint32_t>(V4L2_MAP_QUANTIZATION_DEFAULT(false, got.colorspace, encoding))
            : got.quantization;
    mode_.encoding.full_range = quantization == V4L2_QUANTIZATION_FULL_RANGE;
    if (width % 2 != 0) return Error{ErrorCode::unsupported, name_ + ": yuyv pictures of an odd width cannot be read"};
  } else if (format != V4l2Format::mjpg) {
    mode_.bytes_per_line = std::max(mode_.bytes_per_line, static_cast<uint32_t>(width));
  }

  if (fps == 0) return {};
  auto parameters = cleared<v4l2_streamparm>();
  parameters.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  // A thousandth of a frame a second is finer than any camera's steps.
  parameters.parm.capture.timeperframe = {1000, static_cast<uint32_t>(std::lround(fps * 1000))};
  const int result = ioctl(VIDIOC_S_PARM, &parameters);
  const double got_fps = result < 0 ? 0 : rate_of(parameters.parm.capture.timeperframe);
  if (is_gone(-result)) return system_error(name_, "its frame rate cannot be set", -result);
  if (settings.fps != 0 && !Rates::same(got_fps, settings.fps)) {
    std::ostringstream message;
    message << name_ << ": fps " << settings.fps << " is not possible";
    if (got_fps > 0) message << "; this camera would take " << got_fps;
    return Error{ErrorCode::invalid_argument, message.str()};
  }
  if (got_fps > 0) mode_.fps = got_fps;
  return {};
}

Result<void> VideoDevice::apply_controls(const V4l2CameraSettings& settings, const std::optional<int>& exposure_us) {
  VideoControls controls(*system_, fd_, name_);
  return controls.apply(settings, exposure_us);
}

std::optional<int> VideoDevice::exposure_us() const { return VideoControls(*system_, fd_, name_).exposure_us(); }

Result<void> VideoDevice::map_buffers(int buffers) {
  auto request = cleared<v4l2_requestbuffers>();
  request.count = static_cast<uint32_t>(buffers);
  request.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  request.memory = V4L2_MEMORY_MMAP;
  if (const int result = ioctl(VIDIOC_REQBUFS, &request); result < 0)
    return system_error(name_, "lends no buffers", -result);
  // One that the device fills and one that is read.
  if (request.count < 2)
    return Error{ErrorCode::io,
                 name_ + ": the kernel has memory for " + std::to_string(request.count) + " buffers only"};
  for (uint32_t i = 0; i < request.count; ++i) {
    auto buffer = cleared<v4l2_buffer>();
    buffer.index = i;
    buffer.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
    buffer.memory = V4L2_MEMORY_MMAP;
    if (const int result = ioctl(VIDIOC_QUERYBUF, &buffer); result < 0)
      return system_error(name_, "does not tell of its buffers", -result);
    if ((buffer.flags & V4L2_BUF_FLAG_TIMESTAMP_MASK) != V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC)
      return Error{
          ErrorCode::unsupported,
          name_ + ": its driver does not stamp frames with the monotonic clock, so that their time is unknown"};
    const uint8_t* memory = system_->map(fd_, buffer.length, buffer.m.offset);
    if (memory == nullptr) return Error{ErrorCode::io, name_ + ": its buffers cannot be mapped"};
    mappings_.push_back({memory, buffer.length});
    if (const int result = ioctl(VIDIOC_QBUF, &buffer); result < 0)
      return system_error(name_, "takes no buffers", -result);
  }
  return {};
}

Result<void> VideoDevice::start(int buffers) {
  if (auto mapped = map_buffers(buffers); !mapped) {
    stop();
    return mapped;
  }
  int type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  const int result = ioctl(VIDIOC_STREAMON, &type);
  if (result == 0) return {};
  stop();
  if (result == -ENOSPC)
    return Error{ErrorCode::io, name_ +
                                    ": not enough USB bandwidth is left on its controller: use mjpg, a lower rate or "
                                    "size, or plug it into another controller"};
  return system_error(name_, "does not begin to stream", -result);
}

void VideoDevice::stop() noexcept {
  if (mappings_.empty()) return;
  // A lost device refuses both, which changes nothing: the memory is freed with the descriptor.
  int type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  ioctl(VIDIOC_STREAMOFF, &type);
  for (const Mapping& mapping : mappings_) system_->unmap(mapping.memory, mapping.length);
  mappings_.clear();
  auto none = cleared<v4l2_requestbuffers>();
  none.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  none.memory = V4L2_MEMORY_MMAP;
  ioctl(VIDIOC_REQBUFS, &none);
}

Result<std::optional<FilledBuffer>> VideoDevice::dequeue() {
  auto buffer = cleared<v4l2_buffer>();
  buffer.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  buffer.memory = V4L2_MEMORY_MMAP;
  const int result = ioctl(VIDIOC_DQBUF, &buffer);
  if (result == -EAGAIN) return std::optional<FilledBuffer>();
  if (result == -ENODEV) return Error{ErrorCode::device_lost, name_ + ": was unplugged"};
  if (result < 0) return Error{ErrorCode::device_lost, name_ + ": its stream broke off: " + std::strerror(-result)};
  if (buffer.index >= mappings_.size())
    return Error{ErrorCode::device_lost, name_ + ": its driver delivers buffers that it never got"};
  const Mapping& mapping = mappings_[buffer.index];
  return std::optional<FilledBuffer>(
      {.index = buffer.index,
       .sequence = buffer.sequence,
       .timestamp_ns = seconds(buffer.timestamp.tv_sec) + int64_t{buffer.timestamp.tv_usec} * 1000,
       .stamped_at_end = (buffer.flags & V4L2_BUF_FLAG_TSTAMP_SRC_MASK) == V4L2_BUF_FLAG_TSTAMP_SRC_EOF,
       .error = (buffer.flags & V4L2_BUF_FLAG_ERROR) != 0,
       .bytes = {mapping.memory, std::min<size_t>(buffer.bytesused, mapping.length)}});
}

Result<void> VideoDevice::enqueue(const FilledBuffer& filled) {
  auto buffer = cleared<v4l2_buffer>();
  buffer.index = filled.index;
  buffer.type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  buffer.memory = V4L2_MEMORY_MMAP;
  const int result = ioctl(VIDIOC_QBUF, &buffer);
  if (result < 0) return Error{ErrorCode::device_lost, name_ + ": its stream broke off: " + std::strerror(-result)};
  return {};
}

}  // namespace booth
