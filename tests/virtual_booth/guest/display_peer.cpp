#include "tests/virtual_booth/guest/display_peer.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>
#include <xf86drm.h>
#include <xf86drmMode.h>

#include <algorithm>
#include <stdexcept>

namespace booth {
namespace {

Screen copy(int fd, const drmModeFB2& buffer) {
  Screen screen{static_cast<int>(buffer.width), static_cast<int>(buffer.height), {}};
  uint64_t offset = 0;
  if (drmModeMapDumbBuffer(fd, buffer.handles[0], &offset) != 0) throw std::runtime_error("cannot map the screen");
  const size_t size = size_t{buffer.pitches[0]} * buffer.height;
  void* const memory = ::mmap(nullptr, size, PROT_READ, MAP_SHARED, fd, static_cast<off_t>(offset));
  if (memory == MAP_FAILED) throw std::runtime_error("cannot map the screen");
  const auto* const pixels = static_cast<const uint32_t*>(memory);
  constexpr uint32_t colours = 0xFFFFFF;
  for (uint32_t y = 0; y < buffer.height; ++y)
    for (uint32_t x = 0; x < buffer.width; ++x)
      screen.pixels.push_back(pixels[y * (buffer.pitches[0] / sizeof(uint32_t)) + x] & colours);
  ::munmap(memory, size);
  return screen;
}

}  // namespace

bool Screen::is_black() const {
  return std::all_of(pixels.begin(), pixels.end(), [](uint32_t pixel) { return pixel == 0; });
}

std::optional<Screen> look_at(const std::string& card) {
  const int fd = ::open(card.c_str(), O_RDWR | O_CLOEXEC);
  if (fd < 0) throw std::runtime_error("cannot open " + card);
  drmDropMaster(fd);  // who opens a card that nobody draws on becomes its master
  drmSetClientCap(fd, DRM_CLIENT_CAP_UNIVERSAL_PLANES, 1);
  std::optional<Screen> screen;
  drmModePlaneRes* const planes = drmModeGetPlaneResources(fd);
  for (uint32_t i = 0; planes != nullptr && i < planes->count_planes && !screen; ++i) {
    drmModePlane* const plane = drmModeGetPlane(fd, planes->planes[i]);
    if (plane != nullptr && plane->fb_id != 0 && plane->crtc_id != 0)
      if (drmModeFB2* const buffer = drmModeGetFB2(fd, plane->fb_id); buffer != nullptr) {
        screen = copy(fd, *buffer);
        drmModeFreeFB2(buffer);
      }
    drmModeFreePlane(plane);
  }
  drmModeFreePlaneResources(planes);
  ::close(fd);
  return screen;
}

}  // namespace booth
