#include "tests/drivers/simulated_video.h"

#include <linux/videodev2.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <deque>
#include <utility>

namespace booth {
namespace {

constexpr size_t page = 4096;

}  // namespace

struct SimulatedVideo::Device {
  SimulatedNode node;
  bool present = true;
  bool streaming = false;
  bool broken = false;
  int ready_fd = -1;  ///< the streaming handle's, one byte a filled buffer
  uint32_t fourcc = 0;
  uint32_t width = 0, height = 0;
  uint32_t sequence = 0;
  std::vector<std::vector<uint8_t>> buffers;
  std::deque<uint32_t> lent;
  std::deque<v4l2_buffer> filled;

  SimulatedControl* find(uint32_t id) {
    const auto found =
        std::find_if(node.controls.begin(), node.controls.end(), [&](const auto& control) { return control.id == id; });
    return found == node.controls.end() ? nullptr : &*found;
  }
  bool inactive(const SimulatedControl& control) {
    const SimulatedControl* governor = control.governed_by == 0 ? nullptr : find(control.governed_by);
    return governor != nullptr && governor->value != control.free_when;
  }
  uint32_t size_image() const {
    if (fourcc == V4L2_PIX_FMT_MJPEG) return width * height * 2;
    return width * height * (fourcc == V4L2_PIX_FMT_YUYV ? 2 : 1);
  }
  void stop() {
    streaming = false;
    lent.clear();
    filled.clear();
  }

  int query_control(v4l2_query_ext_ctrl& query) {
    const uint32_t wanted = query.id & V4L2_CTRL_ID_MASK;
    const bool next = (query.id & V4L2_CTRL_FLAG_NEXT_CTRL) != 0;
    const SimulatedControl* best = nullptr;
    for (const SimulatedControl& control : node.controls)
      if (next ? control.id > wanted && (best == nullptr || control.id < best->id) : control.id == wanted)
        best = &control;
    if (best == nullptr) return -EINVAL;
    query.id = best->id;
    query.type = best->type;
    query.minimum = best->minimum;
    query.maximum = best->maximum;
    query.step = static_cast<uint64_t>(best->step);
    query.flags = inactive(*best) ? V4L2_CTRL_FLAG_INACTIVE : 0;
    std::strncpy(query.name, best->name.c_str(), sizeof query.name - 1);
    return 0;
  }

  int set_control(const v4l2_ext_control& wanted) {
    SimulatedControl* control = find(wanted.id);
    if (control == nullptr) return -EINVAL;
    if (inactive(*control)) return -EACCES;
    control->value = control->sticks_at.value_or(wanted.value);
    return 0;
  }

  int set_format(v4l2_pix_format& pix) {
    if (!buffers.empty()) return -EBUSY;
    if (node.rounds_width_to != 0) pix.width = static_cast<uint32_t>(node.rounds_width_to);
    fourcc = pix.pixelformat;
    width = pix.width;
    height = pix.height;
    pix.bytesperline = fourcc == V4L2_PIX_FMT_MJPEG ? 0 : size_image() / height;
    pix.sizeimage = size_image();
    pix.colorspace = V4L2_COLORSPACE_SRGB;
    return 0;
  }

  int enumerate_format(v4l2_fmtdesc& description) const {
    std::vector<uint32_t> codes;
    for (const SimulatedSize& size : node.sizes)
      if (std::find(codes.begin(), codes.end(), size.fourcc) == codes.end()) codes.push_back(size.fourcc);
    if (description.index >= codes.size()) return -EINVAL;
    description.pixelformat = codes[description.index];
    return 0;
  }

  int enumerate_size(v4l2_frmsizeenum& wanted) const {
    uint32_t index = 0;
    for (const SimulatedSize& size : node.sizes) {
      if (size.fourcc != wanted.pixel_format || index++ != wanted.index) continue;
      wanted.type = V4L2_FRMSIZE_TYPE_DISCRETE;
      wanted.discrete = {static_cast<uint32_t>(size.width), static_cast<uint32_t>(size.height)};
      return 0;
    }
    return -EINVAL;
  }

