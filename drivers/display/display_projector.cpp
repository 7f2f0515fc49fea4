#include "drivers/display/display_projector.h"

#include <fcntl.h>
#include <poll.h>
#include <sys/mman.h>
#include <unistd.h>
#include <xf86drm.h>
#include <xf86drmMode.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <span>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "drivers/display/mode_choice.h"
#include "drivers/display/pattern_image.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr const char* card_folder = "/dev/dri";
/// A display that does not flip for this long hangs.
constexpr int flip_timeout_ms = 2000;
constexpr std::chrono::milliseconds longest_nap{10};

template <auto free>
struct Free {
  template <class T>
  void operator()(T* object) const {
    free(object);
  }
};
using Resources = std::unique_ptr<drmModeRes, Free<drmModeFreeResources>>;
using Connector = std::unique_ptr<drmModeConnector, Free<drmModeFreeConnector>>;
using Encoder = std::unique_ptr<drmModeEncoder, Free<drmModeFreeEncoder>>;

class Descriptor {
 public:
  explicit Descriptor(int fd) : fd_(fd) {}
  Descriptor(Descriptor&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}
  Descriptor& operator=(Descriptor&& other) noexcept {
    std::swap(fd_, other.fd_);
    return *this;
  }
  ~Descriptor() {
    if (fd_ >= 0) ::close(fd_);
  }
  int get() const { return fd_; }

 private:
  int fd_;
};

std::string connector_name(const drmModeConnector& connector) {
  const char* const type = drmModeGetConnectorTypeName(connector.connector_type);
  return std::string(type != nullptr ? type : "Unknown") + "-" + std::to_string(connector.connector_type_id);
}

DisplayMode describe(const drmModeModeInfo& mode) {
  const double pixels = static_cast<double>(mode.htotal) * mode.vtotal;
  return {mode.hdisplay, mode.vdisplay, pixels > 0 ? mode.clock * 1000.0 / pixels : 0,
          (mode.type & DRM_MODE_TYPE_PREFERRED) != 0, (mode.flags & DRM_MODE_FLAG_INTERLACE) != 0};
}

/// A full-screen picture in the card's memory: 32 bits a pixel, X R G B.
class Buffer {
 public:
  static Result<std::unique_ptr<Buffer>> create(int fd, const std::string& name, int width, int height) {
    auto buffer = std::unique_ptr<Buffer>(new Buffer(fd));
    const auto failed = [&](const char* what) {
      return Error{ErrorCode::unsupported, name + ": the card gives no " + what + ": " + std::strerror(errno)};
    };
    uint32_t pitch = 0;
    uint64_t size = 0;
    if (drmModeCreateDumbBuffer(fd, static_cast<uint32_t>(width), static_cast<uint32_t>(height), 32, 0,
                                &buffer->handle_, &pitch, &size) != 0)
      return failed("picture memory");
    buffer->size_ = static_cast<size_t>(size);
    buffer->stride_ = pitch / sizeof(uint32_t);
    constexpr uint8_t depth = 24;
    if (drmModeAddFB(fd, static_cast<uint32_t>(width), static_cast<uint32_t>(height), depth, 32, pitch, buffer->handle_,
                     &buffer->id_) != 0)
      return failed("frame buffer");
    uint64_t offset = 0;
    if (drmModeMapDumbBuffer(fd, buffer->handle_, &offset) != 0) return failed("way to its picture memory");
    void* const memory =
        ::mmap(nullptr, buffer->size_, PROT_READ | PROT_WRITE, MAP_SHARED, fd, static_cast<off_t>(offset));
    if (memory == MAP_FAILED) return failed("way to its picture memory");
    buffer->pixels_ = static_cast<uint32_t*>(memory);
    std::memset(buffer->pixels_, 0, buffer->size_);
    return buffer;
  }
  ~Buffer() {
    if (pixels_ != nullptr) ::munmap(pixels_, size_);
    if (id_ != 0) drmModeRmFB(fd_, id_);
    if (handle_ != 0) drmModeDestroyDumbBuffer(fd_, handle_);
  }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;

