#include "drivers/aravis/aravis_source.h"

#include <algorithm>
#include <atomic>
#include <functional>
#include <list>
#include <map>
#include <mutex>
#include <set>
#include <thread>
#include <utility>

#include "drivers/aravis/aravis_camera.h"
#include "drivers/aravis/gobject.h"
#include "drivers/aravis/gvcp.h"
#include "drivers/aravis/triggers.h"

namespace booth {
namespace {

/// How long a camera may take to answer before it counts as absent.
constexpr std::chrono::milliseconds locate_patience{600};
/// A discovery this young is as good as a new one: when all cameras open at once, they need not all ask.
constexpr Timestamp discovery_age = seconds(2);

/// Opening a device reads its GenICam description, for which Aravis' parser has one state for the whole process: two
/// at once get each other's features, or crash.
std::mutex& parser_mutex() {
  static std::mutex mutex;
  return mutex;
}

struct FoundDevice {
  std::string device_id, serial, model, address;
  bool gige = false;
};

}  // namespace

struct AravisSource::Content {
  Content(AravisSettings settings_, const Clock& clock_, Warn warn_)
      : settings(std::move(settings_)), clock(clock_), warn(std::move(warn_)) {}

  const AravisSettings settings;
  const Clock& clock;
  const Warn warn;

  std::mutex mutex;
  std::map<std::string, std::weak_ptr<AravisCamera>> open;  ///< guarded by mutex
  std::set<std::string> opening;                            ///< guarded by mutex
  const std::shared_ptr<PtpWatch> ptp = std::make_shared<PtpWatch>();
  std::mutex discovery_mutex;
  std::vector<FoundDevice> found;       ///< guarded by discovery_mutex
  std::optional<Timestamp> discovered;  ///< when `found` was asked for; guarded by discovery_mutex

  std::vector<FoundDevice> discover(Timestamp not_before) {
    const std::lock_guard lock(discovery_mutex);
    if (discovered && *discovered >= not_before) return found;
    const Timestamp asked = clock.now();
    arv_update_device_list();
    found.clear();
    const auto text = [](const char* value) { return std::string(value != nullptr ? value : ""); };
    for (unsigned i = 0; i < arv_get_n_devices(); ++i) {
      const bool gige = text(arv_get_device_protocol(i)) == "GigEVision";
      found.push_back({text(arv_get_device_id(i)), text(arv_get_device_serial_nbr(i)),
                       text(arv_get_device_vendor(i)) + " " + text(arv_get_device_model(i)),
                       gige ? text(arv_get_device_address(i)) : "USB", gige});
    }
    discovered = asked;
    return found;
  }

  std::optional<FoundDevice> discover_serial(const std::string& serial) {
    const Timestamp now = clock.now();
    for (const Timestamp not_before : {now - discovery_age, now}) {
      const auto devices = discover(not_before);
      const auto device =
          std::find_if(devices.begin(), devices.end(), [&](const FoundDevice& one) { return one.serial == serial; });
      if (device != devices.end()) return *device;
    }
    return std::nullopt;
  }

  /// Lets go of a camera that is lost in a thread of its own: its answers are waited for in vain, for seconds, and
  /// meanwhile it may be back.
  void bury(std::shared_ptr<AravisCamera> camera) {
    const std::lock_guard lock(mutex);
    burials.remove_if([](const Burial& burial) { return burial.over->load(); });
    auto over = std::make_shared<std::atomic<bool>>(false);
    open.erase(camera->info().id);
    burials.push_back({over, std::jthread([camera = std::move(camera), over]() mutable {
                         camera.reset();
                         *over = true;
                       })});
  }
  struct Burial {
    std::shared_ptr<std::atomic<bool>> over;
    std::jthread thread;
  };

  const AravisCameraSettings* find(const std::string& id) const {
    const auto camera = std::find_if(settings.cameras.begin(), settings.cameras.end(),
                                     [&](const AravisCameraSettings& one) { return one.id == id; });
    return camera == settings.cameras.end() ? nullptr : &*camera;
  }

