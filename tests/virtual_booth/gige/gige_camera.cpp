#include "tests/virtual_booth/gige/gige_camera.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cerrno>
#include <chrono>
#include <cstring>
#include <fstream>
#include <optional>
#include <random>
#include <sstream>
#include <system_error>
#include <utility>

namespace booth::virtual_booth {
namespace {

/// GVCP commands; the acknowledge of each is its number + 1.
enum Command : uint16_t {
  discovery = 0x0002,
  packet_resend = 0x0040,
  read_register = 0x0080,
  write_register = 0x0082,
  read_memory = 0x0084,
  write_memory = 0x0086,
  action = 0x0100
};
enum Status : uint16_t {
  success = 0,
  not_implemented = 0x8001,
  invalid_parameter = 0x8002,
  invalid_address = 0x8003,
  access_denied = 0x8006
};
constexpr uint16_t gvcp_port = 3956;
constexpr uint8_t acknowledge_asked = 0x01;
constexpr uint8_t scheduled = 0x80;  ///< an action command says when

/// Bootstrap registers of the standard, and the features' own, as camera.xml has them.
enum Register : uint32_t {
  version = 0x0000,
  device_mode = 0x0004,
  mac_high = 0x0008,
  mac_low = 0x000c,
  current_ip = 0x0024,
  manufacturer = 0x0048,
  model_name = 0x0068,
  serial_number = 0x00d8,
  first_url = 0x0200,
  interface_count = 0x0600,
  stream_channel_count = 0x0904,
  action_signal_count = 0x0908,
  action_device_key = 0x090c,
  gvcp_capability = 0x0934,
  heartbeat_timeout = 0x0938,
  tick_frequency = 0x093c,
  timestamp_control = 0x0944,
  timestamp_value = 0x0948,
  control_privilege = 0x0a00,
  stream_port = 0x0d00,
  stream_packet_size = 0x0d04,
  stream_packet_delay = 0x0d08,
  stream_destination = 0x0d18,
  stream_source_port = 0x0d1c,
  action_group = 0x9800,  ///< key and mask of each action, 16 bytes apart
  sensor_width = 0x8000,
  sensor_height = 0x8004,
  width = 0x8008,
  height = 0x800c,
  offset_x = 0x8010,
  offset_y = 0x8014,
  pixel_format = 0x8018,
  acquisition = 0x8020,
  frame_rate = 0x8028,
  trigger_mode = 0x8030,
  trigger_source = 0x8038,
  trigger_activation = 0x803c,
  trigger_delay = 0x8040,
  trigger_software = 0x8044,
  exposure_auto = 0x804c,
  exposure_time = 0x8050,
  exposure_limit = 0x8054,
  gain_auto = 0x8058,
  gain = 0x805c,
  balance_white_auto = 0x8060,
  balance_red = 0x8068,
  balance_blue = 0x806c,
  gamma_value = 0x8070,
  temperature = 0x8080,
  ptp_enable = 0x8084,
  ptp_status = 0x8088,
  offers_ptp = 0x8090,
  description = 0x20000
};
constexpr size_t memory_size = 0x40000;
constexpr uint32_t fire_test_packet = 0x80000000;
constexpr uint32_t source_line1 = 1, source_software = 16, source_action0 = 32;

enum PixelFormat : uint32_t {
  mono8 = 0x01080001,
  bayer_gr8 = 0x01080008,
  bayer_rg8 = 0x01080009,
  bayer_gb8 = 0x0108000a,
  bayer_bg8 = 0x0108000b,
  rgb8 = 0x02180014
};

struct Feature {
  const char* name;
  Register address;
  bool is_float;
};
constexpr Feature reported_features[] = {{"Width", width, false},
                                         {"Height", height, false},
                                         {"OffsetX", offset_x, false},
                                         {"OffsetY", offset_y, false},
                                         {"TriggerMode", trigger_mode, false},
                                         {"TriggerSource", trigger_source, false},
                                         {"TriggerActivation", trigger_activation, false},
                                         {"TriggerDelay", trigger_delay, true},
                                         {"ExposureAuto", exposure_auto, false},
                                         {"ExposureTime", exposure_time, true},
                                         {"GainAuto", gain_auto, false},
                                         {"Gain", gain, true},
                                         {"BalanceWhiteAuto", balance_white_auto, false},
                                         {"BalanceRatioRed", balance_red, true},
                                         {"BalanceRatioBlue", balance_blue, true},
                                         {"Gamma", gamma_value, true},
                                         {"GevSCPD", stream_packet_delay, false},
                                         {"GevSCPSPacketSize", stream_packet_size, false},
                                         {"GevHeartbeatTimeout", heartbeat_timeout, false},
                                         {"PtpEnable", ptp_enable, false}};

uint64_t monotonic_ns() {
  return static_cast<uint64_t>(
      std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch())
          .count());
}

uint16_t get16(const uint8_t* bytes) { return static_cast<uint16_t>(bytes[0] << 8 | bytes[1]); }
uint32_t get32(const uint8_t* bytes) { return static_cast<uint32_t>(get16(bytes)) << 16 | get16(bytes + 2); }
void put16(uint8_t* bytes, uint32_t value) {
  bytes[0] = static_cast<uint8_t>(value >> 8);
  bytes[1] = static_cast<uint8_t>(value);
}
void put32(uint8_t* bytes, uint32_t value) {
  put16(bytes, value >> 16);
  put16(bytes + 2, value);
}

class Socket {
 public:
  Socket() = default;
  /// Bound to that address. @throw std::system_error
  Socket(uint32_t address, uint16_t port, bool shared)
      : descriptor_(::socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0)) {
    const int on = 1;
    if (shared) setsockopt(descriptor_, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
    sockaddr_in name{};
    name.sin_family = AF_INET;
    name.sin_port = htons(port);
    name.sin_addr.s_addr = htonl(address);
    if (bind(descriptor_, reinterpret_cast<const sockaddr*>(&name), sizeof name) != 0) {
      const int reason = errno;
      close(descriptor_);
      throw std::system_error(reason, std::generic_category(),
                              std::string("bind ") + inet_ntoa(name.sin_addr) + ":" + std::to_string(port));
    }
  }
  Socket(Socket&& other) noexcept : descriptor_(std::exchange(other.descriptor_, -1)) {}
  Socket& operator=(Socket&& other) noexcept {
    std::swap(descriptor_, other.descriptor_);
    return *this;
  }
  ~Socket() {
    if (descriptor_ >= 0) close(descriptor_);
  }
  int get() const { return descriptor_; }

 private:
  int descriptor_ = -1;
};

bool same(const sockaddr_in& a, const sockaddr_in& b) {
  return a.sin_addr.s_addr == b.sin_addr.s_addr && a.sin_port == b.sin_port;
}

/// The channel (0 R, 1 G, 2 B) that a Bayer format samples at (x, y) of the image.
int bayer_channel(uint32_t format, int x, int y) {
  const bool odd_x = x % 2 != 0, odd_y = y % 2 != 0;
  switch (format) {
    case bayer_rg8: return odd_x == odd_y ? (odd_x ? 2 : 0) : 1;
    case bayer_bg8: return odd_x == odd_y ? (odd_x ? 0 : 2) : 1;
    case bayer_gr8: return odd_x == odd_y ? 1 : (odd_x ? 0 : 2);
    default: return odd_x == odd_y ? 1 : (odd_x ? 2 : 0);
  }
}

}  // namespace

