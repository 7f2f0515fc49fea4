#include "drivers/v4l2/v4l2_source.h"

#include <map>
#include <mutex>
#include <set>
#include <utility>

#include "drivers/v4l2/v4l2_camera.h"
#include "drivers/v4l2/video_device.h"
#include "drivers/v4l2/video_system.h"

namespace booth {
namespace {

constexpr const char* driver_name = "v4l2";

}  // namespace

/// What a source and its cameras share.
class V4l2Registry {
 public:
  V4l2Registry(V4l2Settings settings, const Clock& clock, std::shared_ptr<VideoSystem> system)
      : clock_(clock), system_(std::move(system)) {
    for (V4l2CameraSettings& camera : settings.cameras) {
      const std::string id = camera.id;
      settings_.emplace(id, std::move(camera));
    }
  }

  std::vector<CameraInfo> discover() {
    std::vector<CameraInfo> cameras;
    std::set<std::string> buses;
    for (const VideoNode& node : capture_nodes()) {
      // Of the several streams of one device, the first is the camera's.
      if (!buses.insert(node.bus).second) continue;
      CameraInfo info{.id = node.bus,
                      .driver = driver_name,
                      .model = node.card,
                      .serial = system_->serial(node.node),
                      .address = node.node};
      for (const auto& [id, camera] : settings_) {
        const auto configured = find_node(camera);
        if (!configured || configured->node != node.node) continue;
        info.id = id;
        info.role = camera.role;
        info.width = camera.width;
        info.height = camera.height;
      }
      cameras.push_back(std::move(info));
    }
    return cameras;
  }

  Result<std::unique_ptr<Camera>> open(const std::string& id, std::shared_ptr<V4l2Registry> self) {
    const auto found = settings_.find(id);
    if (found == settings_.end())
      return Error{ErrorCode::not_found, id + ": no camera of that name is configured for the driver v4l2"};
    const V4l2CameraSettings& settings = found->second;
    const auto node = find_node(settings);
    if (!node) return node.error();
    {
      const std::lock_guard lock(mutex_);
      if (!open_.insert(id).second) return Error{ErrorCode::busy, id + ": is open already"};
    }
    auto opened = open(settings, *node, std::move(self));
    if (!opened) close(id);
    return opened;
  }

 private:
  Result<std::unique_ptr<Camera>> open(const V4l2CameraSettings& settings, const VideoNode& node,
                                       std::shared_ptr<V4l2Registry> self) {
    auto device = VideoDevice::open(system_, node.node, settings);
    if (!device) return device.error();
    if (auto applied = (*device)->apply_controls(settings, settings.exposure_us); !applied) return applied.error();
    if (settings.gray_code_exposure_us) {
      // Refused now rather than when somebody stands in the booth.
      for (const auto& exposure_us : {settings.gray_code_exposure_us, settings.exposure_us})
        if (auto applied = (*device)->apply_controls(settings, exposure_us); !applied) return applied.error();
    }
    CameraInfo info{.id = settings.id,
                    .driver = driver_name,
                    .role = settings.role,
                    .width = (*device)->mode().width,
                    .height = (*device)->mode().height,
                    .model = node.card,
                    .serial = system_->serial(node.node),
                    .address = node.node};
    return std::unique_ptr<Camera>(
        std::make_unique<V4l2Camera>(*std::move(device), settings, std::move(info), clock_,
                                     [self = std::move(self), id = settings.id] { self->close(id); }));
  }

  void close(const std::string& id) {
    const std::lock_guard lock(mutex_);
    open_.erase(id);
  }

  /// Nodes that cannot be asked now, such as one that is just going, are left out.
  std::vector<VideoNode> capture_nodes() {
    std::vector<VideoNode> nodes;
    for (const std::string& path : system_->nodes())
      if (auto node = identify(*system_, path); node && node->captures) nodes.push_back(*std::move(node));
    return nodes;
  }

  Result<VideoNode> find_node(const V4l2CameraSettings& settings) {
    const Error absent{ErrorCode::device_lost, settings.id + ": no camera is plugged in as " +
                                                   (!settings.device.empty()   ? settings.device
                                                    : !settings.serial.empty() ? "serial number " + settings.serial
                                                                               : settings.bus)};
    if (!settings.device.empty()) {
      const std::string path = system_->resolve(settings.device);
      if (path.empty()) return absent;
      auto node = identify(*system_, path);
      if (!node) return Error{node.error().code, settings.id + ": " + node.error().message};
      return node;
    }
    std::optional<VideoNode> found;
    for (VideoNode& node : capture_nodes()) {
      if (settings.serial.empty() ? node.bus != settings.bus : system_->serial(node.node) != settings.serial) continue;
      if (found && found->bus != node.bus)
        return Error{ErrorCode::invalid_argument, settings.id + ": several cameras have the serial number " +
                                                      settings.serial + " (at " + found->bus + " and " + node.bus +
                                                      "); name the port with bus instead"};
      if (!found) found = std::move(node);
    }
    if (!found) return absent;
    return *std::move(found);
  }

  const Clock& clock_;
  const std::shared_ptr<VideoSystem> system_;
  std::map<std::string, V4l2CameraSettings> settings_;

  std::mutex mutex_;
  std::set<std::string> open_;  ///< guarded by mutex_
};

V4l2Source::V4l2Source(std::shared_ptr<V4l2Registry> registry) : registry_(std::move(registry)) {}
V4l2Source::~V4l2Source() = default;

Result<std::shared_ptr<V4l2Source>> V4l2Source::open(V4l2Settings settings, const Clock& clock,
                                                     std::shared_ptr<VideoSystem> system) {
  if (const auto checked = check(settings); !checked) return checked.error();
  if (!system) system = linux_video_system();
  return std::shared_ptr<V4l2Source>(
      new V4l2Source(std::make_shared<V4l2Registry>(std::move(settings), clock, std::move(system))));
}

Result<std::vector<CameraInfo>> V4l2Source::discover() { return registry_->discover(); }

Result<std::unique_ptr<Camera>> V4l2Source::open_camera(const std::string& id) {
  return registry_->open(id, registry_);
}

Result<std::unique_ptr<Trigger>> V4l2Source::open_trigger() {
  return Error{ErrorCode::unsupported, "v4l2: USB cameras have no trigger"};
}

Result<std::unique_ptr<Projector>> V4l2Source::open_projector() {
  return Error{ErrorCode::unsupported, "v4l2: a camera is no projector"};
}

}  // namespace booth