  Result<std::shared_ptr<AravisCamera>> open_device(const AravisCameraSettings& camera);

  std::list<Burial> burials;  ///< guarded by mutex

  /// The cameras that are open and triggered in that way.
  std::vector<std::shared_ptr<AravisCamera>> triggered_by(AravisTriggerSource trigger) {
    const std::lock_guard lock(mutex);
    std::vector<std::shared_ptr<AravisCamera>> cameras;
    for (const auto& [id, weak] : open)
      if (auto camera = weak.lock(); camera && camera->trigger() == trigger) cameras.push_back(std::move(camera));
    return cameras;
  }
};

namespace {

Error absent(const AravisCameraSettings& settings) {
  return {ErrorCode::device_lost,
          "camera " + settings.id + ": nothing answers at " +
              (settings.address.empty() ? "serial number " + settings.serial : "address " + settings.address)};
}

Result<GObjectPtr<ArvDevice>> open_gige(const AravisCameraSettings& settings, in_addr address) {
  const auto own = own_address_towards(address);
  if (!own) return Error{ErrorCode::device_lost, "camera " + settings.id + ": " + own.error().message};
  if (!gvcp_answers(address, locate_patience)) return absent(settings);
  const GObjectPtr<GInetAddress> interface(
      g_inet_address_new_from_bytes(reinterpret_cast<const guint8*>(&own->s_addr), G_SOCKET_FAMILY_IPV4));
  const GObjectPtr<GInetAddress> device(
      g_inet_address_new_from_bytes(reinterpret_cast<const guint8*>(&address.s_addr), G_SOCKET_FAMILY_IPV4));
  GErrorSlot error;
  const std::lock_guard lock(parser_mutex());
  GObjectPtr<ArvDevice> opened(arv_gv_device_new(interface.get(), device.get(), error.out()));
  if (!opened) return Error{ErrorCode::device_lost, "camera " + settings.id + ": " + error.message()};
  return opened;
}

Result<GObjectPtr<ArvDevice>> open_usb(const AravisCameraSettings& settings, const std::string& device_id) {
  GErrorSlot error;
  const std::lock_guard lock(parser_mutex());
  GObjectPtr<ArvDevice> opened(arv_open_device(device_id.c_str(), error.out()));
  if (!opened) return Error{ErrorCode::device_lost, "camera " + settings.id + ": " + error.message()};
  return opened;
}

/// As the daemon holds it. The device itself is shared with the trigger while that fires.
class AravisCameraHandle final : public Camera {
 public:
  using Bury = std::function<void(std::shared_ptr<AravisCamera>)>;
  AravisCameraHandle(std::shared_ptr<AravisCamera> camera, Bury bury)
      : camera_(std::move(camera)), bury_(std::move(bury)) {}
  ~AravisCameraHandle() override {
    if (camera_->is_lost()) bury_(std::move(camera_));
  }
  const CameraInfo& info() const override { return camera_->info(); }
  Result<void> arm(const CaptureSettings& settings, int count) override { return camera_->arm(settings, count); }
  Result<Frame> wait_frame(Timestamp deadline) override { return camera_->wait_frame(deadline); }
  void note_trigger(int index, Timestamp when) noexcept override { camera_->note_trigger(index, when); }
  Result<void> check_presence() const override { return camera_->check_presence(); }
  std::vector<Statistic> statistics() const override { return camera_->statistics(); }
  std::vector<std::string> warnings() const override { return camera_->warnings(); }
  void stop() noexcept override { camera_->stop(); }