/// The camera while it has power; only its thread touches it.
class GigeCamera::Device {
 public:
  Device(const GigeCameraOptions& options, std::function<void(const std::function<void(GigeCameraReport&)>&)> tell)
      : options_(options), tell_(std::move(tell)), address_(ntohl(inet_addr(options.address.c_str()))) {
    power_on();
  }

  void power_on() {
    if (powered_) return;
    control_ = Socket(address_, gvcp_port, false);
    broadcast_ = Socket(INADDR_BROADCAST, gvcp_port, true);
    stream_ = Socket(address_, 0, false);
    const int size = 8 << 20;
    setsockopt(stream_.get(), SOL_SOCKET, SO_SNDBUF, &size, sizeof size);
    powered_on_ns_ = monotonic_ns();
    block_id_ = 0;
    controller_.reset();
    acquiring_ = muted_ = false;
    pending_.reset();
    kept_.clear();
    reset_registers();
    powered_ = true;
  }
  void power_off() {
    powered_ = false;
    for (Socket* socket : {&control_, &broadcast_, &stream_}) *socket = Socket();
    acquiring_ = false;
    controller_.reset();
    pending_.reset();
    publish();
  }

  void pulse() {
    if (is_armed(source_line1))
      expose();
    else
      leave_unanswered();
  }
  void expose() { expose(monotonic_ns()); }
  void expose(uint64_t when) {
    if (!acquiring_ || pending_) return leave_unanswered();
    const auto delay_ns = static_cast<uint64_t>(real(trigger_delay) * 1000);
    const auto exposure_ns = static_cast<uint64_t>(real(exposure_time) * 1000);
    const uint64_t begin = when + delay_ns;
    pending_ = Exposure{begin, begin + exposure_ns};
    tell_([](GigeCameraReport& report) { ++report.exposures; });
  }