  int enumerate_interval(v4l2_frmivalenum& wanted) const {
    for (const SimulatedSize& size : node.sizes) {
      if (size.fourcc != wanted.pixel_format || static_cast<uint32_t>(size.width) != wanted.width ||
          static_cast<uint32_t>(size.height) != wanted.height || wanted.index >= size.rates.size())
        continue;
      wanted.type = V4L2_FRMIVAL_TYPE_DISCRETE;
      wanted.discrete = {1, static_cast<uint32_t>(size.rates[wanted.index])};
      return 0;
    }
    return -EINVAL;
  }

  int request_buffers(v4l2_requestbuffers& request) {
    if (streaming) return -EBUSY;
    request.count = std::min(request.count, node.most_buffers);
    buffers.assign(request.count, std::vector<uint8_t>((size_image() / page + 1) * page));
    lent.clear();
    return 0;
  }

  uint32_t timestamp_flags() const {
    return node.monotonic ? V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC | V4L2_BUF_FLAG_TSTAMP_SRC_SOE
                          : V4L2_BUF_FLAG_TIMESTAMP_UNKNOWN;
  }
};

/// One open of a node.
struct SimulatedVideo::Handle {
  std::shared_ptr<Device> device;
  int ready_fd = -1;  ///< the other end of what the driver polls; closed when the device is gone

  Handle(std::shared_ptr<Device> device_, int ready) : device(std::move(device_)), ready_fd(ready) {}
  ~Handle() { hang_up(); }
  Handle(const Handle&) = delete;
  Handle& operator=(const Handle&) = delete;
  void hang_up() {
    if (ready_fd >= 0) ::close(std::exchange(ready_fd, -1));
  }
};

SimulatedVideo::~SimulatedVideo() = default;

std::shared_ptr<SimulatedVideo::Device> SimulatedVideo::find(const std::string& node) {
  const auto found = devices_.find(node);
  return found == devices_.end() ? nullptr : found->second;
}

void SimulatedVideo::plug_in(SimulatedNode node) {
  const std::lock_guard lock(mutex_);
  auto device = std::make_shared<Device>();
  device->node = std::move(node);
  devices_[device->node.node] = std::move(device);
}

void SimulatedVideo::unplug(const std::string& node) {
  const std::lock_guard lock(mutex_);
  const auto device = find(node);
  device->present = false;
  device->stop();
  for (const auto& [fd, handle] : handles_)
    if (handle->device == device) handle->hang_up();
  devices_.erase(node);
}

bool SimulatedVideo::send(const std::string& node, const std::vector<uint8_t>& bytes, int64_t timestamp_ns,
                          uint32_t flags) {
  const std::lock_guard lock(mutex_);
  const auto device = find(node);
  if (!device || !device->streaming) return false;
  const uint32_t sequence = device->sequence++;
  if (device->lent.empty()) return false;
  v4l2_buffer buffer;
  std::memset(&buffer, 0, sizeof buffer);
  buffer.index = device->lent.front();
  device->lent.pop_front();
  buffer.sequence = sequence;
  buffer.flags = flags | device->timestamp_flags();
  buffer.timestamp = {timestamp_ns / 1'000'000'000, timestamp_ns % 1'000'000'000 / 1000};
  auto& memory = device->buffers[buffer.index];
  buffer.bytesused = static_cast<uint32_t>(std::min(bytes.size(), memory.size()));
  std::copy_n(bytes.begin(), buffer.bytesused, memory.begin());
  device->filled.push_back(buffer);
  const char filled = 1;
  return ::write(device->ready_fd, &filled, 1) == 1;
}

void SimulatedVideo::break_stream(const std::string& node) {
  const std::lock_guard lock(mutex_);
  const auto device = find(node);
  device->broken = true;
  const char awake = 1;
  [[maybe_unused]] const auto written = ::write(device->ready_fd, &awake, 1);
}

bool SimulatedVideo::streams(const std::string& node) {
  const std::lock_guard lock(mutex_);
  const auto device = find(node);
  return device && device->streaming;
}

int64_t SimulatedVideo::control_value(const std::string& node, uint32_t id) {
  const std::lock_guard lock(mutex_);
  return find(node)->find(id)->value;
}

int SimulatedVideo::open_descriptors() {
  const std::lock_guard lock(mutex_);
  return static_cast<int>(handles_.size());
}

std::vector<std::string> SimulatedVideo::nodes() {
  const std::lock_guard lock(mutex_);
  std::vector<std::string> names;
  for (const auto& [name, device] : devices_) names.push_back(name);
  return names;
}

std::string SimulatedVideo::resolve(const std::string& path) {
  const std::lock_guard lock(mutex_);
  return devices_.contains(path) ? path : std::string();
}

std::string SimulatedVideo::serial(const std::string& node) {
  const std::lock_guard lock(mutex_);
  const auto device = find(node);
  return device ? device->node.serial : std::string();
}

int SimulatedVideo::open(const std::string& node) {
  const std::lock_guard lock(mutex_);
  const auto device = find(node);
  if (!device) return -ENOENT;
  int pair[2];
  if (::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, pair) != 0) return -errno;
  handles_[pair[0]] = std::make_shared<Handle>(device, pair[1]);
  return pair[0];
}

