#include "tests/virtual_booth/guest/display_peer.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>
#include <xf86drm.h>
#include <xf86drmMode.h>

#include <algorithm>
#include <stdexcept>
#include <utility>

namespace booth {
namespace {

constexpr uint32_t colours = 0xFFFFFF;

/// The frame buffer's pixels, mapped while this lives.
class Mapped {
 public:
  Mapped(int fd, const drmModeFB2& buffer) : size_(size_t{buffer.pitches[0]} * buffer.height) {
    uint64_t offset = 0;
    if (drmModeMapDumbBuffer(fd, buffer.handles[0], &offset) == 0)
      memory_ = ::mmap(nullptr, size_, PROT_READ, MAP_SHARED, fd, static_cast<off_t>(offset));
    if (memory_ == MAP_FAILED) throw std::runtime_error("cannot map the screen");
  }
  ~Mapped() { ::munmap(memory_, size_); }
  Mapped(const Mapped&) = delete;
  Mapped& operator=(const Mapped&) = delete;
  const uint32_t* pixels() const { return static_cast<const uint32_t*>(memory_); }

 private:
  const size_t size_;
  void* memory_ = MAP_FAILED;
};

Screen copy(int fd, const drmModeFB2& buffer) {
  Screen screen{static_cast<int>(buffer.width), static_cast<int>(buffer.height), {}};
  const Mapped memory(fd, buffer);
  for (uint32_t y = 0; y < buffer.height; ++y)
    for (uint32_t x = 0; x < buffer.width; ++x)
      screen.pixels.push_back(memory.pixels()[y * (buffer.pitches[0] / sizeof(uint32_t)) + x] & colours);
  return screen;
}

/// What `see` makes of the frame buffer that the card shows; nothing where the output is off.
template <class See>
auto look(const std::string& card, const See& see) {
  const int fd = ::open(card.c_str(), O_RDWR | O_CLOEXEC);
  if (fd < 0) throw std::runtime_error("cannot open " + card);
  drmDropMaster(fd);  // who opens a card that nobody draws on becomes its master
  drmSetClientCap(fd, DRM_CLIENT_CAP_UNIVERSAL_PLANES, 1);
  std::optional<decltype(see(fd, std::declval<const drmModeFB2&>()))> seen;
  drmModePlaneRes* const planes = drmModeGetPlaneResources(fd);
  for (uint32_t i = 0; planes != nullptr && i < planes->count_planes && !seen; ++i) {
    drmModePlane* const plane = drmModeGetPlane(fd, planes->planes[i]);
    if (plane != nullptr && plane->fb_id != 0 && plane->crtc_id != 0)
      if (drmModeFB2* const buffer = drmModeGetFB2(fd, plane->fb_id); buffer != nullptr) {
        seen = see(fd, *buffer);
        drmModeFreeFB2(buffer);
      }
    drmModeFreePlane(plane);
  }
  drmModeFreePlaneResources(planes);
  ::close(fd);
  return seen;
}

}  // namespace

bool Screen::is_black() const {
  return std::all_of(pixels.begin(), pixels.end(), [](uint32_t pixel) { return pixel == 0; });
}

std::optional<Screen> look_at(const std::string& card) { return look(card, copy); }

std::optional<uint32_t> look_at_first_pixel(const std::string& card) {
  return look(card, [](int fd, const drmModeFB2& buffer) { return Mapped(fd, buffer).pixels()[0] & colours; });
}

}  // namespace booth