  /// Waits for something to do, at most until the next exposure ends or `most_ms`, and does it.
  void serve(int wake, int most_ms) {
    std::array<pollfd, 3> polled{pollfd{wake, POLLIN, 0}, pollfd{control_.get(), POLLIN, 0},
                                 pollfd{broadcast_.get(), POLLIN, 0}};
    timespec patience = until_next(most_ms);
    if (ppoll(polled.data(), polled.size(), &patience, nullptr) < 0 && errno != EINTR)
      throw std::system_error(errno, std::generic_category(), "ppoll");
    if (polled[0].revents != 0) {
      uint64_t count = 0;
      [[maybe_unused]] const ssize_t size = read(wake, &count, sizeof count);
    }
    if (polled[1].revents != 0) receive(control_);
    if (polled[2].revents != 0) receive(broadcast_);
    if (pending_ && monotonic_ns() >= pending_->end) send_frame();
    if (is_free_running() && !pending_ && monotonic_ns() >= next_free_) {
      next_free_ = std::max(next_free_ + static_cast<uint64_t>(1e9 / real(frame_rate)), monotonic_ns());
      expose();
    }
    if (controller_ && monotonic_ns() - heard_ns_ > uint64_t{1'000'000} * word(heartbeat_timeout)) release_control();
  }

  // Faults.
  double loss = 0;
  int lose_next = 0;
  bool swallow_next = false;
  bool cut_next = false;
  void see(std::vector<std::shared_ptr<const Image>> scenes) {
    scenes_ = std::move(scenes);
    wire_.assign(scenes_.size(), nullptr);
    next_scene_ = 0;
  }
  void mute(bool muted) { muted_ = muted; }
  void set_ptp(const std::string& status) {
    static const std::map<std::string, uint32_t> values = {{"Initializing", 1}, {"Faulty", 2}, {"Disabled", 3},
                                                           {"Listening", 4},    {"Master", 6}, {"Uncalibrated", 8},
                                                           {"Slave", 9}};
    write(ptp_status, values.at(status));
  }

  void publish() {
    tell_([&](GigeCameraReport& report) {
      report.controlled = controller_.has_value();
      report.acquiring = acquiring_;
      report.armed = powered_ && is_armed(source_line1);
    });
  }
  std::map<std::string, double> features() const {
    std::map<std::string, double> values;
    for (const Feature& feature : reported_features)
      values[feature.name] = feature.is_float ? real(feature.address) : word(feature.address);
    values["GevSCPSPacketSize"] = word(stream_packet_size) & 0xffff;
    values["PixelFormat"] = word(pixel_format);
    return values;
  }

 private:
  struct Exposure {
    uint64_t begin, end;
  };
  /// A frame as it goes over the wire, kept for resends.
  struct SentFrame {
    uint16_t id = 0;
    std::shared_ptr<const std::vector<uint8_t>> bytes;
    uint64_t timestamp = 0;
    uint32_t format = 0, width = 0, height = 0, x = 0, y = 0, packet_size = 0;
    uint32_t first_lost_for_good = UINT32_MAX;  ///< packets from this one on cannot be had again

    uint32_t room() const { return packet_size - 36; }
    uint32_t blocks() const { return (static_cast<uint32_t>(bytes->size()) + room() - 1) / room(); }
  };
  struct Packet {
    std::array<uint8_t, 48> head{};
    size_t head_size = 0;
    const uint8_t* body = nullptr;
    size_t body_size = 0;
  };

  uint32_t word(uint32_t address) const { return get32(memory_.data() + address); }
  void write(uint32_t address, uint32_t value) { put32(memory_.data() + address, value); }
  double real(uint32_t address) const { return std::bit_cast<float>(word(address)); }
  void write_real(uint32_t address, double value) {
    write(address, std::bit_cast<uint32_t>(static_cast<float>(value)));
  }
  void write_text(uint32_t address, const std::string& text, size_t room) {
    std::copy_n(text.begin(), std::min(text.size(), room - 1), memory_.begin() + address);
  }