void SimulatedVideo::close(int fd) {
  const std::lock_guard lock(mutex_);
  handles_.erase(fd);
  ::close(fd);
}

int SimulatedVideo::control(int fd, unsigned long request, void* argument) {
  const std::lock_guard lock(mutex_);
  const Handle& handle = *handles_.at(fd);
  Device& device = *handle.device;
  if (!device.present) return -ENODEV;
  if (const auto error = device.node.errors.find(request); error != device.node.errors.end()) return -error->second;
  switch (request) {
    case VIDIOC_QUERYCAP: {
      auto& capability = *static_cast<v4l2_capability*>(argument);
      std::strcpy(reinterpret_cast<char*>(capability.card), "Simulated Camera");
      std::strcpy(reinterpret_cast<char*>(capability.bus_info), device.node.bus.c_str());
      capability.capabilities = device.node.capabilities;
      capability.device_caps = device.node.device_caps;
      return 0;
    }
    case VIDIOC_ENUM_FMT: return device.enumerate_format(*static_cast<v4l2_fmtdesc*>(argument));
    case VIDIOC_ENUM_FRAMESIZES: return device.enumerate_size(*static_cast<v4l2_frmsizeenum*>(argument));
    case VIDIOC_ENUM_FRAMEINTERVALS: return device.enumerate_interval(*static_cast<v4l2_frmivalenum*>(argument));
    case VIDIOC_S_FMT: return device.set_format(static_cast<v4l2_format*>(argument)->fmt.pix);
    case VIDIOC_S_PARM:
      if (device.node.keeps_rate != 0)
        static_cast<v4l2_streamparm*>(argument)->parm.capture.timeperframe = {
            1, static_cast<uint32_t>(device.node.keeps_rate)};
      return 0;
    case VIDIOC_QUERY_EXT_CTRL: return device.query_control(*static_cast<v4l2_query_ext_ctrl*>(argument));
    case VIDIOC_QUERYMENU: {
      const auto& query = *static_cast<v4l2_querymenu*>(argument);
      const SimulatedControl* control = device.find(query.id);
      if (control == nullptr) return -EINVAL;
      return std::find(control->menu.begin(), control->menu.end(), query.index) == control->menu.end() ? -EINVAL : 0;
    }
    case VIDIOC_S_EXT_CTRLS: return device.set_control(*static_cast<v4l2_ext_controls*>(argument)->controls);
    case VIDIOC_G_EXT_CTRLS: {
      v4l2_ext_control& wanted = *static_cast<v4l2_ext_controls*>(argument)->controls;
      const SimulatedControl* control = device.find(wanted.id);
      if (control == nullptr) return -EINVAL;
      wanted.value = static_cast<int32_t>(control->value);
      return 0;
    }
    case VIDIOC_REQBUFS: return device.request_buffers(*static_cast<v4l2_requestbuffers*>(argument));
    case VIDIOC_QUERYBUF: {
      auto& buffer = *static_cast<v4l2_buffer*>(argument);
      buffer.flags = device.timestamp_flags();
      buffer.length = static_cast<uint32_t>(device.buffers[buffer.index].size());
      buffer.m.offset = buffer.index * page;
      return 0;
    }
    case VIDIOC_QBUF: {
      if (device.broken) return -EIO;
      device.lent.push_back(static_cast<v4l2_buffer*>(argument)->index);
      return 0;
    }
    case VIDIOC_DQBUF: {
      if (device.broken) return -EIO;
      if (device.filled.empty()) return -EAGAIN;
      char filled = 0;
      if (::read(fd, &filled, 1) != 1) return -EAGAIN;
      *static_cast<v4l2_buffer*>(argument) = device.filled.front();
      static_cast<v4l2_buffer*>(argument)->index += device.node.fills_wrong_buffer;
      device.filled.pop_front();
      return 0;
    }
    case VIDIOC_STREAMON:
      if (device.node.forgets_on_stream) device.find(V4L2_CID_EXPOSURE_ABSOLUTE)->value = 250;
      device.sequence = 0;
      device.ready_fd = handle.ready_fd;
      device.streaming = true;
      return 0;
    case VIDIOC_STREAMOFF: {
      const size_t filled = device.filled.size();
      device.stop();
      std::vector<char> unread(filled);
      if (filled > 0 && ::read(fd, unread.data(), filled) < 0) return -errno;
      return 0;
    }
    default: return -ENOTTY;
  }
}