  uint32_t id() const { return id_; }
  size_t stride() const { return stride_; }
  std::span<uint32_t> pixels() { return {pixels_, size_ / sizeof(uint32_t)}; }

 private:
  explicit Buffer(int fd) : fd_(fd) {}
  int fd_;
  uint32_t handle_ = 0;
  uint32_t id_ = 0;
  size_t size_ = 0;
  size_t stride_ = 0;
  uint32_t* pixels_ = nullptr;
};

/// A display that is to be driven.
struct Output {
  Descriptor card{-1};
  std::string card_path;
  uint32_t connector = 0;
  uint32_t crtc = 0;
  drmModeModeInfo mode = {};
  DisplayMode described;
};

/// The paths of all cards, in their order.
std::vector<std::string> card_paths() {
  std::vector<std::string> paths;
  std::error_code error;
  for (fs::directory_iterator entry(card_folder, error), end; !error && entry != end; entry.increment(error))
    if (entry->path().filename().string().starts_with("card")) paths.push_back(entry->path().string());
  std::sort(paths.begin(), paths.end());
  return paths;
}

/// A CRTC that the connector can be driven by; the one that drives it already where there is one.
uint32_t crtc_for(int fd, const drmModeRes& resources, const drmModeConnector& connector) {
  const Encoder current(drmModeGetEncoder(fd, connector.encoder_id));
  if (current && current->crtc_id != 0) return current->crtc_id;
  for (int i = 0; i < connector.count_encoders; ++i) {
    const Encoder encoder(drmModeGetEncoder(fd, connector.encoders[i]));
    if (!encoder) continue;
    for (int j = 0; j < resources.count_crtcs; ++j)
      if ((encoder->possible_crtcs & (1u << j)) != 0) return resources.crtcs[j];
  }
  return 0;
}

Result<Output> find_output_on(const std::string& path, const DisplaySettings& settings) {
  Output output;
  output.card = Descriptor(::open(path.c_str(), O_RDWR | O_CLOEXEC));
  output.card_path = path;
  const int fd = output.card.get();
  if (fd < 0) {
    const std::string message = settings.id + ": " + path + " cannot be opened: " + std::strerror(errno);
    if (errno == EACCES || errno == EPERM) return Error{ErrorCode::io, message + "; is this user in the group video?"};
    return Error{ErrorCode::device_lost, message};
  }
  const Resources resources(drmModeGetResources(fd));
  if (!resources) return Error{ErrorCode::unsupported, settings.id + ": " + path + " drives no displays"};
  std::string known;
  Connector chosen;
  for (int i = 0; i < resources->count_connectors; ++i) {
    Connector connector(drmModeGetConnector(fd, resources->connectors[i]));
    if (!connector) continue;
    const bool connected = connector->connection == DRM_MODE_CONNECTED;
    const std::string name = connector_name(*connector);
    known += (known.empty() ? "" : ", ") + name + (connected ? " (connected)" : "");
    if (settings.connector.empty() ? !connected : name != settings.connector) continue;
    if (!connected)
      return Error{ErrorCode::device_lost, settings.id + ": nothing is connected to " + name + " of " + path};
    if (chosen)
      return Error{ErrorCode::invalid_argument, settings.id + ": several displays are connected to " + path +
                                                    "; name the connector, one of " + known};
    chosen = std::move(connector);
  }
  if (!chosen) {
    if (!settings.connector.empty())
      return Error{ErrorCode::invalid_argument,
                   settings.id + ": connector " + settings.connector + " is not on " + path + ", which has " + known};
    return Error{ErrorCode::device_lost, settings.id + ": no display is connected to " + path};
  }
  std::vector<DisplayMode> modes;
  for (int i = 0; i < chosen->count_modes; ++i) modes.push_back(describe(chosen->modes[i]));
  const auto mode = choose_mode(modes, settings);
  if (!mode) return mode.error();
  output.connector = chosen->connector_id;
  output.crtc = crtc_for(fd, *resources, *chosen);
  if (output.crtc == 0)
    return Error{ErrorCode::unsupported,
                 settings.id + ": " + path + " cannot drive " + connector_name(*chosen) + " now"};
  output.mode = chosen->modes[*mode];
  output.described = modes[*mode];
  return output;
}