  void reset_registers() {
    memory_.assign(memory_size, 0);
    write(version, 0x00010002);
    write(device_mode, 0x80000001);  // big-endian, UTF-8
    write(mac_high, 0x0256);
    write(mac_low, 0x42000000 | (address_ & 0xffff));
    write(current_ip, address_);
    write_text(manufacturer, "VirtualBooth", 32);
    write_text(model_name, options_.model, 32);
    write_text(serial_number, options_.serial, 16);
    write(interface_count, 1);
    write(stream_channel_count, 1);
    write(action_signal_count, 2);
    constexpr uint32_t writes_memory = 2, concatenates = 1, resends = 4, serial = 1u << 30, user_name = 1u << 31;
    write(gvcp_capability, user_name | serial | writes_memory | concatenates | (options_.resend ? resends : 0));
    write(heartbeat_timeout, 3000);
    write(tick_frequency, static_cast<uint32_t>(options_.tick_frequency >> 32));
    write(tick_frequency + 4, static_cast<uint32_t>(options_.tick_frequency));
    write(stream_packet_size, 576);
    std::ifstream file(BOOTH_SOURCE_DIR "/tests/virtual_booth/gige/camera.xml", std::ios::binary);
    std::stringstream xml;
    xml << file.rdbuf();
    std::string text = xml.str();
    if (const size_t feature = text.find("Name=\"" + options_.lacks + "\""); feature != std::string::npos)
      text.replace(feature, sizeof "Name=\"" - 1, "Name=\"Not");
    if (text.empty() || description + text.size() > memory_size) throw std::runtime_error("camera.xml cannot be read");
    write_text(description, text, text.size() + 1);
    std::stringstream url;
    url << "Local:camera.xml;" << std::hex << description << ";" << text.size();
    write_text(first_url, url.str(), 512);
    const Image& scene = *options_.scenes.front();
    write(sensor_width, static_cast<uint32_t>(scene.width));
    write(sensor_height, static_cast<uint32_t>(scene.height));
    write(width, static_cast<uint32_t>(scene.width));
    write(height, static_cast<uint32_t>(scene.height));
    write(pixel_format, mono8);
    write_real(frame_rate, 10);
    write(trigger_source, source_line1);
    write(exposure_auto, 2);  // as cameras come from the factory: everything automatic
    write(gain_auto, 2);
    write(balance_white_auto, 2);
    write_real(exposure_time, 5000);
    write_real(exposure_limit, options_.largest_exposure_us);
    write_real(balance_red, 1);
    write_real(balance_blue, 1);
    write_real(gamma_value, 1);
    write_real(temperature, 41.5);
    write(ptp_status, 3);
    write(offers_ptp, options_.offers_ptp ? 1 : 0);
  }

  bool is_armed(uint32_t source) const {
    return acquiring_ && word(trigger_mode) == 1 && word(trigger_source) == source;
  }
  bool is_free_running() const { return acquiring_ && word(trigger_mode) == 0; }
  void leave_unanswered() {
    tell_([](GigeCameraReport& report) { ++report.unanswered; });
  }
  timespec until_next(int most_ms) const {
    uint64_t wait = uint64_t{1'000'000} * static_cast<uint64_t>(most_ms);
    const uint64_t now = monotonic_ns();
    const auto bound = [&](uint64_t due) { wait = std::min(wait, due > now ? due - now : 0); };
    if (pending_) bound(pending_->end);
    if (is_free_running() && !pending_) bound(next_free_);
    return {static_cast<time_t>(wait / 1'000'000'000), static_cast<long>(wait % 1'000'000'000)};
  }
  double ticks_per_ns() const {
    return (1 + options_.clock_error_ppm * 1e-6) * (static_cast<double>(options_.tick_frequency) / 1e9);
  }
  uint64_t clock_zero() const { return options_.shares_clock ? 0 : powered_on_ns_; }
  uint64_t ticks(uint64_t monotonic) const {
    return static_cast<uint64_t>(static_cast<double>(monotonic - clock_zero()) * ticks_per_ns());
  }
  uint64_t monotonic_at(uint64_t ticks) const {
    return clock_zero() + static_cast<uint64_t>(static_cast<double>(ticks) / ticks_per_ns());
  }

  // The control channel.