const uint8_t* SimulatedVideo::map(int fd, size_t /*length*/, int64_t offset) {
  const std::lock_guard lock(mutex_);
  if (!handles_.at(fd)->device->node.maps) return nullptr;
  return handles_.at(fd)->device->buffers[static_cast<size_t>(offset) / page].data();
}

void SimulatedVideo::unmap(const uint8_t* /*memory*/, size_t /*length*/) {}

SimulatedNode usual_camera(const std::string& node, const std::string& serial, const std::string& bus) {
  SimulatedNode camera{.node = node, .serial = serial, .bus = bus};
  camera.device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
  camera.capabilities = camera.device_caps | V4L2_CAP_META_CAPTURE | V4L2_CAP_DEVICE_CAPS;
  camera.sizes = {{V4L2_PIX_FMT_YUYV, 16, 8, {30}},
                  {V4L2_PIX_FMT_MJPEG, 16, 8, {30, 15}},
                  {V4L2_PIX_FMT_MJPEG, 32, 16, {30, 15}},
                  {V4L2_PIX_FMT_GREY, 16, 8, {60}},
                  {V4L2_PIX_FMT_SRGGB8, 16, 8, {30}}};
  camera.controls = {
      {V4L2_CID_GAIN, "Gain", V4L2_CTRL_TYPE_INTEGER, 0, 100, 1, 10},
      {V4L2_CID_AUTO_WHITE_BALANCE, "White Balance, Automatic", V4L2_CTRL_TYPE_BOOLEAN, 0, 1, 1, 1},
      {V4L2_CID_WHITE_BALANCE_TEMPERATURE,
       "White Balance Temperature",
       V4L2_CTRL_TYPE_INTEGER,
       2800,
       6500,
       10,
       4000,
       {},
       V4L2_CID_AUTO_WHITE_BALANCE,
       0},
      {V4L2_CID_POWER_LINE_FREQUENCY, "Power Line Frequency", V4L2_CTRL_TYPE_MENU, 0, 2, 1, 0, {0, 1, 2}},
      {V4L2_CID_EXPOSURE_AUTO, "Auto Exposure", V4L2_CTRL_TYPE_MENU, 0, 3, 1, 3, {1, 3}},
      {V4L2_CID_EXPOSURE_ABSOLUTE,
       "Exposure Time, Absolute",
       V4L2_CTRL_TYPE_INTEGER,
       3,
       2047,
       1,
       250,
       {},
       V4L2_CID_EXPOSURE_AUTO,
       V4L2_EXPOSURE_MANUAL},
      {V4L2_CID_EXPOSURE_AUTO_PRIORITY, "Exposure, Dynamic Framerate", V4L2_CTRL_TYPE_BOOLEAN, 0, 1, 1, 1}};
  return camera;
}

}  // namespace booth
