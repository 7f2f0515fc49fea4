#include "tests/drivers/simulated_card.h"

#include <gtest/gtest.h>
#include <time.h>
#include <unistd.h>
#include <xf86drm.h>
#include <xf86drmMode.h>

#include <cerrno>
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <stdexcept>
#include <thread>

namespace booth {
namespace {

constexpr int width = 32, height = 16;
constexpr uint32_t pitch = width * sizeof(uint32_t);
constexpr uint32_t page = 4096;
constexpr uint32_t most_buffers = 8;
constexpr uint32_t crtc = 40;
constexpr uint32_t first_encoder = 50;

SimulatedCard* card = nullptr;

int result_of(int error) {
  errno = error;
  return error == 0 ? 0 : -error;
}

/// Memory as libdrm gives it, which it frees itself.
template <class T>
T* allocate(size_t count = 1) {
  return static_cast<T*>(drmMalloc(static_cast<int>(count * sizeof(T))));
}

}  // namespace

SimulatedCard::SimulatedCard() {
  if (card != nullptr) throw std::logic_error("there is a simulated card already");
  path_ = testing::TempDir() + "simulated-card-" + std::to_string(::getpid());
  std::ofstream(path_).close();
  std::filesystem::resize_file(path_, most_buffers * page);
  card = this;
}

SimulatedCard::~SimulatedCard() {
  card = nullptr;
  std::error_code error;
  std::filesystem::remove(path_, error);
}

extern "C" {

drmModeResPtr drmModeGetResources(int) {
  if (!card->drives_displays) return nullptr;
  auto* resources = allocate<drmModeRes>();
  resources->count_crtcs = 1;
  resources->crtcs = allocate<uint32_t>();
  resources->crtcs[0] = crtc;
  resources->count_connectors = static_cast<int>(card->connectors.size());
  resources->connectors = allocate<uint32_t>(card->connectors.size());
  for (size_t i = 0; i < card->connectors.size(); ++i) resources->connectors[i] = static_cast<uint32_t>(i);
  return resources;
}

drmModeConnectorPtr drmModeGetConnector(int, uint32_t id) {
  const SimulatedCard::Connector& described = card->connectors[id];
  auto* connector = allocate<drmModeConnector>();
  connector->connector_id = id;
  connector->connector_type = DRM_MODE_CONNECTOR_HDMIA;
  connector->connector_type_id = described.number;
  connector->connection = described.connected ? DRM_MODE_CONNECTED : DRM_MODE_DISCONNECTED;
  connector->count_encoders = 1;
  connector->encoders = allocate<uint32_t>();
  connector->encoders[0] = first_encoder + id;
  if (!described.has_modes) return connector;
  connector->count_modes = 1;
  connector->modes = allocate<drmModeModeInfo>();
  drmModeModeInfo& mode = connector->modes[0];
  mode.hdisplay = mode.htotal = width;
  mode.vdisplay = mode.vtotal = height;
  mode.clock = 60 * width * height / 1000;
  return connector;
}

drmModeEncoderPtr drmModeGetEncoder(int, uint32_t id) {
  if (id < first_encoder) return nullptr;
  auto* encoder = allocate<drmModeEncoder>();
  encoder->encoder_id = id;
  encoder->possible_crtcs = card->connectors[id - first_encoder].has_crtc ? 1 : 0;
  return encoder;
}

int drmGetCap(int, uint64_t capability, uint64_t* value) {
  *value = capability == DRM_CAP_DUMB_BUFFER ? card->has_dumb_buffers : card->stamps_with_monotonic_clock;
  return 0;
}

int drmIsMaster(int) { return card->master_error == 0 ? 1 : 0; }
int drmSetMaster(int) { return result_of(card->master_error); }

int drmModeCreateDumbBuffer(int, uint32_t, uint32_t, uint32_t, uint32_t, uint32_t* handle, uint32_t* pitch_of,
                            uint64_t* size) {
  if (card->create_error != 0) return result_of(card->create_error);
  *handle = ++card->buffers;
  *pitch_of = pitch;
  *size = uint64_t{pitch} * height;
  return 0;
}
int drmModeDestroyDumbBuffer(int, uint32_t) {
  --card->buffers;
  return 0;
}
int drmModeAddFB(int, uint32_t, uint32_t, uint8_t, uint8_t, uint32_t, uint32_t handle, uint32_t* id) {
  if (card->add_error != 0) return result_of(card->add_error);
  *id = handle;
  return 0;
}
int drmModeRmFB(int, uint32_t) { return 0; }
int drmModeMapDumbBuffer(int, uint32_t handle, uint64_t* offset) {
  if (card->map_error != 0) return result_of(card->map_error);
  *offset = uint64_t{handle - 1} * page;
  return 0;
}

int drmModeSetCursor(int, uint32_t, uint32_t, uint32_t, uint32_t) { return 0; }
int drmModeSetCrtc(int, uint32_t, uint32_t buffer, uint32_t, uint32_t, uint32_t*, int, drmModeModeInfoPtr) {
  if (card->mode_error != 0) return result_of(card->mode_error);
  card->shown_buffer = buffer;
  return 0;
}
int drmModePageFlip(int, uint32_t, uint32_t buffer, uint32_t, void* data) {
  if (card->flip_error != 0) return result_of(card->flip_error);
  card->flip_waits = data;
  if (card->flips) card->shown_buffer = buffer;
  return 0;
}

/// The node is always ready to be read: where no flip has completed, an event of another kind is what came.
int drmHandleEvent(int fd, drmEventContextPtr context) {
  if (card->event_error != 0) return result_of(card->event_error);
  if (!card->flips || card->flip_waits == nullptr) {
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
    return 0;
  }
  timespec now{};
  ::clock_gettime(CLOCK_MONOTONIC, &now);
  void* const data = card->flip_waits;
  card->flip_waits = nullptr;
  context->page_flip_handler(fd, 0, static_cast<unsigned>(now.tv_sec), static_cast<unsigned>(now.tv_nsec / 1000), data);
  return 0;
}

}  // extern "C"

}  // namespace booth