  void receive(const Socket& socket) {
    std::array<uint8_t, 2048> in{}, out{};
    sockaddr_in from{};
    socklen_t from_size = sizeof from;
    const ssize_t received =
        recvfrom(socket.get(), in.data(), in.size(), 0, reinterpret_cast<sockaddr*>(&from), &from_size);
    if (received < 8 || in[0] != 0x42 || muted_) return;
    const uint16_t command = get16(in.data() + 2), size = get16(in.data() + 4);
    if (size > received - 8) return;
    tell_([](GigeCameraReport& report) { ++report.commands; });
    const bool is_controller = controller_ && same(*controller_, from);
    if (is_controller) heard_ns_ = monotonic_ns();

    uint16_t status = success;
    const uint8_t* data = in.data() + 8;
    const size_t answer = obey(command, in[1], data, size, !controller_ || is_controller, out.data() + 8, status);
    const bool wrote = status == success && (command == write_register || command == write_memory);
    if (wrote) react_to_write(from);
    if ((in[1] & acknowledge_asked) != 0 && command != packet_resend) {
      put16(out.data(), status);
      put16(out.data() + 2, command + 1u);
      put16(out.data() + 4, static_cast<uint32_t>(answer));
      put16(out.data() + 6, get16(in.data() + 6));
      sendto(control_.get(), out.data(), 8 + answer, 0, reinterpret_cast<const sockaddr*>(&from), sizeof from);
    }
    publish();
  }

  /// @return how many bytes of answer it wrote to `out`
  size_t obey(uint16_t command, uint8_t flags, const uint8_t* data, uint16_t size, bool may_write, uint8_t* out,
              uint16_t& status) {
    constexpr uint32_t largest_block = 536;
    switch (command) {
      case discovery: {
        constexpr size_t discovered = 0xf8;
        std::copy_n(memory_.begin(), discovered, out);
        return discovered;
      }
      case packet_resend:
        if (size >= 12 && options_.resend) resend(get16(data + 2), get32(data + 4), get32(data + 8));
        return 0;
      case read_register: {
        for (uint16_t i = 0; i + 4 <= size; i = static_cast<uint16_t>(i + 4)) {
          const uint32_t address = get32(data + i);
          if (address + 4 > memory_size) return status = invalid_address, 0;
          put32(out + i, word(address));
        }
        return size;
      }
      case read_memory: {
        if (size < 8) return status = invalid_parameter, 0;
        const uint32_t address = get32(data), count = get16(data + 6);
        if (count > largest_block) return status = invalid_parameter, 0;
        if (address + count > memory_size) return status = invalid_address, 0;
        put32(out, address);
        std::copy_n(memory_.begin() + address, count, out + 4);
        return 4 + count;
      }
      case write_register: {
        if (!may_write) return status = access_denied, 0;
        uint32_t written = 0;
        for (uint16_t i = 0; i + 8 <= size; i = static_cast<uint16_t>(i + 8), ++written)
          if (!write_checked(get32(data + i), get32(data + i + 4))) return status = invalid_address, 0;
        put32(out, written);
        return 4;
      }
      case write_memory: {
        if (!may_write) return status = access_denied, 0;
        if (size < 8 || size % 4 != 0) return status = invalid_parameter, 0;
        for (uint16_t i = 4; i < size; i = static_cast<uint16_t>(i + 4))
          if (!write_checked(get32(data) + i - 4, get32(data + i))) return status = invalid_address, 0;
        put32(out, size - 4u);
        return 4;
      }
      case action:
        if (size < 12 || ((flags & scheduled) != 0 && size < 20)) return status = invalid_parameter, 0;
        act(get32(data), get32(data + 4), get32(data + 8),
            (flags & scheduled) != 0 ? monotonic_at(uint64_t{get32(data + 12)} << 32 | get32(data + 16))
                                     : monotonic_ns(),
            status);
        return 0;
      default: return status = not_implemented, 0;
    }
  }

  bool write_checked(uint32_t address, uint32_t value) {
    if (address + 4 > memory_size || address % 4 != 0) return false;
    for (const Feature& feature : reported_features)
      if (feature.name == options_.keeps && feature.address == address) return true;
    if (address == stream_packet_size && (value & fire_test_packet) != 0) {
      value &= ~fire_test_packet;
      const uint32_t size = value & 0xffff;
      if (size > 28 && size <= static_cast<uint32_t>(options_.path_mtu)) {
        const std::vector<uint8_t> test(size - 28);
        const sockaddr_in to = destination();
        sendto(stream_.get(), test.data(), test.size(), 0, reinterpret_cast<const sockaddr*>(&to), sizeof to);
      }
    }
    if (address == timestamp_control && (value & 2) != 0) {
      const uint64_t now = ticks(monotonic_ns());
      write(timestamp_value, static_cast<uint32_t>(now >> 32));
      write(timestamp_value + 4, static_cast<uint32_t>(now));
    }
    write(address, value);
    return true;
  }

