#include "tests/virtual_booth/guest/usb_camera_peer.h"

#include <arpa/inet.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <utility>

namespace booth {
namespace {

namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;
using Bytes = std::vector<uint8_t>;

constexpr const char* controller = "/sys/devices/platform/vhci_hcd.0";
constexpr size_t payload = 16384;  ///< of one bulk transfer
constexpr size_t payload_header = 12;
constexpr uint32_t intervals[] = {333'333, 666'666, 1'000'000};  ///< in units of 100 ns

// USB/IP commands.
constexpr uint32_t cmd_submit = 1, cmd_unlink = 2, ret_submit = 3, ret_unlink = 4;
constexpr size_t message_size = 48;

// UVC requests.
constexpr uint8_t set_cur = 0x01, get_cur = 0x81, get_min = 0x82, get_max = 0x83, get_res = 0x84, get_len = 0x85,
                  get_info = 0x86, get_def = 0x87;
constexpr size_t parameters_size = 26;  ///< of UVC 1.0's probe and commit

void append(Bytes& bytes, std::initializer_list<int> values) {
  for (const int value : values) bytes.push_back(static_cast<uint8_t>(value));
}
void put(Bytes& bytes, size_t at, uint32_t value, size_t size) {
  for (size_t i = 0; i < size; ++i) bytes[at + i] = static_cast<uint8_t>(value >> (8 * i));
}
void append(Bytes& bytes, uint32_t value, size_t size) {
  bytes.resize(bytes.size() + size);
  put(bytes, bytes.size() - size, value, size);
}
uint32_t get(const uint8_t* bytes, size_t size) {
  uint32_t value = 0;
  for (size_t i = size; i-- > 0;) value = value << 8 | bytes[i];
  return value;
}

bool read_all(int fd, void* data, size_t size) {
  auto* at = static_cast<uint8_t*>(data);
  while (size > 0) {
    const ssize_t got = ::read(fd, at, size);
    if (got <= 0) return false;
    at += got;
    size -= static_cast<size_t>(got);
  }
  return true;
}
bool write_all(int fd, const Bytes& data) {
  size_t at = 0;
  while (at < data.size()) {
    const ssize_t put = ::send(fd, data.data() + at, data.size() - at, MSG_NOSIGNAL);
    if (put <= 0) return false;
    at += static_cast<size_t>(put);
  }
  return true;
}

/// The GUID of an uncompressed format: its code, then what is common to all.
Bytes guid(const std::string& fourcc) {
  const std::string code = fourcc == "YUYV" ? "YUY2" : fourcc == "GREY" ? "Y800" : fourcc;
  Bytes bytes(code.begin(), code.end());
  append(bytes, {0, 0, 0x10, 0, 0x80, 0, 0, 0xAA, 0, 0x38, 0x9B, 0x71});
  return bytes;
}

/// The first capture node of the device with that serial number; empty where there is none.
std::string find_node(const std::string& serial) {
  std::vector<std::string> found;
  std::error_code error;
  for (fs::directory_iterator entry("/sys/class/video4linux", error), end; !error && entry != end;
       entry.increment(error)) {
    std::string text;
    std::ifstream(entry->path() / "device/../serial") >> text;
    int index = -1;
    std::ifstream(entry->path() / "index") >> index;
    const std::string node = "/dev/" + entry->path().filename().string();
    if (text == serial && index == 0 && fs::exists(node)) found.push_back(node);
  }
  return found.empty() ? std::string() : found.front();
}

/// Waits for what the kernel does by itself; it has no event to wait for.
template <class Condition>
bool eventually(Condition condition) {
  const auto deadline = Clock::now() + std::chrono::seconds(120);
  while (!condition()) {
    if (Clock::now() > deadline) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  return true;
}

}  // namespace

UsbCameraPeer::UsbCameraPeer(std::string serial, std::vector<Mode> modes, bool free_running)
    : serial_(std::move(serial)),
      modes_(std::move(modes)),
      free_running_(free_running),
      controls_{{1, 2, 1, 1, 8, 9, 8, 8},          // exposure mode: bits for manual and automatic; now automatic
                {1, 4, 4, 1, 10000, 1, 100, 100},  // exposure time, 100 µs
                {2, 4, 2, 0, 255, 1, 0, 0}} {      // gain
  describe();
}

UsbCameraPeer::~UsbCameraPeer() { unplug(); }

size_t UsbCameraPeer::frame_size(const Mode& mode) const {
  const auto pixels = static_cast<size_t>(mode.width) * static_cast<size_t>(mode.height);
  return mode.fourcc == "MJPG" || mode.fourcc == "YUYV" ? pixels * 2 : pixels;
}

void UsbCameraPeer::describe() {
  Bytes& c = configuration_;
  append(c, {9, 2, 0, 0, 2, 1, 0, 0x80, 250});  // configuration of two interfaces
  append(c, {8, 11, 0, 2, 0x0E, 3, 0, 2});      // which belong together: a video function
  append(c, {9, 4, 0, 0, 0, 0x0E, 1, 0, 2});    // the control interface
  append(c, {13, 0x24, 1, 0x00, 0x01, 13 + 18 + 11 + 9, 0, 0x40, 0x42, 0x0F, 0, 1, 1});  // its header, clock 1 MHz
  append(c, {18, 0x24, 2, 1, 1, 2, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0x0A, 0, 0});  // camera: exposure mode and time
  append(c, {11, 0x24, 5, 2, 1, 0, 0, 2, 0x00, 0x02, 0});                    // processing unit: gain
  append(c, {9, 0x24, 3, 3, 1, 1, 0, 2, 0});                                 // output terminal
  append(c, {9, 4, 1, 0, 1, 0x0E, 2, 0, 0});                                 // the streaming interface
  const size_t header = c.size();
  const int formats = static_cast<int>(modes_.size());
  append(c, {13 + formats, 0x24, 1, formats, 0, 0, 0x81, 0, 3, 0, 0, 0, 1});
  for (int i = 0; i < formats; ++i) append(c, {0});
  for (int i = 0; i < formats; ++i) {
    const Mode& mode = modes_[static_cast<size_t>(i)];
    const bool jpeg = mode.fourcc == "MJPG";
    if (jpeg) {
      append(c, {11, 0x24, 6, i + 1, 1, 0, 1, 0, 0, 0, 0});
    } else {
      append(c, {27, 0x24, 4, i + 1, 1});
      for (const uint8_t byte : guid(mode.fourcc)) append(c, {byte});
      append(c, {mode.fourcc == "YUYV" ? 16 : 8, 1, 0, 0, 0, 0});
    }
    const auto size = static_cast<uint32_t>(frame_size(mode));
    append(c, {26 + 4 * static_cast<int>(std::size(intervals)), 0x24, jpeg ? 7 : 5, 1, 0});
    append(c, static_cast<uint32_t>(mode.width), 2);
    append(c, static_cast<uint32_t>(mode.height), 2);
    append(c, size * 8, 4);  // least and most bits a second, which nobody holds it to
    append(c, size * 240, 4);
    append(c, size, 4);
    append(c, intervals[0], 4);
    append(c, {static_cast<int>(std::size(intervals))});
    for (const uint32_t interval : intervals) append(c, interval, 4);
    append(c, {6, 0x24, 0x0D, 1, 1, 4});  // colours: sRGB
  }
  put(c, header + 4, static_cast<uint32_t>(c.size() - header), 2);
  append(c, {7, 5, 0x81, 2, 0, 2, 0});  // bulk endpoint, 512 bytes a packet
  put(c, 2, static_cast<uint32_t>(c.size()), 2);
}

Bytes UsbCameraPeer::stream_parameters(int format, uint32_t interval) const {
  format = std::clamp(format, 1, static_cast<int>(modes_.size()));
  uint32_t offered = intervals[0];
  for (const uint32_t candidate : intervals)
    if (interval >= candidate) offered = candidate;
  Bytes parameters(parameters_size, 0);
  parameters[2] = static_cast<uint8_t>(format);
  parameters[3] = 1;
  put(parameters, 4, offered, 4);
  put(parameters, 18, static_cast<uint32_t>(frame_size(modes_[static_cast<size_t>(format - 1)])), 4);
  put(parameters, 22, payload, 4);
  return parameters;
}

std::optional<std::string> UsbCameraPeer::plug_in() {
  int pair[2];
  if (::socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, pair) != 0) throw std::runtime_error("no socket pair");
  {
    const std::lock_guard lock(mutex_);
    socket_ = pair[1];
    streaming_ = sends_ = false;
    fault_ = Fault::none;
    pending_.clear();
    for (Control& control : controls_) control.value = control.initial;
    probe_ = commit_ = stream_parameters(1, 0);
  }
  std::ifstream status(std::string(controller) + "/status");
  std::string line;
  int port = -1;
  while (port < 0 && std::getline(status, line)) {
    int number = 0, state = 0;
    constexpr int port_is_free = 4;
    if (std::sscanf(line.c_str(), "hs %d %d", &number, &state) == 2 && state == port_is_free) port = number;
  }
  constexpr int high_speed = 3;
  std::ofstream attach(std::string(controller) + "/attach");
  attach << port << " " << pair[0] << " " << (0x10000 + port + 1) << " " << high_speed << std::flush;
  ::close(pair[0]);
  if (port < 0 || !attach) throw std::runtime_error("vhci-hcd has no port for " + serial_);
  thread_ = std::jthread([this] { run(); });
  std::string node;
  if (!eventually([&] { return !(node = find_node(serial_)).empty(); })) return std::nullopt;
  return node;
}

void UsbCameraPeer::unplug() {
  if (!thread_.joinable()) return;
  {
    const std::lock_guard lock(mutex_);
    ::shutdown(socket_, SHUT_RDWR);
  }
  thread_.join();
  {
    const std::lock_guard lock(mutex_);
    ::close(std::exchange(socket_, -1));
    streaming_ = false;
  }
  eventually([&] { return find_node(serial_).empty(); });
}

void UsbCameraPeer::set_frames(std::vector<Bytes> frames) {
  const std::lock_guard lock(mutex_);
  frames_ = std::move(frames);
  next_frame_ = 0;
}

void UsbCameraPeer::expose() {
  const std::lock_guard lock(mutex_);
  begin_frame();
}

void UsbCameraPeer::fail_next(Fault fault) {
  const std::lock_guard lock(mutex_);
  fault_ = fault;
}

int UsbCameraPeer::exposed() const {
  const std::lock_guard lock(mutex_);
  return exposed_;
}

int UsbCameraPeer::missed() const {
  const std::lock_guard lock(mutex_);
  return missed_;
}

uint32_t UsbCameraPeer::control(int entity, int selector) const {
  const std::lock_guard lock(mutex_);
  for (const Control& control : controls_)
    if (control.entity == entity && control.selector == selector) return control.value;
  throw std::invalid_argument("no such control");
}

void UsbCameraPeer::run() {
  auto due = Clock::now();
  while (true) {
    int64_t wait_ms = -1;
    {
      const std::lock_guard lock(mutex_);
      if (free_running_ && streaming_) {
        if (Clock::now() >= due) {
          if (!sends_) begin_frame();
          due = std::max(due + std::chrono::nanoseconds(interval_ns_), Clock::now());
        }
        wait_ms = std::chrono::duration_cast<std::chrono::milliseconds>(due - Clock::now()).count() + 1;
      }
    }
    pollfd polled{socket_, POLLIN, 0};
    const int ready = ::poll(&polled, 1, static_cast<int>(std::max<int64_t>(wait_ms, -1)));
    if (ready > 0 && !serve()) return;
  }
}

bool UsbCameraPeer::serve() {
  Request request;
  static_assert(sizeof request == message_size);
  if (!read_all(socket_, &request, sizeof request)) return false;
  request.command = ntohl(request.command);
  request.sequence = ntohl(request.sequence);
  request.direction = ntohl(request.direction);
  request.endpoint = ntohl(request.endpoint);
  for (uint32_t& word : request.words) word = ntohl(word);
  const bool to_host = request.direction == 1;
  Bytes data;
  if (request.command == cmd_submit && !to_host) {
    data.resize(request.words[1]);
    if (!data.empty() && !read_all(socket_, data.data(), data.size())) return false;
  }
  const std::lock_guard lock(mutex_);
  if (request.command == cmd_submit) {
    if (request.endpoint == 0) {
      answer_control(request, data);
    } else if (request.endpoint == 1 && to_host) {
      pending_.push_back({request.sequence, request.words[1]});
      pump();
    } else {
      reply(request.sequence, -EPIPE, {}, 0);
    }
    return true;
  }
  if (request.command != cmd_unlink) return false;
  const auto victim = std::find_if(pending_.begin(), pending_.end(),
                                   [&](const Pending& pending) { return pending.sequence == request.words[0]; });
  const bool found = victim != pending_.end();
  if (found) pending_.erase(victim);
  Bytes message(message_size, 0);
  const uint32_t words[] = {
      htonl(ret_unlink), htonl(request.sequence), 0, 0, 0, htonl(static_cast<uint32_t>(found ? -ECONNRESET : 0))};
  std::memcpy(message.data(), words, sizeof words);
  return write_all(socket_, message);
}

void UsbCameraPeer::reply(uint32_t sequence, int status, const Bytes& data, uint32_t length) {
  Bytes message(message_size, 0);
  const uint32_t words[] = {htonl(ret_submit),
                            htonl(sequence),
                            0,
                            0,
                            0,
                            htonl(static_cast<uint32_t>(status)),
                            htonl(length),
                            0,
                            htonl(static_cast<uint32_t>(-1)),
                            0};
  std::memcpy(message.data(), words, sizeof words);
  message.insert(message.end(), data.begin(), data.end());
  write_all(socket_, message);  // where it fails, the next read ends the thread
}

void UsbCameraPeer::answer_control(const Request& request, const Bytes& data) {
  const bool to_host = (request.setup[0] & 0x80) != 0;
  const bool of_class = (request.setup[0] & 0x60) == 0x20;
  auto answer = of_class ? class_request(request, data) : standard_request(request);
  if (!answer) return reply(request.sequence, -EPIPE, {}, 0);
  if (!to_host) return reply(request.sequence, 0, {}, request.words[1]);
  answer->resize(std::min<size_t>(answer->size(), request.words[1]));
  reply(request.sequence, 0, *answer, static_cast<uint32_t>(answer->size()));
}

std::optional<Bytes> UsbCameraPeer::standard_request(const Request& request) {
  constexpr uint8_t get_status = 0, clear_feature = 1, set_feature = 3, get_descriptor = 6, get_configuration = 8,
                    set_configuration = 9, get_interface = 10, set_interface = 11;
  const uint8_t type = request.setup[3], index = request.setup[2];
  switch (request.setup[1]) {
    case get_descriptor: {
      constexpr uint8_t device = 1, configuration = 2, string = 3;
      if (type == device) return Bytes{18, 1, 0, 2, 0xEF, 2, 1, 64, 0x09, 0x12, 1, 0, 0, 1, 1, 2, 3, 1};
      if (type == configuration) return configuration_;
      if (type != string) return std::nullopt;
      if (index == 0) return Bytes{4, 3, 9, 4};  // US English
      const std::string texts[] = {"Avatar Booth", "Virtual Camera", serial_};
      if (index > std::size(texts)) return std::nullopt;
      Bytes text{0, string};
      for (const char letter : texts[index - 1]) append(text, {letter, 0});
      text[0] = static_cast<uint8_t>(text.size());
      return text;
    }
    case get_status: return Bytes{0, 0};
    case get_configuration: return Bytes{1};
    case get_interface: return Bytes{0};
    case clear_feature:
      // The end of a stream from a bulk endpoint: its halt is cleared.
      if (request.setup[4] == 0x81) streaming_ = sends_ = false;
      return Bytes{};
    case set_feature:
    case set_configuration:
    case set_interface: return Bytes{};
    default: return std::nullopt;
  }
}

std::optional<Bytes> UsbCameraPeer::class_request(const Request& request, const Bytes& data) {
  const uint8_t what = request.setup[1];
  const int selector = request.setup[3], interface = request.setup[4], entity = request.setup[5];
  if (interface == 1) {
    constexpr int probe = 1, commit = 2;
    if (selector != probe && selector != commit) return std::nullopt;
    Bytes& current = selector == probe ? probe_ : commit_;
    switch (what) {
      case set_cur:
        if (data.size() < 8) return std::nullopt;
        current = stream_parameters(data[2], get(&data[4], 4));
        if (selector == commit) {
          streaming_ = true;
          sends_ = false;
          next_frame_ = 0;
          interval_ns_ = int64_t{get(&current[4], 4)} * 100;
        }
        return Bytes{};
      case get_len: return Bytes{parameters_size, 0};
      case get_info: return Bytes{3};
      case get_min: return stream_parameters(current[2], intervals[0]);
      case get_max: return stream_parameters(current[2], intervals[std::size(intervals) - 1]);
      case get_def: return stream_parameters(1, intervals[0]);
      case get_cur: return current;
      default: return std::nullopt;
    }
  }
  const auto control = std::find_if(controls_.begin(), controls_.end(), [&](const Control& candidate) {
    return candidate.entity == entity && candidate.selector == selector;
  });
  if (control == controls_.end()) return std::nullopt;
  const auto value = [&](uint32_t number) {
    Bytes bytes(control->size);
    put(bytes, 0, number, control->size);
    return bytes;
  };
  switch (what) {
    case set_cur:
      if (data.size() < control->size) return std::nullopt;
      control->value = get(data.data(), control->size);
      return Bytes{};
    case get_cur: return value(control->value);
    case get_min: return value(control->minimum);
    case get_max: return value(control->maximum);
    case get_res: return value(control->step);
    case get_def: return value(control->initial);
    case get_len: return Bytes{static_cast<uint8_t>(control->size), 0};
    case get_info: return Bytes{3};
    default: return std::nullopt;
  }
}

void UsbCameraPeer::begin_frame() {
  if (!streaming_ || sends_ || frames_.empty()) {
    ++missed_;
    return;
  }
  ++exposed_;
  sending_ = frames_[next_frame_++ % frames_.size()];
  const Fault fault = std::exchange(fault_, Fault::none);
  if (fault == Fault::swallow) return;
  if (fault == Fault::cut_short) sending_.resize(sending_.size() / 2);
  marks_error_ = fault == Fault::error_bit;
  sent_ = 0;
  sends_ = true;
  pump();
}

/// Hands the frame to the transfers that the host waits for; one may be on its way at the end of a stream, and is
/// completed by the next frame's beginning.
void UsbCameraPeer::pump() {
  constexpr uint8_t end_of_header = 0x80, error = 0x40, end_of_frame = 0x02;
  while (sends_ && !pending_.empty()) {
    const Pending transfer = pending_.front();
    pending_.pop_front();
    const size_t room = std::min<size_t>(transfer.length, payload) - payload_header;
    const size_t part = std::min(room, sending_.size() - sent_);
    const bool last = sent_ + part == sending_.size();
    Bytes data{payload_header, static_cast<uint8_t>(end_of_header | frame_toggle_ | (marks_error_ ? error : 0) |
                                                    (last ? end_of_frame : 0))};
    data.resize(payload_header, 0);
    data.insert(data.end(), sending_.begin() + static_cast<ptrdiff_t>(sent_),
                sending_.begin() + static_cast<ptrdiff_t>(sent_ + part));
    sent_ += part;
    reply(transfer.sequence, 0, data, static_cast<uint32_t>(data.size()));
    if (last) {
      sends_ = false;
      frame_toggle_ ^= 1;
    }
  }
}

}  // namespace booth