Result<Output> find_output(const DisplaySettings& settings) {
  if (!settings.card.empty()) return find_output_on(settings.card, settings);
  Error last{ErrorCode::device_lost, settings.id + ": this machine has no graphics card in " + card_folder};
  for (const std::string& path : card_paths()) {
    auto output = find_output_on(path, settings);
    if (output) return output;
    // A card without displays is passed over; a display that cannot do what is asked is not.
    if (output.error().code == ErrorCode::invalid_argument) return output;
    last = output.error();
  }
  return last;
}

class KmsProjector final : public FlippingProjector {
 public:
  static Result<std::unique_ptr<KmsProjector>> open(const DisplaySettings& settings, const Clock& clock,
                                                    Output output) {
    const auto pattern = pattern_for(output.described, settings);
    if (!pattern) return pattern.error();
    const int fd = output.card.get();
    uint64_t capability = 0;
    if (drmGetCap(fd, DRM_CAP_DUMB_BUFFER, &capability) != 0 || capability == 0)
      return Error{ErrorCode::unsupported, settings.id + ": " + output.card_path + " has no plain picture memory"};
    if (drmGetCap(fd, DRM_CAP_TIMESTAMP_MONOTONIC, &capability) != 0 || capability == 0)
      return Error{ErrorCode::unsupported,
                   settings.id + ": " + output.card_path + " does not stamp its flips with the monotonic clock"};
    if (drmIsMaster(fd) == 0 && drmSetMaster(fd) != 0)
      return Error{errno == EBUSY || errno == EACCES || errno == EPERM ? ErrorCode::busy : ErrorCode::io,
                   settings.id + ": another program draws on " + output.card_path + " (" + std::strerror(errno) + ")"};
    auto projector = std::unique_ptr<KmsProjector>(new KmsProjector(settings, clock, std::move(output), *pattern));
    for (auto& buffer : projector->buffers_) {
      auto created = Buffer::create(fd, settings.id, pattern->width, pattern->height);
      if (!created) return created.error();
      buffer = *std::move(created);
    }
    if (auto set = projector->set_mode(); !set) return set.error();
    return projector;
  }

  ~KmsProjector() override { dark(); }

  const ProjectorInfo& info() const override { return info_; }
  Timestamp refresh_ns() const override { return std::llround(1e9 / output_.described.refresh_hz); }

  Result<Timestamp> flip(int index) override {
    if (index < 0 || index >= pattern_count(info_.pattern))
      return Error{ErrorCode::invalid_argument, info_.id + ": has no pattern " + std::to_string(index) +
                                                    ", only 0 to " + std::to_string(pattern_count(info_.pattern) - 1)};
    const size_t next = shown_ == first_picture ? second_picture : first_picture;
    draw_pattern(info_.pattern, index, white_, buffers_[next]->pixels(), buffers_[next]->stride());
    return flip_to(next);
  }

  Result<void> show(int index) override {
    const auto flipped = flip(index);
    if (!flipped) {
      dark();
      return flipped.error();
    }
    const Timestamp there = *flipped + Timestamp{settings_.delay_us} * 1000;
    for (Timestamp now = clock_.now(); now < there; now = clock_.now())
      std::this_thread::sleep_for(
          std::min<std::chrono::nanoseconds>(std::chrono::nanoseconds(there - now), longest_nap));
    return {};
  }