  void react_to_write(const sockaddr_in& from) {
    const bool privileged = (word(control_privilege) & 3) != 0;
    if (!controller_ && privileged) {
      controller_ = from;
      heard_ns_ = monotonic_ns();
    } else if (controller_ && !privileged) {
      release_control();
    }
    const bool wanted = controller_ && word(acquisition) != 0;
    if (wanted && !acquiring_) {
      acquiring_ = true;
      kept_.clear();
      if (options_.counts_from_acquisition) block_id_ = 0;
      next_free_ = monotonic_ns();
    } else if (!wanted) {
      acquiring_ = false;
      pending_.reset();
    }
    if (word(trigger_software) != 0) {
      write(trigger_software, 0);
      if (is_armed(source_software))
        expose();
      else
        leave_unanswered();
    }
  }

  void release_control() {
    controller_.reset();
    write(control_privilege, 0);
    write(acquisition, 0);
    acquiring_ = false;
    pending_.reset();
    publish();
  }

  void act(uint32_t device_key, uint32_t group_key, uint32_t group_mask, uint64_t when, uint16_t& status) {
    for (uint32_t i = 0; i < word(action_signal_count); ++i) {
      const uint32_t group = action_group + 16 * i;
      if (device_key != word(action_device_key) || group_key != word(group) || (group_mask & word(group + 4)) == 0)
        continue;
      if (is_armed(source_action0 + i)) return expose(when);
    }
    status = invalid_parameter;
    leave_unanswered();
  }

  // The stream channel.

  sockaddr_in destination() const {
    sockaddr_in to{};
    to.sin_family = AF_INET;
    to.sin_addr.s_addr = htonl(word(stream_destination));
    to.sin_port = htons(static_cast<uint16_t>(word(stream_port)));
    return to;
  }

  /// The next scene, cut to the region and sampled as the pixel format says.
  std::shared_ptr<const std::vector<uint8_t>> read_sensor() {
    const std::array<uint32_t, 5> settings{word(pixel_format), word(width), word(height), word(offset_x),
                                           word(offset_y)};
    if (settings != wire_settings_) wire_.assign(scenes_.size(), nullptr);
    wire_settings_ = settings;
    const size_t number = next_scene_++ % scenes_.size();
    if (wire_[number]) return wire_[number];
    const Image& scene = *scenes_[number];
    auto bytes = std::make_shared<std::vector<uint8_t>>();
    bytes->reserve(size_t{settings[1]} * settings[2] * (settings[0] == rgb8 ? 3 : 1));
    for (int y = 0; y < static_cast<int>(settings[2]); ++y) {
      for (int x = 0; x < static_cast<int>(settings[1]); ++x) {
        const uint8_t* pixel = scene.pixel(x + static_cast<int>(settings[3]), y + static_cast<int>(settings[4]));
        if (settings[0] == rgb8)
          for (int c = 0; c < 3; ++c) bytes->push_back(scene.channels == 3 ? pixel[c] : pixel[0]);
        else if (settings[0] == mono8 || scene.channels == 1)
          bytes->push_back(scene.channels == 3 ? pixel[1] : pixel[0]);
        else
          bytes->push_back(pixel[bayer_channel(settings[0], x, y)]);
      }
    }
    return wire_[number] = bytes;
  }

  /// Block `number` of a frame: 0 the leader, then the payload, then the trailer.
  static Packet make_packet(const SentFrame& frame, uint32_t number, bool again) {
    constexpr uint32_t leader = 1, trailer = 2, payload = 3, image = 1, resent = 0x0100;
    const uint32_t blocks = frame.blocks();
    Packet packet;
    uint8_t* head = packet.head.data();
    put16(head, again ? resent : 0);
    put16(head + 2, frame.id);
    put32(head + 4, (number == 0 ? leader : number <= blocks ? payload : trailer) << 24 | number);
    uint8_t* data = head + 8;
    packet.head_size = 8;
    if (number == 0) {
      put16(data + 2, image);
      put32(data + 4, static_cast<uint32_t>(frame.timestamp >> 32));
      put32(data + 8, static_cast<uint32_t>(frame.timestamp));
      put32(data + 12, frame.format);
      put32(data + 16, frame.width);
      put32(data + 20, frame.height);
      put32(data + 24, frame.x);
      put32(data + 28, frame.y);
      packet.head_size += 36;
    } else if (number <= blocks) {
      const size_t offset = size_t{number - 1} * frame.room();
      packet.body = frame.bytes->data() + offset;
      packet.body_size = std::min<size_t>(frame.room(), frame.bytes->size() - offset);
    } else {
      put16(data + 2, image);
      put32(data + 4, frame.height);
      packet.head_size += 8;
    }
    return packet;
  }

