#include "drivers/aravis/aravis_camera.h"

#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <utility>

#include "drivers/aravis/buffer_pool.h"
#include "drivers/aravis/gvcp.h"

namespace booth {
namespace {

constexpr size_t spare_buffers = 2;  ///< beyond the frames of a shot
constexpr size_t preview_buffers = 4;
constexpr size_t most_automatic_buffers = 128;

/// What every Ethernet carries is 1500 bytes; some tunnels take a little of it.
constexpr gint usual_packet_size = 1400;

/// A camera that owes a frame this long is asked whether it is still there.
constexpr Timestamp worrying_silence = milliseconds(700);
constexpr std::chrono::milliseconds answer_patience{900};

std::string describe(ArvBufferStatus status) {
  switch (status) {
    case ARV_BUFFER_STATUS_TIMEOUT:
    case ARV_BUFFER_STATUS_MISSING_PACKETS: return "packets are missing";
    case ARV_BUFFER_STATUS_WRONG_PACKET_ID: return "its packets are numbered wrongly";
    case ARV_BUFFER_STATUS_SUCCESS:
    case ARV_BUFFER_STATUS_SIZE_MISMATCH: return "it is not as large as the camera said";
    case ARV_BUFFER_STATUS_ABORTED: return "its reception was broken off";
    default: return "it was not received";
  }
}

/// This process' own UDP socket that is bound to the port; -1 where there is none. Aravis does not tell.
int find_socket(uint16_t port) {
  std::error_code code;
  for (const auto& entry : std::filesystem::directory_iterator("/proc/self/fd", code)) {
    const int descriptor = std::atoi(entry.path().filename().c_str());
    sockaddr_in name{};
    socklen_t size = sizeof name;
    int type = 0;
    socklen_t type_size = sizeof type;
    if (getsockname(descriptor, reinterpret_cast<sockaddr*>(&name), &size) == 0 && name.sin_family == AF_INET &&
        name.sin_port == htons(port) && getsockopt(descriptor, SOL_SOCKET, SO_TYPE, &type, &type_size) == 0 &&
        type == SOCK_DGRAM)
      return descriptor;
  }
  return -1;
}

class ScopedFlag {
 public:
  /// @pre the mutex is locked whenever the flag is constructed or destroyed
  explicit ScopedFlag(bool& flag) : flag_(flag) { flag_ = true; }
  ~ScopedFlag() { flag_ = false; }
  ScopedFlag(const ScopedFlag&) = delete;
  ScopedFlag& operator=(const ScopedFlag&) = delete;