  void dark() noexcept override {
    if (shown_ == black || !buffers_[black]) return;
    if (flip_to(black)) return;
    // A flip may hang that a new beginning does not; where that fails too, nobody can do any more.
    [[maybe_unused]] const auto set = set_mode();
  }

 private:
  static constexpr size_t black = 0;
  static constexpr size_t first_picture = 1;
  static constexpr size_t second_picture = 2;

  KmsProjector(const DisplaySettings& settings, const Clock& clock, Output output, const GrayCodePattern& pattern)
      : settings_(settings), clock_(clock), output_(std::move(output)), info_{settings.id, "display", pattern} {
    const auto level = static_cast<uint32_t>(white_level(settings));
    white_ = level << 16 | level << 8 | level;
  }

  Error failed(const std::string& what, int error) const {
    if (error == EACCES || error == EPERM)
      return {ErrorCode::device_lost, info_.id + ": " + what + ": another program took " + output_.card_path + " over"};
    return {ErrorCode::device_lost, info_.id + ": " + what + ": " + std::strerror(error)};
  }

  /// Takes the display, black.
  Result<void> set_mode() {
    const int fd = output_.card.get();
    drmModeSetCursor(fd, output_.crtc, 0, 0, 0);  // fails where there is none
    if (drmModeSetCrtc(fd, output_.crtc, buffers_[black]->id(), 0, 0, &output_.connector, 1, &output_.mode) != 0)
      return failed("its mode cannot be set", errno);
    shown_ = black;
    return {};
  }

  Result<Timestamp> flip_to(size_t buffer) {
    if (hangs_) return failed("it does not flip any more", ETIMEDOUT);
    const int fd = output_.card.get();
    flip_ = {};
    if (drmModePageFlip(fd, output_.crtc, buffers_[buffer]->id(), DRM_MODE_PAGE_FLIP_EVENT, &flip_) != 0)
      return failed("it does not flip", errno);
    shown_ = buffer;  // or will be, even if nobody is told: what hangs may go through later
    drmEventContext context;
    std::memset(&context, 0, sizeof context);
    context.version = 2;
    context.page_flip_handler = [](int, unsigned, unsigned s, unsigned us, void* data) {
      *static_cast<Flip*>(data) = {true, seconds(s) + Timestamp{us} * 1000};
    };
    const Timestamp deadline = clock_.now() + milliseconds(flip_timeout_ms);
    while (!flip_.done) {
      const Timestamp left = deadline - clock_.now();
      pollfd polled{fd, POLLIN, 0};
      const int ready = left <= 0 ? 0 : ::poll(&polled, 1, static_cast<int>(left / milliseconds(1)) + 1);
      if (ready < 0 && errno == EINTR) continue;
      if (ready <= 0) {
        hangs_ = true;
        return failed("it has not flipped for " + std::to_string(flip_timeout_ms) + " ms", ETIMEDOUT);
      }
      if (drmHandleEvent(fd, &context) != 0) return failed("it does not say when it flips", errno);
    }
    return flip_.when;
  }

  struct Flip {
    bool done = false;
    Timestamp when = 0;
  };

  const DisplaySettings settings_;
  const Clock& clock_;
  Output output_;
  const ProjectorInfo info_;
  uint32_t white_ = 0;
  std::array<std::unique_ptr<Buffer>, 3> buffers_;  ///< black, and two pictures of which one is shown, one drawn
  size_t shown_ = black;
  Flip flip_;           ///< the last one that was asked for
  bool hangs_ = false;  ///< a flip was asked for that never came
};

}  // namespace

Result<std::unique_ptr<FlippingProjector>> open_display_projector(const DisplaySettings& settings, const Clock& clock) {
  if (auto checked = check(settings); !checked) return checked.error();
  auto output = find_output(settings);
  if (!output) return output.error();
  auto projector = KmsProjector::open(settings, clock, *std::move(output));
  if (!projector) return projector.error();
  return std::unique_ptr<FlippingProjector>(*std::move(projector));
}

}  // namespace booth