  bool is_lost() { return loss > 0 && std::uniform_real_distribution<double>()(random_) < loss; }

  void send_frame() {
    const Exposure exposure = *std::exchange(pending_, std::nullopt);
    SentFrame frame;
    if (++block_id_ == 0) block_id_ = 1;
    frame.id = block_id_;
    frame.bytes = read_sensor();
    frame.timestamp = ticks(exposure.begin);
    frame.format = word(pixel_format);
    frame.width = word(width);
    frame.height = word(height);
    frame.x = word(offset_x);
    frame.y = word(offset_y);
    frame.packet_size = word(stream_packet_size) & 0xffff;
    if (std::exchange(swallow_next, false) || muted_) return;
    if (std::exchange(cut_next, false)) frame.first_lost_for_good = frame.blocks() / 2;

    const uint32_t count = frame.blocks() + 2;
    const auto to_lose = static_cast<uint32_t>(std::exchange(lose_next, 0));
    const uint32_t stride = to_lose > 0 ? std::max(1u, (count - 2) / (to_lose + 1)) : 0;
    const bool too_large = frame.packet_size > static_cast<uint32_t>(options_.path_mtu);
    std::vector<Packet> batch;
    uint64_t lost = 0;
    constexpr size_t largest_batch = 64;
    for (uint32_t number = 0; number < count; ++number) {
      Packet packet = make_packet(frame, number, false);
      const bool chosen = stride > 0 && number > 0 && number % stride == 0 && number / stride <= to_lose;
      if (chosen || is_lost() || number >= frame.first_lost_for_good || (too_large && packet.body_size == frame.room()))
        ++lost;
      else
        batch.push_back(packet);
      if (batch.size() == largest_batch || number + 1 == count) lost += send(batch);
    }
    tell_([&](GigeCameraReport& report) {
      report.packets_sent += count - lost;
      report.packets_lost += lost;
    });
    constexpr size_t frames_kept = 8;
    kept_.push_back(std::move(frame));
    if (kept_.size() > frames_kept) kept_.pop_front();
  }

  /// Sends and empties a batch. @return how many packets the operating system did not take
  uint64_t send(std::vector<Packet>& batch) {
    std::vector<std::array<iovec, 2>> parts(batch.size());
    std::vector<mmsghdr> messages(batch.size());
    sockaddr_in to = destination();
    for (size_t i = 0; i < batch.size(); ++i) {
      parts[i] = {iovec{batch[i].head.data(), batch[i].head_size},
                  iovec{const_cast<uint8_t*>(batch[i].body), batch[i].body_size}};
      messages[i] = {};
      messages[i].msg_hdr.msg_iov = parts[i].data();
      messages[i].msg_hdr.msg_iovlen = batch[i].body_size > 0 ? 2 : 1;
      messages[i].msg_hdr.msg_name = &to;
      messages[i].msg_hdr.msg_namelen = sizeof to;
    }
    uint64_t refused = 0;
    for (size_t sent = 0; sent < messages.size();) {
      const int now = sendmmsg(stream_.get(), messages.data() + sent, static_cast<unsigned>(messages.size() - sent), 0);
      if (now > 0) {
        sent += static_cast<size_t>(now);
      } else if (errno == EAGAIN || errno == ENOBUFS) {
        pollfd writable{stream_.get(), POLLOUT, 0};
        poll(&writable, 1, 10);
      } else {
        ++sent;
        ++refused;
      }
    }
    batch.clear();
    return refused;
  }

  void resend(uint16_t id, uint32_t first, uint32_t last) {
    const auto found = std::find_if(kept_.begin(), kept_.end(), [&](const SentFrame& f) { return f.id == id; });
    if (found == kept_.end() || !acquiring_) return;
    last = std::min({last & 0xffffff, found->blocks() + 1, found->first_lost_for_good - 1});
    std::vector<Packet> batch;
    for (uint32_t number = first & 0xffffff; number <= last; ++number)
      if (!is_lost()) batch.push_back(make_packet(*found, number, true));
    tell_([&](GigeCameraReport& report) { report.packets_resent += batch.size(); });
    send(batch);
  }