 private:
  std::shared_ptr<AravisCamera> camera_;
  const Bury bury_;
};

}  // namespace

Result<std::shared_ptr<AravisCamera>> AravisSource::Content::open_device(const AravisCameraSettings& camera) {
  std::optional<in_addr> address;
  std::string usb_device;
  if (!camera.address.empty()) {
    address = resolve_host(camera.address);
    if (!address)
      return Error{ErrorCode::device_lost, "camera " + camera.id + ": address: no host is called " + camera.address};
  } else {
    const auto device = discover_serial(camera.serial);
    if (!device) return absent(camera);
    if (device->gige)
      address = resolve_host(device->address);
    else
      usb_device = device->device_id;
  }
  auto device = address ? open_gige(camera, *address) : open_usb(camera, usb_device);
  if (!device) return device.error();
  return AravisCamera::open(*std::move(device), address, camera, settings.action, ptp, clock, warn);
}

Result<std::shared_ptr<AravisSource>> AravisSource::create(const AravisSettings& settings, const Clock& clock,
                                                           Warn warn) {
  if (const auto checked = check(settings); !checked) return checked.error();
  return std::shared_ptr<AravisSource>(new AravisSource(std::make_shared<Content>(settings, clock, std::move(warn))));
}

AravisSource::AravisSource(std::shared_ptr<Content> content) : content_(std::move(content)) {}
AravisSource::~AravisSource() = default;

Result<std::vector<CameraInfo>> AravisSource::discover() {
  std::vector<CameraInfo> cameras;
  for (const FoundDevice& device : content_->discover(content_->clock.now())) {
    CameraInfo info{.id = device.serial, .driver = "aravis"};
    for (const AravisCameraSettings& camera : content_->settings.cameras) {
      const auto address = camera.address.empty() ? std::nullopt : resolve_host(camera.address);
      if (camera.serial == device.serial || (address && to_text(*address) == device.address)) {
        info.id = camera.id;
        info.role = camera.role;
      }
    }
    info.model = device.model;
    info.serial = device.serial;
    info.address = device.address;
    cameras.push_back(std::move(info));
  }
  return cameras;
}

Result<std::unique_ptr<Camera>> AravisSource::open_camera(const std::string& id) {
  const AravisCameraSettings* settings = content_->find(id);
  if (settings == nullptr) return Error{ErrorCode::not_found, "no camera " + id + " is configured"};
  {
    const std::lock_guard lock(content_->mutex);
    const auto taken = content_->open.find(id);
    const auto held = taken == content_->open.end() ? nullptr : taken->second.lock();
    if (content_->opening.contains(id) || (held && !held->is_lost()))
      return Error{ErrorCode::busy, "camera " + id + " is open already"};
    if (held) return absent(*settings);
    content_->opening.insert(id);
  }
  auto opened = content_->open_device(*settings);
  const std::lock_guard lock(content_->mutex);
  content_->opening.erase(id);
  if (!opened) return opened.error();
  content_->open[id] = *opened;
  return std::unique_ptr<Camera>(std::make_unique<AravisCameraHandle>(
      *std::move(opened),
      [content = content_](std::shared_ptr<AravisCamera> camera) { content->bury(std::move(camera)); }));
}

Result<std::unique_ptr<Trigger>> AravisSource::open_trigger() {
  const auto any = [&](AravisTriggerSource trigger) {
    return std::any_of(content_->settings.cameras.begin(), content_->settings.cameras.end(),
                       [&](const AravisCameraSettings& camera) { return camera.trigger == trigger; });
  };
  const auto cameras = [content = content_](AravisTriggerSource trigger) {
    return [content, trigger] { return content->triggered_by(trigger); };
  };
  if (any(AravisTriggerSource::action)) {
    auto sender = ActionSender::create(content_->settings.action);
    if (!sender) return sender.error();
    return std::unique_ptr<Trigger>(std::make_unique<ActionTrigger>(cameras(AravisTriggerSource::action),
                                                                    content_->settings.action, *std::move(sender),
                                                                    content_->clock, content_->warn));
  }
  if (any(AravisTriggerSource::software))
    return std::unique_ptr<Trigger>(
        std::make_unique<SoftwareTrigger>(cameras(AravisTriggerSource::software), content_->clock, content_->warn));
  return Error{ErrorCode::unsupported, "every camera is triggered by its line, which another driver pulses"};
}

Result<std::unique_ptr<Projector>> AravisSource::open_projector() {
  return Error{ErrorCode::unsupported, "cameras are no projectors"};
}

}  // namespace booth