 private:
  bool& flag_;
};

}  // namespace

AravisCamera::AravisCamera(const AravisCameraSettings& settings, const AravisActionSettings& action,
                           std::shared_ptr<PtpWatch> ptp, const Clock& clock, Warn warn)
    : settings_(settings),
      action_(action),
      ptp_(std::move(ptp)),
      clock_(clock),
      warn_(std::move(warn)),
      events_(std::make_shared<Events>(clock)) {}

Result<std::shared_ptr<AravisCamera>> AravisCamera::open(GObjectPtr<ArvDevice> device, std::optional<in_addr> address,
                                                         const AravisCameraSettings& settings,
                                                         const AravisActionSettings& action,
                                                         std::shared_ptr<PtpWatch> ptp, const Clock& clock, Warn warn) {
  const std::string name = "camera " + settings.id;
  if (ARV_IS_GV_DEVICE(device.get()) && !arv_gv_device_is_controller(ARV_GV_DEVICE(device.get())))
    return Error{ErrorCode::busy,
                 name + ": another program controls it" + (address ? " (" + to_text(*address) + ")" : "")};
  std::shared_ptr<AravisCamera> opened(new AravisCamera(settings, action, std::move(ptp), clock, std::move(warn)));
  opened->address_ = address;
  GErrorSlot error;
  opened->camera_.reset(arv_camera_new_with_device(device.get(), error.out()));
  if (!opened->camera_) return Error{ErrorCode::device_lost, name + ": " + error.message()};
  opened->features_ = std::make_unique<Features>(opened->camera_.get(), settings.id);
  opened->loss_handler_ = g_signal_connect_data(
      device.get(), "control-lost", G_CALLBACK(+[](ArvDevice*, gpointer data) {
        Events& events = **static_cast<std::shared_ptr<Events>*>(data);
        {
          const std::lock_guard lock(events.mutex);
          events.lost = true;
        }
        events.changed.notify_all();
      }),
      new std::shared_ptr<Events>(opened->events_),
      [](gpointer data, GClosure*) { delete static_cast<std::shared_ptr<Events>*>(data); }, G_CONNECT_DEFAULT);
  const std::lock_guard lock(opened->control_);
  if (const auto configured = opened->configure(); !configured) return configured.error();
  return opened;
}

AravisCamera::~AravisCamera() {
  {
    const std::lock_guard lock(control_);
    // What a lost camera is asked costs seconds of waiting for nothing.
    if (camera_ && !is_lost()) static_cast<void>(end_acquisition());
  }
  if (held_) pool_->give_back(held_->buffer);
  if (pool_) pool_->close();
  if (camera_ && loss_handler_ != 0) g_signal_handler_disconnect(arv_camera_get_device(camera_.get()), loss_handler_);
  stream_.reset();
  features_.reset();
  camera_.reset();
}

Result<void> AravisCamera::configure() {
  // A program that died may have left it acquiring; nothing can be set then.
  if (const auto ended = features_->execute("AcquisitionStop"); !ended && ended.error().code == ErrorCode::device_lost)
    return ended;
  const auto picture = apply_settings(*features_, settings_, action_);
  if (!picture) return picture.error();
  picture_ = *picture;

  GErrorSlot error;
  const auto text = [](const char* value) { return std::string(value != nullptr ? value : ""); };
  info_ = {.id = settings_.id,
           .driver = "aravis",
           .role = settings_.role,
           .width = picture_.width,
           .height = picture_.height,
           .model = text(arv_camera_get_vendor_name(camera_.get(), error.out())),
           .serial = text(arv_camera_get_device_serial_number(camera_.get(), error.out())),
           .address = address_ ? to_text(*address_) : std::string("USB")};
  info_.model += ' ';
  info_.model += text(arv_camera_get_model_name(camera_.get(), error.out()));
  return make_stream();
}

Result<void> AravisCamera::make_stream() {
  ArvCamera* camera = camera_.get();
  GErrorSlot error;
  const bool gige = arv_camera_is_gv_device(camera) != FALSE;
  if (gige) {
    arv_camera_gv_set_stream_options(
        camera, settings_.packet_socket ? ARV_GV_STREAM_OPTION_NONE : ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED);
    arv_camera_gv_set_packet_delay(camera, settings_.packet_delay_ns, error.out());
    if (error) return features_->failed("packet_delay_ns", error);
    if (settings_.packet_size != 0)
      if (const auto set = features_->set_integer("GevSCPSPacketSize", settings_.packet_size, "packet_size"); !set)
        return set;
    // Asked for, a size is tried by test packets; automatic, the largest that passes is searched.
    arv_camera_gv_set_packet_size_adjustment(camera, settings_.packet_size == 0
                                                         ? ARV_GV_PACKET_SIZE_ADJUSTMENT_ALWAYS
                                                         : ARV_GV_PACKET_SIZE_ADJUSTMENT_ON_FAILURE);
  }
  // The other mode announces no frames.
  if (!gige) arv_uv_device_set_usb_mode(ARV_UV_DEVICE(arv_camera_get_device(camera)), ARV_UV_USB_MODE_SYNC);
  stream_.reset(arv_camera_create_stream_full(
      camera,
      [](gpointer data, ArvStreamCallbackType type, ArvBuffer*) {
        if (type != ARV_STREAM_CALLBACK_TYPE_BUFFER_DONE) return;
        Events& events = **static_cast<std::shared_ptr<Events>*>(data);
        {
          const std::lock_guard lock(events.mutex);
          events.arrivals.push_back(events.clock.now());
        }
        events.changed.notify_all();
      },
      new std::shared_ptr<Events>(events_), [](gpointer data) { delete static_cast<std::shared_ptr<Events>*>(data); },
      error.out()));
  if (!stream_) return features_->failed("no stream", error);
  if (gige) {
    if (const auto checked = check_packet_size(); !checked) return checked;
    constexpr int bytes_per_kib = 1024, us_per_ms = 1000;
    if (!settings_.packet_resend)
      g_object_set(stream_.get(), "packet-resend", ARV_GV_STREAM_PACKET_RESEND_NEVER, nullptr);
    g_object_set(stream_.get(), "socket-buffer", ARV_GV_STREAM_SOCKET_BUFFER_FIXED, "socket-buffer-size",
                 settings_.socket_buffer_kib * bytes_per_kib, "packet-request-ratio", settings_.resend_ratio,
                 "packet-timeout", static_cast<guint>(settings_.packet_timeout_ms * us_per_ms), "frame-retention",
                 static_cast<guint>(settings_.frame_retention_ms * us_per_ms), nullptr);
    if (!settings_.packet_socket) enlarge_socket_buffer();
  }
  const guint payload = arv_camera_get_payload(camera, error.out());
  if (error) return features_->failed("payload", error);
  const size_t picture_bytes = static_cast<size_t>(picture_.width) * static_cast<size_t>(picture_.height) *
                               static_cast<size_t>(picture_.channels);
  if (payload < picture_bytes)
    return features_->refuse("pixel_format", "the camera sends " + std::to_string(payload) +
                                                 " bytes a frame, expected " + std::to_string(picture_bytes));
  pool_ = std::make_shared<BufferPool>(stream_.get(), payload, picture_.width, picture_.height, picture_.channels);
  pool_->grow_to(settings_.buffers != 0 ? static_cast<size_t>(settings_.buffers) : preview_buffers);
  return {};
}

Result<void> AravisCamera::check_packet_size() {
  GErrorSlot error;
  const gint passes = static_cast<gint>(arv_camera_gv_get_packet_size(camera_.get(), error.out()));
  if (error) return features_->failed("packet_size", error);
  if (settings_.packet_size == 0 && passes < usual_packet_size)
    warn("packet_size", "packets of more than " + std::to_string(passes) + " bytes do not pass the network, expected " +
                            std::to_string(usual_packet_size) +
                            " at least: small ones cost time, and frames may be late");
  if (settings_.packet_size == 0 || passes == settings_.packet_size) return {};
  return features_->refuse("packet_size", std::to_string(settings_.packet_size) + ", but packets of more than " +
                                              std::to_string(passes) +
                                              " bytes do not pass the network (its MTU may be too small)");
}

void AravisCamera::enlarge_socket_buffer() {
  // Aravis does it when the first packet of the first frame has arrived, which is too late for that frame.
  const int socket = find_socket(arv_gv_stream_get_port(ARV_GV_STREAM(stream_.get())));
  if (socket < 0) return;
  constexpr int bytes_per_kib = 1024;
  const int wanted = settings_.socket_buffer_kib * bytes_per_kib;
  int got = 0;
  socklen_t size = sizeof got;
  setsockopt(socket, SOL_SOCKET, SO_RCVBUF, &wanted, sizeof wanted);
  getsockopt(socket, SOL_SOCKET, SO_RCVBUF, &got, &size);
  got /= 2;  // Linux doubles what is asked for, and says so
  if (got < wanted)
    warn("socket_buffer_kib", std::to_string(settings_.socket_buffer_kib) + ", but the kernel allows " +
                                  std::to_string(got / bytes_per_kib) +
                                  ": frames may lose packets until net.core.rmem_max is raised to " +
                                  std::to_string(wanted));
}

/// @param topic     that which the sentence is about; a later one takes its place
/// @param sentence  empty: all is well again
void AravisCamera::warn(const std::string& topic, const std::string& sentence) {
  {
    const std::lock_guard lock(warnings_mutex_);
    if (sentence.empty()) {
      warnings_.erase(topic);
      return;
    }
    warnings_[topic] = topic + ": " + sentence;
  }
  if (warn_) warn_("camera " + settings_.id + ": " + topic + ": " + sentence);
}

std::vector<std::string> AravisCamera::warnings() const {
  const std::lock_guard lock(warnings_mutex_);
  std::vector<std::string> sentences;
  for (const auto& [topic, sentence] : warnings_) sentences.push_back(sentence);
  return sentences;
}

bool AravisCamera::is_lost() const {
  const std::lock_guard lock(events_->mutex);
  return events_->lost;
}

Error AravisCamera::lost() const {
  return {ErrorCode::device_lost,
          "camera " + settings_.id + (address_ ? " at " + to_text(*address_) : "") + " does not answer any more"};
}

void AravisCamera::announce_loss() {
  {
    const std::lock_guard lock(events_->mutex);
    events_->lost = true;
  }
  events_->changed.notify_all();
}

bool AravisCamera::still_answers() const { return !address_ || gvcp_answers(*address_, answer_patience); }

Result<void> AravisCamera::end_acquisition() {
  if (!std::exchange(acquiring_, false)) return {};
  return features_->execute("AcquisitionStop");
}

void AravisCamera::restart_reception() {
  // Cameras may number their frames from 1 again; a stream that goes on would take them for late ones of before.
  arv_stream_stop_thread(stream_.get(), FALSE);
  if (held_) pool_->give_back(std::exchange(held_, std::nullopt)->buffer);
  while (ArvBuffer* buffer = arv_stream_try_pop_buffer(stream_.get())) pool_->give_back(buffer);
  {
    const std::lock_guard lock(events_->mutex);
    events_->arrivals.clear();
  }
  arv_stream_start_thread(stream_.get());
}

Result<void> AravisCamera::switch_mode(CaptureMode mode) {
  if (applied_mode_ == mode) return {};
  applied_mode_.reset();
  const auto applied =
      mode == CaptureMode::preview ? apply_free_running(*features_, settings_) : apply_triggered(*features_, settings_);
  if (!applied) return applied;
  applied_mode_ = mode;
  return {};
}

Result<void> AravisCamera::apply_role(ShotRole role) {
  const bool pattern = role == ShotRole::gray_code;
  if (applied_role_ && (*applied_role_ == ShotRole::gray_code) == pattern) return {};
  applied_role_.reset();
  const double exposure =
      pattern ? settings_.pattern_exposure_us.value_or(settings_.exposure_us) : settings_.exposure_us;
  const double gain = pattern ? settings_.pattern_gain_db.value_or(settings_.gain_db) : settings_.gain_db;
  if (const auto set = apply_exposure(*features_, exposure); !set) return set;
  if (const auto set = apply_gain(*features_, gain); !set) return set;
  const auto got = features_->get_float(exposure_feature(*features_));
  if (!got) return got.error();
  exposure_us_ = *got;
  gain_db_ = gain;
  applied_role_ = role;
  return {};
}

void AravisCamera::read_device_clock() {
  // SFNC 2 and, before it, GigE Vision's own names.
  constexpr std::array<std::pair<const char*, const char*>, 2> names{
      {{"TimestampLatch", "TimestampLatchValue"}, {"GevTimestampControlLatch", "GevTimestampValue"}}};
  constexpr double ns_per_s = 1e9;
  for (const auto& [latch, value] : names) {
    if (!features_->has(latch) || !features_->has(value)) continue;
    // A busy machine may be slow to ask or to hear: the quickest of some answers is the one to trust.
    constexpr int most_questions = 4;
    constexpr Timestamp quick = milliseconds(1);
    Timestamp before = 0, after = INT64_MAX;
    int64_t ticks = 0;
    for (int i = 0; i < most_questions && after - before > quick; ++i) {
      const Timestamp asked = clock_.now();
      if (!features_->execute(latch)) return;
      const Timestamp answered = clock_.now();
      const auto latched = features_->get_integer(value);
      if (!latched) return;
      if (answered - asked < after - before) before = asked, after = answered, ticks = *latched;
    }
    GErrorSlot error;
    const guint64 frequency = arv_camera_is_gv_device(camera_.get()) != FALSE
                                  ? arv_gv_device_get_timestamp_tick_frequency(
                                        ARV_GV_DEVICE(arv_camera_get_device(camera_.get())), error.out())
                                  : static_cast<guint64>(ns_per_s);
    if (error || frequency == 0) return;
    const auto device_ns = std::llround(static_cast<double>(ticks) * (ns_per_s / static_cast<double>(frequency)));
    const std::lock_guard lock(clock_mutex_);
    device_clock_.note_reading(device_ns, before, after);
    return;
  }
}

void AravisCamera::supervise_ptp() {
  if (features_->has("DeviceTemperature"))
    if (const auto celsius = features_->get_float("DeviceTemperature")) {
      temperature_ = *celsius;
      has_temperature_ = true;
    }
  if (!settings_.ptp) return;
  const char* feature = features_->has("PtpStatus") ? "PtpStatus" : "GevIEEE1588Status";
  if (!features_->has(feature)) return;
  const auto status = features_->get_text(feature);
  if (!status) return;
  const bool ready = *status == "Slave" || *status == "Master";
  ptp_ready_ = ready ? 1 : 0;
  if (std::exchange(ptp_status_, *status) != *status)
    warn("ptp", ready ? "" : "its clock does not follow the network's, its state is " + *status);
  if (const auto masters = ptp_->note(settings_.id, *status); masters && warn_) warn_(*masters);
}

Result<void> AravisCamera::arm(const CaptureSettings& settings, int count) {
  worker_ = std::this_thread::get_id();
  if (is_lost()) return lost();
  if (settings.mode == CaptureMode::triggered && count < 1)
    return Error{ErrorCode::invalid_argument,
                 "camera " + settings_.id + ": cannot be armed for " + std::to_string(count) + " frames"};
  const std::lock_guard lock(control_);
  const auto failed = [&](const Error& error) {
    if (error.code != ErrorCode::device_lost) return error;
    announce_loss();
    return lost();
  };
  {
    const std::lock_guard events_lock(events_->mutex);
    events_->armed = false;
  }
  if (const auto ended = end_acquisition(); !ended) return failed(ended.error());
  if (const auto set = switch_mode(settings.mode); !set) return failed(set.error());
  if (const auto set = apply_role(settings.role); !set) return failed(set.error());
  read_device_clock();
  supervise_ptp();
  mode_ = settings.mode;
  preview_index_ = -1;
  if (settings_.buffers == 0 && mode_ == CaptureMode::triggered)
    pool_->grow_to(std::min(most_automatic_buffers, static_cast<size_t>(count) + spare_buffers));
  restart_reception();
  {
    const std::lock_guard events_lock(events_->mutex);
    events_->matcher.begin(count);
    events_->armed = true;
  }
  last_sign_of_life_ = clock_.now();
  acquiring_ = true;
  if (const auto begun = features_->execute("AcquisitionStart"); !begun) return failed(begun.error());
  return {};
}

void AravisCamera::stop() noexcept {
  bool waiting = false;
  {
    const std::lock_guard lock(events_->mutex);
    events_->armed = false;
    waiting = events_->waiting;
  }
  events_->changed.notify_all();
  // A camera that hangs takes seconds to say nothing. Only the thread that works with it waits for that: it ends the
  // acquisition on its way out of wait_frame, or at its next call.
  if (waiting || is_lost() || worker_ != std::this_thread::get_id()) return;
  const std::lock_guard lock(control_);
  if (!end_acquisition()) announce_loss();
}

void AravisCamera::note_trigger(int index, Timestamp when) noexcept {
  {
    const std::lock_guard lock(events_->mutex);
    events_->matcher.note_trigger(index, when);
  }
  events_->changed.notify_all();
}

std::optional<AravisCamera::Received> AravisCamera::receive() {
  Timestamp arrival = 0;
  {
    const std::lock_guard lock(events_->mutex);
    if (events_->arrivals.empty()) return std::nullopt;
    arrival = events_->arrivals.front();
    events_->arrivals.pop_front();
  }
  ArvBuffer* const buffer = arv_stream_try_pop_buffer(stream_.get());  // lay there before it was announced
  if (buffer == nullptr) return std::nullopt;
  last_sign_of_life_ = clock_.now();
  Received received{buffer, arv_buffer_get_frame_id(buffer), arrival};
  const auto device_ns = static_cast<int64_t>(arv_buffer_get_timestamp(buffer));
  const std::lock_guard lock(clock_mutex_);
  // Where the camera cannot be asked for its time: a frame arrives after its exposure at the earliest.
  if (!device_clock_.has_readings() && arv_buffer_get_status(buffer) == ARV_BUFFER_STATUS_SUCCESS)
    device_clock_.note_arrival(device_ns, arrival - static_cast<Timestamp>(exposure_us_ * 1000));
  received.exposed = device_clock_.host_time(device_ns).value_or(arrival);
  return received;
}

Result<Frame> AravisCamera::deliver(Received received, int index) {
  ++frames_;
  return Frame{.camera = settings_.id,
               .index = index,
               .timestamp_ns = received.exposed,
               .frame_id = received.frame_id,
               .exposure_us = exposure_us_,
               .gain_db = gain_db_,
               .pixels = pool_->lend(received.buffer),
               .mosaic = picture_.mosaic};
}

bool AravisCamera::holds_picture(const Received& received) const {
  return arv_buffer_get_status(received.buffer) == ARV_BUFFER_STATUS_SUCCESS &&
         arv_buffer_get_image_width(received.buffer) == picture_.width &&
         arv_buffer_get_image_height(received.buffer) == picture_.height;
}

std::optional<Result<Frame>> AravisCamera::judge(Received received) {
  if (!holds_picture(received)) {
    const std::string what = describe(arv_buffer_get_status(received.buffer));
    pool_->give_back(received.buffer);
    ++damaged_;
    const std::lock_guard lock(events_->mutex);
    events_->matcher.note_damaged();
    return Error{ErrorCode::invalid_file, "camera " + settings_.id + ": a frame arrived damaged: " + what};
  }
  const Timestamp triggered = received.exposed - static_cast<Timestamp>(settings_.trigger_delay_us * 1000);
  const Timestamp unsure = clock_uncertainty();
  FrameMatcher::Match match;
  {
    const std::lock_guard lock(events_->mutex);
    match = events_->matcher.match(received.frame_id, triggered, unsure, clock_.now());
  }
  if (match.verdict == FrameMatcher::Verdict::wait) {
    held_ = received;
    return std::nullopt;
  }
  if (match.slipped) ++slipped_;
  if (match.verdict == FrameMatcher::Verdict::answers) return deliver(received, match.index);
  ++unwanted_;
  pool_->give_back(received.buffer);
  return std::nullopt;
}

std::optional<Result<Frame>> AravisCamera::newest() {
  std::optional<Received> best;
  while (const auto received = receive()) {
    ++preview_index_;
    if (!holds_picture(*received)) {
      ++damaged_;
      pool_->give_back(received->buffer);
      continue;
    }
    if (best) pool_->give_back(best->buffer);
    best = received;
  }
  if (!best) return std::nullopt;
  return deliver(*best, preview_index_);
}

std::optional<Result<Frame>> AravisCamera::next() {
  if (mode_ == CaptureMode::preview) return newest();
  if (!held_) held_ = receive();
  if (!held_) return std::nullopt;
  return judge(*std::exchange(held_, std::nullopt));
}

Result<Frame> AravisCamera::wait_frame(Timestamp deadline) {
  std::unique_lock lock(events_->mutex);
  const ScopedFlag waiting(events_->waiting);
  const auto unlocked = [&](const auto& action) {
    lock.unlock();
    auto result = action();
    lock.lock();
    return result;
  };
  for (;;) {
    if (events_->lost) return lost();
    if (!events_->armed) {
      const auto ended = unlocked([&] {
        const std::lock_guard control(control_);
        return end_acquisition();
      });
      if (!ended && ended.error().code == ErrorCode::device_lost) events_->lost = true;
      return Error{ErrorCode::cancelled, "camera " + settings_.id + ": is not armed"};
    }
    if (auto frame = unlocked([&] { return next(); })) return *std::move(frame);
    const Timestamp now = clock_.now();
    if (!held_ && !events_->arrivals.empty()) continue;
    if (now >= deadline) return Error{ErrorCode::timeout, "camera " + settings_.id + ": no frame arrived in time"};
    const bool silent =
        now - last_sign_of_life_ > worrying_silence &&
        (mode_ == CaptureMode::preview ||
         events_->matcher.owes_answer(now - worrying_silence - static_cast<Timestamp>(exposure_us_ * 1000)));
    if (silent) {
      if (!unlocked([&] { return still_answers(); })) {
        events_->lost = true;
        continue;
      }
      last_sign_of_life_ = clock_.now();
    }
    Timestamp until = deadline;
    if (held_) until = std::min(until, events_->matcher.wait_until(held_->exposed));
    until = std::min(until, now + worrying_silence);
    events_->changed.wait_for(lock, std::chrono::nanoseconds(std::max<Timestamp>(until - now, 1)));
  }
}

Result<void> AravisCamera::fire_software() {
  {
    const std::lock_guard lock(events_->mutex);
    if (events_->lost) return lost();
    if (!events_->armed) return {};
  }
  const std::lock_guard lock(control_);
  return features_->execute("TriggerSoftware");
}

std::optional<int64_t> AravisCamera::device_time(Timestamp when) const {
  const std::lock_guard lock(clock_mutex_);
  return device_clock_.device_time(when);
}

Timestamp AravisCamera::clock_uncertainty() const {
  const std::lock_guard lock(clock_mutex_);
  return device_clock_.has_readings() ? device_clock_.uncertainty_ns() : 0;
}

Result<void> AravisCamera::check_presence() const {
  if (is_lost()) return lost();
  return {};
}

std::vector<Statistic> AravisCamera::statistics() const {
  std::vector<Statistic> statistics;
  const auto add = [&](const std::string& name, double value) { statistics.push_back({name, value}); };
  add("frames", static_cast<double>(frames_));
  add("damaged_frames", static_cast<double>(damaged_));
  add("unwanted_frames", static_cast<double>(unwanted_));
  add("slipped_triggers", static_cast<double>(slipped_));
  if (has_temperature_) add("temperature_c", temperature_);
  if (settings_.ptp) add("ptp_ready", ptp_ready_);
  {
    const std::lock_guard lock(clock_mutex_);
    if (device_clock_.has_readings()) {
      add("clock_drift_ppm", device_clock_.drift_ppm());
      add("clock_uncertainty_us", static_cast<double>(device_clock_.uncertainty_ns()) / 1000);
    }
  }
  ArvStream* stream = stream_.get();
  for (guint i = 0; i < arv_stream_get_n_infos(stream); ++i) {
    const bool is_real = arv_stream_get_info_type(stream, i) == G_TYPE_DOUBLE;
    add(arv_stream_get_info_name(stream, i),
        is_real ? arv_stream_get_info_double(stream, i) : static_cast<double>(arv_stream_get_info_uint64(stream, i)));
  }
  return statistics;
}

}  // namespace booth