  const GigeCameraOptions& options_;
  const std::function<void(const std::function<void(GigeCameraReport&)>&)> tell_;
  const uint32_t address_;
  bool powered_ = false, acquiring_ = false, muted_ = false;
  Socket control_, broadcast_, stream_;
  std::vector<uint8_t> memory_;
  std::optional<sockaddr_in> controller_;
  uint64_t heard_ns_ = 0, powered_on_ns_ = 0, next_free_ = 0;
  std::optional<Exposure> pending_;
  uint16_t block_id_ = 0;
  std::vector<std::shared_ptr<const Image>> scenes_ = options_.scenes;
  size_t next_scene_ = 0;
  std::array<uint32_t, 5> wire_settings_{};
  std::vector<std::shared_ptr<const std::vector<uint8_t>>> wire_;
  std::deque<SentFrame> kept_;
  std::minstd_rand random_{12345};
};

GigeCamera::GigeCamera(GigeCameraOptions options)
    : options_(std::move(options)), wake_(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)) {
  if (options_.scenes.empty()) throw std::invalid_argument("a camera needs something to see");
  auto failed = std::make_shared<std::exception_ptr>();
  thread_ = std::jthread([this, failed](const std::stop_token& stop) {
    try {
      run(stop);
    } catch (...) {
      const std::lock_guard lock(mutex_);
      *failed = std::current_exception();
      ++done_;
    }
    carried_out_.notify_all();
  });
  std::unique_lock lock(mutex_);
  carried_out_.wait(lock, [&] { return done_ > 0; });
  if (*failed) {
    lock.unlock();
    thread_.join();
    close(wake_);
    std::rethrow_exception(*failed);
  }
}

GigeCamera::~GigeCamera() {
  thread_.request_stop();
  eventfd_write(wake_, 1);
  thread_.join();
  close(wake_);
}

void GigeCamera::run(const std::stop_token& stop) {
  Device device(options_, [this](const std::function<void(GigeCameraReport&)>& change) {
    const std::lock_guard lock(mutex_);
    change(report_);
  });
  {
    const std::lock_guard lock(mutex_);
    posted_ = done_ = 1;
  }
  carried_out_.notify_all();
  constexpr int idle_ms = 100;
  while (!stop.stop_requested()) {
    device.serve(wake_, idle_ms);
    std::deque<std::function<void(Device&)>> orders;
    {
      const std::lock_guard lock(mutex_);
      orders.swap(orders_);
    }
    for (const auto& order : orders) order(device);
    auto features = device.features();
    {
      const std::lock_guard lock(mutex_);
      done_ += orders.size();
      features_ = std::move(features);
    }
    if (!orders.empty()) carried_out_.notify_all();
  }
}

void GigeCamera::post(std::function<void(Device&)> order) {
  std::unique_lock lock(mutex_);
  orders_.push_back(std::move(order));
  const uint64_t mine = ++posted_;
  eventfd_write(wake_, 1);
  carried_out_.wait(lock, [&] { return done_ >= mine; });
}

void GigeCamera::pulse() {
  const std::lock_guard lock(mutex_);
  orders_.push_back([](Device& device) { device.pulse(); });
  ++posted_;
  eventfd_write(wake_, 1);
}
void GigeCamera::see(std::vector<std::shared_ptr<const Image>> scenes) {
  post([&](Device& device) { device.see(std::move(scenes)); });
}
void GigeCamera::lose_packets(double share) {
  post([=](Device& device) { device.loss = share; });
}
void GigeCamera::lose_of_next_frame(int packets) {
  post([=](Device& device) { device.lose_next = packets; });
}
void GigeCamera::swallow_next_frame() {
  post([](Device& device) { device.swallow_next = true; });
}
void GigeCamera::cut_next_frame() {
  post([](Device& device) { device.cut_next = true; });
}
void GigeCamera::expose_untriggered() {
  post([](Device& device) { device.expose(); });
}
void GigeCamera::mute(bool muted) {
  post([=](Device& device) { device.mute(muted); });
}
void GigeCamera::power_off() {
  post([](Device& device) { device.power_off(); });
}
void GigeCamera::power_on() {
  post([](Device& device) { device.power_on(); });
}
void GigeCamera::set_ptp_status(const std::string& status) {
  post([=](Device& device) { device.set_ptp(status); });
}

GigeCameraReport GigeCamera::report() const {
  const std::lock_guard lock(mutex_);
  return report_;
}

double GigeCamera::feature(const std::string& name) const {
  const std::lock_guard lock(mutex_);
  return features_.at(name);
}

}  // namespace booth::virtual_booth
